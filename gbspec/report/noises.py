"""The noises of measurement that a fit with random disturbances has learned, beside its constants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.runs import Run


@dataclass(frozen=True)
class LearnedNoise:
    """The standard deviation of a channel's noise, in its unit or of its logarithm: its own deviation and interval."""

    title: str
    value: float
    sd: float | None
    interval: tuple[float, float] | None
    unit: str


def learned_noises(run: Run) -> tuple[LearnedNoise, ...]:
    """The noises that the best member has learned by the likelihood of innovations: those that the model does not
    state. One that has gone to zero, or is not told from a disturbance, has no interval."""
    if not run.model.diffusions:
        return ()
    from gbspec.ir import logarithmic
    from gbspec.report.collect import channel_unit

    record = run.innovations
    found, out = {} if record is None else record.noise, []
    for channel, log in zip(run.model.channels, logarithmic(run.model), strict=True):
        one = found.get(channel.name)
        if one is not None:
            known = one.interval is not None and one.sd_of_log is not None
            sd = one.value * (one.sd_of_log or 0.0) if known else None
            unit = "" if log else channel_unit(run.model, channel)
            out.append(LearnedNoise(f"noise of {channel.name}", one.value, sd, one.interval, unit))
    return tuple(out)
