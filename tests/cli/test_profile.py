"""profile: the interval of a constant, with all other parameters refitted."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build, needed

pytestmark = pytest.mark.usefixtures("quick_fits")

Run = Callable[..., Any]
NOISE = 0.03
START = 1.0

FALL = """\
model fall "Straight lines: everything about them is known in closed form"
time t from 0
state x in [-5, 5] = 1
condition u in [0, 1]
learn a = 0.1 in [-5, 5]
learn b = 0.1 in [-5, 5]
initial x = 1
x' = a + b*u
observe x
truth a = 0.5
truth b = -0.7
"""


def call(*arguments: object) -> Any:
    texts = [str(argument) for argument in arguments]
    return CliRunner().invoke(build(needed(texts)), texts)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run of a model that is linear in its constants, on noisy data."""
    folder = tmp_path_factory.mktemp("profile")
    (folder / "fall.gb").write_text(FALL)
    rng = np.random.default_rng(5)
    lines = ["trajectory,t,x,u"]
    for k, u in enumerate((0.0, 0.3, 1.0)):
        for t in (0.5, 1.0, 1.5, 2.0):
            lines.append(f"{k},{t},{START + (0.5 - 0.7 * u) * t + NOISE * rng.standard_normal()},{u}")
    (folder / "fall.csv").write_text("\n".join(lines) + "\n")
    made = call("train", folder / "fall.gb", folder / "fall.csv", "-o", folder / "run", "--effort", "low", "--quiet")
    assert made.exit_code == 0, made.stderr
    yield folder


def test_the_profile_of_a_linear_model_is_the_parabola_of_least_squares(place: Path, here: Path) -> None:
    result = call("profile", place / "run", "b", "-o", "b.png", "--json")
    assert result.exit_code == 0, result.stderr
    made = json.loads(result.stdout)
    data = pl.read_csv(place / "fall.csv")
    t, u, x = (data[name].to_numpy() for name in ("t", "u", "x"))
    design = np.stack([t, u * t], axis=1)
    solution, residual, *_ = np.linalg.lstsq(design, x - START, rcond=None)
    variance = float(residual[0]) / (len(x) - 2)
    deviation = math.sqrt(variance * np.linalg.inv(design.T @ design)[1, 1])
    assert made["estimate"] == pytest.approx(solution[1], abs=1e-3 * deviation + 1e-6)
    half = math.sqrt(made["threshold"]) * deviation
    assert made["interval"] == pytest.approx([solution[1] - half, solution[1] + half], abs=0.02 * half)
    for point in made["points"]:
        assert point["deviance"] == pytest.approx(((point["value"] - solution[1]) / deviation) ** 2, rel=0.02, abs=0.02)
        # With b fixed, a is the least-squares solution for the remainder
        rest = float(t @ (x - START - point["value"] * u * t) / (t @ t))
        assert point["constants"]["a"] == pytest.approx(rest, abs=1e-3)
    assert Path("b.png").stat().st_size > 1000


def test_an_end_that_the_data_do_not_bound_is_reported_as_open(place: Path, here: Path) -> None:
    text = FALL.replace("b*u", "b*u*0.0001")
    Path("weak.gb").write_text(text)
    made = call("train", "weak.gb", place / "fall.csv", "-o", "weak", "--effort", "low", "--quiet")
    assert made.exit_code == 0, made.stderr
    found = json.loads(call("profile", "weak", "b", "--points", 3, "--json").stdout)
    assert None in found["interval"]
    assert any("do not bound" in note for note in found["notes"])


def test_the_weights_are_refitted(here: Path) -> None:
    Path("bent.gb").write_text(
        'model bent "A rate partly unknown"\nstate x in [0, 2] = 1\nlearn k = 0.5 in [0, 3]\n'
        "unknown extra(x) by mlp(4)\nx' = -k*x + extra(x)\nobserve x\ntruth k = 0.5\ntruth extra(x) = 0.2*x^2\n"
    )
    arguments = ("--trajectories", 4, "--span", 3, "--noise", 0.02, "--seed", 1)
    assert call("simulate", "bent.gb", "-o", "bent.csv", *arguments).exit_code == 0
    assert call("train", "bent.gb", "bent.csv", "-o", "run", "--effort", "low", "--quiet").exit_code == 0
    found = json.loads(call("profile", "run", "k", "--points", 2, "--json").stdout)
    # A free function of x compensates any k: the data cannot distinguish them
    assert max(point["deviance"] for point in found["points"]) < found["threshold"]
    assert found["interval"] == [None, None]


def test_fits_that_did_not_converge_give_no_interval(here: Path) -> None:
    Path("grow.gb").write_text(
        'model grow "Far from linear in its constants"\nstate x in [0, 3] = 0.1\nlearn r = 2 in [0.1, 5]\n'
        "learn K = 2 in [0.5, 5]\ninitial x = 0.1\nx' = r*x*(1 - x/K)\nobserve x\ntruth r = 1.5\ntruth K = 2\n"
    )
    arguments = ("--trajectories", 1, "--span", 3, "--noise", 0.3, "--seed", 1)
    assert call("simulate", "grow.gb", "-o", "grow.csv", *arguments).exit_code == 0
    assert call("train", "grow.gb", "grow.csv", "-o", "run", "--effort", "low", "--quiet").exit_code == 0
    result = call("profile", "run", "K", "--iterations", 1, "--points", 3, "-o", "b.png", "--json")
    found = json.loads(result.stdout)
    assert not all(point["converged"] for point in found["points"])
    assert found["interval"] == [None, None]
    assert any("--iterations" in note for note in found["notes"])


@pytest.mark.parametrize(
    ("arguments", "code"),
    [(("u",), "GB858"), (("bb",), "GB858"), (("b", "-o", "b.gif"), "GB812"), (("b", "--data", "gone.csv"), "GB70")],
)
def test_wrong_input(place: Path, here: Path, arguments: tuple[str, ...], code: str) -> None:
    result = call("profile", place / "run", *arguments)
    assert result.exit_code == (2 if code == "GB812" else 1), result.output
    assert code in result.stderr


def test_data_other_than_the_training_data_are_rejected(place: Path, here: Path) -> None:
    shutil.copytree(place / "run", here / "run")
    Path("other.csv").write_text((place / "fall.csv").read_text() + "9,1.0,0.4,0.5\n")
    result = call("profile", "run", "b", "--data", "other.csv")
    assert result.exit_code == 1
    assert "GB859" in result.stderr


def test_fits_are_stored_and_reused(place: Path, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(place / "run", here / "run")
    for old in Path("run/members/0").glob("profile.*"):
        old.unlink()
    data = ("--data", place / "fall.csv", "--json")
    first = json.loads(call("profile", "run", "b", "--points", 1, *data).stdout)
    whole = json.loads(call("profile", "run", "b", *data).stdout)
    assert len(whole["points"]) > len(first["points"]) == 3

    def refuse(*_: object) -> None:
        raise AssertionError("a fit was made again")

    with monkeypatch.context() as patched:
        patched.setattr("gbspec.training.profile.refits.minimise", refuse)
        patched.setattr("gbspec.training.profile.likelihood.minimise", refuse)
        assert json.loads(call("profile", "run", "b", *data).stdout) == whole
    # A damaged stored file is not used
    Path("run/members/0/profile.b.safetensors").write_bytes(b"nothing")
    assert json.loads(call("profile", "run", "b", *data).stdout) == whole


def amended(run: Path, interval: list[float]) -> None:
    """Replaces the recorded interval of `b`."""
    content = json.loads((run / "fit.json").read_text())
    content["constants"]["b"]["interval"] = interval
    (run / "fit.json").write_text(json.dumps(content))


def test_the_fit_s_interval_is_compared_and_the_verdict_shown_with_the_constants(place: Path, here: Path) -> None:
    from gbspec.report import run_summary
    from gbspec.report.html import tables
    from gbspec.runs import open_run

    shutil.copytree(place / "run", "run")
    shutil.copy(place / "fall.csv", "fall.csv")
    found = json.loads(call("profile", "run", "b", "--json").stdout)
    assert (found["trust"], found["verdict"]) == ("both", None)
    assert found["fit_interval"] == pytest.approx(found["interval"], abs=0.1)
    assert "warning: `b`" not in run_summary(open_run("run"))
    low, high = found["interval"]
    amended(Path("run"), [low - 2 * (high - low), high])
    found = json.loads(call("profile", "run", "b", "-o", "b.png", "--json").stdout)
    assert found["trust"] == "profile" and "trust the profile" in found["verdict"]
    assert "trust the profile" in call("profile", "run", "b").stdout
    run = open_run("run")
    assert "profile" in run_summary(run) and f"warning: `b`: {found['verdict']}" in run_summary(run)
    table = tables.constants(run)
    place_of = table.header.index("profile")
    assert [row[place_of] != "-" for row in table.rows] == [False, True]
    assert call("plot", "run", "constants", "-o", "constants.png").exit_code == 0


def test_a_profile_of_other_weights_is_not_shown(place: Path, here: Path) -> None:
    from gbspec.runs import open_run

    shutil.copytree(place / "run", "run")
    path = Path("run/members/0/profile.b.json")
    assert call("profile", "run", "b", "--data", place / "fall.csv", "--points", 2).exit_code == 0
    assert open_run("run").profiled("b") is not None
    path.write_text(path.read_text().replace('"weights": "', '"weights": "0'))
    assert open_run("run").profiled("b") is None
    path.write_text("{")
    assert open_run("run").profiled("b") is None


def test_a_profile_with_a_flat_bottom_has_points_near_its_ends(here: Path) -> None:
    """Two rates that may be exchanged are fitted as equal: the deviance rises with the fourth power of their distance,
    and its curvature says nothing."""
    text = (
        'model bate "Two rates in turn"\ntime t from 0\nstate A in [0, 10]\nstate G in [0, 10] = 0\n'
        "learn ka = 0.3 in [0.02, 3]\nlearn ke = 0.3 in [0.02, 3]\nlearn A0 = 5 in [0.5, 50]\ninitial A = A0\n"
        "A' = -ka*A\nG' = ka*A - ke*G\nobserve G\n"
    )
    Path("bate.gb").write_text(text)
    rng = np.random.default_rng(3)
    t = np.arange(1.0, 25.0)
    values = 1.5 / 0.12 * np.sin(0.12 * t) * np.exp(-0.3 * t) + 0.1 * rng.standard_normal(len(t))
    Path("bate.csv").write_text("t,G\n" + "".join(f"{a},{b}\n" for a, b in zip(t, values, strict=True)))
    assert call("train", "bate.gb", "bate.csv", "-o", "run", "--effort", "low", "--quiet").exit_code == 0
    found = json.loads(call("profile", "run", "ka", "--json").stdout)
    roots = [math.sqrt(point["deviance"] / found["threshold"]) for point in found["points"]]
    for inner, outer in ((1, 0), (-2, -1)):
        assert min(abs(roots[inner] - 1), abs(roots[outer] - 1)) < 0.15, roots
