"""Reports and videos of the arm and its puck, from states and from images."""

import matplotlib.image
import numpy as np
import pytest

from drawing_here import needs_renderer
from midway import api
from midway.cli.main import main
from midway.envs.registry import Declaration, make_vec
from midway.errors import ConfigurationError
from midway.reports import decoder, images, report, tabletop, watch
from midway.reports.recordings import Recording
from midway.reports.scenes import TableScene, Words
from midway.runs.folder import RunFolder


def stems(files):
    return {file.stem for file in files if file.suffix == ".png"}


def test_the_report_of_states_draws_the_table(state_run, tmp_path):
    page, *figures = report([state_run], tmp_path)
    names = {"learning-curves", "distances", "ris-table", "ris-failures"}
    assert stems(figures) == {f"push-state-{name}" for name in names}
    assert "no maze" not in page.read_text()


@needs_renderer
def test_the_report_of_images_shows_what_is_imagined(image_run, tmp_path, quick_decoder):
    _, *figures = report([image_run], tmp_path)
    names = {"learning-curves", "distances", "ris-table", "ris-failures", "ris-images"}
    assert stems(figures) == {f"push-{name}" for name in names}
    pixels = matplotlib.image.imread(tmp_path / "push-ris-images.png")
    assert pixels.shape[1] > 1_000
    assert (image_run / "decoder.safetensors").exists()


@needs_renderer
def test_rows_of_images_are_those_of_the_environment(image_run, quick_decoder):
    loaded = api.load(image_run)
    decode = decoder.of_policy(RunFolder(image_run), loaded)
    rows = images.rows(loaded, decode, "hard", 2, seed=3)
    observation, _ = make_vec("push", num_envs=2, task="hard").reset(seed=3)
    np.testing.assert_array_equal(rows["state,\nand decoded"][0], observation["observation"])
    np.testing.assert_array_equal(rows["goal,\nand decoded"][0], observation["desired_goal"])
    assert len(rows) == 2 + 1 + images.DRAWN
    for left, right, notes in rows.values():
        assert left.shape == right.shape == (2, 84, 84, 3)
        assert left.dtype == right.dtype == np.uint8
        assert len(notes) == 2


@needs_renderer
def test_the_nearest_image_of_an_image_is_itself(image_run, quick_decoder):
    loaded = api.load(image_run)
    real = decoder.real_images(loaded)[[3, 35]]
    found, notes = images.Album(loaded).nearest(decoder.features(loaded, real))
    np.testing.assert_array_equal(found, real)
    assert notes == ["0.0", "0.0"]


@needs_renderer
def test_without_a_drawing_library_images_are_missing_and_the_rest_is_drawn(
    image_run, tmp_path, monkeypatch
):
    def fail(*arguments, **options):
        raise ConfigurationError("images need OpenGL")

    monkeypatch.setattr(Declaration, "factory", fail)
    page, *figures = report([image_run], tmp_path)
    assert stems(figures) == {"push-learning-curves", "push-distances"}
    assert "images need OpenGL" in page.read_text()


def test_a_video_of_the_table(state_run, tmp_path):
    file = tmp_path / "hard.mp4"
    assert watch(state_run, file, "hard", 1, 0) == file
    assert file.stat().st_size > 5_000


@needs_renderer
def test_a_video_of_images(image_run, tmp_path, quick_decoder):
    file = tmp_path / "uniform.gif"
    watch(image_run, file, "uniform", 1, 0)
    assert file.stat().st_size > 20_000


def episode(success):
    states = np.array([[0.1, 0.6, 0.0, 0.6], [0.0, 0.55, 0.0, 0.6]], np.float32)
    goal = np.array([0.0, 0.55, 0.1, 0.6], np.float32)
    return Recording("hard", states, goal, states, goal, success, 0.1)


def test_words_tell_hand_and_puck_apart(state_run):
    loaded = api.load(state_run)
    words = Words(loaded, episode(False), 0.01)
    assert words.after(0) == "step 0, hand 11 cm, puck 10 cm to the goal"
    assert words.after(1) == "step 1, hand 0 cm, puck 10 cm to the goal"
    assert Words(loaded, episode(True), 0.01).after(1) == "step 1, goal reached"


def test_the_puck_of_a_frame_is_where_it_is_seen_by_the_camera(state_run):
    """World x points left and y down: the hand at x 0.1 begins on the left of the puck."""
    scene = TableScene("", api.load(state_run), episode(False))
    first, second = scene.frame(0).astype(int), scene.frame(1).astype(int)
    assert first.shape[0] % 2 == first.shape[1] % 2 == 0
    changed = np.argwhere(np.abs(first - second).sum(-1) > 100)
    assert len(changed) > 50
    assert scene.frame(0).tobytes() == first.astype(np.uint8).tobytes()


def test_the_table_is_turned_like_the_camera():
    _, (axes,) = tabletop.panels(1, 1)
    assert axes.get_xlim()[0] > axes.get_xlim()[1]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]
    assert axes.get_aspect() == 1


def test_live_without_a_display_is_one_line(state_run, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(SystemExit) as stop:
        main(["watch", str(state_run), "--live"])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("midway: a window needs a display")
    assert error.count("\n") == 1


def test_live_writes_no_file(state_run, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["watch", str(state_run), "--live", "--out", str(tmp_path / "a.mp4")])
    assert stop.value.code == 2
    assert "--live writes no file" in capsys.readouterr().err
