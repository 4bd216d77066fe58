"""Generated modules with tensors of float32: types are kept, and results are those of float64 up to rounding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec.backends.module import load_module
from tests.training.test_populations import model_of

MODELS = {
    "spline": ["unknown f(X in [0, 5]) by spline(8)", "X' = -f"],
    "spline of two": ["state Y = 1", "unknown f(X in [0, 5], Y in [0, 5]) by spline(6, 6)", "X' = -f", "Y' = f - Y"],
    "contracts": [
        "unknown f(X in [0, 5]) zero at X = 0, increasing in X by spline(6)",
        "unknown g(X in [0, 5]) equals 1 at X = 1 by mlp(4)",
        "unknown h(X in [0, 5]) period 5 in X by mlp(4)",
        "X' = h - f*g",
    ],
    "numbers that are chosen": [
        "time t",
        "let s = if(t > 0.2, 0.1, 0.3)",
        "unknown f(X in [0, 5], s in [0, 1]) by mlp(5)",
        "X' = max(s, 0.2) - f",
        "observe z = if(X > 0.5, 1.1, 0.1)",
    ],
    "array": [
        "state c[1..3] in [0, 5]",
        "unknown f(x in [0, 5]) by spline(6)",
        "c[i]' = max(c[i-1], 0.2) - if(c[i] > 0.5, 0.1, 0.2) - f(c[i])",
        "c[0] = 1",
        "X' = f(X)",
    ],
    "table": ["table f(X) = (0, 0), (1, 2), (2, 3), (5, 4)", "X' = -f(X)"],
    "delay": [
        "time t : h from 0",
        "learn tau = 1.5 in [0.5, 4]",
        "unknown f(d in [0, 5]) by spline(5)",
        "let d = delay(X, tau)",
        "X' = f - 0.1*X",
        "history X = 0.8",
    ],
    "event": [
        "time t : h from 0",
        "learn k = 0.7 in [0.1, 2]",
        "unknown f(X in [0, 5]) by spline(5)",
        "event kick every 0.2: X = X + 0.1",
        "X' = k - f",
    ],
    "algebraic": [
        "algebraic p in [0.01, 10] = 1",
        "unknown g(p in [0, 10]) increasing in p by mlp(4)",
        "equation balance: p + 0.1*g = X + 1",
        "X' = 0.1*g - X",
    ],
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("batch", [(), (3,)], ids=["one", "three"])
def test_tensors_keep_their_type(name: str, batch: tuple[int, ...], tmp_path: Path) -> None:
    lines = ["model m", "state X in [0, 5] = 1", *MODELS[name], "observe X", ""]
    module = load_module(model_of("\n".join(lines), tmp_path)).random(0)
    x = np.random.default_rng(0).uniform(0.3, 0.7, (*batch, len(module.states)))

    def found(dtype: torch.dtype) -> dict[str, torch.Tensor]:
        state = torch.as_tensor(x, dtype=dtype)
        out = {"simulate": module.simulate(state, [0.0, 0.25, 0.5], max_step=0.05)}
        if name != "delay":  # whose equations want delayed values beside the state
            out |= {"rhs": module.rhs(0.1, state), "observe": module.observe(0.1, state)}
            out["step"] = module.step(0.0, state, 0.05)
        for function, call in module.functions.items():
            size = len(module.networks[module.equations.unknowns[function][0]]["arguments"])
            out[function] = call(state.new_full((*batch, size), 0.4))
        return out

    narrow, wide = found(torch.float32), found(torch.float64)
    for key, value in narrow.items():
        assert (value.dtype, wide[key].dtype) == (torch.float32, torch.float64), key
        assert value.double().numpy() == pytest.approx(wide[key].numpy(), rel=1e-4, abs=1e-4), key
