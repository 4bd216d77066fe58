"""Checks whether the learned right-hand side is independent of the step that it was trained with.

A model trained through a Runge-Kutta step can depend on the error of that step (paper: case B). Trajectories are
solved from the same initial states with the training's step, with each of its sub-steps halved (which are shorter than
the step where inputs change often), and adaptively, and compared. Fits whose steps end where right-hand sides switch
(`--switches`) looked at half the step themselves; nothing here takes such steps.

Models with random disturbances were fitted by a filter, which solves from row to row: of these its predictions are
compared with those in half of its steps. Where it solves exactly there is nothing to compare.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.validation.metrics import truth_scale
from gbspec.arrays import Array
from gbspec.data import below_zero, evenly_spaced
from gbspec.files import finite
from gbspec.frames import counted
from gbspec.runs import DEPENDS, StepRecord, encode

if TYPE_CHECKING:
    from gbspec.analysis.prediction import Prediction
    from gbspec.backends import Evaluator
    from gbspec.data import Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Run


CONVERGED = 1e-4
"""If half the step changes less than this, the adaptive solution differs for another reason than the step."""
LOOKED_AT = 24
"""Most trajectories that are solved again with fixed steps."""
STATES_LOOKED_AT = 600
"""After a fit, the most states of all checked trajectories together: models with many states get fewer trajectories."""


@dataclass(frozen=True)
class StepCheck:
    """Largest differences, relative to the states' ranges, from the solution with the training's step `step`.

    `half_step`: of the solution with half the step; `adaptive`: of the adaptive one. None without a step or
    trajectories; infinite if the fixed step diverges. `unsolved`: number of trajectories that the training's step can
    solve and the adaptive solver cannot. `label`: the trajectory in which half the step differs most. `ahead`: it is
    that of a filter's predictions from row to row, for which there is no adaptive solution. `negative`: the states that
    are declared from zero and go below it.
    """

    half_step: float | None
    adaptive: float | None
    step: float | None = None
    trajectories: int = 0
    unsolved: int = 0
    label: str = ""
    ahead: bool = False
    negative: tuple[str, ...] = ()

    def record(self) -> StepRecord:
        """What `fit.json` keeps of it."""
        return StepRecord(finite(self.half_step), finite(self.adaptive), self.step, self.trajectories, self.unsolved)

    def to_json(self) -> dict[str, object]:
        """Keys half_step, adaptive, the step, the number of trajectories, and unsolved."""
        document: dict[str, object] = encode(self.record())
        return document

    @property
    def _checked(self) -> str:
        number = self.unsolved + self.trajectories
        return counted(number, "trajectory that was checked", "trajectories that were checked")

    @property
    def _below_zero(self) -> str:
        """What is likely where states are negative that are declared not to be."""
        if not self.negative:
            return ""
        names = ", ".join(f"`{name}`" for name in self.negative)
        return (
            f". {names} {'is' if len(self.negative) == 1 else 'are'} below 0 at times, where the declared range "
            "begins; fixed steps can cross a pole of the balances there, and adaptive ones meet it: a likely cause"
        )

    @property
    def warning(self) -> str | None:
        """The warning if the right-hand side depends on the step; otherwise None."""
        if self.ahead:
            return self._of_filter
        if self.unsolved and self.half_step is not None and self.half_step <= DEPENDS:
            return (
                f"an adaptive solver cannot solve {self.unsolved} of {self._checked}; the training step of "
                f"{self.step:.6g} can, and half of it changes the solutions by "
                f"{100 * self.half_step:.2g} % of the states' ranges at most, so that the step is not the reason"
                + self._below_zero
            )
        if self.unsolved:
            return (
                f"the learned right-hand side depends on its training step of {self.step:.6g}: {self.unsolved} of "
                f"{self._checked} can be solved with that step, but not by an adaptive solver. Train with a smaller "
                "`--max-step`"
            )
        if self.half_step is None or self.adaptive is None:
            return None
        worst = max(self.half_step, self.adaptive)
        if worst <= DEPENDS:
            return None
        if self.half_step <= CONVERGED:
            differ = f"differs by up to {100 * worst:.2g} % of the states' ranges" if math.isfinite(worst) else "fails"
            return (
                f"an adaptive solver {differ} where half the training step of {self.step:.6g} changes nothing: the "
                "solutions are sensitive to the integration (a jump of the right-hand side, an unstable solution), and "
                "results of `predict`, `validate` and figures, which are adaptive, are uncertain by as much"
                + self._below_zero
            )
        if not math.isfinite(worst):
            return (
                f"with the training step of {self.step:.6g} some trajectories blow up that the adaptive solver can "
                "solve. Train with a smaller `--max-step`"
            )
        return (
            f"the learned right-hand side depends on its training step of {self.step:.6g}: solutions with half the "
            f"step or an adaptive solver differ by up to {100 * worst:.2g} % of the states' ranges. Train with a "
            "smaller `--max-step` before computing eigenvalues or bifurcations"
        )

    @property
    def _of_filter(self) -> str | None:
        """The warning of a filter."""
        if self.half_step is None or self.half_step <= DEPENDS:
            return None
        if math.isfinite(self.half_step):
            said = f"differ by up to {100 * self.half_step:.2g} % of the states' ranges"
        else:
            said = "are not finite"
        return (
            f"predictions from row to row depend on the step of {self.step:.6g} in which the filter takes them: in "
            f"steps of half of it they {said}. Train with a smaller `--max-step`"
        )


def warning_of_other_data(check: StepCheck, fitted: StepRecord | None) -> str | None:
    """The warning for other data than those of the fit, of which `fitted` is the check."""
    small = fitted is not None and not fitted.unsolved and fitted.half_step is not None and fitted.half_step <= DEPENDS
    if check.warning is None or check.unsolved or not small or (check.half_step or 0.0) <= CONVERGED:
        return check.warning
    differ = f"by up to {100 * (check.half_step or 0.0):.2g} % of the states' ranges"
    return (
        f"half the training step of {check.step:.6g} changes solutions {differ} in `{check.label}`, and those of the "
        "training data hardly: they are faster here. Errors, predictions and figures are of adaptive steps, which this "
        "does not concern; exported code with fixed steps needs shorter ones"
    )


def check_fit(run: Run, trajectories: Trajectories) -> tuple[StepCheck, ...]:
    """The check of each member of a run just fitted to `trajectories`, from its learned initial states."""
    from gbspec.analysis.prediction import learned_positions, learned_start, predict
    from gbspec.backends import Evaluator

    checks = []
    count = max(1, min(LOOKED_AT, STATES_LOOKED_AT // len(run.model.states)))
    for number, member in zip(run.numbers, run.members, strict=True):
        positions = learned_positions(member, trajectories, run.fit.data)
        fitted = [(i, position) for i, position in enumerate(positions) if position is not None]
        chosen = [fitted[k] for k in evenly_spaced(len(fitted), count)]
        evaluator = Evaluator(member)
        items = [trajectories.items[i] for i, _ in chosen]
        starts = [learned_start(evaluator, position, trajectories.items[i]) for i, position in chosen]
        predicted = [predict(evaluator, run.model, item, start) for item, start in zip(items, starts, strict=True)]
        checks.append(step_check(evaluator, run.model, run.equal_step(number), items, predicted))
    return tuple(checks)


def step_check(
    evaluator: Evaluator,
    model: Model,
    step: float | None,
    items: Sequence[Trajectory],
    predictions: Sequence[Prediction],
) -> StepCheck:
    """Solves up to 24 trajectories again with the training's steps and with half of each, from the same starts."""
    pairs = [(item, one) for item, one in zip(items, predictions, strict=True) if not one.failure and len(one.times)]
    if step is None:
        return StepCheck(None, None, step)
    failed = [(item, one) for item, one in zip(items, predictions, strict=True) if one.failure]
    tried = [failed[k] for k in evenly_spaced(len(failed), LOOKED_AT)]
    solved = [(item, one) for item, one in tried if np.isfinite(_fixed(evaluator, step, item, one)).all()]
    if not pairs:
        differences = _halved(evaluator, step, solved)
        negative = _negative(model, solved, [_fixed(evaluator, step, item, one) for item, one in solved])
        return StepCheck(max(differences.values(), default=None), None, step, 0, len(solved), negative=negative)
    chosen = [pairs[k] for k in evenly_spaced(len(pairs), LOOKED_AT)]
    adaptive = np.concatenate([one.states for _, one in chosen])
    scale, _ = truth_scale(adaptive, np.maximum(np.abs(adaptive).max(axis=0), 1e-12))
    coarse = np.concatenate([_fixed(evaluator, step, item, one) for item, one in chosen])
    halved = _halved(evaluator, step, [*chosen, *solved], scale)
    label = max(halved, key=lambda each: halved[each])
    largest, negative = _largest(adaptive - coarse, scale), _negative(model, chosen, [adaptive, coarse])
    return StepCheck(halved[label], largest, step, len(chosen), len(solved), label, negative=negative)


def _negative(
    model: Model, checked: Sequence[tuple[Trajectory, Prediction]], solutions: Sequence[Array]
) -> tuple[str, ...]:
    """The states that starts or solutions take below zero although they are declared from zero."""
    starts = [one.start.state[None] for _, one in checked]
    return tuple(below_zero(model, np.concatenate([*starts, *solutions]))) if starts else ()


def filter_check(step: float, labels: Sequence[str], coarse: Sequence[Array], fine: Sequence[Array]) -> StepCheck:
    """The check of a filter in steps of at most `step`: its predictions of the states [R, n] from the row before, by
    trajectory, in these steps and in halves of them; NaN in first rows, which nothing is before."""
    later = [np.isfinite(a).all(axis=1) for a in coarse]
    every = np.concatenate([a[rows] for a, rows in zip(coarse, later, strict=True)])
    if not len(every):
        return StepCheck(None, None, step, ahead=True)
    scale, _ = truth_scale(every, np.maximum(np.abs(every).max(axis=0), 1e-12))
    each = zip(labels, coarse, fine, later, strict=True)
    found = {label: _largest((b - a)[rows], scale) for label, a, b, rows in each if rows.any()}
    label = max(found, key=lambda one: found[one])
    return StepCheck(found[label], None, step, len(found), 0, label, ahead=True)


def _halved(
    evaluator: Evaluator, step: float, chosen: Sequence[tuple[Trajectory, Prediction]], scale: Array | None = None
) -> dict[str, float]:
    """The largest differences between solutions with a step and with half of it by trajectory, relative to `scale` [n]
    (their own)."""
    coarse, fine = ([_fixed(evaluator, step, item, one, parts) for item, one in chosen] for parts in (1, 2))
    if scale is None and coarse:
        every = np.concatenate(coarse)
        scale, _ = truth_scale(every, np.maximum(np.abs(every).max(axis=0), 1e-12))
    each = zip(chosen, coarse, fine, strict=True)
    return {item.label: _largest(b - a, np.asarray(scale)) for (item, _), a, b in each}


def _fixed(evaluator: Evaluator, step: float, item: Trajectory, one: Prediction, parts: int = 1) -> Array:
    states: Array = evaluator.integrate_fixed(
        one.start.state,
        item.times,
        item.condition,
        item.inputs,
        item.start,
        max_step=step,
        doses=item.doses,
        constants=one.start.constants,
        parts=parts,
    )
    return states


def _largest(difference: Array, scale: Array) -> float:
    if not np.isfinite(difference).all():
        return math.inf
    return float(np.max(np.abs(difference) / scale))
