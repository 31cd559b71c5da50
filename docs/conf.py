"""Sphinx configuration: `sphinx-build -W --keep-going -b html docs docs/_build/html`."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

import ubl_graph

project = "ubl_graph"
author = "The ubl_graph developers"
copyright = author
version = release = ubl_graph.__version__

extensions = [
    "myst_nb",  # brings myst_parser
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
]
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
exclude_patterns = ["_build", "conf.py"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

# docs/notebooks/*.py are run by every build, which fails where one of them does.
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # s a cell
nb_merge_streams = True
# What a cell writes as Markdown may hold formulas and tables.
nb_render_markdown_format = "myst"

# In the docstrings single backticks mark code.
default_role = "code"
autodoc_member_order = "bysource"
# The docstrings name types and units; signatures stay short.
autodoc_typehints = "none"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
# "east, north : float" under "Attributes" names two; napoleon's own style takes one name only.
napoleon_custom_sections = [("Attributes", "params_style")]

html_theme = "furo"
html_title = f"ubl_graph {release}"
html_copy_source = False

_TEXTS: dict[str, list[str]] = {}


def _keep(_: Sphinx, what: str, name: str, __: object, ___: object, lines: list[str]) -> None:
    if what in {"attribute", "data", "property"}:
        _TEXTS[name] = list(lines)


def _restore(_: Sphinx, what: str, name: str, __: object, ___: object, lines: list[str]) -> None:
    # Napoleon takes what stands before a colon in an attribute's docstring for a type.
    if what in {"attribute", "data", "property"}:
        lines[:] = _TEXTS.pop(name)


def _lengths(_: Sphinx, __: str, ___: str, ____: object, _____: object, lines: list[str]) -> None:
    # |P - B| is a length in our docstrings, reStructuredText's substitution never.
    for i, line in enumerate(lines):
        if "`" not in line and not line.lstrip().startswith((">>>", "...")):
            lines[i] = re.sub(r"\|([^|]+)\|", r"\\|\1\\|", line)


def setup(app: Sphinx) -> dict[str, Any]:
    """Put our handlers before and after napoleon's, which has priority 500."""
    app.connect("autodoc-process-docstring", _keep, priority=400)
    app.connect("autodoc-process-docstring", _restore, priority=600)
    app.connect("autodoc-process-docstring", _lengths, priority=700)
    return {"parallel_read_safe": False}
