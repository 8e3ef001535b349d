"""The table of the arm from above: where a policy brings hand and puck, and what it imagines."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patches import Rectangle as Patch

from midway.envs.push_scene import HAND_BOX
from midway.envs.views import TableView
from midway.reports import maze as maps
from midway.reports import style
from midway.reports.cache import ON_TABLE, Cache, Study
from midway.reports.recordings import Recording, in_every_state
from midway.reports.runs import Group, Runs
from midway.reports.style import Picture
from midway.runs.policy import Policy

HAND, PUCK = TableView.hand, TableView.puck
"""x and y of the hand and of the puck in a state (m)."""

PUCK_RADIUS = 0.04
"""As the puck is drawn (m)."""

MARGIN = 0.06
"""How much is drawn around what the hand can reach (m)."""


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield the table of each group: the policy of its first usable seed."""
    if isinstance(runs.view, TableView):
        for group in runs.groups:
            for study in cache.studies(group)[:1]:
                yield _picture(runs, group, study)


def _picture(runs: Runs, group: Group, study: Study) -> Picture:
    episodes = study.recordings
    return Picture(
        f"{runs.slug}-{group.slug}-table",
        lambda: draw(study, group.label),
        f"{group.label} at the table",
        f"Ways of hand and puck with the deterministic policy ({study.where}), seen as the camera "
        "sees them. An episode ends when both are within 5 cm of their goals. Subgoals, where they "
        "are states, are those at the start.",
        f"Plan of the table with {len(episodes)} episodes of {group.label}, "
        f"{sum(episode.success for episode in episodes)} of which reach the goal.",
        f"{sum(episode.success for episode in episodes)} of {len(episodes)} episodes reach their "
        "goal. A puck that lies where it lay was never touched; one that lies off its goal was "
        "pushed, and not far or not straight enough.",
    )


def draw(study: Study, label: str) -> Figure:
    """Draw the ways of hand and puck, and subgoals imagined or planned at the start."""
    figure, axes = panels(len(ON_TABLE), max(ON_TABLE.values()))
    kind = ""
    for panel, recording in zip(axes, study.recordings, strict=True):
        draw_ways(panel, recording)
        found = subgoals(study.policy, recording)
        if found is not None:
            draw_subgoals(panel, found[0])
            kind = recording.kind
        draw_state(panel, recording.states[0], maps.START)
        draw_state(panel, recording.target, maps.GOAL)
        end = "reached" if recording.success else f"{100 * recording.final_distance:.0f} cm off"
        style.caption(panel, f"{label}, {recording.task}: {end}")
    style.legend_below(figure, legend(kind))
    return figure


def panels(rows: int, columns: int, width: float = style.WIDTH) -> tuple[Figure, list[Axes]]:
    """Return a figure with plans of the table, turned as the camera sees it."""
    seen = HAND_BOX.grown(MARGIN)
    height = rows * (width / columns * seen.half_y / seen.half_x + 0.35) + 0.6
    figure, axes = style.figure(rows, columns, height=height, width=width)
    for each in axes:
        draw_table(each)
    return figure, axes


def draw_table(axes: Axes) -> None:
    """Draw what the hand can reach; x points left and y down, as in the pictures."""
    axes.grid(visible=False)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_facecolor("#f2f1ec")
    size = (2 * HAND_BOX.half_x, 2 * HAND_BOX.half_y)
    axes.add_patch(Patch(HAND_BOX.low, *size, facecolor="none", edgecolor=maps.WALL, lw=1))
    seen = HAND_BOX.grown(MARGIN)
    axes.set_xlim(seen.high[0], seen.low[0])
    axes.set_ylim(seen.high[1], seen.low[1])
    axes.set_aspect("equal")


def draw_state(axes: Axes, state: Float[np.ndarray, "4"], colour: str) -> None:
    """Draw the hand as a square, and the puck as the circle that it is."""
    x, y = state[PUCK].tolist()
    axes.plot(*state[HAND], "s", color=colour, markersize=7, markeredgecolor="white", zorder=6)
    axes.add_patch(Circle((x, y), PUCK_RADIUS, fill=False, edgecolor=colour, lw=2, zorder=5))


def draw_ways(axes: Axes, recording: Recording) -> None:
    """Draw where hand (thin) and puck (thick) went."""
    colour = maps.REACHED if recording.success else maps.FAILED
    for part, width in ((HAND, 1.0), (PUCK, 2.6)):
        axes.plot(*recording.states[:, part].T, color=colour, linewidth=width, alpha=0.8, zorder=4)


def draw_subgoals(axes: Axes, imagined: Float[np.ndarray, "I 4"]) -> None:
    """Draw imagined subgoals: hands as squares, the middles of pucks as dots."""
    for part, marker in ((HAND, "s"), (PUCK, "o")):
        axes.plot(
            *imagined[:, part].T,
            marker,
            color=maps.SUBGOAL,
            markersize=5,
            markeredgecolor=style.INK,
            markeredgewidth=0.4,
            alpha=0.7,
            zorder=5,
        )


def subgoals(policy: Policy, recording: Recording) -> Float[np.ndarray, "T I 4"] | None:
    """Return the subgoals in every state (m), imagined or planned.

    None where there are none, or where they are features of images.
    """
    return None if policy.spec.is_image else in_every_state(policy, recording)


def legend(subgoals: str) -> list[Line2D]:
    """Return the entries; ``subgoals`` are imagined, planned, or none."""
    hollow: style.Look = {"linestyle": "", "markerfacecolor": "none", "markeredgewidth": 2}
    dots: style.Look = {"linestyle": "", "color": maps.SUBGOAL, "markeredgecolor": style.INK}
    entries = [
        Line2D([], [], color=maps.START, marker="s", linestyle="", label="hand at the start"),
        Line2D(
            [], [], color=maps.START, marker="o", markersize=10, label="puck at the start", **hollow
        ),
        Line2D([], [], color=maps.GOAL, marker="s", linestyle="", label="goal of the hand"),
        Line2D(
            [], [], color=maps.GOAL, marker="o", markersize=10, label="goal of the puck", **hollow
        ),
        Line2D([], [], color=maps.REACHED, linewidth=2, label="way: goal reached (thick: puck)"),
        Line2D([], [], color=maps.FAILED, linewidth=2, label="way: not reached"),
    ]
    if subgoals:
        entries += [
            Line2D([], [], marker="s", label=f"{subgoals} subgoals: hand", **dots),
            Line2D([], [], marker="o", label="and puck", **dots),
        ]
    return entries
