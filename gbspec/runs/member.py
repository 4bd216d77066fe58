"""What `fit.json` has of one member: its stages, how it follows the channels, its noises and likelihood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gbspec.data import Estimated
from gbspec.ir import Model
from gbspec.runs.typed_json import OMITTED


@dataclass(frozen=True)
class SearchRecord:
    """What a search from several starts has found: how many were `improved`, how many `times` the best minimum was
    reached, and how many others ended `near` it, in none that is a worse one."""

    improved: int
    times: int
    near: int = 0
    others: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        if self.times != 1:
            return f"{self.improved} improved, the best minimum found {self.times} times"
        beside = f" ({self.near} other{'' if self.near == 1 else 's'} near it)" if self.near > 0 else ""
        return f"{self.improved} improved, the best minimum found 1 time{beside}"


@dataclass(frozen=True)
class StageRecord:
    """A stage of a member's training; the loss is None if it is not finite or the stage did not begin.

    `remark` says in words what the stage did, if its numbers do not; `search` is what a search has found.
    """

    name: str
    iterations: int
    loss: float | None
    seconds: float
    remark: str | None = field(default=None, metadata=OMITTED)
    search: SearchRecord | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)


def last_search(stages: Sequence[StageRecord]) -> SearchRecord | None:
    """What the last search among the stages has found; None if there was none."""
    found = [stage.search for stage in stages if stage.search is not None]
    return found[-1] if found else None


@dataclass(frozen=True)
class ChannelRecord:
    """How whole solutions, from their initial states, follow a channel's data.

    `r2` is 1 minus the mean squared error over the variance of the data (of logarithms, if the noise is log-normal),
    `naive` that of the best predictor that knows no model, which `predictor` names; None where they are undefined (the
    solution is not finite, the data do not vary). Of a model with disturbances both are of predictions one row ahead:
    the naive one is the last value, or the mean. `held` is `r2` of the data that `--holdout` excluded.
    `autocorrelation` is the correlation of residuals with the next ones of the same trajectory, from `pairs` of them.

    `values` is the number of measured values, `weight` that of a squared error, in units of the variance of the data.
    If the channel is weighed by a noise that the fit estimated, `noise` is its standard deviation, and `share` the
    share of the values that count. `outliers` is the number of residuals far from all others, if these leave most of
    the sum of squares. `lack_of_fit` is the probability that averages of replicates are so far from the solutions by
    the error of measurement that replicates show; None without replicates. `censored` of the `values` are limits, which
    `r2` does not count, and so many `averages` are of replicates; None where there are none. `as_stated` is True where
    whole solutions follow the values to the noise that model or table state, so that `r2` says nothing against them.
    """

    r2: float | None
    naive: float | None
    predictor: str = ""
    held: float | None = None
    values: int | None = field(default=None, metadata=OMITTED)
    weight: float | None = field(default=None, metadata=OMITTED)
    noise: float | None = field(default=None, metadata=OMITTED)
    share: float | None = field(default=None, metadata=OMITTED)
    autocorrelation: float | None = field(default=None, metadata=OMITTED)
    pairs: int = 0
    outliers: int | None = field(default=None, metadata=OMITTED)
    lack_of_fit: float | None = field(default=None, metadata=OMITTED)
    censored: int | None = field(default=None, metadata=OMITTED)
    averages: int | None = field(default=None, metadata=OMITTED)
    as_stated: bool | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class WhitenessRecord:
    """Tests of a channel's standardised innovations, which are independent and standard normal if the model is right.

    `ljung_box` is the statistic of their first `lags` autocorrelations, `p` its probability under independence,
    `robust_p` the probability where values are uncorrelated and their variance changes in time; `periodogram` the
    largest distance of the cumulated periodogram from the diagonal, `periodogram_p` its probability.
    """

    values: int
    lags: int
    ljung_box: float | None
    p: float | None
    periodogram: float | None
    periodogram_p: float | None
    robust_p: float | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class NoiseRecord:
    """A learned standard deviation of a channel's noise, the standard deviation of its logarithm, a 90 % interval."""

    value: float
    sd_of_log: float | None
    interval: tuple[float, float] | None
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class LikelihoodRecord:
    """The likelihood of a fit: `objective` says which. `parameters` is the number of fitted ones, `minus2ll` is that at
    the estimates, of which sizes of disturbances and noises maximise the restricted likelihood, and `least` at the
    maximum of the likelihood itself, to which `aic` and `bic` belong. With priors, which weights of unknown functions
    have too, these three are None; in runs of older versions `least` is, and `aic` and `bic` are at the estimates.
    `maximum` is False where the fit did not come to one. Where the likelihood grows without limit as the noise of the
    channels `unbounded` goes to zero, it has no maximum, and these three are None too."""

    objective: str
    minus2ll: float | None
    parameters: int
    values: int
    aic: float | None
    bic: float | None
    noise: Mapping[str, NoiseRecord] = field(default_factory=dict)
    whiteness: Mapping[str, WhitenessRecord] = field(default_factory=dict)
    least: float | None = field(default=None, metadata=OMITTED)
    maximum: bool | None = field(default=None, metadata=OMITTED)
    unbounded: tuple[str, ...] | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)

    def without_maximum(self) -> LikelihoodRecord:
        """That of a fit that did not come to its maximum: without criteria and intervals."""
        noise = {name: replace(one, sd_of_log=None, interval=None) for name, one in self.noise.items()}
        return replace(self, aic=None, bic=None, least=None, maximum=False, noise=noise)


@dataclass(frozen=True)
class MemberRecord:
    """A member's fit.

    `loss` is the mean of half squared residuals of whole solutions from their initial states, `interval_loss` that of
    predictions from each row to the next; `rmse` and `channels` by channel are of whole solutions; None where the
    solution was not finite, and `channels` in runs of older versions.

    `likelihood` is that of a fit by maximum likelihood; such a fit's errors are of predictions from row to row.

    `member` is its number and `files` the digests of its files by name; runs of version 0.1.0 have neither. `freedom`:
    the degrees of freedom of the residuals from which the noise was estimated; None for likelihoods and older runs.
    """

    seed: int
    loss: float | None
    rmse: Mapping[str, float | None]
    seconds: float
    stages: tuple[StageRecord, ...]
    member: int | None = field(default=None, metadata=OMITTED)
    files: Mapping[str, str] | None = field(default=None, metadata=OMITTED)
    interval_loss: float | None = field(default=None, metadata=OMITTED)
    channels: Mapping[str, ChannelRecord] | None = field(default=None, metadata=OMITTED)
    likelihood: LikelihoodRecord | None = field(default=None, metadata=OMITTED)
    freedom: float | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)

    def estimated(self, model: Model) -> Estimated | None:
        """The noise by which the member's channels are weighed, if that was estimated."""
        found = [(self.channels or {}).get(channel.name) for channel in model.channels]
        if all(one is None or one.share is None for one in found):
            return None
        noise = [np.nan if one is None or one.noise is None else one.noise for one in found]
        share = [1.0 if one is None or one.share is None else one.share for one in found]
        return Estimated(np.array(noise), np.array(share))


def comparable_losses(members: Sequence[MemberRecord]) -> list[float | None]:
    """The losses of members; if they weigh their channels differently, those with the geometric mean of the weights."""
    losses = [member.loss for member in members]
    weighed = [
        {name: one.weight for name, one in (member.channels or {}).items() if one.values and one.weight}
        for member in members
        if member.loss is not None
    ]
    if (
        not weighed
        or any(one.keys() != weighed[0].keys() for one in weighed)
        or all(one == weighed[0] for one in weighed)
    ):
        return losses
    common = {name: float(np.exp(np.mean([np.log(one[name]) for one in weighed]))) for name in weighed[0]}
    return [None if member.loss is None else _loss(member.channels or {}, common) for member in members]


def _loss(channels: Mapping[str, ChannelRecord], weights: Mapping[str, float]) -> float:
    """Half the mean weighted squared error, in units of the variances of the data, of the channels that have one."""
    found = [(one.values, weights[name] * (1 - one.r2)) for name, one in channels.items()
             if name in weights and one.values and one.r2 is not None]  # fmt: skip
    return 0.5 * sum(count * error for count, error in found) / max(sum(count for count, _ in found), 1)
