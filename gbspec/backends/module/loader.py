"""Loads the generated module of a Model in this process."""

from __future__ import annotations

import copyreg
import hashlib
import importlib.util
import linecache
import sys

from gbspec.backends.module.render import class_name, generate
from gbspec.backends.protocol import GeneratedModule
from gbspec.diagnostics import Defect
from gbspec.ir import RK4, Method, Model

_loaded: dict[str, type[GeneratedModule]] = {}


def load_module(model: Model, method: Method = RK4) -> type[GeneratedModule]:
    """The class of the module generated for a method; models whose modules have the same text share it.

    The text is executed as if from a file: it is registered as a module and with `linecache`, so that tracebacks show
    it; its objects can be pickled, and loaded in another process.
    """
    text = generate(model, method)
    return _class(text, class_name(model))


def _class(text: str, name: str) -> type[GeneratedModule]:
    digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
    if digest not in _loaded:
        made = _execute(text, f"gbspec_generated_{digest[:16]}", name)
        # Another process does not have the module, so that a pickled instance takes the text along.
        copyreg.pickle(made, lambda instance: (_restored, (text, name), instance.__getstate__()))
        _loaded[digest] = made
    return _loaded[digest]


def _restored(text: str, name: str) -> GeneratedModule:
    """An instance without weights, of the class of a text, for `pickle`, which then sets what was kept of it."""
    return object.__new__(_class(text, name))


def _execute(text: str, name: str, class_name: str) -> type[GeneratedModule]:
    path = f"<{name}>"
    spec = importlib.util.spec_from_loader(name, loader=None, origin=path)
    if spec is None:
        raise Defect(f"no import spec could be made for the module `{name}`")
    module = importlib.util.module_from_spec(spec)
    try:
        code = compile(text, path, "exec")
    except SyntaxError as error:
        raise Defect(f"the generated module is not valid Python: {error}") from error
    linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)
    sys.modules[name] = module
    exec(code, module.__dict__)  # generated from a Model; text from users only occurs escaped
    return getattr(module, class_name)  # type: ignore[no-any-return]  # the class that the text defines
