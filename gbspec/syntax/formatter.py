"""The canonical form of a file: spaces, order of clauses, line breaks; comments and meaning are unchanged.

A statement is written on one line if it fits in `WIDTH` columns, unless its author began a line with one of its
clauses: then each clause gets its own line. Longer lines are broken before `+` and `-` and after commas. Clauses are
put in the order of the language's table, except in a statement with comments inside, whose order its author chose.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from gbspec.diagnostics import Defect, Findings, Source, UserError
from gbspec.syntax import ast
from gbspec.syntax.characters import clean
from gbspec.syntax.chunks import split
from gbspec.syntax.limits import too_large
from gbspec.syntax.parser import Parsed, parse, parse_statements
from gbspec.syntax.spacing import Piece, pieces
from gbspec.syntax.transformer import Clause
from gbspec.syntax.walking import same

WIDTH = 100
_INDENT = 4
_ORDER = (
    *(
        "unit",
        "from",
        "consumed",
        "produced",
        "left",
        "contracts",
        "range",
        "categories",
        "bound",
        "postulates",
        "value",
        "learned",
        "steady",
    ),
    *(
        "with",
        "then",
        "file",
        "points",
        "method",
        "outside",
        "interpolation",
        "prior",
        "per_trajectory",
        "rate",
        "noise",
        "over",
        "times",
        "lag",
        *("when", "at", "every", "until", "after", "queue", "priority", "transient", "sampled", "armed", "assignments"),
        "column",
        "network",
        "text",
        "extends",
    ),
)
_RANK = {kind: rank for rank, kind in enumerate(_ORDER)}


def format_text(source: Source) -> str:
    """The text in canonical form; raises `UserError` with all diagnostics if it does not parse.

    The result parses to the same tree, and formatting it again changes nothing.
    """
    findings = Findings()
    large = too_large(source)
    if large is not None:
        raise UserError([large])
    parsed = parse_statements(source, findings)
    findings.raise_if_failed()
    text = _file(source, parsed)
    _check(source, text)
    return text


def _file(source: Source, parsed: Sequence[Parsed]) -> str:
    """The statements and the comments between them, in the order of the text, with at most one empty line between."""
    blocks = [(part.chunk.start, _last(part), statement_lines(part)) for part in parsed]
    for comment in split(source).comments:
        written = source.text[comment.start : comment.end].rstrip()
        blocks.append((comment.start, comment.end, [written]))
    lines: list[str] = []
    previous_end = -1
    for start, end, block in sorted(blocks):
        if previous_end >= 0 and source.text.count("\n", previous_end, start) > 1:
            lines.append("")
        lines.extend(block)
        previous_end = end
    return "\n".join(lines) + "\n" if lines else ""


def _last(part: Parsed) -> int:
    """Where the statement ends, its last comment included."""
    return max([part.chunk.end, *(comment.end for comment in part.chunk.comments)])


def _check(source: Source, text: str) -> None:
    """Checks that the canonical text has the same meaning; raises `Defect` otherwise."""
    again = Source(source.path, text)
    before, after = parse(source, Findings()), parse(again, Findings())
    if not same(before, after):
        raise Defect(f"formatting {source.path} would change its meaning")
    if _comments(source) != _comments(again):
        raise Defect(f"formatting {source.path} would lose a comment")


def _comments(source: Source) -> list[str]:
    layout = split(source)
    found = [*layout.comments, *(comment for chunk in layout.chunks for comment in chunk.comments)]
    return sorted(source.text[comment.start : comment.end].rstrip() for comment in found)


# -------------------------------------------------------------------------------------------------------- one statement


def statement_lines(part: Parsed) -> list[str]:
    """The lines of one statement in canonical form."""
    chunk = part.chunk
    text, _ = clean(chunk)
    if text is None:
        raise Defect("a statement that does not parse cannot be formatted")
    found = pieces(text, chunk.start, part.clauses, chunk.comments, chunk.source.text)
    last, found[-1].after = found[-1].after, ""
    commented = any(piece.above or piece.after for piece in found)
    groups = _groups(found)
    if not commented:
        groups = _ordered(groups, part.clauses, part.statement)
    ordered = [piece for group in groups for piece in group]
    ordered[0].space = False
    broken = any(piece.new_line and _starts_line(piece, part.clauses) for piece in found)
    if not broken and not commented:
        line = _joined(ordered)
        if len(line) <= WIDTH:
            return [_with_comment(line, last)]
    several = (
        sum(part.clauses[index].kind != "unit" for index in {p.clause for p in ordered if p.clause is not None}) > 1
    )
    lines = _lines(ordered, part.clauses, clause_lines=broken or (several and not commented))
    lines[-1] = _with_comment(lines[-1], last)
    return lines


def _groups(found: list[Piece]) -> list[list[Piece]]:
    """The tokens split into head and clauses; tokens between clauses stay with the preceding clause."""
    groups: list[list[Piece]] = [[]]
    for piece in found:
        if piece.first:
            groups.append([])
        groups[-1].append(piece)
    return groups


def _ordered(groups: list[list[Piece]], clauses: Sequence[Clause], statement: ast.Statement) -> list[list[Piece]]:
    """The groups in canonical order, contracts joined by commas; the sides of a process stay with its head."""
    fixed = sum(clause.kind in ("consumed", "produced", "left") for clause in clauses)
    if fixed:
        groups = [[piece for group in groups[: fixed + 1] for piece in group], *groups[fixed + 1 :]]
    head, rest = groups[0], groups[1:]
    rest = sorted(rest, key=lambda group: _rank(clauses[group[0].clause or 0].kind, statement))
    for group, following in pairwise(rest):
        kinds = {clauses[part[0].clause or 0].kind for part in (group, following)}
        if kinds == {"contracts"}:
            group.append(Piece(",", "sign", group[0].clause, False))
            following[0].breakable, following[0].first = True, False
    return [head, *rest]


def _rank(kind: str, statement: ast.Statement) -> float:
    """The rank of a clause in its statement; some statements move a clause directly behind another."""
    after = statement.entry.after.get(kind)
    return _RANK[kind] if after is None else _RANK[after] + 0.5


def _joined(line: Sequence[Piece]) -> str:
    return "".join((" " if piece.space else "") + piece.text for piece in line).lstrip()


def _with_comment(line: str, comment: str) -> str:
    return f"{line}  {comment}" if comment else line


def _lines(ordered: Sequence[Piece], clauses: Sequence[Clause], clause_lines: bool) -> list[str]:
    """A statement on several lines."""
    lines: list[str] = []
    waiting: list[Piece] = []
    before: Piece | None

    def flush(comment: str = "") -> None:
        if waiting:
            deeper = clause_lines and lines and not begins_clause
            indent = 0 if not lines else 2 * _INDENT if deeper else _INDENT
            lines.extend(_filled(waiting, indent, (2 if clause_lines and lines else 1) * _INDENT))
            lines[-1] = _with_comment(lines[-1], comment)
            waiting.clear()

    begins_clause, before = False, None
    for piece in ordered:
        if piece.above or (clause_lines and _starts_line(piece, clauses)):
            flush()
        if not waiting:
            # A contract that follows a comment within a list is indented like the first.
            begins_clause = piece.first or (before is not None and before.text == "," and before.depth == 0)
        before = piece
        lines.extend(" " * _INDENT + comment for comment in piece.above)
        waiting.append(piece)
        if piece.after:
            flush(piece.after)
    flush()
    return lines


def _starts_line(piece: Piece, clauses: Sequence[Clause]) -> bool:
    """Whether a token begins a clause that gets its own line when the statement is broken into clauses."""
    return piece.first and clauses[piece.clause or 0].kind not in (
        "unit",
        "consumed",
        "produced",
        "left",
        "assignments",
    )


def _filled(line: Sequence[Piece], indent: int, hanging: int) -> list[str]:
    """Tokens on as many lines as they need, broken where the fewest brackets are open."""
    lines: list[str] = []
    start = 0
    width = indent
    best: int | None = None
    for index, piece in enumerate(line):
        width += len(piece.text) + piece.space
        if piece.breakable and index > start and (best is None or piece.depth <= line[best].depth):
            best = index
        if width > WIDTH and best is not None:
            lines.append(" " * indent + _joined(line[start:best]))
            start, indent, best = best, hanging, None
            width = hanging + len(_joined(line[start : index + 1]))
    lines.append(" " * indent + _joined(line[start:]))
    return lines
