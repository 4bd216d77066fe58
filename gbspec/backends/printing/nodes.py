"""Nodes that the backends add to sympy's: temporaries, a choice of two values, a guard that stops gradients of the
branch not taken, and operations on vectors."""

from __future__ import annotations

from typing import ClassVar

import sympy


class Temporary(sympy.Dummy):  # type: ignore[misc]  # sympy is untyped
    """A symbol that the backend introduces; in products it follows the model's, like `phi` in `B*phi`."""

    is_Dummy = False  # noqa: N815 - sympy's name; needed to sort it among symbols

    @classmethod
    def class_key(cls) -> tuple[int, int, str]:
        """The sort key of a symbol."""
        return 2, 0, "Symbol"


def temporary(name: str, real: bool = True) -> Temporary:
    """A new temporary with the preferred name `name`."""
    return Temporary(name, real=True) if real else Temporary(name)


class Where(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """`Where(condition, a, b)`: a if the condition holds, else b; both are evaluated."""

    word: ClassVar[str] = "where"

    def __new__(cls, condition: sympy.Basic, a: sympy.Expr, b: sympy.Expr) -> Where:
        """Creates the node without simplification."""
        return super().__new__(cls, condition, a, b)  # type: ignore[no-any-return]


class Guard(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """`Guard(condition, x)`: the value x; gradients pass only if the condition holds.

    In the branch of a choice that is not taken, a derivative may be infinite (`sqrt(x)` at 0, `exp(x)` for large x);
    its product with zero is NaN, which would spoil the gradient of the branch that is taken.
    """

    word: ClassVar[str] = "guard"

    def __new__(cls, condition: sympy.Basic, x: sympy.Expr) -> Guard:
        """Creates the node without simplification."""
        return super().__new__(cls, condition, x)  # type: ignore[no-any-return]


class VectorTemporary(Temporary):
    """A temporary that is a vector: its components are on the last axis (in casadi, a column)."""


STATE = VectorTemporary("state", real=True)
"""The vector of all states."""


def temporary_like(name: str, *values: sympy.Basic, real: bool = True) -> Temporary:
    """A new temporary for a result computed from these values: a vector if one of them is."""
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
        """Takes the function's arguments in order; nothing is evaluated."""
        return super().__new__(cls, *map(sympy.sympify, arguments))  # type: ignore[no-any-return]


class Scalar(Operation):
    """An operation whose result is a scalar."""


class Part(Operation):
    """`Part(vector, begin, end)` and `Part(vector, begin, end, step)`: components `begin`, `begin + step`, ..."""

    word = "part"


class Entry(Scalar):
    """`Entry(vector, index)`: one component."""

    word = "entry"


class Sum(Scalar):
    """`Sum(vector)`: the sum of all components."""

    word = "total"


class Column(Operation):
    """`Column(x)`: a scalar as a vector of one component, which broadcasts with vectors of any length."""

    word = "column"


class Join(Operation):
    """`Join(like, vectors...)`: the vectors concatenated."""

    word = "join"


class Repeat(Operation):
    """`Repeat(like, x, count)`: a scalar as a vector of equal components."""

    word = "repeat"


class Indices(Operation):
    """`Indices(like, first, end)`: the numbers from `first` to `end - 1`."""

    word = "indices"
