"""Videos that a reader can open."""

import imageio.v3 as imageio
import numpy as np
import pytest

from midway import api
from midway.envs.geodesic import way_left
from midway.errors import ConfigurationError
from midway.reports import videos, watch
from midway.reports.recordings import Recording, chain, draws, record
from midway.reports.scenes import Words


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio's reader
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_can_be_read(ris_run, tmp_path, suffix, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")  # which it forks for
    file = tmp_path / "videos" / f"hard{suffix}"
    assert watch(ris_run, file, task="hard", episodes=1, seed=0) == file
    frames = list(imageio.imiter(file))
    assert 80 < len(frames) < 200
    assert all(frame.shape == frames[0].shape for frame in frames)
    assert np.asarray(frames[0], float).std() > 10
    assert [f.name for f in file.parent.iterdir()] == [file.name]


def test_the_default_place_is_in_the_run_folder(sac_run, copy_run):
    run = copy_run(sac_run, "run")
    assert watch(run, None, "uniform", 2, 3) == run / "videos" / "uniform.mp4"
    assert (run / "videos" / "uniform.mp4").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "task", "episodes", "words"),
    [
        ("a.avi", "hard", 1, "a.avi"),
        ("a.mp4", "easy", 1, "unknown task 'easy'"),
        ("a.mp4", "hard", 0, "episodes 0"),
    ],
)
def test_bad_requests_are_one_line(ris_run, tmp_path, name, task, episodes, words):
    with pytest.raises(ConfigurationError, match=words) as error:
        watch(ris_run, tmp_path / name, task, episodes, 0)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_what_ffmpeg_says_is_told(tmp_path):
    frames = iter([np.zeros((0, 0, 3), np.uint8)])
    with pytest.raises(ConfigurationError, match=r"a\.mp4: .*[Ii]nvalid") as error:
        videos.write(tmp_path / "a.mp4", frames, 10)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_one_line(ris_run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="cannot write the video"):
        watch(ris_run, tmp_path / "file" / "a.mp4", "hard", 1, 0)


def test_words_say_the_way_left_in_a_maze(ris_run):
    policy = api.load(ris_run)
    view = policy.config.declaration().view
    case = view.maze.cases["hard"]
    states = np.zeros((2, 4), np.float32)
    states[0, :2], states[1, :2] = (case.start.x, case.start.y), (case.goal.x, case.goal.y)
    episode = Recording("hard", states, states[1], states, states[1], False, 0.0)
    words = Words(policy, episode, 1.0)
    words.along(view, episode)
    left = way_left(view.maze, states[:1, :2], states[1, :2])[0]
    assert words.after(0) == f"step 0, {left:.1f} m of the way left"
    assert words.after(1) == "step 1, 0.0 m of the way left"


def test_recordings_are_whole_episodes(ris_run):
    policy = api.load(ris_run)
    recordings = record(policy, {"hard": 2, "uniform": 3}, seed=5)
    assert [recording.task for recording in recordings] == ["hard"] * 2 + ["uniform"] * 3
    for recording in recordings:
        assert len(recording.states) == recording.length + 1
        distance = np.linalg.norm(recording.states[-1, :2] - recording.goal[:2])
        assert distance == pytest.approx(recording.final_distance, abs=1e-5)
        assert recording.success == (distance < 0.5)
        assert recording.success or recording.length == 150
    again = record(policy, {"hard": 2, "uniform": 3}, seed=5)
    np.testing.assert_array_equal(again[4].states, recordings[4].states)


def test_imagined_subgoals_follow_their_distribution(ris_run):
    policy = api.load(ris_run)
    pair = np.zeros((1, 4), np.float32), np.ones((1, 4), np.float32)
    found = policy.subgoals(*pair)
    location, scale = (part.achieved_goal for part in found)
    drawn = draws(found, count=20_000)[0]
    np.testing.assert_allclose(np.median(drawn, 0), location[0], atol=0.05 * scale.max())
    np.testing.assert_allclose(np.abs(drawn - location).mean(0), scale[0], rtol=0.05)


def test_a_chain_halves_the_way_again_and_again(ris_run):
    policy = api.load(ris_run)
    start, goal = np.zeros(4, np.float32), np.ones(4, np.float32)
    way = chain(policy, start, goal, 2)
    assert way.shape == (3, 4)
    middle = policy.subgoals(start[None], goal[None]).location.achieved_goal[0]
    last = policy.subgoals(middle[None], goal[None]).location.achieved_goal[0]
    np.testing.assert_allclose(way[1], middle, rtol=1e-5)
    np.testing.assert_allclose(way[2], last, rtol=1e-5)
