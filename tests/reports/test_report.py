"""Every figure and the page, from tiny runs."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from midway.envs.mazes import MAZES
from midway.envs.registry import entry
from midway.envs.views import MazeView
from midway.reports import cache, compose, difficulty, failures, images, maze, report
from midway.reports.cache import Episode, Study, is_flipped
from midway.reports.curves import success_curve
from midway.reports.difficulty import bins
from midway.reports.health import PANELS, with_speed
from midway.reports.imagined import density, halvings
from midway.reports.recordings import Recording
from midway.reports.runs import by_environment, groups
from midway.runs.folder import write_json
from midway.types import DistanceTask

FIGURES = {"learning-curves", "ris-map", "difficulty", "ris-subgoals", "ris-values", "health"}
FIGURES |= {"ris-failures"}


class Page(HTMLParser):
    """Collects what the tests ask of a page."""

    def __init__(self, path):
        super().__init__()
        self.images, self.links, self.words = [], [], []
        self.text = path.read_text()
        self.feed(self.text)
        self.close()

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if tag == "img":
            self.images.append(values)
        self.links += [v for k, v in attributes if k in ("src", "href")]

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def single(ris_run, tmp_path_factory):
    out = tmp_path_factory.mktemp("single")
    return report([ris_run], out)


def test_one_run_gives_every_figure(single):
    page, *figures = single
    assert page.name == "report.html"
    assert {f.stem.removeprefix("point-u-") for f in figures} == FIGURES
    assert {f.suffix for f in figures} == {".png", ".svg"}
    for file in figures:
        if file.suffix == ".png":
            pixels = matplotlib.image.imread(file)[..., :3]
            assert pixels.shape[1] > 500
            assert pixels.std() > 0.05
        else:
            assert "</svg>" in file.read_text()[-200:]


def test_every_figure_says_what_to_conclude(single):
    page = Page(single[0])
    assert " ".join(page.words).count("What it says:") == len(page.images)


def test_failures_are_shown_and_told_apart():
    place, far = np.array([1.0, 1.0]), np.linspace((1.0, 1.0), (6.0, 6.0), 20)
    maze, goal = MAZES["u"], np.array([1.4, 1.4])
    common = {"task": "hard", "goal": goal, "success": False, "geodesic": 1.0}
    episodes = [
        Episode(path=np.stack([place] * 20), **common),
        Episode(path=far, **common | {"task": "uniform"}),
        Episode(path=far, flipped=True, **common),
    ]
    said = failures.conclusion(maze, episodes)
    assert said.startswith("Of 3 failures, 1 lay on their backs; 1 ended less than 1 m before")
    assert [episode.task for episode in failures.chosen(episodes)] == ["hard", "uniform", "hard"]
    assert len(failures.draw(maze, episodes).axes) == 3


def test_failures_elsewhere_than_in_mazes_are_told_apart_by_their_distances():
    task = DistanceTask(((0,), (1,)), 0.1, ("hand", "puck"))
    goal, still = np.zeros(2, np.float32), np.ones((11, 2), np.float32)
    whole = np.linspace(1, 0, 11, dtype=np.float32)[:, None] * still
    ways = {
        "were ended by the environment": whole[:5],
        "ended with less than 25": 0.15 + 0.85 * whole,
        "ended no nearer": 1 + still - whole,
        "stood still": np.concatenate([still[:1], 0.5 * still[1:]]),
        "were still on their way": 0.5 + 0.5 * whole,
    }
    episodes = [Recording("hard", way, goal, way, goal, False, 1.0) for way in ways.values()]
    said = failures.conclusion_of_distances(task, episodes, limit=10)
    for words in ways:
        assert f"1 {words}" in said
    episodes.append(Recording("hard", whole, goal, whole, goal, True, 0.0))
    figure = failures.draw_distances(task, episodes, " (m)")
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["hand", "puck"]
    for axes in figure.axes:
        assert sum(line.get_marker() == "X" for line in axes.lines) == 5


def test_the_page_stands_alone(single):
    page = Page(single[0])
    assert len(page.images) == len(FIGURES)
    for image in page.images:
        assert image["src"].startswith("data:image/png;base64,")
        assert len(image["alt"]) > 30
    assert all(link.startswith(("data:", "#")) for link in page.links)
    assert not re.search(r"https?:|@import|url\(|<script", page.text)
    assert '<html lang="en">' in page.text


def test_the_page_says_how_the_run_was_made_and_what_is_missing(single, ris_run):
    words = "".join(Page(single[0]).words)
    for expected in (str(ris_run), "batch_size", "jax 0.", "one seed"):
        assert expected in words
    assert "unfinished" not in words


def test_default_places(ris_run, copy_run, monkeypatch):
    asked = []
    monkeypatch.setattr(compose, "_write", lambda runs, out: asked.append(out) or [])
    run = copy_run(ris_run, "run")
    report(str(run))
    report([run, copy_run(ris_run, "other", seed=1)])
    assert asked == [run / "figures", run.parent / "report"]


def test_several_agents_and_seeds_and_a_run_in_progress(ris_run, sac_run, copy_run, tmp_path):
    runs = [ris_run, copy_run(ris_run, "b", seed=1, until=800), copy_run(sac_run, "c")]
    (runs[1] / "policy.safetensors").unlink()
    page, *figures = report([*runs, runs[0]], tmp_path / "out")
    names = {figure.stem.removeprefix("point-u-") for figure in figures}
    assert names == FIGURES - {"ris-values"} | {
        "sac-map",
        "sac-failures",
        "ris-sac-values",
        "comparison",
    }
    words = "".join(Page(page).words)
    assert "RIS, seed 1: unfinished, 800 of 1,200 steps" in words
    assert "RIS, seed 1: no policy saved yet" in words
    assert "SAC: one seed" in words
    assert "RIS: one seed" not in words


def test_a_run_that_has_just_begun(ris_run, copy_run, tmp_path):
    run = copy_run(ris_run, "young", until=0)
    for name in ("policy.safetensors", "metrics.csv", "evaluation.csv"):
        (run / name).unlink()
    files = report([run], tmp_path / "out")
    assert [file.name for file in files] == ["report.html"]
    words = "".join(Page(files[0]).words)
    for expected in ("0 of 1,200", "no learning curves", "no training health", "no policy saved"):
        assert expected in words


def test_a_damaged_policy_is_reported_and_the_rest_is_drawn(ris_run, copy_run, tmp_path):
    run = copy_run(ris_run, "damaged")
    (run / "policy.safetensors").write_bytes(b"no weights")
    page, *figures = report([run], tmp_path / "out")
    assert {f.stem.removeprefix("point-u-") for f in figures} == {"learning-curves", "health"}
    assert "the policy cannot be used" in page.read_text()


def test_several_environments_have_an_overview(ris_run, copy_run, tmp_path):
    other = copy_run(ris_run, "s")
    for name in ("config.json", "policy.json"):
        file = other / name
        write_json(file, json.loads(file.read_text().replace("point-u", "point-s")))
    files = report([ris_run, other], tmp_path / "out")
    assert "all-learning-curves.png" in {file.name for file in files}
    assert len(Page(files[0]).images) == 1 + 2 * len(FIGURES)


def test_a_second_report_computes_nothing_again(single, ris_run, tmp_path, monkeypatch):
    out = shutil.copytree(single[0].parent, tmp_path / "out")
    monkeypatch.setattr(cache.policies, "load", None)
    report([ris_run], out)


def test_past_policies_are_snapshots_of_the_heat_map(ris_run, tmp_path):
    """The run keeps eight snapshots; the policy is the last of them."""
    run = compose.read(ris_run)
    assert list(run.past_weights) == [152, 304, 456, 600, 752, 904, 1056]
    looked = Study(run, tmp_path)
    assert looked.subgoals()["step"].tolist() == [152, 600, 1056, 1200]
    assert len(looked.chain()["x"]) == 7


def test_without_past_policies_the_page_says_so(ris_run, copy_run, tmp_path):
    run = copy_run(ris_run, "run")
    shutil.rmtree(run / "policies")
    page, *figures = report([run], tmp_path / "out")
    assert len(figures) == 2 * len(FIGURES)
    assert "no past policies were kept" in page.read_text()


def test_the_maze_is_drawn_as_it_is():
    omega = MAZES["omega"]
    _, (axes,) = maze.panels(omega, 1)
    drawn = {(*patch.get_xy(), patch.get_width(), patch.get_height()) for patch in axes.patches}
    assert drawn == {(*wall.low, 2 * wall.half_x, 2 * wall.half_y) for wall in omega.walls}
    assert axes.get_aspect() == 1


def test_values_cover_the_arena(ris_run, tmp_path):
    table = Study(compose.read(ris_run), tmp_path).values()
    assert (table["x"].min(), table["x"].max()) == (-3.75, 3.75)
    assert (table["y"].min(), table["y"].max()) == (-9, 9)
    assert np.isfinite(table["value"]).all()


def test_difficulty_bins_hold_as_many_episodes_in_order_of_distance():
    lengths = [5.0, 1.0, 9.0, 2.0, 7.0, 7.0, 3.0, 8.0, 4.0, 6.0, 10.0, 11.0]
    episodes = [Episode("uniform", np.zeros((1, 2)), np.zeros(2), True, d) for d in lengths]
    assert bins(episodes).tolist() == [2, 0, 4, 0, 3, 3, 1, 4, 1, 2, 5, 5]


def test_sampled_actions_have_a_row_of_their_own(ris_run, single):
    (runs,) = by_environment([compose.read(ris_run)])
    cached = cache.Cache(single[0].parent / "data")
    (picture,) = difficulty.figures(runs, cached, ("mean", "sampled"))
    labels = [axes.get_ylabel() for axes in picture.draw().axes]
    assert labels == ["success, deterministic", "success, with sampled actions"]
    (study,) = cached.studies(runs.groups[0])
    mean, sampled = study.episodes(), study.episodes("sampled")
    assert [(e.task, e.geodesic, *e.goal) for e in mean] == [
        (e.task, e.geodesic, *e.goal) for e in sampled
    ]
    assert any(
        len(a.path) != len(b.path) or (a.path != b.path).any()
        for a, b in zip(mean, sampled, strict=True)
    )


def test_density_of_a_laplace_subgoal():
    row = {"x": 1.0, "y": 0.0, "scale_x": 1.0, "scale_y": 2.0}
    heat = density(row, np.array([1.0, 2.0]), np.array([0.0, 2.0]))
    np.testing.assert_allclose(heat, np.exp([[0, -1], [-1, -2]]))


def test_the_middle_of_a_chain_was_imagined_first():
    assert [halvings(place) for place in range(1, 8)] == [0, 1, 0, 2, 0, 1, 0]


def test_updates_per_second():
    table = {"updates": np.array([10.0, 30.0, 60.0]), "training_seconds": np.array([5.0, 9.0, 9.0])}
    assert with_speed(table)["updates/s"][1] == 5
    assert np.isnan(with_speed(table)["updates/s"][[0, 2]]).all()


def test_over_time_a_seed_that_is_done_keeps_its_last_success(ris_run, copy_run):
    runs = [compose.read(ris_run), compose.read(copy_run(ris_run, "b", seed=1))]
    for number, run in enumerate(runs, start=1):
        _, place = np.unique(run.evaluation["step"], return_inverse=True)
        run.evaluation["success_rate"][:] = number / 4
        run.evaluation["training_seconds"] = (place + 1.0) * 60 * number
    (group,) = groups(runs)
    drawn = success_curve(group, "hard", "mean", "minutes")
    assert drawn is not None
    assert (drawn.x[0], drawn.x[-1]) == (2, 8)
    assert set(drawn.runs) == {2}
    np.testing.assert_allclose(drawn.centre, 3 / 8)


def test_an_ant_on_its_back_is_noticed():
    state = np.zeros((2, 31), np.float32)
    state[:, [5, 7]] = 1
    upright = Recording("hard", state, state[0], state, state[0], False, 1.0)
    state = state.copy()
    state[-1, 7] = -1
    fallen = Recording("hard", state, state[0], state, state[0], False, 1.0)
    view = entry("ant-u").view
    assert isinstance(view, MazeView)
    assert [is_flipped(view, recording) for recording in (upright, fallen)] == [False, True]


def test_every_panel_says_what_is_healthy():
    for panel in PANELS:
        assert 20 < len(panel.healthy) < 110


def test_reports_leave_the_run_as_it_is(ris_run, single):
    assert not (Path(ris_run) / "figures").exists()


def test_what_the_autoencoder_keeps_is_drawn(leap_run, tmp_path):
    looked = Study(compose.read(leap_run), tmp_path)
    states, kept = images.reconstructions(looked.policy)
    assert states.shape == kept.shape == (images.STATES, 4)
    error = np.linalg.norm((states - kept)[:, :2], axis=1).mean()
    title = images.draw_reconstructions(looked, "LEAP").axes[0].get_title()
    assert f"mean error {error:.2f} m" in title.replace("\n", " ")
