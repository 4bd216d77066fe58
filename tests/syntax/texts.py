"""Random valid `.gb` texts, as lists of tokens, so that spaces, line breaks and comments can be varied."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import strategies as st

Tokens = list[str]

NAMES = ("x", "y", "k", "mu", "μ", "x_1", "rate", "time", "lambda", "E", "by", "in", "held", "zero", "noise", "größe")
names = st.sampled_from(NAMES)
numbers = st.one_of(
    st.integers(0, 10**6).map(str),
    st.floats(0, 1e300, allow_nan=False, allow_infinity=False).map(repr),
    st.sampled_from(["1.", ".5", "2e-3", "3E5", "0.10", "1.e+2"]),
)
strings = st.sampled_from(['"biomass"', '""', '"a # b"', '"it’s · fine"', '"(unclosed ["'])


def separated(parts: Sequence[Tokens], by: str = ",") -> Tokens:
    """The parts with a sign between them."""
    return [token for index, part in enumerate(parts) for token in ([by] if index else []) + part]


def bracketed(inner: Tokens, signs: str = "()") -> Tokens:
    return [signs[0], *inner, signs[1]]


@st.composite
def binary(draw: st.DrawFn, inner: st.SearchStrategy[Tokens]) -> Tokens:
    return [*draw(inner), draw(st.sampled_from(["+", "-", "*", "/", "^", "**"])), *draw(inner)]


@st.composite
def conditions(draw: st.DrawFn, inner: st.SearchStrategy[Tokens]) -> Tokens:
    def comparison() -> Tokens:
        tokens = [*draw(inner), draw(st.sampled_from(["<", "<=", ">", ">=", "=="])), *draw(inner)]
        return ["not", *tokens] if draw(st.booleans()) else tokens

    tokens = comparison()
    for _ in range(draw(st.integers(0, 2))):
        tokens += [draw(st.sampled_from(["and", "or"])), *bracketed(comparison())]
    return tokens


units = st.sampled_from(["gX/L", "1/h", "kg*m/s^2", "m**-2", "(g/L)^0.5", "10^3", "J/(mol*K)"]).map(lambda t: [t])
in_units = units.filter(lambda t: t != ["10^3"])  # a conversion is to a named unit, or to the pure number 1


def deeper(inner: st.SearchStrategy[Tokens]) -> st.SearchStrategy[Tokens]:
    return st.one_of(
        binary(inner),
        inner.map(bracketed),
        inner.map(lambda tokens: ["-", *bracketed(tokens)]),
        st.tuples(st.sampled_from(["-", "+"]), names).map(list),
        st.tuples(names, st.lists(inner, max_size=3)).map(lambda t: [t[0], *bracketed(separated(t[1]))]),
        st.tuples(names, inner).map(lambda t: [t[0], *bracketed(t[1], "[]")]),
        st.tuples(conditions(inner), inner, inner).map(lambda t: ["if", *bracketed(separated(t))]),
        st.tuples(inner, in_units).map(lambda t: bracketed([*t[0], "in", *t[1]])),
    )


expressions = st.recursive(st.one_of(names, numbers).map(lambda token: [token]), deeper, max_leaves=8)
intervals = st.tuples(expressions, expressions).map(lambda t: bracketed(separated(t), "[]"))
distributions = st.tuples(st.sampled_from(["normal", "lognormal"]), st.lists(expressions, min_size=1, max_size=2)).map(
    lambda t: [t[0], *bracketed(separated(t[1]))]
)

unit = units.map(lambda t: [":", *t])
interval = intervals.map(lambda t: ["in", *t])
quantities = st.one_of(expressions, st.tuples(expressions, in_units).map(lambda t: [*t[0], "in", *t[1]]))
value = quantities.map(lambda t: ["=", *t])
postulate = expressions.map(lambda t: ["=", *t])
text = strings.map(lambda t: [t])
column = strings.map(lambda t: ["as", t])
bound = st.tuples(st.sampled_from([">", ">=", "<", "<="]), expressions).map(lambda t: [t[0], *t[1]])
contract = st.one_of(
    bound,
    interval,
    st.tuples(names, expressions).map(lambda t: ["zero", "at", t[0], "=", *t[1]]),
    st.tuples(st.sampled_from(["increasing", "decreasing"]), names).map(lambda t: [t[0], "in", t[1]]),
    bound.map(lambda t: ["a", *t]),
)
contracts = st.lists(contract, min_size=1, max_size=3).map(separated)
network = st.sampled_from(
    [["by", "mlp"], ["by", "mlp", "(", ")"], ["by", "mlp", "(", "32", ",", "32", ",", "activation", "=", "silu", ")"]]
)


@st.composite
def clauses(
    draw: st.DrawFn, optional: Sequence[st.SearchStrategy[Tokens]], required: Sequence[st.SearchStrategy[Tokens]] = ()
) -> Tokens:
    """All of the required and some of the optional clauses, in any order."""
    chosen = [draw(clause) for clause in required]
    chosen += [draw(clause) for clause in optional if draw(st.booleans())]
    return [token for clause in draw(st.permutations(chosen)) for token in clause]


def statement(head: st.SearchStrategy[Tokens], tail: st.SearchStrategy[Tokens]) -> st.SearchStrategy[Tokens]:
    return st.tuples(head, tail).map(lambda t: t[0] + t[1])


def named(word: str) -> st.SearchStrategy[Tokens]:
    return names.map(lambda name: [word, name])


targets = st.one_of(
    names.map(lambda name: [name]), st.tuples(names, expressions).map(lambda t: [t[0], *bracketed(t[1], "[]")])
)
state_names = st.sampled_from(["x", "y", "S", "μ", "rate", "größe"])
# a side that begins with a call of something named `rate` reads as the clause
sides = st.one_of(st.just([]), expressions.filter(lambda t: t[:2] != ["rate", "("]))


def after(word: str) -> st.SearchStrategy[Tokens]:
    """A clause of a quantity behind a keyword."""
    return quantities.map(lambda t: [word, *t])


def targeted(word: str) -> st.SearchStrategy[Tokens]:
    return targets.map(lambda target: [word, *target])


table_arguments = st.lists(
    st.tuples(names, st.one_of(st.just([]), unit)).map(lambda t: [t[0], *t[1]]), min_size=1, max_size=2
).map(separated)
per = st.sampled_from(["trajectory", "subject", "occasion"])
spreads = st.one_of(
    st.just([]),
    st.sampled_from(["lognormal", "normal", "logitnormal"]).map(lambda t: ["~", t]),
    distributions.map(lambda t: ["~", *t]),
)
populations = st.tuples(per, spreads).map(lambda t: ["per", t[0], *t[1]])
signed = st.tuples(st.sampled_from(["", "-", "+"]), numbers).map(lambda t: [*filter(None, t)])
points = st.lists(
    st.lists(signed, min_size=2, max_size=3).map(lambda t: bracketed(separated(t))), min_size=1, max_size=3
)
from_points = st.one_of(strings.map(lambda t: ["from", t]), points.map(lambda t: ["=", *separated(t)]))
table_clauses = clauses(
    [
        unit,
        st.sampled_from([["linear"], ["pchip"], ["cubic"]]),
        st.sampled_from([["outside", "hold"], ["outside", "error"]]),
        text,
    ],
    [from_points],
)


@st.composite
def events(draw: st.DrawFn) -> Tokens:
    """An event with any of its clauses; they end where what it sets begins."""
    assigned = separated([[*draw(targets), "=", *draw(quantities)] for _ in range(draw(st.integers(1, 3)))])
    priority = expressions.map(lambda t: ["priority", *t])
    if draw(st.booleans()):
        when = ["when", *draw(conditions(expressions))]
        rest = draw(clauses([priority, st.just(["armed"])]))
    else:
        when = draw(clauses([after("every")], [after("at")]) | clauses([after("until"), after("at")], [after("every")]))
        rest = draw(clauses([priority]))
    return ["event", draw(names), *when, *rest, ":", *assigned]


statements = st.one_of(
    statement(named("model"), clauses([text, strings.map(lambda t: ["extends", t])])),
    statement(named("time"), clauses([unit, expressions.map(lambda t: ["from", *t]), text])),
    statement(named("unit"), clauses([text])),
    statement(state_names.map(lambda n: ["state", n]), clauses([unit, interval, value, text])),
    st.tuples(state_names, expressions, expressions).map(
        lambda t: ["state", t[0], *bracketed([*t[1], "..", *t[2]], "[]")]
    ),
    statement(named("condition"), clauses([unit, interval, value, column, text])),
    statement(named("input"), clauses([unit, interval, st.sampled_from([["held"], ["linear"]]), value, column, text])),
    statement(named("const"), clauses([unit, text], [value])),
    statement(
        named("learn"),
        clauses(
            [unit, value, interval, distributions.map(lambda t: ["prior", *t]), st.just(["per", "trajectory"]), text]
        ),
    ),
    statement(named("learn"), clauses([value, st.just([">", "0"]), st.just(["<=", "10"]), text])),
    statement(named("let"), clauses([unit, text], [value])),
    statement(
        st.tuples(names, st.lists(names, max_size=3)).map(
            lambda t: ["function", t[0], *bracketed(separated([[n] for n in t[1]]))]
        ),
        clauses([text], [value]),
    ),
    statement(
        st.lists(
            st.tuples(names, st.one_of(st.just([]), unit, interval)).map(lambda t: [t[0], *t[1]]),
            min_size=1,
            max_size=3,
        ).map(lambda arguments: ["unknown", "a", ",", "b", *bracketed(separated(arguments))]),
        clauses([unit, contracts, st.lists(postulate, min_size=1, max_size=1).map(lambda t: t[0]), network, text]),
    ),
    statement(
        st.tuples(names, sides, sides).map(lambda t: ["process", t[0], ":", *t[1], "->", *t[2]]),
        clauses([text], [expressions.map(lambda t: ["rate", *t])]),
    ),
    statement(state_names.map(lambda n: [n, "'"]), value),
    st.tuples(state_names, expressions, value).map(lambda t: [t[0], *bracketed(t[1], "[]"), "'", *t[2]]),
    st.tuples(state_names, expressions, value).map(lambda t: [t[0], *bracketed(t[1], "[]"), *t[2]]),
    statement(targeted("initial"), clauses([text], [st.one_of(value, st.just(["learn"]))])),
    statement(targeted("observe"), clauses([unit, value, distributions.map(lambda t: ["noise", *t]), column, text])),
    statement(
        targeted("dose"),
        clauses([expressions.map(lambda t: ["times", *t]), after("lag"), after("over"), text]),
    ),
    statement(
        named("learn"),
        clauses([unit, value, text], [populations]),
    ),
    statement(named("effect"), clauses([text], [st.just(["per", "trajectory"])])),
    st.lists(names, min_size=2, max_size=4).map(lambda t: ["correlate", *separated([[n] for n in t])]),
    statement(st.tuples(names, table_arguments).map(lambda t: ["table", t[0], *bracketed(t[1])]), table_clauses),
    statement(named("discrete"), clauses([unit, interval, text], [value])),
    events(),
    statement(targeted("diffusion"), clauses([text], [value])),
    statement(named("conserve"), clauses([expressions.map(lambda t: ["rate", *t]), text], [value])),
    statement(named("truth"), value),
    statement(named("truth").map(lambda t: [*t, "(", "x", ",", "y", ")"]), value),
    st.sampled_from([["allow", "GB401"], ["allow", "GB401", "k"], ["without", "k"], ["without", "observe", "x"]]),
)

spaces = st.sampled_from([" ", " ", " ", "  ", "\t", "\n    ", "\n\n  ", "  # why\n   ", "\n    # own line\n\n  "])


@st.composite
def spaced(draw: st.DrawFn, tokens: Tokens) -> str:
    """The tokens with random spaces, line breaks and comments between them."""
    return tokens[0] + "".join(draw(spaces) + token for token in tokens[1:])


@st.composite
def files(draw: st.DrawFn) -> str:
    """A file of random statements; most on one line, some with comments and line breaks in them."""
    lines = []
    for tokens in draw(st.lists(statements, max_size=5)):
        lines.append(draw(spaced(tokens)) if draw(st.booleans()) else " ".join(tokens))
        lines.append(draw(st.sampled_from(["", "\n", "\n\n\n", "  # trailing", "\n# own", "\n  # indented\n"])))
        lines.append("\n")
    return draw(st.sampled_from(["", "# head\n", "\n\n"])) + "".join(lines)
