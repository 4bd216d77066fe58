"""Signature help: the call around the cursor, its parameters, and which of them is being written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gbspec.ir import NOISES
from gbspec.lsp import words
from gbspec.lsp.hover import declaration
from gbspec.lsp.workspace import Parsed, Workspace
from gbspec.syntax import ast, inert, statement_before

_CALLED = re.compile(r"([^\W\d]\w*)\s*\Z")
_DECLARES = re.compile(r"\s*(?:unknown|function|table)\s[^(]*\Z")
_TEXT = re.compile(r'"[^"\n]*"?')
_OPENING, _CLOSING = "([", ")]"

_SPECIAL: dict[tuple[str, str], str] = {
    ("prior", "normal"): "normal(mean, sd)",
    ("prior", "lognormal"): "lognormal(median, cv)",
    **{("noise", kind): form.signature for kind, form in NOISES.items() if form.parameters},
    ("by", "mlp"): "mlp(width, …, activation=silu)",
}
"""Words that are called after a clause's keyword."""


@dataclass(frozen=True)
class Signature:
    """A call: its `label`, the places of its parameters in it, Markdown about it, and the index of the current one."""

    label: str
    parameters: tuple[tuple[int, int], ...]
    documentation: str
    active: int


def signature(workspace: Workspace, path: str | Path, offset: int) -> Signature | None:
    """The call around an offset; None outside of calls, in a text, and for what nothing declares."""
    parsed = workspace.parsed(path)
    if parsed is None or inert(parsed.source, offset):
        return None
    before = _TEXT.sub(lambda found: " " * len(found[0]), statement_before(parsed.source, offset))
    opened = _opened(before)
    if opened is None:
        return None
    place, active = opened
    called = _CALLED.search(before, 0, place)
    if called is None or _DECLARES.match(before[:place]):
        return None
    found = _usage(workspace.chain(path), called[1], before[: called.start()])
    return None if found is None else _made(*found, active)


def _opened(before: str) -> tuple[int, int] | None:
    """The place of the innermost parenthesis that is still open, and the number of commas since then."""
    commas = depth = 0
    for place in range(len(before) - 1, -1, -1):
        character = before[place]
        if character in _CLOSING:
            depth += 1
        elif character in _OPENING and depth:
            depth -= 1
        elif character == "(":
            return place, commas
        elif character == "[":
            return None
        elif character == "," and not depth:
            commas += 1
    return None


def _usage(chain: Sequence[Parsed], name: str, before: str) -> tuple[str, str] | None:
    """How a name is called, and what is said of it."""
    declaring = next((s for p in chain for s in p.file.statements if any(n.text == name for n in s.declares())), None)
    match declaring:
        case ast.UnknownStatement():
            formals = ", ".join(argument.name.text for argument in declaring.arguments)
            return f"{name}({formals})", declaration(declaring, declaring.entry.role)
        case ast.FunctionStatement() | ast.TableStatement():
            formals = ", ".join(formal.text for formal in declaring.formals())
            return f"{name}({formals})", declaration(declaring, declaring.entry.role)
        case None:
            pass
        case _:
            return None
    if name in words.FUNCTIONS:
        return words.FUNCTIONS[name]
    if name == "if":
        return "if(condition, a, b)", words.OPERATORS["if"]
    clause = before.split()[-1] if before.split() else ""
    usage = _SPECIAL.get((clause, name))
    return None if usage is None else (usage, words.meaning(name))


def _made(usage: str, documentation: str, active: int) -> Signature:
    """The signature of a usage such as `atan2(y, x)`; what is repeated (`…`) is the last parameter for ever."""
    start = usage.index("(") + 1
    places, names = [], usage[start:-1].split(", ")
    for name in names:
        places.append((start, start + len(name)))
        start += len(name) + 2
    if "…" in names:
        active = min(active, names.index("…"))
    return Signature(usage, tuple(places), documentation, active)
