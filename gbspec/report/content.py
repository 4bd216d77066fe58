"""The content of figures as plain float64 arrays."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.arrays import Array, Mask
from gbspec.runs import ProfileRecord


@dataclass(frozen=True)
class ChannelFit:
    """One channel of one trajectory.

    Measurements `measured` [R] at `times` [R]; curves on a dense grid `grid` [G]: `members` [M, G], one per member of
    the ensemble (their mean is drawn, their range shaded), and the `truth` [G] if there is one. Censored values are
    `below` and `above` limits: times and limits [2, L], None without any. `solution`: what the curves are.
    """

    name: str
    times: Array
    measured: Array
    grid: Array
    members: Array
    truth: Array | None = None
    unit: str = ""
    below: Array | None = None
    above: Array | None = None
    solution: str = "model"


@dataclass(frozen=True)
class Given:
    """What the data give over the time of a trajectory: an input (a curve), or doses into a state (amounts at times).

    `times`, `values` [P]; the corners of a held input are among its points.
    """

    name: str
    times: Array
    values: Array
    unit: str = ""
    doses: bool = False


@dataclass(frozen=True)
class TrajectoryFit:
    """One trajectory: its label, its condition in words, its channels, and the origin of its initial state.

    `given` are its inputs and doses, `own` its constants `per trajectory` in words.
    """

    label: str
    condition: str
    channels: tuple[ChannelFit, ...]
    origin: str = ""
    given: tuple[Given, ...] = ()
    own: str = ""


@dataclass(frozen=True)
class LearnedFunction:
    """One unknown over the region of its arguments that the data cover.

    `points` [P, A] are its arguments along the fitted trajectories, `members` [M, P] its values there, `truth` [P] the
    reference. Each of `slices` varies one argument over the range of the points while the others are constant.
    """

    name: str
    arguments: tuple[str, ...]
    points: Array
    members: Array
    truth: Array | None
    slices: tuple[Slice, ...]
    plane: Plane | None = None
    unit: str = ""


@dataclass(frozen=True)
class Slice:
    """A function of one argument: `x` [G], `members` [M, G], `truth` [G] or None; `label` says what is held fixed.
    `unit` is the argument's.

    `postulate` [G] is the function postulated in the model, None if there is none; `visited` [V] are values of the
    argument in the data, within the range of `x`; `trained` is the range of the network's training, if it is known.
    `band` are the ends [2, G] of the 90 % band, `far` [G] says where the function is extrapolated; None: not known.
    """

    argument: str
    x: Array
    members: Array
    truth: Array | None
    label: str
    postulate: Array | None = None
    visited: Array | None = None
    trained: tuple[float, float] | None = None
    band: Array | None = None
    far: Mask | None = None
    unit: str = ""


@dataclass(frozen=True)
class Plane:
    """A function of its two leading arguments on a grid: `learned` [Y, X], `truth` [Y, X] or None, the rest fixed.

    `half` [Y, X] is half the width of the 90 % band, None if that is not known.
    """

    x_name: str
    y_name: str
    x: Array
    y: Array
    learned: Array
    truth: Array | None
    label: str
    half: Array | None = None
    units: tuple[str, str] = ("", "")


@dataclass(frozen=True)
class LearnedConstant:
    """A learned constant: its value, an interval, one value per member, its starting value, the truth, and the result
    of a profile, if one was made."""

    name: str
    value: float
    interval: tuple[float, float] | None
    members: tuple[float, ...]
    start: float | None = None
    truth: float | None = None
    profile: ProfileRecord | None = None
    unit: str = ""


@dataclass(frozen=True)
class OwnConstant:
    """A constant per trajectory: the `values` [N] and 90 % intervals `low` to `high` [N] (NaN: not known) of the
    trajectories `labels`."""

    name: str
    labels: tuple[str, ...]
    values: Array
    low: Array
    high: Array
    unit: str = ""
    truth: float | None = None


@dataclass(frozen=True)
class History:
    """One member's training: `seconds` [N] (cumulative), `loss` [N], the name of the `stage` of each, and the
    constants."""

    member: int
    stage: tuple[str, ...]
    seconds: Array
    loss: Array
    constants: dict[str, Array]


@dataclass(frozen=True)
class Residuals:
    """The residuals [N] of one channel (see `gbspec.ir.residual`) at `times` [N] of all trajectories.

    `predicted` [N] are the values there in the channel's unit; `logarithmic`: the residuals are of logarithms;
    `solution`: what predicts.
    """

    name: str
    times: Array
    predicted: Array
    residual: Array
    logarithmic: bool = False
    unit: str = ""
    solution: str = "model"


@dataclass(frozen=True)
class Orbit:
    """One trajectory in the plane of two states: `learned` [G, 2], `truth` [G, 2] or None, `measured` [N, 2]."""

    label: str
    learned: Array
    truth: Array | None
    measured: Array
