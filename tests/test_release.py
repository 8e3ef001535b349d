"""What a newcomer does: install the wheel, and train on an environment of one's own.

The wheel is built from the source distribution and installed into a fresh environment outside the
checkout, which holds the libraries of the light core and none of an extra.
"""

import os
import re
import runpy
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TINY = ["hidden=(8,8)", "batch_size=8", "num_envs=4", "random_steps=40", "replay_capacity=2000"]
TINY += ["evaluation_episodes=2", "log_every=20"]

USE = """
import numpy as np
import midway
assert {folder!r} in midway.__file__, midway.__file__
policy = midway.load("runs/boat")
action = policy(np.zeros(4), np.zeros(2))
assert action.shape == (2,) and (abs(action) <= 1).all()
"""

pytestmark = pytest.mark.release


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the source distribution and of the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    return folder


def test_the_wheel_holds_the_package_and_nothing_else(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    source = ROOT / "src"
    files = [path for path in (source / "midway").rglob("*") if "__pycache__" not in path.parts]
    assert held == {str(path.relative_to(source)) for path in files if path.is_file()}
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as sources:
        names = {name.partition("/")[2] for name in sources.getnames()}
    assert {"LICENSE", "README.md", "pyproject.toml", "src/midway/py.typed"} <= names


def test_from_the_wheel_to_a_policy_for_an_environment_of_ones_own(
    built: Path, tmp_path: Path
) -> None:
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    python = venv / "bin" / "python"
    (wheel,) = built.glob("*.whl")
    pip = ("-m", "pip", "--python", str(python), "install", "--no-deps")
    assert use(tmp_path, Path(sys.executable), *pip, str(wheel)).returncode == 0
    link_core(Path(sysconfig.get_path("purelib", vars={"base": str(venv)})))
    page = (ROOT / "docs" / "your-own-task.md").read_text()
    found = re.search(r"```python boat\.py\n(.*?)```", page, re.DOTALL)
    assert found is not None
    (tmp_path / "boat.py").write_text(found[1])

    def midway(*arguments: str) -> subprocess.CompletedProcess[str]:
        return use(tmp_path, venv / "bin" / "midway", *arguments)

    assert "train" in midway("--help").stdout
    assert midway("doctor").returncode == 0
    assert midway("check", "boat:Boat-v0", "--seconds", "1").returncode == 0
    train = ["train", "boat:Boat-v0", "--steps", "200", "--out", "runs/boat", "--set", *TINY]
    trained = midway(*train)
    assert trained.returncode == 0, trained.stderr
    assert "success" in midway("evaluate", "runs/boat", "--episodes", "4").stdout
    used = use(tmp_path, python, "-c", USE.format(folder=str(venv)))
    assert used.returncode == 0, used.stderr
    drawn = midway("report", "runs/boat")
    assert drawn.returncode == 2
    assert "pip install 'midway[plots]'" in drawn.stderr


def link_core(site: Path) -> None:
    """Link what midway without extras needs into an environment, as pip would install it."""
    closure = runpy.run_path(str(ROOT / ".ci" / "tested.py"))["closure"]
    for distribution in closure(PROJECT["dependencies"]).values():
        for top in {file.parts[0] for file in distribution.files or () if file.parts[0] != ".."}:
            if top != "__pycache__" and not (site / top).exists():
                (site / top).symlink_to(distribution.locate_file(top))


def use(folder: Path, program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the environment in a folder, which knows nothing of the checkout."""
    known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(program), *arguments]
    return subprocess.run(command, cwd=folder, env=known, capture_output=True, text=True)
