"""Steps that end where right-hand sides switch: whether a fit needs them, and the stage that continues it with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import sympy
from sympy.core.relational import Relational

from gbspec.arrays import Array
from gbspec.ir import Model, Steady, Unknown, in_language
from gbspec.training.engines import Engine, happened, residual_table
from gbspec.training.optimise import LevenbergMarquardt, Stage
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Parameters
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.finer import FinerStep, LastFit, continuing, step_shows
from gbspec.training.recipe.planned import Planned, Reached, step_fraction
from gbspec.training.stages import Effort, StageName, most_iterations

WORTH = 0.25
"""Steps are cut where that divides the effect of half the step by at least four: switches are the reason then."""

_LACKING = (
    ". Derivatives leave out how the times of jumps there move: where solutions pass them the fit may rest beside the "
    "best values, and intervals may be wrong"
)
PASSED = 1e-9
"""A residual, in scales of its channel, that cut steps change by more follows a solution that passes a switch."""


def cut_steps(context: Context, last: Callable[[Reached], LastFit | None], effort: Effort) -> Planned:
    """Continues the last fit with steps that end where right-hand sides switch: where a constant occurs in conditions
    alone, of which other steps have no derivative; where solutions pass jumps, whose times other steps have no
    derivative of; and where the step's error shows and switches are the reason for it, and the step is fixed and not
    one that the user gave."""
    most = most_iterations(StageName.CUT, effort)

    def make(reached: Reached) -> Stage:
        found, fraction, cut = last(reached), step_fraction(reached.begun), context.cut()
        assert found is not None, "the stage has begun"
        layout, blend = found.layout, found.blend
        chosen = continuing(found.options(reached), reached)
        newton = LevenbergMarquardt(StageName.CUT, most, lambda i: cut.engine(layout, blend, fraction, i), chosen)
        model = context.switched.model
        assert model is not None, "the stage has begun"
        only = ", ".join(f"`{name}`" for name in only_in_switches(context.model, model))
        why = "the error of steps across showed"
        if only:
            why = f"only the times of switches depend on {only}"
        elif jumped(found, reached):
            why = "other steps have no derivatives of the times of jumps"
        return FinerStep(newton, f"steps end {_places(model)}, since {why}")

    def jumped(found: LastFit, reached: Reached) -> bool:
        return _passes_jumps(context, found.layout, found.seen, reached.theta, step_fraction(reached.begun))

    def shows(reached: Reached) -> bool:
        found = last(reached)
        wanted = context.options.switches == "auto" and not context.cutting
        if not wanted or found is None or context.switched.model is None:
            return False
        if only_in_switches(context.model, context.switched.model) or jumped(found, reached):
            return True
        if context.adaptive or context.options.max_step is not None:
            return False
        size = step_fraction(reached.begun)
        now, half = (context.engine(found.layout, found.seen, part) for part in (size, size / 2))
        if not step_shows(now, half, reached.theta, found.constants):
            return False
        before, after = (_effect(each, found, reached.theta, size) for each in (context, context.cut()))
        return after <= WORTH * before

    return Planned(StageName.CUT, most, make, possible=shows)


def _passes_jumps(context: Context, layout: Parameters, blend: float, theta: Array, size: float) -> bool:
    """Whether solutions pass switches, so that cut steps differ, and right-hand sides may jump there. A run that
    resumes has cut steps already."""
    if not context.switched.jumps or context.switched.model is None:
        return False
    now, cut = (each.engine(layout, blend, size) for each in (context.cut(False), context.cut()))
    with np.errstate(all="ignore"):
        change = np.abs(residual_table(cut, theta) - residual_table(now, theta))[now.problem.seen]
    return bool((change > PASSED).any())


def _effect(context: Context, found: LastFit, theta: Array, size: float) -> float:
    """The root mean square by which half the step changes residuals; infinite where a solution blows up."""
    now, half = (context.engine(found.layout, found.seen, part) for part in (size, size / 2))
    seen = now.problem.seen
    with np.errstate(all="ignore"):
        change = (residual_table(now, theta) - residual_table(half, theta))[seen]
        effect = float(np.sqrt(np.mean(change**2))) if len(change) else 0.0
    return effect if np.isfinite(effect) else np.inf


def of_solutions(model: Model) -> tuple[str, ...]:
    """The learned constants that solutions depend on, and not only what is measured of them."""
    inside = {symbol for value in _values(replace(model, channels=()), model.balances) for symbol in value.free_symbols}
    return tuple(item.name for item in model.learnables if item.symbol in inside)


def only_in_switches(model: Model, cut: Model) -> tuple[str, ...]:
    """The learned constants that only the conditions of switches depend on."""
    smooth = {symbol for value in _values(model, cut.balances) for symbol in _smooth(value)}
    decide = {symbol for value in model.inlined([each.guard for each in cut.switches]) for symbol in value.free_symbols}
    return tuple(item.name for item in model.learnables if item.symbol in decide - smooth)


def only_in_jumps(model: Model) -> tuple[str, ...]:
    """The learned constants that occur only where values jump: in conditions, `sign`, `floor` and `ceil`. Without steps
    that end where they jump, nothing has a derivative by them."""
    values = _values(model, model.balances)
    smooth = {symbol for value in values for symbol in _smooth(value)}
    return tuple(
        item.name
        for item in model.learnables
        if item.symbol not in smooth and any(item.symbol in value.free_symbols for value in values)
    )


def _values(model: Model, balances: Sequence[sympy.Expr]) -> list[sympy.Expr]:
    """All values that solutions, what is measured of them and its likelihood depend on."""
    fixed = [*(channel.value for channel in model.channels), *(s.initial.value for s in model.states)]
    fixed += [part for c in model.channels if c.noise is not None for part in (c.noise.value, c.noise.shape)]
    fixed += [*(s.history for s in model.states), *_learned(model.unknowns), *_steady(model.steady)]
    fixed += [part for dose in model.doses for part in (dose.fraction, dose.lag, dose.duration)]
    fixed += [*(one.value for one in model.diffusions), *(one.lag for one in model.delays)]
    fixed += [one.residual for one in model.constraints]
    events = [part for e in model.events for part in (e.guard, e.rank, *(value for _, value in e.values))]
    timings = [part for e in model.events if e.timing for part in (e.timing.at, e.timing.every, e.timing.until)]
    return list(model.inlined([part for part in (*balances, *fixed, *events, *timings) if part is not None]))


def _learned(unknowns: Sequence[Unknown]) -> Iterator[sympy.Expr | None]:
    """What unknown functions depend on besides their networks: in postulates, contracts and the forms of these."""
    for one in unknowns:
        yield one.postulate
        for contract in one.contracts:
            yield from (contract.value, contract.to)
        if one.form is not None:
            yield from (one.form.value, *(part for evaluation in one.form.evaluations for part in evaluation))


def _steady(start: Steady | None) -> Iterator[sympy.Expr]:
    """What steady states depend on before the start, and states after it."""
    if start is not None:
        yield from (*(value for _, value in start.held), *(part for law in start.laws for part in law))
        yield from (value for _, value in start.after)


_JUMPING = (Relational, sympy.sign, sympy.floor, sympy.ceiling)


def _smooth(node: sympy.Basic) -> set[sympy.Basic]:
    """The symbols of an expression, without those that occur only where it jumps."""
    if isinstance(node, _JUMPING):
        return set()
    return {node} if isinstance(node, sympy.Symbol) else {s for part in node.args for s in _smooth(part)}


def _places(model: Model) -> str:
    """Where steps end, in words."""
    texts = [min(in_language(each.guard), in_language(-each.guard), key=_readable) for each in model.switches]
    return "where " + ", ".join(f"`{text}`" for text in texts) + " changes its sign"


def _readable(text: str) -> tuple[bool, int]:
    return text.startswith("-"), len(text)


def said_of_switches(context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]) -> list[str]:
    """Sentences about the switches of right-hand sides at the end of a fit."""
    switched, options = context.switched, context.options
    skipped = f" ({'; '.join(switched.skipped)})" if switched.skipped else ""
    unknown = switched.unknown_jumps
    lacking = _LACKING if unknown else ""
    if context.cutting:
        said = [f"steps do not end at all switches of right-hand sides{skipped}{lacking}"] if skipped else []
        return said + _uncut(context.engine(parameters, 0.0, step_fraction(stages)), theta, switched.jumps)
    if options.switches == "on":
        why = switched.reason or (f"nothing to cut at{skipped}" if skipped else "no right-hand side switches")
        return [f"`--switches on`: steps do not end where right-hand sides switch: {why}{lacking}"]
    reasons = [unknown] if unknown else []
    if _passes_jumps(context, parameters, 0.0, theta, step_fraction(stages)):
        reasons.append(_without_stage(options))
    return [f"steps do not end where right-hand sides jump: {'; '.join(reasons)}{_LACKING}"] if reasons else []


def _without_stage(options: TrainOptions) -> str:
    """Why no steps end at jumps although they could."""
    if options.switches == "off":
        return "`--switches off`"
    asked = not options.named_stages or StageName.CUT in options.named_stages
    return f"the fit has no stage `{StageName.CUT}`" if asked else f"`--stages` does not name `{StageName.CUT}`"


def _uncut(engine: Engine, theta: Array, jumps: bool) -> list[str]:
    """A sentence where solutions slide along a switch, or touch it, so that steps go across it; `jumps`: whether
    right-hand sides may jump at switches."""
    found = happened(engine, theta)
    count = 0 if found is None else int(found.uncut.sum())
    if not count:
        return []
    return [
        f"{count} of {engine.problem.packed.substeps} steps go across a switch of the right-hand sides, since "
        "solutions slide along it or touch it: there they are as exact as without `--switches`"
        + (", and derivatives may leave out how its times move" if jumps else "")
    ]
