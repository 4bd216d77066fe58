"""What a run keeps of a population: the likelihood and the distributions in `fit.json`, and tables for figures.

`members/K/population.safetensors` has, for every measured value, its trajectory, channel and time, the predictions of
the population (all deviations 0) and of the trajectory's own constants, conditional weighted residuals (`cwres`) and
those of the own predictions (`iwres`), normalised prediction distribution errors (`npde`),
and the quantiles of a visual predictive check.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gbspec.arrays import Array
from gbspec.runs import files
from gbspec.runs.typed_json import OMITTED

POPULATION = "population.safetensors"


@dataclass(frozen=True)
class ObjectiveRecord:
    """What the fit minimised, in words, and its value at the end."""

    definition: str
    value: float | None
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class EffectRecord:
    """A constant's distribution: `median` (the mean of a normal one) and `sd` of the deviations (of logarithms, if it
    is lognormal; of logits, if logitnormal). `interval` is that of the median, `sd_interval` that of the spread (90 %;
    None: not known, or fixed). `per`: the column between whose values it differs; the distribution
    of a second grouping has a record of its own, `NAME per COLUMN`."""

    median: float
    sd: float
    interval: tuple[float, float] | None
    shrinkage: float | None
    distribution: str = "lognormal"
    median_sd: float | None = None
    sd_interval: tuple[float, float] | None = None
    per: str = "trajectory"
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class ErrorsRecord:
    """Normalised prediction distribution errors of a channel: their number, mean and variance, and the p value of their
    being standard normal (three tests, Bonferroni)."""

    n: int
    mean: float
    variance: float
    p: float
    others: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class PopulationRecord:
    """A fit by the marginal likelihood. `correlations` are of deviations. `parameters` is the number p of estimated
    numbers (of weights the effective one), `aic` is -2 log L + 2 p, `bic` -2 log L + p log(measured values);
    `nodes` of quadrature for each effect (1: Laplace's method), `ridge` of networks, and `npde` by channel.
    `exact_hessian` is -2 log L by Laplace's method with the exact inner Hessian at the same estimates (None: that is
    not positive definite for some trajectory). `minus2ll` is None where it is not a finite number. `maximum`: whether
    the likelihood is at its maximum; where the stage that maximises it did not run, or ended early, or `held`, it is
    not, and there are no AIC and BIC; nor are there with priors of constants, with which the estimates are not at the
    maximum of L. `held`: held-out data chose weights of networks on the way to the maximum."""

    minus2ll: float | None
    effects: Mapping[str, EffectRecord]
    correlations: Mapping[str, Mapping[str, float]]
    parameters: float = 0.0
    aic: float | None = None
    bic: float | None = None
    nodes: int = 1
    ridge: float | None = field(default=None, metadata=OMITTED)
    npde: Mapping[str, ErrorsRecord] = field(default_factory=dict)
    exact_hessian: float | None = None
    maximum: bool = True
    held: bool = False
    others: Mapping[str, object] = field(default_factory=dict)

    @property
    def reason(self) -> str:
        """Why the likelihood is not at its maximum."""
        if self.held:
            return "held-out data chose a point on the way to it"
        return "the stage that seeks it did not run, or ended early"


@dataclass(frozen=True)
class PopulationTables:
    """The file's content: tables by name, and the labels of the trajectories."""

    arrays: Mapping[str, Array]
    labels: tuple[str, ...]

    def write(self, directory: Path) -> None:
        """Writes it into a member's directory."""
        files.write_tensors(directory / POPULATION, dict(self.arrays), {"labels": list(self.labels)})


def read_tables(directory: Path) -> PopulationTables | None:
    """The tables of a member; None if there are none, or they are damaged."""
    path = directory / POPULATION
    if not path.is_file():
        return None
    try:
        arrays, remarks = files.read_tensors(path)
    except ValueError:
        return None
    labels = remarks.get("labels")
    if not isinstance(labels, list):
        return None
    return PopulationTables(arrays, tuple(map(str, labels)))
