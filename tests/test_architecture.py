"""The house of the design: imports point down only, and some names are never used."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import midway
from midway.agents.registry import AGENTS
from midway.envs.registry import ENVIRONMENTS

SOURCE = Path(midway.__file__).parent
FILES = sorted(path for path in SOURCE.rglob("*.py") if path != SOURCE / "__init__.py")
"""All but the public face, ``midway/__init__.py``, which may name anything."""

FLOORS = (
    {"errors", "plain"},
    {"types", "files"},
    {"settings", "functional", "tables", "agent", "statistics"},
    {"networks", "replay", "envs", "planning"},
    {"agents"},
    {"training"},
    {"runs", "presets", "spaces"},
    {"configuration"},
    {"api"},
    {"reports", "cluster", "bench"},
    {"cli"},
)
"""The floors from below; the lowest of the design is three here: all reads the types and errors."""

FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}

AGENT_FLOORS = ({"beyond", "entropy"}, {"ris", "sac", "tdm", "crl"}, {"leap"}, {"registry"})
"""The same within agents/: LEAP is built on TDM, and the registry names them all."""

AGENT_FLOOR = {agent: level for level, agents in enumerate(AGENT_FLOORS) for agent in agents}

FORBIDDEN_IMPORTS = {"gym", "mujoco_py", "d4rl", "pickle"}
FORBIDDEN_NAME = re.compile(r"^_*(tau|alpha|lambda)_*$", re.IGNORECASE)


def name_of(path: Path) -> str:
    """Return the dotted name below midway: ``agents.ris`` for agents/ris.py."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imports(tree: ast.AST, package: tuple[str, ...]) -> Iterator[str]:
    """Yield every dotted name that the module imports, at its top or inside a function.

    ``from midway.agents import ris`` yields ``midway.agents.ris``: a name that is no module (a
    function) makes the dotted name one longer than a module's, which no check here minds.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)


def imports_of(path: Path) -> Iterator[str]:
    package = ("midway", *path.relative_to(SOURCE).parent.parts)
    return imports(ast.parse(path.read_text()), package)


def violations(module: str, imported: Iterator[str]) -> Iterator[str]:
    """Yield a line for each import of the module that does not point down."""
    room = module.split(".")[0]
    for target in imported:
        if target != "midway" and not target.startswith("midway."):
            continue
        there = target.split(".")[1:]
        if not there or there[0] not in FLOOR:
            yield f"{module} imports {target}, which is on no floor"
        elif there[0] == room:
            yield from _violations_between_agents(module, there)
        elif FLOOR[there[0]] >= FLOOR[room]:
            yield f"{module} (floor {FLOOR[room]}) imports {target} (floor {FLOOR[there[0]]})"


def _violations_between_agents(module: str, there: list[str]) -> Iterator[str]:
    room, _, importer = module.partition(".")
    if room == "agents" and AGENT_FLOOR[there[1]] >= AGENT_FLOOR[importer]:
        yield f"{module} imports {there[1]}, which is not below it"


def identifiers(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield every name that the module binds or reads, with its line.

    The name of an argument in a call belongs to whoever defined the function: matplotlib's alpha.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword):
            continue
        line = getattr(node, "lineno", 0)
        for field in ("id", "attr", "arg", "name", "asname"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                yield value.split(".")[-1], line


def test_the_checks_below_see_the_package():
    names = {name_of(path) for path in FILES}
    assert {"types", "functional", "agents.ris", "networks.mlp", "replay.buffer"} <= names


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_module_stands_on_a_floor(path):
    room, *parts = name_of(path).split(".")
    assert room in FLOOR
    if room == "agents" and parts:
        assert parts[0] in AGENT_FLOOR


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_point_down(path):
    assert list(violations(name_of(path), imports_of(path))) == []


def test_modules_do_not_import_each_other_in_a_circle():
    modules = {name_of(path) for path in FILES}
    below = {name_of(path): set(_modules_of(imports_of(path), modules)) for path in FILES}
    rest = dict(below)
    while leaves := [module for module, targets in rest.items() if not targets & rest.keys()]:
        for leaf in leaves:
            del rest[leaf]
    assert rest == {}


def _modules_of(imported: Iterator[str], modules: set[str]) -> Iterator[str]:
    """Yield the modules that are meant: ``replay.buffer`` for ``midway.replay.buffer.add``."""
    for target in imported:
        name = target.removeprefix("midway.")
        while name and name not in modules:
            name = name.rpartition(".")[0]
        if target.startswith("midway.") and name:
            yield name


LOOP = ["arrays", "collect", "evaluate", "freeze", "loop", "seeds", "state", "step"]


@pytest.mark.parametrize("module", [f"training.{name}" for name in LOOP])
def test_the_loop_knows_neither_agents_nor_environments(module):
    path = SOURCE.joinpath(*module.split(".")).with_suffix(".py")
    rooms = {target.split(".")[1] for target in imports_of(path) if target.startswith("midway.")}
    containers = {
        "errors",
        "plain",
        "types",
        "files",
        "functional",
        "agent",
        "tables",
        "statistics",
    }
    assert rooms <= containers | {"replay", "training"}


@pytest.mark.parametrize("path", [*FILES, SOURCE / "__init__.py"], ids=name_of)
def test_no_forbidden_import(path):
    roots = {target.split(".")[0] for target in imports_of(path)}
    assert not roots & FORBIDDEN_IMPORTS


@pytest.mark.parametrize("path", [*FILES, SOURCE / "__init__.py"], ids=name_of)
def test_no_symbol_of_the_papers_is_an_identifier(path):
    """Each of them means two or three things in the papers: the symbol goes to the docstring."""
    found = [
        f"line {line}: {name}"
        for name, line in identifiers(ast.parse(path.read_text()))
        if FORBIDDEN_NAME.match(name)
    ]
    assert found == []


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("functional", "from midway.networks.mlp import MLP"),
        ("networks.mlp", "import midway.agents.ris"),
        ("networks.mlp", "from midway.replay import buffer"),
        ("envs.registry", "from ..agents import ris"),
        ("agents.ris", "from midway.training.loop import train"),
        ("agents.ris", "from midway.agents import sac"),
        ("agents.ris", "from .sac import Config"),
        ("agents.tdm", "from midway.agents.leap import Config"),
        ("training.loop", "def run():\n    from midway.cli.main import main"),
        ("training.loop", "from midway.presets import PAPER"),
        ("training.loop", "from midway.runs.folder import RunFolder"),
        ("runs.policy", "from midway import presets"),
        ("presets", "from midway.runs.folder import RunConfig"),
        ("runs.folder", "from midway import api"),
        ("bench.pieces", "from midway.reports import page"),
        ("types", "from midway.settings import check"),
        ("settings", "from midway.tables import read"),
        ("files", "from midway.tables import read"),
        ("agent", "from midway import functional"),
        ("agents.leap", "from midway.agents import registry"),
        ("presets", "from midway.reports import page"),
        ("reports.page", "from midway.cluster import sweep"),
        ("agents.ris", "from midway import make_vec"),
        ("agents.ris", "import midway"),
    ],
)
def test_an_import_that_does_not_point_down_is_found(module, line):
    package = ("midway", *module.split(".")[:-1])
    assert list(violations(module, imports(ast.parse(line), package)))


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("networks.mlp", "from midway import functional"),
        ("networks.policies", "from .mlp import MLP"),
        ("agents.leap", "from midway.agents import tdm"),
        ("agents.registry", "from midway.agents import ris, sac"),
        ("agents.ris", "import numpy as np"),
        ("cli.main", "from midway.training.loop import train"),
        ("presets", "from midway.training.config import TrainConfig"),
        ("settings", "from midway.types import ConfigurationError"),
        ("agent", "from midway.types import Batch"),
        ("tables", "from midway.types import ConfigurationError"),
        ("runs.policy", "from midway.training import freeze"),
        ("api", "from midway import presets"),
        ("bench.pieces", "from midway import api"),
        ("cli.main", "from midway.bench import pieces"),
    ],
)
def test_an_import_that_points_down_is_allowed(module, line):
    package = ("midway", *module.split(".")[:-1])
    assert list(violations(module, imports(ast.parse(line), package))) == []


def test_a_symbol_is_found_wherever_it_is_used():
    for line in ("tau = 1", "f(x=alpha)", "def f(lambda_): pass", "x.tau", "import a as alpha"):
        assert any(FORBIDDEN_NAME.match(name) for name, _ in identifiers(ast.parse(line)))
    for line in ("lambda x: x", "target = 1", "alphabet = 1", "plot(alpha=0.5)"):
        assert not any(FORBIDDEN_NAME.match(name) for name, _ in identifiers(ast.parse(line)))


# --- nobody asks for a name -----------------------------------------------------------------------

AGENT_NAMES = {*AGENTS, "crl"}
MAY_NAME_AGENTS = {"agents.registry", "presets"}
MAY_DEFAULT_TO_AGENTS = {"configuration", "api", "cli", "bench"}
"""Rooms whose calls and default arguments may choose an agent; none may compare one."""

GUESS = re.compile(rf"^({'|'.join({e.family for e in ENVIRONMENTS.values()})})(-.*)?$")


def names_of_agents(module: str, tree: ast.AST) -> Iterator[str]:
    """Yield a line for every agent's name that the module must not know."""
    if module in MAY_NAME_AGENTS:
        return
    allowed: set[ast.AST] = set()
    if module.split(".")[0] in MAY_DEFAULT_TO_AGENTS:
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                given = [*node.args.defaults, *(d for d in node.args.kw_defaults if d)]
                allowed |= {part for value in given for part in ast.walk(value)}
            elif isinstance(node, ast.Call):
                allowed |= set(node.args)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node.value in AGENT_NAMES and node not in allowed:
            yield f"line {node.lineno}: {node.value!r}"


def guesses(tree: ast.AST) -> Iterator[str]:
    """Yield a line for each guess at an environment from parts of its name."""
    names = {*ENVIRONMENTS, *(e.family for e in ENVIRONMENTS.values())}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            texts = [a.value for a in node.args if isinstance(a, ast.Constant)]
            cut = node.func.attr in {"partition", "rpartition", "split"} and "-" in texts
            begun = node.func.attr in {"startswith", "removeprefix"} and any(
                isinstance(text, str) and GUESS.match(text) for text in texts
            )
            if cut or begun:
                yield f"line {node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            for part in (part for side in sides for part in ast.walk(side)):
                if isinstance(part, ast.Constant) and part.value in names:
                    yield f"line {node.lineno}: {ast.unparse(node)}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_nobody_asks_for_the_name_of_an_agent(path):
    assert list(names_of_agents(name_of(path), ast.parse(path.read_text()))) == []


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_nothing_is_guessed_from_the_name_of_an_environment(path):
    assert list(guesses(ast.parse(path.read_text()))) == []


def test_a_name_of_an_agent_is_found():
    for line in ('if agent == "sac": pass', 'COLOURS = {"ris": 1}', 'x in ("tdm", "leap")'):
        assert list(names_of_agents("reports.style", ast.parse(line)))
        assert list(names_of_agents("api", ast.parse(line)))
        assert not list(names_of_agents("presets", ast.parse(line)))
    default = ast.parse('def train(agent="ris", agents=("ris", "sac")): pass')
    assert not list(names_of_agents("cli.main", default))
    assert list(names_of_agents("training.loop", default))


def test_a_guess_at_an_environment_is_found():
    for line in (
        'env.partition("-")',
        'env.startswith("ant-")',
        'env == "push"',
        'e.family == "ant"',
    ):
        assert list(guesses(ast.parse(line)))
    for line in ('line.partition(":")', 'name.startswith("distance_")', 'x == "hard"'):
        assert not list(guesses(ast.parse(line)))
