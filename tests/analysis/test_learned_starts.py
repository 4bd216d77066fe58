"""What a fit begins the trajectories of its training with: as a table, and in the generated module."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec

SPRING = """
model spring
time t
condition pull in [0, 4]
state x in [-2, 2]
state v in [-2, 2]
state heat in [0, 9]
learn w = 1.5 in [0.2, 4]
learn d = 0.1 in [0, 1] per trajectory
x' = v
v' = -w^2*x - d*v
heat' = d*v^2
initial heat = 0.1*pull
observe x
"""


@pytest.mark.usefixtures("quick_fits")
def test_solutions_of_the_module_from_learned_starts_are_those_of_the_fit(tmp_path: Path) -> None:
    (tmp_path / "spring.gb").write_text(SPRING)
    t = np.arange(0, 6, 0.25)
    shift = {"bent": 0.3, "free": 1.2}
    rows = {
        "trajectory": np.repeat(list(shift), len(t)),
        "t": np.tile(t, 2),
        "pull": np.repeat([2.0, 3.0], len(t)),
        "x": np.concatenate([np.exp(-0.05 * t) * np.cos(1.3 * t + one) for one in shift.values()]),
    }
    run = gbspec.load(tmp_path / "spring.gb").train(rows, tmp_path / "run", effort="low")
    starts = run.learned_starts(rows)
    assert starts.columns == ["trajectory", "time", "x", "v", "heat", "d"]
    assert starts["trajectory"].to_list() == list(shift)
    assert starts["heat"].to_list() == pytest.approx([0.2, 0.3])
    assert starts["v"].to_list() == pytest.approx([-1.3 * np.sin(one) for one in shift.values()], abs=0.15)
    predicted = run.predict(rows).to_frame()
    model = run.member()
    assert model.info["labels"] == list(shift)
    for i, row in enumerate(starts.iter_rows(named=True)):
        given = {"condition": {"pull": [2.0, 3.0][i]}, "constants": {"d": row["d"]}, "tolerance": 1e-8}
        solved = model.simulate([row[name] for name in model.states], times=t, **given)
        by_hand = model.initial(model.weights["initial"][i], condition=given["condition"])
        again = model.simulate(by_hand, times=t, **given)
        expected = predicted.filter(predicted["trajectory"] == row["trajectory"])["x"].to_numpy()
        assert solved[:, 0].numpy() == pytest.approx(expected, abs=1e-5)
        assert again.numpy() == pytest.approx(solved.numpy(), abs=1e-9)
    with pytest.raises(gbspec.UserError, match="GB859"):
        run.learned_starts({**rows, "x": rows["x"] + 1})
