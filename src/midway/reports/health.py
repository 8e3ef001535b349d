"""Training health: the scalars of ``metrics.csv``, and what a healthy curve looks like."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from midway.reports import style
from midway.reports.cache import Cache
from midway.reports.runs import Group, RunData, Runs, seeds_of
from midway.reports.style import Picture, thousands
from midway.tables import Table

COLUMNS = 3

LINE = 44
"""Letters in a line under a panel."""


@dataclass(frozen=True)
class Panel:
    """One quantity.

    Attributes:
        title: Its name, with its unit.
        columns: Columns of ``metrics.csv``; the second is dashed. ``updates/s`` is computed.
        healthy: One line that says what a healthy curve looks like.
        logarithmic: Whether it spans powers of ten.
        bounded: Whether the bounds of the values are drawn.
    """

    title: str
    columns: tuple[str, ...]
    healthy: str
    logarithmic: bool = False
    bounded: bool = field(default=False, kw_only=True)


PANELS = (
    Panel(
        "Q (solid), target (dashed)",
        ("critic/q", "critic/target"),
        "Falls from 0, then levels off between the bounds; beyond the lower bound it diverges.",
        bounded=True,
    ),
    Panel(
        "Critic loss",
        ("critic/loss",),
        "Settles at some level, which may be above its first; growth without end means divergence.",
        True,
    ),
    Panel(
        "KL to the prior (nats)",
        ("policy/kl_to_prior",),
        "Rises while the policy learns, then settles; growth without end: the prior is ignored.",
    ),
    Panel(
        "Subgoal advantage (steps)",
        ("subgoal/advantage",),
        "Below 0 and falling: imagined subgoals are better than states at random.",
    ),
    Panel(
        "Subgoal scale",
        ("subgoal/scale",),
        "Falls at first and settles above 0: subgoals get precise but do not collapse.",
    ),
    Panel(
        "Effective candidates",
        ("subgoal/effective_candidates",),
        "Below the batch size: good states count; 1: one state alone decides each update.",
        True,
    ),
    Panel(
        "Policy entropy (nats)",
        ("policy/entropy",),
        "Settles (SAC: at its target). A sudden fall: too sure too soon. RIS at 3.4 an action: "
        "stuck at its bound.",
    ),
    Panel(
        "Entropy coefficient",
        ("policy/entropy_coefficient",),
        "Falls, then levels off once the entropy is at its target.",
        True,
    ),
    Panel(
        "Success while collecting",
        ("collect/success_rate",),
        "Rises, with noise: sampled actions on the tasks of training.",
    ),
    Panel(
        "Steps on its back (share)",
        ("collect/flip_rate",),
        "Falls towards 0 as the ant learns to walk; level and high: replay fills with lying ants.",
    ),
    Panel(
        "Updates per second",
        ("updates/s",),
        "Level; a lasting fall means a busy or overheated machine.",
    ),
)


def figures(runs: Runs, cache: Cache) -> Iterator[Picture]:
    """Yield one figure of all scalars that some run has."""
    shown = panels(runs.groups)
    if not shown:
        cache.note("no run has metrics yet: no training health")
        return
    yield Picture(
        f"{runs.slug}-health",
        lambda: draw(runs.groups),
        "Training health",
        "One line for each seed; the grey text says what a healthy curve looks like. "
        "Dotted: the bounds of the values.",
        f"{len(shown)} quantities over environment steps: "
        f"{', '.join(panel.title for panel in shown)}. Healthy: "
        + " ".join(panel.healthy for panel in shown),
        "A curve that does what its grey text calls unhealthy is the first thing to look into "
        "where success stays low.",
    )


def draw(groups: Sequence[Group]) -> Figure:
    """Draw every quantity that some run has, one line per run."""
    shown = panels(groups)
    rows = -(-len(shown) // COLUMNS)
    figure, axes = style.figure(rows, COLUMNS, height=2.75 * rows + 0.4)
    for axis, panel in zip(axes, shown, strict=False):
        _draw_panel(axis, panel, groups)
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    entries = [_entry(group) for group in groups]
    style.legend_below(figure, entries, title="x axis of every panel: environment steps")
    return figure


def _draw_panel(axes: Axes, panel: Panel, groups: Sequence[Group]) -> None:
    for group in groups:
        for run in group.runs:
            _draw_run(axes, panel, group, run)
    if panel.bounded:
        _draw_bounds(axes, groups)
    if panel.logarithmic:
        _scale_logarithmically(axes)
    axes.xaxis.set_major_formatter(thousands)
    axes.set_xlim(left=0)
    _write(axes, panel)


def panels(groups: Sequence[Group]) -> list[Panel]:
    """Return the panels that some run has numbers for."""
    tables = [with_speed(run.metrics) for group in groups for run in group.runs]
    return [
        p for p in PANELS if any(np.isfinite(t.get(p.columns[0], np.nan)).any() for t in tables)
    ]


def with_speed(table: Table) -> Table:
    """Return the table with ``updates/s``, between each row and the one before it."""
    if not table:
        return {}
    updates = np.diff(table["updates"], prepend=np.nan)
    seconds = np.diff(table["training_seconds"], prepend=np.nan)
    speed = np.divide(updates, seconds, out=np.full_like(updates, np.nan), where=seconds > 0)
    return {**table, "updates/s": speed}


def _draw_run(axes: Axes, panel: Panel, group: Group, run: RunData) -> None:
    table = with_speed(run.metrics)
    for column, line in zip(panel.columns, ("-", (0, (2, 1.5))), strict=False):
        if column in table:
            x, y = finite(table["step"], table[column])
            axes.plot(x, y, color=group.colour, linestyle=line, linewidth=1.3, alpha=0.85)


def finite(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return the points that have a number."""
    kept = np.isfinite(y)
    return x[kept], y[kept]


def _draw_bounds(axes: Axes, groups: Sequence[Group]) -> None:
    """Draw the largest and the smallest possible value."""
    discounts = {getattr(group.runs[0].config.hyperparameters, "discount", 1.0) for group in groups}
    for bound in {0.0} | {-1 / (1 - discount) for discount in discounts if discount < 1}:
        axes.axhline(bound, color=style.MUTED, linestyle=":", linewidth=1.4)


def _scale_logarithmically(axes: Axes) -> None:
    """Show powers of ten, and 2 and 5 times them where there are few."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    few = high / low < 1_000
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: _minor_name(value) if few else "")
    axes.tick_params(which="minor", labelsize=style.SMALL, color=style.MUTED, labelcolor=style.INK)


def _minor_name(value: float) -> str:
    """Return 2 and 5 times a power of ten as text, and nothing for other numbers."""
    return f"{value:g}" if f"{value:.0e}"[0] in "25" else ""


def _write(axes: Axes, panel: Panel) -> None:
    """Write the title, and what is healthy where the name of the axis would be."""
    axes.set_title(panel.title, fontsize=style.TEXT, color=style.INK, loc="left", weight="bold")
    text = textwrap.fill(panel.healthy, LINE)
    axes.set_xlabel(text, fontsize=style.SMALL, color=style.MUTED, loc="left", labelpad=5)
    axes.xaxis.label.set_horizontalalignment("left")


def _entry(group: Group) -> Line2D:
    return Line2D(
        [], [], color=group.colour, linewidth=2, label=f"{group.label} ({seeds_of([group])})"
    )
