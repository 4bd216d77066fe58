"""The tokens of a parsed statement, and the spaces between them in the canonical form."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from gbspec.syntax.chunks import Comment
from gbspec.syntax.names import normalise
from gbspec.syntax.transformer import Clause

_TOKEN = re.compile(
    r'(?P<string>"[^"\n]*")'
    r"|(?P<number>(?:[0-9]+(?:\.(?!\.)[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>%|[A-Za-z_\u0080-\U0010ffff][A-Za-z0-9_\u0080-\U0010ffff]*)"
    r"|(?P<sign>\*\*|->|<=|>=|==|\.\.|[-+*/^<>=:,'()\[\]{}~])"
)
_TIGHT = frozenset({"*", "/", "^"})
_WORDS = frozenset({"and", "or", "not"})
# clause keywords that precede an expression
_VALUE_WORDS = frozenset(
    {"rate", "over", "times", "lag", "from", "when", "at", "every", "until", "after", "queue", "priority"}
)


@dataclass
class Piece:
    """A token, its canonical text, whether a space precedes it, and its comments.

    `clause` is the index of its clause in the order of the text (None in the statement's head), `depth` the number of
    brackets around it; `breakable` says that a long line may be broken before it. `above` are the comments on separate
    lines before it, `after` the comment at the end of its line, `new_line` whether it began a line.
    """

    text: str
    kind: str
    clause: int | None
    first: bool
    depth: int = 0
    space: bool = False
    breakable: bool = False
    new_line: bool = False
    above: list[str] = field(default_factory=list)
    after: str = ""


def pieces(text: str, offset: int, clauses: Sequence[Clause], comments: Sequence[Comment], source: str) -> list[Piece]:
    """The tokens of a statement (`text`, comments blanked, at `offset` in `source`) with their canonical spaces."""
    waiting: Iterator[Comment] = iter(comments)
    comment = next(waiting, None)
    found: list[Piece] = []
    above: list[str] = []
    line_end = -1
    for match in _TOKEN.finditer(text):
        start = match.start() + offset
        while comment is not None and comment.start < start:
            written = source[comment.start : comment.end].rstrip()
            if comment.own_line:
                above.append(written)
            else:
                found[-1].after = written
            comment = next(waiting, None)
        index = next((i for i, clause in enumerate(clauses) if clause.span.start <= start < clause.span.end), None)
        first = index is not None and clauses[index].span.start == start
        kind = match.lastgroup or ""
        written = _written(match[0], kind)
        new_line = bool(found) and "\n" in source[line_end:start]
        found.append(Piece(written, kind, index, first, new_line=new_line, above=above))
        above = []
        line_end = match.end() + offset
    if comment is not None and found:
        found[-1].after = source[comment.start : comment.end].rstrip()
    _space(found, clauses)
    return found


def _written(text: str, kind: str) -> str:
    if kind == "name":
        return normalise(text)
    return "^" if text == "**" else text


def _space(found: list[Piece], clauses: Sequence[Clause]) -> None:
    """Decides the space before each token, and where a long line may be broken."""
    brackets: list[str] = []  # kinds of the open brackets: `index`, `options` (of a network) or `plain`
    previous: Piece | None = None
    operand = False  # whether the tokens so far end with an operand, so that a sign after it is an operator
    for piece in found:
        kind = clauses[piece.clause].kind if piece.clause is not None else ""
        unary = piece.text in "+-" and not operand
        if piece.text in (")", "]", "}") and brackets:
            brackets.pop()
        piece.depth = len(brackets)
        inner = brackets[-1] if brackets else ""
        if previous is not None:
            piece.space = (piece.first and kind != "assignments") or _spaced(previous, piece, kind, inner, unary)
            joined = piece.kind == "sign" and piece.text in "+-" and not unary and inner != "index"
            separate = previous.text == "," or joined or piece.text in ("and", "or")
            piece.breakable = piece.space and separate and kind != "unit"
            piece.space = piece.space or _would_merge(previous, piece)
        if piece.text in ("(", "[", "{"):
            brackets.append(_bracket(previous, piece, kind))
        if piece.text == "in" and operand:
            piece.kind = "word"  # what follows is a range or a unit; else it is a name
        operand = (piece.kind in ("number", "name", "string") and not _is_word(piece, kind)) or piece.text in ")]}'"
        if unary:
            piece.kind = "unary"
        previous = piece


def _bracket(previous: Piece | None, piece: Piece, kind: str) -> str:
    if piece.text == "[" and previous is not None and previous.kind == "name" and previous.text != "in":
        return "index"
    return "options" if kind == "network" else "plain"


def _is_word(piece: Piece, kind: str) -> bool:
    """Whether a name is a keyword that is followed by an expression."""
    return piece.text in _WORDS or (piece.first and kind in _VALUE_WORDS)


def _spaced(previous: Piece, piece: Piece, kind: str, inner: str, unary: bool) -> bool:
    """Whether a space separates two tokens of one clause (or of the head)."""
    before, text = previous.text, piece.text
    if before in ("(", "[", "{") or text in (")", "]", "}", ",", "'") or previous.kind == "unary":
        return False
    if before == ",":
        return True
    if ".." in (before, text) or before in _TIGHT or text in _TIGHT:
        return False
    if kind == "unit":
        return before == ":"
    if text == "(":
        return previous.kind != "name" or _is_word(previous, kind)
    if text == "[":
        return previous.kind != "name" or before == "in"
    if inner == "index" or (inner == "options" and "=" in (before, text)):
        return False
    if text == ":" and (piece.clause is None or kind == "assignments") and inner == "":
        return False  # after the name of a process, before the assignments of an event
    return not (unary and before in _TIGHT)


def _would_merge(previous: Piece, piece: Piece) -> bool:
    """Whether two tokens without a space would be read as different ones, e.g. `1.` and `..`."""
    return (previous.text + piece.text[0]).endswith("..") and ".." in (previous.text, piece.text)
