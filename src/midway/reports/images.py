"""What a policy sees and imagines, as images, and what an autoencoder keeps of states."""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from midway.agent import AgentState, PretrainSettings
from midway.envs.views import MazeView, TableView
from midway.networks.decoder import ImageDecoder
from midway.reports import maze as maps
from midway.reports import style
from midway.reports.cache import SEED, Cache, Study
from midway.reports.decoder import Images, as_images, decoded, reconstructed
from midway.reports.recordings import draws
from midway.reports.runs import Group, Runs
from midway.reports.style import Picture
from midway.runs.policy import Policy
from midway.training.pretrain import sample_states
from midway.types import NumPyArray, Subgoal

Rows: TypeAlias = Mapping[str, Images]
"""Images of every configuration, by the name of their row."""

SHOWN = {"uniform": 4, "hard": 4}
"""Configurations of each task."""

GAP = 0.25
"""Width between the two tasks, as a share of an image."""

SIDE = 1.3
"""Width of the names of rows (inches)."""

STATES = 60
"""Reconstructed states on a map."""

IMAGES = 8
"""Reconstructed images in a row."""

ACTIONS = 2
"""Random actions after each reset that reconstructed states are taken from."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield what each group imagines as images, and what its autoencoder keeps."""
    if runs.view is None:
        return
    for group in runs.groups:
        for study in cache.studies(group)[:1]:
            if isinstance(runs.view, TableView) and study.decoder is not None:
                yield _imagined_picture(runs, group, study)
            if study.agent.pretrain is not None and _is_drawn(study):
                yield _kept_picture(runs, group, study)


def _is_drawn(study: Study) -> bool:
    """Return whether the states of the environment can be drawn."""
    return isinstance(study.view, MazeView) or study.policy.spec.is_image


def _imagined_picture(runs: Runs, group: Group, study: Study) -> Picture:
    imagines = study.imagines
    return Picture(
        f"{runs.slug}-{group.slug}-images",
        lambda: draw(study, group.label),
        f"What {group.label} imagines" if imagines else f"What the features of {group.label} keep",
        f"Columns are starts with their goals ({study.where}). A decoder that was fitted on the "
        "side turns features into images; the decoded state and goal show how much of an image the "
        "features and the decoder keep."
        + (
            " Between them: the mean of the subgoal policy and one draw from it, decoded."
            if imagines
            else ""
        ),
        f"Images of {runs.env}: states, goals"
        + (" and imagined subgoals" if imagines else "")
        + f" of {group.label}, on random and on hard configurations.",
        "What the decoded state and goal do not show, the policy hardly knows: look for the puck."
        + (" A sound subgoal lies between the two." if imagines else ""),
    )


def _kept_picture(runs: Runs, group: Group, study: Study) -> Picture:
    return Picture(
        f"{runs.slug}-{group.slug}-reconstructions",
        lambda: draw_reconstructions(study, group.label),
        f"What the autoencoder of {group.label} keeps",
        "New states of the environment, and what is decoded from their latent numbers: "
        f"{group.label} plans its subgoals in these ({study.where}).",
        f"States of {runs.env} and their reconstructions.",
        "What is lost below the images cannot be planned for: look for the puck.",
    )


def draw(study: Study, label: str) -> Figure:
    """Draw configurations side by side: state, imagined subgoals, goal, and what is decoded."""
    assert study.decoder is not None
    pair = study.policy, study.decoder
    blocks = {task: rows(*pair, task, count, SEED) for task, count in SHOWN.items()}
    names = list(blocks["uniform"])
    columns = sum(SHOWN.values()) + len(SHOWN) - 1
    widths = [1.0] * columns
    widths[SHOWN["uniform"]] = GAP
    side = (style.WIDTH - SIDE) / sum(widths)
    height = len(names) * (side + 0.04) + 0.4
    grid = {"width_ratios": widths}
    figure, axes = style.figure(len(names), columns, height=height, gridspec_kw=grid)
    for row, name in enumerate(names):
        images = [*blocks["uniform"][name], None, *blocks["hard"][name]]
        for column, image in enumerate(images):
            _show(axes[row * columns + column], image)
        look: style.Look = {"ha": "right", "va": "center", "color": style.INK}
        axes[row * columns].set_ylabel(name, rotation=0, fontsize=style.TEXT, **look)
    for task, column in (("uniform", 0), ("hard", SHOWN["uniform"] + 1)):
        axes[column].set_title(f"{label}, {task}", fontsize=style.TEXT, loc="left")
    return figure


def rows(policy: Policy, decoder: ImageDecoder, task: str, count: int, seed: int) -> Rows:
    """Return the rows of one task: imagined subgoals where the agent has them."""
    env = policy.config.declaration().factory(num_envs=count, task=task)
    observation, _ = env.reset(seed=seed)
    pair = observation["observation"], observation["desired_goal"]
    seen = {"state": pair[0], "state,\ndecoded": reconstructed(policy, decoder, pair[0])}
    goals = {"goal,\ndecoded": reconstructed(policy, decoder, pair[1]), "goal": pair[1]}
    if policy.agent.subgoals is None:
        return {**seen, **goals}
    found = policy.subgoals(*pair)
    return {
        **seen,
        "imagined\nsubgoal, mean": decoded(decoder, found.location.achieved_goal),
        "imagined\nsubgoal, drawn": decoded(decoder, draws(found, count=1, seed=seed)[:, 0]),
        **goals,
    }


def _show(axes: Axes, image: NumPyArray | None) -> None:
    """Show an image without axes, or nothing."""
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)
    axes.set(xticks=[], yticks=[])
    if image is None:
        axes.set_visible(False)
    else:
        axes.imshow(image)


def draw_reconstructions(study: Study, label: str) -> Figure:
    """Draw new states of the environment beside their reconstructions."""
    states, kept = reconstructions(study.policy)
    if not isinstance(study.view, MazeView):
        return _draw_images(states, as_images(kept), label)
    figure, (axes,) = maps.panels(study.view.maze, 1)
    before, after = states[:, study.view.position], kept[:, study.view.position]
    error = np.linalg.norm(after - before, axis=1).mean()
    style.caption(axes, label, f"mean error {error:.2f} m")
    for pair in np.stack([before, after], axis=1):
        axes.plot(*pair.T, color=style.MUTED, linewidth=1.0, zorder=3)
    states_drawn = axes.plot(*before.T, "o", color=style.BLACK, markersize=5, label="state")[0]
    drawn = axes.plot(*after.T, "D", color=style.ORANGE, markersize=4, label="reconstruction")[0]
    style.legend_below(figure, [states_drawn, drawn])
    return figure


def reconstructions(
    policy: Policy,
) -> tuple[Shaped[np.ndarray, "N ..."], Float[np.ndarray, "N ..."]]:
    """Return new states and what is left of them after encoding and decoding."""
    env = policy.config.declaration().factory(num_envs=IMAGES)
    count = IMAGES if policy.spec.is_image else STATES
    assert policy.agent.pretrain is not None
    states = sample_states(env, PretrainSettings((), count, ACTIONS, rounds=0), SEED)
    kept = _reconstructed(policy.agent.pretrain.reconstruct, policy.state, states)
    return np.asarray(states.observation), np.asarray(kept)


@eqx.filter_jit
def _reconstructed(
    reconstruct: Callable[[AgentState, Subgoal], Array], state: AgentState, states: Subgoal
) -> Array:
    return reconstruct(state, states)


def _draw_images(images: Images, kept: Images, label: str) -> Figure:
    figure, axes = style.figure(2, IMAGES, height=2 * style.WIDTH / IMAGES + 0.7)
    for panel, image in zip(axes, [*images, *kept], strict=True):
        panel.imshow(image)
        panel.set_axis_off()
    axes[0].set_title(f"{label}: images, and below what is reconstructed", loc="left")
    return figure
