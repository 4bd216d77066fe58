"""Points at which a model is compared with its truth: the paper's test points, generalised to any model.

Right-hand sides and functions are compared at `rhs_points` points, one on each of as many true trajectories drawn as
in the sampling, at a time drawn uniformly from `window`. Solutions are compared after `horizon`, from points on the
attractor: for `conditions` sets of conditions, evenly over their ranges, the truth is integrated for `settle` and then
gives `points` initial states `spacing` apart. A model that is driven by inputs, doses or time has no attractor; the
first of the points above are then the initial states, and the inputs continue as drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.simulation import Boxes, Plan, Region, boxes, plan, regions
from gbspec.analysis.systems import quasirandom_points, trained_ranges
from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError, Findings
from gbspec.ir import whole

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.data import MetricsOptions, Signal, SimulateOptions
    from gbspec.ir import Condition, Input, Model


RTOL = 1e-8
"""Relative tolerance of the truth's solutions, from given initial states."""
DRAWN = 1e-5
"""Relative tolerance of the solutions that lead to a test point, whose exact position does not matter."""
ATTEMPTS = 200
CHECKS = 32
"""The number of times at which a trajectory is tested for rejected regions."""


@dataclass(frozen=True)
class RhsPoints:
    """Points of the truth: times [N], states [N, n], conditions [N, c], inputs (and delayed values) [N, u],
    signals of each."""

    times: Array
    states: Array
    conditions: Array
    inputs: Array
    signals: tuple[tuple[Signal, ...], ...]


@dataclass(frozen=True)
class SolutionPoints:
    """Initial states of the truth [M, n] at times [M], with conditions [M, c] and signals, and final states [M, n]."""

    times: Array
    starts: Array
    conditions: Array
    signals: tuple[tuple[Signal, ...], ...]
    horizon: float
    ends: Array


class Sampler:
    """Draws trajectories of the truth. Raises UserError (GB751 to GB755) if the sampling does not fit the model."""

    def __init__(self, evaluator: Evaluator, model: Model, sampling: SimulateOptions, options: MetricsOptions) -> None:
        self.evaluator, self.model = evaluator, model
        self.options = options.settled(sampling.span)
        low, high = self.options.window or (0.0, sampling.span)
        self.window = (low, high)
        self.sampling = replace(sampling, span=max(high, sampling.span), channels="all", clock={})
        findings = Findings()
        self.box: Boxes = boxes(model, self.sampling, findings)
        self.reject: tuple[Region, ...] = regions(self.sampling.reject, model, findings)
        findings.raise_if_failed()

    def reach(
        self, random: np.random.Generator, after: Callable[[], float], condition: Array | None = None
    ) -> tuple[Plan, float, Array]:
        """A drawn trajectory, a time `after` its start and the state [n] then; drawn again if it is rejected."""
        reason = "it has too few times"
        for _ in range(ATTEMPTS):
            drawn = plan(self.model, self.sampling, self.box, "", random)
            if drawn is None:
                continue
            if condition is not None:
                drawn = replace(drawn, condition=condition)
            time = drawn.start + after()
            try:
                states = self._solve(drawn, time)
            except ComputationError as error:
                reason = error.what
                continue
            if states is not None:
                return drawn, time, states
            reason = "it enters a rejected region"
        raise ComputationError(
            f"no test trajectory of the truth was found in {ATTEMPTS} draws; the last: {reason}",
            where="the points at which the model is compared with its truth",
            remedy="declare narrower ranges of the states; in `cases.toml`, narrow `initial` or reject less",
        )

    def _solve(self, drawn: Plan, time: float) -> Array | None:
        """The state [n] at a time of a plan; None if the trajectory enters a rejected region before."""
        # Equal parts of the span have the same relative times, so one integrator serves all trajectories.
        parts = CHECKS if self.reject else 1
        times = drawn.start + (time - drawn.start) * np.arange(1, parts + 1) / parts
        times[-1] = time
        x0 = self.evaluator.initial(drawn.x0, drawn.condition, None, drawn.inputs, drawn.start)
        states = self.evaluator.integrate(
            x0, times, drawn.condition, drawn.inputs, drawn.start, doses=drawn.doses, rtol=DRAWN, atol=DRAWN
        )
        inputs = self.inputs_at(drawn.inputs, times)
        path = np.vstack([x0, states]), np.append(drawn.start, times), np.vstack([inputs[:1], inputs])
        for region in self.reject:
            if region.entered(path[1], path[0], drawn.condition, path[2], self.evaluator.constants):
                return None
        return np.asarray(states[-1], dtype=float)

    def _late(self, drawn: Plan, time: float) -> Array:
        """The delayed values [1, n_delays] at a time of a plan."""
        x0 = self.evaluator.initial(drawn.x0, drawn.condition)
        times = np.array([time])
        found = self.evaluator.followed(
            x0, times, drawn.condition, drawn.inputs, drawn.start, doses=drawn.doses, rtol=DRAWN, atol=DRAWN
        )
        return found[1]

    def inputs_at(self, signals: tuple[Signal, ...], times: Array) -> Array:
        """The inputs [T, m] at times."""
        from gbspec.data import evaluate

        columns = [evaluate(s, item.interpolation, times) for s, item in zip(signals, self.model.inputs, strict=True)]
        return np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))

    # ------------------------------------------------------------------ the points
    def rhs_points(self) -> RhsPoints:
        """One point on each of `rhs_points` trajectories."""
        found = []
        for i in range(self.options.rhs_points):
            random = np.random.default_rng([self.options.seed, i, 2])
            found.append(self.reach(random, lambda random=random: random.uniform(*self.window)))  # type: ignore[misc]  # a default binds the loop's value
        drawn = [one for one, _, _ in found]
        inputs = np.concatenate([self.inputs_at(one.inputs, np.array([time])) for one, time, _ in found])
        if self.model.delays:
            inputs = np.hstack([inputs, np.concatenate([self._late(one, time) for one, time, _ in found])])
        return RhsPoints(
            times=np.array([time for _, time, _ in found]),
            states=np.array([state for _, _, state in found]),
            conditions=np.array([one.condition for one in drawn]).reshape(len(found), -1),
            inputs=inputs,
            signals=tuple(one.inputs for one in drawn),
        )

    def solution_points(self, rhs: RhsPoints) -> SolutionPoints:
        """Initial states on the attractor (for a driven model, on trajectories) and the final states."""
        horizon = float(self.options.horizon or self.sampling.span / 2.0)
        driven = bool(self.model.inputs or self.model.doses) or self.evaluator.rhs.jac_sparsity(0, 0).nnz() > 0
        if driven:
            count = min(len(rhs.times), self.options.conditions * self.options.points)
            points = rhs.times[:count], rhs.states[:count], rhs.conditions[:count], rhs.signals[:count]
        else:
            points = self._attractor(horizon)
        times, starts, conditions, signals = points
        ends = solve_ends(self.evaluator, times, starts, conditions, signals, horizon)
        good = np.asarray(np.isfinite(ends).all(axis=1))
        kept = tuple(one for one, is_good in zip(signals, good, strict=True) if is_good)
        return SolutionPoints(times[good], starts[good], conditions[good], kept, horizon, ends[good])

    def _attractor(self, horizon: float) -> tuple[Array, Array, Array, tuple[tuple[Signal, ...], ...]]:
        options = self.options
        length = options.period if options.period is not None else horizon
        spacing = options.spacing if options.spacing is not None else length / options.points
        starts, conditions = [], []
        for i, condition in enumerate(self._conditions()):
            random = np.random.default_rng([options.seed, i, 3])
            _, _, settled = self.reach(random, lambda: float(options.settle or self.sampling.span / 5.0), condition)
            times = spacing * np.arange(options.points)
            starts.append(self.evaluator.integrate(settled, times, condition, start=0.0, rtol=RTOL, atol=RTOL))
            conditions.append(np.repeat(condition[None], options.points, axis=0))
        count = len(starts) * options.points
        return np.zeros(count), np.concatenate(starts), np.concatenate(conditions), ((),) * count

    def _conditions(self) -> Array:
        """Sets of conditions [N, c]: evenly spaced for one condition, quasirandom for several."""
        box, count = self.box.conditions, self.options.conditions
        if len(box) == 1:
            return whole(self.model.conditions, np.linspace(box[0, 0], box[0, 1], count)[:, None])
        points = quasirandom_points(count, len(box), self.options.seed)
        return whole(self.model.conditions, box[:, 0] + (box[:, 1] - box[:, 0]) * points) if len(box) else points


def solve_ends(
    evaluator: Evaluator,
    times: Array,
    starts: Array,
    conditions: Array,
    signals: tuple[tuple[Signal, ...], ...],
    horizon: float,
    rtol: float = RTOL,
) -> Array:
    """The states [M, n] one horizon after each initial state; NaN if the solution cannot be continued."""
    ends = np.full(starts.shape, np.nan)
    for i, (time, start, condition, inputs) in enumerate(zip(times, starts, conditions, signals, strict=True)):
        try:
            ends[i] = evaluator.integrate(
                start, [time + horizon], condition, inputs, float(time), rtol=rtol, atol=rtol
            )[0]
        except ComputationError:
            continue
    return ends


def sampling_for(model: Model, sampling: SimulateOptions, member: GeneratedModule) -> SimulateOptions:
    """The sampling, with boxes that neither it nor the model has taken from the trained initial states and ranges."""
    learned = member.weights.get("initial")
    initial, condition = dict(sampling.initial), dict(sampling.condition)
    for i, state in enumerate(model.states):
        ranged = state.range is not None and state.range.bounded
        expressed = state.initial.known
        if not ranged and not expressed and state.name not in initial and learned is not None and len(learned):
            initial[state.name] = (float(learned[:, i].min()), float(learned[:, i].max()))
    trained = trained_ranges(model, member)
    external: tuple[Condition | Input, ...] = (*model.conditions, *model.inputs)
    for item in external:
        ranged = item.range is not None and item.range.bounded
        if not ranged and item.name not in condition and item.name in trained:
            condition[item.name] = trained[item.name]
    return replace(sampling, initial=initial, condition=condition)


__all__ = ["RhsPoints", "Sampler", "SolutionPoints", "sampling_for", "solve_ends"]
