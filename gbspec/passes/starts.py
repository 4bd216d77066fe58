"""Starts that a fit by the likelihood does not know: it learns none of its own for each trajectory."""

from __future__ import annotations

from gbspec.diagnostics import Findings
from gbspec.ir import Model


def unknown_starts(model: Model, findings: Findings) -> None:
    """Warns of states whose start is neither given nor measured, in a model that is fitted by the marginal likelihood
    (GB790); `train` refuses it (GB776)."""
    if not model.marginal or model.diffusions:
        return
    measured = {channel.state for channel in model.channels}
    told = set()
    for i, state in enumerate(model.states):
        free = state.initial.kind == "learned" or (state.initial.kind == "measured" and i not in measured)
        if not free or (state.span is not None and state.span in told):  # elements of one array
            continue
        told.add(state.span)
        name = state.name
        findings.warning(
            "GB790",
            f"`train` will refuse this model: the start of `{name}` is to be learned, which its likelihood does not do",
            state.span,
            help=f"write `initial {name} = …`, a number or a constant such as `learn {name}_0 = …`, "
            "with `per trajectory ~ lognormal` where it differs",
            subject=name,
        )
