"""What can be known of a Model before anything runs, beyond whether it is right."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.diagnostics import Findings
from gbspec.ir import Model
from gbspec.passes.conservation import Law, linear_laws
from gbspec.passes.identifiability import Identifiability, identifiability


@dataclass(frozen=True)
class Examination:
    """Linear conservation laws, and what no data could separate."""

    laws: tuple[Law, ...]
    identifiability: Identifiability


def examine(model: Model, findings: Findings) -> Examination:
    """Finds both; what cannot be separated is recorded as warnings (GB401, GB402)."""
    return Examination(linear_laws(model), identifiability(model, findings))
