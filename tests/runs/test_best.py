"""The best policy of a run: kept by the lower end of its interval, confirmed, and found again."""

import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

import midway
import tiny
from midway import api, tables
from midway.cli.main import main
from midway.errors import ConfigurationError
from midway.reports import curves
from midway.reports.runs import by_environment, read
from midway.runs import kept
from midway.runs.folder import RunFolder
from midway.training import loop, seeds
from midway.training.evaluate import Episode, Evaluation
from midway.training.state import Training

pytestmark = pytest.mark.usefixtures("short_episodes")

TINY = tiny.TINY | {
    "evaluate_every": 20,
    "evaluation_episodes": 10,
    "log_every": 60,
    "checkpoint_every": 60,
    "steps": 120,
}
EPISODES = 10


def lucky(env: object, policy: object, task: str, actions: str, seed: int, check: object) -> object:
    """Return episodes that succeed or not by the seed alone."""
    reached = int(np.random.default_rng(seed).integers(EPISODES + 1))
    episodes = [Episode(number < reached, 1, 0.0) for number in range(EPISODES)]
    return Evaluation(task, actions, tuple(episodes))  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def luck(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "run_episodes", lucky)


def train(out: Path) -> api.Run:
    return midway.train("point-u", agent="sac", seed=5, out=out, changes=TINY)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, short_episodes: None) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "run_episodes", lucky)
        return train(tmp_path_factory.mktemp("whole") / "run").path


def expected() -> list[tuple[int, float]]:
    """Return the steps of the best policies, one after the other, with their confirmed success."""
    streams = seeds.training(5)
    found, bar = [], 0.0
    for step in range(0, 121, 20):
        evaluated, confirmed = (
            lucky(None, None, "hard", "mean", streams.episodes(step, use), None) for use in (0, 1)
        )
        assert isinstance(evaluated, Evaluation)
        assert isinstance(confirmed, Evaluation)
        if min(evaluated.success.low, confirmed.success.low) > bar:
            found.append((step, confirmed.success_rate))
            bar = confirmed.success.low
    return found


def test_the_best_policy_won_its_evaluation_and_then_its_own_episodes(whole: Path) -> None:
    best = kept.best(RunFolder(whole))
    assert best is not None
    won = expected()
    assert len(won) > 1
    assert (best.step, best.success.centre) == won[-1]
    assert best.step < 120
    assert best.task == "hard"


def test_each_evaluation_has_episodes_of_its_own(whole: Path) -> None:
    """They are a function of seed and step; tasks and kinds of action share them."""
    table, streams = read(whole).evaluation, seeds.training(5)
    assert np.unique(table["step"]).tolist() == list(range(0, 121, 20))
    for row, step in enumerate(table["step"].astype(int).tolist()):
        result = lucky(None, None, "", "mean", streams.episodes(step), None)
        assert isinstance(result, Evaluation)
        assert table["success_rate"][row] == result.success_rate
    used = {streams.episodes(step, use) for step in range(100) for use in (0, 1)}
    assert len(used) == 200


def test_a_star_is_where_the_best_policy_was_confirmed(whole: Path) -> None:
    best = kept.best(RunFolder(whole))
    assert best is not None
    (runs,) = by_environment([read(whole)])
    stars = [
        (panel, line)
        for panel, axes in enumerate(curves.draw(runs).axes)
        for line in axes.lines
        if line.get_marker() == curves.STAR
    ]
    assert [panel for panel, _ in stars] == [0, 2]  # hard, over steps and over time
    assert stars[0][1].get_xdata() == [best.step]
    assert all(line.get_ydata() == [best.success.centre] for _, line in stars)


def test_each_policy_is_loaded_by_its_name(whole: Path) -> None:
    best = kept.best(RunFolder(whole))
    assert best is not None
    steps = {which: midway.load(whole, which).step for which in ("last", "best", 60)}
    assert steps == {"last": 120, "best": best.step, 60: 60}
    assert read(whole, "best").policy_step == best.step
    assert midway.load(whole, best.step).step == best.step
    with pytest.raises(ConfigurationError, match=r"no policy of step 7 was kept: there are .*120$"):
        midway.load(whole, 7)


def test_the_command_line_evaluates_the_best(
    whole: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(api, "load", lambda path, which, _: asked.append(which) or Path())
    for words in (["best"], ["last"], ["6e1"]):
        with pytest.raises(AttributeError):
            main(["evaluate", str(whole), "--policy", *words])
    assert asked == ["best", "last", 60]
    with pytest.raises(SystemExit):
        main(["evaluate", str(whole), "--policy", "worst"])
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("stop", [0, 100])
def test_the_best_is_the_same_after_an_interruption(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    """Also where the process ends between the evaluation and the episodes that confirm it."""
    original, calls = loop._keep_the_best, []

    def interrupted(training: Training, *others: object) -> None:
        if training.counters.steps == stop and not calls:
            calls.append(stop)
            signal.raise_signal(signal.SIGINT)
            raise loop.Interrupted
        original(training, *others)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "_keep_the_best", interrupted)
    assert not train(tmp_path / "run").finished
    assert midway.resume(tmp_path / "run").finished
    for name in ("policies/best.safetensors", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (whole / name).read_bytes()
    rows = [(run / "evaluation.csv").read_text().splitlines() for run in (whole, tmp_path / "run")]
    assert len(rows[0]) == len(rows[1]) == 1 + 2 + 6 * 4


def test_what_a_killed_process_kept_later_does_not_change_the_best(
    whole: Path, tmp_path: Path
) -> None:
    """The checkpoint is older than the best policy, which wins again."""
    run = shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(run / "checkpoints" / "120")
    before = (run / "policies" / "best.safetensors").read_bytes()
    assert midway.resume(run).finished
    assert (run / "policies" / "best.safetensors").read_bytes() == before
    assert midway.resume(run, from_step=0).finished
    assert (run / "policies" / "best.safetensors").read_bytes() == before


def test_a_run_that_reached_nothing_has_no_best_policy(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(whole, tmp_path / "run")
    (run / "policies" / "best.safetensors").write_bytes(b"damaged")
    assert kept.best(RunFolder(run)) is None
    with pytest.raises(ConfigurationError, match="cannot be read"):
        midway.load(run, "best")
    (run / "policies" / "best.safetensors").unlink()
    with pytest.raises(ConfigurationError, match="no best policy: no evaluation that reached"):
        midway.load(run, "best")
    assert midway.load(run).step == 120
    table = tables.read(run / "evaluation.csv")
    tables.write(run / "evaluation.csv", {**table, "success_rate": 0 * table["success_rate"]})
    for command in ("evaluate", "report", "watch"):
        with pytest.raises(SystemExit) as stop:
            main([command, str(run), "--policy", "best"])
        assert stop.value.code == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "none of its 7 evaluations of hard has reached a goal" in said
        assert "--policy last" in said
    (run / "evaluation.csv").unlink()
    with pytest.raises(ConfigurationError, match="no evaluation yet"):
        midway.load(run, "best")
