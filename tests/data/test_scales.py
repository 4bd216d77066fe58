"""Scales and weights of residuals by hand: stated noise, standard deviations in the table, shared units, averages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.data.scales import scales_of
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.ir.model import Model
from tests.training.conftest import model_of

TEXT = """model three
state x in [0, 5]
x' = -x{term}
observe a = x{0}
observe b = 2*x{1}
observe c = 3*x{2}
"""
VALUES = np.array([[1.0, 2.0, np.nan], [3.0, 6.0, 10.0], [5.0, np.nan, 30.0]])


def three(*noise: str, complete: bool = False) -> Model:
    text = TEXT if complete else TEXT.replace("x' =", "unknown f(x) by mlp(2)\nx' =")
    return model_of(text.format(*(noise or ("", "", "")), term="" if complete else " + f"))


def table(sd: Array | None = None, counts: Array | None = None) -> Trajectories:
    sd = np.full(VALUES.shape, np.nan) if sd is None else sd
    counts = np.isfinite(VALUES).astype(float) if counts is None else counts
    item = Trajectory("1", 0.0, np.arange(3.0), VALUES, counts, sd, np.zeros(0))
    return Trajectories((item,), ("a", "b", "c"))


def spread() -> Array:
    return np.array([np.nanstd(VALUES[:, 0]), np.nanstd(VALUES[:, 1]), np.nanstd(VALUES[:, 2])])


def test_without_noise_it_is_the_standard_deviation() -> None:
    scales = scales_of(three(), table())
    assert scales.channel == pytest.approx(spread()) and scales.deviation == pytest.approx(spread())
    assert (scales.level, scales.noise, scales.log.any()) == (1.0, None, False)


def test_stated_noise_is_over_the_common_level() -> None:
    scales = scales_of(three(" noise normal(0.1)", " noise normal(4)", ""), table())
    level = (0.1 / spread()[0] + 4 / spread()[1]) / 2
    assert scales.channel == pytest.approx([0.1 / level, 4 / level, spread()[2]])
    assert scales.noise is None, "one channel does not state its noise"
    known = scales_of(three(" noise normal(0.1)", " noise normal(4)", " noise lognormal(0.5)"), table())
    logs = np.log(VALUES[1:, 2]).std()
    stated = np.array([0.1, 4.0, np.sqrt(np.log(1.25))])
    level = float(np.mean(stated / [*spread()[:2], logs]))
    assert known.channel == pytest.approx(stated / level) and known.noise == pytest.approx(level)
    assert known.log.tolist() == [False, False, True]


def test_an_entry_with_its_own_standard_deviation_has_its_own_scale() -> None:
    sd = np.full(VALUES.shape, np.nan)
    sd[:, 0] = [0.5, 0.2, np.nan]
    data = table(sd)
    scales = scales_of(three(), data)
    level = 0.35 / spread()[0]
    assert scales.channel == pytest.approx([0.35 / level, *spread()[1:]])
    assert scales.of_rows(sd, VALUES, np.ones(VALUES.shape))[:, 0] == pytest.approx(
        [0.5 / level, 0.2 / level, 0.35 / level]
    )
    assert scales.of_rows(sd, VALUES, np.ones(VALUES.shape))[:, 1:] == pytest.approx(np.tile(spread()[1:], (3, 1)))


def test_an_average_with_its_own_standard_deviation_counts_as_its_measurements_do() -> None:
    """Of four values with 0.2 each the average has 0.1: it counts as four values, not as sixteen."""
    sd, counts = np.full(VALUES.shape, np.nan), np.ones(VALUES.shape)
    sd[:, 0], counts[0, 0] = [0.1, 0.2, 0.2], 4
    data = table(sd)
    (item,) = data.items
    factor = scales_of(three(), data).factor(replace(item, counts=counts))[:, 0]
    assert factor[0] / factor[1] == pytest.approx(2.0)


def test_a_standard_deviation_is_in_the_unit_of_its_value_also_where_logarithms_are_fitted() -> None:
    sd = np.full(VALUES.shape, np.nan)
    sd[1:, 2] = [1.0, 6.0]
    values = VALUES.copy()
    scales = scales_of(three("", "", " noise lognormal(0.5)"), table(sd))
    found = scales.of_rows(sd, values, np.ones(values.shape))
    assert found[1:, 2] * scales.level == pytest.approx([1.0 / 10.0, 6.0 / 30.0])
    assert found[0, 2] == scales.channel[2], "no standard deviation of its own"
    values[1, 2] = 0.0
    assert scales.of_rows(sd, values, np.ones(values.shape))[1, 2] == scales.channel[2], "zero has no logarithm"


def test_channels_of_a_unit_share_a_scale_where_all_functions_are_known() -> None:
    def in_grams(*noise: str) -> Model:
        states = "time t : s\nstate x : g in [0, 5]\nconst k : 1/s = 1\nx' = -k*x"
        text = TEXT.replace("state x in [0, 5]\nx' = -x{term}", states).replace("*x{", "*x : g{")
        return model_of(text.format(*(noise or ("", "", ""))))

    scales = scales_of(in_grams(), table())
    assert scales.channel == pytest.approx([np.sqrt(np.mean(spread() ** 2))] * 3)
    noisy = scales_of(in_grams("", " noise normal(1)", ""), table())
    shared = np.sqrt((spread()[0] ** 2 + spread()[2] ** 2) / 2)
    assert noisy.channel == pytest.approx([shared, spread()[1], shared])


def test_channels_without_units_have_scales_of_their_own() -> None:
    assert scales_of(three(complete=True), table()).channel == pytest.approx(spread())


def test_the_weight_is_the_square_root_of_the_number_averaged() -> None:
    counts = np.array([[1.0, 4.0, 0.0], [9.0, 1.0, 2.0], [1.0, 0.0, 16.0]])
    data = table(counts=counts)
    found = scales_of(three(), data).factor(data.items[0])
    assert found == pytest.approx(np.sqrt(counts) / spread())
    assert (found == 0).tolist() == np.isnan(VALUES).tolist()
