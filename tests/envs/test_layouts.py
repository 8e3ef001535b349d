"""Mazes of one's own: read, refused with the cell named, built, stored and trained in."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import midway
import tiny
from midway import reports
from midway.envs import layouts
from midway.envs.geodesic import geodesic_distance
from midway.envs.layouts import Layout
from midway.envs.registry import own_maze
from midway.errors import ConfigurationError

TINY = tiny.TINY | {"num_envs": 2, "random_steps": 20, "checkpoint_every": 60}


@pytest.mark.parametrize("name", layouts.names())
@pytest.mark.parametrize("robot", ["point", "ant"])
def test_those_of_gymnasium_robotics_are_environments(name: str, robot: str) -> None:
    declared = midway.maze_env(robot, name)
    assert declared.name == f"{robot}-{name}"
    env = midway.make_vec(declared, num_envs=3, task="hard")
    observation, _ = env.reset(seed=0)
    maze = declared.view.maze
    assert maze.free(observation["observation"][:, :2]).all()
    assert maze.free(observation["desired_goal"][:, :2]).all()
    layout = layouts.read(name)
    assert Layout.from_json(json.loads(json.dumps(layout.to_json()))) == layout
    way = geodesic_distance(
        maze, observation["observation"][:, :2], observation["desired_goal"][0, :2]
    )
    # Corners are cut: the way is shorter than from cell to cell, and much longer than straight.
    assert (way < layout.length + 1).all()
    assert (way > 0.6 * layout.length).all()


def test_a_map_becomes_walls_by_hand() -> None:
    maze = Layout("l", ("S#.", ".#.", "..G"), 2.0).maze()
    assert (maze.arena.half_x, maze.arena.half_y) == (3, 3)
    [wall] = maze.inner_walls
    assert (wall.x, wall.y, wall.half_x, wall.half_y) == (0, 1, 1, 2)
    assert (maze.cases["hard"].start.x, maze.cases["hard"].start.y) == (-2, 2)
    assert (maze.cases["hard"].goal.x, maze.cases["hard"].goal.y) == (2, -2)
    goals = [maze.cases[f"case-{n}"].goal for n in range(10, 14)]
    assert [(goal.x, goal.y) for goal in goals] == [(-2, 0), (-2, -2), (0, -2), (2, -2)]


@given(st.lists(st.text("#.", min_size=4, max_size=4), min_size=1, max_size=5))
def test_walls_cover_what_is_drawn_and_nothing_else(rows: list[str]) -> None:
    """Whatever the map: the middle of each cell is in a wall where it is drawn as one."""
    layout = object.__new__(Layout)  # also maps whose cells are not all reached
    for name, value in {"name": "x", "rows": tuple(rows), "cell": 2.0}.items():
        object.__setattr__(layout, name, value)
    walls = layout._walls()
    for row, letters in enumerate(rows):
        for column, letter in enumerate(letters):
            middle = np.array([(column + 0.5 - 2) * 2, (len(rows) / 2 - row - 0.5) * 2])
            assert any(wall.contains(middle) for wall in walls) == (letter == "#")
    area = sum(4 * wall.half_x * wall.half_y for wall in walls)
    assert area == pytest.approx(4 * sum(letters.count("#") for letters in rows))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("S.x\n..G", r"maze here, row 1, column 3: 'x' is none of # \. S G"),
        ("S.\n..G", "row 2: 3 cells, but the first row has 2"),
        ("...\n..G", "must have one S, the start of the hard task, not 0"),
        ("S.S\n..G", "row 1, column 3: must have one S, the start of the hard task, not 2"),
        ("S#G", "row 1, column 3: cannot be reached from S"),
        ("S.G\n###\n..#", "row 3, column 1: cannot be reached from S"),
        ("", "must have 1 to 100 rows and columns"),
    ],
)
def test_a_wrong_map_is_refused_with_its_cell(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "here.txt").write_text(text)
    with pytest.raises(ConfigurationError, match=reason):
        layouts.read(tmp_path / "here.txt")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("cell: 3", "must have map"),
        ("map: S.G\nwalls: 3", "must have map, and may have cell"),
        ("map: S.G\ncell: wide", "cell a number of metres"),
        ("map: S.G\ncell: 1", r"cell 1.0: must be from 2.0 to 100.0 m"),
        ("map: [", "maze .*here.yaml: "),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "here.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=reason):
        layouts.read(tmp_path / "here.yaml")


def test_names_that_mean_something_else_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"cannot be read .* or one of medium, umaze"):
        layouts.read(tmp_path / "nowhere.txt")
    (tmp_path / "u.txt").write_text("S.G")
    with pytest.raises(ConfigurationError, match="one of midway's own is called that"):
        layouts.read(tmp_path / "u.txt")
    with pytest.raises(ConfigurationError, match="--maze goes with point or ant, not with push"):
        own_maze("push", layouts.read("umaze"))


def test_a_run_in_a_maze_of_ones_own_needs_its_file_no_more(tmp_path: Path) -> None:
    file = tmp_path / "rooms.txt"
    file.write_text("S.#.\n....\n.#G.\n")
    run = midway.train(midway.maze_env("point", file), steps=60, out=tmp_path / "run", changes=TINY)
    file.unlink()
    assert midway.resume(run.path, steps=120).finished
    result = midway.evaluate(run.path, episodes=2)
    assert (result.task, len(result.episodes)) == ("hard", 2)
    assert midway.load(run.path).config.env == "point-rooms"
    assert any("ris-map" in path.name for path in reports.report([run.path]))
    assert reports.watch(run.path).stat().st_size > 1000
