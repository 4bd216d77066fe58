"""Helpers that the rules share: places, names, checks, and the state of the statement being built."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from lark import Token

from gbspec.diagnostics import Diagnostic, Source, Span
from gbspec.syntax import nodes as ast
from gbspec.syntax.names import REFUSED, is_name, normalise
from gbspec.syntax.walking import ungrouped

Children = list[Any]  # tokens and the results of the rules below


@dataclass(frozen=True)
class Clause(ast.Node):
    """One clause of a statement; `content` is a node, a tuple of nodes or None, by the kind."""

    kind: str
    content: Any


@dataclass(frozen=True)
class Names(ast.Node):
    """Several names, e.g. a function's parameters."""

    items: tuple[ast.Name, ...]


CLAUSE_WORDS = {
    "unit": "unit (`: …`)",
    "range": "range (`in [low, high]`)",
    "value": "value (`= …`)",
    "text": "description",
    "extends": "`extends`",
    "from": "`from`",
    "column": "`as`",
    "file": 'file (`from "…"`)',
    "points": "list of points (`= (…), (…)`)",
    "method": "`linear`, `pchip` or `cubic`",
    "outside": "`outside`",
    "interpolation": "`held` or `linear`",
    "prior": "`prior`",
    "noise": "`noise`",
    "per_trajectory": "`per trajectory`",
    "learned": "`learn`",
    "rate": "`rate`",
    "over": "`over`",
    "times": "`times`",
    "lag": "`lag`",
    "when": "`when`",
    "at": "`at`",
    "every": "`every`",
    "until": "`until`",
    "after": "`after`",
    "queue": "`queue`",
    "priority": "`priority`",
    "transient": "`transient`",
    "sampled": "`sampled`",
    "armed": "`armed`",
    "assignments": "list of assignments (`: …`)",
    "postulates": "postulate (`= …`)",
    "network": "network (`by …`)",
    "lower": "lower bound",
    "upper": "upper bound",
}
"""The name of each kind of clause in messages."""


MAX_PROBLEMS = 20
"""The maximal number of diagnostics per statement; only a damaged file would have more."""


class Parts:
    """Places, names and checks that the rules share; the state of one statement being built.

    `words` are the keywords that begin a statement.
    """

    def __init__(self, words: frozenset[str] = frozenset()) -> None:
        self.words = words
        self.begin(Source("", ""), 0)

    def begin(self, source: Source, offset: int) -> None:
        """Starts a statement whose text begins at the offset in the source."""
        self.source, self.offset = source, offset
        self.problems: list[Diagnostic] = []
        self.clauses: tuple[Clause, ...] = ()
        self._depth: dict[int, int] = {}

    def place(self, first: Any, last: Any | None = None) -> Span:
        """The span from one token or node to another (or of a single one)."""
        last = first if last is None else last
        start = cast(int, first.start_pos) + self.offset if isinstance(first, Token) else first.span.start
        end = cast(int, last.end_pos) + self.offset if isinstance(last, Token) else last.span.end
        return Span(self.source, start, end)

    def over(self, children: Children) -> Span:
        """The span of all that a rule matched."""
        return self.place(children[0], children[-1])

    def problem(self, code: str, message: str, place: Span, *, label: str = "", help: str = "") -> None:
        """Records a diagnostic about the statement."""
        self.report(Diagnostic(code, message, place, label, help=help))

    def report(self, finding: Diagnostic) -> None:
        """Records a diagnostic, unless the statement has reached its limit."""
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(finding)

    def name_at(self, token: Token) -> ast.Name:
        """A name, used or declared."""
        span = self.place(token)
        if not token.isascii() and not is_name(token):
            self.problem(
                "GB137",
                f"`{token}` is not a name",
                span,
                help="a name begins with a letter (of any script) or `_`, then letters, digits and `_`",
            )
        return ast.Name(span, normalise(str(token)))

    def declared(self, token: Token) -> ast.Name:
        """A name at the place where it is declared."""
        name = self.name_at(token)
        if name.text in REFUSED:
            self.problem(
                "GB136",
                f"`{name.text}` cannot be declared: it has a fixed meaning in every expression",
                name.span,
                help=f"choose another name, e.g. `{name.text}_` or `{name.text}_1`",
            )
        return name

    def number_value(self, expression: ast.Expression) -> ast.Expression:
        """Checks that an expression is a number and not a condition."""
        inner = ungrouped(expression)
        if is_condition(inner):
            self.problem(
                "GB122",
                "a comparison is not a number",
                inner.span,
                label="true or false, where a number is needed",
                help="choose between two numbers with `if(condition, a, b)`",
            )
        return expression

    def condition_value(self, expression: ast.Expression) -> ast.Expression:
        """Checks that an expression is a condition and not a number."""
        inner = ungrouped(expression)
        if not is_condition(inner):
            self.problem(
                "GB123",
                "a condition is needed here, and this is a number",
                inner.span,
                label="neither true nor false",
                help="compare it with something, e.g. `x > 0`",
            )
        return expression

    def nested(self, node: Any, below: Iterable[Any], chain: Any = None) -> Any:
        """Records the nesting depth of a node; `chain` is the left part of a sum or product, which adds no depth."""
        depth = 1 + max((self._depth.get(id(child), 0) for child in below), default=0)
        if chain is not None:
            depth = max(depth, self._depth.get(id(chain), 0))
        self._depth[id(node)] = depth
        if depth == ast.MAX_DEPTH + 1:
            self.problem(
                "GB138",
                f"this expression is nested more than {ast.MAX_DEPTH} deep",
                node.span,
                help="give names to its inner parts with `let`",
            )
        return node


def is_condition(expression: ast.Expression) -> bool:
    """Whether an expression is a condition rather than a number."""
    if isinstance(expression, ast.Comparison | ast.Logic):
        return True
    return isinstance(expression, ast.Unary) and expression.operator == "not"


def nodes(children: Sequence[Any]) -> tuple[Any, ...]:
    """The results of the rules below, without the tokens between them."""
    return tuple(child for child in children if not isinstance(child, Token))


def tokens(children: Sequence[Any], kind: str) -> list[Token]:
    """The tokens of one kind."""
    return [child for child in children if isinstance(child, Token) and child.type == kind]
