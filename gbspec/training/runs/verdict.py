"""The verdict on a fit: whether whole solutions follow the data better than predictors that know no model, and whether
what is left looks like the noise of measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from scipy.special import chdtr
from sympy.core.function import AppliedUndef

from gbspec.diagnostics import Findings
from gbspec.ir import Channel, Model, new_name
from gbspec.passes import by_one_trajectory, examine
from gbspec.runs import (
    COLOURED,
    EXACT,
    NOT_INDEPENDENT,
    ChannelRecord,
    LikelihoodRecord,
    SearchRecord,
    autocorrelated,
    how_followed,
    not_independent,
)
from gbspec.training.problem import share_that_counts
from gbspec.training.runs.beside_naive import better, lost_ahead, squared_errors, worse_ahead
from gbspec.training.runs.naming import labelled
from gbspec.training.runs.offered import offered
from gbspec.training.runs.unbounded import said_of_unbounded

GOOD = 0.9
"""A fit that explains more than this, and leaves nothing but noise, is not doubted because a simple curve does too."""

VISIBLE = 1e-4
"""The same of a fit that gave no standard deviations: stages of exact data end before such fractions matter."""

ABOVE = 2.0
"""Residuals that are this many times as large as the noise that the model or the table states are not that noise."""

BY_CHANCE = 1e-3
"""Residuals are smaller than the stated noise where chance makes them so small with a smaller probability."""

OF_MEDIAN = 0.37
"""The efficiency of the median absolute residual, by which the noise of fits from row to row is estimated: it has the
variance of a standard deviation of so many of the values (Rousseeuw and Croux, 1993)."""

SEVERAL = 3
"""A minimum that a search found so many times is the best that it can find."""

UNLIKELY = 1e-2
"""The model lacks something where its distances from averages of replicates have a smaller probability."""

SMALL, SMALL_LOG = 0.1, 0.01
"""A learned noise without an interval that is a larger part of the errors, or of log-normal values, is not at zero."""

REMEDIES = (
    "do not rely on it for simulation; what may help: a postulate or a contract for the unknown function, "
    "ranges of unmeasured states, a measured rate (`observe r = X'`) or another measured state, a smaller network, "
    "`--members 5`, or another model"
)
REMEDIES_OF_KNOWN_FORMS = (
    "do not rely on it for simulation; what may help: `--effort high`, narrower bounds or starting values nearer to "
    "what is meant, `per trajectory` constants, another state, or another model"
)


def verdicts(
    channels: Mapping[str, ChannelRecord], model: Model | None = None, bounded: Iterable[str] = ()
) -> list[str]:
    """A warning for each channel whose whole solutions are hardly better than the best naive predictor, or worse, or
    leave more than half of the variance, or whose predictions one row ahead, of a model with disturbances, are worse;
    `bounded` are the constants that ended at bounds."""
    remedies = _lacked(REMEDIES if model is None or model.unknowns else REMEDIES_OF_KNOWN_FORMS, model)
    wider = _wider(bounded)
    if wider:
        remedies = remedies.replace("what may help: ", f"what may help: {wider}, ").replace("narrower bounds or ", "")
    out = []
    for name, found in channels.items():
        if found.r2 is None or found.as_stated:
            continue
        if model is not None and model.diffusions:  # these predict from row to row
            out += [_missed_ahead(name, found, model, wider)] if worse_ahead(found) else []
            continue
        if found.naive is None or better(found, name, model):
            if how_followed(found.r2, [found]) == "badly":
                left = f"R² {found.r2:.3g}: they leave {100 * (1 - found.r2):.3g} % of the variance"
                out.append(f"whole solutions follow `{name}` badly ({left}): {remedies}")
            continue
        if found.r2 > GOOD and found.autocorrelation is not None and name not in autocorrelated(channels):
            continue
        compared = "worse than" if found.r2 < found.naive else "hardly better than"
        measured = f"R² {found.r2:.3g}, naive {found.naive:.3g}"
        out.append(f"whole solutions follow `{name}` {compared} {found.predictor} ({measured}): {remedies}")
    return out


def _lacked(remedies: str, model: Model | None) -> str:
    """Remedies without what the model has, or has no place for: ranges of its unmeasured states, narrower bounds."""
    if model is None:
        return remedies
    measured = {channel.state for channel in model.channels}
    ranges = [state.range for i, state in enumerate(model.states) if i not in measured]
    if all(one is not None and one.bounded for one in ranges):
        remedies = remedies.replace("ranges of unmeasured states, ", "")
    bounds = "narrower bounds or starting values nearer to what is meant, ", "narrower bounds, "
    return remedies if model.learnables else remedies.replace(bounds[0], "").replace(bounds[1], "")


def _wider(bounded: Iterable[str]) -> str:
    names = " and ".join(f"`{name}`" for name in sorted(bounded))
    return f"wider bounds of {names}, if values beyond them are plausible" if names else ""


def _missed_ahead(name: str, found: ChannelRecord, model: Model, wider: str) -> str:
    relied = "this fit" if lost_ahead(found) else f"predictions of `{name}`"
    return (
        f"predictions one row ahead follow `{name}` worse than {found.predictor} (R² {found.r2:.3g}, naive "
        f"{found.naive:.3g}). The likelihood may have a higher maximum, or the disturbances are not of this form: do "
        f"not rely on {relied}. What may help: {', '.join([wider] * bool(wider) + _remedies_ahead(model))}"
    )


def _remedies_ahead(model: Model) -> list[str]:
    """What may help a fit with disturbances: nothing that its model has already, or has not to be changed."""
    learned, inside = {k.name for k in model.learnables}, set[str]()
    for one in model.diffusions:
        inside |= {symbol.name for symbol in one.value.free_symbols} & learned
    out = ["smaller starts of the sizes of disturbances"] if inside else []
    if any(one.relative is None and one.between is None for one in model.diffusions):
        out.append(
            "disturbances in proportion to a state (`diffusion x = s*x`) where its values are positive over orders of "
            "magnitude"
        )
    if learned - inside:
        other = " other" if inside else ""
        out.append(
            f"starting values of the{other} constants nearer to what is meant (as from a fit without `diffusion`)"
        )
    return [*out, "or another model" if out else "another model"]


def lacking(channels: Mapping[str, ChannelRecord]) -> list[str]:
    """A warning for each channel of which the model lacks more than the error of measurement that replicates show."""
    return [
        f"averages of `{name}` are further from the solutions than its replicates from each other allow (p = "
        f"{found.lack_of_fit:.1g}): the model lacks something that the data show, or replicates share an error, as "
        "those of one sample do. Intervals contain what replicates show, not what is lacking"
        for name, found in channels.items()
        if found.lack_of_fit is not None and found.lack_of_fit < UNLIKELY and not not_followed(found)
    ]


def blown_up(labels: Sequence[str]) -> str:
    """What is said of trajectories whose solutions are not finite."""
    which = "trajectory" if len(labels) == 1 else "trajectories"
    rest = "this trajectory does" if len(labels) == 1 else "these trajectories do"
    return f"the solution from the initial state blows up in {which} {labelled(labels)}; {rest} not count as fitted"


def not_followed(found: ChannelRecord | None) -> bool:
    """Whether whole solutions follow a channel less well than the best naive predictor, and not to the stated noise:
    what their residuals look like says nothing of the data then."""
    if found is None or found.naive is None or found.as_stated:
        return False
    error, of_naive = squared_errors(found)
    return error > of_naive


def above_stated(
    noise: Mapping[str, float],
    model: Model,
    tabled: Mapping[str, float] | None = None,
    search: SearchRecord | None = None,
) -> list[str]:
    """A warning for each channel whose residuals, of the standard deviation `noise`, are no stated noise.

    `tabled` has channels with values that have standard deviations in the table: how many times as large as these their
    residuals are. Noise is that of measurements alone: with disturbances or differences between trajectories it is not
    compared. A minimum that a `search` found several times is not called a bad one.
    """
    often = search is not None and search.times >= SEVERAL
    why, helps = (_LACKS, _OTHER_MODEL) if often else (_BAD_OR_LACKS, _lacked(_OTHER_MINIMUM, model))
    out = []
    for channel in model.channels if not model.marginal else ():
        out += [
            f"the residuals of `{channel.name}` are {times:.2g} times as large as {what}: {why}; intervals do not hold "
            f"then. What may help: {helps}"
            for times, what in beside_stated(channel, noise, tabled)
            if times > ABOVE
        ][:1]
    return out


def beside_stated(
    channel: Channel, noise: Mapping[str, float], tabled: Mapping[str, float] | None
) -> list[tuple[float, str]]:
    """How many times as large as what table and model state the residuals of a channel are, and what that is."""
    name, stated, compared = channel.name, channel.noise, []
    if tabled and name in tabled:
        compared.append((tabled[name], f"the standard deviations that the table states (`sd_{name}`)"))
    if stated is not None and stated.value is None and stated.scale > 0:  # of a log-normal one as a share
        times = noise.get(name, math.nan) / stated.scale
        compared.append((times, f"the noise that the model states, {stated.kind}({stated.scale:g})"))
    return compared


def below_stated(
    noise: Mapping[str, float],
    model: Model,
    channels: Mapping[str, ChannelRecord],
    freedom: float | None,
    tabled: Mapping[str, float] | None = None,
) -> list[str]:
    """A warning for each channel whose residuals are `far_smaller` than the stated noise, with the channel's part of
    `freedom`. Nothing is said of exact data, and of residuals that are not those of measurements."""
    counted = sum(one.values or 0 for one in channels.values())
    if model.marginal or model.diffusions or freedom is None or not counted:
        return []
    out, following = [], autocorrelated(channels)
    for channel in model.channels:
        name, found = channel.name, channels.get(channel.name)
        if found is None or found.r2 is None or 1 - found.r2 <= EXACT or name in following:
            continue
        left = freedom * (found.values or 0) / counted
        # Values with deviations of their own are compared with these: the number in the model is not theirs.
        times, what = next(iter(beside_stated(channel, noise, tabled)), (math.nan, ""))
        if not far_smaller(times, left):
            continue
        follows = ", or the learned functions follow the noise" if model.networks else ""
        of_residuals = f"{100 * noise[name]:.2g} %" if _relative(channel) else f"{noise[name]:.2g}"
        out.append(
            f"the residuals of `{name}` are only {times:.2g} times as large as {what}: what is stated is too "
            f"large{follows}. It decides what values weigh; intervals and predictions have the noise of the residuals, "
            f"{of_residuals}"
        )
    return out


def far_smaller(times: float, left: float) -> bool:
    """Whether residuals that are so many `times` as large as the stated noise are far smaller, by more than chance.

    With the noise s stated, n times the squared ratio of the estimated to the stated standard deviation has the
    chi-squared distribution of n degrees of freedom, here `left`; a median of residuals counts like `OF_MEDIAN` of
    them.
    """
    n = OF_MEDIAN * left
    return 0 < times < 1 / ABOVE and bool(chdtr(n, n * times**2) <= BY_CHANCE)


def _relative(channel: Channel) -> bool:
    return channel.noise is not None and channel.noise.kind == "lognormal"


_LACKS = "the model lacks something, or the noise is larger"
_BAD_OR_LACKS = "the fit is in a bad minimum, or the model lacks something, or the noise is larger"
_OTHER_MODEL = "`per trajectory` constants, another state, another model, or the noise that the data show"
_OTHER_MINIMUM = "`--effort high`, `--members 5`, narrower bounds, ranges of unmeasured states, or another model"


def widening(channels: Mapping[str, ChannelRecord]) -> float:
    """The factor by which intervals of constants and functions are widened where residuals are autocorrelated.

    A fraction of the values counts (see `share_that_counts`), and standard deviations are larger by the root of its
    inverse. That is so wherever a correlation is beyond chance, also where it is too small for a warning. Channels that
    were weighed by this share have such intervals already. The factor is that of a mean under least squares.
    """
    left = [channels[name] for name in autocorrelated(channels, above=0.0) if (channels[name].share or 1.0) == 1.0]
    shares = [share_that_counts(one.autocorrelation or 0.0, _length(one)) for one in left]
    return max((1 / math.sqrt(share) for share in shares), default=1.0)


def interval_factor(channels: Mapping[str, ChannelRecord], likelihood: LikelihoodRecord | None) -> float:
    """`widening` of a fit of squares; 1 of one by the likelihood of innovations, since what correlated ones take from
    its curvature differs between constants (from a size less than from a level), and is said in words."""
    return widening(channels) if likelihood is None else 1.0


def _length(channel: ChannelRecord) -> float:
    """The mean number of a channel's values in a trajectory; that of a single one where older runs do not tell."""
    values = channel.values or channel.pairs + 1
    return values / max(values - channel.pairs, 1)


def autocorrelations(
    channels: Mapping[str, ChannelRecord],
    model: Model | None = None,
    rmse: Mapping[str, float] | None = None,
    intervals: bool = True,
    noise: Mapping[str, float] | None = None,
) -> list[str]:
    """A warning for the channels whose residuals are autocorrelated, with what to write where the model is given, and
    sizes of residuals (see `offered`); `intervals`: whether there are any."""
    found = autocorrelated(channels)
    if not found:
        return []
    listed, factor = _listed(found, channels), widening(channels)
    if model is not None and model.marginal:
        effect = f"{_OVERSTATED}, of what all trajectories share by up to the factor {factor:.2g}"
    elif not intervals:
        effect = "an interval would have to be wider for it"
    elif factor > 1:
        effect = f"intervals are {factor:.2g} times as wide as if they were independent"
    else:
        effect = "the weights of the channels, and with them the intervals, take this into account"
    return [
        f"the residuals of {listed} are autocorrelated: they are disturbances or errors of the model, not noise of "
        f"measurement. Each row tells less than a new one would: {effect}" + offered(found, model, rmse or {}, noise)
    ]


def innovations(
    channels: Mapping[str, ChannelRecord],
    likelihood: LikelihoodRecord,
    model: Model | None = None,
    rmse: Mapping[str, float] | None = None,
) -> list[str]:
    """Warnings of a fit with disturbances: innovations that are not independent, and noises that ended at zero, or
    (where the errors `rmse` say that they are no small part of these) that are not told from disturbances."""
    out, coloured = [], not_independent(channels, likelihood)
    if coloured:
        listed = ", ".join(f"`{name}` ({_why_coloured(channels, name, p)})" for name, p in coloured.items())
        factor = widening({name: channels[name] for name in coloured})
        mean = f". The interval of a mean would have to be {factor:.2g} times as wide" * (factor > 1)
        out.append(f"the innovations of {listed} {NOT_INDEPENDENT}{mean}. {_other_disturbances(model)}")
    unknown = {name: one.value for name, one in likelihood.noise.items() if one.interval is None}
    logs = {c.name for c in model.channels if c.noise is not None and c.noise.kind == "lognormal"} if model else set()
    least = {name: SMALL_LOG if name in logs else SMALL * (rmse or {}).get(name, math.inf) for name in unknown}
    gone = [f"`{name}` ({value:.2g})" for name, value in unknown.items() if not value > least[name]]
    if gone:
        out.append(
            f"the learned noise of {', '.join(gone)} has gone to zero, or is not told from it: all that measurements "
            "scatter is taken for a disturbance. If the noise is known, state it: `noise normal(…)`"
        )
    mixed = [f"`{name}` ({value:.2g})" for name, value in unknown.items() if value > least[name]]
    if mixed:
        out.append(
            f"the learned noise of {', '.join(mixed)} has no interval: these data do not tell how much of what "
            "measurements scatter is noise, and how much a disturbance. If the noise is known, state it: "
            "`noise normal(…)`"
        )
    return [*out, *said_of_unbounded(likelihood, model)]


def _other_disturbances(model: Model | None) -> str:
    """What may help where innovations are not independent: not what the model has already."""
    memory = remembering(model) if model is not None else []
    if not memory or model is None:
        d, tau, s = ("d", "tau", "s_d") if model is None else (new_name(model, name) for name in ("d", "tau", "s_d"))
        return (
            f"What may help: a disturbance with a memory (`state {d} = 0`, `{d}' = -{d}/{tau}`, `diffusion {d} = {s}`, "
            f"`learn {tau}` and `{s}`, and `{d}` in the balance), another `diffusion`, or an unknown function"
        )
    name, new = memory[0], new_name(model, f"{memory[0]}2")
    delayed = "a dead time of an input (move its column by as many rows), " if model.inputs else ""
    listed = ", ".join(f"`{one}`" for one in memory)
    verb = "is a disturbance" if len(memory) == 1 else "are disturbances"
    return (
        f"{listed} {verb} with a memory already. What may help: one of second order (`state {new} = 0`, `{new}' = "
        f"-{new}/tau_{new}`, `diffusion {new} = s_{new}`, `learn tau_{new}` and `s_{new}`, and `+ {new}` in the "
        f"balance of `{name}`), {delayed}another state, or an unknown function"
    )


def remembering(model: Model) -> list[str]:
    """The states that are disturbances with a memory, as in `d' = -d/tau`, `diffusion d = s`: not measured themselves,
    with balances of themselves alone. Those of random walks (`d' = 0`) are too."""
    moving = {model.time.symbol, *(one.symbol for one in (*model.states, *model.inputs, *model.intermediates))}
    measured, disturbed = {channel.state for channel in model.channels}, {one.state for one in model.diffusions}
    return [
        state.name
        for i, (state, rate) in enumerate(zip(model.states, model.balances, strict=True))
        if state.name in disturbed
        and i not in measured
        and not rate.free_symbols & (moving - {state.symbol})
        and not rate.atoms(AppliedUndef)
    ]


def _why_coloured(channels: Mapping[str, ChannelRecord], name: str, p: float | None) -> str:
    """What shows that innovations are not independent: the test's probability, or else their correlation."""
    if p is not None and p < COLOURED:
        return f"probability {p:.1g}"
    return f"correlation {channels[name].autocorrelation:.3g} with the next row's"


_OVERSTATED = "the likelihood takes them for independent nevertheless, so that its intervals are too narrow"


def unrested(
    channels: Mapping[str, ChannelRecord], ended: str, model: Model | None = None, bounded: bool = False
) -> list[str]:
    """The same of a fit that gave no standard deviations, whose last stage `ended` so (empty: by itself); `bounded`:
    whether constants ended at bounds, which narrower ones would not help."""
    found = autocorrelated(channels, VISIBLE)
    if not found and all(one.r2 is None or 1 - one.r2 <= VISIBLE for one in channels.values()):
        return []
    narrower = "" if bounded else _lacked("narrower bounds, ", model)
    if not found:
        functions = model is None or bool(model.networks)
        return [
            f"constants {'and functions ' if functions else ''}have no intervals: the fit has not come to rest{ended}, "
            "or its equations are numerically singular. Its constants may be far from the best ones. What may help: "
            f"`--effort high`, another `--seed`, {narrower}or `--solver ros34pw2` where solutions change fast"
        ]
    ranges = _lacked("ranges of unmeasured states, ", model)
    return [
        f"the residuals of {_listed(found, channels)} are autocorrelated, and the fit has not come to rest{ended}: "
        "they are errors of the fit or of the model, not noise of measurement, and constants have no intervals. What "
        f"may help: `--effort high`, `--members 5`, {narrower}{ranges}or another model"
    ]


def _listed(found: list[str], channels: Mapping[str, ChannelRecord]) -> str:
    """The channels with the correlations of their residuals; what these numbers are is said of the first."""
    each = [f"{channels[name].autocorrelation:.3g}" for name in found]
    told = [f"correlation {each[0]} with the next row's", *each[1:]]
    return ", ".join(f"`{name}` ({one})" for name, one in zip(found, told, strict=True))


def inseparable(model: Model) -> list[str]:
    """A warning for each set of constants and functions that no data can separate, as `gbspec check` has it.

    There is none for a set that the model allows, and none where the analysis could not decide.
    """
    findings = Findings()
    examine(model, findings)
    return [f"{one.message} ({one.code}): {'; '.join((*one.notes, one.help))}" for one in findings]


def named_inseparable(model: Model) -> set[str]:
    """The names that these warnings are about."""
    findings = Findings()
    sets = examine(model, findings).identifiability.sets
    told = {one.subject for one in findings}
    return {name for one in sets if one.names[0] in told for name in one.names}


def inseparable_by_one(model: Model) -> list[str]:
    """The same for what a single trajectory cannot separate, where several could."""
    out = []
    for found in by_one_trajectory(model):
        groups = (found.names, found.constants, found.unknowns)
        both, constants, functions = (" and ".join(f"`{name}`" for name in group) for group in groups)
        out.append(
            f"{both} cannot be told apart by one trajectory: a function of time alone can follow any single one. What "
            f"the fit shows of them rests on the smoothness of {functions}, and intervals do not count that. Give "
            f"{constants} a value (`const`) or a prior, or measure trajectories with other initial values"
        )
    return out
