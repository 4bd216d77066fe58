"""Packages that are not installed, as diagnostics with the command that installs them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from gbspec.diagnostics.diagnostic import Diagnostic, UserError

EXTRAS = {
    "torch": ("train", "training, or what uses the gradients of a learned model,"),
    "onnx": ("onnx", "`gbspec export --as onnx`"),
    "libsbml": ("sbml", "`gbspec import` of SBML"),
    "yaml": ("sbml", "`gbspec import` of PEtab"),
    "h5py": ("sbml", "`gbspec import` of PEtab-SciML"),
    "distributed": ("cluster", "`--scheduler`"),
}
"""Packages that `pip install gbspec` leaves out: the extra that brings each, and what needs it."""
REQUIRED = {
    "casadi": "the simulation, prediction or analysis of a model",
    "pygls": "`gbspec lsp`",
    "lsprotocol": "`gbspec lsp`",
    "matplotlib": "a figure",
}
"""Packages that belong to every installation, with what needs each; one may still have been removed or be broken."""


def missing_package(error: ImportError) -> Diagnostic | None:
    """The diagnostic (GB866) for a failed import of one of these packages; None for other modules."""
    name = (error.name or "").partition(".")[0]
    if name in EXTRAS:
        extra, what = EXTRAS[name]
        return _missing(name, what, f"gbspec[{extra}]")
    return _missing(name, REQUIRED[name], name) if name in REQUIRED else None


def _missing(name: str, what: str, package: str) -> Diagnostic:
    command = f"pip install '{package}'" if "[" in package else f"pip install {package}"
    message = f"{what} needs the package `{name}`, which is not installed"
    return Diagnostic("GB866", message, None, help=f"install it: `{command}`")


@contextmanager
def packages() -> Iterator[None]:
    """A context or decorator in which the import of such a package, if it fails, raises `UserError` (GB866)."""
    try:
        yield
    except ImportError as error:
        found = missing_package(error)
        if found is None:
            raise
        raise UserError([found]) from error
