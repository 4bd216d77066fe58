"""Totals that the balances conserve: with them steady states are not isolated, and are neither found nor followed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gbspec.diagnostics import Diagnostic, UserError

if TYPE_CHECKING:
    from gbspec.ir import Expr, Model
    from gbspec.passes import Law


def require_isolated(model: Model) -> None:
    """Raises UserError (GB877) for balances that conserve linear combinations of states, naming these and the
    statements that leave one state of each out; not where an infusion may change them."""
    from gbspec.ir import in_language
    from gbspec.passes import linear_laws

    laws = () if any(item.infuses for item in model.inputs) else linear_laws(model)
    if not laws:
        return
    solved = _solved(model, laws)
    conserved = " and ".join(f"`{in_language(total, model.conditions)}`" for _, total in solved)
    changes = [_instead(model, name, total, numbered=len(solved) > 1) for name, total in solved]
    message = (
        f"the balances of `{model.name}` conserve {conserved}: every total has steady states of its own, so that none"
        " can be found or followed before it is fixed"
    )
    help = f"fix what is conserved: write {'; '.join(changes)}"
    raise UserError([Diagnostic("GB877", message, None, help=help)])


def _solved(model: Model, laws: Sequence[Law]) -> list[tuple[str, Expr]]:
    """For each law the last state that no other law has, and what is conserved, that state's coefficient 1."""
    import sympy

    names = [state.name for state in reversed(model.states)]
    rows = sympy.Matrix([[dict(law.coefficients).get(name, sympy.S.Zero) for name in names] for law in laws])
    reduced, pivots = rows.rref()
    symbols = sympy.Matrix([sympy.Symbol(name, real=True) for name in names])
    return [(names[pivot], (reduced[row, :] * symbols)[0]) for row, pivot in enumerate(pivots)]


def _instead(model: Model, name: str, total: Expr, *, numbered: bool) -> str:
    """The statements in place of a state that follows from what is conserved."""
    import sympy

    from gbspec.ir import in_language

    rest = total - sympy.Symbol(name, real=True)
    if rest == 0:
        return f"`const {name} = …` in place of the state `{name}` and its balance"
    word = f"total_{name}" if numbered else "total"
    taken = {item.name for item in (*model.states, *model.conditions, *model.inputs)} | {*model.constant_names}
    while word in taken:
        word += "_"
    others = in_language(-rest, model.conditions)
    others = f"- {others[1:]}" if others.startswith("-") else f"+ {others}"
    return f"`const {word} = …` and `let {name} = {word} {others}` in place of the state `{name}` and its balance"
