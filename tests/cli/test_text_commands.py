"""new, check, fmt, compile, explain: the commands that only read and write text."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec.backends.registry import backends
from gbspec.cli.app import build
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.frontend import STAGES, after, load_model
from gbspec.operations import models

Run = Callable[..., Any]

HEAVY = """
import sys
from gbspec.cli.app import main
try:
    main(sys.argv[2:])
except SystemExit as leave:
    assert not leave.code, leave.code
loaded = [name for name in sys.argv[1].split() if name in sys.modules]
assert not loaded, loaded
"""


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (["check", "urp_gb2", "--quiet"], "torch casadi matplotlib polars pyarrow scipy"),
        (["--version"], "torch casadi matplotlib polars pyarrow scipy sympy"),
    ],
)
def test_a_command_imports_only_what_it_needs(here: Path, arguments: list[str], absent: str) -> None:
    called = [sys.executable, "-c", HEAVY, absent, *arguments]
    done = subprocess.run(called, capture_output=True, text=True, cwd=here)
    assert done.returncode == 0, done.stderr


def test_check_prints_states_initial_values_unknowns_and_learnables(gbspec: Run) -> None:
    result = gbspec("check", "urp_gb2")
    assert result.exit_code == 0, result.stderr
    for said in (
        "x1",
        "conversion",
        "measured, else learned",
        "phi(x1, x2, Da)",
        "3-64-64-1",
        "4481",
        "B from 5",
        "Da",
    ):
        assert said in result.stdout


def test_check_json_has_its_keys_in_order(document: Run) -> None:
    made = document("check", "urp_gb2")
    assert list(made) == ["files"]
    (file,) = made["files"]
    assert list(file)[:10] == [
        *("path", "model", "states", "conditions", "inputs", "constants", "learnables", "unknowns", "laws"),
        "identifiability",
    ]
    assert file["states"] == ["x1", "x2"]
    assert file["learnables"] == ["B", "beta"]
    (unknown,) = file["unknowns"]
    assert list(unknown.items())[:3] == [("names", ["phi"]), ("arguments", ["x1", "x2", "Da"]), ("parameters", 4481)]
    assert file["diagnostics"] == []


def test_check_json_has_the_columns_of_groups_apart_from_conditions(document: Run, tmp_path: Path) -> None:
    path = tmp_path / "m.gb"
    path.write_text(
        "model m\ntime t from 0\ncondition dose in [0, 9]\ncondition kind in {wild, mutant}\nstate x in [0, 9]\n"
        "learn k = 1 in [0.1, 9] per trajectory ~ lognormal per strain ~ lognormal\nlearn a = 1 in [0.1, 9] per kind\n"
        "x' = -k*a*x\ninitial x = dose\nobserve x\n"
    )
    (file,) = document("check", path)["files"]
    assert file["conditions"] == ["dose", "kind"]
    assert file["groups"] == [
        {"column": "kind", "constants": ["a_wild", "a_mutant"]},
        {"column": "strain", "constants": ["k"]},
    ]


def test_check_reports_everything_of_every_file(gbspec: Run, document: Run, decay: Path) -> None:
    bad = decay.with_name("bad.gb")
    bad.write_text("model bad\nstate x\nstate y\nx' = -k*x\n")
    result = gbspec("check", decay, bad)
    assert result.exit_code == 1
    assert "`k`" in result.stderr
    assert "`y`" in result.stderr
    assert "decay" in result.stdout
    good, wrong = document("check", decay, bad)["files"]
    assert good["model"] == "decay"
    assert {d["severity"] for d in wrong["diagnostics"]} >= {"error"}
    assert list(wrong["diagnostics"][0]) == [
        *("code", "severity", "message", "file", "line", "column", "end_line", "end_column", "labels", "notes", "help"),
    ]


def test_strict_counts_warnings(gbspec: Run, decay: Path) -> None:
    decay.write_text(decay.read_text() + "const spare = 3\n")
    assert gbspec("check", decay).exit_code == 0
    assert gbspec("check", decay, "--strict").exit_code == 1


def test_check_reads_standard_input(here: Path) -> None:
    (here / "base.gb").write_text("model base\nstate x = 1\nx' = -x\nobserve x\n")
    text = 'model long extends "base.gb"\nstate y = 1\ny\' = -k*y\n'
    wrong = CliRunner().invoke(build(("check", "fmt")), ["check", "-", "--json"], input=text)
    assert wrong.exit_code == 1
    (file,) = json.loads(wrong.stdout)["files"]
    assert (file["path"], file["diagnostics"][0]["file"], file["diagnostics"][0]["line"]) == ("-", "<stdin>", 3)
    right = CliRunner().invoke(build(("check", "fmt")), ["check", "-"], input=text.replace("k*y", "y"))
    assert right.exit_code == 0, right.stderr
    assert "long" in right.stdout


def test_fmt_writes_what_it_reads_from_standard_input(here: Path) -> None:
    def fmt(text: str, *flags: str) -> Any:
        return CliRunner().invoke(build(("check", "fmt")), ["fmt", "-", *flags], input=text)

    untidy = "model decay\r\nstate  x=1 # how much\nx' = -x\nobserve x\n"
    formatted = fmt(untidy)
    assert (formatted.exit_code, formatted.stderr) == (0, "")
    assert "# how much\n" in formatted.stdout
    again = fmt(formatted.stdout)
    assert again.stdout == formatted.stdout
    assert fmt(formatted.stdout, "--check").exit_code == 0
    assert fmt(untidy, "--check").exit_code == 1
    assert "<stdin>" in fmt(untidy, "--diff").stdout
    assert json.loads(fmt(untidy, "--json").stdout)["formatted"] == formatted.stdout
    wrong = fmt("model decay\nstate x = = 1\n")
    assert (wrong.exit_code, wrong.stdout) == (1, "")
    assert "<stdin>:2" in wrong.stderr
    assert not list(here.iterdir())


@pytest.mark.parametrize("command", [("check",), ("compile", "-o", "x.py"), ("fmt",)])
def test_a_missing_model_is_wrong_input(gbspec: Run, here: Path, command: tuple[str, ...]) -> None:
    result = gbspec(command[0], "absent.gb", *command[1:])
    assert result.exit_code == 1
    assert "absent.gb" in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize("command", [("check",), ("compile", "-o", "x.py"), ("fmt",)])
def test_a_directory_for_a_model_is_wrong_input(gbspec: Run, here: Path, command: tuple[str, ...]) -> None:
    (here / "folder").mkdir()
    result = gbspec(command[0], "folder", *command[1:])
    assert result.exit_code == 1
    assert "folder" in result.stderr


# ------------------------------------------------------------------------------------------------------------ new
def test_new_writes_a_formatted_model_that_passes_strict_checks(gbspec: Run, here: Path) -> None:
    assert gbspec("new", "my_model").exit_code == 0
    result = gbspec("check", "--strict", "my_model.gb")
    assert result.exit_code == 0, result.stderr
    assert gbspec("fmt", "--check", "my_model.gb").exit_code == 0


def test_new_never_overwrites(gbspec: Run, decay: Path) -> None:
    before = decay.read_text()
    result = gbspec("new", "decay")
    assert result.exit_code == 1
    assert "GB806" in result.stderr
    assert decay.read_text() == before


@pytest.mark.parametrize("name", ["my-model", "2nd", "a b"])
def test_new_rejects_names_that_no_module_can_have(gbspec: Run, here: Path, name: str) -> None:
    result = gbspec("new", name)
    assert result.exit_code == 2
    assert "GB807" in result.stderr
    assert not list(here.iterdir())


def test_the_data_of_a_new_model_have_different_starts_and_stay_in_its_ranges(gbspec: Run, here: Path) -> None:
    gbspec("new", "my_model")
    text = (here / "my_model.gb").read_text()
    assert all(f"\n{word} " in text for word in ("time", "condition", "const", "learn", "unknown", "process", "truth"))
    told = gbspec("simulate", "my_model.gb", "-o", "data.csv", "--trajectories", "12", "--keep-start")
    assert told.exit_code == 0, told.stderr
    assert "outside" not in told.stderr
    header, *rows = [line.split(",") for line in (here / "data.csv").read_text().splitlines()]
    first = [dict(zip(header, row, strict=True)) for row in rows if row[1] == "0.0"]
    assert all(len({row[name] for row in first}) == 12 for name in ("A", "B", "D"))


def test_a_state_that_is_not_measured_and_leaves_its_range_is_told(gbspec: Run, here: Path) -> None:
    text = (
        "model m\ninput I held in [1, 2]\nstate soc in [0, 1] = 0.5\nsoc' = I\ninitial soc = 0.5\nobserve v = 2*soc\n"
    )
    (here / "m.gb").write_text(text)
    told = gbspec("simulate", "m.gb", "-o", "data.csv", "--trajectories", "2")
    assert "note: `soc`: 40 of 40 values lie far outside of its range [0, 1]: from " in told.stderr


@pytest.mark.parametrize("name", ["fed_batch", "urp_gb2", "alpha_pinene", "cell"])
def test_a_copy_of_a_bundled_model_stands_alone_under_its_new_name(
    gbspec: Run, document: Run, here: Path, name: str
) -> None:
    told = gbspec("new", "mine", "--from", name)
    assert told.exit_code == 0, told.stderr
    assert "gbspec simulate mine.gb" in told.stderr
    assert gbspec("fmt", "--check", "mine.gb").exit_code == 0
    (copy,) = document("check", "mine.gb")["files"]
    (original,) = document("check", name)["files"]
    assert (copy["model"], copy["states"], copy["learnables"]) == ("mine", original["states"], original["learnables"])


def test_a_copy_of_each_bundled_model_checks(here: Path) -> None:
    for name in shipped_models():
        text, _ = models.copied(name, "mine")
        (here / "mine.gb").write_text(text)
        assert load_model("mine.gb", Findings()).name == "mine", name


def test_a_copy_keeps_comments_and_says_nothing_of_simulation_without_a_truth(gbspec: Run, here: Path) -> None:
    told = gbspec("new", "mine", "--from", "theophylline")
    assert "# Twelve subjects" in (here / "mine.gb").read_text()
    assert "simulate" not in told.stderr
    assert "train mine.gb" in told.stderr


def test_models_lists_every_bundled_model_with_its_title(gbspec: Run, document: Run) -> None:
    shown = gbspec("models").stdout.splitlines()
    assert [line.split()[0] for line in shown] == list(shipped_models())
    assert "fed_batch                Fed-batch fermenter, growth kinetics unknown" in shown
    assert document("models")["models"][0]["title"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("urp_gb", "bundled model `urp_gb"),
        ("fedbatch", "`fed_batch`"),
        ("Fed_batch.gb", "`fed_batch`"),
        ("something", "gbspec models"),
    ],
)
@pytest.mark.parametrize("command", [("check",), ("simulate", "-o", "x.csv"), ("new", "mine", "--from")])
def test_a_misspelt_bundled_model_gets_a_suggestion(
    gbspec: Run, here: Path, command: tuple[str, ...], given: str, said: str
) -> None:
    result = gbspec(command[0], *command[1:], given) if command[0] == "new" else gbspec(command[0], given, *command[1:])
    assert result.exit_code == 1
    assert "GB001" in result.stderr
    assert said in result.stderr


# ------------------------------------------------------------------------------------------------------------ fmt
def test_fmt_rewrites_check_reports_and_diff_shows(gbspec: Run, here: Path) -> None:
    path = here / "m.gb"
    rough = "model   m  # the name\nstate x=1\nx'=-2*x\nobserve   x\n"
    path.write_text(rough)
    told = gbspec("fmt", "--check", path)
    assert (told.exit_code, path.read_text()) == (1, rough)
    shown = gbspec("fmt", "--diff", path)
    assert (shown.exit_code, path.read_text()) == (1, rough)
    assert "-x'=-2*x" in shown.stdout
    assert "+x' = -2*x" in shown.stdout
    assert gbspec("fmt", path).exit_code == 0
    assert "# the name" in path.read_text()
    assert gbspec("fmt", "--check", "--diff", path).exit_code == 0


def test_fmt_leaves_a_file_with_syntax_errors_alone(gbspec: Run, decay: Path) -> None:
    bad = decay.with_name("bad.gb")
    bad.write_text("model bad\nstate x = = 1\n")
    decay.write_text("model   decay\nstate N=1\nN' = -N\n")
    result = gbspec("fmt", bad, decay)
    assert result.exit_code == 1
    assert "bad.gb" in result.stderr
    assert bad.read_text() == "model bad\nstate x = = 1\n"
    assert decay.read_text().startswith("model decay\n")


# -------------------------------------------------------------------------------------------------------- compile
def test_compile_writes_a_module_that_imports_without_gbspec(gbspec: Run, decay: Path) -> None:
    result = gbspec("compile", decay, "-o", "decay.py")
    assert result.exit_code == 0, result.stderr
    foreign = "{'gbspec', 'sympy', 'torch', 'casadi'}"
    code = f"import sys, decay; print(decay.Decay.states, sorted({foreign} & set(sys.modules)))"
    shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=decay.parent)
    assert shown.stdout.strip() == "('N',) []"


def test_compile_with_another_solver(gbspec: Run, decay: Path) -> None:
    assert gbspec("compile", decay, "--solver", "dopri5", "-o", "decay.py").exit_code == 0
    assert 'solver: ClassVar[str] = "dopri5"' in Path("decay.py").read_text()
    result = gbspec("compile", decay, "--solver", "dopri6", "-o", "other.py")
    assert result.exit_code == 2
    assert "GB850" in result.stderr and "`rk4`, `rk38`, `dopri5`" in result.stderr
    assert not Path("other.py").exists()


def test_compile_emits_the_intermediate_form(gbspec: Run, decay: Path) -> None:
    assert gbspec("compile", decay, "--emit", "ir", "-o", "decay.ir").exit_code == 0
    assert "rate" in Path("decay.ir").read_text()


def test_compile_to_a_folder_that_does_not_exist(gbspec: Run, decay: Path) -> None:
    result = gbspec("compile", decay, "-o", "no/such/decay.py")
    assert result.exit_code == 1
    assert "GB805" in result.stderr


def test_compile_writes_the_result_of_each_stage_of_the_pipeline(gbspec: Run, document: Run, decay: Path) -> None:
    for stage in STAGES:
        said = document("compile", decay, "--emit", stage.name, "-o", "decay.txt")
        assert (said["model"], said["emit"], said["class"]) == ("decay", stage.name, None)
        assert Path("decay.txt").read_text() == after(stage.name, decay, Findings()).text


def test_a_stage_depends_only_on_earlier_stages(gbspec: Run, here: Path) -> None:
    (here / "wrong.gb").write_text("model wrong\nstate x = 1\nx' = -y\nobserve x\n")
    assert gbspec("compile", "wrong.gb", "--emit", "ast", "-o", "tree.txt").exit_code == 0
    assert "value (- y)" in Path("tree.txt").read_text()
    result = gbspec("compile", "wrong.gb", "--emit", "checked", "-o", "checked.txt")
    assert result.exit_code == 1
    assert "GB201" in result.stderr
    assert not Path("checked.txt").exists()


def test_a_form_that_cannot_express_the_model_gives_the_reason(gbspec: Run, here: Path) -> None:
    arguments = ", ".join(["x"] * 40)
    formals = ", ".join(f"a{i}" for i in range(40))
    text = f"model wide\nstate x = 1\nunknown f({formals}) by mlp(4)\nx' = f({arguments})\nobserve x\n"
    (here / "wide.gb").write_text(text)
    assert gbspec("compile", "wide.gb", "-o", "wide.py").exit_code == 0
    result = gbspec("compile", "wide.gb", "--emit", "native", "-o", "wide.c")
    assert result.exit_code == 1
    assert "GB808" in result.stderr
    assert "the network `f` has too many layers or arguments" in result.stderr
    assert not Path("wide.c").exists()


def test_the_help_lists_every_form(gbspec: Run) -> None:
    shown = " ".join(gbspec("compile", "--help").stdout.replace("│", " ").split())
    assert all(f"{name}: " in shown for name in (*(stage.name for stage in STAGES), *backends()))


def test_an_unknown_form_is_usage(gbspec: Run, decay: Path) -> None:
    assert gbspec("compile", decay, "--emit", "fortran", "-o", "decay.f").exit_code == 2


# -------------------------------------------------------------------------------------------------------- explain
def test_explain(gbspec: Run, document: Run) -> None:
    result = gbspec("explain", "gb807")
    assert result.exit_code == 0
    assert "gbspec new my_model" in result.stdout
    assert document("explain", "GB807")["title"]


def test_explain_an_unknown_code(gbspec: Run) -> None:
    result = gbspec("explain", "GB000")
    assert result.exit_code == 2
    assert "GB000" in result.stderr


def test_the_json_document_is_the_only_thing_on_standard_output(gbspec: Run, decay: Path) -> None:
    for arguments in (("check", decay), ("compile", decay, "-o", "d.py"), ("new", "another"), ("explain", "GB801")):
        assert isinstance(json.loads(gbspec(*arguments, "--json").stdout), dict)
