"""What a newcomer does: install the wheel, type the README, train on an environment of one's own.

The wheel is built from the source distribution and installed into fresh environments outside the
checkout: one holds the libraries of the light core and none of an extra, the other those of the
extras that the README names.
"""

import os
import re
import runpy
import shlex
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TINY = ["hidden=(8,8)", "batch_size=8", "num_envs=4", "random_steps=40", "replay_capacity=10000"]
TINY += ["evaluation_episodes=2", "log_every=20"]

EXTRAS = ("plots", "video", "tune", "robotics")
"""Extras of the README's commands."""

SHORTER = {"--trials 20": "--trials 2", "--seeds 0 1 2": "--seeds 0"}
"""What the README would train for longer than an hour, typed with fewer runs."""

TRAINING = ("train", "sweep", "tune")

OTHER_PYTHONS = ("3.12", "3.13", "3.14")

WHEELS = ("plots", "video", "cluster", "tune", "data", "onnx")
"""Extras that have wheels for them."""

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
    venv = installed(built, tmp_path / "venv", requirements(()))
    python = venv / "bin" / "python"
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


@pytest.mark.extra
@pytest.mark.timeout(5400)
def test_the_readme_typed_line_by_line(built: Path, tmp_path: Path) -> None:
    """Runs are as the README has them, with networks, budgets and studies that end soon."""
    venv = installed(built, tmp_path / "venv", requirements(EXTRAS))
    text = (ROOT / "README.md").read_text()
    (commands,) = (block for block in blocks(text, "") if block.startswith("midway "))
    (code,) = blocks(text, "python")
    lines = [line.split("#")[0].strip() for line in commands.splitlines()]
    lines = [part.strip() for line in lines for part in line.split("\N{MIDDLE DOT}")]
    assert len(lines) > 15
    (tmp_path / "zoo").symlink_to(ROOT / "zoo")
    for line in lines:
        name, *words = shlex.split(shorter(line))
        assert name == "midway"
        typed = use(tmp_path, venv / "bin" / "midway", *words)
        assert typed.returncode == 0, f"{line}: {typed.stderr}"
    settings = ", ".join(f"'{name}': '{value}'" for name, value in (p.split("=") for p in TINY))
    short = code.replace("steps=16_000", f"steps=200, changes={{{settings}}}")
    assert short != code
    used = use(tmp_path, venv / "bin" / "python", "-c", short)
    assert used.returncode == 0, used.stderr


@pytest.mark.parametrize("python", OTHER_PYTHONS)
def test_other_pythons_have_wheels_of_the_tested_releases(python: str, tmp_path: Path) -> None:
    """They resolve; nothing of them is run here."""
    command = ["-m", "pip", "install", "--dry-run", "--ignore-installed", "--only-binary=:all:"]
    command += ["--python-version", python, "--target", str(tmp_path / "nowhere")]
    command += ["--constraint", str(ROOT / "constraints.txt"), *requirements(WHEELS)]
    resolved = use(tmp_path, Path(sys.executable), *command)
    assert resolved.returncode == 0, resolved.stderr
    assert "Would install" in resolved.stdout
    assert "jaxlib-" in resolved.stdout


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def shorter(line: str) -> str:
    """Return a command of the README that ends soon."""
    for long, short in SHORTER.items():
        line = line.replace(long, short)
    if line.split()[1] in TRAINING and "--help" not in line:
        line += " --steps 200 --set " + " ".join(map(shlex.quote, TINY))
    return line


def requirements(extras: Sequence[str]) -> list[str]:
    """Return what midway needs with some extras."""
    of_extras = chain.from_iterable(PROJECT["optional-dependencies"][name] for name in extras)
    own = [line for line in of_extras if not line.startswith("midway[")]
    return [*PROJECT["dependencies"], *own]


def installed(built: Path, venv: Path, wanted: Sequence[str]) -> Path:
    """Return a fresh environment with the wheel and what it requires, as pip would install it."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    (wheel,) = built.glob("*.whl")
    python = str(venv / "bin" / "python")
    pip = ("-m", "pip", "--python", python, "install", "--no-deps", str(wheel))
    assert use(venv, Path(sys.executable), *pip).returncode == 0
    site = Path(sysconfig.get_path("purelib", vars={"base": str(venv)}))
    closure = runpy.run_path(str(ROOT / ".ci" / "tested.py"))["closure"]
    for distribution in closure(wanted).values():
        for top in {file.parts[0] for file in distribution.files or () if file.parts[0] != ".."}:
            if top != "__pycache__" and not (site / top).exists():
                (site / top).symlink_to(distribution.locate_file(top))
    return venv


def use(folder: Path, program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the environment in a folder, which knows nothing of the checkout."""
    known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(program), *arguments]
    return subprocess.run(command, cwd=folder, env=known, capture_output=True, text=True)
