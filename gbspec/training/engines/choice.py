"""What solves a problem: the native kernel, or the torch graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir.model import Model
from gbspec.training.engines.device import device_of
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.options import TrainOptions


@dataclass(frozen=True)
class Choice:
    """What solves a problem: a kernel, or (None) the torch graph; `remark` says why it is not the kernel."""

    kernel: Kernel | None = None
    remark: str = ""


TORCH = Choice()

LEAST_SUBSTEPS = 1500
"""With fewer sub-steps in the data, `--backend auto` does not wait for the compiler: it takes two seconds or so, and at
2,500 sub-steps a fit of urp_gb2 takes 15 instead of 29."""


def choose(model: Model, module: type[Any], options: TrainOptions, substeps: int) -> Choice:
    """The choice of `--backend` for data of so many sub-steps.

    Raises UserError (GB863) where the kernel was asked for and cannot be had.
    """
    wanted = options.backend == "native"
    if options.backend == "torch" or not (wanted or substeps >= LEAST_SUBSTEPS):
        return TORCH
    if device_of(options.device) != "cpu":
        found: Kernel | str = "the native kernel does not work on a GPU"
    else:
        found = kernel_of(model, module)
    if not isinstance(found, str):
        return Choice(found)
    if wanted:
        help_text = "leave `--backend` out: the torch graph then serves"
        raise UserError([Diagnostic("GB863", f"`--backend native` cannot be had: {found}", None, help=help_text)])
    return Choice(None, f"the torch graph serves: {found}")
