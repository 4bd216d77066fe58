"""From a Model to the class of its generated module, in this process."""

from __future__ import annotations

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
    """The class of the module generated for a method; one and the same for models whose module has the same text.

    The text runs as it would from a file: it is registered as a module and with `linecache`, so that tracebacks show it
    and its objects can be pickled within the process.
    """
    text = generate(model, method)
    digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
    if digest not in _loaded:
        _loaded[digest] = _execute(text, f"gbspec_generated_{digest[:16]}", class_name(model))
    return _loaded[digest]


def _execute(text: str, name: str, class_name: str) -> type[GeneratedModule]:
    path = f"<{name}>"
    spec = importlib.util.spec_from_loader(name, loader=None, origin=path)
    if spec is None:
        raise Defect(f"the module `{name}` cannot be described")
    module = importlib.util.module_from_spec(spec)
    try:
        code = compile(text, path, "exec")
    except SyntaxError as error:
        raise Defect(f"the generated module is not valid Python: {error}") from error
    linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)
    sys.modules[name] = module
    exec(code, module.__dict__)  # the text is our own, made of a Model; nothing a user wrote is in it unprinted
    return getattr(module, class_name)  # type: ignore[no-any-return]  # the class that the text defines
