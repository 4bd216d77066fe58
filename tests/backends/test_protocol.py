"""What the rest of gbspec uses of a generated module is what every generated module has."""

from __future__ import annotations

import functools
import inspect
from typing import get_type_hints

import pytest

from gbspec.backends.module import load_module
from gbspec.backends.module.template.model import Template
from gbspec.backends.protocol import Equations, GeneratedModule
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir import scheduled

TEMPLATE: type[GeneratedModule] = Template  # mypy compares names and signatures
EQUATIONS: Equations = Template.equations


def parameters(function: object) -> list[tuple[str, object]]:
    """Names and defaults, without the instance or the class."""
    assert callable(function)
    found = inspect.signature(function).parameters.values()
    return [(one.name, one.default) for one in found if one.name not in ("self", "cls")]


def offered(protocol: type) -> dict[str, object]:
    """The methods and properties that a protocol names."""
    return {name: value for name, value in vars(protocol).items() if not name.startswith("_") and name != "unknowns"}


@pytest.mark.parametrize("name", sorted(shipped_models()))
def test_the_class_of_every_bundled_model_conforms(name: str) -> None:
    model = load_model(shipped_models()[name], Findings())
    module = load_module(model)
    for attribute in get_type_hints(GeneratedModule):
        assert hasattr(module, attribute) or attribute in ("weights", "info"), attribute
    for method, declared in offered(GeneratedModule).items():
        there = inspect.getattr_static(module, method)
        if isinstance(declared, property):
            assert isinstance(there, functools.cached_property | type), method
        else:
            assert isinstance(there, type(declared)), f"{method} is of a class on one side alone"
            assert parameters(getattr(module, method)) == parameters(getattr(GeneratedModule, method)), method
    optional = {"events"} if model.diffusions else {"events", "diffusions"}
    optional |= {"delays"} if model.delays else {"delays", "lags", "delayed", "history", "past"}
    optional |= set() if model.events else {"guards", "happen", "cutting"}
    optional |= set() if any(event.rank is not None for event in model.events) else {"ranks"}
    optional |= {"steady_states"} if model.steady is not None else {"steady_states", "steady", "settled"}
    optional |= set() if model.steady is not None and model.steady.after else {"resumed"}
    followed = model.steady is not None and any(event.guard is not None for event in model.events)
    optional |= set() if followed else {"followed"}
    optional |= {"blocks"} if model.algebraics else {"blocks", "algebraic", "unsolved"}
    optional |= set() if any(event.timing is not None for event in model.events) else {"timing"}
    optional |= {"whole"} if scheduled(model) else {"whole", "schedule"}
    for method in set(offered(Equations)) - optional:
        expected = [(model.time.name if key == "t" and method != "grid" else key, default)
                    for key, default in parameters(getattr(Equations, method))]  # fmt: skip
        assert parameters(getattr(module.equations, method)) == expected, method
    assert tuple(module.equations.unknowns) == module.unknowns
    instance = module.random()
    assert set(instance.weights) == set(module.shapes()) and instance.info == {}


def test_nothing_private_of_a_module_is_used_outside_of_it() -> None:
    """Equations and networks are reached by public names; a name with `_` is a matter of the template."""
    import re
    from pathlib import Path

    import gbspec

    private = re.compile(r"\b(?:module|instance|member)\._[a-z]\w*")
    root = Path(gbspec.__file__).parent
    found = {
        f"{path.relative_to(root)}: {use}"
        for path in root.rglob("*.py")
        for use in private.findall(path.read_text(encoding="utf-8"))
    }
    assert not found
