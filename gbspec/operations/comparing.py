"""Comparison of runs by their likelihoods: -2 log likelihood, AIC, BIC, likelihood-ratio tests, and what differs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from gbspec.diagnostics import Diagnostic, UserError, packages
from gbspec.json_values import JsonObject

if TYPE_CHECKING:
    from gbspec.runs import LikelihoodRecord, Run


LOWER = 0.1
"""-2 log likelihood of a larger model that is above a smaller one's by more is not at its least; stages end where a
step promises less."""
_PRIORS = "has constants with a prior: it is not at a maximum of likelihood"


@dataclass(frozen=True)
class Compared:
    """One run: its likelihood and the number of its estimated parameters."""

    run: str
    model: str
    minus2ll: float
    parameters: float
    aic: float
    bic: float


@dataclass(frozen=True)
class Ratio:
    """A likelihood-ratio test of a model against a larger one that contains it: the fall of -2 log likelihood, the
    number of further parameters, and the probability of such a fall if the smaller model holds."""

    smaller: str
    larger: str
    fall: float
    freedom: int
    p: float
    boundary: bool
    """Whether the smaller model has a spread or disturbance of 0, or a normal noise where the larger has Student's, or
    Poisson counts where it has negative binomial ones, at the edge of what is possible: p is then too large."""


@dataclass(frozen=True)
class Comparison:
    """The result: the runs, tests of nested ones, and lines of the models that not all of them have."""

    runs: tuple[Compared, ...]
    tests: tuple[Ratio, ...]
    differences: dict[str, tuple[str, ...]]

    def to_json(self) -> JsonObject:
        """The result for `--json`."""
        return {
            "runs": [vars(one) for one in self.runs],
            "tests": [vars(one) for one in self.tests],
            "differences": {name: list(lines) for name, lines in self.differences.items()},
        }

    def __str__(self) -> str:
        from gbspec.report import table

        best = min(one.aic for one in self.runs)
        rows = [
            [one.run, f"{one.minus2ll:.3f}", f"{one.parameters:.4g}", f"{one.aic:.3f}", f"{one.bic:.3f}",
             f"{one.aic - best:.3f}"]
            for one in self.runs
        ]  # fmt: skip
        parts = [table(["run", "-2 log L", "parameters", "AIC", "BIC", "AIC above the least"], rows)]
        for one in self.tests:
            if one.fall < -LOWER:
                parts.append(
                    f"{one.larger} against {one.smaller}: -2 log L is higher by {-one.fall:.3f} with {_further(one)}, "
                    "which it cannot be at the highest maximum, as the larger model contains the smaller one: its fit "
                    "is at a lower one (try `--effort high`, other starting values, `--members 5`), or the likelihoods "
                    "are not exact enough"
                )
                continue
            edge = " (the smaller model is at the edge of what is possible: p is too large)" if one.boundary else ""
            parts.append(
                f"{one.larger} against {one.smaller}: -2 log L falls by {max(one.fall, 0.0):.3f} for {_further(one)}, "
                f"p = {one.p:.3g}{edge}"
            )
        for name, lines in self.differences.items():
            parts.append("\n".join([f"only in {name}", *(f"  {line}" for line in lines)]))
        return "\n\n".join(parts)


def _further(one: Ratio) -> str:
    return f"{one.freedom} further parameter{'s' if one.freedom > 1 else ''}"


def _contents(run: Run) -> set[str]:
    """What the data of a run are told by: the SHA-256 of the file of a table, and that of its content."""
    return {told for told in (run.fit.data.sha256, run.fit.data.content) if told}


@packages()
def compare(runs: Sequence[Run]) -> Comparison:
    """Compares runs of the same data.

    Likelihoods are marginal ones, or those of innovations (models with `diffusion`), each at its maximum.

    Raises UserError (GB775) if the data, the rows that were fitted or the columns of which the models speak differ, a
    run was not fitted by a likelihood, its likelihood is not at its maximum, or likelihoods are not of the same values.
    """
    found: list[tuple[Run, Compared]] = []
    for run in runs:
        one = _compared(run)
        if _contents(run).isdisjoint(_contents(runs[0])):
            raise _refused(run, runs[0], "were fitted to different data", "fit both models to the same table")
        if _measured(run) != _measured(runs[0]):
            said = "do not observe the same columns of the table"
            raise _refused(run, runs[0], said, "likelihoods are compared of the same measured values")
        _check_ways(run, runs[0])
        _check_trajectories(run, runs[0])
        if _counts(run) != _counts(runs[0]):
            help_text = (
                "zeros of a state that one model keeps at 0 do not count in its fit; empty these cells to compare both"
            )
            raise _refused(run, runs[0], "were fitted to different numbers of values of the same table", help_text)
        found.append((run, one))
    integrated = [run.fit.population for run, _ in found if run.fit.population is not None]
    ways = {one.nodes for one in integrated if one.effects}  # without distributions a likelihood is exact
    if len(ways) > 1:
        message = "the likelihoods were computed in different ways: by Laplace's method and by quadrature"
        raise UserError([Diagnostic("GB775", message, None, help="fit all of them with the same `--quadrature`")])
    tests = [test for first, second in combinations(found, 2) if (test := _ratio(first, second)) is not None]
    return Comparison(tuple(one for _, one in found), tuple(tests), _differences(found))


def _refused(run: Run, other: Run, said: str, help_text: str) -> UserError:
    return UserError([Diagnostic("GB775", f"`{run.path}` and `{other.path}` {said}", None, help=help_text)])


def _check_ways(run: Run, other: Run) -> None:
    """Raises UserError (GB775) where likelihoods of the same values are not the same function of them: marginal ones
    and those of innovations, with starts taken from first values or not, of logarithms or not."""
    if not (run.model.diffusions or other.model.diffusions):
        return
    if bool(run.model.diffusions) is not bool(other.model.diffusions):
        said = "have likelihoods of different kinds, the one marginal, the other that of innovations"
        raise _refused(run, other, said, "compare models that all have `diffusion`, or none")
    for name, (starts, log) in _ways(run).items():
        its_starts, its_log = _ways(other)[name]
        if log is not its_log:
            said = f"have likelihoods of `{name}` on different scales: the noise of the one is that of logarithms"
            raise _refused(run, other, said, "write the same kind of noise in both models")
        if starts != its_starts:
            said = (
                f"have different starts of the state that `{name}` measures: one spreads widely around its first value "
                "(nothing says where it starts), the other does not, and likelihoods of that value differ by the spread"
            )
            raise _refused(run, other, said, "write the same `initial` in both models")


def _ways(run: Run) -> dict[str, tuple[bool, bool]]:
    """Of each column that a model observes: whether the start of its state is spread around the first value, and
    whether the likelihood is that of logarithms."""
    from gbspec.ir import logarithmic

    states, out = run.model.states, {}
    for channel, log in zip(run.model.channels, logarithmic(run.model), strict=True):
        wide = channel.state is not None and states[channel.state].initial.kind == "measured"
        out[channel.column] = wide, bool(log)
    return out


def _measured(run: Run) -> frozenset[str]:
    """The columns of the table that a run's model observes."""
    return frozenset(channel.column for channel in run.model.channels)


def _check_trajectories(run: Run, other: Run) -> None:
    """Raises UserError (GB775) where not all members of both runs were fitted to the same trajectories, to their end
    or up to the same time."""
    ends = all(isinstance(member.info.get("ends"), list) for one in (run, other) for member in one.members)
    its, others = _fitted(run, ends), _fitted(other, ends)
    if len(its) > 1:
        message = f"the members of `{run.path}` were fitted to different trajectories"
        help_text = "fit it again: it is of an older version of gbspec, whose members held out others each"
        raise UserError([Diagnostic("GB775", message, None, help=help_text)])
    if len(its | others) > 1:
        help_text = "fit both without `--holdout`, or with the same `--holdout` and `--seed`"
        raise _refused(run, other, "were not fitted to the same rows of the table", help_text)


def _fitted(run: Run, ends: bool) -> set[frozenset[tuple[str, object]]]:
    """The labels of the trajectories that members of a run were fitted to, and where these end (`ends`: if all members
    know that); those of older versions may differ."""
    out = set()
    for labels, times in [(member.info.get("labels"), member.info.get("ends")) for member in run.members]:
        if isinstance(labels, list):
            known = times if ends and isinstance(times, list) else [None] * len(labels)
            out.add(frozenset((str(label), time) for label, time in zip(labels, known, strict=True)))
    return out


def _counts(run: Run) -> dict[str, int | None]:
    """The number of values of each column that a run was fitted to."""
    channels = next((one.channels for one in run.fit.members if one.channels), None) or {}
    return {channel.column: channels[channel.name].values for channel in run.model.channels if channel.name in channels}


def _compared(run: Run) -> Compared:
    """The likelihood of a run. Raises UserError (GB775) if it has none that can be compared."""
    population = run.fit.population
    if population is not None:
        if population.minus2ll is None or not population.maximum:
            why = "it is not a finite number" if population.maximum else population.reason
            message = f"the likelihood of `{run.path}` is not at its maximum: {why}"
            help_text = "`gbspec report` and the warnings of the run say more; maxima are compared"
            if population.held:
                help_text = "fit it without `--holdout`: maxima are compared"
            raise UserError([Diagnostic("GB775", message, None, help=help_text)])
        if _has_priors(run):
            help_text = "`gbspec crossvalidate` compares models with priors"
            raise UserError([Diagnostic("GB775", f"`{run.path}` {_PRIORS}", None, help=help_text)])
        return Compared(
            str(run.path),
            run.model.name,
            population.minus2ll,
            population.parameters,
            population.minus2ll + 2 * population.parameters if population.aic is None else population.aic,
            float("nan") if population.bic is None else population.bic,
        )
    found = run.innovations
    if found is None:
        message = f"`{run.path}` was not fitted by a likelihood"
        help_text = (
            "models with populations (`per trajectory ~ lognormal`), learned noises (`noise normal(s)`) or random "
            "disturbances (`diffusion`) are"
        )
        raise UserError([Diagnostic("GB775", message, None, help=help_text)])
    _check_maximum(run, found)
    assert found.least is not None and found.aic is not None and found.bic is not None
    return Compared(str(run.path), run.model.name, found.least, found.parameters, found.aic, found.bic)


def _check_maximum(run: Run, found: LikelihoodRecord) -> None:
    """Raises UserError (GB775) where the likelihood of innovations is not known at its maximum."""
    help_text = "`gbspec crossvalidate` compares models with `diffusion`, unknown functions and priors"
    if run.model.networks:
        said = "has unknown functions, whose weights have a prior: it is not at a maximum of likelihood"
    elif _has_priors(run):
        said = _PRIORS
    elif found.maximum is False:
        said = "is not at the maximum of its likelihood: its stage `innovations` ended early"
        help_text = "the warnings of the run say more; maxima are compared"
    elif None not in (found.least, found.aic, found.bic):
        return
    elif found.unbounded:
        noises = " and ".join(f"`{name}`" for name in found.unbounded)
        said = f"has a likelihood without a maximum: it grows without limit as the noise of {noises} goes to zero"
        help_text = "state the noise (`noise normal(…)`), or leave out `initial` of states that are measured"
    elif found.minus2ll is None:
        said, help_text = "has a likelihood that is not a finite number", "the warnings of the run say more"
    elif found.aic is None:  # what a range of a state says of a start that is learned
        said = "has starts with a prior (states with a range): it is not at a maximum of likelihood"
    else:
        said = "does not have the maximum of its likelihood"
        help_text = "fit it again: it is of an older version of gbspec"
    raise UserError([Diagnostic("GB775", f"`{run.path}` {said}", None, help=help_text)])


def _has_priors(run: Run) -> bool:
    return any(learnable.prior is not None for learnable in run.model.learnables)


def _parameters(run: Run) -> frozenset[str]:
    """The names of what is estimated; a median has the name of its constant."""
    model = run.model
    medians = {k.distribution.median: k.name for k in model.distributed if k.distribution is not None}
    names = [k.name for k in (*model.learnables, *model.implied) if not k.per_trajectory]
    found = run.innovations
    noises = [] if found is None else [f"noise of {name}" for name in found.noise]
    return frozenset([*(medians.get(name, name) for name in names), *noises])


def _ratio(first: tuple[Run, Compared], second: tuple[Run, Compared]) -> Ratio | None:
    """The test of two runs, if one model has all parameters of the other and the same equations."""
    from scipy.special import gammaincc

    if first[0].model.networks or second[0].model.networks or not _same_equations(first[0], second[0]):
        return None
    a, b = _parameters(first[0]), _parameters(second[0])
    if a == b or not (a < b or b < a):
        return None
    (small, less), (large, more) = (first, second) if a < b else (second, first)
    fall, freedom = less.minus2ll - more.minus2ll, abs(len(a) - len(b))
    p = float(gammaincc(freedom / 2, max(fall, 0.0) / 2))
    if not _disturbances(small) <= _disturbances(large) or _own(small) != _own(large):
        return None
    edges = [
        (_deviations(run), _disturbances(run), [c.noise and c.noise.kind for c in run.model.channels])
        for run in (small, large)
    ]
    return Ratio(less.run, more.run, fall, freedom, p, edges[0] != edges[1])


def _deviations(run: Run) -> set[tuple[str, str]]:
    """The constants that differ, with the columns between whose values they do."""
    each = [(k.name, k.distribution) for k in run.model.distributed if k.distribution is not None]
    found = {(name, "trajectory") for name, made in each if made.spread is not None or made.fixed}
    return found | {(name, level.column) for name, made in each for level in made.levels}


def _own(run: Run) -> set[str]:
    """The constants that each trajectory has for itself, without a distribution."""
    return {k.name for k in run.model.learnables if k.per_trajectory and k.distribution is None}


def _disturbances(run: Run) -> set[tuple[str, object]]:
    """The disturbed states with the sizes of their disturbances."""
    model = run.model
    values = model.inlined([diffusion.value for diffusion in model.diffusions])
    return {(diffusion.state, value) for diffusion, value in zip(model.diffusions, values, strict=True)}


def _same_equations(first: Run, second: Run) -> bool:
    """Whether two models have the same balances, starts and channels (their noises may differ)."""

    def equations(run: Run) -> tuple[object, ...]:
        model = run.model
        starts = tuple(state.initial.value for state in model.states)
        if model.diffusions:  # starts that nothing says are spread by ranges and declared values
            starts += tuple((state.initial.kind, state.start, state.range) for state in model.states)
        left = model.inlined([equation.residual for equation in model.constraints])
        return model.inlined(model.balances), left, starts, model.inlined([c.value for c in model.channels])

    return equations(first) == equations(second)


def _differences(found: Sequence[tuple[Run, Compared]]) -> dict[str, tuple[str, ...]]:
    """The lines of each model that not all of them have, comments and the name left out, and options that differ."""
    lines = [[" ".join(line.split("#")[0].split()) for line in run.model.text.splitlines()] for run, _ in found]
    kept = [[line for line in each if line and not line.startswith("model ")] for each in lines]
    common = set(kept[0]).intersection(*map(set, kept[1:]))
    out = {}
    for (run, one), each in zip(found, kept, strict=True):
        own = [line for line in each if line not in common]
        options = found[0][0].fit.options
        own += [f"--{k.replace('_', '-')} {v}" for k, v in run.fit.options.items() if options.get(k) != v]
        if own:
            out[one.run] = tuple(own)
    return out
