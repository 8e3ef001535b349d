"""What users type: numbers, settings and commands, with one clear line for what is wrong."""

import contextlib
import dataclasses
import functools
import io
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, ParamSpec

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from midway.errors import ConfigurationError

Arguments = ParamSpec("Arguments")


def _whole_number(words: list[str]) -> int:
    """Read 50000, 50_000 or 5e4."""
    number = float(words[0].replace("_", ""))
    if not number.is_integer():
        raise ValueError(f"{words[0]} is not a whole number")
    return int(number)


_NUMBER = PrimitiveConstructorSpec[int](
    nargs=1,
    metavar="N",
    instance_from_str=_whole_number,
    is_instance=lambda value: value is None or isinstance(value, int),
    str_from_instance=lambda value: [str(value)],
)
Count = Annotated[int, _NUMBER]
"""A whole number, which may be written 1e6 or 1_000_000."""
OptionalCount = Annotated[int | None, _NUMBER]
"""A whole number, or what the preset or the run says."""
Kept = Literal["best", "last"] | Count
"""A policy of a run."""
Changes = tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]]
"""Settings as NAME=VALUE: several after one ``--set``, or one ``--set`` for each."""


def parse(
    commands: Mapping[str, Callable[..., None]], arguments: Sequence[str]
) -> Callable[[], None]:
    """Return the command with its arguments.

    Raises:
        ConfigurationError: A wrong command or argument, or an option that is given twice.
    """
    options = Counter(word.partition("=")[0] for word in arguments if word.startswith("--"))
    for option in sorted(options.keys() - {"--set"}):
        if options[option] > 1:
            raise ConfigurationError(f"{option} is given twice: write its values after one")
    errors = io.StringIO()
    delayed = {name: _delay(command) for name, command in commands.items()}
    try:
        with contextlib.redirect_stderr(errors):
            command: Callable[[], None] = tyro.extras.subcommand_cli_from_dict(
                delayed,
                prog="midway",
                description="Goal-conditioned reinforcement learning with imagined subgoals.",
                args=arguments,
            )
        return command
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ConfigurationError(_one_line(errors.getvalue())) from None


def _delay(command: Callable[Arguments, None]) -> Callable[Arguments, Callable[[], None]]:
    """Return a function of the same signature that only binds its arguments.

    Parsing and running stay apart, so that only messages of the parser are caught.
    """

    @functools.wraps(command)
    def bind(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Callable[[], None]:
        return functools.partial(command, *args, **kwargs)

    return bind


def _one_line(box: str) -> str:
    """Return the text of the parser's box without its frame and its hint at --help."""
    lines = [line.strip("│╭╮╰╯ \n") for line in box.splitlines()]
    text = " ".join(line for line in lines[1:] if line.strip("─"))
    text = re.split(r"For full helptext|Argument helptext|Perhaps you meant", text)[0]
    return f"{' '.join(text.split())} (see midway --help)"


def settings(given: Sequence[Sequence[str]]) -> dict[str, str]:
    """Return the settings of ``--set NAME=VALUE ...``, given once or several times.

    Raises:
        ConfigurationError: A word without a value.
    """
    changes = {}
    for word in itertools.chain(*given):
        name, equals, value = word.partition("=")
        if not equals:
            raise ConfigurationError(f"--set {word!r}: write NAME=VALUE")
        changes[name.replace("-", "_")] = value
    return changes


def print_json(value: object) -> None:
    """Print one line of JSON."""
    print(json.dumps(value))


def run_folders(paths: Sequence[Path]) -> list[Path]:
    """Return the paths, with the folder of a sweep replaced by its runs."""
    found: list[Path] = []
    for path in paths:
        below = sorted(config.parent for config in path.glob("*/config.json"))
        found += below if below and not (path / "config.json").exists() else [path]
    return found


def plain(value: object) -> object:
    """Return a setting's value as JSON has it: a group of settings as its parts."""
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value  # type: ignore[arg-type]
