"""import of PEtab 2: experiments with several periods, against a closed form, and cases of the suite."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

import gbspec
from gbspec.diagnostics import UserError
from gbspec.operations.importing import import_file
from tests.imports import models as made
from tests.imports.suites import suite

pytest.importorskip("libsbml", reason="SBML needs the extra `sbml`")
pytest.importorskip("yaml", reason="PEtab needs the extra `sbml`")
pytestmark = pytest.mark.usefixtures("quick_fits")

YAML = """\
format_version: 2.0.0
parameter_files: [parameters.tsv]
model_files: {one: {language: sbml, location: made.xml}}
condition_files: [conditions.tsv]
experiment_files: [experiments.tsv]
measurement_files: [measurements.tsv]
observable_files: [observables.tsv]
"""
TABLES = {
    "conditions": "conditionId\ttargetId\ttargetValue\na\tk\tslow\nb\tk\t2*fast\nb\ty\ty + 1\nc\tk\tfast\n",
    "experiments": "experimentId\ttime\tconditionId\none\t0\ta\none\t2\tb\ntwo\t1\tc\n",
    "measurements": (
        "observableId\texperimentId\ttime\tmeasurement\tobservableParameters\tnoiseParameters\n"
        "o\tone\t1\t0.7\t1\tsigma\no\tone\t2\t1.5\t1\tsigma\no\tone\t3\t0.2\t1\tsigma\np\ttwo\t2\t0.3\t2\t\n"
    ),
    "observables": "observableId\tobservableFormula\tnoiseFormula\tnoiseDistribution\tobservablePlaceholders\t"
    "noisePlaceholders\no\tscale*y\tsd\tnormal\tscale\tsd\np\tscale*y\t0.4\tlog-normal\tscale\t\n",
    "parameters": "parameterId\tlowerBound\tupperBound\tnominalValue\testimate\tpriorDistribution\tpriorParameters\n"
    "slow\t0\t5\t0.4\ttrue\tnormal\t1;2\nfast\t0\t5\t0.9\ttrue\tcauchy\t1;2\nsigma\t0.01\t2\t0.6\tfalse\t\t\n",
}


def problem(folder: Path, **changed: str) -> Path:
    """y' = -k y from 1."""
    decay = made.sbml(
        made.parameters("false", y="1", k="1"), made.rules(y=made.apply("minus", made.apply("times", "k", "y")))
    )
    made.stored(folder, decay)
    for name, text in {**TABLES, **changed}.items():
        (folder / f"{name}.tsv").write_text(text)
    (folder / "problem.yaml").write_text(changed.get("problem", YAML))
    return folder / "problem.yaml"


def closed(slow: float, fast: float) -> float:
    """The negative log likelihood; a measurement at the time of a change is of the values after it."""
    after = math.exp(-2 * slow) + 1
    total = 0.0
    for value, y in ((math.exp(-slow), 0.7), (after, 1.5), (after * math.exp(-2 * fast), 0.2)):
        sd = 0.6
        total += 0.5 * math.log(2 * math.pi * sd**2) + 0.5 * ((value - y) / sd) ** 2
    residual = (math.log(0.3) - math.log(2 * math.exp(-fast))) / 0.4
    return total + 0.5 * math.log(2 * math.pi * (0.4 * 0.3) ** 2) + 0.5 * residual**2


def test_periods_of_experiments(tmp_path: Path) -> None:
    found = import_file(problem(tmp_path), tmp_path / "out")
    assert found.data is not None
    assert "event switch_1 at switch_1_time" in Path(found.model).read_text()
    assert any("cauchy" in one.reason for one in found.left_out)
    assert found.options == {"forcing": "autoregressive"}
    result = gbspec.evaluate(found.model, found.data)
    assert result.nllh == pytest.approx(closed(0.4, 0.9), rel=1e-7)
    h = 1e-5
    slope = (closed(0.4 + h, 0.9) - closed(0.4 - h, 0.9)) / (2 * h)
    assert result.gradient["slow"] == pytest.approx(slope, rel=1e-5)


def test_a_steady_state_before_the_first_period(tmp_path: Path) -> None:
    """y rests at 0 by `slow`; then it is 1 and falls by `2 fast`, and from 2 on by `fast`."""
    experiments = "experimentId\ttime\tconditionId\none\t-inf\ta\none\t0\tb\none\t2\tc\ntwo\t1\tc\n"
    found = import_file(problem(tmp_path, experiments=experiments), tmp_path / "out")
    assert found.data is not None
    values = [one.value for one in gbspec.evaluate(found.model, found.data).found.simulation]
    expected = [math.exp(-1.8), math.exp(-3.6), math.exp(-4.5), 2 * math.exp(-0.9)]
    assert sorted(values) == pytest.approx(sorted(expected), rel=1e-6)


def test_a_trigger_that_a_condition_changes_after_a_steady_state_is_refused(tmp_path: Path) -> None:
    """Whether it becomes true when the state is set is not said."""
    experiments = "experimentId\ttime\tconditionId\none\t-inf\ta\none\t0\tb\n"
    one = "\n".join(TABLES["measurements"].splitlines()[:2]) + "\n"
    path = problem(tmp_path, experiments=experiments, measurements=one)
    refill = made.event("refill", made.apply("lt", "y", "0.5"), {"y": "<cn>1</cn>"})
    decay = made.sbml(
        made.parameters("false", y="1", k="1"),
        made.rules(y=made.apply("minus", made.apply("times", "k", "y"))),
        made.happening(refill),
    )
    made.stored(tmp_path, decay)
    with pytest.raises(UserError, match="what changes after the steady state"):
        import_file(path, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("experiments", TABLES["experiments"].replace("\tc\n", "\tnone\n"), "no table has the condition `none`"),
        ("problem", YAML.replace("sbml,", "pysb,"), "SBML is offered"),
        ("problem", YAML.replace("2.0.0", "3.0.0"), "PEtab 3.0.0 is not offered"),
        ("problem", YAML + "extensions: {other: {}}\n", "the extension `other` is not offered"),
    ],
)
def test_what_has_no_form_is_refused(tmp_path: Path, name: str, text: str, reason: str) -> None:
    with pytest.raises(UserError) as raised:
        import_file(problem(tmp_path, **{name: text}), tmp_path / "out")
    assert any(reason in one.message for one in raised.value.diagnostics), raised.value


@pytest.mark.parametrize("case", ["0007", "0009", "0017", "0023", "0029", "0031"])
def test_cases_of_the_suite(case: str) -> None:
    from benchmarks.studies.petab import judged

    assert judged(suite("petab") / "v2" / case).end == "passed"
