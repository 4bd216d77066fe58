"""Every fit is checked for leaning on its step, and says so where it does: steps as long as a fast decay takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec import driver
from gbspec.analysis.validate import validate
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings
from gbspec.runs import open_run
from gbspec.training import TrainOptions
from gbspec.training.variations import Point
from tests.training.conftest import model_of

DECAY = """model decay
state x in [0, 2] = 1
unknown lost(x) by mlp(6)
x' = -lost
observe x
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Trajectories:
    path = tmp_path_factory.mktemp("decay") / "decay.csv"
    rows = [(k, t, float((1 + 0.1 * k) * np.exp(-2.4 * t))) for k in range(8) for t in (0.0, 1.0, 2.0, 3.0)]
    path.write_text("trajectory,t,x\n" + "".join(f"{k},{t},{x!r}\n" for k, t, x in rows))
    return driver.read_data(str(path), model_of(DECAY), Findings())


def options(step: float) -> TrainOptions:
    return TrainOptions(max_step=step, members=2, workers=1, method="lm", epochs=20, warm_start=False)


def test_a_fit_that_leans_on_its_step_says_so(data: Trajectories, tmp_path: Path) -> None:
    run = driver.train(model_of(DECAY), data, tmp_path / "run", options(1.0))
    assert [check["half_step"] > 0.01 for check in run.fit["step_checks"]] == [True, True]
    assert [check["trajectories"] for check in run.fit["step_checks"]] == [8, 8]
    told = [warning for warning in run.fit["warnings"] if "leans on its training step of 1" in warning]
    assert [warning.partition(":")[0] for warning in told] == ["member 0", "member 1"]
    assert all("Train with a smaller `--max-step`" in warning for warning in told)
    assert open_run(tmp_path / "run").fit == run.fit
    found = validate(run, data, truth=False)
    assert found.step_check.half_step == pytest.approx(run.fit["step_checks"][0]["half_step"])
    assert found.warnings_after(run.fit) == run.fit["warnings"]  # the report says it once


def test_a_fit_that_holds_at_any_step_has_its_check_and_no_warning(data: Trajectories, tmp_path: Path) -> None:
    run = driver.train(model_of(DECAY), data, tmp_path / "run", options(0.1))
    assert all(0 <= check[name] < 0.01 for check in run.fit["step_checks"] for name in ("half_step", "adaptive"))
    assert not any("leans" in warning for warning in run.fit["warnings"])


def test_each_run_of_a_sweep_is_checked(data: Trajectories, tmp_path: Path) -> None:
    said: list[str] = []

    class Heard:
        def update(self, update: object) -> None: ...

        def message(self, text: str) -> None:
            said.append(text)

    points = [Point("long", {}, options(1.0)), Point("short", {}, options(0.1))]
    driver.sweep(model_of(DECAY), data, points, tmp_path, TrainOptions(workers=1), Heard())
    assert len(open_run(tmp_path / "short").fit["step_checks"]) == 2
    assert [text.partition(":")[0] for text in said if "leans" in text] == ["long", "long"]
