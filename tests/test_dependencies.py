"""What pyproject.toml declares is what the code imports, no more and no less."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import packages_distributions, version
from pathlib import Path

import pytest

from midway.envs.packages import PACKAGES

ROOT = Path(__file__).parents[1]
SOURCE, TESTS = ROOT / "src" / "midway", ROOT / "tests"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

TOOLS = {
    *("beartype", "build", "mypy", "pre-commit", "ruff"),
    *("pytest-cov", "pytest-timeout", "pytest-xdist"),
}
"""Of the extra ``dev``: what is run, or plugged into pytest, and imported by no test."""

PROVIDERS = packages_distributions()


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(lines: Iterable[str]) -> dict[str, str]:
    """Return the lower bound of each distribution; every line is written ``name>=1.2.3``.

    A line ``midway[extra]`` stands for another extra, which is read at its own place.
    """
    found = {}
    for line in lines:
        if line.startswith("midway["):
            continue
        match = re.fullmatch(r"([\w-]+)>=(\d+(?:\.\d+)*)", line)
        assert match, f"not written as name>=version: {line}"
        found[canonical(match[1])] = match[2]
    return found


DECLARED = requirements(PYPROJECT["project"]["dependencies"])
EXTRAS = {
    name: requirements(lines)
    for name, lines in PYPROJECT["project"]["optional-dependencies"].items()
}
BOUNDS = DECLARED | {name: bound for extra in EXTRAS.values() for name, bound in extra.items()}
DEV, ROBOTICS = EXTRAS.pop("dev"), EXTRAS.pop("robotics")
ROBOTICS |= EXTRAS.pop("ogbench")
del EXTRAS["docs"]  # run by `make docs`, imported by nothing
assert EXTRAS["data"].pop("h5py")  # Minari reads its files by it
OPTIONAL = {name for extra in EXTRAS.values() for name in extra}


def imported(node: ast.AST, inside: bool = False) -> Iterator[tuple[str, bool]]:
    """Yield the first name of each import, and whether it waits in a function or is of types."""
    names = []
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and not node.level:
        names = [node.module or ""]
    yield from ((name.split(".")[0], inside) for name in names)
    typed = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    inside = inside or typed or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    for child in ast.iter_child_nodes(node):
        yield from imported(child, inside)


def distribution_of(name: str, declared: Iterable[str]) -> str:
    """Return the distribution that provides an import, of several the declared one."""
    providers = {canonical(provider) for provider in PROVIDERS.get(name, [name])}
    return min(providers & set(declared) or providers)


def found_in(folder: Path, declared: Iterable[str], but: str = "") -> set[tuple[str, bool]]:
    """Return the distributions that the files import, but for Python's own and their own."""
    files = [path for path in folder.rglob("*.py") if but not in path.parts]
    own = {"midway", *sys.stdlib_module_names, *(path.stem for path in files)}
    names = {found for path in files for found in imported(ast.parse(path.read_text()))}
    return {(distribution_of(name, declared), inside) for name, inside in names if name not in own}


def test_the_package_imports_what_it_declares() -> None:
    assert {name for name, _ in found_in(SOURCE, {*DECLARED, *OPTIONAL})} == {*DECLARED, *OPTIONAL}


def test_what_an_extra_installs_is_imported_where_it_is_needed() -> None:
    found = {name for name, inside in found_in(SOURCE, OPTIONAL) if not inside}
    assert found & OPTIONAL == set(EXTRAS["plots"])
    elsewhere = found_in(SOURCE, OPTIONAL, but="reports")
    assert {name for name, inside in elsewhere if not inside} & OPTIONAL == set()


WITHOUT_PLOTS = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {names}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
from midway import api, presets
from midway.bench import pieces
from midway.cluster import sweep
from midway.cli.main import main
main(["presets", "point-u"])
main(["report", "nowhere"])
"""


def test_the_core_does_without_the_extras_and_names_them() -> None:
    names = {"PIL", "imageio_ffmpeg", "jinja2", "matplotlib", "minari", "ray", "onnx", "wandb"}
    script = WITHOUT_PLOTS.format(names=names)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stdout.startswith("steps")
    (line,) = done.stderr.splitlines()
    assert re.fullmatch(r"midway: a figure needs \w+: pip install 'midway\[plots\]'", line), line


def test_the_extras_of_environments_hold_the_packages_that_are_found_by_their_ids() -> None:
    assert set(ROBOTICS) == set(map(canonical, PACKAGES))


def test_the_tests_import_what_is_declared() -> None:
    found = {name for name, _ in found_in(TESTS, {*DECLARED, *DEV, *OPTIONAL})}
    assert found - {*DECLARED, *OPTIONAL} == set(DEV) - TOOLS
    assert set(DEV) >= TOOLS


def numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text)[:3])


@pytest.mark.parametrize("name", sorted({**DECLARED, **DEV}))
def test_what_is_tested_is_within_the_bounds(name: str) -> None:
    assert numbers(version(name)) >= numbers({**DECLARED, **DEV}[name])


def test_the_constraints_hold_a_tested_release_of_everything() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    tested = dict(line.split("==") for line in lines)
    for name in ("ogbench", "huggingface-hub", "wandb"):  # not installed where the tests run
        del BOUNDS[name]
    assert {name for name in BOUNDS if name not in tested} == set()
    for name, bound in BOUNDS.items():
        assert numbers(tested[name]) >= numbers(bound), name


def test_the_package_holds_the_files_that_it_declares() -> None:
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["midway"]
    matched = {pattern: {*SOURCE.glob(pattern)} for pattern in patterns}
    assert all(matched.values()), matched
    files = {path for path in SOURCE.rglob("*") if path.is_file() and path.suffix != ".py"}
    there = {path for path in files if "__pycache__" not in path.parts}
    assert set().union(*matched.values()) == there


def test_imports_are_found_wherever_they_stand() -> None:
    tree = ast.parse("import a.b, c\nfrom d.e import f\nfrom . import g\ndef h():\n  import i")
    assert [*imported(tree)] == [("a", False), ("c", False), ("d", False), ("i", True)]
