"""Stages of the automatic recipe by name: each alone, several in order, and names that are none."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.backends.module import load_module
from gbspec.diagnostics import UserError
from gbspec.runs import open_run
from gbspec.training import TrainOptions, Update, train
from gbspec.training.options import STAGES
from gbspec.training.recipe import planning
from gbspec.training.recipe.preparation import prepare
from tests.training.conftest import URP, Recorder, model_of, urp_data

pytestmark = pytest.mark.usefixtures("quick_fits")

SMALL = URP.replace("mlp(12, 12)", "mlp(6)")
KNOWN = URP.replace("unknown phi(x1, x2, Da) by mlp(12, 12)", "let phi = Da*(1 - x1)*exp(x2)")


@pytest.mark.parametrize("stage", ["imputed forcing", "half step", "whole solutions", "blend", "autoregressive"])
def test_a_stage_alone_runs_where_the_data_do_not_ask_for_it(stage: str, tmp_path: Path) -> None:
    recorder = Recorder()
    options = TrainOptions(stages=stage.replace(" ", "-"), epochs=5, max_step=0.1, workers=1)
    run = train(model_of(SMALL), urp_data(3, 1.4, 6), options, tmp_path / "run", recorder)
    losses = [update.loss for update in recorder.updates if update.stage == stage]
    assert {update.stage for update in recorder.updates} == {"warm start", stage}
    assert losses[-1] < losses[0]
    assert run.member().info["max_step"] == (0.05 if stage == "half step" else 0.1)


def test_a_run_that_was_stopped_has_the_step_that_it_was_fitting_with(tmp_path: Path) -> None:
    options = TrainOptions(stages="half step; autoregressive", epochs=5, max_step=0.1, workers=1)
    with pytest.raises(KeyboardInterrupt):
        train(model_of(SMALL), urp_data(3, 1.4, 6), options, tmp_path / "half", Recorder(interrupt_after=3))
    assert open_run(tmp_path / "half").member().info["max_step"] == 0.05

    class Later(Recorder):
        def update(self, update: Update) -> None:
            self.interrupt_after = len(self.updates) + 1 if update.stage == "autoregressive" else None
            super().update(update)

    with pytest.raises(KeyboardInterrupt):
        train(model_of(SMALL), urp_data(3, 1.4, 6), options, tmp_path / "whole", Later())
    assert open_run(tmp_path / "whole").member().info["max_step"] == 0.1


def test_named_stages_run_in_the_order_of_the_recipe_and_resume(tmp_path: Path) -> None:
    names = "Choice; autoregressive; teacher-forcing"
    options = {"stages": names, "effort": "low", "workers": 1}
    model, data, recorder = model_of(SMALL), urp_data(3, 1.4, 6), Recorder()
    whole = train(model, data, TrainOptions(**options), tmp_path / "whole", recorder)  # type: ignore[arg-type]
    order = list(dict.fromkeys(update.stage for update in recorder.updates))
    assert order == ["warm start", "teacher forcing", "autoregressive", "choice"]
    with pytest.raises(KeyboardInterrupt):
        train(model, data, TrainOptions(**options), tmp_path / "cut", Recorder(interrupt_after=9))  # type: ignore[arg-type]
    resumed = train(model, data, TrainOptions(**options, resume=True), tmp_path / "cut")  # type: ignore[arg-type]
    assert [r["loss"] for r in resumed.history()] == [r["loss"] for r in whole.history()]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"stages": "teacher forcing; teasing"}, "`--stages teasing` must be one of `adam`"),
        ({"stages": " ; "}, "`--stages  ; ` must be one of `adam`"),
        ({"stages": "blend", "method": "lm"}, "`--method lm` must be `auto` where stages are named"),
        ({"stages": "search"}, "with this model, data and options there is no stage `search`, only `adam`, `imputed"),
        ({"stages": "half step", "effort": "low"}, "there is no stage `half step`"),
    ],
)
def test_stages_that_are_none_are_told(options: dict[str, str], expected: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        train(model_of(SMALL), urp_data(3, 1.4, 6), TrainOptions(**options, workers=1), tmp_path / "run")  # type: ignore[arg-type]
    assert expected in str(caught.value)
    assert [finding.code for finding in caught.value.diagnostics] == ["GB850"]


def test_a_named_stage_that_had_nothing_to_do_is_told(tmp_path: Path) -> None:
    run = train(model_of(SMALL), urp_data(3, 1.4, 6), TrainOptions(stages="choice", workers=1), tmp_path / "run")
    assert "member 0: the stage `choice` was requested, but had nothing to do" in run.fit.warnings


def test_names_are_kept_as_the_recipe_has_them() -> None:
    options = TrainOptions(stages="Least-squares starts too;half_step; half  step")
    assert options.named_stages == ("least squares, starts too", "half step", "half step")
    assert TrainOptions(stages="half-step").to_json() == TrainOptions(stages=" Half step;").to_json()


def test_every_stage_that_is_planned_can_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def population(text: str) -> str:
        distributed = text.replace("in [0, 10]", "in [0.1, 10] per trajectory ~ lognormal")
        return f"{distributed}initial x1 = 0.1\ninitial x2 = 0.1\n"

    def names(text: str, **options: str) -> set[str]:
        model, data = model_of(text), urp_data(2, 12.0, 6)
        ready = prepare(model, load_module(model), data, TrainOptions(**options), 0)  # type: ignore[arg-type]
        return {stage.name for stage in planning.plan(ready.context, ready.parameters)}

    found = names(URP, initial="bred") | names(URP, effort="high") | names(URP, forcing="0.5") | names(KNOWN)
    found |= names(population(KNOWN)) | names(population(URP))
    found |= names(f"{KNOWN}diffusion x1 = 0.1\n")
    monkeypatch.setattr(planning, "PASSES", 1)
    found |= names(URP)
    assert found == set(STAGES)
