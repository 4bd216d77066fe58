"""The tree of each statement, the places of its parts, and how lines form statements."""

from __future__ import annotations

import math

import pytest

from gbspec.diagnostics import Findings, Source
from gbspec.syntax import ast
from gbspec.syntax.formatter import format_text
from gbspec.syntax.parser import parse, parse_expression
from gbspec.syntax.walking import walk
from tests.effort import calls


def read(text: str) -> tuple[ast.Statement, ...]:
    findings = Findings()
    file = parse(Source("test.gb", text), findings)
    assert [finding.message for finding in findings] == []
    assert file is not None
    return file.statements


def one(text: str) -> ast.Statement:
    (statement,) = read(text)
    return statement


def codes(text: str) -> list[str]:
    findings = Findings()
    parse(Source("test.gb", text), findings)
    return [finding.code for finding in findings]


# ------------------------------------------------------------------------------------------------------- statements


def test_state_with_all_clauses() -> None:
    state = one('state X : gX/L in [0, 50] = 0.1 "biomass"')
    assert isinstance(state, ast.StateStatement)
    assert state.declarator.name.text == "X"
    assert state.unit is not None and state.unit.span.text == "gX/L"
    assert state.range is not None and state.range.high.span.text == "50"
    assert isinstance(state.start, ast.Number) and state.start.value == 0.1
    assert state.description is not None and state.description.value == "biomass"


def test_clauses_may_come_in_any_order() -> None:
    first = one('learn k : 1/h = 1 in [0, 2] prior normal(1, 2) per trajectory "k"')
    second = one('learn k per trajectory "k" prior normal(1, 2) in [0, 2] = 1 : 1/h')
    assert format_text(first.span.source) == format_text(second.span.source)


def test_unknown_with_everything() -> None:
    unknown = one(
        "unknown a, b(u, g : mg/L in [0, 5]) : 1/h, g/L\n  a >= 0, zero at u = 0, increasing in u, in [0, 1]\n"
        "  = monod(u)*nn, nn\n  by mlp(32, 16, activation=silu)"
    )
    assert isinstance(unknown, ast.UnknownStatement)
    assert [name.text for name in unknown.names] == ["a", "b"]
    assert [argument.name.text for argument in unknown.arguments] == ["u", "g"]
    assert unknown.arguments[1].unit is not None and unknown.arguments[1].range is not None
    assert [unit.span.text for unit in unknown.units] == ["1/h", "g/L"]
    bound, zero, monotone, interval = unknown.contracts
    assert isinstance(bound, ast.Bound) and bound.name is not None and bound.name.text == "a"
    assert isinstance(zero, ast.ZeroAt) and zero.argument.text == "u"
    assert isinstance(monotone, ast.Shaped) and monotone.shape == "increasing"
    assert isinstance(interval, ast.RangeContract)
    assert len(unknown.postulates) == 2
    assert unknown.network is not None
    assert [width.span.text for width in unknown.network.widths] == ["32", "16"]
    assert unknown.network.options[0].name.text == "activation"


@pytest.mark.parametrize(
    ("text", "consumed", "produced"),
    [
        ("process p: 1/Y*S -> X + 2*Z rate mu*X", "1/Y*S", "X + 2*Z"),
        ("process p: -> X rate 1", None, "X"),
        ("process p: X -> rate 1", "X", None),
        ("process p: -> rate rate", None, None),
    ],
)
def test_either_side_of_a_process_may_be_empty(text: str, consumed: str | None, produced: str | None) -> None:
    process = one(text)
    assert isinstance(process, ast.ProcessStatement)
    assert (process.consumed.span.text if process.consumed else None) == consumed
    assert (process.produced.span.text if process.produced else None) == produced


def test_arrays() -> None:
    declared, balance, closure, observed = read("state c[1..N+1]\nc[i]' = c[i-1]\nc[0] = cin\nobserve c[3]")
    assert isinstance(declared, ast.StateStatement)
    assert declared.declarator.last is not None and declared.declarator.last.span.text == "N+1"
    assert isinstance(balance, ast.BalanceStatement) and isinstance(balance.target, ast.Index)
    assert isinstance(closure, ast.ClosureStatement)
    assert isinstance(observed, ast.ObserveStatement) and isinstance(observed.target, ast.Index)


def test_keywords_are_names_where_that_is_unambiguous() -> None:
    statements = read(
        "const rate = 3\nlet time = rate*input\nlearn noise = 1\nconst in = 2\ncondition by in [0, 1]\n"
        "observe held = linear\nunknown zero(at, increasing)\nlet from = zero(in, by) + lag\ninput times held\n"
        "process rate: x -> y rate rate\nconst model = 1\nlet state = model\nfunction trajectory(per) = per"
    )
    assert len(statements) == 13


def test_names_are_compared_after_nfkc() -> None:
    micro, greek = read("const µ = 1\nlet a = μ")
    assert isinstance(micro, ast.ConstStatement) and isinstance(greek, ast.LetStatement)
    assert isinstance(greek.value, ast.Name)
    assert micro.name.text == greek.value.text == "μ"


def test_every_span_holds_the_text_of_its_node() -> None:
    text = 'state X : gX/L*(m)^2 in [-1, 5*(2)] = 0.1 "b"\nlet a = f(x, -(y)) + c[i-1]^2*if(x > 3, 1, 2)\n'
    for statement in read(text):
        for node in walk(statement):
            if isinstance(node, ast.Name | ast.Number):
                assert node.span.text == node.text
            elif isinstance(node, ast.UnitName):
                assert node.span.text.strip("()") == node.text
            elif isinstance(node, ast.Call):
                assert node.span.text.startswith(node.function.text + "(") and node.span.text.endswith(")")
            elif isinstance(node, ast.Group):
                assert node.span.text == f"({node.inner.span.text})"
            elif isinstance(node, ast.Binary):
                assert node.span.start == node.left.span.start and node.span.end == node.right.span.end


# ------------------------------------------------------------------------------------------------------------- lines


def test_indented_lines_and_closing_brackets_continue() -> None:
    text = "unknown phi(\n\tx,\n\n# between\n  y\n)\n  by mlp(3)\nlet a = b[\n  1\n] # end\n"
    assert [type(statement) for statement in read(text)] == [ast.UnknownStatement, ast.LetStatement]


def test_comments_and_signs_in_texts() -> None:
    state, constant = read('state x "a # b (["   # (comment"\nconst k = 3 # "open')
    assert isinstance(state, ast.StateStatement) and state.description is not None
    assert state.description.value == "a # b (["
    assert isinstance(constant, ast.ConstStatement)


def test_unusual_spaces_are_spaces() -> None:
    assert len(read("const\u00a0k\u2009=\u30003\n\u00a0\u00a0+ 1")) == 1


def test_empty_files_have_no_statement() -> None:
    assert read("") == ()
    assert read("\n# nothing\n   # here\n") == ()


def test_errors_in_one_statement_do_not_hide_errors_in_others() -> None:
    findings = Findings()
    file = parse(Source("test.gb", "let a = (b\nstate X\nlet c = 2x\nX' = 1\nlet e = +\n"), findings)
    assert [finding.place.position[0] for finding in findings] == [1, 3, 5]  # type: ignore[union-attr]
    assert file is not None
    assert [type(statement) for statement in file.statements] == [ast.StateStatement, ast.BalanceStatement]
    assert file.uncertain == {"let", "a", "b", "c", "x", "e"}


def test_nothing_readable_is_no_file() -> None:
    findings = Findings()
    assert parse(Source("test.gb", "foo\nbar\n"), findings) is None
    assert len(findings) == 2


def test_statements_after_a_stray_indentation_are_read() -> None:
    findings = Findings()
    file = parse(Source("test.gb", "model m\n  state x\n  x' = 1\nobserve x\n\n\tlet a = 3\n"), findings)
    assert [finding.code for finding in findings] == ["GB110", "GB110"]
    assert file is not None and len(file.statements) == 5


def test_an_indented_first_line_is_one_diagnostic() -> None:
    assert codes("  model m\nstate x\n") == ["GB110"]
    assert codes("  model m\n  state x\n  # why\n  x' = 1\n") == ["GB110"]


@pytest.mark.parametrize(
    "text",
    [
        "unknown phi(x,\ny)\n",
        "unknown phi(x,\ny,\nz)\nstate x\n",
        "let a = b\n+ c\n",
        "let a = b +\nc\n",
        'learn k = 1\n"why"\nstate x',
        "unknown f(x)\n>= 0\n",
    ],
)
def test_a_continued_line_that_is_not_indented_is_one_diagnostic(text: str) -> None:
    assert codes(text) == ["GB111"]


# ------------------------------------------------------------------------------------------------------------ limits


def test_a_sum_of_5000_terms_and_a_product_of_5000_factors() -> None:
    for sign in "+*":
        (statement,) = read("let a = " + f" {sign} ".join(f"x{i}" for i in range(5000)))
        assert sum(isinstance(node, ast.Binary) for node in walk(statement)) == 4999


@pytest.mark.parametrize(
    "expression",
    [
        "(" * 10_000 + "x" + ")" * 10_000,
        "(" * 10_000,
        "-" * 10_000 + "x",
        "^".join(["x"] * 5_000),
        "f(" * 500 + "x" + ")" * 500,
        "if(x > 0, 1, " * 200 + "2" + ")" * 200,
        "c[" * 5_000 + "1" + "]" * 5_000,
    ],
)
def test_deep_nesting_is_one_diagnostic(expression: str) -> None:
    assert codes(f"let a = {expression}\n") == ["GB138"]


def test_nesting_up_to_the_limit_is_read() -> None:
    depth = ast.MAX_DEPTH
    assert codes("let a = " + "(" * depth + "x" + ")" * depth) == []
    assert codes("let a = " + "-" * depth + "x") == []
    assert codes("let a = " + "(" * (depth + 1) + "x" + ")" * (depth + 1)) == ["GB138"]


def test_a_condition_of_many_parts_is_read() -> None:
    assert codes("let a = if(" + " and ".join(["x > 1"] * 3000) + ", 1, 2)") == []


def test_many_statements_are_read_in_linear_time() -> None:
    def text(states: int) -> str:
        return "".join(f"state x{i} : g/L in [0, 10] = 0.5\nx{i}' = -k*x{i} + x{i + 1}/h^2\n" for i in range(states))

    read(text(10))  # initialises the parser and other caches
    small, large = (calls(lambda n=n: read(text(n))) for n in (100, 1000))
    assert large < 1.5 * 10 * small  # ten times the text; a quadratic parser would need a hundred times the calls


# ------------------------------------------------------------------------------------------------------- expressions


def test_a_lone_expression_may_be_a_condition() -> None:
    findings = Findings()
    assert isinstance(parse_expression(Source("--reject", " x2 > 4 "), findings), ast.Comparison)
    assert isinstance(parse_expression(Source("--reject", "x2 + 1"), findings), ast.Binary)
    assert not list(findings)


@pytest.mark.parametrize("text", ["", "  ", "x >", "2x", "(x", 'x "a"', "x = 3", "x²", "let a = 3"])
def test_a_lone_expression_that_is_wrong(text: str) -> None:
    findings = Findings()
    assert parse_expression(Source("--reject", text), findings) is None
    assert len(findings) == 1


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("-2^2", -4.0),
        ("2^-1", 0.5),
        ("2^3^2", 512.0),
        ("2**3**2", 512.0),
        ("-2^-2^-1", -(2 ** -(2**-1))),
        ("8/4/2", 1.0),
        ("8 - 4 - 2", 2.0),
        ("2 - -3", 5.0),
        ("2*-3 + +4", -2.0),
        ("-(1 + 2)*3", -9.0),
        ("1e3 + .5 + 2. + 1.5E-1", 1002.65),
    ],
)
def test_precedence(text: str, value: float) -> None:
    from tests.syntax.evaluate import evaluate

    expression = parse_expression(Source("test", text), Findings())
    assert expression is not None
    assert math.isclose(evaluate(expression, {}), value)
