"""The table of the kinds of figures of a run, for `gbspec plot` and for the page.

A kind's module has a function `build(source: Source) -> Figure`, which raises `MissingError` if there is nothing to
show. The modules are imported when a figure is requested, so that importing this table is cheap.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Protocol, cast

if TYPE_CHECKING:
    from gbspec.report.description import Figure
    from gbspec.report.source import Source


class Builder(Protocol):
    """The interface of a kind's module."""

    @staticmethod
    def build(source: Source) -> Figure:
        """The description of the figure. Raises `MissingError` where there is nothing to show."""


@dataclass(frozen=True)
class Kind:
    """A kind of figure: `name` for `gbspec plot`, its `help`, and the `module` that builds it.

    `heading` and `note` are those of its section on the page (without a heading it has none), `section` is the
    section's id where it is not the name; that of an `optional` one is left out where there is nothing to show. `also`
    are other names for `gbspec plot`.
    """

    name: str
    help: str
    module: str
    heading: str = ""
    note: str = ""
    section: str = ""
    also: tuple[str, ...] = ()
    optional: bool = False

    @property
    def id(self) -> str:
        """The id of its section on the page."""
        return self.section or self.name

    def build(self, source: Source) -> Figure:
        """The description of the figure. Raises `MissingError` where there is nothing to show."""
        return cast(Builder, import_module(self.module)).build(source)


_HERE = "gbspec.report.figures"
KINDS = (
    Kind(
        "fit",
        "measurements and the learned solution",
        f"{_HERE}.fit",
        heading="Data and fit",
        note="Solutions from the initial states, by an adaptive solver; below what is measured: states that are not, "
        "inputs and doses. Measurements are dots; the truth is dashed; the shaded band is the range of the members. "
        "Solutions of a model with random disturbances are those without them, which lead measurements away.",
    ),
    Kind(
        "functions",
        "unknown functions along each argument",
        f"{_HERE}.functions",
        heading="Learned functions",
        note="Along each argument, with the others at their medians over the data; then over the plane of two "
        "arguments, where there are data. Ticks: positions of the data. Shaded: the 90 % band of the fit. Grey "
        "background: far from the data that the function was learned from.",
        also=("function",),
    ),
    Kind("constants", "learned constants with intervals", f"{_HERE}.constants", also=("constant",)),
    Kind(
        "per-trajectory",
        "the constants that each trajectory has for itself, with intervals",
        f"{_HERE}.per_trajectory",
        heading="Constants of single trajectories",
        note="Values with 90 % intervals, given the other parameters' uncertainty.",
        also=("own",),
        optional=True,
    ),
    Kind(
        "parity",
        "the right-hand side, learned against true",
        f"{_HERE}.parity",
        heading="Right-hand side, model against truth",
        note="At the fitted states of the measured rows.",
    ),
    Kind(
        "residuals",
        "residuals over time and prediction, and their distribution",
        f"{_HERE}.residuals",
        heading="Residuals",
        note="Predicted minus measured, or the logarithm of their ratio under log-normal noise, in the "
        "units that the fit uses. Of a model with random disturbances they are those of its solution without them; its "
        "fit minimises innovations.",
        also=("residual",),
    ),
    Kind(
        "predictive-check",
        "quantiles of the data within those of simulated populations",
        f"{_HERE}.predictive_check",
        heading="Visual predictive check",
        note="Lines: the 5 %, 50 % and 95 % quantiles of the measurements in intervals of time. Bands: the 90 % range "
        "of the same quantiles of populations that were simulated with the trajectories, times and conditions of the "
        "data.",
        also=("vpc",),
        optional=True,
    ),
    Kind(
        "weighted-residuals",
        "conditional weighted residuals of a population over time and prediction",
        f"{_HERE}.weighted_residuals",
        heading="Conditional weighted residuals",
        note="Standard normal if model and noise are right. The third panel compares measurements with the predictions "
        "of the population and of each trajectory's own constants.",
        also=("cwres",),
        optional=True,
    ),
    Kind(
        "prediction-errors",
        "normalised prediction distribution errors of a population",
        f"{_HERE}.prediction_errors",
        heading="Prediction distribution errors",
        note="Where each measurement lies among simulated ones, after the values of its trajectory have been "
        "decorrelated, as a standard normal number. p is that of their being standard normal; a small one means that "
        "distributions, noise or structure are not right.",
        also=("npde",),
        optional=True,
    ),
    Kind("history", "the loss and the constants over the training", f"{_HERE}.history", heading="Training"),
    Kind(
        "innovations",
        "tests of the innovations of a model with random disturbances",
        f"{_HERE}.innovations",
        heading="Innovations",
        note="Errors of predictions from row to row in their standard deviations, their autocorrelation and their "
        "cumulated periodogram. If the model describes the data, they are independent: within the dashed lines (95 %).",
        optional=True,
    ),
    Kind(
        "eigenvalues",
        "eigenvalues of the Jacobian along the data",
        f"{_HERE}.eigenvalues",
        heading="Eigenvalues along the data",
    ),
    Kind(
        "initial-states",
        "learned, bred and true initial states",
        f"{_HERE}.initial_states",
        heading="Initial states along fast and slow directions",
        note="Learned and bred initial states against the reference, then their errors, decomposed into the modes of "
        "the Jacobian there, slowest first, in units of the states' ranges. Bred: the start from which the learned "
        "dynamics follow the whole trajectory best. An error along a fast direction decays before it is measured.",
        section="starts",
    ),
    Kind(
        "phase",
        "trajectories in the plane of the first two states",
        f"{_HERE}.phase",
        heading="Phase portrait",
    ),
    Kind("summary", "a fit, a function and the constants in one", f"{_HERE}.summary"),
)
"""In the order of the page."""


def names() -> tuple[str, ...]:
    """All names of kinds that `gbspec plot` accepts."""
    return tuple(name for kind in KINDS for name in (kind.name, *kind.also))


def kind_of(name: str) -> Kind:
    """The kind of that name. Raises `ValueError` where there is none."""
    for kind in KINDS:
        if name in (kind.name, *kind.also):
            return kind
    raise ValueError(f"`{name}` is no kind of figure; there are {', '.join(kind.name for kind in KINDS)}")
