"""Nodes that the backends add to sympy's: temporaries, a choice of two, a value whose gradient counts where chosen."""

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
