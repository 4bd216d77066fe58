"""simulate, train, validate, eigen and plot, run in sequence as by a user."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build, needed

from .conftest import DECAY, KNOWN

pytestmark = pytest.mark.usefixtures("few_points")

Run = Callable[..., Any]


def call(*arguments: object) -> Any:
    texts = [str(argument) for argument in arguments]
    return CliRunner().invoke(build(needed(texts)), texts)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with two models, their tables and a run of each."""
    folder = tmp_path_factory.mktemp("chain")
    for name, text in (("decay", DECAY), ("known", KNOWN)):
        (folder / f"{name}.gb").write_text(text)
        table = folder / f"{name}.csv"
        made = call("simulate", folder / f"{name}.gb", "-o", table, "--trajectories", 5, "--span", 3, "--keep-start")
        assert made.exit_code == 0, made.stderr
        made = call("train", folder / f"{name}.gb", table, "-o", folder / f"{name}_run", "--effort", "low", "--quiet")
        assert made.exit_code == 0, made.stderr
        assert "whole solutions" in made.stdout and not made.stderr  # what a fit found is its result
    yield folder


# ------------------------------------------------------------------------------------------------------- simulate
def test_simulate_writes_a_table_and_reports_its_content(known: Path, document: Run) -> None:
    arguments = ("--trajectories", 4, "--dt", 0.25, "--span", 2, "--channels", "0.5", "--noise", 0.01, "--seed", 7)
    made = document("simulate", known, "-o", "t.csv", *arguments)
    assert made["trajectories"] == 4
    assert made["options"]["noise"] == 0.01
    header, *rows = Path("t.csv").read_text().splitlines()
    assert header == "trajectory,t,A,B"
    assert len(rows) == made["rows"]


def test_the_same_seed_gives_the_same_table(known: Path, gbspec: Run) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert gbspec("simulate", known, "-o", f"{name}.csv", "--seed", seed, "--trajectories", 3).exit_code == 0
    a, b, c = (Path(f"{name}.csv").read_text() for name in "abc")
    assert a == b != c


def test_set_changes_the_truth(known: Path, gbspec: Run) -> None:
    for name, k in (("slow", 0.1), ("fast", 3)):
        arguments = ("--initial", "A=1", "--initial", "B=0", "--trajectories", 1, "--set", f"k={k}")
        assert gbspec("simulate", known, "-o", f"{name}.csv", *arguments).exit_code == 0
    slow, fast = (float(Path(f"{n}.csv").read_text().splitlines()[1].split(",")[2]) for n in ("slow", "fast"))
    assert slow == pytest.approx(0.951229424500714, rel=1e-9)  # exp(-0.1 * 0.5)
    assert fast == pytest.approx(0.22313016014842982, rel=1e-9)  # exp(-3 * 0.5)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--set", "k"), "GB810"),
        (("--set", "k=fast"), "GB810"),
        (("--set", "kk=1"), "GB804"),
        (("--initial", "A=0..1"), "GB750"),
        (("--initial", "C=0:1"), "GB75"),
        (("--dt", "0"), "GB754"),
        (("--reject", "A >"), "GB"),
        (("--like", "absent.csv"), "GB70"),
    ],
)
def test_wrong_options_of_simulate(known: Path, gbspec: Run, arguments: tuple[str, ...], code: str) -> None:
    result = gbspec("simulate", known, "-o", "t.csv", *arguments)
    assert result.exit_code == (2 if code in ("GB750", "GB754", "GB810") else 1), result.stderr
    assert code in result.stderr
    assert not Path("t.csv").exists()


def test_an_unknown_without_a_truth_is_named(decay: Path, gbspec: Run) -> None:
    decay.write_text("".join(line for line in DECAY.splitlines(True) if not line.startswith("truth")))
    result = gbspec("simulate", decay, "-o", "t.csv")
    assert result.exit_code == 1
    assert "GB803" in result.stderr
    assert "`rate`" in result.stderr


def test_output_that_cannot_be_written_is_reported_before_the_work(known: Path, gbspec: Run) -> None:
    result = gbspec("simulate", known, "-o", "no/such/place.csv")
    assert result.exit_code == 1
    assert "GB805" in result.stderr


# ---------------------------------------------------------------------------------------------------------- train
def test_the_files_of_a_run(place: Path) -> None:
    run = place / "decay_run"
    assert {p.name for p in run.iterdir()} >= {"model.gb", "model.py", "fit.json", "history.csv", "members"}
    fit = json.loads((run / "fit.json").read_text())
    assert list(fit)[:8] == ["gbspec", "model", "data", "options", "versions", "constants", "noise", "members"]


def test_a_run_is_written_with_the_solver_that_it_was_trained_with(place: Path, here: Path) -> None:
    more = ("--solver", "rk38", "--method", "lm", "--epochs", 2, "--quiet")
    assert call("train", place / "known.gb", place / "known.csv", "-o", "rk38", *more).exit_code == 0
    for emit, chosen, said in (
        ("module", (), 'solver: ClassVar[str] = "rk38"'),
        ("module", ("--solver", "dopri5"), 'solver: ClassVar[str] = "dopri5"'),
        ("c", (), "(`rk38`)"),
        ("c", ("--solver", "dopri5"), "(`dopri5`)"),
    ):
        assert call("compile", "rk38", "--emit", emit, "-o", "out", *chosen).exit_code == 0
        assert said in Path("out").read_text()
    assert call("compile", place / "known.gb", "--emit", "c", "--solver", "rk38", "-o", "out").exit_code == 0
    assert "(`rk38`)" in Path("out").read_text()


def test_the_known_constant_is_found(place: Path) -> None:
    fit = json.loads((place / "known_run" / "fit.json").read_text())
    assert fit["constants"]["k"]["value"] == pytest.approx(0.8, rel=1e-3)


def test_train_does_not_overwrite_a_run(place: Path) -> None:
    result = call("train", place / "known.gb", place / "known.csv", "-o", place / "known_run")
    assert result.exit_code == 1
    assert "GB806" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "status", "code"),
    [
        (("absent.csv",), 1, "GB70"),
        (("{place}",), 1, "GB"),
        (("{place}/known.csv", "--members", "0"), 2, "GB850"),
        (("{place}/known.csv", "--holdout", "2"), 2, "GB850"),
        (("{place}/known.csv", "--resume"), 1, "no run to resume"),
        (("{place}/known.csv", "--effort", "much"), 2, "effort"),
        (("{place}/known.csv", "--members", "many"), 2, "members"),
        (("{place}/decay.csv",), 1, "GB7"),
    ],
)
def test_wrong_input_of_train(place: Path, here: Path, arguments: tuple[str, ...], status: int, code: str) -> None:
    given = [argument.format(place=place) for argument in arguments]
    result = call("train", place / "known.gb", *given, "-o", here / "run")
    assert result.exit_code == status, result.output
    assert code in result.stderr
    assert not (here / "run").exists()


def test_an_interrupted_training_exits_130_and_can_be_resumed(place: Path, here: Path) -> None:
    train = [sys.executable, "-m", "gbspec", "train", str(place / "decay.gb"), str(place / "decay.csv"), "-o", "run"]
    slow = [*train, "--method", "adam", "--epochs", "100000", "--no-warm-start", "--solver", "rk4"]
    process = subprocess.Popen(slow, cwd=here, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    seen = ""
    while "adam" not in seen.lower() and (line := process.stderr.readline()):  # or until the process ends
        seen += line
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=300)
    assert process.returncode == 130, seen + rest
    assert "Traceback" not in seen + rest
    assert call("validate", here / "run", place / "decay.csv").exit_code == 0


# ------------------------------------------------------------------------------------------------------- validate
def test_validate_json_has_the_keys_of_the_contract(place: Path) -> None:
    made = json.loads(call("validate", place / "known_run", "--json").stdout)
    assert list(made)[:4] == ["channels", "trajectories", "step_check", "truth"]
    assert list(made["channels"]["A"]) == ["n", "rmse", "nrmse", "mae", "r2"]
    assert made["channels"]["A"]["r2"] > 0.999
    assert {"half_step", "adaptive"} <= set(made["step_check"])
    assert made["truth"]["constants"]["all"] < 1e-3


@pytest.mark.parametrize(("member", "status"), [("9", 1), ("first", 2)])
def test_a_member_that_does_not_exist(place: Path, member: str, status: int) -> None:
    assert call("validate", place / "known_run", "--member", member).exit_code == status


@pytest.mark.parametrize("command", [("validate",), ("plot", "fit", "-o", "f.png")])
def test_a_directory_that_is_not_a_run(here: Path, command: tuple[str, ...]) -> None:
    result = call(command[0], here, *command[1:])
    assert result.exit_code == 1
    assert "GB851" in result.stderr


# ---------------------------------------------------------------------------------------------------------- eigen
def test_eigenvalues_of_a_model_and_of_a_run_with_its_truth(place: Path) -> None:
    made = json.loads(call("eigen", place / "known.gb", "--at", "A=1,B=0.5", "--json").stdout)
    (point,) = made["points"]
    assert list(point)[:5] == ["state", "condition", "rhs_norm", "eigenvalues", "truth"]
    assert sorted(re for re, _ in point["eigenvalues"]) == pytest.approx([-0.8, 0.0], abs=1e-12)
    (learned,) = json.loads(call("eigen", place / "known_run", "--at", "A=1,B=0.5", "--json").stdout)["points"]
    assert sorted(re for re, _ in learned["truth"]) == pytest.approx([-0.8, 0.0], abs=1e-12)


@pytest.mark.parametrize(("at", "code"), [("A", "GB810"), ("1, 2", "GB810"), ("A=1,C=2", "GB870"), ("A=1", "GB871")])
def test_wrong_points(place: Path, at: str, code: str) -> None:
    result = call("eigen", place / "known.gb", "--at", at)
    assert result.exit_code == (2 if code == "GB810" else 1)
    assert code in result.stderr


# ----------------------------------------------------------------------------------------------------------- plot
@pytest.mark.parametrize("kind", ["fit", "functions", "history", "residuals", "summary"])
def test_figures_of_a_run_with_an_unknown(place: Path, here: Path, kind: str) -> None:
    result = call("plot", place / "decay_run", kind, "-o", "figure.png")
    assert result.exit_code == 0, result.stderr
    assert Path("figure.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(("suffix", "start"), [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_file_formats_of_a_figure(place: Path, here: Path, suffix: str, start: bytes) -> None:
    for _ in range(2):
        result = call("plot", place / "known_run", "phase", "-o", f"figure.{suffix}", "--show", "2")
        assert result.exit_code == 0, result.stderr
    assert Path(f"figure.{suffix}").read_bytes().startswith(start)


@pytest.mark.parametrize(
    ("run", "arguments", "code"),
    [
        ("known_run", ("functions", "-o", "f.png"), "GB813"),
        ("decay_run", ("constants", "-o", "f.png"), "GB813"),
        ("decay_run", ("phase", "-o", "f.png"), "GB813"),
        ("decay_run", ("fit", "-o", "f.png", "--show", "99"), "GB813"),
        ("decay_run", ("fit", "-o", "f.bmp"), "GB812"),
        ("decay_run", ("fit", "-o", "no/f.png"), "GB805"),
    ],
)
def test_figures_that_cannot_be_drawn(place: Path, here: Path, run: str, arguments: tuple[str, ...], code: str) -> None:
    result = call("plot", place / run, *arguments)
    assert result.exit_code == (2 if code == "GB812" else 1), result.output
    assert code in result.stderr
    assert not list(here.iterdir())


# --------------------------------------------------------------------------------------------------------- Python
@pytest.mark.usefixtures("quick_fit")
def test_the_same_from_python(place: Path, here: Path) -> None:
    import gbspec

    model = gbspec.load(place / "known.gb")
    assert model.check() == ()
    assert "A" in str(model)
    data = model.simulate(trajectories=3, span=2.0, initial={"A": (0.5, 1.0)})
    fit = model.train(data, "run", effort="low")
    assert fit.constants["k"] == pytest.approx(0.8, rel=1e-3)
    assert fit.validate(data).channels["A"].r2 > 0.999
    assert len(fit.eigen(at=[{"A": 1.0, "B": 0.0}]).points) == 1
    assert fit.plot("fit", "fit.png", data=data).axes
    assert Path("fit.png").is_file()
    assert len(gbspec.simulate("run", trajectories=2)) == 2
    assert model.compile("known.py").startswith('"""')
    assert gbspec.check(place / "known.gb") == ()


# ------------------------------------------------------------------------------------------------------ bifurcate
FOLD = """\
model saddle "A saddle-node"
condition p in [-1, 1]
state x in [-2, 2] = 1
x' = p + x - x^3
observe x
"""


def test_bifurcate_finds_the_folds_and_draws_them(here: Path, gbspec: Run) -> None:
    (here / "saddle.gb").write_text(FOLD)
    result = gbspec("bifurcate", "saddle.gb", "--over", "p", "--range", -1, 1, "-o", "d.png", "--json")
    assert result.exit_code == 0, result.stderr
    made = json.loads(result.stdout)
    assert list(made)[:5] == ["parameter", "range", "branches", "special", "cycles"]
    folds = sorted(point["value"] for point in made["special"] if point["type"] == "fold")
    exact = 2 / (3 * 3**0.5)  # p = x^3 - x at x = ±1/sqrt(3)
    assert folds == pytest.approx([-exact, exact], abs=1e-8)
    assert Path("d.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("arguments", "status", "code"),
    [
        (("--over", "q", "--range", "0", "1"), 1, "GB872"),
        (("--over", "k", "--range", "1", "0"), 2, "GB875"),
        (("--over", "k"), 2, "range"),
        (("--over", "k", "--range", "0", "1", "-o", "d.txt"), 2, "GB812"),
    ],
)
def test_wrong_parameters_of_bifurcate(
    known: Path, gbspec: Run, arguments: tuple[str, ...], status: int, code: str
) -> None:
    result = gbspec("bifurcate", known, *arguments)
    assert result.exit_code == status, result.output
    assert code in result.stderr


# ------------------------------------------------------------------------------------------------------- sweep
@pytest.mark.usefixtures("quick_fit")
def test_a_sweep_has_a_row_for_each_combination(place: Path, here: Path, document: Run) -> None:
    made = document("sweep", place / "known.gb", place / "known.csv", "-o", "swept", "--vary", "effort=low",
                    "--vary", "max_step=0.1,0.5", "--workers", 1)  # fmt: skip
    assert [row["run"] for row in made["runs"]] == ["effort=low,max_step=0.1", "effort=low,max_step=0.5"]
    assert all(row["loss"] < 1e-4 for row in made["runs"])
    assert Path("swept/sweep.csv").is_file() and Path("swept/effort=low,max_step=0.1/fit.json").is_file()
    again = call("sweep", place / "known.gb", place / "known.csv", "-o", "swept", "--vary", "effort=low")
    assert again.exit_code == 1 and "GB806" in again.stderr
