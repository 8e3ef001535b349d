"""The pictures of an episode, step by step: a maze, the arm's table, or images side by side."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.text import Text

from midway.agent import Plan
from midway.envs.geodesic import way_left
from midway.envs.views import MazeView, TableView
from midway.reports import decoder, style, tabletop
from midway.reports import maze as maps
from midway.reports.decoder import Images
from midway.reports.recordings import Recording, imagined, in_every_state, plans
from midway.runs.folder import RunFolder
from midway.runs.policy import Policy
from midway.types import DistanceTask

Frame: TypeAlias = UInt8[np.ndarray, "height width 3"]

PIXELS = 100
"""Pixels per inch of a frame."""

SIDE = 2.6
"""Width of an image in a frame (inches)."""

TABLE_WIDTH = 6.0
"""Width of the table in a frame (inches)."""


@runtime_checkable
class Scene(Protocol):
    """Draws the frames of one episode; all frames of a video have the same size."""

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        ...


MakeScene: TypeAlias = Callable[[Recording], Scene]


def maker(folder: RunFolder, policy: Policy, title: str) -> MakeScene:
    """Return what makes the scene of an episode.

    Args:
        folder: The run folder.
        policy: Its policy, asked for subgoals in every state if it imagines any.
        title: What is shown.
    """
    view = policy.config.declaration().view
    if isinstance(view, MazeView):
        return lambda recording: MazeScene(view, title, policy, recording)
    if isinstance(view, TableView) and policy.spec.is_image:
        decode = decoding(folder, policy)
        return lambda recording: ImageScene(title, policy, recording, decode)
    if isinstance(view, TableView):
        return lambda recording: TableScene(title, policy, recording)
    return lambda recording: GoalScene(title, policy, recording)


class Stage:
    """A figure whose background is drawn once; each frame adds what moves.

    Args:
        figure: The figure with all that stands still.
        moving: What moves, hidden from the background.
    """

    def __init__(self, figure: Figure, moving: Sequence[Artist]) -> None:
        self._figure = figure
        self._moving = moving
        for artist in moving:
            artist.set_animated(True)
        figure.set_dpi(PIXELS)
        style.settle(figure)
        self._canvas = cast(FigureCanvasAgg, figure.canvas)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def frame(self) -> Frame:
        """Return the picture with everything where it is now; both sides are even."""
        self._canvas.restore_region(self._background)
        for artist in self._moving:
            self._figure.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        height, width = (side - side % 2 for side in pixels.shape[:2])
        return pixels[:height, :width].copy()


class MazeScene:
    """A maze from above, with the agent, its trail, its goal and the subgoals it imagines.

    Args:
        view: The maze, and where positions are.
        title: What is shown.
        policy: The policy, asked for subgoals in every state if it imagines any.
        recording: The episode.
    """

    def __init__(self, view: MazeView, title: str, policy: Policy, recording: Recording) -> None:
        self._path = recording.states[:, view.position]
        found = in_every_state(policy, recording)
        self._subgoals = None if found is None else found[..., view.position]
        self._kind = recording.kind
        self._words = Words(policy, recording, unit=1.0)
        self._words.along(view, recording)
        figure, (axes,) = maps.panels(view.maze, 1)
        _head(axes, title)
        maps.draw_ends(axes, self._path[0], recording.target[view.position], size=1.4)
        self._trail, self._agent, self._marks = (
            axes.plot([], [], **look)[0]
            for look in (
                {"color": style.BLUE, "linewidth": 2, "zorder": 4},
                {"color": style.BLUE, "marker": "o", "markersize": 11, "zorder": 7},
                {**_diamonds(), "zorder": 6},
            )
        )
        style.legend_below(figure, self._legend())
        self._text = _text(axes)
        self._stage = Stage(figure, [self._trail, self._agent, self._marks, self._text])

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        self._trail.set_data(*self._path[: step + 1].T)
        self._agent.set_data(*self._path[step : step + 1].T)
        if self._subgoals is not None:
            self._marks.set_data(*self._subgoals[step].T)
        self._text.set_text(self._words.after(step))
        return self._stage.frame()

    def _legend(self) -> list[Line2D]:
        look: style.Look = {"color": style.BLUE, "marker": "o", "markersize": 9, "linewidth": 2}
        entries = [Line2D([], [], label="agent", **look), *maps.ends_legend()]
        if self._subgoals is not None:
            entries.append(Line2D([], [], label=f"{self._kind} subgoals", **_diamonds()))
        return entries


class TableScene:
    """The table from above, with hand, puck, their ways and goals, and imagined subgoals.

    Args:
        title: What is shown.
        policy: The policy, asked for subgoals in every state if it imagines any.
        recording: The episode, of hand x, y and puck x, y (m).
    """

    def __init__(self, title: str, policy: Policy, recording: Recording) -> None:
        self._states = recording.states
        self._subgoals = tabletop.subgoals(policy, recording)
        self._kind = recording.kind
        self._words = Words(policy, recording, unit=0.01)
        figure, (axes,) = tabletop.panels(1, 1, TABLE_WIDTH)
        _head(axes, title)
        tabletop.draw_state(axes, recording.target, maps.GOAL)
        self._ways = [
            axes.plot([], [], color=style.BLUE, linewidth=width, alpha=0.6, zorder=4)[0]
            for width in (1.0, 2.6)
        ]
        self._marks = [
            axes.plot([], [], marker, color=maps.SUBGOAL, markersize=6, alpha=0.7, zorder=5)[0]
            for marker in ("s", "o")
        ]
        self._hand = axes.plot([], [], "s", color=style.BLUE, markersize=11, zorder=7)[0]
        look: style.Look = {"facecolor": style.BLUE, "alpha": 0.45, "zorder": 3}
        self._puck = Circle((0, 0), tabletop.PUCK_RADIUS, **look)
        axes.add_patch(self._puck)
        style.legend_below(figure, self._legend())
        self._text = _text(axes)
        moving = [self._puck, *self._ways, *self._marks, self._hand, self._text]
        self._stage = Stage(figure, moving)

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        parts = (tabletop.HAND, tabletop.PUCK)
        for part, way, marks in zip(parts, self._ways, self._marks, strict=True):
            way.set_data(*self._states[: step + 1, part].T)
            if self._subgoals is not None:
                marks.set_data(*self._subgoals[step][:, part].T)
        self._hand.set_data(*self._states[step : step + 1, tabletop.HAND].T)
        x, y = self._states[step, tabletop.PUCK].tolist()
        self._puck.set_center((x, y))
        self._text.set_text(self._words.after(step))
        return self._stage.frame()

    def _legend(self) -> list[Line2D]:
        hollow: style.Look = {"markerfacecolor": "none", "markeredgewidth": 2, "markersize": 10}
        look: style.Look = {"linestyle": "", "color": style.BLUE}
        goal: style.Look = {"linestyle": "", "color": maps.GOAL}
        entries = [
            Line2D([], [], marker="s", label="hand", **look),
            Line2D([], [], marker="o", markersize=10, alpha=0.45, label="puck", **look),
            Line2D([], [], marker="s", label="goal of the hand", **goal),
            Line2D([], [], marker="o", label="goal of the puck", **goal, **hollow),
        ]
        if self._subgoals is not None:
            dots: style.Look = {"linestyle": "", "color": maps.SUBGOAL}
            entries.append(Line2D([], [], marker="s", label=f"{self._kind} subgoals: hand", **dots))
            entries.append(Line2D([], [], marker="o", label="and puck", **dots))
        return entries


class ImageScene:
    """What the camera sees, the mean imagined subgoal if there is one, and the goal.

    Args:
        title: What is shown.
        policy: The policy.
        recording: The episode, of images.
        decode: Returns the images of the subgoals in every state, or None.
    """

    def __init__(
        self,
        title: str,
        policy: Policy,
        recording: Recording,
        decode: Callable[[Recording], Images | None],
    ) -> None:
        subgoals = decode(recording)
        films = {"now": recording.observations}
        films |= {} if subgoals is None else {f"{recording.kind} subgoal": subgoals}
        self._films = list(films.values())
        self._words = Words(policy, recording, unit=0.01)
        columns = len(films) + 1
        figure, axes = style.figure(1, columns, height=SIDE + 0.9, width=columns * (SIDE + 0.1))
        for panel in axes:
            panel.set_axis_off()
        figure.suptitle(f"{title}\n", fontsize=style.TEXT, color=style.INK)
        for panel, name in zip(axes, [*films, "goal"], strict=True):
            panel.set_title(name, fontsize=style.TEXT, color=style.INK)
        axes[-1].imshow(recording.goal)
        self._images = [
            panel.imshow(film[0]) for panel, film in zip(axes, self._films, strict=False)
        ]
        look: style.Look = {"ha": "center", "va": "top", "fontsize": style.TEXT}
        self._text = figure.text(0.5, 0.93, "", color=style.INK, **look)
        self._stage = Stage(figure, [*self._images, self._text])

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        for image, film in zip(self._images, self._films, strict=True):
            image.set_data(film[step])
        self._text.set_text(self._words.after(step))
        return self._stage.frame()


class GoalScene:
    """The way of the achieved goal in its first two coordinates, beside the environment's picture.

    A goal of one coordinate is shown over time.

    Args:
        title: What is shown.
        policy: The policy, asked for subgoals in every state if it imagines any.
        recording: The episode.
    """

    def __init__(self, title: str, policy: Policy, recording: Recording) -> None:
        self._path = _on_plane(recording.states)
        found = None if policy.spec.is_image else in_every_state(policy, recording)
        self._subgoals = None if found is None else _on_plane(found)
        self._pictures = recording.pictures
        self._kind = recording.kind
        self._words = Words(policy, recording, unit=0.0)
        columns = 2 if len(self._pictures) else 1
        figure, (axes, *beside) = style.figure(1, columns, height=4.6, width=4.2 * columns)
        style.label(axes, f"{title}\n", *_names(recording.target))
        axes.plot(*_on_plane(recording.target[None])[-1:].T, "*", markersize=16, color=maps.GOAL)
        shown = [self._path, _on_plane(recording.target[None])]
        low, high = np.concatenate(shown).min(0), np.concatenate(shown).max(0)
        rim = 0.15 * max(float((high - low).max()), 1e-6)
        axes.set(xlim=(low[0] - rim, high[0] + rim), ylim=(low[1] - rim, high[1] + rim))
        self._trail, self._agent, self._marks = (
            axes.plot([], [], **look)[0]
            for look in (
                {"color": style.BLUE, "linewidth": 2, "zorder": 4},
                {"color": style.BLUE, "marker": "o", "markersize": 9, "zorder": 7},
                {**_diamonds(), "zorder": 6},
            )
        )
        for panel in beside:
            panel.set_axis_off()
        self._images = [panel.imshow(self._pictures[0]) for panel in beside]
        style.legend_below(figure, self._legend())
        self._text = _text(axes)
        moving = [self._trail, self._agent, self._marks, *self._images, self._text]
        self._stage = Stage(figure, moving)

    def frame(self, step: int) -> Frame:
        """Return the picture after so many steps."""
        self._trail.set_data(*self._path[: step + 1].T)
        self._agent.set_data(*self._path[step : step + 1].T)
        if self._subgoals is not None:
            self._marks.set_data(*self._subgoals[step].T)
        for image in self._images:
            image.set_data(self._pictures[step])
        self._text.set_text(self._words.after(step))
        return self._stage.frame()

    def _legend(self) -> list[Line2D]:
        look: style.Look = {"color": style.BLUE, "marker": "o", "markersize": 9, "linewidth": 2}
        goal: style.Look = {"linestyle": "", "color": maps.GOAL, "marker": "*", "markersize": 14}
        entries = [
            Line2D([], [], label="achieved goal", **look),
            Line2D([], [], label="goal", **goal),
        ]
        if self._subgoals is not None:
            entries.append(Line2D([], [], label=f"{self._kind} subgoals", **_diamonds()))
        return entries


def _on_plane(goals: Float[np.ndarray, "*B G"]) -> Float[np.ndarray, "*B 2"]:
    """Return the first two coordinates of goals; of a single one, its place in time before it."""
    if goals.shape[-1] > 1:
        return goals[..., :2]
    time = np.arange(len(goals), dtype=float).reshape(-1, *[1] * (goals.ndim - 1))
    return np.concatenate([np.broadcast_to(time, goals.shape), goals], axis=-1)


def _names(goal: Float[np.ndarray, " G"]) -> tuple[str, str]:
    """Return what the axes of a plane of goals are."""
    return ("goal[0]", "goal[1]") if len(goal) > 1 else ("step", "goal[0]")


class Words:
    """What is said of every step: how far the goal is.

    Args:
        policy: The policy, whose task measures distances.
        recording: The episode.
        unit: 1 for metres, 0.01 for centimetres, 0 where the unit is not known.
    """

    def __init__(self, policy: Policy, recording: Recording, unit: float) -> None:
        task = policy.spec.task
        pair = recording.states, recording.target
        named = task.named_distances(*pair) if isinstance(task, DistanceTask) else {}
        self._distances = named or {"": task.distance(*pair)}
        self._end = recording.length if recording.success else -1
        self._unit = unit
        self._where = "to the goal"

    def along(self, view: MazeView, recording: Recording) -> None:
        """Measure along the corridors of a maze: a straight line says little there."""
        path, goal = recording.states[:, view.position], recording.target[view.position]
        self._distances = {"": way_left(view.maze, path, goal)}
        self._where = "of the way left"

    def after(self, step: int) -> str:
        """Return the words after so many steps."""
        if step == self._end:
            return f"step {step}, goal reached"
        unit, digits = {1.0: (" m", 1), 0.01: (" cm", 0), 0.0: ("", 3)}[self._unit]
        parts = (
            f"{name + ' ' if name else ''}{distances[step] / (self._unit or 1.0):.{digits}f}{unit}"
            for name, distances in self._distances.items()
        )
        return f"step {step}, {', '.join(parts)} {self._where}"


def decoding(folder: RunFolder, policy: Policy) -> Callable[[Recording], Images | None]:
    """Return what gives the subgoal in every state as an image; it returns None without any.

    It is the mean of those imagined, or the planned one that is due.
    """
    if decoder.encoder_of(policy) is None:
        return lambda recording: None
    if not plans(policy.agent) and policy.agent.subgoals is None:
        return lambda recording: None
    fitted = decoder.of_policy(folder, policy)

    def decode(recording: Recording) -> Images:
        if recording.plans is None:
            features = np.asarray(imagined(policy, recording).location.achieved_goal)
        else:
            features = _aims(recording.plans)
        return decoder.decoded(fitted, features)

    return decode


def _aims(plans: Plan) -> Float[np.ndarray, "T_1 F"]:
    """Return the subgoal that is due in every state, and at the end the last of these."""
    aims = np.asarray(plans.subgoals)[np.arange(len(plans.due)), plans.due]
    return np.concatenate([aims, aims[-1:]])


def _head(axes: Axes, title: str) -> None:
    """Write the title, with a line below it for words; no axes."""
    axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
    axes.set_title(f"{title}\n", fontsize=style.TEXT, color=style.INK)


def _text(axes: Axes) -> Text:
    """Return the words above a map."""
    middle: style.Look = {"ha": "center", "va": "bottom", "color": style.INK}
    return axes.text(0.5, 1.0, "", transform=axes.transAxes, **middle)


def _diamonds() -> style.Look:
    look = {"color": maps.SUBGOAL, "marker": "D", "linestyle": ""}
    return {**look, "markersize": 6, "markeredgecolor": "none", "alpha": 0.7}
