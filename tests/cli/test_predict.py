"""predict: new trajectories from their first rows, with all shared parameters fixed."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build, needed

pytestmark = pytest.mark.usefixtures("quick_fits")

Run = Callable[..., Any]

HIDDEN = """\
model hidden "A chain of which the first state is never measured"
state A in [0, 2] = 1
state B in [0, 2] = 0
learn k = 0.3 in [0, 5]
initial A learn
A' = -k*A
B' = k*A - 0.2*B
observe B
truth k = 0.8
"""


def call(*arguments: object) -> Any:
    texts = [str(argument) for argument in arguments]
    return CliRunner().invoke(build(needed(texts)), texts)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run of a model with an unmeasured state, its training table, and a table of new trajectories."""
    folder = tmp_path_factory.mktemp("predict")
    (folder / "hidden.gb").write_text(HIDDEN)
    for name, seed, count in (("old", 1, 4), ("new", 2, 3)):
        made = call("simulate", folder / "hidden.gb", "-o", folder / f"{name}.csv", "--trajectories", count,
                    "--span", 6, "--dt", 0.5, "--seed", seed, "--noise", 0.02, "--keep-start")  # fmt: skip
        assert made.exit_code == 0, made.stderr
    made = call("train", folder / "hidden.gb", folder / "old.csv", "-o", folder / "run", "--effort", "low", "--quiet",
                "--members", 2, "--workers", 1)  # fmt: skip
    assert made.exit_code == 0, made.stderr
    yield folder


def test_the_initial_state_is_estimated_from_the_window_and_the_rest_predicted(place: Path, here: Path) -> None:
    result = call("predict", place / "run", place / "new.csv", "-o", "p.csv", "--window", 5, "--json")
    assert result.exit_code == 0, result.stderr
    made = json.loads(result.stdout)
    assert [one["start"] for one in made["trajectories"]] == ["estimated"] * 3
    assert made["trajectories"][0]["estimated"] == ["A(t0)", "B(t0)"], "the noisy first value of B is data"
    assert made["trajectories"][0]["rows"] == {"training": 0, "window": 5, "predicted": 8}
    assert made["channels"]["B"]["n"] == 24
    assert made["channels"]["B"]["nrmse"] < 0.3
    table = pl.read_csv("p.csv")
    assert table.columns == ["trajectory", "t", "B", "B_low", "B_high", "A", "A_low", "A_high", "used", "outside"]
    assert table["used"].to_list()[:7] == ["window"] * 5 + ["predicted"] * 2
    assert ((table["B_low"] < table["B"]) & (table["B"] < table["B_high"])).all()


def test_rows_after_the_window_have_no_influence(place: Path, here: Path) -> None:
    whole = pl.read_csv(place / "new.csv")
    late = pl.col("t") > whole["t"].unique().sort()[5]
    whole.with_columns(pl.when(late).then(pl.col("B") * 3 + 1).otherwise(pl.col("B")).alias("B")).write_csv("bent.csv")
    for name, data in (("a", place / "new.csv"), ("b", Path("bent.csv"))):
        assert call("predict", place / "run", data, "-o", f"{name}.csv", "--window", 4).exit_code == 0
    a, b = (pl.read_csv(f"{name}.csv") for name in "ab")
    # Not to the last digits: the channel's standard deviation over the table weights residuals against the weak prior
    assert (a["A"] - b["A"]).abs().max() < 1e-3


def test_a_longer_window_narrows_the_interval_of_the_unmeasured_state(place: Path, here: Path) -> None:
    widths = []
    for rows in (1, 8):
        assert call("predict", place / "run", place / "new.csv", "-o", "w.csv", "--window", rows).exit_code == 0
        first = pl.read_csv("w.csv").group_by("trajectory").first()
        widths.append((first["A_high"] - first["A_low"]).mean())
    assert widths[1] < 0.5 * widths[0]


def test_training_trajectories_are_recognised_by_content(place: Path, here: Path) -> None:
    table = pl.read_csv(place / "old.csv").with_columns(
        ("renamed" + pl.col("trajectory").cast(str)).alias("trajectory")
    )
    table.write_csv("renamed.csv")
    made = json.loads(call("predict", place / "run", "renamed.csv", "-o", "p.csv", "--json").stdout)
    assert {one["start"] for one in made["trajectories"]} == {"learned"}
    assert set(pl.read_csv("p.csv")["used"]) == {"training"}
    labels = {one["trajectory"]: one["same_rows_as"] for one in made["trajectories"]}
    assert labels and all(label == f"renamed{other}" for label, other in labels.items())
    for table, same in (("renamed.csv", True), (str(place / "old.csv"), False)):
        said = call("predict", place / "run", table, "-o", "p.csv", "--window", "3").stdout
        assert ("has the same rows as" in said or "have the same rows as" in said) is same
        assert ("`renamed1` as `1`" in said) is same and ("part of the training data" in said) is not same


def test_rows_without_measurements_are_predicted(place: Path, here: Path) -> None:
    Path("plan.csv").write_text("trajectory,t,B\n1,0,0.2\n1,0.5,0.5\n1,1,0.62\n1,50,\n1,100,\n")
    assert call("predict", place / "run", "plan.csv", "-o", "p.csv").exit_code == 0
    last = pl.read_csv("p.csv").row(-1, named=True)
    assert last["t"] == 100
    assert last["used"] == "predicted"
    assert math.isclose(last["B"], 0, abs_tol=1e-5)


def test_a_single_member_without_a_covariance_gives_a_warning_about_its_intervals(place: Path, here: Path) -> None:
    made = call("train", place / "hidden.gb", place / "old.csv", "-o", "one", "--effort", "low", "--quiet")
    assert made.exit_code == 0
    assert "too narrow" not in call("predict", "one", place / "new.csv", "-o", "p.csv").stdout
    Path("one/members/0/covariance.safetensors").unlink()
    assert "too narrow" in call("predict", "one", place / "new.csv", "-o", "p.csv").stdout


def test_the_same_from_python(place: Path, here: Path) -> None:
    import gbspec

    found = gbspec.open_run(place / "run").predict(place / "new.csv", "p.csv", window=5)
    assert found.errors()["B"].n == 24
    assert Path("p.csv").is_file()


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("-o", "p.csv", "--window", "0"), "GB814"),
        (("-o", "p.csv", "--window", "3", "--from-start"), "GB814"),
        (("-o", "p.xlsx"), "GB812"),
        (("-o", "no/p.csv"), "GB805"),
    ],
)
def test_wrong_options(place: Path, here: Path, arguments: tuple[str, ...], code: str) -> None:
    result = call("predict", place / "run", place / "new.csv", *arguments)
    # Inconsistent options are a usage error; a file that cannot be written is an input error
    assert result.exit_code == (2 if code in ("GB812", "GB814") else 1), result.output
    assert code in result.stderr
    assert not list(here.iterdir())


MEASURED = """\
model known "Decay, its start given by the model or measured"
state A in [0, 9] = 1
learn k = 0.3 in [0, 5]
{initial}
A' = -k*A
observe A
truth k = 0.8
"""


@pytest.mark.parametrize(("initial", "estimated"), [("", True), ("initial A = 1", False)])
def test_a_window_estimates_a_measured_start_or_says_that_it_has_no_effect(
    here: Path, initial: str, estimated: bool
) -> None:
    Path("m.gb").write_text(MEASURED.format(initial=initial))
    rows = [(i, t / 2, (1 if initial else i + 1) * math.exp(-0.4 * t)) for i in range(4) for t in range(8)]
    noisy = [(i, t, x + 0.02 * (-1) ** n) for n, (i, t, x) in enumerate(rows)]
    Path("old.csv").write_text("trajectory,t,A\n" + "".join(f"{i},{t},{x}\n" for i, t, x in noisy[:24]))
    first = [(i, t, x + (0.5 if t == 0 else 0.0)) for i, t, x in noisy[24:]]
    Path("new.csv").write_text("trajectory,t,A\n" + "".join(f"{i},{t},{x}\n" for i, t, x in first))
    assert call("train", "m.gb", "old.csv", "-o", "run", "--effort", "low", "--quiet").exit_code == 0
    made = {}
    for window in ("--from-start", "--window=6"):
        result = call("predict", "run", "new.csv", "-o", "p.csv", window, "--json")
        assert result.exit_code == 0, result.stderr
        made[window] = json.loads(result.stdout)
    no_effect = any("the window has no effect on 1 trajectory (`3`)" in one for one in made["--window=6"]["warnings"])
    assert no_effect is not estimated
    if estimated:
        assert [one["trajectories"][0]["start"] for one in made.values()] == ["known", "estimated"]
        starts = [one["trajectories"][0]["initial"]["A"] for one in made.values()]
        assert starts[0] == pytest.approx(4.52)
        assert abs(starts[1] - 4.0) < 0.35, "one noisy value is not believed"


def test_training_trajectories_are_recognised_among_rows_with_inputs_only(here: Path) -> None:
    Path("m.gb").write_text(
        "model m\nstate x in [0, 9]\ninput F held\nlearn k = 0.3 in [0, 5]\nx' = F - k*x\nobserve x\n"
    )
    rows = [(t / 4, math.exp(-t / 8) if t % 3 == 2 else None, t % 2) for t in range(16)]
    lines = [f"{t},{'' if x is None else x},{F}\n" for t, x, F in rows]
    Path("d.csv").write_text("t,x,F\n" + "".join(lines))
    assert call("train", "m.gb", "d.csv", "-o", "run", "--effort", "low", "--quiet").exit_code == 0

    def made(run: str) -> tuple[str, int, int]:
        result = call("predict", run, "d.csv", "-o", "p.csv", "--json")
        (found,) = json.loads(result.stdout)["trajectories"]
        return found["start"], found["rows"]["training"], found["rows"]["predicted"]

    assert made("run") == ("continued", 15, 1), "its last row has no measurement"
    Path("d.csv").write_text("t,x,F\n" + "".join(lines[:15]))
    assert call("train", "m.gb", "d.csv", "-o", "again", "--effort", "low", "--quiet").exit_code == 0
    assert made("again") == ("learned", 15, 0)
    said = call("predict", "again", "d.csv", "-o", "p.csv", "--from-start").output
    assert "`--from-start`" in said and "has no effect on 1 trajectory" in said and "the window has" not in said


def test_a_validation_that_scores_nothing_fails(here: Path) -> None:
    Path("m.gb").write_text("model m\nstate x in [0, 9]\nlearn k = 0.3 in [0, 5]\nx' = -k*x^2\nobserve x\n")
    Path("d.csv").write_text("t,x\n" + "".join(f"{t},{1 / (1 + 0.8 * t)}\n" for t in range(8)))
    assert call("train", "m.gb", "d.csv", "-o", "run", "--effort", "low", "--quiet").exit_code == 0
    assert call("validate", "run", "d.csv", "--quiet").exit_code == 0
    result = call("validate", "run", "d.csv", "--set", "k=-9", "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["channels"]["x"]["n"] == 0
    assert "no trajectory can be solved, so that nothing was scored" in result.stderr
