"""The content of `fit.json`, which is read and written only here.

The keys are the names of the fields, in their order. Files of version 0.1.0 lack the keys of fields with a default.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gbspec.backends import INTERFACE
from gbspec.data import Estimated, Scales, Trajectories, scales_of
from gbspec.diagnostics import Findings
from gbspec.files import finite
from gbspec.ir import METHODS, RK4, Model, Network, logarithmic
from gbspec.json_values import JsonObject
from gbspec.runs import files
from gbspec.runs.population import ObjectiveRecord, PopulationRecord
from gbspec.runs.quantiles import quantile
from gbspec.runs.typed_json import OMITTED, JsonError, decode, encode, read_object
from gbspec.version import __version__

Option = str | int | float | bool | None
"""The value of an option of training; integers stay integers."""
OLDEST = 1
"""The oldest interface of the generated module whose runs can still be read; assumed if a run names none."""
SPLINES = 3
"""The first interface whose coefficients of splines have the units of `gbspec.passes.splines`."""
LAYERS = 4
"""The first interface whose later layers of networks with directions have the units of `gbspec.passes.layouts`."""
DAMAGED = "restore the file from a copy, or train again into another directory"
UNBEGUN = "its training stopped before it began: the same `gbspec train` command begins it again"


@dataclass(frozen=True)
class DataRecord:
    """The data that a run was trained on: path and SHA-256 of the table, numbers of trajectories, rows and values.

    `path` is as it was given; `absolute` and `relative` (to the run) are the table's place, by which it is found from
    other folders. Data that were in no table are kept in the run, and `path` is empty; `sha256` is of their content.
    `format`: the form of the table, as for `--format`, if it is no ordinary one.
    """

    path: str
    sha256: str
    trajectories: int
    rows: int
    values: int
    absolute: str | None = field(default=None, metadata=OMITTED)
    relative: str | None = field(default=None, metadata=OMITTED)
    format: str | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class OwnRecord:
    """A trajectory's value of a constant per trajectory, like that of a shared constant."""

    value: float
    sd: float | None
    interval: tuple[float, float] | None
    others: Mapping[str, object] = field(default_factory=dict)


CERTAIN = 0.1
"""Half a 90 % interval, relative to the value, up to which a constant is certain."""


@dataclass(frozen=True)
class ConstantRecord:
    """A learned constant, in its unit: mean over members, standard deviation, 90 % interval (None: not known).

    A constant per trajectory has its mean over the trajectories here, and their values by label in `per_trajectory`.
    """

    value: float
    sd: float | None
    interval: tuple[float, float] | None
    start: float
    per_member: tuple[float, ...]
    per_trajectory: Mapping[str, OwnRecord] | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)

    @property
    def half_width(self) -> float | None:
        """Half the interval, relative to the value; None where it is not known."""
        if self.interval is None:
            return None
        half = 0.5 * (self.interval[1] - self.interval[0])
        return half / abs(self.value) if self.value else None if half else 0.0

    @property
    def certain(self) -> bool:
        """Whether the data determine the constant by itself: half its interval is at most a tenth of its value."""
        return self.half_width is not None and self.half_width <= CERTAIN


@dataclass(frozen=True)
class StageRecord:
    """A stage of a member's training; the loss is None if it is not finite or the stage did not begin.

    `remark` says in words what the stage did, if its numbers do not.
    """

    name: str
    iterations: int
    loss: float | None
    seconds: float
    remark: str | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class ChannelRecord:
    """How whole solutions, from their initial states, follow a channel's data.

    `r2` is 1 minus the mean squared error over the variance of the data (of logarithms, if the noise is log-normal),
    `naive` that of the best predictor that knows no model, which `predictor` names; None where they are undefined (the
    solution is not finite, the data do not vary). `held` is `r2` of the data that `--holdout` excluded.
    `autocorrelation` is the correlation of residuals with the next ones of the same trajectory, from `pairs` of them.

    `values` is the number of measured values, `weight` that of a squared error, in units of the variance of the data.
    If the channel is weighed by a noise that the fit estimated, `noise` is its standard deviation, and `share` the
    share of the values that count. `outliers` is the number of residuals far from all others, if these leave most of
    the sum of squares. `lack_of_fit` is the probability that averages of replicates are so far from the solutions by
    the error of measurement that replicates show; None without replicates.
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
    """The likelihood that a fit maximised: `objective` says which. `parameters` is the number of fitted ones."""

    objective: str
    minus2ll: float | None
    parameters: int
    values: int
    aic: float | None
    bic: float | None
    noise: Mapping[str, NoiseRecord] = field(default_factory=dict)
    whiteness: Mapping[str, WhitenessRecord] = field(default_factory=dict)
    others: Mapping[str, object] = field(default_factory=dict)


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


DEPENDS = 0.01
"""A difference above this fraction of the states' range means that solutions depend on the step of a fit."""


@dataclass(frozen=True)
class StepRecord:
    """Check of a member's step: largest differences relative to the states' ranges (None: no check, or not finite)."""

    half_step: float | None
    adaptive: float | None
    step: float | None
    trajectories: int
    unsolved: int = 0
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class ScalesRecord:
    """The scales of residuals in training (`gbspec.data.Scales`), by channel; `noise` None if one is not stated."""

    channel: tuple[float | None, ...]
    deviation: tuple[float | None, ...]
    level: float
    noise: float | None
    others: Mapping[str, object] = field(default_factory=dict)

    @classmethod
    def of(cls, scales: Scales) -> ScalesRecord:
        """The record of the scales of the training data; None for a channel without any."""
        channel, deviation = (tuple(map(finite, map(float, each))) for each in (scales.channel, scales.deviation))
        return cls(channel, deviation, scales.level, scales.noise)

    @classmethod
    def mean(cls, scales: Sequence[Scales]) -> ScalesRecord:
        """The record of several members' scales: their geometric mean."""
        channel = np.exp(np.mean([np.log(one.channel) for one in scales], axis=0))
        level = float(np.exp(np.mean([np.log(one.level) for one in scales])))
        return cls.of(replace(scales[0], channel=channel, level=level))

    def scales(self, model: Model) -> Scales:
        """The scales of a model's channels."""
        channel, deviation = (np.array(each, dtype=np.float64) for each in (self.channel, self.deviation))
        return Scales(logarithmic(model), channel, deviation, self.level, self.noise)


@dataclass(frozen=True)
class BackendRecord:
    """The backend that all members use, `native` or `torch`, where `--backend auto` measured both: the seconds that a
    fit was expected to take by the torch graph and by the kernel."""

    used: Literal["native", "torch"]
    torch: float
    native: float
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class FitRecord:
    """The content of `fit.json`.

    `gbspec` is the version that wrote the file, `interface` that of its generated module; `noise` the standard
    deviation by channel; `correlations` of the shared constants by their names, empty if not known; `solver` one of
    `gbspec.ir.methods`, and `solver_reason` why it was chosen, where the training chose it for a reason; `step_checks`
    has one entry per member and is empty if no check was made; `scales` are missing in older runs. `objective` is what
    was minimised, `population` the distributions of constants, where there are any. `backend` is missing where the
    number of sub-steps or an option decided. `finished` is false while members are fitted and after an interruption:
    files of members may then be newer than this record. `files` are the digests of the run's other files by name.
    `others` are keys that this version does not know; they are kept.
    """

    gbspec: str
    model: str
    data: DataRecord
    options: Mapping[str, Option]
    versions: Mapping[str, str]
    constants: Mapping[str, ConstantRecord]
    noise: Mapping[str, float | None]
    members: tuple[MemberRecord, ...]
    warnings: tuple[str, ...]
    correlations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    solver: str = RK4.name
    solver_reason: str | None = field(default=None, metadata=OMITTED)
    step_checks: tuple[StepRecord, ...] = ()
    interface: int = OLDEST
    scales: ScalesRecord | None = field(default=None, metadata=OMITTED)
    backend: BackendRecord | None = field(default=None, metadata=OMITTED)
    objective: ObjectiveRecord | None = field(default=None, metadata=OMITTED)
    population: PopulationRecord | None = field(default=None, metadata=OMITTED)
    finished: bool = True
    files: Mapping[str, str] | None = field(default=None, metadata=OMITTED)
    others: Mapping[str, object] = field(default_factory=dict)

    @property
    def quantile(self) -> float:
        """Half the width of 90 % intervals, in standard deviations: of the member with the least `freedom`."""
        return quantile(min((one.freedom for one in self.members if one.freedom is not None), default=None))

    def scales_for(self, model: Model, trajectories: Trajectories) -> Scales:
        """The scales of residuals for a table: those of the training, so that few rows are weighed as in the fit; those
        of the table itself in older runs."""
        return scales_of(model, trajectories) if self.scales is None else self.scales.scales(model)

    def to_json(self) -> JsonObject:
        """The content of `fit.json` as a JSON object."""
        document: JsonObject = encode(self)
        return document

    def write(self, directory: Path) -> None:
        """Writes `fit.json` into a run directory, atomically."""
        files.write_json(directory / files.FIT, self.to_json())


def read_record(directory: Path, findings: Findings) -> FitRecord | None:
    """Reads the `fit.json` of a run directory.

    Returns None if it is damaged (GB852 for each wrong key) or of an interface that this version cannot read (GB857);
    an older interface is a warning (GB857).
    """
    path = directory / files.FIT
    if not path.is_file():
        begun = (directory / files.MEMBERS).is_dir()
        findings.error("GB852", f"`{path}` is missing", None, help=DAMAGED if begun else UNBEGUN)
        return None
    try:
        content = read_object(path)
        if "gbspec" not in content and "model" not in content:
            raise JsonError(["it does not describe a fit of gbspec"])
        if _of_another_interface(directory, content, findings):
            return None
        record = decode(FitRecord, content)
    except OSError as error:
        findings.error("GB852", f"`{path}` cannot be read: {error.strerror}", None, help=DAMAGED)
    except JsonError as error:
        for finding in error.findings:
            findings.error("GB852", f"`{path}` is damaged: {finding}", None, help=DAMAGED)
    else:
        if record.solver in METHODS:
            if record.interface < INTERFACE:
                _warn_of_an_older_interface(directory, record, findings)
            return record
        message = f"`{path}` names a solver that this version does not have: `{record.solver}`"
        help_text = f"use the version that wrote it; here there are {', '.join(METHODS)}"
        findings.error("GB852", message, None, help=help_text)
    return None


def _of_another_interface(directory: Path, content: Mapping[str, object], findings: Findings) -> bool:
    """Whether the run's weights are for a generated module that this version does not read, which is reported.

    This is checked before anything else is read, since the keys may differ too.
    """
    interface, wrote = content.get("interface", OLDEST), content.get("gbspec")
    if type(interface) is not int or OLDEST <= interface <= INTERFACE:
        return False
    which = f"this is gbspec {__version__}, which reads {OLDEST} to {INTERFACE}"
    _refuse(directory, wrote, interface, which, findings)
    return True


def check_weights(directory: Path, record: FitRecord, model: Model) -> None:
    """Raises UserError (GB857) for weights of an older interface that have another meaning now."""
    findings = Findings()
    if record.interface < SPLINES and any(network.spline for network in model.networks):
        which = f"coefficients of splines have other units since {SPLINES}"
        _refuse(directory, record.gbspec, record.interface, which, findings)
    elif record.interface < LAYERS and any(_saturates_late(network) for network in model.networks):
        which = f"second layers of networks with directions have other units since {LAYERS}"
        _refuse(directory, record.gbspec, record.interface, which, findings)
    findings.raise_if_failed()


def _saturates_late(network: Network) -> bool:
    """Whether layers after the first have saturating units: before, all of their units were saturating."""
    later = network.layout.hidden[1:] if network.layout is not None else ()
    return any(block.shape == "saturating" for layer in later for block in layer)


def _refuse(directory: Path, wrote: object, interface: int, which: str, findings: Findings) -> None:
    message = f"the run `{directory}` was written by gbspec {wrote} for the module interface {interface}; {which}"
    path = shlex.quote(str(directory / files.MODEL))
    other = f"gbspec {wrote}" if wrote != __version__ else f"the earlier state of gbspec {wrote} that wrote it"
    help_text = f"use {other}, or train again with this one: `gbspec train {path} DATA -o RUN`"
    findings.error("GB857", message, None, help=help_text)


def _warn_of_an_older_interface(directory: Path, record: FitRecord, findings: Findings) -> None:
    message = (
        f"the run `{directory}` was written by gbspec {record.gbspec} for the module interface {record.interface}; its "
        f"module is generated again from `{files.MODEL}` for the interface {INTERFACE}"
    )
    help_text = "nothing has to be done; `gbspec train … --resume` with the run's options writes the run as it is now"
    findings.warning("GB857", message, None, help=help_text)
