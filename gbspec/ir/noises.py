"""The kinds of noise: how each is written, what messages say of it, and what it has in place of a sum of squares.

The likelihood of a noise with a density of its own (`density`) is in `gbspec.training.population.families`, under the
same kind; `counts.py` has the intervals of counts. Nothing is imported here that a check of a file does not need.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

NoiseKind = Literal["normal", "lognormal", "student", "poisson", "negative_binomial"]


@dataclass(frozen=True)
class NoiseForm:
    """A kind of noise, written as `parameters` say.

    `whose`: what a message says of such a noise ("Student's"). `density`: it has a likelihood and no sum of squares,
    even where nothing of it is learned. `counts`: it is the distribution of whole numbers from 0. `shape`: the name of
    its last parameter where that shapes the distribution, with `bounds` that suit a learned one.
    """

    kind: NoiseKind
    parameters: tuple[str, ...]
    example: str
    whose: str
    shape: str = ""
    bounds: str = ""
    density: bool = False
    counts: bool = False

    @property
    def signature(self) -> str:
        """`student(scale, df)`; `poisson`."""
        return f"{self.kind}({', '.join(self.parameters)})" if self.parameters else self.kind

    def upper(self, shape: float) -> float | None:
        """The 95 % point in units of the scale; None: that of the normal distribution."""
        return None


@dataclass(frozen=True)
class _Student(NoiseForm):
    def upper(self, shape: float) -> float:
        from scipy.special import stdtrit  # not every command needs it

        return float(stdtrit(shape, 0.95))


NOISES: Mapping[NoiseKind, NoiseForm] = {
    form.kind: form
    for form in (
        NoiseForm("normal", ("sd",), "normal(0.1)", "normal"),
        NoiseForm("lognormal", ("cv",), "lognormal(0.1)", "log-normal"),
        _Student(
            "student", ("scale", "df"), "student(0.1, 5)", "Student's", "degrees of freedom", "5 in [1, 100]",
            density=True,
        ),
        NoiseForm("poisson", (), "poisson", "that of Poisson counts", density=True, counts=True),
        NoiseForm(
            "negative_binomial", ("k",), "negative_binomial(10)", "that of negative binomial counts", "size",
            "10 in [0.1, 1e4]", density=True, counts=True,
        ),
    )
}  # fmt: skip
"""All kinds of noise, by the word that a model has for them."""

WITH_DENSITY: Mapping[str, NoiseForm] = {form.kind: form for form in NOISES.values() if form.density}
"""The noises with a density of their own, by their words."""

LEAST_COUNT = 1e-30
"""The expectation of a count is at least this: a count where the model has none is improbable, but not impossible."""
