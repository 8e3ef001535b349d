"""The site: `make site` builds it, and fails at any broken link or docstring."""

import re
import tomllib
from pathlib import Path

from sphinx.application import Sphinx

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]

project = PROJECT["name"]
release = PROJECT["version"]
author = "The midway authors"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
html_theme = "furo"
html_title = f"midway {release}"
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
exclude_patterns = ["_build"]
linkcheck_timeout, linkcheck_retries = 20, 2
linkcheck_report_timeouts_as_broken = True

OUTSIDE = re.compile(r"\]\(((?:\.\./)+)benchmarks/README\.md")
"""Links of the pages to the results, which are a file of the repository and a page of the site."""


def setup(app: Sphinx) -> None:
    """Read pages and docstrings as they are written for the repository."""
    app.connect("source-read", results_are_a_page)
    app.connect("autodoc-process-docstring", bars_are_absolute_values)


def results_are_a_page(app: Sphinx, page: str, source: list[str]) -> None:
    """Lead links to the results to the page that holds them."""
    source[0] = OUTSIDE.sub("](" + "../" * page.count("/") + "reproducing.md", source[0])


def bars_are_absolute_values(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Keep ``|V|``, which reStructuredText reads as a substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]
