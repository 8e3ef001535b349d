"""What the autoencoder of a policy keeps of states (LEAP)."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.figure import Figure

from midway.envs import registry as environments
from midway.reports import maps, style
from midway.reports.runs import RunData
from midway.reports.study import POSITION, maze_of
from midway.training import policy as policies
from midway.training.pretrain import sample_states
from midway.types import Pretraining

COUNT = 60
"""States on a map."""

IMAGES = 8
"""Images in a row."""

SEED = 20_210_718
"""Seed of the states, which are met in no training."""

Pair = tuple[Shaped[np.ndarray, "N ..."], Shaped[np.ndarray, "N ..."]]


def has_autoencoder(run: RunData) -> bool:
    """Return whether the run has an autoencoder whose states can be drawn."""
    drawable = maze_of(run.config.env) is not None or run.config.env == "push"
    return run.config.agent == "leap" and run.has_policy and drawable


def draw(run: RunData, label: str) -> Figure:
    """Draw new states of the environment beside their reconstructions.

    Raises:
        ConfigurationError: The policy is missing, damaged or foreign.
    """
    states, reconstructions = reconstruct(run)
    maze = maze_of(run.config.env)
    if maze is None:
        return _draw_images(states, reconstructions, label)
    figure, (axes,) = maps.panels(maze, 1)
    before, after = states[:, POSITION], reconstructions[:, POSITION]
    error = np.linalg.norm(after - before, axis=1).mean()
    style.caption(axes, label, f"mean error {error:.2f} m")
    for pair in np.stack([before, after], axis=1):
        axes.plot(*pair.T, color=style.MUTED, linewidth=1.0, zorder=3)
    states_drawn = axes.plot(*before.T, "o", color=style.BLACK, markersize=5, label="state")[0]
    drawn = axes.plot(*after.T, "D", color=style.ORANGE, markersize=4, label="reconstruction")[0]
    style.legend_below(figure, [states_drawn, drawn])
    return figure


def reconstruct(run: RunData) -> Pair:
    """Return new states and what is left of them after encoding and decoding."""
    env = environments.make_vec(run.config.env, num_envs=IMAGES)
    state = policies.load(run.folder, env.goal_spec).state
    count = IMAGES if state.spec.is_image else COUNT
    actions = state.config.vae_random_actions
    states = sample_states(env, Pretraining(("vae",), count, actions, 1), SEED).observation
    decoded = eqx.filter_jit(lambda vae, x: vae.decode(vae.encode(x).mean))(state.vae, states)
    return np.asarray(states), np.asarray(decoded)


def _draw_images(
    images: Shaped[np.ndarray, "N H W 3"],
    reconstructions: Float[np.ndarray, "N H W 3"],
    label: str,
) -> Figure:
    figure, axes = style.figure(2, IMAGES, height=2 * style.WIDTH / IMAGES + 0.7)
    for panel, image in zip(axes, [*images, *np.clip(reconstructions, 0, 1)], strict=True):
        panel.imshow(image)
        panel.set_axis_off()
    axes[0].set_title(f"{label}: images, and below what is reconstructed", loc="left")
    return figure
