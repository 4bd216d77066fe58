"""Structural analysis of a valid Model: conservation laws and identifiability."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.diagnostics import Findings
from gbspec.ir import Model
from gbspec.passes.conservation import Law, linear_laws
from gbspec.passes.identifiability import Identifiability, identifiability
from gbspec.passes.starts import unknown_starts


@dataclass(frozen=True)
class Examination:
    """Linear conservation laws, and sets of parameters that no data can separate."""

    laws: tuple[Law, ...]
    identifiability: Identifiability


def examine(model: Model, findings: Findings) -> Examination:
    """Finds both; parameters that cannot be separated are recorded as warnings (GB401, GB402), and starts that `train`
    refuses (GB790)."""
    unknown_starts(model, findings)
    laws = () if model.events else linear_laws(model)  # an event may change any of them; delayed values are like inputs
    disturbed = {one.state for one in model.diffusions}  # independent disturbances do not cancel
    laws = tuple(law for law in laws if not disturbed & {name for name, _ in law.coefficients})
    return Examination(laws, identifiability(model, findings))
