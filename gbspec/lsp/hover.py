"""Hover: the description of the name under the cursor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import dedent

from gbspec.diagnostics import Span, UserError
from gbspec.lsp import words
from gbspec.lsp.index import DEFAULT_TIME, Occurrence, Symbol, at, home
from gbspec.lsp.workspace import Parsed, Workspace
from gbspec.syntax import Key, ast, target_name

_MAX_LINES = 12


@dataclass(frozen=True)
class Hover:
    """Markdown, and the span of the text that it describes."""

    markdown: str
    span: Span


def hover(workspace: Workspace, path: str | Path, offset: int, values: Mapping[str, float]) -> Hover | None:
    """The description of the name or word at an offset; `values` are those of the constants, as far as known."""
    here = at(workspace.occurrences(path), offset)
    if here is None:
        return _word(workspace, path, offset)
    text = _describe(workspace, path, here, values)
    return Hover(text, here.span) if text else None


def _describe(workspace: Workspace, path: str | Path, here: Occurrence, values: Mapping[str, float]) -> str:
    symbol = here.symbol
    match symbol.space:
        case "word":
            return word(symbol.name)
        case "code":
            return code(symbol.name)
        case "argument":
            return f"`{symbol.name}`: argument, local to this statement" + _formal(workspace.chain(path), symbol)
        case "model":
            return declaration(here.statement, "model")
        case "unit":
            return _unit(workspace.chain(path), symbol)
        case "name":
            return name(workspace.chain(path), symbol.name, values)


def name(chain: Sequence[Parsed], wanted: str, values: Mapping[str, float]) -> str:
    """The description of a model's name: declaration, role, description, value, and statements about it."""
    declaring = _declaring(chain, wanted)
    if declaring is None:
        return f"`{wanted}`: the time" if wanted == DEFAULT_TIME else ""
    statement, parsed = declaring
    parts = [declaration(statement, statement.entry.role)]
    if wanted in values:
        parts.append(f"value: {values[wanted]:.6g}")
    about = [_code(s) for s in _about(chain, wanted) if s is not statement]
    if about:
        parts.append(_fenced("\n".join(about)))
    if parsed is not chain[0]:
        parts.append(f"declared in `{Path(parsed.source.path).name}`")
    return "\n\n".join(parts)


def declaration(statement: ast.Statement, role: str) -> str:
    """The text of a statement, the role of the name that it declares, and its description."""
    text = getattr(statement, "description", None) or getattr(statement, "title", None)
    said = f": {text.value}" if isinstance(text, ast.Text) and text.value else ""
    details = _details(statement)
    line = f"*{role}*{said}" if role else said.removeprefix(": ")
    return "\n\n".join(part for part in (_fenced(_code(statement)), line, details) if part)


def word(text: str) -> str:
    """A word of the language and its meaning."""
    if text in words.FUNCTIONS:
        usage, meaning = words.FUNCTIONS[text]
        return f"`{usage}`: {meaning}"
    meaning = words.meaning(text)
    if not meaning:
        from gbspec.semantics import ACTIVATIONS

        meaning = "an activation of a network" if text in ACTIVATIONS else ""
    return f"`{text}`: {meaning}" if meaning else ""


def code(text: str) -> str:
    """The title and explanation of a code of the catalogue."""
    from gbspec.diagnostics import explain

    try:
        entry = explain(text)
    except UserError:
        return ""
    return f"**{entry.code}**: {entry.title}\n\n{entry.explanation}"


def _word(workspace: Workspace, path: str | Path, offset: int) -> Hover | None:
    """The hover for a keyword at the offset, outside strings and comments."""
    from gbspec.syntax import word_at

    parsed = workspace.parsed(path)
    span = word_at(parsed.source, offset) if parsed is not None else None
    text = word(span.text) if span is not None else ""
    return Hover(text, span) if span is not None and text else None


def _declaring(chain: Sequence[Parsed], wanted: str) -> tuple[ast.Statement, Parsed] | None:
    for parsed in chain:
        for statement in parsed.file.statements:
            if any(n.text == wanted for n in statement.declares()):
                return statement, parsed
    return None


def _about(chain: Sequence[Parsed], wanted: str) -> list[ast.Statement]:
    """The statements about a name (its balance, initial value, …), each from the nearest file that has it."""
    found: dict[Key, ast.Statement] = {}
    for parsed in chain:
        for statement in parsed.file.statements:
            if isinstance(statement, ast.About) and target_name(statement.target).text == wanted:
                found.update({key: statement for key in statement.replaces() if key not in found})
    return sorted(found.values(), key=lambda s: ast.STATEMENTS.index(type(s)))


def _details(statement: ast.Statement) -> str:
    """The unit and range as text."""
    parts = []
    unit = getattr(statement, "unit", None)
    if isinstance(unit, ast.Node):
        parts.append(f"unit `{unit.span.text}`")
    for one in getattr(statement, "units", ()):
        parts.append(f"unit `{one.span.text}`")
    interval = getattr(statement, "range", None)
    if isinstance(interval, ast.Interval):
        parts.append(f"range {interval.low.span.text} to {interval.high.span.text}")
    return ", ".join(parts)


def _formal(chain: Sequence[Parsed], symbol: Symbol) -> str:
    """The unit and range of an unknown's argument."""
    statements = (s for parsed in chain for s in parsed.file.statements if isinstance(s, ast.UnknownStatement))
    owner = next((s for s in statements if home(s) == symbol.home), None)
    arguments = owner.arguments if owner is not None else ()
    details = next((_details_of(a) for a in arguments if a.name.text == symbol.name), "")
    return f"; {details}" if details else ""


def _details_of(argument: ast.Argument) -> str:
    parts = [f"unit `{argument.unit.span.text}`"] if argument.unit is not None else []
    if argument.range is not None:
        parts.append(f"range {argument.range.low.span.text} to {argument.range.high.span.text}")
    return ", ".join(parts)


def _unit(chain: Sequence[Parsed], symbol: Symbol) -> str:
    for parsed in chain:
        for statement in parsed.file.statements:
            if isinstance(statement, ast.UnitStatement) and statement.name.text == symbol.name:
                return declaration(statement, "unit of this model")
    return f"`{symbol.name}`: a unit"


def _code(statement: ast.Statement) -> str:
    """A statement's text, truncated if it is long."""
    first, *rest = statement.span.text.splitlines() or [""]
    lines = [first, *(f"    {line}" if line.strip() else line for line in dedent("\n".join(rest)).splitlines())]
    return "\n".join(lines if len(lines) <= _MAX_LINES else [*lines[:_MAX_LINES], "    …"])


def _fenced(text: str) -> str:
    return f"```gb\n{text}\n```"
