"""The units of noises: those of the channel, none of relative ones, and no unit of a measured quantity for counts."""

from __future__ import annotations

from collections.abc import Callable

from gbspec.diagnostics import Label
from gbspec.ir import WITH_DENSITY
from gbspec.semantics.dimensions import Units
from gbspec.semantics.units import ONE, Unit
from gbspec.syntax import PREDICTION, ast, target_name


def check(units: Units, statement: ast.ObserveStatement, unit: Unit, usable: Callable[[ast.Expression], bool]) -> None:
    """Checks the unit of a noise of a channel in `unit`: the channel's for a standard deviation, none for a coefficient
    of variation, degrees of freedom and a size."""
    noise = statement.noise
    if noise is None or not all(map(usable, noise.arguments)):
        return
    name = target_name(statement.target)
    form = WITH_DENSITY.get(noise.kind.text)
    counts = form is not None and form.counts
    if counts:
        _count(units, name, noise, unit)
    formals = {PREDICTION: unit, name.text: unit}
    changing = units.solution.namespace.difference(units.solution.resolved(unit))
    first = ONE if counts or noise.kind.text == "lognormal" else changing
    for argument, wanted in zip(noise.arguments, (first, ONE), strict=False):
        units.carries(argument, wanted, f"the noise of `{name.text}`", name.span, formals)


def _count(units: Units, name: ast.Name, noise: ast.Distribution, unit: Unit) -> None:
    """Reports counts in a unit that is not one of counted things: a pure number, or a unit of the model's own."""
    namespace = units.solution.namespace
    known = units.solution.known(unit)
    if known is None or namespace.is_one(known) or known.lone() in namespace.own:
        return
    shown = units.solution.shown(known)
    units.findings.error(
        "GB505",
        f"`{name.text}` is in `{shown}`, and counts have no unit, or one that the model declares (`unit cells`)",
        noise.span,
        label="the noise of counts",
        labels=[Label(name.span, f"in `{shown}`")],
        help="observe the number that is counted, as a concentration times the volume that was looked through: "
        "`observe counted = C*V noise poisson`",
    )
