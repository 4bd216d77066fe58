"""Comparison of fits: their error measure, the initial guesses of peers, the table and the figure."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import gbspec
from benchmarks import accuracy, plot, startup
from benchmarks.accuracy import Record, network, points, prepared, reached, right_hand_side, table_of
from gbspec.backends.module import load_module
from gbspec.operations.models import reference


def test_the_error_is_of_the_module_s_right_hand_side() -> None:
    instance = load_module(gbspec.load("urp_gb2").model).random(4)
    w, prefix = instance.weights, "network.phi."
    layers = [w[f"{prefix}{i}.{part}"] for i in range(3) for part in ("weight", "bias")]
    scales = [w[prefix + name] for name in ("input_center", "input_scale", "output_center", "output_scale")]
    at, truth = points()
    found = right_hand_side(at, network(layers, scales, at), *w["constants"])
    expected = instance.rhs(0.0, torch.from_numpy(at[:, :2].copy()), torch.from_numpy(at[:, 2:].copy()))
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-12, atol=1e-12)
    record = Record()
    record.take(layers, w["constants"], scales)
    (one,) = record.errors()
    assert (one["B"], one["beta"]) == (5.0, 1.0)
    assert one["error"] > 0.05
    assert one["seconds"] >= 0
    known = load_module(reference(gbspec.load("urp_gb2").model).model)()
    expected = known.rhs(0.0, torch.from_numpy(at[:, :2].copy()), torch.from_numpy(at[:, 2:].copy()))
    np.testing.assert_allclose(truth, expected.numpy(), rtol=1e-12, atol=1e-12)


def test_peers_start_from_the_first_measurements() -> None:
    table = accuracy.data(3)
    work = prepared(table)
    for item, start in zip(table.items, work.start, strict=True):
        for channel in range(2):
            seen = item.values[np.isfinite(item.values[:, channel]), channel]
            assert start[channel] == seen[0]
    assert np.all(work.input_scale > 0)


def test_gbspec_s_own_fit_is_followed() -> None:
    record = accuracy.fit_gbspec(accuracy.data(3), method="gradient-matching")
    times = [time for time, *_ in record.taken]
    assert times == sorted(times)
    errors = [one["error"] for one in record.errors()]
    assert errors[-1] < 0.5


def test_peers_fit_within_their_time() -> None:
    pytest.importorskip("torchdiffeq", reason="torchdiffeq is not installed (`pip install .[benchmarks]`)")
    record = accuracy.fit_by_hand("torchdiffeq", accuracy.data(2, span=1.5), 0.0)
    assert len(record.taken) == 10  # the least number of steps
    first, last = record.taken[0], record.taken[-1]
    assert not np.array_equal(first[1][0], last[1][0])
    assert not np.array_equal(first[2], last[2])


CURVE = [
    {"seconds": 1.0, "error": 0.02, "B": 10.0, "beta": 3.0},
    {"seconds": 4.0, "error": 5e-4, "B": 11.0, "beta": 3.3},
]


def test_the_first_time_counts() -> None:
    assert reached(CURVE, 3e-2) == 1.0
    assert reached(CURVE, 1e-3) == 4.0
    assert reached(CURVE, 1e-4) is None
    last = table_of({"gbspec": CURVE}).splitlines()[-1]
    assert last == "| **gbspec train** | 1 s | 4 s | 4 s | 4 s | – | – | 5.0e-04 | 1.0e-01 | 4 s |"


def test_a_figure_has_a_panel_for_each_result(tmp_path: Path) -> None:
    timing = {"ms": 2.0, "low_ms": 1.0, "high_ms": 3.0, "rounds": 3}
    contents = {
        "step": {
            "timings": {"torch float32": timing, "graph float64": timing},
            "limit_ms": {"float32": 1.0, "float64": 2.0},
        },
        "growth": {
            "axes": {"trajectories": [{"size": {"trajectories": n}, "timings": {"torch": timing}} for n in (2, 20)]}
        },
        "accuracy": {"curves": {"gbspec": CURVE}},
    }
    for count, (name, content) in enumerate(contents.items(), start=1):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
        assert len(plot.figure(tmp_path).axes) == count
    plot.figure(tmp_path).savefig(tmp_path / "made.png")
    assert (tmp_path / "made.png").read_bytes().startswith(b"\x89PNG")


def test_the_readme_is_replaced_between_its_marks(tmp_path: Path) -> None:
    readme = (plot.ROOT / "README.md").read_text()
    made = plot.fill(readme, "here")
    assert f"{plot.BEGIN}\nhere\n{plot.END}" in made
    assert plot.fill(made, "here") == made
    with pytest.raises(ValueError, match="there is no"):
        plot.fill("a text", "here")
    (tmp_path / "accuracy.json").write_text(json.dumps({"curves": {"gbspec": CURVE, "diffrax": CURVE[:1]}}))
    text = plot.summary(tmp_path, "made.png")
    assert "gbspec train: 4 s" in text and "not reached within 1 s (final error 2.0e-02)" in text
    assert text.endswith("(made.png)")


def test_start_up_table_has_all_times(tmp_path: Path) -> None:
    assert startup.told("print('noise'); print(0.25)") == 0.25
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        startup.told("1 / 0")
    text = startup.table({"timings": {"a": {"ms": 1500.0, "low_ms": 1400.0, "high_ms": 1600.0, "cpu_ms": 1300.0}}})
    assert text.endswith("| a | 1.50 s | 1.40–1.60 | 1.30 s |")
    assert all("python" not in command[0] for command in startup.commands(str(tmp_path)).values())
