"""Precedence and associativity of the parser compared with Python's, on random expressions."""

from __future__ import annotations

import cmath
import math

from hypothesis import given, settings
from hypothesis import strategies as st

from gbspec.diagnostics import Findings, Source
from gbspec.syntax import ast
from gbspec.syntax.parser import parse_expression
from gbspec.syntax.walking import children, same, ungrouped, walk
from tests.syntax.evaluate import evaluate

VALUES = {"x": 1.25, "y": 0.5, "lambda_": 2.0}

atoms = st.sampled_from(["x", "y", "lambda_", "2", "3.", ".5", "1e-1"])


def _deeper(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    operator = st.sampled_from(["+", "-", "*", "/", "**", " - ", " + "])
    condition = st.tuples(inner, st.sampled_from(["<", "<=", ">", ">=", "=="]), inner).map("".join)
    return st.one_of(
        st.tuples(inner, operator, inner).map("".join),
        inner.map(lambda text: f"({text})"),
        inner.map(lambda text: f"-{text}"),
        inner.map(lambda text: f"+{text}"),
        st.tuples(condition, condition, inner, inner).map(lambda t: f"choose({t[0]} and not {t[1]}, {t[2]}, {t[3]})"),
        st.tuples(condition, condition, inner, inner).map(lambda t: f"choose(not {t[0]} or {t[1]}, {t[2]}, {t[3]})"),
    )


texts = st.recursive(atoms, _deeper, max_leaves=12)


@settings(max_examples=300, deadline=None)
@given(texts)
def test_the_tree_means_what_python_means(text: str) -> None:
    ours = text.replace("**", "^").replace("choose", "if")
    findings = Findings()
    expression = parse_expression(Source("test", ours), findings)
    assert expression is not None, [finding.message for finding in findings]
    assert expression.span.text == ours.strip()
    # Python's own parser is the reference here; the text is the test's own
    reference = compile(text, "test", "eval")
    scope = {"choose": lambda condition, a, b: a if condition else b, "__builtins__": {}, **VALUES}
    try:
        expected = complex(eval(reference, scope))
    except (ZeroDivisionError, OverflowError):
        return
    try:
        found = complex(evaluate(expression, VALUES))
    except OverflowError:
        return
    assert (cmath.isnan(expected) and cmath.isnan(found)) or found == expected or math.isclose(abs(found - expected), 0)


def test_walk_goes_from_left_to_right_and_same_ignores_places() -> None:
    first = parse_expression(Source("a", "f(x, -y) + c[2]"), Findings())
    second = parse_expression(Source("b", " f( x,-y )+c [2]"), Findings())
    third = parse_expression(Source("c", "f(x, -y) + c[3]"), Findings())
    assert first is not None and second is not None and third is not None
    assert [node.text for node in walk(first) if isinstance(node, ast.Name)] == ["f", "x", "y", "c"]
    assert same(first, second) and not same(first, third) and not same(first, None)
    assert len(children(first)) == 2


def test_parentheses_are_kept_and_ignored_in_evaluation() -> None:
    expression = parse_expression(Source("a", "((x))"), Findings())
    assert isinstance(expression, ast.Group)
    assert isinstance(ungrouped(expression), ast.Name)
