"""What pyproject.toml declares is what the code imports, no more and no less."""

import ast
import re
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

TOOLS = {"beartype", "mypy", "pre-commit", "pytest-cov", "pytest-timeout", "pytest-xdist", "ruff"}
"""Of the extra ``dev``: what is run, or plugged into pytest, and imported by no test."""

PROVIDERS = packages_distributions()


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(lines: Iterable[str]) -> dict[str, str]:
    """Return the lower bound of each distribution; every line is written ``name>=1.2.3``."""
    found = {}
    for line in lines:
        match = re.fullmatch(r"([\w-]+)>=(\d+(?:\.\d+)*)", line)
        assert match, f"not written as name>=version: {line}"
        found[canonical(match[1])] = match[2]
    return found


DECLARED = requirements(PYPROJECT["project"]["dependencies"])
EXTRAS = {
    name: requirements(lines)
    for name, lines in PYPROJECT["project"]["optional-dependencies"].items()
}
DEV, ROBOTICS = EXTRAS.pop("dev"), EXTRAS.pop("robotics")
ROBOTICS |= EXTRAS.pop("ogbench")
assert EXTRAS["data"].pop("h5py")  # Minari reads its files by it
OPTIONAL = {name for extra in EXTRAS.values() for name in extra}


def imported(node: ast.AST, inside: bool = False) -> Iterator[tuple[str, bool]]:
    """Yield the first name of each import, and whether it waits inside a function."""
    names = []
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and not node.level:
        names = [node.module or ""]
    yield from ((name.split(".")[0], inside) for name in names)
    inside = inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    for child in ast.iter_child_nodes(node):
        yield from imported(child, inside)


def distribution_of(name: str, declared: Iterable[str]) -> str:
    """Return the distribution that provides an import, of several the declared one."""
    providers = {canonical(provider) for provider in PROVIDERS.get(name, [name])}
    return min(providers & set(declared) or providers)


def found_in(folder: Path, declared: Iterable[str]) -> set[tuple[str, bool]]:
    """Return the distributions that the files import, but for Python's own and their own."""
    files = [*folder.rglob("*.py")]
    own = {"midway", *sys.stdlib_module_names, *(path.stem for path in files)}
    names = {found for path in files for found in imported(ast.parse(path.read_text()))}
    return {(distribution_of(name, declared), inside) for name, inside in names if name not in own}


def test_the_package_imports_what_it_declares() -> None:
    assert {name for name, _ in found_in(SOURCE, {*DECLARED, *OPTIONAL})} == {*DECLARED, *OPTIONAL}


def test_what_an_extra_installs_is_imported_where_it_is_needed() -> None:
    assert {name for name, inside in found_in(SOURCE, OPTIONAL) if not inside} & OPTIONAL == set()


def test_the_extras_of_environments_hold_the_packages_that_are_found_by_their_ids() -> None:
    assert set(ROBOTICS) == set(map(canonical, PACKAGES))


def test_the_tests_import_what_is_declared() -> None:
    found = {name for name, _ in found_in(TESTS, {*DECLARED, *DEV, *OPTIONAL})}
    assert found - {*DECLARED, *OPTIONAL} == set(DEV) - TOOLS
    assert set(DEV) >= TOOLS


@pytest.mark.parametrize("name", sorted({**DECLARED, **DEV}))
def test_what_is_tested_is_within_the_bounds(name: str) -> None:
    def numbers(text: str) -> tuple[int, ...]:
        return tuple(int(part) for part in re.findall(r"\d+", text)[:3])

    assert numbers(version(name)) >= numbers({**DECLARED, **DEV}[name])


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
