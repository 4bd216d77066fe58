"""A profile as it is returned, printed and written."""

from __future__ import annotations

from dataclasses import dataclass, field

import polars as pl

from gbspec.frames import Shown, of_rows
from gbspec.runs import NORMAL_90
from gbspec.training.profile.agreement import Comparison

THRESHOLD = NORMAL_90**2
"""The 90 % point of chi-squared with one degree of freedom, as of data whose noise is known."""


@dataclass(frozen=True)
class ProfilePoint:
    """The fit with the constant at `value`: `deviance` relative to the best point, and the `others`, that is, the other
    constants.

    `converged` is False if the fit had not converged after the iterations allowed: the deviance is then too large.
    """

    value: float
    deviance: float
    others: dict[str, float]
    converged: bool


@dataclass(frozen=True, repr=False)
class Profile(Shown):
    """A profile, ordered by value. `low` and `high` are the ends of the 90 % interval; None if the threshold was not
    reached on that side, or if some fit has not converged. `fitted` is the fit's interval; `comparison` says
    which of both to trust. `noise` is the standard deviation to which a deviance of squares refers."""

    name: str
    member: int
    estimate: float
    points: tuple[ProfilePoint, ...]
    low: float | None
    high: float | None
    noise: float | None
    notes: tuple[str, ...] = ()
    threshold: float = THRESHOLD
    fitted: tuple[float, float] | None = None
    comparison: Comparison = field(default_factory=lambda: Comparison("both"))

    def to_frame(self) -> pl.DataFrame:
        """One row for each value: the constant, `deviance`, `converged`, and the other constants fitted there."""
        return of_rows(
            {self.name: point.value, "deviance": point.deviance, "converged": point.converged, **point.others}
            for point in self.points
        )

    @property
    def settled(self) -> bool:
        """Whether every fit has converged, so that the deviances are meaningful."""
        return all(point.converged for point in self.points)

    def to_json(self) -> dict[str, object]:
        """The content of `profile --json`."""
        return {
            "constant": self.name,
            "member": self.member,
            "estimate": self.estimate,
            "interval": [self.low, self.high],
            "fit_interval": None if self.fitted is None else list(self.fitted),
            "trust": self.comparison.trust,
            "verdict": self.comparison.words or None,
            "threshold": self.threshold,
            "noise": self.noise,
            "points": [
                {"value": p.value, "deviance": p.deviance, "converged": p.converged, "constants": p.others}
                for p in self.points
            ],
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        ends = [f"{end:.6g}" if end is not None else "open" for end in (self.low, self.high)]
        interval = f"90 % interval {ends[0]} to {ends[1]}" if self.settled else "no interval, see the note"
        lines = [f"{self.name} = {self.estimate:.6g}, {interval}"]
        for point in self.points:
            inside = "inside" if point.deviance <= self.threshold else ""
            rest = "" if point.converged else "  not converged"
            lines.append(
                f"  {self.name} = {point.value:<12.6g} deviance {point.deviance:<10.4g} {inside}{rest}".rstrip()
            )
        if self.fitted is not None:
            agree = ", which agrees" if self.comparison.trust == "both" else ""
            lines.append(f"interval of the fit: {self.fitted[0]:.6g} to {self.fitted[1]:.6g}{agree}")
        notes = [*self.notes, *([self.comparison.words] if self.comparison.words else [])]
        return "\n".join([*lines, *(f"note: {note}" for note in notes)])
