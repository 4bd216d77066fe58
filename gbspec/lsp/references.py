"""Definition, references and renaming of a name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gbspec.diagnostics import Span
from gbspec.lsp.index import DEFAULT_TIME, Occurrence, Symbol, at
from gbspec.lsp.workspace import Parsed, Workspace, key
from gbspec.syntax import REFUSED, ast, is_name, normalise


class Refused(Exception):  # noqa: N818 - a refusal, not an error
    """The requested renaming is impossible; the message gives the reason for the user."""


@dataclass(frozen=True)
class Renaming:
    """The spans to replace, by file, and the new name."""

    places: Mapping[Path, tuple[Span, ...]]
    name: str


def definitions(workspace: Workspace, path: str | Path, offset: int) -> tuple[Span, ...]:
    """The declarations of the name at an offset, in the nearest file of the chain that declares it.

    For the path after `extends`: the beginning of that file. For a declaration that replaces one of an extended file:
    the replaced one, so that repeated requests lead through the chain.
    """
    chain = workspace.chain(path)
    if not chain:
        return ()
    for statement in chain[0].file.statements:
        if isinstance(statement, ast.ModelStatement) and statement.extends is not None and len(chain) > 1:
            span = statement.extends.span
            if span.start <= offset <= span.end:
                return (Span(chain[1].source, 0, 0),)
    here = at(workspace.occurrences(path), offset)
    if here is None:
        return ()
    found = [_declarations(workspace, parsed, here.symbol) for parsed in chain]
    if here.declares:
        found = [*found[1:], found[0]]
    return next((spans for spans in found if spans), ())


def _declarations(workspace: Workspace, parsed: Parsed, symbol: Symbol) -> tuple[Span, ...]:
    everything = workspace.occurrences(parsed.source.path)
    return tuple(o.span for o in everything if o.symbol == symbol and o.declares)


def references(workspace: Workspace, path: str | Path, offset: int) -> tuple[Occurrence, ...]:
    """All references, in all known files of the model, to the name at an offset; none for words of the language."""
    here = at(workspace.occurrences(path), offset)
    if here is None or here.symbol.space in ("word", "code"):
        return ()
    return everywhere(workspace, path, here.symbol)


def everywhere(workspace: Workspace, path: str | Path, symbol: Symbol) -> tuple[Occurrence, ...]:
    """All references to a symbol in the files that share it."""
    return tuple(o for parsed in _family(workspace, path, symbol) for o in _in(workspace, parsed, symbol))


def _in(workspace: Workspace, parsed: Parsed, symbol: Symbol) -> list[Occurrence]:
    return [o for o in workspace.occurrences(parsed.source.path) if o.symbol == symbol]


def _family(workspace: Workspace, path: str | Path, symbol: Symbol) -> tuple[Parsed, ...]:
    """The files that share a symbol: the farthest file of the chain that names it, and all that extend that one."""
    if symbol.space == "model":
        return workspace.chain(path)[:1]
    naming = [parsed for parsed in workspace.chain(path) if _in(workspace, parsed, symbol)]
    return workspace.descendants(naming[-1].source.path) if naming else ()


# ------------------------------------------------------------------------------------------------------------ renaming


def renamable(workspace: Workspace, path: str | Path, offset: int) -> Occurrence:
    """The name to be renamed at an offset; raises `Refused` if the model does not declare it."""
    here = at(workspace.occurrences(path), offset)
    if here is None:
        raise Refused("there is no name here")
    symbol = here.symbol
    if symbol.space in ("word", "code"):
        raise Refused(f"`{symbol.name}` is a word of the language")
    if symbol.space == "unit" and symbol.name not in workspace.names(path).units:
        raise Refused(f"the unit `{symbol.name}` is not declared in the model, so it cannot be renamed")
    if symbol.space == "name" and symbol.name not in workspace.names(path).declared:
        raise Refused(f"`{symbol.name}` is not declared")
    if symbol == Symbol("name", DEFAULT_TIME) and not _declared_in_chain(workspace, path, symbol):
        raise Refused(f"`{symbol.name}` is the time of a model without a `time` statement; write `time tau` first")
    for found in everywhere(workspace, path, symbol):
        table = found.statement if found.declares else None
        if isinstance(table, ast.TableStatement) and table.file is not None:
            raise Refused(f"`{symbol.name}` is the name of a column in the file of the table `{table.name.text}`")
    return here


def _declared_in_chain(workspace: Workspace, path: str | Path, symbol: Symbol) -> bool:
    return any(_declarations(workspace, parsed, symbol) for parsed in workspace.chain(path))


def rename(workspace: Workspace, path: str | Path, offset: int, name: str) -> Renaming:
    """The edits that rename the name at an offset in every file that uses it.

    Raises `Refused` if the new name is malformed, in use, or would resolve to another symbol at one of its places:
    after the edits every place must refer to the same symbol as before.
    """
    symbol = renamable(workspace, path, offset).symbol
    new = normalise(name)
    family = _family(workspace, path, symbol)
    _check_name(workspace, family, symbol, new)
    places: dict[Path, tuple[Span, ...]] = {}
    for parsed in family:
        found = _in(workspace, parsed, symbol)
        if symbol.name in parsed.file.uncertain:
            raise Refused(f"a statement in `{Path(parsed.source.path).name}` that names `{symbol.name}` cannot be read")
        if symbol.space == "argument" and any(o.implied for o in found):
            bare = next(o.span.text for o in found if o.implied)
            raise Refused(
                f"`{bare}` is implicitly applied to `{symbol.name}`; write its arguments in parentheses first"
            )
        spans = tuple(dict.fromkeys(o.span for o in found if not o.implied))
        if spans:
            places[key(parsed.source.path)] = spans
    renaming = Renaming(places, name)
    if new != symbol.name:
        _same_meaning(workspace, family, renaming)
    return renaming


def _check_name(workspace: Workspace, family: Sequence[Parsed], symbol: Symbol, new: str) -> None:
    if not is_name(new):
        raise Refused(f"`{new}` is not a name: letters of any script, digits and `_`, not beginning with a digit")
    if symbol.space == "unit":
        if any(new in workspace.names(p.source.path).units for p in family) and new != symbol.name:
            raise Refused(f"there is already a unit `{new}`")
        return
    if symbol.space == "model":
        return
    if new in REFUSED:
        raise Refused(f"`{new}` is a word of the language and cannot be a name")
    if new in ast.WORDS and _is_state(family, symbol):
        raise Refused(f"`{new}` begins a statement, so that a state cannot have this name")
    if symbol.space == "name" and new != symbol.name:
        for parsed in family:
            names = workspace.names(parsed.source.path)
            if new in names.declared:
                where = Path(parsed.source.path).name
                raise Refused(f"`{new}` is already declared, in `{where}` or a file that it extends")


def _is_state(family: Sequence[Parsed], symbol: Symbol) -> bool:
    statements = (s for parsed in family for s in parsed.file.statements)
    return any(isinstance(s, ast.StateStatement) and s.declarator.name.text == symbol.name for s in statements)


def _same_meaning(workspace: Workspace, family: Sequence[Parsed], renaming: Renaming) -> None:
    """Raises `Refused` if after the edits a place refers to another symbol, or a statement cannot be parsed."""
    texts = {path: replaced(spans, renaming.name) for path, spans in renaming.places.items()}
    trial = workspace.with_texts(texts)
    for parsed in family:
        path = parsed.source.path
        after = trial.parsed(path)
        if after is None or (after.broken and not parsed.broken):
            raise Refused(f"`{renaming.name}` would not be parsed as a name at all of its places")
        if _shape(workspace.occurrences(path)) != _shape(trial.occurrences(path)):
            raise Refused(f"`{renaming.name}` has another meaning at one of its places")
        if _lending(workspace, parsed) != _lending(trial, parsed):
            raise Refused(f"in `{Path(path).name}` a contract would use the range of another quantity")


def _lending(workspace: Workspace, parsed: Parsed) -> list[tuple[bool, ...]]:
    """Whether each argument of the unknowns in a file's scope takes the range of the quantity of the same name."""
    names = workspace.names(parsed.source.path)
    return [tuple(a in names.lent[output] for a in formals) for output, (_, formals) in names.arguments.items()]


def replaced(spans: Sequence[Span], name: str) -> str:
    """A file's text with the name substituted at the given spans."""
    text = spans[0].source.text
    for span in sorted(spans, key=lambda s: -s.start):
        text = text[: span.start] + name + text[span.end :]
    return text


def _shape(found: Sequence[Occurrence]) -> list[tuple[int, bool, bool]]:
    """The pattern of references: for each place the index of the first with the same symbol."""
    first: dict[Symbol, int] = {}
    return [(first.setdefault(o.symbol, i), o.declares, o.implied) for i, o in enumerate(found)]
