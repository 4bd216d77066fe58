"""The bundled models: in a checkout's `models/`, or inside the installed package."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from gbspec.data.names import similar
from gbspec.diagnostics import Diagnostic, UserError

PACKAGE = Path(__file__).resolve().parent.parent


@cache
def models_folder() -> Path:
    """The folder with the bundled models: the wheel's `gbspec/_models`, else `models/` next to the package."""
    installed = PACKAGE / "_models"
    return installed if installed.is_dir() else PACKAGE.parent / "models"


@cache
def shipped_models() -> dict[str, Path]:
    """The bundled `.gb` files by the model's name (that of the file), in the order of names."""
    return {path.stem: path for path in sorted(models_folder().glob("*/*.gb"), key=lambda path: path.stem)}


def shipped_model(name: str) -> Path:
    """The file of a bundled model, e.g. `urp_gb2`; raises UserError (GB744) with a suggestion if there is none."""
    known = shipped_models()
    if name in known:
        return known[name]
    meant = similar(name, known)
    advice = f"is `{meant}` meant?" if meant else f"there are {', '.join(known)}"
    raise UserError([Diagnostic("GB744", f"there is no bundled model `{name}`", None, help=advice)])
