"""From text to a syntax tree: one statement at a time, so that an error in one does not hide errors in others."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, cast

from lark import Token
from lark.exceptions import UnexpectedInput, UnexpectedToken

from gbspec.diagnostics import Diagnostic, Findings, Label, Source, Span
from gbspec.syntax import ast
from gbspec.syntax.characters import clean
from gbspec.syntax.chunks import Chunk, Comment, split
from gbspec.syntax.grammar import engine
from gbspec.syntax.kinds import Kind
from gbspec.syntax.limits import MOST_ERRORS, too_large
from gbspec.syntax.mistakes import Slip, explain_slip, where
from gbspec.syntax.names import normalise
from gbspec.syntax.reading import read_source
from gbspec.syntax.transformer import Clause

__all__ = ["Parsed", "parse", "parse_expression", "parse_statements", "read_source"]

_WORD = re.compile(r"[^\W\d]\w*")
_HEAD = re.compile(rf"\s*({'|'.join(ast.WORDS)})\s+([^\W\d]\w*)")
_BEGINS_STATEMENT = re.compile(rf"({'|'.join(ast.WORDS)})[ \t]+[^\W\d]|[^\W\d]\w*[ \t]*(\[[^\]\n]*\][ \t]*)?'[ \t]*=")
_BRACKET = re.compile(r'"[^"\n]*"|[()\[\]]')
_DECLARING = frozenset(s.entry.word for s in ast.STATEMENTS if s.entry.kind not in (None, Kind.CHANNEL))
_MAX_JOINED = 20  # lines that are joined one by one; lines inside open brackets are joined at once
_MAX_INSIDE = 500


@dataclass(frozen=True)
class Parsed:
    """The result of parsing one statement: the tree, its clauses in the order of the text, and its diagnostics.

    A tree with problems has the intended meaning despite an error in the text (a typographic sign, a line that should
    be indented). `ended_early`: the statement is incomplete; `stopped_at`: where the parser stopped, else -1.
    """

    chunk: Chunk
    statement: Any
    clauses: tuple[Clause, ...]
    problems: tuple[Diagnostic, ...]
    ended_early: bool = False
    stopped_at: int = -1


def parse(source: Source, findings: Findings) -> ast.File | None:
    """The tree of a file. Every syntax error is recorded; the statements that have one are left out of the tree.

    None if the file has statements but none could be parsed, or is too large (GB010).
    """
    large = too_large(source)
    if large is not None:
        findings.add(large)
        return None
    statements: list[ast.Statement] = []
    uncertain: set[str] = set()
    parsed = parse_statements(source, findings)
    for part in parsed:
        if part.statement is not None:
            statements.append(part.statement)
        else:
            uncertain.update(normalise(word) for word in _WORD.findall(part.chunk.span.text))
    if parsed and not statements:
        return None
    return ast.File(Span(source, 0, len(source.text)), tuple(statements), frozenset(uncertain))


def parse_expression(source: Source, findings: Findings) -> ast.Expression | None:
    """The tree of a single expression or condition (`x2 > 4`); None if it cannot be parsed."""
    end = len(source.text.rstrip())
    start = len(source.text) - len(source.text.lstrip())
    if start >= end:
        findings.error("GB101", "an expression is missing", Span(source, 0, 0), label="an expression is expected here")
        return None
    parsed = _Reader(source, {}).read(Chunk(source, start, end, (start,), ()), "expression")
    findings.extend(parsed.problems)
    return cast("ast.Expression | None", parsed.statement)


def parse_statements(source: Source, findings: Findings) -> list[Parsed]:
    """Every statement of a file with its place, including those with errors; each error is recorded once.

    After `MOST_ERRORS` statements with errors the others are not parsed (GB011).
    """
    chunks = split(source).chunks
    reader = _Reader(source, _declared(chunks))
    done: list[Parsed] = []
    waiting = deque(chunks)
    wrong = 0
    while waiting and wrong < MOST_ERRORS:
        chunk = waiting.popleft()
        parsed = reader.read(chunk)
        if parsed.problems and parsed.stopped_at in chunk.lines[1:]:
            pieces = _unindented(chunk)
            if len(pieces) > 1:
                findings.add(_stray_indentation(pieces, chunk.indented))
                waiting.extendleft(reversed(pieces))
                continue
        if chunk.indented:
            findings.add(_stray_indentation([chunk], True))
        if parsed.ended_early:
            parsed = reader.close_brackets(parsed, waiting)
        joined = reader.join(done[-1], parsed) if parsed.problems and done else None
        if joined is not None:
            done[-1] = joined
        else:
            done.append(parsed)
            wrong += bool(parsed.problems)
    for parsed in done:
        findings.extend(parsed.problems)
    if waiting:
        findings.add(_not_read(waiting))
    return done + [Parsed(chunk, None, (), ()) for chunk in waiting]


def _not_read(waiting: deque[Chunk]) -> Diagnostic:
    """The diagnostic for the rest of a file with too many errors."""
    first, last = waiting[0].span, waiting[-1].span
    lines = last.position[2] - first.position[0] + 1
    message = f"{MOST_ERRORS} statements have errors; {lines:,} more line{'s were' if lines > 1 else ' was'} not read"
    return Diagnostic("GB011", message, first, "not read from here", help="correct the errors above first")


def _declared(chunks: tuple[Chunk, ...]) -> Mapping[str, str]:
    """The keyword of the declaring statement by declared name, judged from each statement's first two words."""
    found = {}
    for chunk in chunks:
        head = _HEAD.match(chunk.source.text, chunk.start, chunk.end)
        if head is not None and head[1] in _DECLARING:
            found[normalise(head[2])] = head[1]
    return found


# ------------------------------------------------------------------------------------------------ lines and statements


def _unindented(chunk: Chunk) -> list[Chunk]:
    """The statement split at every indented line that begins like a statement."""
    text = chunk.source.text
    starts = [chunk.start, *(at for at in chunk.lines[1:] if _BEGINS_STATEMENT.match(text, at, chunk.end))]
    pieces = []
    for start, following in zip(starts, [*starts[1:], chunk.end], strict=True):
        lines = tuple(at for at in chunk.lines if start <= at < following) or (start,)
        comments = tuple(c for c in chunk.comments if start <= c.start < following)
        end = start + len(_without_comments(text, start, following, comments).rstrip())
        pieces.append(Chunk(chunk.source, start, end, lines, comments))
    return pieces


def _without_comments(text: str, start: int, end: int, comments: tuple[Comment, ...]) -> str:
    """The text from `start` to `end` with its comments blanked."""
    parts = []
    for comment in comments:
        parts += [text[start : comment.start], " " * (min(comment.end, end) - comment.start)]
        start = min(comment.end, end)
    return "".join([*parts, text[start:end]])


def _stray_indentation(pieces: list[Chunk], first_too: bool) -> Diagnostic:
    """The diagnostic for indented lines that begin statements."""
    stray = pieces if first_too else pieces[1:]
    spans = [Span(piece.source, _line_start(piece), piece.start) for piece in stray]
    if len(spans) == 1:
        message = "a statement starts in the first column, and this line is indented"
    else:
        message = f"statements start in the first column, and {len(spans)} lines here are indented"
    return Diagnostic(
        "GB110",
        message,
        spans[0],
        "indented",
        tuple(Label(span, "and this one") for span in spans[1:3]),
        help="remove the spaces or tabs before it; an indented line continues the statement above",
    )


def _line_start(chunk: Chunk) -> int:
    return chunk.source.text.rfind("\n", 0, chunk.start) + 1


class _Reader:
    """Parses the statements of one file."""

    def __init__(self, source: Source, kinds: Mapping[str, str]) -> None:
        self.source, self.kinds = source, kinds
        self._joined: dict[int, list[Chunk]] = {}  # by a statement's start: what was joined to it

    def read(self, chunk: Chunk, start: str = "statement") -> Parsed:
        """Parses one statement."""
        text, problems = clean(chunk)
        if text is None:
            return Parsed(chunk, None, (), tuple(problems))
        deep = _too_deep(chunk, text)
        if deep is not None:
            return Parsed(chunk, None, (), (*problems, deep))
        lark, builder = engine()
        builder.begin(chunk.source, chunk.start)
        try:
            statement: Any = lark.parse(text, start=start)
        except UnexpectedInput as error:
            return self._failed(chunk, text, error, tuple(problems), lone=start == "expression")
        clauses, found = builder.clauses, tuple(builder.problems)
        return Parsed(chunk, None if found else statement, clauses, (*problems, *found))

    def _failed(
        self, chunk: Chunk, text: str, error: UnexpectedInput, problems: tuple[Diagnostic, ...], lone: bool
    ) -> Parsed:
        lark, _ = engine()
        state, _ = where(error)
        token, expected = Token("?", text[error.pos_in_stream or 0 :][:1], error.pos_in_stream), frozenset[str]()
        if isinstance(error, UnexpectedToken):
            token, expected = error.token, frozenset(error.accepts or error.expected)
        slip = Slip(chunk, text, state, token, expected, self.kinds, lone)
        if not problems:
            problems = (explain_slip(lark, slip),)
        return Parsed(chunk, None, (), problems, slip.at_end, chunk.start + slip.start)

    def close_brackets(self, parsed: Parsed, waiting: deque[Chunk]) -> Parsed:
        """Joins a statement that ends inside brackets with the following ones, up to where the brackets are closed.

        Removes those from `waiting` if together they parse as one statement; else changes nothing.
        """
        count = _lines_to_close(parsed.chunk, waiting)
        if not count:
            return parsed
        following = [waiting[index] for index in range(count)]
        joined = self.read(_united([parsed.chunk, *following]))
        if joined.problems:
            return parsed
        for _ in following:
            waiting.popleft()
        return replace(joined, problems=(_not_indented(parsed.chunk, following[0]),))

    def join(self, before: Parsed, after: Parsed) -> Parsed | None:
        """Two statements joined into one (the second should have been indented); None if that does not parse."""
        first, second = before.chunk, after.chunk
        joined = self._joined.get(first.start, [])
        unfinished = before.statement is not None or before.ended_early or joined
        if not unfinished or len(joined) >= _MAX_JOINED or second.indented:
            return None
        parsed = self.read(_united([first, second]))
        if parsed.problems and not (parsed.ended_early and before.ended_early and after.stopped_at >= 0):
            return None
        joined = self._joined[first.start] = [*joined, second]
        if parsed.problems:
            return replace(parsed, problems=before.problems)
        start = Chunk(self.source, first.start, joined[0].start, first.lines, ()) if len(joined) > 1 else first
        return replace(parsed, problems=(_not_indented(start, joined[0]),))


def _united(chunks: list[Chunk]) -> Chunk:
    """Several statements as one."""
    lines = tuple(line for chunk in chunks for line in chunk.lines)
    comments = tuple(comment for chunk in chunks for comment in chunk.comments)
    return Chunk(chunks[0].source, chunks[0].start, chunks[-1].end, lines, comments)


def _not_indented(first: Chunk, second: Chunk) -> Diagnostic:
    """The diagnostic for a continuation line that starts in the first column."""
    return Diagnostic(
        "GB111",
        "a line that continues a statement is indented",
        second.span,
        "not indented",
        (Label(Span(first.source, first.start, first.end), "the statement that it continues"),),
        help="put spaces before it",
    )


def _lines_to_close(chunk: Chunk, waiting: deque[Chunk]) -> int:
    """How many of the following statements are needed to close a statement's brackets; 0 if they stay open."""
    depth = _balance(chunk)
    for count, following in enumerate(islice(waiting, _MAX_INSIDE), start=1):
        if depth <= 0 or _BEGINS_STATEMENT.match(following.source.text, following.start, following.end):
            return 0
        depth += _balance(following)
        if depth <= 0:
            return count
    return 0


def _balance(chunk: Chunk) -> int:
    """The number of opened minus the number of closed brackets."""
    text = _without_comments(chunk.source.text, chunk.start, chunk.end, chunk.comments)
    signs = [found[0] for found in _BRACKET.finditer(text)]
    return sum(sign in "([" for sign in signs) - sum(sign in ")]" for sign in signs)


def _too_deep(chunk: Chunk, text: str) -> Diagnostic | None:
    """The diagnostic for brackets nested too deep; None if they are not."""
    if sum(map(text.count, "([")) <= ast.MAX_DEPTH:
        return None
    depth = 0
    for found in _BRACKET.finditer(text):
        if found[0] in "([":
            depth += 1
        elif found[0] in ")]":
            depth -= 1
        if depth > ast.MAX_DEPTH:
            at = chunk.start + found.start()
            message = f"brackets are nested more than {ast.MAX_DEPTH} deep"
            help = "give names to the inner parts with `let`"
            return Diagnostic("GB138", message, Span(chunk.source, at, at + 1), help=help)
    return None
