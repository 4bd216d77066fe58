"""Values of kinds that the Python interface does not take are named, and numbers of any kind are taken."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
import sympy
import torch

import gbspec
from gbspec.diagnostics import Findings
from gbspec.given import is_real, plain
from gbspec.studies import CrossOptions, StudyOptions
from gbspec.training import TrainOptions


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"trajectories": 1.5}, "GB754: `trajectories` is 1.5, and must be a whole number"),
        ({"trajectories": "3"}, "GB754: `trajectories` is '3', and must be a whole number"),
        ({"span": "3"}, "GB754: `span` is '3', and must be a number"),
        ({"noise": None}, "GB754: `noise` is None, and must be a number"),
        ({"initial": {"x": "a"}}, "GB754: `initial` is {'x': 'a'}, and must be ranges by name"),
        ({"condition": "T"}, "GB754: `condition` is 'T', and must be ranges by name"),
        ({"values": {"k": "a"}}, "GB804: the value 'a' for `k` is not a finite number"),
        ({"values": {"k": float("nan")}}, "GB804: the value nan for `k` is not a finite number"),
        ({"values": {"k": np.array([3.0])}}, "GB804: the value array([3.]) for `k` is not a finite number"),
        ({"values": {"k": np.array("3")}}, "is not a finite number"),
        ({"values": {"k": 1j}}, "GB804: the value 1j for `k` is not a finite number"),
        ({"dose": 3}, "GB754: `dose` is 3, and must be doses by name"),
        ({"dose": {"x": 3}}, "GB754: `dose` is {'x': 3}, and must be doses by name"),
        ({"reject": 3}, "GB754: `reject` is 3, and must be conditions"),
        ({"reject": "x > 4"}, "GB754: `reject` is 'x > 4', and must be conditions"),
        ({"clock": 3}, "GB754: `clock` is 3, and must be intervals by name"),
    ],
)
def test_options_of_another_type_are_named(model: gbspec.Specification, options: dict[str, Any], said: str) -> None:
    with pytest.raises(gbspec.UserError, match=re.escape(said)):
        model.simulate(**options)


def test_numbers_of_numpy_are_options(model: gbspec.Specification) -> None:
    made = model.simulate(trajectories=np.int64(2), span=np.float32(1.0), dt=0.5, initial={"x": np.array([1, 2])})  # type: ignore[arg-type,dict-item]
    assert len(made) == 2


@pytest.mark.parametrize("number", [np.array(0.5), np.float32(0.5), Decimal("0.5"), sympy.Rational(1, 2)])
def test_what_is_one_number_is_a_value(model: gbspec.Specification, number: Any) -> None:
    options: dict[str, Any] = {"trajectories": 1, "span": 2 * number, "dt": number, "noise": number / 10}
    made = model.simulate(values={"k": number}, initial={"x": (number, number)}, **options)
    same = model.simulate(values={"k": 0.5}, initial={"x": (0.5, 0.5)}, trajectories=1, span=1, dt=0.5, noise=0.05)
    np.testing.assert_allclose(made.items[0].values, same.items[0].values, rtol=1e-6)
    findings = Findings()
    options = {"max_step": number, "holdout": number, "ridge": number, "tolerance": number}
    TrainOptions(solver="dopri5", **options).check(findings)
    assert not findings.errors


def test_tensors_of_one_number_are_numbers() -> None:
    numbers = [torch.tensor(3.0), torch.tensor(3), torch.tensor(3.0, requires_grad=True)]
    assert all(is_real(number) and plain(number) == 3 for number in numbers)
    others = [torch.tensor([3.0]), torch.tensor(3j), np.array(3j), np.array("3"), "3", b"3", sympy.Symbol("x"), None]
    assert not any(map(is_real, others))


@pytest.mark.parametrize("values", ["k=3", 3, np.float64(3), {3: 1.0}, [("k", 3.0)]])
def test_values_that_are_not_by_name_are_named(model: gbspec.Specification, values: Any) -> None:
    data = model.simulate(trajectories=1)
    with pytest.raises(TypeError, match="values are numbers by name, as in "):
        model.evaluate(data, values=values)
    with pytest.raises(TypeError, match="values are numbers by name, as in "):
        model.simulate(values=values)


@pytest.mark.parametrize(
    "options",
    [{"members": "3"}, {"members": 1.5}, {"members": None}, {"max_step": "a"}, {"stages": 3}],
)
def test_options_of_a_fit_of_another_type_are_named(options: dict[str, Any]) -> None:
    findings = Findings()
    TrainOptions(**options).check(findings)
    assert [error.code for error in findings.errors] == ["GB850"]


def test_what_is_no_path_is_named() -> None:
    with pytest.raises(TypeError, match="a model is given by its path, or a bundled one by its name, not by NoneType"):
        gbspec.load(None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a run is given by the path of its directory, not by int"):
        gbspec.open_run(3)  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [{"window": "3"}, {"folds": "a"}, {"folds": 2.5}, {"window": 1.5}])
def test_options_of_a_cross_validation_are_whole_numbers(options: dict[str, Any]) -> None:
    ((name, value),) = options.items()
    shown = repr(value)
    with pytest.raises(gbspec.UserError, match=rf"`--{name} {shown}` must be a whole number, at least "):
        CrossOptions(**options).check()


@pytest.mark.parametrize("options", [{"members": "3"}, {"workers": 1.5}, {"seed": None}, {"noise": "a"}])
def test_options_of_a_study_are_numbers(options: dict[str, Any]) -> None:
    with pytest.raises(gbspec.UserError, match=r"GB814: .* must be a"):
        StudyOptions(**options).check()


def test_what_is_no_path_to_write_is_named(model: gbspec.Specification) -> None:
    data = model.simulate(trajectories=1)
    with pytest.raises(TypeError, match="written to a directory, which is given by its path, not by NoneType"):
        model.train(data, None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a file to write is given by its path, not by int"):
        model.compile(3)  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="a file to write is given by its path, not by int"):
        model.export(3, "c")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a file to write is given by its path, not by int"):
        model.simulate(3, trajectories=1)  # type: ignore[arg-type]
