"""`--backend`: which of the kernel and the torch graph serves, and that they come to the same fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.diagnostics import UserError
from gbspec.training import Silent, TrainOptions, train
from gbspec.training.engines.native.kernel import Kernel
from tests.training.conftest import URP, model_of, urp_data


class Heard(Silent):
    def __init__(self) -> None:
        self.messages: list[str] = []

    def message(self, text: str) -> None:
        self.messages.append(text)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(source: str) -> Any:
        raise CompilerError("there is no C compiler (cc, gcc, clang)")

    monkeypatch.setattr("gbspec.backends.native.library.compiled", missing)
    monkeypatch.setattr("gbspec.training.engines.native.kernel._kernels", {})


QUICK: dict[str, Any] = {
    "method": "adam",
    "epochs": 2,
    "effort": "low",
    "max_step": 0.2,
    "workers": 1,
    "warm_start": False,
}


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_the_graph_serves_and_a_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, data, heard = model_of(URP), urp_data(3, 1.0, 1), Heard()
    with pytest.raises(UserError, match=r"GB863.*no C compiler"):
        train(model, data, TrainOptions(backend="native", **QUICK), tmp_path / "native")
    monkeypatch.setattr("gbspec.training.engines.choice.LEAST_SUBSTEPS", 1)
    train(model, data, TrainOptions(**QUICK), tmp_path / "auto", heard)
    assert heard.messages[1:] == ["the torch graph is used: there is no C compiler (cc, gcc, clang)"]


def test_what_the_kernel_does_not_cover_is_left_to_the_graph_and_a_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    why = "the native kernel does not cover this model: the network `phi` has too many layers or arguments"
    model, heard = model_of(URP.replace("mlp(12, 12)", f"mlp({', '.join(['4'] * 15)})")), Heard()
    data = urp_data(3, 1.0, 1)
    with pytest.raises(UserError, match=f"GB863.*is not available: {why}"):
        train(model, data, TrainOptions(backend="native", **QUICK), tmp_path / "native")
    monkeypatch.setattr("gbspec.training.engines.choice.LEAST_SUBSTEPS", 1)
    train(model, data, TrainOptions(**QUICK), tmp_path / "auto", heard)
    assert heard.messages[1:] == [f"the torch graph is used: {why}"]


def test_a_gpu_is_no_place_for_the_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.engines.choice.device_of", lambda wanted: "cuda")
    with pytest.raises(UserError, match=r"GB863.*does not work on a GPU"):
        train(model_of(URP), urp_data(3, 1.0, 1), TrainOptions(backend="native", **QUICK), tmp_path / "run")


@pytest.mark.parametrize("method", ["adam", "lbfgs", "lm"])
def test_both_come_to_the_same_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    try:
        find_compiler()
    except CompilerError as error:
        pytest.skip(str(error))
    swept: list[bool] = []
    whole = Kernel.sweep
    monkeypatch.setattr(Kernel, "sweep", lambda *a, **k: swept.append(a[3]) or whole(*a, **k))  # type: ignore[func-returns-value]
    # What is asked of constants after the fit refits them by gradients, whatever the method.
    monkeypatch.setattr("gbspec.training.runs.deviance.Deviance.of", classmethod(lambda *a, **k: None))
    model, data, options = model_of(URP), urp_data(3, 1.0, 1), QUICK | {"method": method}
    fits = [
        train(model, data, TrainOptions(backend=backend, **options), tmp_path / backend)  # type: ignore[arg-type]
        for backend in ("native", "torch")
    ]
    assert len(swept) > 2
    assert any(swept) == (method != "lm")
    losses = [fit.fit.members[0].loss for fit in fits]
    # Adam's first steps divide gradients by their own size, so that entries near zero move by their rounding.
    assert losses[0] == pytest.approx(losses[1], rel=1e-5 if method == "adam" else 1e-6)
