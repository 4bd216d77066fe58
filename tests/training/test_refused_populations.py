"""Fits of populations that are refused before anything is learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.operations import tables
from gbspec.training import TrainOptions, train, unbegun
from tests.training.test_populations import LEVEL, levels, model_of, table


def test_an_unknown_start_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.recipe.context.fit_curves", lambda *_: pytest.fail("the data were prepared"))
    model = model_of(LEVEL.replace("initial x = m\n", "state z\nz' = m\n"), tmp_path)
    data = tables.read_data(table(tmp_path, np.ones((2, 3)), np.arange(3.0)), model, Findings())
    with pytest.raises(UserError) as caught:
        train(model, data, TrainOptions(backend="torch"), tmp_path / "run")
    assert [found.code for found in caught.value.diagnostics] == ["GB776"]
    assert not (tmp_path / "run").exists()  # so that the corrected call is not refused


def test_what_is_refused_before_anything_is_learned_leaves_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise UserError([Diagnostic("GB863", "there is no kernel", None)])

    monkeypatch.setattr("gbspec.training.runs.fit.fit_jobs", refused)
    model, data, _ = levels(tmp_path)
    with pytest.raises(UserError):
        train(model, data, TrainOptions(backend="torch"), tmp_path / "run")
    assert unbegun(tmp_path / "run")  # so that the corrected call is not refused
