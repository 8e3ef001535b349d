"""What a policy sees, imagines and is to reach, as images (figure 10 of the paper)."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from midway.envs import registry as environments
from midway.networks.decoder import ImageDecoder
from midway.reports import imagination, style
from midway.training import decoder as decoders
from midway.training.folder import RunFolder
from midway.training.policy import Policy

Images = Shaped[np.ndarray, "B H W 3"]
Rows = Mapping[str, Images]
"""Images of every configuration, by the name of their row."""

SHOWN = {"uniform": 4, "hard": 4}
"""Configurations of each task."""

GAP = 0.25
"""Width between the two tasks, as a share of an image."""

SIDE = 1.3
"""Width of the names of rows (inches)."""


def decoder_of(folder: RunFolder, policy: Policy) -> ImageDecoder:
    """Return the decoder of a run's policy, fitted now if it has none yet.

    Raises:
        ConfigurationError: Nothing here can draw the images that it is fitted to.
    """
    env = environments.make_vec(policy.config.env, num_envs=decoders.COPIES)
    return decoders.of_policy(folder, policy, env)


def draw(policy: Policy, decoder: ImageDecoder, label: str, seed: int) -> Figure:
    """Draw configurations side by side: state, imagined subgoals, goal, and what is decoded."""
    blocks = {task: rows(policy, decoder, task, count, seed) for task, count in SHOWN.items()}
    names = list(next(iter(blocks.values())))
    columns = sum(SHOWN.values()) + len(SHOWN) - 1
    widths = [1.0] * columns
    widths[SHOWN["uniform"]] = GAP
    side = (style.WIDTH - SIDE) / sum(widths)
    figure, axes = style.figure(
        len(names),
        columns,
        height=len(names) * (side + 0.04) + 0.4,
        gridspec_kw={"width_ratios": widths},
    )
    for row, name in enumerate(names):
        images = [*blocks["uniform"][name], None, *blocks["hard"][name]]
        for column, image in enumerate(images):
            _show(axes[row * columns + column], image)
        axes[row * columns].set_ylabel(
            name, rotation=0, ha="right", va="center", fontsize=style.TEXT, color=style.INK
        )
    for task, column in (("uniform", 0), ("hard", SHOWN["uniform"] + 1)):
        axes[column].set_title(f"{label}, {task}", fontsize=style.TEXT, loc="left")
    return figure


def rows(policy: Policy, decoder: ImageDecoder, task: str, count: int, seed: int) -> Rows:
    """Return the rows of one task: imagined subgoals where the agent has them."""
    env = environments.make_vec(policy.config.env, num_envs=count, task=task)
    observation, _ = env.reset(seed=seed)
    pair = observation["observation"], observation["desired_goal"]
    seen = {"state": pair[0], "state,\ndecoded": reconstructed(policy, decoder, pair[0])}
    goals = {"goal,\ndecoded": reconstructed(policy, decoder, pair[1]), "goal": pair[1]}
    if not imagination.imagines(policy.config.agent):
        return {**seen, **goals}
    mean = imagination.distribution(policy, *pair)[0]
    drawn = imagination.subgoals(policy, *pair, count=1, seed=seed)[:, 0]
    return {
        **seen,
        "imagined\nsubgoal, mean": decoded(decoder, mean),
        "imagined\nsubgoal, drawn": decoded(decoder, drawn),
        **goals,
    }


def decoded(decoder: Callable[[Any], Any], codes: Float[np.ndarray, "B L"]) -> Images:
    """Return the images that codes stand for, uint8."""
    images = np.asarray(_decoded(decoder, codes))
    return np.asarray((255 * np.clip(images, 0, 1)).round(), np.uint8)


def reconstructed(policy: Policy, decoder: ImageDecoder, images: Images) -> Images:
    """Return what is left of images after encoding and decoding, uint8."""
    return decoded(decoder, np.asarray(_encoded(policy.state.encoder, images)))


@eqx.filter_jit
def _decoded(decoder: Any, codes: Any) -> Any:
    return decoder(codes)


@eqx.filter_jit
def _encoded(encoder: Any, images: Any) -> Any:
    return encoder(images)


def _show(axes: Axes, image: Any) -> None:
    """Show an image without axes, or nothing."""
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)
    axes.set(xticks=[], yticks=[])
    if image is None:
        axes.set_visible(False)
    else:
        axes.imshow(image)
