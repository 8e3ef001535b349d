"""Every figure has all of its words on its canvas."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from canvas import cut_off

from drawing_here import needs_renderer
from midway.envs.mazes import MAZES
from midway.reports import comparison, compose, curves, maze, style
from midway.reports.cache import Cache
from midway.reports.runs import by_environment, read
from midway.runs.folder import write_json

LONG = "RIS, kl_weight 0.1, learning_rate 0.0001, hard"


def check(folders: list[Path], out: Path) -> int:
    """Draw every figure of these runs; return how many there are."""
    environments = by_environment([read(folder) for folder in folders])
    pictures = [*curves.overview(environments), *comparison.overview(environments)]
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
        write_json(file, json.loads(file.read_text().replace("point-u", "point-s")))
    assert check([ris_run, sac_run, leap_run, other], tmp_path) == 23


def test_a_table(state_run, tmp_path):
    assert check([state_run], tmp_path) == 4


@needs_renderer
def test_images(image_run, tmp_path, quick_decoder):
    assert check([image_run], tmp_path) == 5


@pytest.mark.parametrize("name", ["u", "omega"])
@pytest.mark.parametrize("columns", [1, 2, 5])
def test_maps_with_long_names(name, columns):
    figure, axes = maze.panels(MAZES[name], columns)
    for panel in axes:
        style.caption(panel, LONG, "8 of 8 reach the goal")
    style.legend_below(figure, maze._legend("imagined"))
    style.settle(figure)
    assert cut_off(figure) == []


def test_comparisons_with_long_names(ris_run, sac_run):
    (runs,) = by_environment([read(folder) for folder in (ris_run, sac_run)])
    named = [replace(group, label=f"{LONG} {group.slug}") for group in runs.groups]
    found = {"hard": comparison.sides([replace(runs, groups=named)], "hard")}
    figure = comparison.draw(found)
    style.settle(figure)
    assert cut_off(figure) == []


def test_words_that_are_cut_off_are_found():
    figure, (axes,) = style.figure(1, 1, height=3.0, width=4.0)
    style.label(axes, "title", "x", "y")
    figure.text(0.9, 0.5, "words at the edge")
    style.settle(figure)
    assert cut_off(figure) == ["words at the edge"]
    axes.set_title("far above", y=2.0)
    assert cut_off(figure) == ["words at the edge", "far above"]
