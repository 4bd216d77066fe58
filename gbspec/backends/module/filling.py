"""Joins the template's files and fills their marked places."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from importlib import resources

from gbspec.diagnostics import Defect

PARTS = ("model", "stepping", "vectors", "weights", "networks", "directions", "arithmetic", "slopes", "tensors")
"""The template's files in the order of the generated module."""

PLACE = re.compile(
    r'^(?P<indent>[ ]*)"""(?:(?!""").)*?"""  \# \{\{(?P<document>[a-z ]+)\}\}\n'  # a docstring, marked where it ends
    r"|^(?P<before>[ ]*)\S[^\n]*  \# \{\{(?P<line>[a-z ]+)\}\}\n"  # a line that ends in its mark
    r"|^(?P<margin>[ ]*)\# \{\{(?P<region>[a-z ]+)\n.*?^(?P=margin)\# (?P=region)\}\}\n",  # between two marks
    flags=re.M | re.S,
)


OPTIONAL = re.compile(r"^[ ]*\# \[(events|algebraic|delays|steady|resting)\n(.*?)^[ ]*\# \1\]\n", flags=re.M | re.S)
"""What only modules of models with events, algebraic variables, delays or steady starts have, or with events on the
way to these."""
EARLY = ("events", "switches", "delays")
"""Such files whose place is among the first ones."""


@cache
def template(*more: str) -> str:
    """The files joined, with those that only some models need, without comments for type checkers and linters."""
    early = [part for part in more if part in EARLY]
    parts = (*PARTS[:2], *early, *PARTS[2:], *(part for part in more if part not in early))
    text = "\n\n\n".join(map(_part, parts)) + "\n"
    text = OPTIONAL.sub(lambda match: match[2] if match[1] in more else "", text)
    return re.sub(r"  # type: ignore\[[^\n]*|  # noqa: [^\n]*", "", text)


def _part(name: str) -> str:
    """A file of the template; except for the first, the part after the line `# <body>`."""
    text = resources.files("gbspec.backends.module.template").joinpath(f"{name}.py").read_text(encoding="utf-8")
    return (text if name == PARTS[0] else text.split("# <body>\n", 1)[1]).strip()


def fill(text: str, places: Mapping[str, str]) -> str:
    """The text with every marked place replaced, with the indentation of the mark.

    Raises Defect unless the text has exactly the given places, each once.
    """
    found = [match["document"] or match["line"] or match["region"] for match in PLACE.finditer(text)]
    if sorted(found) != sorted(places) or "{{" in PLACE.sub("", text):
        raise Defect(f"the template has the places {sorted(found)}, not {sorted(places)}, or an invalid mark")

    def replacement(match: re.Match[str]) -> str:
        indent = match["indent"] or match["before"] or match["margin"] or ""
        # Only line feeds end lines: `splitlines` also splits at characters that a description may have, such as U+2028.
        value = places[match["document"] or match["line"] or match["region"]]
        return "".join(f"{indent}{line}".rstrip() + "\n" for line in value.split("\n"))

    return PLACE.sub(replacement, text)
