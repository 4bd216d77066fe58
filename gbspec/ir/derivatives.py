"""The derivative rules of all operations of the language, used by the native kernel and the identifiability analysis.
A test compares torch's automatic differentiation with them.

Conventions where a function has a kink or jumps: `abs` and `sign` have slope 0 at 0, and `floor` has it everywhere;
where the arguments of `max` or `min` are equal, each has slope 1/2 (an argument that is NaN counts as not smaller and
not larger); a power whose exponent is a variable has slope 0 in its base where the exponent is 0, and slope 0 in its
exponent where the base is 0 and the exponent is not negative. The derivative of a conditional is that of the branch
taken; the condition does not contribute.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache

import sympy
from sympy.logic.boolalg import Boolean

from gbspec.diagnostics import Defect
from gbspec.ir.forms import logistic, softplus
from gbspec.ir.model import Expr
from gbspec.ir.tables import Lookup

UNARY: Mapping[type[sympy.Basic], Callable[[Expr, Expr], Expr]] = {
    sympy.exp: lambda x, v: v,
    sympy.log: lambda x, v: 1 / x,
    sympy.sin: lambda x, v: sympy.cos(x),
    sympy.cos: lambda x, v: -sympy.sin(x),
    sympy.tan: lambda x, v: 1 + v**2,
    sympy.cot: lambda x, v: -1 - v**2,
    sympy.sec: lambda x, v: v * sympy.tan(x),
    sympy.csc: lambda x, v: -v * sympy.cot(x),
    sympy.tanh: lambda x, v: 1 - v**2,
    sympy.sinh: lambda x, v: sympy.cosh(x),
    sympy.cosh: lambda x, v: sympy.sinh(x),
    sympy.asin: lambda x, v: 1 / sympy.sqrt(1 - x**2),
    sympy.acos: lambda x, v: -1 / sympy.sqrt(1 - x**2),
    sympy.atan: lambda x, v: 1 / (1 + x**2),
    sympy.asinh: lambda x, v: 1 / sympy.sqrt(1 + x**2),
    sympy.acosh: lambda x, v: 1 / sympy.sqrt(x**2 - 1),
    sympy.atanh: lambda x, v: 1 / (1 - x**2),
    sympy.Abs: lambda x, v: sympy.sign(x),
    sympy.sign: lambda x, v: sympy.S.Zero,
    sympy.floor: lambda x, v: sympy.S.Zero,
    softplus: lambda x, v: logistic(x),
    logistic: lambda x, v: v * (1 - v),
}
"""Functions of one argument: the derivative, with x the argument and v the function's value."""

Partials = list[tuple[Expr, Expr]]


def between_jumps(expression: Expr, symbol: sympy.Symbol) -> Expr:
    """The derivative by a symbol in the closed form that sympy finds, of whose functions `floor` has none."""
    held = {step: sympy.Dummy(real=True) for step in expression.atoms(sympy.floor)}
    return sympy.diff(expression.xreplace(held), symbol).xreplace({level: step for step, level in held.items()})


def partials(node: Expr, value: Expr | None = None) -> Partials:
    """The arguments of an operation, each with the partial derivative by it; conventions at kinks as `Piecewise`.

    `value` represents the operation's value in them (None: the node itself). `Max` and `Min` have two arguments here
    (see `nested`); a conditional (`Piecewise`) is not an operation. Raises Defect for a node without a rule.
    """
    v = node if value is None else value
    if type(node) in UNARY:
        return [(node.args[0], UNARY[type(node)](node.args[0], v))]
    match node:
        case sympy.Add():
            return [(a, sympy.S.One) for a in node.args]
        case sympy.Mul():
            others = [node.args[:i] + node.args[i + 1 :] for i in range(len(node.args))]
            return [(a, sympy.Mul(*rest, evaluate=False)) for a, rest in zip(node.args, others, strict=True)]
        case sympy.Pow():
            return _power(node, v)
        case sympy.Max() | sympy.Min():
            a, b = ordered(node)[0], ordered(node)[-1]  # of two equal arguments sympy keeps only one
            loses = (a < b, b < a) if isinstance(node, sympy.Max) else (b < a, a < b)
            half = (sympy.Rational(1, 2), sympy.Eq(a, b, evaluate=False))
            return [
                (x, _choice((sympy.S.Zero, lost), half, sympy.S.One)) for x, lost in zip((a, b), loses, strict=True)
            ]
        case sympy.atan2():
            y, x = node.args
            square = 1 / (x**2 + y**2)
            return [(y, x * square), (x, -y * square)]
        case Lookup():
            return [(a, node.slope(i)) for i, a in enumerate(node.args)]
    raise Defect(f"no rule gives the derivative of `{type(node).__name__}`")


def has_rule(node: sympy.Basic) -> bool:
    """Whether `partials` has a rule for a node of this kind."""
    known = sympy.Add | sympy.Mul | sympy.Pow | sympy.Max | sympy.Min | sympy.atan2 | Lookup
    return isinstance(node, known) or type(node) in UNARY


def _power(node: sympy.Pow, v: Expr) -> Partials:
    base, exponent = node.args
    if exponent == -1:
        return [(base, -v * v)]
    if exponent == sympy.Rational(1, 2):
        return [(base, 1 / (2 * v))]
    slope = exponent * sympy.Pow(base, exponent - 1)
    if exponent.is_number:
        return [(base, slope)]
    flat = _choice((sympy.S.Zero, sympy.Eq(exponent, 0, evaluate=False)), slope)
    if base.is_number and (base.is_negative or base.is_zero):  # the exponent is whole, or not negative, or no value is
        return [(base, flat)]
    growth = v * sympy.log(base)
    if not base.is_number:
        at_zero = sympy.And(sympy.Eq(base, 0, evaluate=False), sympy.Ge(exponent, 0, evaluate=False), evaluate=False)
        growth = _choice((sympy.S.Zero, at_zero), growth)
    return [(base, flat), (exponent, growth)]


def _choice(*branches: tuple[Expr, Boolean] | Expr) -> sympy.Piecewise:
    """An unevaluated `Piecewise`; the last branch is the default."""
    *cases, otherwise = branches
    return sympy.Piecewise(*cases, (otherwise, True), evaluate=False)


def ordered(node: sympy.Basic) -> list[Expr]:
    """The arguments of `Max`, `Min`, `And` or `Or`, which sympy keeps as a set, in the order in which all backends
    compute them."""
    return sorted(node.args, key=sympy.default_sort_key)


def nested(node: Expr) -> Expr:
    """`Max` or `Min` of several arguments as nested calls with two arguments."""
    *others, last = ordered(node)
    return node if len(others) < 2 else node.func(node.func(*others, evaluate=False), last, evaluate=False)


@lru_cache(maxsize=8192)
def derivative(node: Expr, symbol: sympy.Symbol) -> Expr:
    """The derivative of an expression with respect to a symbol, by these rules; unknowns in it count as constants.

    Raises Defect for a node without a rule.
    """
    if node == symbol:
        return sympy.S.One
    if symbol not in node.free_symbols:
        return sympy.S.Zero
    if isinstance(node, sympy.Piecewise):
        branches = [(derivative(value, symbol), condition) for value, condition in node.args]
        if all(value == 0 for value, _ in branches):
            return sympy.S.Zero
        return sympy.Piecewise(*branches, evaluate=False)
    pairs = partials(nested(node) if isinstance(node, sympy.Max | sympy.Min) else node)
    return sympy.Add(*(slope * derivative(a, symbol) for a, slope in pairs if symbol in a.free_symbols))
