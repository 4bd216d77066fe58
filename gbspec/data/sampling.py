"""The sampling of simulated measurements: the options of `gbspec simulate`, and of a case's `[sampling]`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.given import is_real, is_whole, plain, plain_values, shown

if TYPE_CHECKING:
    from gbspec.ir import Model

Box = tuple[float, float]
BY_NUMBER = "a category by its number, from 0 in the order of the model"
"""The remedy where a text is given for a number, and no model says which number is meant."""


def boxes(flag: str) -> Callable[[Sequence[str]], dict[str, Box]]:
    """A reader of texts `NAME=LOW:HIGH` or `NAME=VALUE`; it raises UserError (GB750) naming the flag."""

    def read(texts: Sequence[str]) -> dict[str, Box]:
        findings, found = Findings(), dict[str, Box]()
        for text in texts:
            name, equals, interval = text.partition("=")
            low, colon, high = interval.partition(":")
            try:
                box = (float(low), float(high if colon else low))
            except ValueError:
                box = (math.nan, math.nan)
            if not (name.strip() and equals and math.isfinite(box[0]) and math.isfinite(box[1]) and box[0] <= box[1]):
                findings.error(
                    "GB750",
                    f"`{flag} {text}` is not a name with a range",
                    None,
                    help=f"write `{flag} x1=0.2:0.95`, or `{flag} x1=0.5` for one value"
                    + (f"; {BY_NUMBER}" if flag == "--condition" else ""),
                )
            found[name.strip()] = box
        findings.raise_if_failed()
        return found

    return read


@dataclass(frozen=True)
class Regimen:
    """Doses into one state: their times, and the range from which each amount is drawn evenly."""

    amount: Box
    times: tuple[float, ...]


def regimen(text: str) -> Regimen:
    """Parses `100@0,12,24`, or `80:120@0` for random amounts; raises ValueError for anything else."""
    amount, at, times = text.partition("@")
    low, colon, high = amount.partition(":")
    found = Regimen((float(low), float(high if colon else low)), tuple(float(time) for time in times.split(",")))
    if not (at and all(map(math.isfinite, (*found.amount, *found.times))) and found.amount[0] <= found.amount[1]):
        raise ValueError(text)
    return found


def doses(texts: Sequence[str]) -> dict[str, str]:
    """Texts `NAME=AMOUNT@TIMES` as regimens by name, to be parsed by `regimen`."""
    return {name.strip(): rest for name, _, rest in (text.partition("=") for text in texts)}


def clocks(texts: Sequence[str]) -> dict[str, float]:
    """Texts `CHANNEL=INTERVAL` as intervals by channel; raises UserError (GB750)."""
    found = {}
    for name, (low, high) in boxes("--clock")(texts).items():
        if low != high or low <= 0:
            message = f"`--clock {name}=…` is not a mean interval above zero"
            raise UserError([Diagnostic("GB750", message, None, help=f"write `--clock {name}=0.5`")])
        found[name] = low
    return found


def _option(default: Any, help: str, **more: Any) -> Any:
    """A dataclass field with its help for the command line."""
    if isinstance(default, Mapping):
        return field(default_factory=dict, metadata={"help": help, **more})
    return field(default=default, metadata={"help": help, **more})


@dataclass(frozen=True)
class SimulateOptions:
    """The options of `gbspec simulate`, one field per flag. Times are in the model's unit.

    `initial` and `condition` are ranges by name, from which initial values and conditions are drawn uniformly; for
    other names the declared ranges are used (for a state without a range, its guess). `reject` are conditions such as
    `x2 > 4`: a trajectory that satisfies one at any time is drawn again.
    """

    trajectories: int = _option(100, "Number of trajectories.")
    span: float = _option(10.0, "Duration of each trajectory.")
    dt: float = _option(0.5, "Mean interval between measurements.")
    sampling: Literal["regular", "gamma"] = _option("regular", "Equal intervals, or gamma-distributed ones (shape 4).")
    channels: str = _option(
        "all", "all: every channel at every time; own-clock: each at its own times; 0.67: each with that probability."
    )
    keep_start: bool = _option(False, "Keep the row at the start, with all channels measured.")
    noise: float = _option(0.0, "Standard deviation of the noise, relative to that of each channel.")
    seed: int = _option(0, "Seed of the random numbers.")
    initial: Mapping[str, Box] = _option(
        {},
        "Range of a state's initial value, as x1=0.2:0.95 (repeatable).",
        metavar="NAME=LOW:HIGH",
        parse=boxes("--initial"),
    )
    condition: Mapping[str, Box] = _option(
        {},
        "Range of a condition or input, as Da=0.2:0.5 (a category by its number, from 0; repeatable).",
        metavar="NAME=LOW:HIGH",
        parse=boxes("--condition"),
    )
    dose: Mapping[str, str] = _option(
        {},
        "Doses into a state, as gut=100@0,12,24; gut=80:120@0 draws each amount (repeatable).",
        metavar="NAME=AMOUNT@TIMES",
        parse=doses,
    )
    clock: Mapping[str, float] = _option(
        {},
        "Mean interval of a channel, with --channels own-clock (repeatable).",
        metavar="NAME=INTERVAL",
        parse=clocks,
    )
    reject: tuple[str, ...] = _option(
        (), 'Draw trajectories again that enter a region, as "x2 > 4" (repeatable).', metavar="CONDITION"
    )

    def __post_init__(self) -> None:
        for name in ("span", "dt", "noise"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        if _by_name(self.clock, is_real):
            object.__setattr__(self, "clock", plain_values(self.clock))
        for name in ("initial", "condition"):
            given = getattr(self, name)
            if _boxes(given):
                object.__setattr__(self, name, {key: (plain(low), plain(high)) for key, (low, high) in given.items()})

    def check(self, findings: Findings) -> None:
        """Reports invalid options (GB754)."""
        rules = (
            (is_whole(self.trajectories) and self.trajectories >= 1, "trajectories", "a whole number, at least 1"),
            (is_real(self.span) and 0 < self.span < math.inf, "span", "a number above zero"),
            (is_real(self.dt) and 0 < self.dt < math.inf, "dt", "a number above zero"),
            (self.sampling in ("regular", "gamma"), "sampling", "`regular` or `gamma`"),
            (is_real(self.noise) and 0 <= self.noise < math.inf, "noise", "a number, zero or more"),
            (is_whole(self.seed) and self.seed >= 0, "seed", "a whole number, zero or more"),
            (_boxes(self.initial), "initial", "ranges by name, as in {'x1': (0.2, 0.95)}"),
            (_boxes(self.condition), "condition", "ranges by name, as in {'Da': (0.2, 0.5)}"),
            (_by_name(self.dose, _text), "dose", "doses by name, as in {'gut': '100@0,12,24'}"),
            (_by_name(self.clock, is_real), "clock", "intervals by name, as in {'x1': 0.5}"),
            (
                isinstance(self.reject, Sequence) and not _text(self.reject) and all(map(_text, self.reject)),
                "reject",
                "conditions, as in ['x1 > 4']",
            ),
            (not self.clock or self.channels == "own-clock", "clock", "used with `channels` own-clock"),
            (
                self.fraction is not None or self.channels in ("all", "own-clock"),
                "channels",
                "`all`, `own-clock` or a number above 0 and up to 1",
            ),
        )
        for holds, name, expected in rules:
            if not holds:
                value = getattr(self, name)
                said = value if name in ("sampling", "channels") else shown(value)
                findings.error("GB754", f"`{name}` is {said}, and must be {expected}", None, subject=name)
        for name, text in self.dose.items() if _by_name(self.dose, _text) else ():
            try:
                regimen(text)
            except ValueError:
                findings.error(
                    "GB750",
                    f"`--dose {name}={text}` is not a name, an amount and times",
                    None,
                    help=f"write `--dose {name or 'gut'}=100@0,12,24`, or `--dose {name or 'gut'}=80:120@0` for "
                    "random amounts",
                    subject=name,
                )

    @property
    def ranged(self) -> bool:
        """Whether everything that is given by name or as a list is so."""
        boxed = _boxes(self.initial) and _boxes(self.condition)
        listed = isinstance(self.reject, Sequence)
        return boxed and listed and _by_name(self.dose, _text) and _by_name(self.clock, is_real)

    @property
    def fraction(self) -> float | None:
        """The probability of each channel at a time, if `channels` is a probability; else None."""
        try:
            value = float(self.channels)
        except (TypeError, ValueError):
            return None
        return value if 0 < value <= 1 else None


def _text(given: object) -> bool:
    return isinstance(given, str)


def _by_name(given: object, holds: Callable[[object], bool]) -> bool:
    """Whether these are values by name, for each of which `holds` says so."""
    return isinstance(given, Mapping) and all(map(holds, given.values()))


def _boxes(given: object) -> bool:
    """Whether these are ranges by name."""
    return isinstance(given, Mapping) and all(map(_box, given.values()))


def _box(given: Any) -> bool:
    try:
        low, high = given
    except (TypeError, ValueError):
        return False
    return is_real(low) and is_real(high)


def fixed(options: SimulateOptions, values: Mapping[str, float], model: Model) -> SimulateOptions:
    """The options with every condition and input among `values` (`--set`) held at its value, unless a box names it."""
    if not options.ranged:  # an error of its own
        return options
    external = {item.name for item in (*model.conditions, *model.inputs)}
    held = {name: (value, value) for name, value in values.items() if name in external}
    return replace(options, condition={**held, **options.condition})
