"""Nodes that the backends add to sympy's: temporaries, a choice of two, a value whose gradient counts where chosen,
and operations on vectors."""

from __future__ import annotations

from typing import ClassVar

import sympy


class Temporary(sympy.Dummy):  # type: ignore[misc]  # sympy is untyped
    """A symbol of the backend's own; in products it stands behind the model's, as `B*phi` does in the user's text."""

    is_Dummy = False  # noqa: N815 - sympy's name; else sympy could not sort it among symbols

    @classmethod
    def class_key(cls) -> tuple[int, int, str]:
        """Sorts it among symbols."""
        return 2, 0, "Symbol"


def temporary(name: str, real: bool = True) -> Temporary:
    """A new temporary that would like to be called `name`."""
    return Temporary(name, real=True) if real else Temporary(name)


class Where(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """`Where(condition, a, b)`: a where the condition holds, else b; both are evaluated."""

    word: ClassVar[str] = "where"

    def __new__(cls, condition: sympy.Basic, a: sympy.Expr, b: sympy.Expr) -> Where:
        """Takes both values; nothing is evaluated."""
        return super().__new__(cls, condition, a, b)  # type: ignore[no-any-return]


class Guard(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """`Guard(condition, x)`: the value x, through which gradients pass only where the condition holds.

    In the branch of a choice that is not taken, a derivative may be infinite (`sqrt(x)` at 0, `exp(x)` far out); zero
    times it is NaN, which would spoil the gradient of the branch that is taken.
    """

    word: ClassVar[str] = "guard"

    def __new__(cls, condition: sympy.Basic, x: sympy.Expr) -> Guard:
        """Takes the condition and the value that counts where it holds."""
        return super().__new__(cls, condition, x)  # type: ignore[no-any-return]


class VectorTemporary(Temporary):
    """A temporary that is a vector: its components stand on the last axis (in casadi, they are a column)."""


STATE = VectorTemporary("state", real=True)
"""The vector of all states."""


def temporary_like(name: str, *values: sympy.Basic, real: bool = True) -> Temporary:
    """A new temporary for what is computed of these values: a vector if one of them is."""
    vector = any(is_vector(value) for value in values)
    kind = VectorTemporary if vector else Temporary
    return kind(name, real=True) if real else kind(name)


def is_vector(value: sympy.Basic) -> bool:
    """Whether a value is a vector."""
    if not any(isinstance(symbol, VectorTemporary) for symbol in value.free_symbols) or isinstance(value, Scalar):
        return False
    return isinstance(value, VectorTemporary | Operation) or any(map(is_vector, value.args))


class Operation(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """An operation on vectors, printed as a call of the arithmetic's function `word`."""

    word: ClassVar[str]
    is_real = True

    def __new__(cls, *arguments: sympy.Basic | int) -> Operation:
        """Takes the function's arguments in order; nothing is ever evaluated."""
        return super().__new__(cls, *map(sympy.sympify, arguments))  # type: ignore[no-any-return]


class Scalar(Operation):
    """An operation whose result is no vector."""


class Part(Operation):
    """`Part(vector, begin, end)` and `Part(vector, begin, end, step)`: components `begin`, `begin + step`, ..."""

    word = "part"


class Entry(Scalar):
    """`Entry(vector, place)`: one component."""

    word = "entry"


class Sum(Scalar):
    """`Sum(vector)`: all components added up."""

    word = "total"


class Column(Operation):
    """`Column(x)`: a scalar as a vector of one component, which stands beside vectors of any number."""

    word = "column"


class Join(Operation):
    """`Join(like, vectors...)`: one behind the other."""

    word = "join"


class Spread(Operation):
    """`Spread(like, x, count)`: a scalar as a vector of equal components."""

    word = "spread"


class Indices(Operation):
    """`Indices(like, first, end)`: the numbers from `first` to `end - 1`."""

    word = "indices"
