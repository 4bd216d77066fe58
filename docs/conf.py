"""Sphinx reads the Markdown of this folder; `make docs` builds the site into build/site, warnings being errors.

Why Sphinx with myst-nb: a reference to a page, a heading or a picture that is not there is an error, the Python
reference comes from the docstrings, notebooks are pages, and neither the theme nor the search loads anything from the
network, so that the built folder works as it is, from a disk too.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "site"), str(HERE.parent)]

from hooks import prepare, repository_links, titled  # noqa: E402 - needs the path above
from lexer import GbLexer  # noqa: E402 - likewise
from sphinx.application import Sphinx  # noqa: E402 - likewise

from gbspec.version import __version__  # noqa: E402 - likewise

project = "gbspec"
author = "the gbspec authors"
copyright = "the gbspec authors"
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc"]
exclude_patterns = ["site", "studies/*/members"]
nb_execution_mode = "off"  # `make notebook` executes the notebook
myst_heading_anchors = 4
highlight_language = "none"
default_role = "code"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
toc_object_entries_show_parents = "hide"
nitpicky = False

html_theme = "furo"
html_title = f"gbspec {version}"
html_show_sourcelink = False
html_copy_source = False

REPOSITORY = os.environ.get("GBSPEC_REPOSITORY", "")
"""Where links to files outside docs/ lead, such as https://host/owner/gbspec/blob/main; empty: they become text."""


def setup(app: Sphinx) -> None:
    """Registers the language, the generated pages and the links to files outside this folder."""
    app.add_lexer("gb", GbLexer)
    app.connect("builder-inited", lambda app: prepare(HERE))
    app.connect("source-read", lambda app, name, text: repository_links(text, REPOSITORY))
    app.connect("source-read", lambda app, name, text: titled(name, text))
