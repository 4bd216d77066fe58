"""The C library of a model, compiled with all warnings and compared with the generated module."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.exports import Exported, ExportOptions
from gbspec.exports.c import Library, verify
from gbspec.exports.c.calling import Compiled
from gbspec.exports.c.verifying import course, errors
from gbspec.exports.checking import Quantity, draw, require
from gbspec.exports.compiling import shared_library
from gbspec.frontend import load_model
from gbspec.ir import METHODS
from gbspec.operations import exporting, models
from tests.backends.examples import clinic, reactor
from tests.exports.texts import BUNDLED, CHOICES, DOSED, EXPLICIT, exported, model_of

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
STRICT = ("-std=c99", "-O0", "-fPIC", "-shared", "-Wall", "-Wextra", "-Wshadow", "-pedantic", "-Werror")


def library_of(subject: Exported, folder: Path) -> Compiled:
    library = Library(subject)
    name = library.prefix
    sources = {f"{name}.h": library.header(), f"{name}.c": library.source()}
    return Compiled(shared_library(folder, sources, folder / f"{name}.so", [f"{name}.c"], STRICT), library)


def agree(subject: Exported, folder: Path, tolerance: float = 1e-13) -> Compiled:
    compiled = library_of(subject, folder)
    for quantity in errors(compiled, compiled.library):
        assert quantity.error < tolerance, quantity
    return compiled


@pytest.mark.parametrize("name", BUNDLED)
def test_every_bundled_model(name: str, tmp_path: Path) -> None:
    agree(exported(load_model(shipped_models()[name], Findings())), tmp_path)


@pytest.mark.parametrize("activation", ["silu", "tanh", "softplus", "relu", "gelu", "sigmoid", "elu", "sin"])
def test_choices_inputs_and_activations(activation: str, tmp_path: Path) -> None:
    agree(exported(model_of(CHOICES.replace("silu", activation))), tmp_path)


@pytest.mark.parametrize("method", EXPLICIT)
def test_doses_contracts_and_methods(method: str, tmp_path: Path) -> None:
    agree(exported(model_of(DOSED), METHODS[method]), tmp_path)


@pytest.mark.parametrize("model", [reactor, clinic])
def test_names_that_c_does_not_have(model: object, tmp_path: Path) -> None:
    agree(exported(model()), tmp_path)  # type: ignore[operator]


@pytest.mark.parametrize("name", ["buffered_tank", "haematopoiesis", "one_compartment", "thermostat", "fed_batch"])
@pytest.mark.parametrize("level", ["-O1", "-O2"])
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_optimising_compilers_do_not_warn(name: str, level: str, compiler: str, tmp_path: Path) -> None:
    """They see more than others, such as values that nothing sets."""
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    library = Library(exported(load_model(shipped_models()[name], Findings())))
    sources = {f"{library.prefix}.h": library.header(), f"{library.prefix}.c": library.source()}
    for file, text in sources.items():
        (tmp_path / file).write_text(text)
    flags = [level if flag == "-O0" else flag for flag in STRICT]
    command = [compiler, *flags, f"{library.prefix}.c", "-o", "library.so", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_greek_names_and_equal_ones(tmp_path: Path) -> None:
    text = "model greek\ntime τ\nstate α in [0, 1]\nstate β_1 in [0, 1]\nconst int = 2\nlearn φ = 1\nlearn phi = 2\n"
    text += "α' = -φ*α + phi*int\nβ_1' = -β_1*τ\nobserve α\nobserve γ = β_1*2\n"
    compiled = agree(exported(model_of(text)), tmp_path)
    header = compiled.library.header()
    assert "double int_;" in header and "double phi;" in header and "double phi_2;" in header
    assert "GREEK_STATE_alpha = 0" in header


def test_names_of_the_library_and_of_its_files_are_kept(tmp_path: Path) -> None:
    text = "model main\nstate x in [0, 1]\nunknown step(x) by mlp(2)\nunknown rhs_along(x) by mlp(2)\n"
    compiled = agree(exported(model_of(text + "x' = step(x) - rhs_along(x)*x\nobserve x\n")), tmp_path)
    assert compiled.prefix == "main_model"
    assert {"double main_model_step_2(", "double main_model_rhs_along_2("} <= {
        line[: line.index("(") + 1] for line in compiled.library.header().splitlines() if line.startswith("double ")
    }


def test_where_a_function_is_asked_outside(tmp_path: Path) -> None:
    subject = exported(reactor())
    compiled = library_of(subject, tmp_path)
    points = draw(subject, 40)
    arguments = np.concatenate([points.x, points.condition], axis=1)
    assert 0 < compiled.outside(points).sum() < 40
    assert (compiled.outside(points) == ((arguments < 0.2) | (arguments > 0.6)).any(axis=1)).all()


def test_each_learned_function_at_arguments(tmp_path: Path) -> None:
    subject = exported(reactor())
    compiled, points = library_of(subject, tmp_path), draw(subject, 5)
    from gbspec.exports.checking import Reference

    arguments = [*points.x.T, points.condition[:, 0]]
    found = compiled.unknown("urp_gb2_phi", points.constants, points.condition, arguments)
    known = Reference(subject, compiled.library.programs, points).unknown("phi", arguments)
    assert found == pytest.approx(known, rel=1e-13)


def test_wrong_times_are_refused_and_infinite_states_reported(tmp_path: Path) -> None:
    compiled = library_of(
        exported(model_of("model grow\nstate x = 1\nx' = x^2\nobserve x\n".replace(" = 1", ""))), tmp_path
    )
    points, path = draw(compiled.library.exported, 2), course(compiled.library)
    states, _ = compiled.simulate(points, replace(path, times=path.times[::-1].copy()))
    assert np.isnan(states).all()


def simulated_by_c(subject: models.Subject, folder: Path, accepted: float = 1e-8) -> None:
    """Exports a subject; its program under the sanitizers prints the table of `gbspec simulate`."""
    findings = Findings()
    made = exporting.export(subject, folder, "c", ExportOptions(), findings, subject.model.name)
    assert not list(findings) and max(made.checked.values()) < 1e-10
    assert {q for q, error in made.checked.items() if error > 1e-13} <= {"steps", "channels along steps"}
    command = [str(COMPILER), "-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-g"]
    command += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", f"{subject.model.name}.c", "main.c"]
    command += ["-lm", "-o", "main"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if "sanitize" in done.stderr or "asan" in done.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert done.returncode == 0, done.stderr
    printed = subprocess.run([folder / "main"], capture_output=True, text=True, check=True).stdout
    rows = list(csv.DictReader(printed.splitlines()))
    known = exporting.example(subject, Exported(subject.model, subject.evaluator.instance, ""))
    assert known.command, "there is a command that simulates the same"
    span = float(known.times[-1]) - known.start
    options = exporting._options(subject, Exported(subject.model, subject.evaluator.instance, ""), span)
    (item,) = exporting.tables.simulate(subject, options).items
    names = [channel.name for channel in subject.model.channels]
    found = np.array([[float(row[name]) for name in names] for row in rows])
    assert [float(row[subject.model.time.name]) for row in rows] == known.times.tolist()
    assert (np.abs(found - item.values) <= accepted * np.abs(item.values).max(axis=0)).all()


def test_the_library_has_no_state_and_no_memory_errors(tmp_path: Path) -> None:
    model = tmp_path / "dosed.gb"
    truth = "truth ka = 1.5\ntruth loss(central, depot) = 0.8*central/(1 + central)\n"
    model.write_text(DOSED + truth, encoding="utf-8")
    simulated_by_c(models.subject(model, {}, Findings()), tmp_path / "library")


def test_the_archive_and_what_it_carries(tmp_path: Path) -> None:
    import zipfile

    findings = Findings()
    subject = models.subject("lotka_volterra", {}, findings)
    one, two = (
        exporting.export(subject, tmp_path / f"{n}.zip", "c", ExportOptions(verify=False), findings, "lotka_volterra")
        for n in (1, 2)
    )
    assert (tmp_path / "1.zip").read_bytes() == (tmp_path / "2.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "1.zip") as archive:
        assert set(archive.namelist()) == set(one.files) and "model.gb" in one.files
        carried = json.loads(archive.read("export.json"))
    assert carried["fingerprint"] == one.fingerprint == two.fingerprint
    assert carried["gbspec"] and carried["form"] == "c"


def test_an_export_is_replaced_and_other_folders_are_not(tmp_path: Path) -> None:
    findings = Findings()
    subject = models.subject("methanol", {}, findings)
    target = tmp_path / "library"
    for _ in range(2):
        exporting.export(subject, target, "c", ExportOptions(verify=False), findings)
    assert [path.name for path in tmp_path.iterdir()] == ["library"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(UserError, match="GB880"):
        exporting.export(subject, tmp_path / "other", "c", ExportOptions(), findings)


def test_without_a_compiler_it_is_written_with_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gbspec.backends import CompilerError

    def none() -> str:
        raise CompilerError("there is no C compiler (cc, gcc, clang)")

    monkeypatch.setattr("gbspec.exports.compiling.find_compiler", none)
    findings = Findings()
    exporting.export(models.subject("methanol", {}, findings), tmp_path / "x", "c", ExportOptions(), findings)
    assert [found.code for found in findings] == ["GB882"] and (tmp_path / "x" / "methanol.c").is_file()


def test_a_difference_is_named_and_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("gbspec.exports.c.networks", fromlist=["x"]).ACTIVATIONS, "silu", ("x", "", "1.0"))
    subject = exported(reactor())
    with pytest.raises(ComputationError, match=r"the right-hand side by .* derivatives of the right-hand side by"):
        require("c", verify(Library(subject)))
    require("c", [Quantity("x", 0.0, 0.0)])


def test_a_model_that_is_too_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.exports.programs.MOST_OPERATIONS", 3)
    findings = Findings()
    with pytest.raises(UserError, match=r"GB808.*more than 3 operations"):
        exporting.export(models.subject("alpha_pinene", {}, findings), tmp_path / "x", "c", ExportOptions(), findings)


def test_complete_models_export_at_their_truth(tmp_path: Path) -> None:
    findings = Findings()
    subject = models.subject("urp_gb2", {"beta": 2.0}, findings)
    exporting.export(subject, tmp_path / "x", "c", ExportOptions(verify=False), findings)
    assert "p->beta = 2.0;" in (tmp_path / "x" / "urp_gb2.c").read_text(encoding="utf-8")
    assert load_module(subject.model).networks == ()
