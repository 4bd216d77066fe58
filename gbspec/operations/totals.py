"""Totals that the balances conserve: with them steady states are not isolated, and are neither found nor followed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from gbspec.diagnostics import Diagnostic, UserError

if TYPE_CHECKING:
    from gbspec.ir import Expr, Model
    from gbspec.passes import Law


def require_isolated(model: Model, values: Mapping[str, float]) -> None:
    """Raises UserError (GB877) for balances that conserve linear combinations of states, naming these and the
    statements that leave one state of each out; not where an infusion may change them. `values` are those of what is
    not varied: where some are zero, less may be left in the balances."""
    from gbspec.ir import in_language
    from gbspec.passes import linear_laws

    if any(item.infuses for item in model.inputs):
        return
    laws, at = linear_laws(model), ""
    used = {s.name for one in (*model.balances, *(i.value for i in model.intermediates)) for s in one.free_symbols}
    zero = [name for name, value in values.items() if value == 0.0 and name in used]
    if not laws and zero and (without := _without(model, zero)) is not None:
        laws = linear_laws(without)
        for name in list(zero):  # only those without which there would be no law
            fewer = _without(model, [one for one in zero if one != name])
            if laws and fewer is not None and (others := linear_laws(fewer)):
                laws, zero = others, [one for one in zero if one != name]
        at = f" where {' and '.join(f'`{name}`' for name in zero)} {'are' if len(zero) > 1 else 'is'} zero"
    if not laws:
        return
    solved = _solved(model, laws)
    kept = [in_language(total, model.conditions) for _, total in solved if not total.is_Symbol]
    still = [f"`{name}`" for name, total in solved if total.is_Symbol]
    said = [f"conserve {' and '.join(f'`{total}`' for total in kept)}"] if kept else []
    said += [f"leave {' and '.join(still)} where {'they start' if len(still) > 1 else 'it starts'}"] if still else []
    each = " or ".join(["total"] * bool(kept) + ["start"] * bool(still))
    changes = [_instead(model, name, total, numbered=len(kept) > 1) for name, total in solved]
    message = (
        f"the balances of `{model.name}` {' and '.join(said)}{at}: every {each} has steady states of its own, so that"
        " none can be found or followed before it is fixed"
    )
    help = f"fix what {'is conserved' if kept else 'stays'}: write {'; '.join(changes)}"
    help += f"; or set another value of {' or '.join(f'`{name}`' for name in zero)}" if at else ""
    raise UserError([Diagnostic("GB877", message, None, help=help)])


def _without(model: Model, zero: Sequence[str]) -> Model | None:
    """The model with these quantities zero; None if something is then not defined."""
    import sympy

    from gbspec.ir import symbol

    nothing = {symbol(name): sympy.S.Zero for name in zero}
    balances = tuple(balance.xreplace(nothing) for balance in model.balances)
    intermediates = tuple(replace(item, value=item.value.xreplace(nothing)) for item in model.intermediates)
    undefined = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)
    if any(one.has(*undefined) for one in (*balances, *(item.value for item in intermediates))):
        return None
    return replace(model, balances=balances, intermediates=intermediates)


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

    from gbspec.ir import in_language, new_name

    rest = total - sympy.Symbol(name, real=True)
    if rest == 0:
        return f"`const {name} = …` {_in_place_of(model, name)}"
    word = new_name(model, f"total_{name}" if numbered else "total")
    others = in_language(-rest, model.conditions)
    others = f"- {others[1:]}" if others.startswith("-") else f"+ {others}"
    return f"`const {word} = …` and `let {name} = {word} {others}` {_in_place_of(model, name)}"


def _in_place_of(model: Model, name: str) -> str:
    """What goes when a state no longer is one: its statements, and its place in processes."""
    state = model.states[model.state_index[name]]
    parts = [f"the state `{name}`", "its balance"]
    parts += ["its `initial`"] if state.initial.span is not None else []
    parts += ["its `diffusion`"] if any(one.state == name for one in model.diffusions) else []
    parts += ["its `dose`"] if any(one.state == name for one in model.doses) else []
    made = f"in place of {', '.join(parts[:-1])} and {parts[-1]}"
    in_process = any(name in dict(process.stoichiometry) for process in model.processes)
    return made + (f" (and leave `{name}` out of the sides of processes)" if in_process else "")
