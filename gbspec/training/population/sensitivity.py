"""The model together with the sensitivities of its states to constants, as a model of its own.

With S = dx/dk for the constants k that are distributed, S' = (df/dx) S + df/dk. A Runge-Kutta step of this larger
system computes the derivative of the step of x exactly, so that its solution is the derivative of the numerical
solution, and its Jacobian with respect to all constants has the mixed second derivatives. Steps are those of the model
alone, adaptive ones included. So are the matrices of a Rosenbrock-W method, by which x and each S are divided: they are
constants in derivatives, and the derivative of a stage with a constant matrix is that stage of S with the same matrix.

Its channels are those of the model, then for each k the derivatives of all channels. The derivative rules are those of
`gbspec.ir.derivatives`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from gbspec.data import Limits
from gbspec.ir import Channel, Dose, Expr, Initial, Model, State, derivative, symbol
from gbspec.training.problem import Integers, Packed, Path, with_doses


@dataclass(frozen=True)
class Extended:
    """The larger model, and for each of its doses the model's dose with the same times and amounts."""

    model: Model
    doses: tuple[int, ...]


def extended(model: Model, constants: Sequence[str]) -> Extended | None:
    """The model with sensitivities to these constants; None where they have another form.

    That is so for unknown functions, whose derivatives are no expressions, and for doses whose lag depends on the
    constants, which move their arrivals.
    """
    by = [symbol(name) for name in constants]
    if model.unknowns or any(dose.lag.has(k) for dose in model.doses for k in by):
        return None
    names = [state.name for state in model.states]
    given = [*model.balances, *(c.value for c in model.channels)]
    expressions = model.inlined(given)
    balances, outputs = expressions[: len(names)], expressions[len(names) :]
    states, more, channels = (
        list(model.states),
        list(balances),
        [_channel(c.name, v) for c, v in zip(model.channels, outputs, strict=True)],
    )
    doses, kinds = list(model.doses), list(range(len(model.doses)))
    for k in by:
        tangent = {name: symbol(f"d {name} / d {k.name}") for name in names}

        def along(expression: Expr, k: sympy.Symbol = k, tangent: dict[str, sympy.Symbol] = tangent) -> Expr:
            """The total derivative of an expression in states and constants."""
            moved = [derivative(expression, symbol(n)) * tangent[n] for n in names if expression.has(symbol(n))]
            return sympy.Add(derivative(expression, k), *moved)

        for state, balance in zip(model.states, balances, strict=True):
            start = state.initial.value
            value = sympy.S.Zero if start is None else along(model.inlined([start])[0])
            states.append(State(tangent[state.name].name, initial=Initial("expression", value)))
            more.append(along(balance))
        channels += [_channel(f"{c.name} / {k.name}", along(v)) for c, v in zip(model.channels, outputs, strict=True)]
        for kind, dose in enumerate(model.doses):
            share = derivative(model.inlined([dose.fraction])[0], k)
            if share != 0:
                doses.append(Dose(tangent[dose.state].name, share, dose.lag))
                kinds.append(kind)
    made = replace(
        model,
        name="sensitivities",
        states=tuple(states),
        balances=tuple(more),
        channels=tuple(channels),
        doses=tuple(doses),
        intermediates=(),
        processes=(),
        arrays=(),
        families=(),
        claims=(),
        truth_constants=(),
        truth_functions=(),
    )
    return Extended(_renamed(made), tuple(kinds))


def _channel(name: str, value: Expr) -> Channel:
    return Channel(name, value)


def _renamed(model: Model) -> Model:
    """The model with names that a module can have in place of those that describe states and channels."""
    taken = {
        *model.constant_names,
        *(c.name for c in model.conditions),
        *(u.name for u in model.inputs),
        model.time.name,
    }

    def free(word: str, i: int) -> str:
        name = f"{word}{i}"
        while name in taken:
            name += "_"
        return name

    names = {s.name: free("state_", i) for i, s in enumerate(model.states)}
    table = {symbol(old): symbol(new) for old, new in names.items()}
    states = tuple(
        replace(s, name=names[s.name], range=None, initial=replace(s.initial, value=_moved(s.initial.value, table)))
        for s in model.states
    )
    return replace(
        model,
        states=states,
        balances=tuple(b.xreplace(table) for b in model.balances),
        channels=tuple(
            Channel(free("channel_", i), c.value.xreplace(table), column=free("channel_", i))
            for i, c in enumerate(model.channels)
        ),
        doses=tuple(replace(d, state=names[d.state]) for d in model.doses),
    )


def _moved(value: Expr | None, table: dict[sympy.Symbol, sympy.Symbol]) -> Expr | None:
    return None if value is None else value.xreplace(table)


def widened(path: Path, times: int, doses: tuple[int, ...]) -> Path:
    """The path of the larger model: the steps of the model's own."""
    return with_doses(path, repacked(path.packed, times, doses), _moving(path.packed, doses)[0])


def _moving(packed: Packed, doses: tuple[int, ...]) -> tuple[Integers, Integers]:
    """For each dose of the larger model, the dose of the packing, and its kind."""
    rows = [np.flatnonzero(packed.doses.kind == kind) for kind in doses]
    pick = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
    kind = np.concatenate([np.zeros(0, dtype=np.int64), *(np.full(len(r), i) for i, r in enumerate(rows))])
    order = np.argsort(pick, kind="stable")  # in the order of the table: by trajectory and time
    return pick[order], kind[order].astype(np.int64)


def repacked(packed: Packed, times: int, doses: tuple[int, ...]) -> Packed:
    """A packing of the larger model: every channel `times` times, and doses that also move sensitivities."""
    own, (pick, kind) = packed.doses, _moving(packed, doses)
    known = tuple(own.known[i] for i in doses)
    table = replace(own, owner=own.owner[pick], kind=kind, time=own.time[pick], amount=own.amount[pick], known=known)
    of_rows = packed.values, packed.weights, packed.sd, packed.scatter
    values, weights, sd, scatter = (np.tile(part, (1, times)) for part in of_rows)
    limits = Limits(np.tile(packed.limits.value, (1, times)), np.tile(packed.limits.side, (1, times)))
    return replace(packed, doses=table, values=values, weights=weights, sd=sd, scatter=scatter, limits=limits)
