"""Layers of networks that act on pictures, as formulas, against torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from gbspec.imports.computing import value_of
from gbspec.imports.formulas import Formula, number
from gbspec.imports.petab.layers import NotOfferedLayerError, convolved, flattened, linear, pooled

RNG = np.random.default_rng(0)


def formulas(values: Any) -> Any:
    made = np.empty(np.shape(values), dtype=object)
    for place, value in np.ndenumerate(values):
        made[place] = number(float(value))
    return made


def numbers(made: Any) -> Any:
    return np.array([value_of(one, {}) for one in made.ravel()]).reshape(made.shape)


def plain(place: str, total: Formula) -> Formula:
    return total


@pytest.mark.parametrize("lead", [(), (1,)])
@pytest.mark.parametrize(
    "args", [{}, {"stride": [2, 1]}, {"padding": [1, 2], "dilation": [2, 1]}, {"stride": 2, "padding": 1}]
)
def test_convolutions(lead: tuple[int, ...], args: dict[str, Any]) -> None:
    x, weight, bias = RNG.normal(size=(*lead, 2, 6, 5)), RNG.normal(size=(3, 2, 2, 3)), RNG.normal(size=3)
    found = numbers(convolved(formulas(x), formulas(weight), formulas(bias), args, plain))
    known = torch.nn.functional.conv2d(*map(torch.from_numpy, (x, weight, bias)), **args)
    np.testing.assert_allclose(found, known.numpy(), rtol=1e-12, atol=1e-14)


def test_pooling_flattening_and_linear_layers() -> None:
    x = RNG.normal(size=(2, 5, 4))
    for kind, function in (("MaxPool2d", torch.max_pool2d), ("AvgPool2d", torch.nn.functional.avg_pool2d)):
        for args in ({"kernel_size": 2}, {"kernel_size": [3, 2], "stride": [2, 1]}):
            known = function(torch.from_numpy(x), **args)
            np.testing.assert_allclose(numbers(pooled(formulas(x), kind, args)), known.numpy(), rtol=1e-12)
    flat = flattened(formulas(x), {"start_dim": 1})
    np.testing.assert_array_equal(numbers(flat), x.reshape(2, 20))
    weight, bias = RNG.normal(size=(3, 20)), RNG.normal(size=3)
    found = numbers(linear(flat, formulas(weight), formulas(bias), plain))
    np.testing.assert_allclose(found, x.reshape(2, 20) @ weight.T + bias, rtol=1e-12)


def test_what_is_not_offered_is_said() -> None:
    x, weight = formulas(np.zeros((2, 3, 3))), formulas(np.zeros((1, 2, 2, 2)))
    with pytest.raises(NotOfferedLayerError, match="groups"):
        convolved(x, weight, None, {"groups": 2}, plain)
    with pytest.raises(NotOfferedLayerError, match="larger than the picture"):
        pooled(x, "MaxPool2d", {"kernel_size": 4})
    with pytest.raises(NotOfferedLayerError, match="no picture"):
        convolved(x[0], weight, None, {}, plain)
    with pytest.raises(NotOfferedLayerError, match="products"):
        linear(formulas(np.zeros(300)), formulas(np.zeros((100, 300))), None, plain)
