"""The objective of a model or run on data at given constants: likelihood, chi-squared, residuals, gradient."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec import frontend
from gbspec.arrays import Array
from gbspec.diagnostics import Diagnostic, Findings, UserError, packages
from gbspec.frames import Tabled, of_rows
from gbspec.given import plain_values, require_values

if TYPE_CHECKING:
    import polars as pl

    from gbspec.backends import GeneratedModule
    from gbspec.data import Trajectories
    from gbspec.ir import Model
    from gbspec.operations.models import Subject
    from gbspec.runs import Run
    from gbspec.training import Evaluated

ASKED = 1e-6
"""The relative accuracy of what is reported; a warning says where it was not reached."""


@dataclass(frozen=True, repr=False)
class Evaluation(Tabled):
    """The negative log likelihood `nllh`, `chi2`, the `gradient` of `nllh` by constant, and every measured value with
    its prediction; `accuracy` is the relative error of the integration, and `remark` says which slopes are not zero at
    the fit itself."""

    model: str
    found: Evaluated
    warnings: tuple[Diagnostic, ...] = ()
    remark: str = ""

    @property
    def nllh(self) -> float:
        """The negative log likelihood."""
        return self.found.nllh

    @property
    def chi2(self) -> float:
        """The sum of squared residuals in standard deviations."""
        return self.found.chi2

    @property
    def gradient(self) -> Mapping[str, float]:
        """The derivatives of `nllh` by the learnable constants, in their units; NaN where they are not known."""
        return self.found.gradient

    @property
    def accuracy(self) -> float:
        """The relative change by a tenth of the last tolerance of the integration."""
        return self.found.accuracy

    def to_frame(self) -> pl.DataFrame:
        """One row for each measured value: `trajectory`, `t`, `channel`, `value`, `measured`, `sd`, `residual`."""
        return of_rows(asdict(one) for one in self.found.simulation)

    def notes(self) -> tuple[str, ...]:
        """The warnings, and the remark."""
        return (*(one.message for one in self.warnings), *([self.remark] if self.remark else []))

    def to_json(self) -> dict[str, object]:
        """The content of `evaluate --json`."""
        return {
            "model": self.model,
            "nllh": self.nllh,
            "chi2": self.chi2,
            "gradient": {name: slope if np.isfinite(slope) else None for name, slope in self.gradient.items()},
            "simulation": [asdict(one) for one in self.found.simulation],
            "accuracy": self.accuracy if np.isfinite(self.accuracy) else None,
            "solver": self.found.solver,
        }

    def __str__(self) -> str:
        count = len(self.found.simulation)
        lines = [f"{self.model}: negative log likelihood {self.nllh:.9g}, chi2 {self.chi2:.9g}, {count:,} values"]
        for name, slope in self.gradient.items():
            lines.append(f"  d nllh/d {name} " + ("is not known" if np.isnan(slope) else f"= {slope:.6g}"))
        return "\n".join([*lines, *([self.remark] if self.remark else [])])


def of_model(model: Model, data: Trajectories, values: Mapping[str, float] | None = None) -> Evaluation:
    """The objective of a model on data: learnables at their values, else their truths, else their starts."""
    values, implied = _apart(model, values)
    made = known(model, values)
    constants = np.tile([k.start for k in made.learnables], (len(data), 1))
    if made.distributed:
        _require_noise(made, implied)
    return _evaluated(made, data, constants, _starts(made, data, None), {}, {}, implied)


@packages()
def of_run(
    run: Run, data: Trajectories, values: Mapping[str, float] | None = None, member: int | None = None
) -> Evaluation:
    """The objective of a run on data at what a member has learned, with `values` set."""
    from gbspec.analysis import learned_positions
    from gbspec.operations.models import set_values

    values, implied = _apart(run.model, values)
    chosen = set_values(run, values)
    number = chosen.best if member is None else member
    instance = chosen.member(number)
    positions = learned_positions(instance, data, chosen.fit.data)
    known = len(chosen.model.constants)
    constants = np.tile(np.asarray(instance.weights["constants"], dtype=np.float64)[known:], (len(data), 1))
    for i, learnable in enumerate(chosen.model.learnables):
        own = instance.weights.get(f"per_trajectory.{learnable.name}")
        for j, place in enumerate(positions):
            if own is not None and place is not None:
                constants[j, i] = own[place]
    learned = _learned_starts(chosen, instance, data)
    noise = _noise_of_run(chosen, number)
    population = {**_population_of_run(chosen, number), **values, **implied}
    starts = _starts(chosen.model, data, learned)
    found = _evaluated(chosen.model, data, constants, starts, instance.weights, noise, population)
    fitted = not values and all(place is not None for place in positions)
    return replace(found, remark=_of_sizes(chosen.model)) if fitted else found


def _apart(model: Model, values: Mapping[str, float] | None) -> tuple[dict[str, float], dict[str, float]]:
    """Values by name: those that the model can have, and those of noises and correlations that a likelihood adds.

    Raises TypeError for what is no values by name."""
    require_values({} if values is None else values)
    given = plain_values(values or {})
    implied = {k.name: given.pop(k.name) for k in model.implied if k.name in given}
    return given, implied


def _of_sizes(model: Model) -> str:
    """What is said of the slopes at a fit with random disturbances: its sizes maximise another likelihood, where other
    parameters are estimated too."""
    inside = {symbol for diffusion in model.diffusions for symbol in diffusion.value.free_symbols}
    elsewhere = {symbol for value in model.inlined(model.balances) for symbol in value.free_symbols}
    names = [k.name for k in model.learnables if k.symbol in inside - elsewhere]
    others = (
        len(names) < len(model.learnables) or model.networks or any(s.initial.kind == "learned" for s in model.states)
    )
    if not names or not others:
        return ""
    return (
        f"sizes of disturbances ({', '.join(names)}) are fitted by the restricted likelihood, in which the other "
        "parameters are estimated too: the slopes of this one are not zero in them"
    )


def _noise_of_run(run: Run, number: int) -> dict[str, float]:
    """The standard deviations of channels that a member has learned."""
    record = run.fit.members[run.numbers.index(number)]
    if record.likelihood is not None:
        return {name: one.value for name, one in record.likelihood.noise.items()}
    return {name: sd for name, sd in run.fit.noise.items() if sd}


def _population_of_run(run: Run, number: int) -> dict[str, float]:
    """The parameters of a population by name, as the best member has learned them. Raises UserError (GB888)."""
    model, record = run.model, run.fit.population
    if not model.distributed or record is None:
        return {}
    reason = f"member {number} of a population, which is not the best," if number != run.best else ""
    if any(len(group) > 2 for group in model.correlated):
        reason = "a run with three or more constants that are correlated (`correlate`)"
    if reason:
        message = f"`gbspec evaluate` is not offered yet for {reason}"
        help = "evaluate the model, with the values of the run by `--set`"
        raise UserError([Diagnostic("GB888", message, None, help=help)])
    known = np.asarray(run.member(number).weights["constants"], dtype=np.float64)[len(model.constants) :]
    found = {k.name: float(value) for k, value in zip(model.learnables, known, strict=True)}
    for learnable in model.distributed:
        made, effect = learnable.distribution, record.effects[learnable.name]
        assert made is not None
        found[learnable.name] = effect.median
        each = [(made.spread, effect)] if made.spread is not None else []
        for level in made.levels:
            mine = record.effects.get(f"{learnable.name} per {level.column}", effect)
            each += [(level.spread, mine)] if level.spread is not None else []
        found |= {name: one.sd for name, one in each if name is not None}
    for a, b in model.correlated:
        pair = next(k.name for k in model.implied if k.name.startswith(f"correlation_{a}_{b}"))
        found[pair] = record.correlations.get(a, {}).get(b, 0.0)
    implied = {k.name for k in model.implied}
    for channel in model.channels:
        value, sd = None if channel.noise is None else channel.noise.value, run.fit.noise.get(channel.name)
        if value is not None and value.is_Symbol and value.name in implied and sd:
            found[value.name] = sd
    return found


def _require_noise(model: Model, implied: Mapping[str, float]) -> None:
    """Raises UserError (GB886) for a channel of a population whose noise nothing says."""
    names = {k.name for k in model.implied}
    for channel in model.channels:
        value = None if channel.noise is None else channel.noise.value
        if value is not None and value.is_Symbol and value.name in names - implied.keys():
            message = f"values of `{channel.name}` have no standard deviation, and so no likelihood"
            help = f"write `noise normal(…)` after `observe {channel.name}`, or `--set {value.name}=…`"
            raise UserError([Diagnostic("GB886", message, channel.span, help=help)])


@packages()
def _evaluated(
    model: Model,
    data: Trajectories,
    constants: Array,
    starts: Array,
    weights: Mapping[str, Array],
    noise: Mapping[str, float],
    population: Mapping[str, float],
) -> Evaluation:
    from gbspec.data import present_values
    from gbspec.training import Given, check_limits, evaluate, evaluate_integral, parameters_of

    data = data.with_defaults([condition.default for condition in model.conditions])
    check_limits(model, data)
    known = parameters_of(model, population) if model.distributed else {}
    if not model.distributed:
        model = _with_declared_noise(model)
        _with_noise(model, data, noise)
    solved = evaluate_integral if model.distributed or model.diffusions else evaluate
    found = solved(
        model,
        present_values(model, data),
        Given(np.asarray(constants, dtype=np.float64), starts, weights, noise, known),
    )
    findings = Findings()
    if found.accuracy > ASKED:
        message = f"the likelihood is known to {found.accuracy:.2g} of its size only, by the error of the integration"
        help = "does the right-hand side jump? An input or a dose is exact where a condition on time is not"
        findings.warning("GB889", message, None, help=help)
    if found.lacking.names:
        _say_lacking(model, found, findings)
    return Evaluation(model.name, found, tuple(findings))


def _say_lacking(model: Model, found: Evaluated, findings: Findings) -> None:
    """A warning of derivatives that are not known (GB893)."""
    names = ", ".join(f"`{name}`" for name in found.gradient if name in found.lacking.names)
    message = (
        f"derivatives of the likelihood by {names} are not known: right-hand sides may jump at a place that moves with "
        f"the solution or with what is learned, and steps do not end there: {found.lacking.reason}"
    )
    help = "differences of `nllh`, at values so far apart that its error does not matter, tell its slopes"
    if model.distributed:
        help = "nor is the value right where solutions jump: Laplace's method takes derivatives. Let it change smoothly"
    elif model.diffusions:
        help = "nor does the filter's variance know of jumps. Let it change smoothly"
    findings.warning("GB893", message, None, help=help)


def known(model: Model, values: Mapping[str, float]) -> Model:
    """A model with its unknowns at their truths, in which the learnables are free and start at the asked values."""
    from gbspec.passes import with_truth, with_values

    changed = frontend.verified(with_values(model, values), "with_values") if values else model
    truths = {t.name: t.value for t in changed.truth_constants}
    true = with_truth(changed)
    free = tuple(replace(k, start=truths.get(k.name, k.start)) for k in changed.learnables)
    return replace(true, constants=changed.constants, learnables=free)


def _with_declared_noise(model: Model) -> Model:
    """The model without the noises that a marginal likelihood would add to channels that state none."""
    implied = {k.symbol for k in model.implied}
    channels = tuple(
        replace(c, noise=None)
        if c.noise is not None and c.noise.value is not None and c.noise.value.free_symbols & implied
        else c
        for c in model.channels
    )
    return replace(model, channels=channels)


def _with_noise(model: Model, data: Trajectories, noise: Mapping[str, float]) -> None:
    """Raises UserError (GB886) if the standard deviation of a measured value is not known."""
    findings = Findings()
    for i, channel in enumerate(model.channels):
        if channel.noise is not None or channel.name in noise:
            continue
        bare = sum(int((np.isfinite(item.values[:, i]) & ~(item.sd[:, i] > 0)).sum()) for item in data.items)
        if bare:
            message = f"{bare} values of `{channel.name}` have no standard deviation, and so no likelihood"
            help = f"write `noise normal(…)` after `observe {channel.name}`, or give a column `sd_{channel.column}`"
            findings.error("GB886", message, channel.span, help=help)
    findings.raise_if_failed()


def starts_of(source: Subject, data: Trajectories) -> Array:
    """The starts [N, n] of trajectories from which a subject is evaluated. Raises UserError (GB887)."""
    if source.run is None:
        return _starts(source.model, data, None)
    return _starts(source.model, data, _learned_starts(source.run, source.evaluator.instance, data))


def _learned_starts(run: Run, instance: GeneratedModule, data: Trajectories) -> list[Array | None]:
    from gbspec.analysis import learned_positions

    positions = learned_positions(instance, data, run.fit.data)
    return [None if place is None else np.asarray(instance.weights["initial"][place]) for place in positions]


def _starts(model: Model, data: Trajectories, learned: list[Array | None] | None) -> Array:
    """The starts [N, n] of trajectories. Raises UserError (GB887) for those that nothing says."""
    from gbspec.analysis import measured_start, needed

    out, findings = np.zeros((len(data), len(model.states))), Findings()
    guess = np.array([0.0 if s.start is None else s.start for s in model.states], dtype=np.float64)
    for j, item in enumerate(data.items):
        own = None if learned is None else learned[j]
        # A fit of whole solutions learns starts that were measured too: its likelihood is that from these.
        out[j] = measured_start(model, item, guess) if own is None or model.diffusions else own
        lacking = [model.states[i] for i in needed(model, item) if own is None and model.states[i].start is None]
        for state in lacking:
            message = f"the start of `{state.name}` in trajectory `{item.label}` is not known"
            help = f"write `initial {state.name} = …`, or a guess: `state {state.name} = …`"
            findings.error("GB887", message, state.span, help=help)
    findings.raise_if_failed()
    return out
