"""Which constants have a profile."""

from __future__ import annotations

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model


def check(model: Model, name: str) -> None:
    """Raises UserError: GB777 for populations, GB858 for what is not a learned constant that trajectories share."""
    if model.marginal:
        message = "profiles of models with populations or learned noises are not offered yet"
        help = "`fit.json` has intervals from the information; `gbspec compare` tests one model against another"
        raise UserError([Diagnostic("GB777", message, None, help=help, subject=name)])
    known = [k.name for k in model.learnables if not k.per_trajectory]
    if name not in known:
        listed = ", ".join(f"`{one}`" for one in known)
        help = f"the shared learned constants are {listed}" if known else "the model has no shared learned constant"
        message = f"`{name}` is not a learned constant that all trajectories share"
        raise UserError([Diagnostic("GB858", message, None, help=help, subject=name)])
