"""Small models with one unknown with contracts, and weights of every magnitude."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy
import torch

from gbspec.diagnostics import Diagnostic, Findings, Source, UserError
from gbspec.frontend import load_model
from gbspec.ir.model import Model, symbol

HEAD = """model m
state x in [0, 10]
learn K = 1 in [0.1, 10]
learn k = 2 > 0
"""


def model_of(unknown: str, head: str = HEAD) -> Model:
    """A model with the given unknown statement. Raises `UserError` for errors in it."""
    return whole_model(f"{head}{unknown}\nx' = -{_applied(unknown)}\nobserve x\n")


def whole_model(text: str) -> Model:
    """The model of a text, with its contracts; warnings are ignored."""
    return load_model("m.gb", Findings(), lambda path: Source(str(path), text))


def refused(unknown: str) -> list[Diagnostic]:
    """The errors of a model whose unknown is rejected."""
    try:
        model_of(unknown)
    except UserError as error:
        return [d for d in error.diagnostics if d.severity.value == "error"]
    return []


def _applied(unknown: str) -> str:
    """The unknown's outputs applied to x and the constants, so that every declaration is used."""
    names, _, rest = unknown.removeprefix("unknown ").partition("(")
    arguments = [part.split(" in [")[0].strip() for part in _split(rest)]
    given = ", ".join("x" if i % 2 == 0 else "0.1*x" for i in range(len(arguments)))
    return "*K*k - ".join(f"{name.strip()}({given})" for name in names.split(",")) + "*K*k"


def _split(text: str) -> list[str]:
    """The arguments up to the closing parenthesis; commas inside brackets do not separate."""
    parts, depth, part = [], 0, ""
    for character in text:
        if character == ")" and depth == 0:
            break
        depth += {"[": 1, "]": -1}.get(character, 0)
        if character == "," and depth == 0:
            parts.append(part)
            part = ""
        else:
            part += character
    return [*parts, part]


def weights(cls: Any, seed: int, kind: str = "random") -> dict[str, Any]:
    """Weights of an instance: of random magnitude (`random`), all zero, huge, or tiny; random scales and centers."""
    rng = np.random.default_rng(seed)
    out = dict(cls.random(seed).weights)
    size = {"random": 10 ** rng.uniform(-2, 1.5), "zero": 0.0, "huge": 1e6, "tiny": 1e-9}[kind]
    for name in out:
        if name.endswith((".weight", ".bias")):
            out[name] = size * rng.normal(size=out[name].shape)
        elif name.endswith(("_center", "_scale")):
            factor = 10 ** rng.uniform(-1, 1, out[name].shape)
            out[name] = out[name] * factor if name.endswith("scale") else out[name] + rng.normal(size=out[name].shape)
    out["constants"] = np.array([rng.uniform(0.1, 10) if name == "K" else rng.exponential() for name in cls.constants])
    return out


def points(model: Model, network: int, count: int, seed: int) -> torch.Tensor:
    """Arguments [count, n]: within their ranges if the guarantee needs these, else of every magnitude."""
    rng = np.random.default_rng(seed)
    forms = [u.form for u in model.unknowns if u.network == network]
    within = {name for form in forms if form is not None for name in form.within}
    states = {state.name: state.range for state in model.states}
    columns = []
    for argument in model.networks[network].arguments:
        given = argument.range or states.get(argument.name)
        if argument.name in within:
            assert given is not None
            columns.append(rng.uniform(given.low, given.high, count))
        else:
            columns.append(rng.normal(size=count) * 10 ** rng.uniform(-1, 3, count))
    return torch.tensor(np.stack(columns, 1), dtype=torch.float64)


def bound(value: sympy.Expr, model: Model, network: int, x: torch.Tensor, constants: Any) -> Any:
    """A contract's expression at arguments [count, n] and constants."""
    symbols = [argument.symbol for argument in model.networks[network].arguments]
    names = [symbol(name) for name in model.constant_names]
    function = sympy.lambdify([*symbols, *names], value, "numpy")
    return np.broadcast_to(np.asarray(function(*x.detach().numpy().T, *constants), dtype=float), (len(x),))
