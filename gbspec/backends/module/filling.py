"""The template's files as one text, and its marked places filled."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from importlib import resources

from gbspec.diagnostics import Defect

PARTS = ("model", "networks", "directions", "arithmetic", "tensors")
"""The template's files in the order of the generated module."""

PLACE = re.compile(
    r'^(?P<indent>[ ]*)"""(?:(?!""").)*?"""  \# \{\{(?P<document>[a-z ]+)\}\}\n'  # a docstring, marked where it ends
    r"|^(?P<before>[ ]*)\S[^\n]*  \# \{\{(?P<line>[a-z ]+)\}\}\n"  # a line that ends in its mark
    r"|^(?P<margin>[ ]*)\# \{\{(?P<region>[a-z ]+)\n.*?^(?P=margin)\# (?P=region)\}\}\n",  # between two marks
    flags=re.M | re.S,
)


@cache
def template() -> str:
    """The files joined, without what only checkers of this project's own text read."""
    text = "\n\n\n".join(map(_part, PARTS)) + "\n"
    return re.sub(r"  # type: ignore\[[^\n]*|  # noqa: [^\n]*", "", text)


def _part(name: str) -> str:
    """A file of the template; of all but the first what follows the line `# <body>`."""
    text = resources.files("gbspec.backends.module.template").joinpath(f"{name}.py").read_text(encoding="utf-8")
    return (text if name == PARTS[0] else text.split("# <body>\n", 1)[1]).strip()


def fill(text: str, places: Mapping[str, str]) -> str:
    """The text with every marked place replaced, indented as its mark is.

    Raises Defect unless the text's places are exactly those given, each once.
    """
    found = [match["document"] or match["line"] or match["region"] for match in PLACE.finditer(text)]
    if sorted(found) != sorted(places) or "{{" in PLACE.sub("", text):
        raise Defect(
            f"the template has the places {sorted(found)}, not {sorted(places)}, or a mark that cannot be read"
        )

    def replacement(match: re.Match[str]) -> str:
        indent = match["indent"] or match["before"] or match["margin"] or ""
        value = places[match["document"] or match["line"] or match["region"]]
        return "".join(f"{indent}{line}".rstrip() + "\n" for line in value.splitlines())

    return PLACE.sub(replacement, text)
