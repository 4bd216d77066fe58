"""Delays in C libraries, functional mock-up units and graphs: the past is kept as the generated module keeps it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from gbspec.backends import Evaluator, NotCoveredError
from gbspec.data import DoseEvents, Signal
from gbspec.diagnostics import Findings
from gbspec.exports import ExportOptions
from gbspec.exports.c import Library
from gbspec.exports.c.delays import room
from gbspec.exports.checking import Course, Reference, own
from gbspec.exports.fmi.unit import make
from gbspec.exports.onnx import make as make_onnx
from gbspec.frontend import load_model
from gbspec.operations import models
from tests.delays.models import EVERYTHING, MACKEY_GLASS
from tests.exports.test_c import COMPILER, agree, library_of, simulated_by_c
from tests.exports.test_fmu import QUICK, VERSIONS, Version, begin, fmpy, of_its_state, opened, problems, unit
from tests.exports.texts import exported, model_of

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
SHORT = MACKEY_GLASS.replace("tau = 12 in [5, 40]", "tau = 0.35 in [0.1, 4]")
HELD = """model held_late
time t from 0
state x in [0, 3] = 1
input F held
learn tau = 0.4 in [0.1, 2]
x' = delay(F, tau) - 0.5*x*delay(x, 2*tau)
dose x
observe x
observe late = x + delay(F, tau)
"""
"""A delayed input that jumps, and two delays."""
TEXTS = pytest.mark.parametrize("text", [SHORT, EVERYTHING, HELD])


@pytest.fixture(autouse=True)
def _quick_compilation(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("gbspec.exports.fmi.unit.FLAGS", QUICK)
    yield


def inputs_of(subject: Any) -> tuple[Signal, ...]:
    return tuple(Signal(np.array([0.0, 0.63, 1.4]), np.array([0.3, 0.8, 0.1])) for _ in subject.model.inputs)


@pytest.mark.parametrize("text", [MACKEY_GLASS, EVERYTHING, HELD])
def test_functions_and_short_courses_agree(text: str, tmp_path: Path) -> None:
    agree(exported(model_of(text)), tmp_path)


@TEXTS
def test_a_course_over_many_delays(text: str, tmp_path: Path) -> None:
    """With changes of inputs and doses, whose jumps show again: the module's steps, near the exact solution."""
    subject = exported(model_of(text))
    compiled, points = library_of(subject, tmp_path), own(subject)
    doses = tuple(DoseEvents(np.array([0.0, 0.7]), np.array([0.2, 0.3])) for _ in subject.model.doses)
    course = Course(0.0, np.array([0.0, 0.31, 0.7, 1.0, 1.7, 2.9, 3.0]), inputs_of(subject), doses, 0.01)
    known = Reference(subject, compiled.library.programs, points)
    states, late = known.trajectory(course)
    found, channels = compiled.simulate(points, course)
    assert np.abs(found - states).max() <= 1e-13 * np.abs(states).max()
    assert channels == pytest.approx(known.channels(course, states, late), rel=1e-12, abs=1e-12)
    exact = known.evaluator.integrate(
        known.evaluator.initial(points.x[0], points.condition[0]),
        course.times,
        points.condition[0],
        course.inputs,
        0.0,
        doses=doses,
        constants=points.constants[0],
    )
    assert np.abs(found - exact).max() <= 1e-7


def test_the_program_simulates_as_the_command_does(tmp_path: Path) -> None:
    simulated_by_c(models.subject("haematopoiesis", {}, Findings()), tmp_path / "library")
    path = tmp_path / "brief.gb"
    path.write_text(SHORT.replace("mackey_glass", "brief").replace("truth tau = 17", "truth tau = 0.6"))
    simulated_by_c(models.subject(path, {}, Findings()), tmp_path / "other")


def test_a_past_without_room_is_told(tmp_path: Path) -> None:
    subject = exported(model_of(SHORT))
    library = Library(subject)
    for name, text in ((f"{library.prefix}.h", library.header()), (f"{library.prefix}.c", library.source())):
        (tmp_path / name).write_text(text)
    main = f"""#include "{library.prefix}.h"
int main(void) {{
    static {library.prefix}_past past;
    static const double times[1] = {{2.0}};
    double x0[1] = {{0.5}}, states[1];
    {library.prefix}_parameters p;
    {library.prefix}_defaults(&p);
    if ({library.prefix}_simulate(&p, 0.0, x0, NULL, NULL, 1, times, 0.01, states, NULL, &past)) return 4;
    printf("%.17g", states[0]);
    return 0;
}}
"""
    (tmp_path / "main.c").write_text("#include <stddef.h>\n#include <stdio.h>\n" + main)
    for pieces, status in ((20, 4), (40, 0)):  # a delay takes 35 steps
        command = [
            str(COMPILER),
            "-std=c99",
            f"-D{library.names.upper}_PIECES={pieces}",
            f"{library.prefix}.c",
            "main.c",
        ]
        subprocess.run([*command, "-lm", "-o", "main"], cwd=tmp_path, check=True)
        done = subprocess.run([tmp_path / "main"], check=False, capture_output=True, text=True)
        assert done.returncode == status
    known = Evaluator(subject.instance).integrate_fixed([0.5], [2.0], (), (), 0.0, max_step=0.01)
    assert float(done.stdout) == pytest.approx(known[0, 0], rel=1e-13)


def test_a_delay_of_too_many_steps_is_refused() -> None:
    subject = exported(model_of(MACKEY_GLASS.replace("[5, 40]", "[5, 4000]")))
    with pytest.raises(NotCoveredError, match=r"longest delay may be 4e\+03, which is more than 100000 steps"):
        Library(subject).header()
    free = exported(
        model_of(
            MACKEY_GLASS.replace("learn tau = 12 in [5, 40]", "condition tau = 12").replace("truth tau = 17\n", "")
        )
    )
    assert room(free, Library(free).programs) == 4 * 12 / 0.005 + 1024
    unbounded = exported(model_of(MACKEY_GLASS.replace("in [5, 40]", "> 1")))
    assert room(unbounded, Library(unbounded).programs) == 4 * 12 / 0.005 + 1024


@VERSIONS
@TEXTS
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_units_follow_the_module(kind: str, text: str, version: Version, tmp_path: Path) -> None:
    """Over many delays, with doses and an input that changes at communication points."""
    subject = exported(model_of(text))
    path = unit(subject, version, tmp_path)
    assert problems(path) == [] and path.stat().st_size < 200_000
    names = [state.name for state in subject.model.states]
    start = {"solver.step": 0.01}
    for dose in subject.model.doses:
        start |= {f"dose_{dose.state}.amount": 0.3, f"dose_{dose.state}.first": 0.71}
    doses = tuple(DoseEvents(np.array([0.71]), np.array([0.3])) for _ in subject.model.doses)
    held = tuple(Signal(np.array([0.0, 0.6, 1.4]), np.array([0.3, 0.8, 0.1])) for _ in subject.model.inputs)
    given = None
    if subject.model.inputs and subject.model.inputs[0].interpolation == "held":
        rows = [(0.0, 0.3), (0.6, 0.3), (0.6, 0.8), (1.4, 0.8), (1.4, 0.1), (3.0, 0.1)]
        given = np.array(rows, dtype=[("time", np.float64), ("F", np.float64)])
    elif subject.model.inputs:
        held, start["F"] = (Signal(np.zeros(1), np.array([0.3])),), 0.3
    found = fmpy.simulate_fmu(
        str(path), fmi_type=kind, output=names, solver="CVode", relative_tolerance=1e-11, stop_time=3.0,
        output_interval=0.05, record_events=False, start_values=start, input=given,
    )  # fmt: skip
    evaluator = Evaluator(subject.instance)
    x0 = evaluator.initial(subject.states, subject.conditions)
    at = (x0, found["time"], subject.conditions, held, 0.0)
    if kind == "ModelExchange":
        known, accepted = evaluator.integrate(*at, doses=doses), 1e-7
    else:
        known, accepted = evaluator.integrate_fixed(*at, max_step=0.01, doses=doses), 1e-12
    states = np.stack([found[name] for name in names], axis=1)
    assert np.abs(states - known).max() <= accepted * np.abs(known).max()


@VERSIONS
@pytest.mark.parametrize("text", [MACKEY_GLASS, EVERYTHING, HELD])
def test_values_and_derivatives_of_units(text: str, version: Version) -> None:
    """At a start, where delayed values come from the history: by the comparison that the command makes itself."""
    made = make(version, exported(model_of(text)), ExportOptions())
    assert max(q.error for q in made.checked) < 1e-13 and len(made.checked) > 8


@VERSIONS
def test_derivatives_within_the_past(version: Version, tmp_path: Path) -> None:
    """By a delay, by the time and by constants, where delayed values are those of steps: against differences."""
    one = opened(unit(exported(model_of(EVERYTHING)), version, tmp_path), "cs")
    one.put([one.refs["solver.step"], one.refs["tau"], one.refs["F"]], [0.01, 0.53, 0.4])
    begin(one)
    for k in range(12):
        one.unit.doStep(0.1 * k, 0.1)
    asked = [one.refs["der(x)"], one.refs["der(y)"], one.refs["z"]]
    for name in ("tau", "r", "c", "k", "x"):
        ref = one.refs[name]
        (exact,) = (np.array(one.unit.getDirectionalDerivative(asked, [ref], [1.0])),)
        (value,) = one.get([ref])
        sides = []
        for change in (1e-6, -1e-6):
            one.put([ref], [value + change])
            sides.append(np.array(one.get(asked)))
        one.put([ref], [value])
        assert exact == pytest.approx((sides[0] - sides[1]) / 2e-6, rel=2e-6, abs=1e-8), name
        assert np.abs(exact).max() > 1e-3, name


@VERSIONS
def test_the_past_is_kept_with_the_state(version: Version, tmp_path: Path) -> None:
    one = opened(unit(exported(model_of(HELD)), version, tmp_path), "cs")
    one.put([one.refs["solver.step"], one.refs["F"]], [0.01, 0.4])
    begin(one)
    one.unit.doStep(0.0, 0.5)
    get, put, write, read = of_its_state(one)
    kept = get()
    written = write(kept)

    def later(flow: float) -> list[float]:
        one.put([one.refs["F"]], [flow])
        for k in range(5):
            one.unit.doStep(0.5 + 0.1 * k, 0.1)
        return list(one.get([one.refs["x"], one.refs["late"]]))

    first = later(0.9)
    put(kept)
    assert later(0.2) != first
    put(read(written))
    assert later(0.9) == first


HOST = r"""
#include "fmi2Functions.h"
#include <stdlib.h>

int main(void) {
    fmi2ValueReference der = 2, state = 1, known = 3;
    fmi2Real value, seed = 1.0, slope, x;
    fmi2FMUstate kept = NULL;
    fmi2EventInfo info;
    fmi2Boolean event, end;
    int k;
    fmi2Component c = fmi2Instantiate("one", fmi2CoSimulation, TOKEN, NULL, NULL, 0, 0);
    if (!c || fmi2GetReal(c, &der, 1, &value)) return 1;
    fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0);
    fmi2EnterInitializationMode(c);
    if (fmi2GetDirectionalDerivative(c, &der, 1, &known, 1, &seed, &slope)) return 2;
    fmi2ExitInitializationMode(c);
    for (k = 0; k < 400; k++) {
        if (fmi2DoStep(c, 0.01 * k, 0.01, 1)) return 3;
        if (k == 200 && fmi2GetFMUstate(c, &kept)) return 4;
    }
    if (fmi2SetFMUstate(c, kept)) return 5;
    for (k = 201; k < 300; k++) { /* model exchange by Euler's method */
        if (fmi2SetTime(c, 0.01 * k + 0.01) || fmi2GetDerivatives(c, &value, 1)) return 6;
        if (fmi2GetContinuousStates(c, &x, 1)) return 7;
        x += 0.01 * value;
        if (fmi2SetContinuousStates(c, &x, 1) || fmi2CompletedIntegratorStep(c, 1, &event, &end)) return 8;
        if (k % 7 == 0 && fmi2NewDiscreteStates(c, &info)) return 9;
    }
    if (fmi2GetReal(c, &state, 1, &x) || x != x) return 10;
    if (fmi2GetDirectionalDerivative(c, &der, 1, &known, 1, &seed, &slope) || slope != slope) return 11;
    fmi2FreeFMUstate(c, &kept);
    fmi2FreeInstance(c);
    return 0;
}
"""


def test_a_unit_with_a_past_has_no_memory_errors(tmp_path: Path) -> None:
    made = make("2", exported(model_of(HELD)), ExportOptions(verify=False))
    sources = {name.removeprefix("sources/"): data for name, data in made.files.items() if name.startswith("sources/")}
    for name, data in {**sources, "host.c": HOST.encode()}.items():
        (tmp_path / name).write_bytes(data)
    token = ElementTree.fromstring(made.files["modelDescription.xml"]).get("guid")
    command = [str(COMPILER), "-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    command += [f'-DTOKEN="{token}"', "-DHELD_LATE_PIECES=200"]  # the ring goes round
    command += sorted(name for name in (*sources, "host.c") if name.endswith(".c"))
    done = subprocess.run([*command, "-lm", "-o", "host"], cwd=tmp_path, capture_output=True, text=True, check=False)
    if "sanitize" in done.stderr or "asan" in done.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert done.returncode == 0, done.stderr
    said = subprocess.run([tmp_path / "host"], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stderr) == (0, "")


@VERSIONS
def test_delayed_values_depend_on_the_time(version: Version) -> None:
    made = make(version, exported(model_of(HELD)), ExportOptions(verify=False))
    root = ElementTree.fromstring(made.files["modelDescription.xml"])
    variables = list(root.find("ModelVariables"))  # type: ignore[arg-type]
    names = {v.get("valueReference") if version == "3" else str(i + 1): v.get("name") for i, v in enumerate(variables)}
    path = "ModelStructure/Derivatives/Unknown" if version == "2" else "ModelStructure/ContinuousStateDerivative"
    (entry,) = root.iterfind(path)
    assert {names[d] for d in (entry.get("dependencies") or "").split()} == {"x", "t"}
    (exchange,) = root.iterfind("ModelExchange")
    assert version == "2" or exchange.get("needsCompletedIntegratorStep") == "true"


def test_graphs_take_delayed_values(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    subject = exported(model_of(EVERYTHING))
    made = make_onnx(subject, ExportOptions())
    assert {"delayed.onnx", "lags.onnx", "rhs.onnx"} <= set(made.files)
    assert max(quantity.error for quantity in made.checked) < 1e-12
    graph = onnx.load_from_string(made.files["rhs.onnx"]).graph
    (inputs,) = (one for one in graph.input if one.name == "inputs")
    assert inputs.type.tensor_type.shape.dim[1].dim_value == 1 + len(subject.model.delays)


def test_the_bundled_model_is_a_small_unit(tmp_path: Path) -> None:
    subject = exported(load_model("haematopoiesis", Findings()))
    for version in ("2", "3"):
        path = unit(subject, version, tmp_path)
        assert problems(path) == [] and path.stat().st_size < 200_000
