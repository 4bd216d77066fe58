"""The verdict on a run in words: what is good, what to doubt, what to do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.frames import counted
from gbspec.ir import OF_COUNTS, OF_LOGARITHMS
from gbspec.report import collect
from gbspec.report.content import LearnedConstant, LearnedFunction
from gbspec.report.text import number, profile_verdicts
from gbspec.runs import (
    CERTAIN,
    FOLLOWED,
    SMALL_FOR_NOISE,
    autocorrelated,
    held_elsewhere,
    how_followed,
    small_for_noise,
)

if TYPE_CHECKING:
    from gbspec.analysis import Validation
    from gbspec.runs import ChannelRecord, Run

VAGUE = 0.5
"""Half a 90 % interval, relative to the value, from which a constant is hardly known."""
FUNCTION_CERTAIN, FUNCTION_VAGUE = 0.1, 0.3
"""Half a function's 90 % band, or the spread of its members, relative to its range over the data."""
HARDLY = "The data hardly determine"
"""The beginning of a doubt about a constant or a function that makes the whole a matter of reservations."""
NO_EFFECT = "` had no effect: "
"""What a warning of an option has that a fit did not use."""
BADLY = re.compile(r"Whole solutions follow `[^`]+` badly")
"""The beginning of a fit's warning of a channel, which is not repeated where its errors on the data say the same."""
ADVICE = re.compile(
    r"(?:; |[.] |: )"
    r"(?=(?:Train|train|widen|fix|do not|give|use|check|`--resume`|`--members|it is |what may|observe |leave ))"
)
"""Where the advice of a warning begins."""


@dataclass(frozen=True)
class Verdict:
    """A sentence about the whole, and what supports it; texts may contain names between backticks."""

    headline: str
    good: tuple[str, ...]
    doubt: tuple[str, ...]
    do: tuple[str, ...]


def verdict(run: Run, found: Validation, functions: Sequence[LearnedFunction], *, with_data: bool) -> Verdict:
    """The verdict on a run; `with_data` is false where its table was not found, so that nothing could be compared."""
    good: list[str] = []
    doubt: list[str] = []
    do: list[str] = []
    if not with_data:
        doubt.append("The table that it was trained on was not found, so that nothing is compared with data here.")
        do.append("Give the table's path: `gbspec report RUN --data DATA`.")
    _channels(run, found, good, doubt)
    shared = [one for one in collect.constants(run) if not run.fit.constants[one.name].per_trajectory]
    _constants(shared, good, doubt)
    for function in functions:
        _function(function, good, doubt)
    check = found.step_check
    if check.half_step is not None and check.adaptive is not None and not check.warning:
        off = number(100 * max(check.half_step, check.adaptive), 2)
        good.append(f"Smaller steps change the solutions by at most {off} % of the states' ranges.")
    elif check.ahead and check.half_step is not None and not check.warning:
        off = number(100 * check.half_step, 2)
        good.append(f"Smaller steps change predictions from row to row by at most {off} % of the states' ranges.")
    warnings = [*found.warnings_after(run.fit.warnings), *profile_verdicts(run)]
    warnings = [text for text in warnings if NO_EFFECT not in text]  # says nothing of the fit
    for warning in warnings:
        if len(run.numbers) == 1:
            warning = re.sub(r"^member \d+: ", "", warning)
        what, *advice = ADVICE.split(warning, maxsplit=1)
        followed = BADLY.match(_sentence(what))
        if followed is None or not any(text.startswith(followed[0]) for text in doubt):
            doubt.append(_sentence(what))
        do += map(_sentence, advice)
    _missing(run, doubt, do)
    reserved = bool(warnings) or any(text.startswith(HARDLY) for text in doubt)
    headline = _headline(run, found, warnings, reserved, with_data)
    return Verdict(headline, *(tuple(dict.fromkeys(each)) for each in (good, doubt, do)))


def _headline(run: Run, found: Validation, warnings: Sequence[str], reserved: bool, with_data: bool) -> str:
    """`reserved`: whether there are warnings, or something that the data hardly determine."""
    followed = {_how(run, found, name) for name in found.judged}
    worse = any(
        text in warning for warning in warnings for text in ("whole solutions follow", "do not rely on this fit")
    )
    if not with_data:
        return "Without its data, this fit cannot be judged."
    at_none = run.innovations is not None and run.innovations.maximum is False
    if at_none or (run.fit.population is not None and not (run.fit.population.maximum or run.fit.population.held)):
        return "Do not rely on this fit: its likelihood is not at its maximum."
    if worse or found.empty or "badly" in followed:
        who = "predictions" if found.ahead else "solutions"
        return f"Do not rely on this fit: its {who} do not follow the data."
    if "in part" in followed:
        return "It follows the data in part."
    return "It follows the data, with reservations." if reserved else "It follows the data."


def _channels(run: Run, found: Validation, good: list[str], doubt: list[str]) -> None:
    """Whole solutions against the data, beside the best predictor that knows no model; with random disturbances
    predictions from row to row."""
    who = "Predictions one row ahead" if found.ahead else "Whole solutions"
    for name, errors in found.judged.items():
        known = _records(run, name)
        naive = [one.naive for one in known if one.naive is not None]
        beside = (
            f"; without a model, {known[0].predictor or 'the best predictor'} reaches {naive[0]:.3g}" if naive else ""
        )
        of = f" {OF_LOGARITHMS}," if errors.logarithms else f" {OF_COUNTS}," if errors.counts else ""
        measured = f"R² {_share(errors.r2)}{of} over {counted(errors.n, 'value')}{beside}"
        how = _how(run, found, name)
        if how == "well":
            good.append(f"{who} follow `{name}`: {measured}.")
        else:
            explained = f"; {SMALL_FOR_NOISE}" if how == "in part" and small_for_noise(known) else ""
            doubt.append(f"{who} follow `{name}` {how}: {measured}{explained}.")
        held = [one.held for one in known if one.held is not None]
        if held:
            text = f"On data that the fit did not see, `{name}` has R² {_share(min(held))}."
            (good if min(held) >= FOLLOWED else doubt).append(text)


def _how(run: Run, found: Validation, channel: str) -> str:
    """How a channel is followed, by the errors that a fit is judged by. One row ahead a small R² is no reason to doubt
    the model: where innovations are independent, the measurements are noisy or the system moves by chance."""
    known = _records(run, channel)
    how = how_followed(found.judged[channel].r2, known)
    coloured = not known or any(autocorrelated({channel: one}) for one in known)
    return "in part" if how == "badly" and found.ahead and not coloured else how


def _records(run: Run, channel: str) -> list[ChannelRecord]:
    """What the members' fits say of a channel."""
    members = [member.channels or {} for member in run.fit.members]
    return [member[channel] for member in members if channel in member]


def _share(r2: float) -> str:
    """An R²: close to one, with as many nines as it has."""
    if not np.isfinite(r2):
        return "not finite"
    return f"{r2:.6f}".rstrip("0").rstrip(".") if 0.999 <= r2 < 0.9999995 else f"{r2:.3g}"


def _constants(constants: Sequence[LearnedConstant], good: list[str], doubt: list[str]) -> None:
    """How certain the constants are."""
    certain, unknown = [], []
    for one in constants:
        if one.interval is None:
            unknown.append(f"`{one.name}`")
            continue
        half = 0.5 * (one.interval[1] - one.interval[0])
        if half <= CERTAIN * abs(one.value):
            certain.append(f"`{one.name}` ±{100 * half / abs(one.value):.2g} %" if one.value else f"`{one.name}`")
        elif half >= VAGUE * abs(one.value):
            ends = f"{number(one.interval[0], 3)} to {number(one.interval[1], 3)}"
            doubt.append(f"{HARDLY} `{one.name}`: its 90 % interval is {ends}.")
    if certain:
        good.append(f"Constants with narrow 90 % intervals: {', '.join(certain)}.")
    if unknown:
        doubt.append(f"No interval is known for {', '.join(unknown)}.")


def _function(function: LearnedFunction, good: list[str], doubt: list[str]) -> None:
    """How certain a learned function is where there are data."""
    if not function.slices:
        return
    piece = function.slices[0]
    mean = piece.members.mean(axis=0)
    near = np.ones(len(piece.x), dtype=bool) if piece.far is None else ~piece.far
    span = float(np.ptp(mean[near])) if near.any() else 0.0
    if span <= 0:
        return
    where = f"`{function.name}` over `{piece.argument}`"
    if len(piece.members) > 1:
        spread = float(np.median(np.ptp(piece.members[:, near], axis=0))) / span
        if spread > FUNCTION_VAGUE:
            doubt.append(f"The members disagree about {where}: by {_percent(spread)} of its range (median).")
    if piece.band is None:
        doubt.append(f"No band is known for {where}.")
        return
    half = float(np.median(0.5 * (piece.band[1] - piece.band[0])[near])) / span
    wide = f"±{_percent(half)} of its range" if half < 1 else f"{_percent(half)} of its range to either side"
    text = f"{where}: the 90 % band is {wide} (median)."
    if half <= FUNCTION_CERTAIN:
        good.append(f"The data determine {text}")
    elif half >= FUNCTION_VAGUE:
        doubt.append(f"{HARDLY} {text}")
    if piece.far is not None and piece.far.any():
        doubt.append(f"{where} is extrapolated where the background is grey.")


def _percent(fraction: float) -> str:
    """A fraction in per cent, never as a power of ten."""
    return "more than 100 %" if fraction >= 1 else f"{float(f'{100 * fraction:.2g}'):g} %"


def _missing(run: Run, doubt: list[str], do: list[str]) -> None:
    """What was not tried."""
    record = run.fit
    if not record.finished:
        if held_elsewhere(run.path):
            doubt.append("Another process is still training it.")
            do.append("Look again when that process has ended.")
        else:
            doubt.append("Training was interrupted.")
            do.append("Continue it: the same `gbspec train` command with `--resume`.")
    if run.model.unknowns and len(run.numbers) < 2:
        doubt.append("A single member does not show how far the functions depend on the random start.")
        do.append("Train several: `--members 5`.")
    held = any(one.held is not None for member in record.members for one in (member.channels or {}).values())
    if record.data.trajectories > 1 and not held:
        doubt.append("All errors are of data that it was fitted to.")
        do.append("Hold trajectories out: `--holdout 0.2`, or `gbspec crossvalidate`.")


def _sentence(text: str) -> str:
    """A text with a capital letter and a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")
