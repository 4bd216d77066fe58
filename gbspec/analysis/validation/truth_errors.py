"""A fitted run against its model's truth: solution, right-hand side, functions and constants (paper, appendix)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import sympy

from gbspec.analysis.validation.comparison_points import RhsPoints, Sampler, SolutionPoints, sampling_for, solve_ends
from gbspec.analysis.validation.metrics import Norms, norms, relative_errors
from gbspec.arrays import Array
from gbspec.files import finite
from gbspec.ir import right_sides, symbol, unknown_function

if TYPE_CHECKING:
    from gbspec.backends import Evaluator
    from gbspec.data import MetricsOptions, SimulateOptions
    from gbspec.ir import Model
    from gbspec.runs import Support


LEARNED_RTOL = 1e-7
"""Relative tolerance at which learned solutions are compared: far below any error of a fit."""
HARDLY_VARIES = 1e-2
"""A function whose truth varies by less than this part of its magnitude is compared relative to the magnitude: an
error relative to the variation would say nothing about the function's values."""


@dataclass(frozen=True)
class TruthErrors:
    """Errors against the truth. `functions` has each unknown by name, and under `all` the vector of them; `on_data`
    each of them at the arguments that it had in the training.

    `constants` has the relative error of each learnable with a truth, and their mean as `all`, or is empty.
    `protocol` describes the points of the comparison.
    """

    solution: Norms
    rhs: Norms
    functions: Mapping[str, Norms] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    protocol: Mapping[str, float] = field(default_factory=dict)
    on_data: Mapping[str, Norms] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """Keys solution, rhs, functions, constants, then the protocol."""
        return {
            "solution": self.solution.to_json(),
            "rhs": self.rhs.to_json(),
            "functions": {name: value.to_json() for name, value in self.functions.items()},
            "constants": {name: finite(value) for name, value in self.constants.items()},
            "functions_on_data": {name: value.to_json() for name, value in self.on_data.items()},
            "protocol": dict(self.protocol),
        }

    def __str__(self) -> str:
        lines = {"solution": str(self.solution), "right-hand side": str(self.rhs)}
        lines |= {f"function {name}": str(value) for name, value in self.functions.items()}
        lines |= {f"{name}, training data": str(value) for name, value in self.on_data.items()}
        if self.constants:
            each = ", ".join(f"{name} {value:.3g}" for name, value in self.constants.items() if name != "all")
            lines["constants"] = f"{self.constants['all']:.3g} ({each})"
        width = max(map(len, lines)) + 2
        return "\n".join(f"{name:<{width}}{value}" for name, value in lines.items())


def truth_errors(
    model: Model,
    evaluators: Sequence[Evaluator],
    sampling: SimulateOptions,
    options: MetricsOptions,
    support: Mapping[str, Support] | None = None,
) -> TruthErrors:
    """Compares the mean of the members' `evaluators` with the truth of their model; `support` has the arguments of each
    network in the training.

    Raises UserError if the model has no truth (GB803) or the sampling does not fit it (GB751 to GB755), and
    ComputationError if the truth cannot be solved.
    """
    truth = truth_evaluator(model)
    known = truth_model(model)
    sampler = Sampler(truth, known, sampling_for(model, sampling, evaluators[0].instance), options)
    at = sampler.rhs_points()
    solution = sampler.solution_points(at)
    protocol = {
        "settle": float(sampler.options.settle or 0.0),
        "horizon": solution.horizon,
        "starts": float(len(solution.starts)),
        "window_from": sampler.window[0],
        "window_to": sampler.window[1],
        "rhs_points": float(len(at.times)),
    }
    return TruthErrors(
        solution=_solution(model, evaluators, solution, options.scales),
        rhs=_rhs(model, evaluators, truth, at, solution.horizon, options.scales),
        functions=_functions(model, evaluators, truth, at),
        constants=_constants(model, evaluators),
        protocol=protocol,
        on_data=_on_data(model, evaluators, truth, support or {}),
    )


def has_reference(model: Model) -> bool:
    """Whether there is a truth to compare with: all unknowns have one, and at least one learned quantity does."""
    return model.has_truth and bool(model.truth_functions or model.truth_constants)


def without_truth(model: Model) -> tuple[str, ...]:
    """The learnables without a truth; the reference uses their starting values."""
    known = {item.name for item in model.truth_constants}
    return tuple(item.name for item in model.learnables if item.name not in known)


def truth_model(model: Model) -> Model:
    """The model with the truth substituted for all learned quantities."""
    from gbspec.passes import with_truth

    return with_truth(model)


def truth_evaluator(model: Model) -> Evaluator:
    """An evaluator of the model's truth: the same module and functions as for a fitted run."""
    from gbspec.backends import Evaluator, load_module

    return Evaluator(load_module(truth_model(model))())


def _scales(model: Model, scales: Mapping[str, float]) -> Array:
    """Fallback scales [n] for states whose truth does not vary: given, else the width of the range, else 1."""
    found = []
    for state in model.states:
        width = state.range.high - state.range.low if state.range is not None and state.range.bounded else 1.0
        found.append(float(scales.get(state.name, width)))
    return np.array(found)


def _solution(
    model: Model, evaluators: Sequence[Evaluator], points: SolutionPoints, scales: Mapping[str, float]
) -> Norms:
    ends = np.mean(
        [
            solve_ends(
                one, points.times, points.starts, points.conditions, points.signals, points.horizon, LEARNED_RTOL
            )
            for one in evaluators
        ],
        axis=0,
    )
    return norms(points.ends, ends, _scales(model, scales), [state.name for state in model.states])


def _rhs(
    model: Model,
    evaluators: Sequence[Evaluator],
    truth: Evaluator,
    at: RhsPoints,
    horizon: float,
    scales: Mapping[str, float],
) -> Norms:
    arguments = (at.times, at.states, at.conditions, at.inputs)
    learned = np.mean([one.rhs_many(*arguments) for one in evaluators], axis=0)
    names = [state.name for state in model.states]
    return norms(truth.rhs_many(*arguments), learned, _scales(model, scales) / horizon, names)


def _constants(model: Model, evaluators: Sequence[Evaluator]) -> dict[str, float]:
    truth = {item.name: item.value for item in model.truth_constants}
    if not truth:
        return {}
    names = model.constant_names
    learned = {name: float(np.mean([one.constants[names.index(name)] for one in evaluators])) for name in truth}
    errors = relative_errors(truth, learned)
    return {"all": float(np.mean(list(errors.values()))), **errors}


# ---------------------------------------------------------------------- functions
def _functions(model: Model, evaluators: Sequence[Evaluator], truth: Evaluator, at: RhsPoints) -> dict[str, Norms]:
    """The errors of each unknown at its arguments at all points; under `all`, those applied once as one vector."""
    columns: dict[str, tuple[Array, Array]] = {}
    first: dict[str, tuple[Array, Array]] = {}
    for name, tables in _arguments(model, truth, at).items():
        true = _true_function(model, name, truth.constants)
        pairs = [
            (true(table), np.asarray(np.mean([one.functions_many(name, table) for one in evaluators], axis=0)))
            for table in tables
        ]
        first[name] = pairs[0]
        columns[name] = np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
    if not columns:
        return {}
    found = {name: _norms_of([name], [pair]) for name, pair in columns.items()}
    return {"all": _norms_of(list(first), list(first.values())), **found}


def _on_data(
    model: Model, evaluators: Sequence[Evaluator], truth: Evaluator, support: Mapping[str, Support]
) -> dict[str, Norms]:
    """The errors of each unknown at the arguments that its network had in the training."""
    found = {}
    for unknown in model.unknowns:
        known = support.get(model.networks[unknown.network].name)
        if known is not None and len(known.points):
            learned = np.mean([one.functions_many(unknown.name, known.points) for one in evaluators], axis=0)
            true = _true_function(model, unknown.name, truth.constants)(known.points)
            found[unknown.name] = _norms_of([unknown.name], [(true, np.asarray(learned))])
    return found


def _norms_of(names: Sequence[str], pairs: Sequence[tuple[Array, Array]]) -> Norms:
    true, learned = (np.stack(columns, axis=1) for columns in zip(*pairs, strict=True))
    size = np.abs(true).max(axis=0)
    return norms(true, learned, np.where(size > 0, size, 1.0), names, HARDLY_VARIES)


def _arguments(model: Model, truth: Evaluator, at: RhsPoints) -> dict[str, list[Array]]:
    """For every unknown that is applied, the arguments [N, a] of each application at the true points."""
    expressions = right_sides(model)
    applied = {one for expression in expressions for one in expression.atoms(sympy.core.function.AppliedUndef)}
    functions = {unknown.name: unknown_function(unknown.name) for unknown in model.unknowns}
    found = {
        name: sorted((one for one in applied if one.func == function), key=sympy.default_sort_key)
        for name, function in functions.items()
    }
    # All in one call: an array's balances apply a function once per element, and separate calls would be slow.
    values = iter(_values(model, [part for each in found.values() for one in each for part in one.args], truth, at))
    tables = {
        name: [np.stack([next(values) for _ in one.args], axis=1) for one in each] for name, each in found.items()
    }
    return {name: each for name, each in tables.items() if each}


def _values(model: Model, expressions: Sequence[sympy.Expr], truth: Evaluator, at: RhsPoints) -> list[Array]:
    """Expressions of the model [N] each at the points; unknowns in them are replaced by their truths."""
    names = [
        model.time.symbol,
        *(item.symbol for item in (*model.states, *model.conditions, *model.inputs)),
        *(delay.symbol for delay in model.delays),
        *(item.symbol for item in model.constants),
        *(item.symbol for item in model.learnables),
    ]
    numbers = [at.times, *at.states.T, *at.conditions.T, *at.inputs.T, *map(float, truth.constants)]
    if model.algebraics:
        names += [item.symbol for item in model.algebraics]
        numbers += [*truth.algebraics_many(at.times, at.states, at.conditions, at.inputs).T]
    bodies = {item.name: item for item in model.truth_functions}

    def known(expression: sympy.Expr) -> sympy.Expr:
        inner = sorted(expression.atoms(sympy.core.function.AppliedUndef), key=sympy.default_sort_key)
        table = {}
        for one in inner:
            body = bodies[one.func.__name__]
            formals = [symbol(parameter) for parameter in body.parameters]
            table[one] = body.value.xreplace(dict(zip(formals, map(known, one.args), strict=True)))
        return expression.xreplace(table)

    found = sympy.lambdify(names, [known(one) for one in expressions], modules="numpy", dummify=True)(*numbers)
    return [np.broadcast_to(np.asarray(value, dtype=float), at.times.shape).copy() for value in found]


def _true_function(model: Model, name: str, constants: Array) -> Callable[[Array], Array]:
    """The truth of an unknown: values [N] at arguments [N, a]."""
    body = next(item for item in model.truth_functions if item.name == name)
    symbols = [symbol(parameter) for parameter in body.parameters]
    shared = [item.symbol for item in (*model.constants, *model.learnables) if item.name not in body.parameters]
    numbers = dict(zip(model.constant_names, map(float, constants), strict=True))
    function = sympy.lambdify([*symbols, *shared], body.value, modules="numpy", dummify=True)

    def values(table: Array) -> Array:
        with np.errstate(all="ignore"):
            value = function(*table.T, *(numbers[one.name] for one in shared))
        return np.broadcast_to(np.asarray(value, dtype=float), (len(table),)).copy()

    return values
