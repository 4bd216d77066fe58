"""Completion: statements, clauses, names in scope, functions, units."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

from gbspec.diagnostics import Source
from gbspec.lsp import words
from gbspec.lsp.index import DEFAULT_TIME
from gbspec.lsp.workspace import Parsed, Workspace
from gbspec.semantics import ACTIVATIONS
from gbspec.syntax import VALUES, Expected, Kind, ast, expected, inert, statement_before

Sort = Literal["keyword", "name", "function", "unit", "value", "file"]

_WORD_BEFORE = re.compile(r"(?:[^\W\d]\w*)?\Z")
_PARAMETERS = re.compile(r"\s*(?:function|table|truth|unknown)\s+[^(]*\(([^)]*)\)")
_OUTPUTS = re.compile(r"\s*unknown\s+([^(]*)\(")
_FORMAL = re.compile(r"(?:^|,)\s*([^\W\d]\w*)")
_EXTENDS = re.compile(r'\bextends\s+"([^"\n]*)\Z')
_POINTS = re.compile(r'\btable\s[^"\n]*\bfrom\s+"([^"\n]*)\Z')
_MOST_FILES = 200
_UNITS = ("s", "min", "h", "day", "g", "kg", "mg", "L", "mL", "m", "cm", "mol", "mmol", "K", "degC", "Pa", "bar", "J")
"""Frequent units; every unit of pint is accepted."""

_ABOUT = {s.entry.word.upper(): s.entry.about for s in ast.STATEMENTS if s.entry.about}
"""The kinds of names that may follow a keyword, by its terminal in the grammar."""


@dataclass(frozen=True)
class Candidate:
    """One possible word; `start` is where the word before the cursor begins, which it replaces."""

    text: str
    kind: Sort
    detail: str = ""
    documentation: str = ""


def completions(workspace: Workspace, path: str | Path, offset: int) -> tuple[int, list[Candidate]]:
    """The offset at which the incomplete word begins, and the candidates for it."""
    parsed = workspace.parsed(path)
    if parsed is None:
        return offset, []
    source = parsed.source
    found = _WORD_BEFORE.search(source.text, 0, offset)
    start = found.start() if found is not None else offset
    if inert(source, offset):
        return _files(source, offset)
    before = statement_before(source, start)
    chain = workspace.chain(path)
    if not before.strip():
        return start, [*_statements(), *_names(chain, {Kind.STATE})]
    what = expected(before)
    if what is None:
        return start, list(_expression(chain, before))
    return start, list(_next(chain, before, what))


def _statements() -> list[Candidate]:
    entries = (kind.entry for kind in ast.STATEMENTS if kind.entry.spelled)
    return [Candidate(entry.word, "keyword", entry.meaning, entry.example) for entry in entries]


def _next(chain: Sequence[Parsed], before: str, what: Expected) -> Iterator[Candidate]:
    """The candidates that the grammar accepts after the beginning of a statement."""
    last = what.read[-1][0] if what.read else ""
    first = what.read[0][0] if what.read else ""
    if "NAME" in what.terminals:
        if "IF" in what.terminals:
            yield from _value(chain, before, what)
        elif last == "PRIOR":
            yield from _words(words.DISTRIBUTIONS)
        elif last == "NOISE":
            yield from _words({**words.DISTRIBUTIONS, **words.NOISES})
        elif last == "BY":
            yield from _words(words.NETWORKS)
        elif _in_unit(what):
            yield from _units(chain)
        elif first in _ABOUT and len(what.read) == 1:
            yield from _names(chain, _ABOUT[first])
        elif first == "WITHOUT":
            yield from (c for c in _statements() if len(what.read) == 1 and c.text not in ("model", "allow", "without"))
            yield from _names(chain, set(Kind))
        elif first == "ALLOW":
            yield from _warnings() if len(what.read) == 1 else _names(chain, set(Kind))
        elif last == "IN" or last == "AT":
            yield from _formals(before)
        elif "ZERO" in what.terminals and last == "COMMA":
            yield from _outputs(before)
    written = set() if first in ("", "UNKNOWN") else {text for _, text in what.read}
    for keyword in what.keywords:
        if keyword not in written or keyword in words.OPERATORS:
            yield Candidate(keyword, "keyword", words.CLAUSES.get(keyword, "") or words.OPERATORS.get(keyword, ""))


def _value(chain: Sequence[Parsed], before: str, what: Expected) -> Iterator[Candidate]:
    """The candidates within an expression, or the options among a network's arguments."""
    pair = tuple(kind for kind, _ in what.read[-2:])
    if pair == ("NAME", "EQUAL") and what.read[-2][1] == "activation":
        yield from (Candidate(word, "value", "an activation of a network") for word in ACTIVATIONS)
        return
    if any(kind == "BY" for kind, _ in what.read):
        yield from _words(words.OPTIONS)
    yield from _expression(chain, before)


def _expression(chain: Sequence[Parsed], before: str) -> Iterator[Candidate]:
    """Names with a value, functions, and the names local to this statement."""
    yield from _formals(before)
    yield from _names(chain, VALUES)
    if not any(isinstance(s, ast.TimeStatement) for parsed in chain for s in parsed.file.statements):
        yield Candidate(DEFAULT_TIME, "name", "the time")
    for function, (usage, meaning) in words.FUNCTIONS.items():
        yield Candidate(function, "function", usage, meaning)
    yield Candidate("pi", "value", words.VALUES["pi"])
    if before.lstrip().startswith("unknown"):
        yield Candidate("nn", "value", words.VALUES["nn"])


def _formals(before: str) -> Iterator[Candidate]:
    """The arguments that an incomplete statement has declared so far."""
    found = _PARAMETERS.match(before)
    if found is not None:
        for formal in dict.fromkeys(_FORMAL.findall(found[1])):
            yield Candidate(formal, "name", "argument")


def _outputs(before: str) -> Iterator[Candidate]:
    """The outputs that an incomplete `unknown` declares, for its contracts."""
    found = _OUTPUTS.match(before)
    if found is not None:
        yield from (Candidate(name.strip(), "function", "an output of this unknown") for name in found[1].split(","))


def _names(chain: Sequence[Parsed], kinds: Container[Kind | None]) -> Iterator[Candidate]:
    """The names of the given kinds, the nearest declaration of each."""
    seen: set[str] = set()
    for parsed in chain:
        for statement in parsed.file.statements:
            if statement.entry.kind in kinds:
                for declared in statement.declares():
                    if declared.text not in seen:
                        seen.add(declared.text)
                        yield _name(declared.text, statement)


def _name(text: str, statement: ast.Statement) -> Candidate:
    description = getattr(statement, "description", None)
    said = f": {description.value}" if isinstance(description, ast.Text) else ""
    function = isinstance(statement, ast.FunctionStatement | ast.TableStatement | ast.UnknownStatement)
    return Candidate(text, "function" if function else "name", statement.entry.role.split(",")[0] + said)


def _units(chain: Sequence[Parsed]) -> Iterator[Candidate]:
    for parsed in chain:
        for statement in parsed.file.statements:
            if isinstance(statement, ast.UnitStatement):
                said = statement.description.value if statement.description is not None else "unit of this model"
                yield Candidate(statement.name.text, "unit", said)
    yield from (Candidate(unit, "unit") for unit in _UNITS)


def _in_unit(what: Expected) -> bool:
    """Whether a unit comes next: the grammar allows a number or a parenthesis there, but not `if`."""
    return {"NAME", "NUMBER", "LPAR"} <= what.terminals and "IF" not in what.terminals


def _words(table: Mapping[str, str]) -> Iterator[Candidate]:
    return (Candidate(word, "value", meaning) for word, meaning in table.items())


def _warnings() -> Iterator[Candidate]:
    from gbspec.diagnostics import entries

    return (Candidate(entry.code, "value", entry.title) for entry in entries().values() if entry.code.startswith("GB4"))


def _files(source: Source, offset: int) -> tuple[int, list[Candidate]]:
    """Inside a string: after `extends` the models in the same folder, after `from` of a table the files of points."""
    line_start = source.text.rfind("\n", 0, offset) + 1
    model = _EXTENDS.search(source.text, line_start, offset)
    points = _POINTS.search(source.text, line_start, offset)
    found = model or points
    if found is None:
        return offset, []
    own = Path(source.path)
    try:
        if model is not None:
            names = sorted(p.name for p in own.parent.glob("*.gb") if p.name != own.name)
        else:
            below = (
                p for end in ("csv", "tsv", "txt") for level in ("*.", "*/*.") for p in own.parent.glob(level + end)
            )
            names = sorted(p.relative_to(own.parent).as_posix() for p in islice(below, _MOST_FILES))
    except OSError:
        return offset, []
    return found.start(1), [Candidate(file, "file") for file in names]
