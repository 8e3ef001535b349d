"""Print a pip constraint for every package that midway and its extras need, as installed here.

`make tested > constraints.txt` writes the newest set that all tests have passed with.
"""

import tomllib
from collections.abc import Iterable
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from itertools import chain
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def closure(lines: Iterable[str]) -> dict[str, Distribution]:
    """Return the installed distributions that the requirements lead to, by canonical name."""
    found: dict[str, Distribution] = {}
    waiting = [Requirement(line) for line in lines]
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        wanted = waiting.pop()
        name, extras = canonicalize_name(wanted.name), frozenset(wanted.extras)
        if name in ("midway", "setuptools") or (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue
        for requirement in map(Requirement, found[name].requires or []):
            if requirement.marker is None or any(
                requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras)
            ):
                waiting.append(requirement)
    return found


if __name__ == "__main__":
    extras = PROJECT["optional-dependencies"].values()
    for name, found in sorted(closure(chain(PROJECT["dependencies"], *extras)).items()):
        print(f"{name}=={found.version}")
