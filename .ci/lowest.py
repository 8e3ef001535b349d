"""Print a pip constraint for every dependency that pins it to its lower bound.

Each bound is one release that exists, so `equinox>=0.13` becomes `equinox==0.13`.
"""

import tomllib
from itertools import chain
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]

for requirement in chain(PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
    if not requirement.startswith("midway["):
        print(requirement.replace(">=", "=="))
