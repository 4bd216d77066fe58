"""The record of a member of a study, and the content of `study.json`, which are made of such records.

The keys are the names of the fields, in their order. Fields with the metadata OMITTED occur only if they have
a value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from gbspec.json_values import JsonObject
from gbspec.runs import OMITTED, JsonError, StageRecord, StepRecord, decode, encode, files, read_object

Norms = Mapping[str, int | float | None]
"""Norms of an error by name, None where one is not finite; for constants also the relative error of each of them."""
Complex = tuple[float, float]
"""Real and imaginary part."""


@dataclass(frozen=True)
class Counts:
    """The numbers of trajectories, rows and values in a member's data."""

    trajectories: int
    rows: int
    values: int


@dataclass(frozen=True)
class Eigenvalues:
    """Spectra at an initial state and their distances to the true one; see `gbspec.studies.starts`."""

    trajectory: str
    true: tuple[Complex, ...]
    learned_at_true: tuple[Complex, ...]
    learned: tuple[Complex, ...]
    error_at_true: tuple[float, ...]
    error: tuple[float, ...]


@dataclass(frozen=True)
class Extent:
    """Number, median and maximum of some values; None if there are none."""

    n: int
    median: float | None
    worst: float | None


@dataclass(frozen=True)
class InitialStates:
    """Errors of learned initial states: of each state, and along fast and slow directions."""

    states: Mapping[str, Extent]
    fast: Extent
    slow: Extent


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """What a member's fit reached: its costs, errors and warnings; the tables on initial states where requested."""

    data: Counts
    cpu_seconds: float
    wall_seconds: float
    other_cpu_seconds: float
    loss: float | None
    stages: tuple[StageRecord, ...]
    constants: Mapping[str, float | None]
    max_step: float | None
    errors: Mapping[str, Norms]
    nrmse: Mapping[str, float | None]
    unsolved: tuple[str, ...]
    step_check: StepRecord
    step_warning: str | None
    warnings: tuple[str, ...]
    eigenvalues: Eigenvalues | None = field(default=None, metadata=OMITTED)
    initial_states: InitialStates | None = field(default=None, metadata=OMITTED)
    versions: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class Record:
    """A finished member: `fitted`, whose keys are among its own in the file, or the reason of its `failure`.

    `resumed`: an interrupted fit was continued, so that the costs are not those of the whole fit; `fit_of` names the
    case whose equal fit this is.
    """

    case: str
    member: int
    seed: int
    settings: str
    resumed: bool = False
    finished: str = ""
    fitted: Fitted | None = field(default=None, metadata=OMITTED)
    failure: str | None = field(default=None, metadata=OMITTED)
    machine: str = ""
    fit_of: str | None = field(default=None, metadata=OMITTED)

    def to_json(self) -> JsonObject:
        """The content of the member's file."""
        document: JsonObject = {}
        for name, value in encode(self).items():
            document |= value if name == "fitted" else {name: value}
        return document

    def write(self, path: Path) -> None:
        """Writes the member's file, atomically."""
        files.write_json(path, self.to_json())


def read_record(path: Path) -> Record | None:
    """The record of a finished member; None if there is none or it is damaged."""
    try:
        content = read_object(path)
        record = decode(Record, content)
        return record if record.failure is not None else replace(record, fitted=decode(Fitted, content))
    except (OSError, JsonError):
        return None


# ------------------------------------------------------------------------------------------------------- study.json
@dataclass(frozen=True)
class MemberStatistics:
    """Statistics over members: a failed member counts as infinite in median and worst; there is then no mean."""

    mean: float
    sd: float
    median: float
    worst: float


@dataclass(frozen=True)
class MetricSummary:
    """The published error and the norms of the members' errors; norms that no member has are omitted."""

    published: float | None
    L1: MemberStatistics | None = field(default=None, metadata=OMITTED)
    L2: MemberStatistics | None = field(default=None, metadata=OMITTED)
    Linf: MemberStatistics | None = field(default=None, metadata=OMITTED)


@dataclass(frozen=True)
class CpuSeconds:
    """CPU time over the `members` that were fitted without an interruption."""

    median: float
    most: float
    members: int


@dataclass(frozen=True)
class EigenvaluesSummary:
    """Spectra of the first member; distances are the median over the members that have them."""

    members: int
    trajectory: str
    true: tuple[Complex, ...]
    learned_at_true: tuple[Complex, ...]
    learned: tuple[Complex, ...]
    error_at_true: tuple[float, ...]
    error: tuple[float, ...]


@dataclass(frozen=True)
class CaseSummary:
    """A case over its finished members; `failed` and `step_warnings` are numbers of members."""

    title: str
    model: str | None
    members: int
    planned: int
    fit_of: str | None
    effort: str
    noise: float
    failed: tuple[int, ...]
    step_warnings: tuple[int, ...]
    cpu_seconds: CpuSeconds | None
    metrics: Mapping[str, MetricSummary]
    eigenvalues: EigenvaluesSummary | None = field(default=None, metadata=OMITTED)
    initial_states: Mapping[str, Extent] | None = field(default=None, metadata=OMITTED)


@dataclass(frozen=True)
class Summary:
    """The content of `study.json`; `last` is the time at which the last member finished."""

    command: str
    seed: int
    versions: Mapping[str, tuple[str, ...]]
    machines: tuple[str, ...]
    last: str | None
    cases: Mapping[str, CaseSummary]

    def to_json(self) -> JsonObject:
        """The content of `study.json` as a JSON object."""
        document: JsonObject = encode(self)
        return document
