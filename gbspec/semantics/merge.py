"""`extends` and `without`: several files become the statements of one model.

What a file declares replaces what its base declared under the same name; balances, `initial`, `observe`, `dose` and
`truth` replace those of the same kind and target. A replacement takes the position of the statement it
replaces, so that the order of states does not change; everything new comes last. `without NAME` removes a declaration
together with the statements about it alone (its balance, initial value, observation, dose, truth).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gbspec.diagnostics import Findings, Source, Span, UserError
from gbspec.semantics.rewriting import converts
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import MOST_SIGNS, Key, ast, children, refused, signs

_UNITS = (ast.UnitName, ast.UnitNumber, ast.UnitBinary)

Load = Callable[[Path], Source]
N = TypeVar("N", bound=ast.Node)

TARGETED = frozenset(kind.entry.word for kind in ast.STATEMENTS if issubclass(kind, ast.About))
"""Kinds of statements that are about a name which another statement declares."""


@dataclass(frozen=True)
class Item:
    """A statement of the model, and its text."""

    statement: ast.Statement
    text: str


@dataclass(frozen=True)
class Merged:
    """The statements of a model after `extends`.

    `complete` is False if a base could not be read; `uncertain` are names in statements that could not be parsed,
    `arrays` names of arrays (after expansion only their elements are names), `in_indices` names in their indices.
    """

    items: tuple[Item, ...]
    complete: bool = True
    uncertain: frozenset[str] = frozenset()
    arrays: frozenset[str] = frozenset()
    in_indices: frozenset[str] = frozenset()

    def lacks(self, name: str) -> bool:
        """Whether a name that is not found is certainly undeclared (no unreadable statement could declare it)."""
        return self.complete and name not in self.uncertain and name not in self.arrays


def names_a_unit(items: Iterable[Item]) -> bool:
    """Whether a model names any unit, but for that of the time: alone it says how to read times, and no more."""
    items = [item for item in items if not isinstance(item.statement, ast.TimeStatement)]
    return any(
        isinstance(item.statement, ast.UnitStatement)
        or any(isinstance(part, _UNITS) for part in children(item.statement))
        or converts(item.statement)
        or (
            isinstance(item.statement, ast.UnknownStatement | ast.TableStatement)
            and any(a.unit for a in item.statement.arguments)
        )
        for item in items
    )


def merge(file: ast.File, findings: Findings, load: Load) -> Merged:
    """Reads the files that this one extends, nearest first, and merges them, farthest first."""
    files, complete = _chain(file, findings, load)
    items: list[Item] = []
    for position, current in enumerate(reversed(files)):
        own = [Item(s, s.span.text) for s in current.statements if not isinstance(s, ast.WithoutStatement)]
        removals = [s for s in current.statements if isinstance(s, ast.WithoutStatement)]
        extends = position > 0 or not complete
        items = _removed(items, removals, findings, extends=extends, complete=complete and not current.uncertain)
        items = _replaced(items, own)
    uncertain = frozenset().union(*(current.uncertain for current in files))
    return Merged(tuple(_without_extends(item) for item in items), complete, uncertain)


def _without_extends(item: Item) -> Item:
    statement = item.statement
    if not isinstance(statement, ast.ModelStatement) or statement.extends is None:
        return item
    title = f" {statement.title.span.text}" if statement.title is not None else ""
    return Item(statement, f"model {statement.name.text}{title}")


# --------------------------------------------------------------------------------------------------------- the files


def _chain(file: ast.File, findings: Findings, load: Load) -> tuple[list[ast.File], bool]:
    """The file, what it extends, what that extends, …; False if one of them could not be read."""
    from gbspec.syntax import parse

    files = [file]
    seen = [_identity(Path(file.span.source.path))]
    size = signs(file.span.source)
    while True:
        current = files[-1]
        string = next((s.extends for s in current.statements if isinstance(s, ast.ModelStatement) and s.extends), None)
        if string is None:
            return files, True
        path = _base_path(current, string, findings)
        if path is None:
            return files, False
        if _identity(path) in seen:
            circle = [*seen[seen.index(_identity(path)) :], _identity(path)]
            findings.error(
                "GB211",
                "a model extends itself: " + " -> ".join(f"`{step.name}`" for step in circle),
                string.span,
                label="this closes the cycle",
                help="move the common part to a separate file that extends nothing",
            )
            return files, False
        source = _load(path, string, findings, load)
        size += signs(source) if source is not None else 0
        if source is not None and size > MOST_SIGNS:
            what = f"a model and those that it extends have {size:,} words and signs; at most {MOST_SIGNS:,} are read"
            findings.add(refused(source.path, what))
            return files, False
        parsed = parse(source, findings) if source is not None else None
        if parsed is None:
            return files, False
        files.append(parsed)
        seen.append(_identity(path))


def _identity(path: Path) -> Path:
    return path.resolve()


def _base_path(file: ast.File, string: ast.Text, findings: Findings) -> Path | None:
    folder = Path(file.span.source.path).parent
    path = folder / string.value
    inside = not Path(string.value).is_absolute() and _identity(path).is_relative_to(_identity(folder))
    if string.value and inside and _identity(path) != _identity(folder):
        return path
    findings.error(
        "GB210",
        f"the path `{string.value}` leaves the folder of this file" if string.value else "the path is empty",
        string.span,
        label="must name a file in or below the folder of this file",
        help='write the path relative to this file, as in `extends "base.gb"` or `extends "parts/base.gb"`',
    )
    return None


def _load(path: Path, string: ast.Text, findings: Findings, load: Load) -> Source | None:
    try:
        return load(path)
    except UserError as error:
        inside = [d for d in error.diagnostics if isinstance(d.place, Span)]
        if inside:  # the file exists, and something in it cannot be read
            findings.extend(inside)
            return None
        reason, help_ = "; ".join(d.message for d in error.diagnostics), error.diagnostics[0].help
    except FileNotFoundError:
        near = sorted(p.name for p in path.parent.glob("*.gb")) if path.parent.is_dir() else []
        reason, help_ = "there is no such file", suggestion(path.name, near)
    except UnicodeDecodeError:
        reason, help_ = "it is not UTF-8 text", "save the file as UTF-8"
    except OSError as error:
        reason, help_ = error.strerror or type(error).__name__, ""
    findings.error("GB209", f"cannot read `{string.value}`: {reason}", string.span, label="extended here", help=help_)
    return None


# ----------------------------------------------------------------------------------------------- replacing and removing


def _replaced(base: Sequence[Item], own: Sequence[Item]) -> list[Item]:
    """The base with statements replaced by those of `own` under the same keys, then the rest of `own`."""
    newest: dict[Key, list[int]] = {}
    for i, item in enumerate(own):
        for key in item.statement.replaces():
            newest.setdefault(key, []).append(i)
    placed: set[int] = set()
    result: list[Item] = []
    for item in base:
        theirs = item.statement.replaces()
        gone = [key for key in theirs if key in newest]
        if not gone:
            result.append(item)
            continue
        if len(gone) < len(theirs):
            result.append(_cut_outputs(item, {name for _, name in gone}))
        for i in sorted(i for key in gone for i in newest[key]):
            if i not in placed:
                placed.add(i)
                result.append(own[i])
    return result + [item for i, item in enumerate(own) if i not in placed]


def _removed(
    base: list[Item],
    removals: Sequence[ast.WithoutStatement],
    findings: Findings,
    *,
    extends: bool,
    complete: bool,
) -> list[Item]:
    for removal in removals:
        kept = _remove(base, removal)
        if kept is None:
            if complete or not extends:
                _nothing_to_remove(base, removal, findings, extends=extends)
            continue
        base = kept
    return base


def _remove(base: list[Item], removal: ast.WithoutStatement) -> list[Item] | None:
    """The base without the named statement; None if it has no such statement."""
    name = removal.name.text
    kind = removal.kind.text if removal.kind is not None else None
    found = False
    kept: list[Item] = []
    for item in base:
        statement = item.statement
        own = statement.replaces()
        about = any(k in TARGETED and target.split("[")[0] == name for k, target in own)
        if kind in TARGETED or kind == "time":
            hit = any(k == kind and (target == name or kind == "time") for k, target in own)
        elif ("name", name) in own and kind in (None, statement.entry.word):
            hit = True
            if len(own) > 1:
                kept.append(_cut_outputs(item, {name}))
        elif isinstance(statement, ast.EquationStatement):
            hit = kind is None and about
        elif isinstance(statement, ast.UnitStatement):
            hit = kind == "unit" and statement.name.text == name
        else:
            measures = isinstance(statement, ast.ObserveStatement) and statement.value is not None
            if kind is None and about:  # removed with its name; a channel with an expression is found by its own name
                found = found or measures
                continue
            hit = False
        found = found or hit
        if not hit:
            kept.append(item)
    return kept if found else None


def _nothing_to_remove(
    base: Sequence[Item], removal: ast.WithoutStatement, findings: Findings, *, extends: bool
) -> None:
    what = f"{removal.kind.text} {removal.name.text}" if removal.kind is not None else removal.name.text
    if not extends:
        findings.error(
            "GB212",
            f"there is nothing that `without {what}` could remove, since this file extends no other",
            removal.span,
            help='`without` removes what comes from a base: `model NAME extends "base.gb"`; here, delete the statement',
        )
        return
    names = [target for item in base for _, target in item.statement.replaces()]
    findings.error(
        "GB212",
        f"there is nothing that `without {what}` could remove",
        removal.name.span,
        label="the extended model has no such statement",
        help=suggestion(removal.name.text, names),
    )


def _cut_outputs(item: Item, gone: Iterable[str]) -> Item:
    """The declaration of several outputs of a network without some of them, in the tree and in the text."""
    statement = item.statement
    if not isinstance(statement, ast.UnknownStatement):
        return item
    out = set(gone)
    keep = [name.text not in out for name in statement.names]
    cuts: list[Span] = []
    names = _cut(statement.names, keep, cuts)
    units = _cut(statement.units, keep, cuts) if len(statement.units) == len(keep) > 1 else statement.units
    posts = statement.postulates
    posts = _cut(posts, keep, cuts) if len(posts) == len(keep) > 1 else posts
    stays = [contract.name is None or contract.name.text not in out for contract in statement.contracts]
    contracts = _cut(statement.contracts, stays, cuts)
    offset = statement.span.start
    text = item.text
    for span in sorted(cuts, key=lambda s: -s.start):
        text = text[: span.start - offset] + text[span.end - offset :]
    changed = dataclasses.replace(statement, names=names, units=units, postulates=posts, contracts=contracts)
    return Item(changed, text)


def _cut(parts: tuple[N, ...], keep: Sequence[bool], cuts: list[Span]) -> tuple[N, ...]:
    """The parts that are kept; the separator next to a removed part is removed too."""
    first_kept = next((i for i, stays in enumerate(keep) if stays), None)
    for i, (part, stays) in enumerate(zip(parts, keep, strict=True)):
        if stays:
            continue
        start, end = part.span.start, part.span.end
        if first_kept is not None and i > first_kept:
            start = _past_separator(part.span.source, parts[i - 1].span.end, start, nearest=parts[i - 1].span.end)
        elif i + 1 < len(parts):
            end = _past_separator(part.span.source, end, parts[i + 1].span.start, nearest=parts[i + 1].span.start)
        cuts.append(Span(part.span.source, start, end))
    return tuple(part for part, stays in zip(parts, keep, strict=True) if stays)


def _past_separator(source: Source, start: int, end: int, *, nearest: int) -> int:
    """The far end of the comma between two neighbours; the near end if there is something else between them."""
    between = source.text[start:end]
    if between.strip() in ("", ","):
        return nearest
    return start if nearest == end else end
