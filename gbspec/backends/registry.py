"""Finds the backends in the folders next to this file; to add a backend, add its folder."""

from __future__ import annotations

import importlib.util
import pkgutil
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType, ModuleType

import gbspec.backends
from gbspec.backends import Backend
from gbspec.diagnostics import Defect

REGISTRATION = "backend"
"""The module in a folder that defines its `BACKEND`."""


@cache
def backends() -> Mapping[str, Backend]:
    """All backends by name, in the order of the names."""
    found = (_registered(Path(folder) / name, name) for folder in gbspec.backends.__path__ for name in _folders(folder))
    return MappingProxyType({b.name: b for b in sorted((b for b in found if b), key=lambda b: b.name)})


def _folders(path: str) -> list[str]:
    return [module.name for module in pkgutil.iter_modules([path]) if module.ispkg]


def _registered(folder: Path, name: str) -> Backend | None:
    """The backend of a folder, or None if it registers none."""
    path = folder / f"{REGISTRATION}.py"
    if not path.is_file():
        return None
    backend: object = getattr(_module(f"{gbspec.backends.__name__}.{name}.{REGISTRATION}", path), "BACKEND", None)
    if not isinstance(backend, Backend) or backend.name != name:
        raise Defect(f"{path} has no BACKEND with the name `{name}`")
    return backend


def _module(name: str, path: Path) -> ModuleType:
    """Imports a file under its own name, without its package's `__init__`.

    The `__init__` may load sympy or casadi, which `gbspec --help` does not need.
    """
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise Defect(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]  # so that the next call raises the error too
        raise
    return module
