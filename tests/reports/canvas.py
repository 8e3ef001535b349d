"""Which words of a figure are cut off by its canvas."""

from collections.abc import Iterator

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import BboxBase

SLACK = 1.0
"""Pixels that a letter's edge may stand over."""


def cut_off(figure: Figure) -> list[str]:
    """Return the words of a drawn figure that leave its canvas."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return [
        words
        for words, box in _boxes(figure, canvas)
        if box.x0 < -SLACK
        or box.y0 < -SLACK
        or box.x1 > figure.bbox.x1 + SLACK
        or box.y1 > figure.bbox.y1 + SLACK
    ]


def _boxes(figure: Figure, canvas: FigureCanvasAgg) -> Iterator[tuple[str, BboxBase]]:
    renderer = canvas.get_renderer()
    for text in (*figure.texts, getattr(figure, "_suptitle", None)):
        if text is not None and text.get_text().strip():
            yield text.get_text(), text.get_window_extent(renderer)
    for legend in figure.legends:
        for text in (*legend.get_texts(), legend.get_title()):
            if text.get_text().strip():
                yield text.get_text(), text.get_window_extent(renderer)
    for axes in figure.axes:
        if axes.get_visible():
            yield from _boxes_of_axes(axes, canvas)


def _boxes_of_axes(axes: Axes, canvas: FigureCanvasAgg) -> Iterator[tuple[str, BboxBase]]:
    renderer = canvas.get_renderer()
    titles = (axes.get_title(place) for place in ("left", "center", "right"))
    yield from (
        (title.get_text(), title.get_window_extent(renderer))
        for title in (axes.title, axes._left_title, axes._right_title, *axes.texts)
        if title.get_visible() and title.get_text().strip()
    )
    for axis in (axes.xaxis, axes.yaxis):
        box = axis.get_tightbbox(renderer) if axes.axison else None
        if box is not None:
            yield f"axis {axis.label.get_text()!r} of {' '.join(titles)!r}", box
