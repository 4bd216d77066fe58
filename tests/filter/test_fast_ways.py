"""The fast ways of the filter against the plain ones: the compiled recursion, and forward mode in numpy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.training.engines import FilterEngine
from gbspec.training.engines.filter import recursion
from gbspec.training.engines.filter.compiled import advance
from gbspec.training.engines.filter.functions import Functions
from tests.filter.conftest import BENT, LINEAR, WITH_NETWORK, engine_of, table

DOSED = (
    "model m\ntime t\nstate x in [0, 5] = 1\nstate v in [0, 5] = 1\nlearn k = 0.7 in [0.1, 3] per trajectory\n"
    "learn f = 0.8 in [0.1, 1]\nlearn s = 0.2 in [0, 2]\n"
    "x' = -k*x^2 + if(v > 1, exp(-v), 0.3*v) + log(1 + x)/(2 + sin(t)) - tanh(x)*max(v, 0.5)^1.5\n"
    "v' = sqrt(v)*cos(x) - atan(v)*min(x, 2)/(1 + v)\ndose x times f\ndiffusion x = s*x\ndiffusion v = s*(1 + v^2)\n"
    "observe x\nobserve y = x*v\n"
)
DOSES = "\n".join(
    [
        "trajectory,t,x,y,dose_x",
        *(
            line
            for k in range(2)
            for line in (f"{k},0,1.1,,", f"{k},0.5,0.{7 + k},0.8,", f"{k},0.8,,,{1 + k}", f"{k},1.2,1.3,1.5,")
        ),
    ]
)


def engine(folder: Path, text: str) -> tuple[FilterEngine, np.ndarray]:
    channels = "X y" if text is LINEAR else "X V y"
    found, vector = engine_of(folder, text, DOSES + "\n" if text is DOSED else table(channels, rows=9))
    return found, vector + 0.05 * np.random.default_rng(3).standard_normal(len(vector))


def same(one: FilterEngine, other: FilterEngine, vector: np.ndarray) -> None:
    """Likelihood, gradient and information of both engines agree."""
    a, b = one.information(vector), other.information(vector)
    assert a.value == pytest.approx(b.value, rel=1e-10)
    size = np.abs(b.gradient).max()
    assert np.allclose(a.gradient, b.gradient, rtol=1e-8, atol=1e-9 * size)
    assert np.allclose(a.matrix, b.matrix, rtol=1e-8, atol=1e-9 * np.abs(b.matrix).max())


@pytest.mark.parametrize("text", [LINEAR, BENT, DOSED, WITH_NETWORK], ids=["linear", "bent", "dosed", "network"])
def test_the_compiled_recursion_is_that_of_numpy(tmp_path: Path, text: str) -> None:
    if advance() is recursion.advanced:
        pytest.skip("there is no C compiler")
    fast, vector = engine(tmp_path, text)
    plain = replace(fast)
    plain.__dict__["advance"] = recursion.advanced
    same(fast, plain, vector)


@pytest.mark.parametrize("text", [LINEAR, BENT, DOSED], ids=["linear", "bent", "dosed"])
def test_forward_mode_is_that_of_torch(tmp_path: Path, text: str) -> None:
    fast, vector = engine(tmp_path, text)
    assert fast.functions.forward is not None
    plain = replace(fast)
    plain.__dict__["functions"] = Functions(fast.functions.local, None)
    same(fast, plain, vector)


GIVEN = (
    "model m\ntime t\nstate x in [0, 5] = 1\nstate v in [0, 5] = 1\ninput u in [-1, 1] linear\n"
    "condition c in [0, 3]\nlearn k = 0.7 in [0.1, 3] per trajectory\nlearn s = 0.2 in [0, 2]\n"
    "unknown q(x in [0, 5], v in [0, 5])\n    >= 0, increasing in x\n    = x*nn\n    by mlp(3)\n"
    "x' = u + c*v - q(x, v)\nv' = -k*v + t*exp(-x)\ndiffusion x = s*x\ndiffusion v = s*(1 + v^2)*c\n"
    "observe x noise lognormal(0.1)\nobserve y = x*v + q(x, v)*u\n"
)
"""A network with contracts, conditions, inputs, and both kinds of coordinates and channels."""


def given() -> str:
    lines = table("x y", rows=9).splitlines()
    return "\n".join([lines[0] + ",c", *(f"{line},{1 + int(line[0])}" for line in lines[1:])]) + "\n"


@pytest.mark.parametrize("text", [WITH_NETWORK, GIVEN], ids=["network", "given"])
def test_values_by_numpy_are_those_of_torch(tmp_path: Path, text: str) -> None:
    data = given() if text is GIVEN else table("X V y", rows=9)
    fast, vector = engine_of(tmp_path, text, data)
    plain = replace(fast)
    plain.__dict__["functions"] = Functions(fast.functions.local, None)
    one, other = fast.filtered(vector), plain.filtered(vector)
    assert np.isfinite(one.value)
    assert one.value == pytest.approx(other.value, rel=1e-11)
    np.testing.assert_allclose(one.end_cov, other.end_cov, rtol=1e-8, atol=1e-12)


def test_models_with_networks_and_arrays_are_left_to_torch(tmp_path: Path) -> None:
    found, _ = engine(tmp_path, WITH_NETWORK)
    assert found.functions.forward is None
