"""gbspec: a declarative compiler for gray-box dynamical models.

From Python: `gbspec.load("model.gb")` gives a model with the methods of the commands, `gbspec.open_run("run")` a run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gbspec.version import __version__

if TYPE_CHECKING:
    from gbspec.api import (
        Specification,
        bifurcate,
        check,
        evaluate,
        figure,
        import_model,
        load,
        open_run,
        simulate,
        study,
        train,
        validate,
    )
    from gbspec.diagnostics import ComputationError, Diagnostic, UserError
    from gbspec.fitted import FittedRun

__all__ = [
    "ComputationError",
    "Diagnostic",
    "FittedRun",
    "Specification",
    "UserError",
    "__version__",
    "bifurcate",
    "check",
    "evaluate",
    "figure",
    "import_model",
    "load",
    "open_run",
    "simulate",
    "study",
    "train",
    "validate",
]


def __getattr__(name: str) -> Any:
    """Imports `gbspec.api` when one of its names is first used: `import gbspec` alone stays light."""
    if name in ("ComputationError", "Diagnostic", "UserError"):
        from gbspec import diagnostics

        return getattr(diagnostics, name)
    if name in __all__:
        from gbspec import api

        return getattr(api, name)
    raise AttributeError(f"module `gbspec` has no attribute `{name}`")


def __dir__() -> list[str]:
    return sorted(__all__)
