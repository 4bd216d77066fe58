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
from gbspec.data import Scales, Trajectories, scales_of
from gbspec.diagnostics import Findings
from gbspec.files import finite
from gbspec.ir import METHODS, RK4, ErrorScale, Model, Network, error_scales, logarithmic
from gbspec.json_values import JsonObject
from gbspec.runs import files
from gbspec.runs.member import MemberRecord
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
    `format`: the form of the table, as for `--format`, if it is no ordinary one. `conditions`: their least and largest
    values. `content`: the SHA-256 of the content of a table, in whatever file or data frame it is.
    """

    path: str
    sha256: str
    trajectories: int
    rows: int
    values: int
    absolute: str | None = field(default=None, metadata=OMITTED)
    relative: str | None = field(default=None, metadata=OMITTED)
    format: str | None = field(default=None, metadata=OMITTED)
    conditions: Mapping[str, tuple[float, float]] | None = field(default=None, metadata=OMITTED)
    content: str | None = field(default=None, metadata=OMITTED)
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

    def error_scales(self, model: Model) -> tuple[ErrorScale, ...]:
        """The scale on which errors of each channel are judged, of counts with the learned size."""
        return error_scales(model, {k: one.value for k, one in self.constants.items() if one.value is not None})

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
