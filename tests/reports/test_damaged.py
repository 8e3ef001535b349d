"""A report of a run with damaged files says which, and shows the rest."""

import shutil
from pathlib import Path

import pytest

import midway
import tiny
from midway import tables
from midway.errors import ConfigurationError
from midway.reports import report
from midway.reports.runs import read

TINY = tiny.TINY | {"steps": 120}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "run"
    return midway.train("point-u", agent="sac", out=path, changes=TINY).path


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "run")


def test_the_page_names_a_damaged_table_and_a_damaged_policy(run: Path) -> None:
    metrics = run / "metrics.csv"
    metrics.write_text(metrics.read_text()[9:])
    kept = min((run / "policies").iterdir())
    content = bytearray(kept.read_bytes())
    content[-1] ^= 1
    kept.write_bytes(content)
    files = report([run])
    page = files[0].read_text()
    assert "metrics.csv" in page
    assert kept.name in page
    assert page.count("left out: ") == 2
    assert len(files) > 2


def test_a_whole_run_has_nothing_damaged(whole: Path) -> None:
    data = read(whole)
    assert data.damaged == ()
    assert data.metrics
    assert data.past_weights


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.split("\n", 1)[1],
        lambda text: text.replace(",", "", 1),
        lambda text: "\x00\xff" + text[10:],
        lambda text: text.replace("\n", "\n1,2\n", 2),
    ],
    ids=["no header", "a comma", "garbage", "short rows"],
)
def test_damaged_tables_are_not_read_in_part(run: Path, damage) -> None:
    metrics = run / "metrics.csv"
    metrics.write_text(damage(metrics.read_text()))
    data = read(run)
    assert not data.metrics
    assert "metrics.csv" in data.damaged[0]


def test_a_last_line_that_is_being_written_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("step,loss\n1,2\n2,3")
    assert tables.read(path)["step"].tolist() == [1]
    path.write_text("step,loss\n1,2\n2,\n")
    assert tables.read(path)["step"].tolist() == [1, 2]
    path.write_text("step,loss\n1,2\n2")
    assert tables.read(path)["step"].tolist() == [1]
    path.write_text("step,loss\n1\n2,3\n")
    with pytest.raises(ConfigurationError, match="line 2 has 1 values for 2 columns"):
        tables.read(path)
