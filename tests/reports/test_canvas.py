"""Every figure has all of its words on its canvas."""

from pathlib import Path

import pytest
from canvas import cut_off

from drawing_here import needs_renderer
from midway.envs.mazes import MAZES
from midway.reports import compose, curves, maze, style
from midway.reports.cache import Cache
from midway.reports.runs import by_environment, read

LONG = "RIS, kl_weight 0.1, learning_rate 0.0001, hard"


def check(folders: list[Path], out: Path) -> int:
    """Draw every figure of these runs; return how many there are."""
    environments = by_environment([read(folder) for folder in folders])
    pictures = [*curves.overview(environments)]
    pictures += [p for runs in environments for p in compose.pictures(runs, Cache(out))]
    for picture in pictures:
        figure = picture.draw()
        figure.set_dpi(style.RESOLUTION)
        style.settle(figure)
        assert cut_off(figure) == [], picture.stem
    return len(pictures)


def test_mazes(ris_run, sac_run, leap_run, copy_run, tmp_path):
    other = copy_run(ris_run, "s")
    for name in ("config.json", "policy.json"):
        file = other / name
        file.write_text(file.read_text().replace("point-u", "point-s"))
    assert check([ris_run, sac_run, leap_run, other], tmp_path) == 1 + 10 + 6


def test_a_table(state_run, tmp_path):
    assert check([state_run], tmp_path) == 3


@needs_renderer
def test_images(image_run, tmp_path, quick_decoder):
    assert check([image_run], tmp_path) == 4


@pytest.mark.parametrize("name", ["u", "omega"])
@pytest.mark.parametrize("columns", [1, 2, 5])
def test_maps_with_long_names(name, columns):
    figure, axes = maze.panels(MAZES[name], columns)
    for panel in axes:
        style.caption(panel, LONG, "8 of 8 reach the goal")
    style.legend_below(figure, maze._legend("imagined"))
    style.settle(figure)
    assert cut_off(figure) == []


def test_words_that_are_cut_off_are_found():
    figure, (axes,) = style.figure(1, 1, height=2, width=2)
    style.label(axes, "a title that is much too long for its panel", "x", "y")
    style.settle(figure)
    assert cut_off(figure) == ["a title that is much too long for its panel"]
