"""Doses as tables give them: infusions, repetitions, steady states."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.data import from_arrays, to_arrays
from gbspec.data.fingerprints import fingerprint
from gbspec.data.table import read_frame
from gbspec.data.trajectories import RunIn, Trajectory
from gbspec.diagnostics import Findings, UserError
from gbspec.ir.model import Condition, Model, symbol
from tests.data.hand_models import drip

Cells = list[float | None]


def read(model: Model, **columns: Cells) -> Trajectory:
    rows = len(columns["t"])
    full = {"x": [None] * (rows - 1) + [1.0]} | columns
    (item,) = read_frame(full, model, Findings()).items
    return item


def test_an_infusion_is_its_rate_between_its_ends() -> None:
    item = read(drip(), t=[0, 1, 2, 9], dose_x=[10, None, 6, None], dur_x=[4, None, None, None])
    (rate,), (at_once,) = item.inputs, item.doses
    assert rate.times.tolist() == [0, 4] and rate.values.tolist() == [2.5, 0]
    assert at_once.times.tolist() == [2] and at_once.amounts.tolist() == [6]  # `over 0`: at once


def test_rates_of_overlapping_infusions_add_and_end_at_zero() -> None:
    third = 1 / 3
    item = read(drip(), t=[0, 0.1, 0.2, 9], dose_x=[third, 0.7, 0.1, None], rate_x=[0.1, 0.3, 0.7, None])
    (rate,) = item.inputs
    assert rate.values[-1] == 0.0
    assert np.sum(rate.values[:-1] * np.diff(rate.times)) == pytest.approx(third + 0.8, rel=1e-12)


def test_an_end_within_rounding_of_a_row_is_at_that_row() -> None:
    assert 0.1 + 0.2 != 0.3
    item = read(drip(), t=[0, 0.1, 0.3, 9], dose_x=[None, 1, 1, None], dur_x=[None, 0.2, 1, None])
    assert item.inputs[0].times.tolist() == [0, 0.1, 0.3, 1.3]


def test_the_model_says_how_long_doses_last_of_which_the_table_does_not() -> None:
    model = drip(duration=symbol("D"), conditions=(Condition("D"),), lag=symbol("D") / 4)
    item = read(model, t=[0, 3, 5, 9], D=[2, 2, 2, 2], dose_x=[10, 4, 8, None], dur_x=[None, 0, 1, None])
    assert item.inputs[0].times.tolist() == [0, 0.5, 2.5, 5.5, 6.5]
    assert item.inputs[0].values.tolist() == [0, 5, 0, 8, 0]
    assert item.doses[0].times.tolist() == [3]


def test_repetitions_follow_at_their_interval() -> None:
    item = read(drip(None), t=[0, 5, 90], dose_x=[10, 4, None], ii_x=[12, 2, None], addl_x=[2, 1, None])
    assert item.doses[0].times.tolist() == [0, 5, 7, 12, 24]
    assert item.doses[0].amounts.tolist() == [10, 4, 4, 10, 10]


def test_a_dose_in_a_steady_state_is_preceded_by_its_regimen() -> None:
    item = read(drip(None), t=[3, 90], dose_x=[10, None], ii_x=[12, None], ss_x=[4, None], addl_x=[1, None])
    assert item.run_in == RunIn(12, 4) and item.start == 3 - 48 and item.begins == 3
    assert item.doses[0].times.tolist() == [-45, -33, -21, -9, 3, 15]
    assert read(drip(None), t=[0, 9], dose_x=[1, None], ii_x=[2, None], ss_x=[1, None]).run_in == RunIn(2, 100)


def test_what_leads_to_a_steady_state_is_kept_with_the_data() -> None:
    data = read_frame(
        {"t": [0, 2], "x": [None, 1], "dose_x": [10, None], "ii_x": [12, None], "ss_x": [4, None], "dur_x": [1, None]},
        drip(), Findings(),
    )  # fmt: skip
    arrays, texts = to_arrays(data)
    again = from_arrays(arrays, texts["labels"], texts["channels"], 1, 1)  # type: ignore[arg-type]  # lists of texts
    assert again.items[0].run_in == RunIn(12, 4) and fingerprint(again.items[0]) == fingerprint(data.items[0])


def test_a_table_of_infusions_is_written_as_their_rate_and_read_again() -> None:
    data = read_frame({"t": [0, 2, 9], "x": [None, 1, 2], "dose_x": [10, 2, None], "dur_x": [3, 0, None]}, drip(),
                      Findings())  # fmt: skip
    frame = data.to_frame()
    assert frame["infusion_x"].drop_nulls().to_list() == [10 / 3, 0]
    again = read_frame(frame, drip(), Findings())
    assert fingerprint(again.items[0]) == fingerprint(data.items[0])


def test_columns_that_a_model_declares_keep_their_meaning() -> None:
    model = drip(None, conditions=(Condition("rate_x"),))
    item = read(model, t=[0, 9], rate_x=[5, 5], dose_x=[10, None])
    assert item.condition.tolist() == [5] and item.doses[0].amounts.tolist() == [10]


def test_a_rate_of_infusion_stands_in_place_of_doses() -> None:
    model = drip()
    item = read(model, t=[0, 1, 4, 9], infusion_x=[2.5, None, 0, None])
    (rate,), (at_once,) = item.inputs, item.doses
    assert rate.times.tolist() == [0, 4] and rate.values.tolist() == [2.5, 0]
    assert not len(at_once.times)
    long = {"t": [0, 4, 9], "name": ["infusion_x", "infusion_x", "x"], "value": [2.5, 0.0, 1.0]}
    (item,) = read_frame(long, model, Findings()).items
    assert item.inputs[0].values.tolist() == [2.5, 0]


def test_without_either_column_both_are_named() -> None:
    findings = Findings()
    with pytest.raises(UserError) as raised:
        read_frame({"t": [0, 1], "x": [1.0, 2.0]}, drip(), findings)
    (error,) = raised.value.diagnostics
    assert error.code == "GB710" and "`dose_x`" in error.message
    assert "`infusion_x`" in str(error.notes)


def test_a_rate_of_infusion_of_doses_at_once_says_what_declares_it() -> None:
    model = drip(duration=None)
    for table in (
        {"t": [0, 1], "x": [None, 1.0], "dose_x": [1.0, None], "infusion_x": [2.0, 0.0]},
        {"t": [0, 0, 1], "name": ["dose_x", "infusion_x", "x"], "value": [1.0, 2.0, 1.0]},
    ):
        findings = Findings()
        read_frame(table, model, findings)
        (warning,) = findings
        assert warning.code == "GB711" and "`dose x over 0`" in warning.help
