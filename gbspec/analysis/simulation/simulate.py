"""Simulated measurements from a model's truth or from a fitted run: what `gbspec simulate` writes.

Solutions come from the evaluator's adaptive solver at a relative tolerance of 1e-10, not from the fixed steps of the
training; those of models with random disturbances from `disturbed`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gbspec.analysis.simulation.design import Boxes, Plan, boxes, plan, plan_like
from gbspec.analysis.simulation.disturbed import disturbed_path
from gbspec.analysis.simulation.region import Region, regions
from gbspec.analysis.systems import Individuals
from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.data import (
    DoseEvents,
    Signal,
    SimulateOptions,
    Trajectories,
    Trajectory,
    clipped,
    evaluate,
    form_of,
    states_beyond,
)
from gbspec.diagnostics import ComputationError, Findings
from gbspec.ir import Model, count_moments, count_quantile, counted_channels, without_values

__all__ = ["SimulateOptions", "Solver", "simulate", "solve"]

TOLERANCE = 1e-10
DENSE = 400
"""The number of points over its span at which a trajectory is tested for rejected regions."""
ATTEMPTS = 200
"""Most draws for one trajectory."""


class Solver(Protocol):
    """The part of an evaluator that simulation needs: constants, initial states, solutions and channels."""

    constants: Array
    """The constants' values, in the model's order."""

    @property
    def instance(self) -> GeneratedModule:
        """The module with its weights."""

    def initial(
        self, x0: Array, condition: Array, constants: Array | None, inputs: tuple[Signal, ...], at: float
    ) -> Array:
        """The initial state [n] at time `at`, with the values that the model gives inserted; raises
        ComputationError."""

    def integrate(
        self,
        x0: Array,
        times: Array,
        condition: Array,
        inputs: tuple[Signal, ...],
        start: float,
        *,
        doses: tuple[DoseEvents, ...],
        rtol: float,
    ) -> Array:
        """States [T, n] at `times` from `x0` at `start`; raises ComputationError."""

    def followed(
        self,
        x0: Array,
        times: Array,
        condition: Array,
        inputs: tuple[Signal, ...],
        start: float,
        *,
        doses: tuple[DoseEvents, ...],
        rtol: float,
    ) -> tuple[Array, Array]:
        """The same, and the delayed values [T, n_delays]."""

    def observe_many(self, t: Array, x: Array, condition: Array, inputs: Array) -> Array:
        """Channels [T, C] at times [T], states [T, n], and inputs with the delayed values behind them [T, m]."""


@dataclass(frozen=True)
class Solved:
    """A plan with its noise-free measurements [T, C] (all channels, measured or not) and its states [T, n]."""

    plan: Plan
    values: Array
    states: Array


@dataclass
class Tally:
    """Counts of plans that were drawn and not used."""

    rejected: int = 0
    failed: int = 0
    reason: str = ""

    def reject(self, reason: str) -> None:
        """Counts a rejected plan."""
        self.rejected, self.reason = self.rejected + 1, reason

    def fail(self, reason: str) -> None:
        """Counts a plan that could not be solved."""
        self.failed, self.reason = self.failed + 1, reason


def simulate(
    evaluator: Solver,
    model: Model,
    options: SimulateOptions,
    like: Trajectories | None = None,
    progress: Callable[[int, int], None] | None = None,
    individuals: Individuals | None = None,
) -> Trajectories:
    """Simulated measurements for `model`, whose right-hand side `evaluator` has.

    With `individuals`, each trajectory has constants of its own, drawn from their distribution.

    With `like`, times, conditions, inputs and doses come from a table, whose trajectories are simulated one by one. A
    trajectory that enters a rejected region or cannot be solved is drawn again; `meta` counts these, and has a
    line for each state that lies far outside of its range. `progress` is called with the numbers of trajectories done
    and in total.

    Raises UserError if the options do not fit the model (GB751 to GB756), ComputationError if 200 draws of a trajectory
    fail.
    """
    findings = Findings()
    options.check(findings)
    if not options.ranged:
        findings.raise_if_failed()
    if not model.channels:
        findings.error("GB756", f"the model `{model.name}` observes nothing", None, help="add `observe …` to it")
    box = boxes(model, options, findings, given=like is not None)
    reject = regions(options.reject, model, findings)
    findings.raise_if_failed()
    draws, tally, solved = _Draws(evaluator, model, options, box, reject, like, individuals), Tally(), []
    count = options.trajectories if like is None else len(like)
    for i in range(count):
        solved.append(draws.solved(i, tally))
        if progress is not None:
            progress(i + 1, count)
    known = dict(zip(model.constant_names, map(float, evaluator.constants), strict=True))
    items = _noisy(solved, model, options, known)
    channels = tuple(channel.name for channel in model.channels)
    meta = {"rejected": str(tally.rejected), "failed": str(tally.failed)}
    meta["outside"] = "\n".join(map(str, states_beyond(model, np.concatenate([one.states for one in solved]))))
    rows = sum(len(item.times) for item in items)
    return Trajectories(items, channels, rows=rows, meta=meta, form=form_of(model))


@dataclass(frozen=True)
class _Draws:
    """The design and generators from which trajectories are drawn."""

    evaluator: Solver
    model: Model
    options: SimulateOptions
    box: Boxes
    reject: tuple[Region, ...]
    like: Trajectories | None
    individuals: Individuals | None = None

    def plan(self, index: int, random: np.random.Generator) -> Plan | None:
        """One plan for trajectory `index`; None if fewer than two measurement times are in the span."""
        if self.like is None:
            return plan(self.model, self.options, self.box, str(index + 1), random)
        return plan_like(self.like.items[index], self.model, self.options, self.box, random)

    def _given(self, drawn: Plan) -> list[Array]:
        """All that the solution of a plan depends on: a model that gives every start and has no range draws nothing
        else, and would be solved in vain again and again."""
        signals = [part for one in drawn.inputs for part in (one.times, one.values)]
        doses = [part for one in drawn.doses for part in (one.times, one.amounts)]
        x0 = self.evaluator.initial(drawn.x0, drawn.condition, None, drawn.inputs, drawn.start)
        return [np.asarray(x0), np.array([drawn.start, drawn.begins]), drawn.condition, drawn.times, *signals, *doses]

    def solved(self, index: int, tally: Tally) -> Solved:
        """Trajectory `index`, drawn until it can be solved and is not rejected; ComputationError after 200 times, or if
        nothing is drawn."""
        random = np.random.default_rng([self.options.seed, index, 0])
        own, solver = Tally(), self.evaluator
        drawing = np.random.default_rng([self.options.seed, index, 3])
        failed: list[Array] = []
        last, fixed = ComputationError(""), False
        for _ in range(ATTEMPTS):
            drawn = self.plan(index, random)
            if drawn is None:
                own.reject("fewer than two measurement times were in the span")
                continue
            if self.individuals is not None:
                values = dict(zip((c.name for c in self.model.conditions), drawn.condition.tolist(), strict=True))
                solver = self.individuals.drawn(self.evaluator, drawing, values, self.options.seed)
            given: list[Array] = []
            try:
                given = self._given(drawn) if own.failed and self.individuals is None else []
                fixed = bool(given and failed and all(map(np.array_equal, given, failed)))
                if fixed:
                    break
                shaking = np.random.default_rng([self.options.seed, index, 2])
                solved = solve(solver, self.model, drawn, self.reject, shaking)
            except ComputationError as error:
                own.fail(error.what)
                failed, last = given, error
                continue
            if isinstance(solved, Region):
                own.reject(f"`{solved.text}` became true")
                continue
            tally.rejected += own.rejected
            tally.failed += own.failed
            return solved
        if fixed:
            what = f"trajectory {index + 1} cannot be solved, and nothing in it is drawn: {last.what}"
            raise ComputationError(what, where=last.where, remedy=last.remedy) from last
        raise ComputationError(
            f"trajectory {index + 1} was drawn {ATTEMPTS} times without success: "
            f"{own.failed} could not be solved, {own.rejected} were rejected; the last: {own.reason}",
            where=f"trajectory {index + 1}",
            remedy="narrow the box of initial states with `--initial`, change `--span` or `--dt`, or reject less"
            + (f"; {ends}" if (ends := without_values({t.name: t.curve for t in self.model.tables})) else ""),
        )


def true_starts(evaluator: Solver, model: Model, options: SimulateOptions) -> Array:
    """The initial states [trajectories, n] of the trajectories of `simulate` with the same options.

    They hold at the first row, unless the model fixes the time at which trajectories start. Raises as `simulate` does.
    """
    findings = Findings()
    box, reject = boxes(model, options, findings), regions(options.reject, model, findings)
    findings.raise_if_failed()
    draws = _Draws(evaluator, model, options, box, reject, None)
    starts = []
    for i in range(options.trajectories):
        drawn = draws.solved(i, Tally()).plan
        x0 = evaluator.initial(drawn.x0, drawn.condition, None, drawn.inputs, drawn.start)
        if drawn.begins > drawn.start:
            times = np.array([drawn.begins])
            x0 = evaluator.integrate(
                x0, times, drawn.condition, drawn.inputs, drawn.start, doses=drawn.doses, rtol=TOLERANCE
            )[-1]
        starts.append(x0)
    return np.array(starts)


def solve(
    evaluator: Solver,
    model: Model,
    drawn: Plan,
    reject: tuple[Region, ...] = (),
    random: np.random.Generator | None = None,
) -> Solved | Region:
    """The solution of a plan, or the rejected region that it entered; with the disturbances that `random` draws, if the
    model has any.

    Raises ComputationError if the solver fails or the solution is not finite.
    """
    end = float(drawn.times[-1])
    grid = np.linspace(drawn.start, end, DENSE) if reject else np.zeros(0)
    times = np.unique(np.concatenate([drawn.times, grid]))
    x0 = evaluator.initial(drawn.x0, drawn.condition, None, drawn.inputs, drawn.start)
    if model.diffusions and random is not None:
        states, late = disturbed_path(evaluator.instance, model, drawn, x0, times, random), np.zeros((len(times), 0))
    else:
        states, late = evaluator.followed(
            x0, times, drawn.condition, drawn.inputs, drawn.start, doses=drawn.doses, rtol=TOLERANCE
        )
    if not np.isfinite(states).all():
        raise ComputationError("the solution is not finite", where=f"trajectory {drawn.label}")
    inputs = input_values(model, drawn.inputs, times)
    for region in reject:
        if region.entered(times, states, drawn.condition, inputs, evaluator.constants):
            return region
    at = np.searchsorted(times, drawn.times)
    values = evaluator.observe_many(drawn.times, states[at], drawn.condition, np.hstack([inputs, late])[at])
    if not np.isfinite(values).all():
        raise ComputationError("a channel is not finite", where=f"trajectory {drawn.label}")
    return Solved(drawn, values, states[at])


def input_values(model: Model, signals: tuple[Signal, ...], times: Array) -> Array:
    """The inputs' values [T, inputs] at `times` (at a jump: the value after it)."""
    columns = [evaluate(s, item.interpolation, times) for s, item in zip(signals, model.inputs, strict=True)]
    return np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))


def _noisy(
    solved: list[Solved], model: Model, options: SimulateOptions, constants: Mapping[str, float]
) -> tuple[Trajectory, ...]:
    """The measurements with noise added.

    Its standard deviation is `noise` times that of each channel over everything measured; on a channel with lognormal
    noise it is relative to the value itself: value * exp(noise * e). Counts are always drawn from the distribution that
    the model states, with the values of its `constants`.
    """
    if not solved:
        return ()
    everything = np.concatenate([np.where(item.plan.mask, item.values, np.nan) for item in solved])
    with np.errstate(all="ignore"):
        mean = np.nansum(everything, axis=0) / np.maximum(1, (~np.isnan(everything)).sum(axis=0))
        count = np.maximum(1, (~np.isnan(everything)).sum(axis=0))
        deviation = np.sqrt(np.nansum((everything - mean) ** 2, axis=0) / count)
    relative = np.array([c.noise is not None and c.noise.kind == "lognormal" for c in model.channels], dtype=bool)
    items = []
    for index, item in enumerate(solved):
        random = np.random.default_rng([options.seed, index, 1])
        error = options.noise * random.standard_normal(item.values.shape)
        values = np.where(relative, item.values * np.exp(error * relative), item.values + error * deviation)
        for j in np.flatnonzero(counted_channels(model)).tolist():
            mean, variance = count_moments(model, j, item.values[:, j], constants)
            values[:, j] = count_quantile(random.random(len(mean)), mean, variance)
        items.append(_trajectory(item.plan, np.where(item.plan.mask, values, np.nan), model))
    return tuple(items)


def _trajectory(drawn: Plan, values: Array, model: Model) -> Trajectory:
    """A trajectory as read from its table: it starts at its first row, unless the model fixes the start."""
    end = float(drawn.times[-1])
    inputs = tuple(
        clipped(signal, item.interpolation, drawn.begins, end)
        for signal, item in zip(drawn.inputs, model.inputs, strict=True)
    )
    return Trajectory(
        label=drawn.label,
        start=drawn.begins,
        times=drawn.times,
        values=values,
        counts=(~np.isnan(values)).astype(float),
        sd=np.full(values.shape, np.nan),
        condition=drawn.condition,
        inputs=inputs,
        doses=drawn.doses,
    )
