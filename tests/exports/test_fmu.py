"""Functional mock-up units: what fmpy says of them, and their numbers against the generated module."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import pytest

from gbspec.backends import CompilerError, Evaluator, find_compiler
from gbspec.data import DoseEvents, Signal
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.exports import Exported, ExportOptions
from gbspec.exports.checking import Reference, draw
from gbspec.exports.fmi.unit import make
from gbspec.exports.programs import Programs
from gbspec.exports.writing import archived
from gbspec.frontend import load_model
from gbspec.operations import exporting, models
from tests.exports.texts import CHOICES, DOSED, HAPPENING, REPEATED, SWITCHED, exported, model_of

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed")
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
Version = Literal["2", "3"]
VERSIONS = pytest.mark.parametrize("version", ["2", "3"])
SOLVED = ("alpha_pinene", "fed_batch", "friction_oscillator", "spreading_population", "urp_gb2")
QUICK = ("-std=c99", "-O0", "-fPIC", "-shared", "-fvisibility=hidden", "-Wall", "-Wextra", "-pedantic", "-Werror")


@pytest.fixture(autouse=True)
def _quick_compilation(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Without optimisation, and every warning an error."""
    monkeypatch.setattr("gbspec.exports.fmi.unit.FLAGS", QUICK)
    yield


def unit(subject: Exported, version: Version, folder: Path) -> Path:
    path = folder / f"unit{version}.fmu"
    path.write_bytes(archived(make(version, subject, ExportOptions(verify=False)).files))
    return path


def problems(path: Path) -> list[str]:
    from fmpy.validation import validate_fmu

    return list(validate_fmu(str(path)))


def opened(path: Path, kind: str = "me") -> Any:
    """A unit after its initialization, by fmpy's classes of either version."""
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Model, FMU2Slave
    from fmpy.fmi3 import FMU3Model, FMU3Slave

    description = read_model_description(str(path))
    folder = extract(str(path), unzipdir=str(path.with_suffix("." + kind)))
    old = description.fmiVersion == "2.0"
    classes = (FMU2Model, FMU2Slave) if old else (FMU3Model, FMU3Slave)
    interface = description.modelExchange if kind == "me" else description.coSimulation
    found = classes[kind != "me"](
        guid=description.guid, unzipDirectory=folder, modelIdentifier=interface.modelIdentifier, instanceName="one"
    )
    found.instantiate()
    refs = {v.name: v.valueReference for v in description.modelVariables}
    get, put = (found.getReal, found.setReal) if old else (found.getFloat64, found.setFloat64)
    return SimpleNamespace(unit=found, refs=refs, get=get, put=put, old=old, description=description)


def of_its_state(one: Any) -> tuple[Any, Any, Any, Any]:
    """The functions of a unit that get, put, write and read its state, as its version spells them."""
    unit = one.unit
    if one.old:
        return unit.getFMUstate, unit.setFMUstate, unit.serializeFMUstate, unit.deSerializeFMUstate
    return unit.getFMUState, unit.setFMUState, unit.serializeFMUState, unit.deserializeFMUState


def begin(one: Any, start: float = 0.0) -> None:
    if one.old:
        one.unit.setupExperiment(startTime=start)
        one.unit.enterInitializationMode()
    else:
        one.unit.enterInitializationMode(startTime=start)
    one.unit.exitInitializationMode()


@VERSIONS
@pytest.mark.parametrize("text", [CHOICES, DOSED])
def test_values_and_derivatives(text: str, version: Version, tmp_path: Path) -> None:
    """States, channels and learned functions and their directional derivatives at points, to rounding."""
    subject = exported(model_of(text))
    path = unit(subject, version, tmp_path)
    assert problems(path) == []
    one, model, points = opened(path), subject.model, draw(subject, 4)
    known = Reference(subject, Programs(model), points)
    begin(one)
    given = [*(s.name for s in model.states), *(c.name for c in model.conditions), *(i.name for i in model.inputs)]
    given += model.constant_names
    rates = [one.refs[f"der({s.name})"] for s in model.states]
    knowns = [one.refs[name] for name in given]
    for i, (t, *parts) in enumerate(zip(*points.arguments, strict=True)):
        one.unit.setTime(t)
        one.put(knowns, np.concatenate(parts).tolist())
        sizes = known.rhs[1][i]
        assert np.abs(np.array(one.get(rates)) - known.rhs[0][i]) == pytest.approx(0 * sizes, abs=1e-13 * sizes.max())
        channels = [one.refs[channel.name] for channel in model.channels]
        assert one.get(channels) == pytest.approx(known.observe[0][i], rel=1e-13, abs=1e-13)
        seed = np.concatenate([part[i] for part in points.along[1:]])
        time = one.refs[model.time.name]
        found = one.unit.getDirectionalDerivative(
            [*rates, *channels], [*knowns, time], [*seed.tolist(), float(points.along[0][i])]
        )
        expected = np.concatenate([known.rhs_along[0][i], known.observe_along[0][i]])
        terms = np.concatenate([known.rhs_along[1][i], known.observe_along[1][i]])
        assert (np.abs(np.array(found) - expected) <= 1e-13 * terms).all()
    one.unit.terminate()
    one.unit.freeInstance()


@VERSIONS
@pytest.mark.parametrize(
    "name", ["alpha_pinene", "fed_batch", "friction_oscillator", "spreading_population", "urp_gb2"]
)
def test_bundled_models_are_valid_and_solved_by_cvode(name: str, version: Version, tmp_path: Path) -> None:
    subject = exported(load_model(shipped_models()[name], Findings()))
    path = unit(subject, version, tmp_path)
    assert problems(path) == []
    options = {"stop_time": 0.5, "output_interval": 0.1, "solver": "CVode", "relative_tolerance": 1e-11}
    outputs = [state.name for state in subject.model.states]
    found = fmpy.simulate_fmu(str(path), fmi_type="ModelExchange", output=outputs, **options)
    evaluator = Evaluator(subject.instance)
    x0 = evaluator.initial(subject.states, subject.conditions)
    inputs = tuple(Signal(np.zeros(1), np.array([value])) for value in subject.inputs)
    doses = tuple(DoseEvents(np.zeros(0), np.zeros(0)) for _ in subject.model.doses)
    known = evaluator.integrate(x0, found["time"], subject.conditions, inputs, 0.0, doses=doses)
    states = np.stack([found[name] for name in outputs], axis=1)
    assert np.abs(states - known).max() <= 1e-7 * np.abs(known).max()
    steps = fmpy.simulate_fmu(str(path), fmi_type="CoSimulation", output=outputs, **options)
    fixed = evaluator.integrate_fixed(
        x0, steps["time"], subject.conditions, inputs, 0.0, max_step=subject.step or 1.0, doses=doses
    )
    states = np.stack([steps[name] for name in outputs], axis=1)
    assert np.abs(states - fixed).max() <= 1e-12 * np.abs(fixed).max()


@VERSIONS
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_doses_arrive_at_their_times(kind: str, version: Version, tmp_path: Path) -> None:
    """A regimen of three doses with a lag that is a parameter, and one into another state at the start."""
    subject = exported(model_of(DOSED))
    path = unit(subject, version, tmp_path)
    start = {"dose_depot.amount": 2.0, "dose_depot.first": 0.1, "dose_depot.interval": 0.3, "dose_depot.number": 3.0}
    start |= {"late": 0.043, "dose_central.amount": 0.5, "dose_central.first": 0.0, "central": 0.7}
    outputs = ["depot", "central"]
    found = fmpy.simulate_fmu(
        str(path), fmi_type=kind, output=outputs, start_values=start, stop_time=1.0, output_interval=0.25,
        solver="CVode", relative_tolerance=1e-11, record_events=False,
    )  # fmt: skip
    evaluator = Evaluator(subject.instance)
    constants = np.array([*subject.constants[:-1], 0.043])
    x0 = evaluator.initial([0.0, 0.7], subject.conditions, constants)
    doses = (DoseEvents(np.array([0.1, 0.4, 0.7]), np.full(3, 2.0)), DoseEvents(np.zeros(1), np.array([0.5])))
    times = np.unique(found["time"])
    given = {"doses": doses, "constants": constants}
    if kind == "ModelExchange":
        known = evaluator.integrate(x0, times, subject.conditions, (), 0.0, **given)
    else:
        known = evaluator.integrate_fixed(x0, times, subject.conditions, (), 0.0, max_step=0.01, **given)
    states = np.stack([found[name] for name in outputs], axis=1)[1:]  # at the start: after its dose
    assert np.abs(states - known[1:]).max() <= (1e-7 if kind == "ModelExchange" else 1e-12) * np.abs(known).max()


@VERSIONS
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_events_happen(kind: str, version: Version, tmp_path: Path) -> None:
    """Thresholds, resets, what events cause, priorities, timed and armed events, a dose that crosses a threshold."""
    subject = exported(model_of(HAPPENING))
    path = unit(subject, version, tmp_path)
    assert problems(path) == []
    start = {"dose_S.amount": 1.1, "dose_S.first": 1.55, "dose_S.number": 1.0, "solver.step": 0.002}
    outputs = ["S", "v", "h", "on", "n"]
    found = fmpy.simulate_fmu(
        str(path), fmi_type=kind, output=outputs, start_values=start, stop_time=3.4, output_interval=0.2,
        solver="CVode", relative_tolerance=1e-11, record_events=False,
    )  # fmt: skip
    doses = (DoseEvents(np.array([1.55]), np.array([1.1])),)
    evaluator = Evaluator(subject.instance)
    inputs = tuple(Signal(np.zeros(1), np.array([value])) for value in subject.inputs)
    times = np.unique(found["time"])
    known = evaluator.integrate(evaluator.initial(subject.states), times, (), inputs, 0.0, doses=doses)
    states = np.stack([found[name] for name in outputs], axis=1)
    assert known[-1, 4] > 120, "the events happened"
    assert np.abs(states[1:] - known[1:]).max() <= 1e-7 * np.abs(known[:, :3]).max()


@VERSIONS
@pytest.mark.parametrize("name", ["bouncing_ball", "overflowing_tanks", "thermostat"])
def test_bundled_models_with_events(name: str, version: Version, tmp_path: Path) -> None:
    subject = exported(load_model(shipped_models()[name], Findings()))
    path = unit(subject, version, tmp_path)
    assert problems(path) == []
    outputs = [state.name for state in subject.model.states]
    evaluator = Evaluator(subject.instance)
    x0 = evaluator.initial(subject.states, subject.conditions)
    inputs = tuple(Signal(np.zeros(1), np.array([value])) for value in subject.inputs)
    for kind in ("ModelExchange", "CoSimulation"):
        found = fmpy.simulate_fmu(
            str(path), fmi_type=kind, output=outputs, start_values={"solver.step": 0.01}, stop_time=3.0,
            output_interval=0.5, solver="CVode", relative_tolerance=1e-11, record_events=False,
        )  # fmt: skip
        known = evaluator.integrate(x0, found["time"], subject.conditions, inputs, 0.0)
        states = np.stack([found[name] for name in outputs], axis=1)
        assert np.abs(states - known).max() <= 1e-7 * np.abs(known).max(), kind


@VERSIONS
def test_units_are_those_of_the_si(version: Version, tmp_path: Path) -> None:
    text = "model units\ntime t : h\nunit cells\nstate x : mg/L\nstate n : cells\nlearn k : 1/h = 0.3 in [0, 5]\n"
    path = unit(exported(model_of(text + "x' = -k*x\nn' = -k*n\nobserve x\nobserve n\n")), version, tmp_path)
    assert problems(path) == []
    named = {u.name: u.baseUnit for u in fmpy.read_model_description(str(path)).unitDefinitions}
    assert (named["h"].s, named["h"].factor) == (1, 3600.0)
    assert (named["mg/L"].kg, named["mg/L"].m) == (1, -3) and named["mg/L"].factor == pytest.approx(1e-3)
    assert named["1/h"].factor == pytest.approx(1 / 3600) and named["cells"] is None
    assert named["mg/L/h"].s == -1


@VERSIONS
@pytest.mark.parametrize("text", [SWITCHED, REPEATED])
def test_solvers_stop_where_choices_change(text: str, version: Version, tmp_path: Path) -> None:
    subject = exported(model_of(text))
    found = fmpy.simulate_fmu(
        str(unit(subject, version, tmp_path)), fmi_type="ModelExchange", output=["x", "y"], stop_time=3.0,
        output_interval=0.5, solver="CVode", relative_tolerance=1e-11, record_events=False,
    )  # fmt: skip
    known = Evaluator(subject.instance).integrate(subject.states, found["time"])
    assert np.abs(np.stack([found["x"], found["y"]], axis=1) - known).max() < 1e-7


def test_a_unit_has_no_memory_errors(tmp_path: Path) -> None:
    """A small importing program under the sanitizers."""
    made = make("2", exported(model_of(DOSED)), ExportOptions(verify=False))
    sources = {name.removeprefix("sources/"): data for name, data in made.files.items() if name.startswith("sources/")}
    for name, data in {**sources, "host.c": HOST.encode()}.items():
        (tmp_path / name).write_bytes(data)
    token = ElementTree.fromstring(made.files["modelDescription.xml"]).get("guid")
    command = [str(COMPILER), "-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command += [f'-DTOKEN="{token}"', *sorted(name for name in (*sources, "host.c") if name.endswith(".c"))]
    done = subprocess.run([*command, "-lm", "-o", "host"], cwd=tmp_path, capture_output=True, text=True, check=False)
    if "sanitize" in done.stderr or "asan" in done.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert done.returncode == 0, done.stderr
    said = subprocess.run([tmp_path / "host"], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stderr) == (0, "")


HOST = r"""
#include "fmi2Functions.h"
#include <stdlib.h>

int main(void) {
    fmi2ValueReference all[64], known = 1, unknown = 3;
    fmi2Real value[64], seed = 1.0, slope, x[2], amount = 2.0;
    fmi2FMUstate state = NULL, other = NULL;
    fmi2EventInfo info;
    size_t size, i, n;
    fmi2Byte *bytes;
    fmi2Component c = fmi2Instantiate("one", fmi2CoSimulation, TOKEN, NULL, NULL, 0, 0);
    if (!c || fmi2Instantiate("two", fmi2CoSimulation, "another", NULL, NULL, 0, 0)) return 1;
    for (n = 0; n < 64; n++) {
        all[n] = (fmi2ValueReference)n;
        if (fmi2GetReal(c, &all[n], 1, &value[n])) break;
    }
    if (n < 10 || n == 64) return 2;
    fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0);
    fmi2EnterInitializationMode(c);
    for (i = 5; i < n; i++) /* the amount of a dose is among what can be set */
        fmi2SetReal(c, &all[i], 1, i == 9 ? &amount : &value[i]);
    fmi2ExitInitializationMode(c);
    if (fmi2GetFMUstate(c, &state) || fmi2SerializedFMUstateSize(c, state, &size)) return 3;
    bytes = malloc(size);
    if (fmi2SerializeFMUstate(c, state, bytes, size) || fmi2DeSerializeFMUstate(c, bytes, size, &other)) return 4;
    if (fmi2NewDiscreteStates(c, &info) || fmi2DoStep(c, 0.0, 0.1, 1) || fmi2GetContinuousStates(c, x, 2)) return 5;
    if (fmi2GetDirectionalDerivative(c, &unknown, 1, &known, 1, &seed, &slope)) return 6;
    fmi2SetFMUstate(c, other);
    fmi2FreeFMUstate(c, &state);
    fmi2FreeFMUstate(c, &other);
    free(bytes);
    fmi2Reset(c);
    fmi2FreeInstance(c);
    return 0;
}
"""


def test_inputs_between_communication_points(tmp_path: Path) -> None:
    """With their derivatives, which FMI 2.0 has, inputs are linear within a step."""
    subject = exported(model_of(CHOICES))
    one = opened(unit(subject, "2", tmp_path), "cs")
    begin(one)
    one.put([one.refs["u"], one.refs["w"]], [0.3, 0.2])
    one.unit.setRealInputDerivatives([one.refs["w"]], [1], [0.5])
    one.unit.doStep(0.0, 0.2)
    evaluator = Evaluator(subject.instance)
    inputs = (Signal(np.zeros(1), np.array([0.3])), Signal(np.array([0.0, 1.0]), np.array([0.2, 0.7])))
    known = evaluator.integrate_fixed(
        subject.states, [0.0, 0.2], subject.conditions, inputs, 0.0, max_step=subject.step or 1.0
    )[-1]
    assert one.get([one.refs["x"], one.refs["y"], one.refs["w"]]) == pytest.approx([*known, 0.3], rel=1e-13)


@VERSIONS
def test_the_state_of_a_unit_is_kept_and_written(version: Version, tmp_path: Path) -> None:
    one = opened(unit(exported(model_of(DOSED)), version, tmp_path), "cs")
    one.put([one.refs["dose_depot.amount"], one.refs["dose_depot.first"]], [1.0, 0.15])
    begin(one)
    refs = [one.refs["depot"], one.refs["central"]]
    one.unit.doStep(0.0, 0.1)
    get, put, write, read = of_its_state(one)
    kept = get()
    written = write(kept)
    one.unit.doStep(0.1, 0.1)
    after = one.get(refs)
    put(kept)
    one.unit.doStep(0.1, 0.1)
    assert one.get(refs) == after
    put(read(written))
    one.unit.doStep(0.1, 0.1)
    assert one.get(refs) == after


@VERSIONS
def test_where_a_function_is_asked_outside(version: Version, tmp_path: Path) -> None:
    one = opened(unit(exported(model_of(CHOICES)), version, tmp_path))
    begin(one)
    said = one.unit.getBoolean
    for x, w, outside in ((0.3, 0.4, False), (0.1, 0.4, True), (0.3, 0.7, True)):
        one.put([one.refs["x"], one.refs["w"]], [x, w])
        assert bool(said([one.refs["outside"]])[0]) is outside


@VERSIONS
def test_the_description_says_what_depends_on_what(version: Version, tmp_path: Path) -> None:
    path = unit(exported(model_of(CHOICES)), version, tmp_path)
    with zipfile.ZipFile(path) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        assert b"model choices" in archive.read("resources/model.gb")
        assert {"sources/fmi2Functions.h", "sources/buildDescription.xml"} & set(archive.namelist())
    variables = list(root.find("ModelVariables"))  # type: ignore[arg-type]
    names = {v.get("valueReference") if version == "3" else str(i + 1): v.get("name") for i, v in enumerate(variables)}
    structure = root.find("ModelStructure")
    assert structure is not None
    key = "index" if version == "2" else "valueReference"
    entries = structure.iterfind("Outputs/Unknown" if version == "2" else "Output")
    found = {names[e.get(key)]: {names[d] for d in (e.get("dependencies") or "").split()} for e in entries}
    assert found == {"x": {"x"}, "z": {"x", "y", "w"}, "outside": {"x", "w"}}
    assert {v.get("name") for v in variables} >= {"phi", "lambda", "a", "k", "der(x)", "switch[1]", "t"}


def test_fmpy_compiles_the_sources(tmp_path: Path) -> None:
    path = unit(exported(model_of(DOSED)), "3", tmp_path)
    with zipfile.ZipFile(path) as archive:
        named = ElementTree.fromstring(archive.read("sources/buildDescription.xml"))
        for entry in named.iter("SourceFile"):
            assert f"sources/{entry.get('name')}" in archive.namelist()


def test_without_a_compiler_there_are_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> str:
        raise CompilerError("there is no C compiler (cc, gcc, clang)")

    monkeypatch.setattr("gbspec.exports.compiling.find_compiler", none)
    findings = Findings()
    subject = models.subject("methanol", {}, findings)
    made = exporting.export(subject, tmp_path / "x.fmu", "fmu3", ExportOptions(), findings)
    assert {found.code for found in findings} == {"GB882", "GB883"}
    assert not any(name.startswith("binaries") for name in made.files)


def test_compilers_for_other_platforms_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that works adds a binary; one that fails does not stop the export."""
    find_compiler()  # which remembers it
    found = {"x86_64-w64-mingw32-gcc": str(COMPILER), "aarch64-linux-gnu-gcc": "/nowhere/gcc"}  # fails
    monkeypatch.setattr("gbspec.exports.fmi.unit.shutil.which", found.get)
    made = make("3", exported(model_of(SWITCHED)), ExportOptions(verify=False))
    assert "binaries/x86_64-windows/switched.dll" in made.files
    assert not any("aarch64-linux" in name for name in made.files)
    assert not made.remarks


@pytest.mark.parametrize("form", ["fmu", "fmu2", "fmu3"])
def test_units_are_small_and_equal_ones_equal(form: str, tmp_path: Path) -> None:
    findings = Findings()
    subject = models.subject("lotka_volterra", {}, findings)
    for name in ("one", "two"):
        made = exporting.export(subject, tmp_path / name, form, ExportOptions(verify=False), findings)
        assert made.size < 200_000
    with zipfile.ZipFile(tmp_path / "one") as one, zipfile.ZipFile(tmp_path / "two") as two:
        assert one.read("modelDescription.xml") == two.read("modelDescription.xml")
