"""What a policy sees and imagines, as images, and what an autoencoder keeps of states."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from midway.agent import AgentState, PretrainSettings
from midway.envs.views import MazeView, TableView
from midway.networks.decoder import ImageDecoder
from midway.reports import maze as maps
from midway.reports import style
from midway.reports.cache import SEED, Cache, Study
from midway.reports.decoder import (
    Images,
    as_images,
    decoded,
    features,
    real_images,
    reconstructed,
)
from midway.reports.recordings import draws
from midway.reports.runs import Group, Runs
from midway.reports.style import Picture
from midway.runs.policy import Policy
from midway.training.pretrain import sample_states
from midway.types import NumPyArray, Subgoal

Rows: TypeAlias = Mapping[str, tuple[Images, Images, Sequence[str]]]
"""Two images of every configuration and a note below them, by the name of their row."""

SHOWN = {"uniform": 2, "hard": 2}
"""Configurations of each task."""

DRAWN = 3
"""Subgoals of each configuration that are drawn from the subgoal policy."""

GAP = 0.25
"""Width between configurations, as a share of an image."""

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
            " Between them, decoded: the mean of the subgoal policy and draws from it, each beside "
            "the real image whose features are nearest (of starts, goals and after random actions; "
            "each feature in units of its deviation). The number is their distance, 1 being the "
            "median from a goal's image to the nearest other."
            if imagines
            else ""
        ),
        f"Images of {runs.env}: states, goals"
        + (" and imagined subgoals" if imagines else "")
        + f" of {group.label}, on random and on hard configurations.",
        "What the decoded state and goal do not show, the policy hardly knows: look for the puck."
        + (
            " A subgoal that is a state decodes to a whole image and has a number around 1. Draws "
            "are farther off than the mean where the subgoal policy is wide, for it spreads each "
            "feature by itself. The prior is averaged over draws; the mean is only the baseline "
            "of the advantage."
            if imagines
            else ""
        ),
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
    """Draw configurations side by side: state, goal and imagined subgoals, two images of each."""
    assert study.decoder is not None
    pair = study.policy, study.decoder
    blocks = {task: rows(*pair, task, count, SEED) for task, count in SHOWN.items()}
    names = list(blocks["uniform"])
    widths = [1.0, 1.0, GAP] * sum(SHOWN.values())
    side = (style.WIDTH - SIDE) / sum(widths)
    grid = {"width_ratios": widths}
    height = len(names) * (side + 0.2) + 0.4
    figure, axes = style.figure(len(names), len(widths), height=height, gridspec_kw=grid)
    panels = np.array(axes, object).reshape(len(names), -1, 3)
    look: style.Look = {"ha": "right", "va": "center", "color": style.INK}
    for name, configurations in zip(names, panels, strict=True):
        found = [block[name] for block in blocks.values()]
        images = zip(*(chain.from_iterable(part) for part in zip(*found, strict=True)), strict=True)
        for place, (left, right, note) in zip(configurations, images, strict=True):
            for panel, image in zip(place, (left, right, None), strict=True):
                _show(panel, image)
            place[1].set_xlabel(note, fontsize=style.SMALL)
        configurations[0][0].set_ylabel(name, rotation=0, fontsize=style.TEXT, **look)
    for task, first in (("uniform", 0), ("hard", SHOWN["uniform"])):
        panels[0, first, 0].set_title(f"{label}, {task}", fontsize=style.TEXT, loc="left")
    return figure


def rows(policy: Policy, decoder: ImageDecoder, task: str, count: int, seed: int) -> Rows:
    """Return the rows of one task: imagined subgoals where the agent has them."""
    env = policy.config.declaration().factory(num_envs=count, task=task)
    observation, _ = env.reset(seed=seed)
    state, goal = observation["observation"], observation["desired_goal"]
    ends = {
        "state,\nand decoded": (state, reconstructed(policy, decoder, state), count * [""]),
        "goal,\nand decoded": (goal, reconstructed(policy, decoder, goal), count * [""]),
    }
    if policy.agent.subgoals is None:
        return ends
    found = policy.subgoals(state, goal)
    drawn = np.moveaxis(draws(found, DRAWN, seed), 1, 0)
    real = Album(policy)
    subgoals = {"mean subgoal": np.asarray(found.location.achieved_goal)}
    subgoals |= {f"subgoal drawn,\n{n} of {DRAWN}": each for n, each in enumerate(drawn, start=1)}
    return ends | {
        f"{name},\nnearest image": (decoded(decoder, each), *real.nearest(each))
        for name, each in subgoals.items()
    }


class Album:
    """Real images of an environment, to be found by the features that a policy sees in them.

    Args:
        policy: The policy.
    """

    def __init__(self, policy: Policy) -> None:
        self._images = real_images(policy)
        seen = features(policy, self._images)
        self._scale = np.maximum(seen.std(axis=0), 1e-6)
        self._tree = cKDTree(seen / self._scale)
        goals = len(seen) // 4  # the last quarter, whose images are independent of the others
        others = cKDTree(seen[:-goals] / self._scale)
        self._usual = float(np.median(others.query(seen[-goals:] / self._scale)[0]))

    def nearest(self, found: Float[np.ndarray, "B F"]) -> tuple[Images, list[str]]:
        """Return the images whose features are nearest, and how far these are, in words."""
        distance, number = self._tree.query(found / self._scale)
        return self._images[number], [f"{d:.1f}" for d in distance / self._usual]


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
