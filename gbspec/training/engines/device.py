"""The device of the torch graph: the processor, or a GPU."""

from __future__ import annotations

import torch

from gbspec.diagnostics import Diagnostic, UserError


def device_of(wanted: str) -> str:
    """The torch device of `--device`; `auto` is a GPU if there is one. Raises UserError (GB861) without a GPU."""
    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        built = torch.version.cuda is not None
        why = "torch finds none on this machine" if built else f"this torch ({torch.__version__}) is built without CUDA"
        help_text = "leave `--device` out to train on the processor" + ("" if built else ", or install torch with CUDA")
        raise UserError([Diagnostic("GB861", f"`--device cuda` needs a GPU, and {why}", None, help=help_text)])
    return "cuda" if available and wanted != "cpu" else "cpu"
