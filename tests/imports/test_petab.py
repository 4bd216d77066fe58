"""import of PEtab: small problems with closed forms, and cases of the PEtab test suite."""

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
format_version: 1
parameter_file: parameters.tsv
problems:
- condition_files: [conditions.tsv]
  measurement_files: [measurements.tsv]
  observable_files: [observables.tsv]
  sbml_files: [made.xml]
"""
TABLES = {
    "conditions": "conditionId\ty\tk\nlow\t1\tslow\nhigh\t2\tfast\n",
    "measurements": (
        "observableId\tsimulationConditionId\ttime\tmeasurement\tobservableParameters\n"
        "o\tlow\t1\t0.7\t1\no\tlow\t1\t0.5\t1\no\thigh\t2\t0.1\t3\n"
    ),
    "observables": "observableId\tobservableFormula\tobservableTransformation\tnoiseFormula\n"
    "o\tobservableParameter1_o*y\tlog10\tsigma/2\n",
    "parameters": "parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\testimate\n"
    "slow\tlin\t0\t5\t0.4\t1\nfast\tlin\t0\t5\t1.5\t1\nsigma\tlin\t0.01\t2\t0.6\t0\n",
}
RATES = "conditionId\tk\nlow\tslow\nhigh\tfast\n"


def problem(folder: Path, **changed: str) -> Path:
    """The files of a problem: y' = -k y, with starts and rates by condition."""
    decay = made.sbml(
        made.parameters("false", y="1", k="1"), made.rules(y=made.apply("minus", made.apply("times", "k", "y")))
    )
    made.stored(folder, decay)
    for name, text in {**TABLES, **changed}.items():
        (folder / f"{name}.tsv").write_text(text)
    (folder / "problem.yaml").write_text(changed.get("problem", YAML))
    return folder / "problem.yaml"


def closed(slow: float, fast: float) -> float:
    """The negative log likelihood of TABLES; y starts at 1 in both: it is a parameter with a rate."""
    total = 0.0
    for y, f in ((0.7, math.exp(-slow)), (0.5, math.exp(-slow)), (0.1, 3 * math.exp(-2 * fast))):
        sd = 0.3
        total += 0.5 * math.log(2 * math.pi * (sd * y * math.log(10)) ** 2)
        total += 0.5 * ((math.log10(y) - math.log10(f)) / sd) ** 2
    return total


def test_a_problem_has_the_likelihood_of_its_closed_form(tmp_path: Path) -> None:
    path = problem(tmp_path, conditions=RATES)
    found = import_file(path, tmp_path / "out")
    assert found.data is not None
    text = Path(found.model).read_text()
    assert "learn slow = 0.4 in [0, 5]" in text
    assert "if(experiment == 0, slow, fast)" in text
    result = gbspec.evaluate(found.model, found.data)
    assert result.nllh == pytest.approx(closed(0.4, 1.5), rel=1e-8)
    h = 1e-5
    assert result.gradient["slow"] == pytest.approx((closed(0.4 + h, 1.5) - closed(0.4 - h, 1.5)) / (2 * h), rel=1e-6)
    assert len(result.found.simulation) == 3, "replicates count each"


def test_names_with_numbers_are_none_that_the_problem_has(tmp_path: Path) -> None:
    """Replicates of `low` and channels of `o` beside a condition `low_2` and an observable `o_2`."""
    values = {}
    for second, other in (("low_2", "o_2"), ("high", "other")):
        folder = tmp_path / second
        folder.mkdir()
        path = problem(
            folder,
            conditions=RATES.replace("high", second),
            measurements=TABLES["measurements"].replace("high", second) + f"{other}\tlow\t2\t0.4\t\n",
            observables=TABLES["observables"] + f"{other}\t2*y\tlin\tsigma\n",
        )
        found = import_file(path, folder / "out")
        assert found.data is not None
        text, lines = Path(found.model).read_text(), Path(found.data).read_text().splitlines()
        values[second] = gbspec.evaluate(found.model, found.data).nllh
        labels = {line.split(",")[0] for line in lines}
        if second == "low_2":
            assert "observe o_3 = " in text and labels == {"trajectory", "low", "low_3", "low_2"}
    assert values["low_2"] == pytest.approx(values["high"], rel=1e-12)


def test_numbers_of_conditions_are_columns(tmp_path: Path) -> None:
    path = problem(tmp_path, conditions="conditionId\tk\nlow\t0.4\nhigh\t1.5\n")
    found = import_file(path, tmp_path / "out")
    assert "condition k" in Path(found.model).read_text()
    assert found.data is not None
    assert gbspec.evaluate(found.model, found.data).nllh == pytest.approx(closed(0.4, 1.5), rel=1e-8)


def test_a_condition_may_be_named_by_a_word_of_the_language(tmp_path: Path) -> None:
    path = problem(tmp_path, conditions="conditionId\tdose\nlow\t0.4\nhigh\t1.5\n")
    decay = made.sbml(
        made.parameters("false", y="1", dose="1"), made.rules(y=made.apply("minus", made.apply("times", "dose", "y")))
    )
    made.stored(tmp_path, decay)
    found = import_file(path, tmp_path / "out")
    assert 'condition dose_ as "dose"' in Path(found.model).read_text()
    assert found.data is not None
    assert gbspec.evaluate(found.model, found.data).nllh == pytest.approx(closed(0.4, 1.5), rel=1e-8)


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        (
            "measurements",
            "observableId\tsimulationConditionId\ttime\tmeasurement\tpreequilibrationConditionId\no\tlow\tinf\t0.7\thigh\n",
            "that follows another steady state is not offered yet",
        ),
        (
            "measurements",
            "observableId\tsimulationConditionId\ttime\tmeasurement\no\tlow\tsoon\t0.7\n",
            "its time is no number",
        ),
        (
            "observables",
            "observableId\tobservableFormula\tnoiseFormula\tnoiseDistribution\no\ty\t1\tlaplace\n",
            "`laplace` is not offered yet",
        ),
        ("observables", "observableId\tobservableFormula\tnoiseFormula\no\t2*y\t0.1*y\n", "depends on `y`"),
        ("observables", "observableId\tobservableFormula\tnoiseFormula\no\t__import__('os')\t1\n", "cannot be read"),
        ("problem", YAML.replace("format_version: 1", "format_version: 2.0.0"), "it has not exactly one model"),
        ("problem", YAML.replace("made.xml", "../made.xml"), "not in or below its folder"),
        ("problem", "a: [1", "it is no YAML"),
    ],
)
def test_what_has_no_form_is_refused(tmp_path: Path, name: str, text: str, reason: str) -> None:
    given = {"conditions": RATES, name: text}
    with pytest.raises(UserError) as raised:
        import_file(problem(tmp_path, **given), tmp_path / "out")
    assert any(reason in one.message for one in raised.value.diagnostics), raised.value
    assert not (tmp_path / "out").exists()


def test_a_noise_may_depend_on_the_prediction(tmp_path: Path) -> None:
    observables = "observableId\tobservableFormula\tnoiseFormula\no\ty\t0.1 + sigma*y\n"
    found = import_file(problem(tmp_path, conditions=RATES, observables=observables), tmp_path / "out")
    assert "noise normal(0.1 + sigma*o)" in Path(found.model).read_text()
    assert found.data is not None
    values = gbspec.evaluate(found.model, found.data).found.simulation
    assert [one.sd for one in values] == pytest.approx([0.1 + 0.6 * one.value for one in values])


def resting(folder: Path, conditions: str, measurements: str) -> Path:
    """y' = k - y from 1, observed with the noise 1."""
    growth = made.sbml(made.parameters("false", y="1", k="1"), made.rules(y=made.apply("minus", "k", "y")))
    observables = "observableId\tobservableFormula\tnoiseFormula\no\ty\t1\n"
    path = problem(folder, conditions=conditions, measurements=measurements, observables=observables)
    made.stored(folder, growth)
    return path


MEASURED = "observableId\tpreequilibrationConditionId\tsimulationConditionId\ttime\tmeasurement\n"


def test_some_trajectories_begin_in_the_steady_state_of_another_condition(tmp_path: Path) -> None:
    """From the steady state of `low`, from the start, from the steady state with y set to 7, and at rest."""
    path = resting(
        tmp_path,
        "conditionId\tk\ty\nlow\t3\t\nhigh\t5\t\nset\t5\t7\n",
        MEASURED + "o\tlow\thigh\t1\t0\no\t\thigh\t1\t0\no\tlow\tset\t1\t0\no\t\thigh\tinf\t0\n",
    )
    found = import_file(path, tmp_path / "out")
    assert "initial steady with k = k_before then y = " in Path(found.model).read_text()
    assert found.data is not None
    e = math.exp(-1)
    values = sorted(one.value for one in gbspec.evaluate(found.model, found.data).found.simulation)
    assert values == pytest.approx(sorted([5 - 2 * e, 5 - 4 * e, 5 + 2 * e, 5.0]), rel=1e-7)


@pytest.mark.parametrize(
    ("formula", "reason", "advice"),
    [("slow", "on the estimated `slow`", "; its `estimate` could be 0"), ("0.1 + sigma*y", "on the prediction", "")],
)
def test_a_noise_that_is_no_number_beside_pre_equilibration(
    tmp_path: Path, formula: str, reason: str, advice: str
) -> None:
    path = resting(tmp_path, "conditionId\tk\nlow\t3\nhigh\t5\n", MEASURED + "o\tlow\thigh\t1\t0\n")
    (tmp_path / "observables.tsv").write_text(f"observableId\tobservableFormula\tnoiseFormula\no\ty\t{formula}\n")
    with pytest.raises(UserError) as raised:
        import_file(path, tmp_path / "out")
    (found,) = raised.value.diagnostics
    said = f"a noise that depends {reason} is not offered yet beside pre-equilibration{advice}"
    assert found.message == f"observable o: {said}"
    assert "docs/howto/import.md" in found.help


def test_formulas_before_a_steady_state_and_after_it(tmp_path: Path) -> None:
    """Conditions with parameters are told apart by their number, before and after."""
    path = resting(
        tmp_path,
        "conditionId\tk\ty\nlow\tslow\t2\nhigh\tfast\tfast*slow\n",
        MEASURED + "o\tlow\thigh\t1\t0\no\thigh\tlow\t1\t0\n",
    )
    found = import_file(path, tmp_path / "out")
    text = Path(found.model).read_text()
    assert "initial steady with experiment = experiment_before then y = if(experiment == 0, 2, fast*slow)" in text
    assert found.data is not None
    e = math.exp(-1)
    values = [one.value for one in gbspec.evaluate(found.model, found.data).found.simulation]
    expected = [1.5 + (0.4 * 1.5 - 1.5) * e, 0.4 + (2 - 0.4) * e]
    assert sorted(values) == pytest.approx(sorted(expected), rel=1e-7)


@pytest.mark.parametrize(
    "case", ["0002", "0006", "0008", "0009", "0010", "0011", "0015", "0016", "0017", "0018", "0020"]
)
def test_cases_of_the_suite(case: str) -> None:
    """Conditions, parameters of observables, replicates, starts by condition, steady states, noise, logarithms."""
    from benchmarks.studies.petab import judged

    assert judged(suite("petab") / "v1" / case).end == "passed"


PRIORS = """\
parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\testimate\tobjectivePriorType\tobjectivePriorParameters
slow\tlin\t0\t5\t0.4\t1\tlogNormal\t-1;0.5
fast\tlog10\t0.001\t5\t1.5\t1\tparameterScaleNormal\t0.3;0.2
sigma\tlin\t0.01\t2\t0.6\t0\t\t
"""


def test_logarithmic_priors_are_the_same_distributions(tmp_path: Path) -> None:
    """`prior lognormal` has the median and the coefficient of variation."""
    found = import_file(problem(tmp_path, conditions=RATES, parameters=PRIORS), tmp_path / "out")
    model = gbspec.load(found.model).model
    priors = {k.name: k.prior for k in model.learnables}
    slow, fast = priors["slow"], priors["fast"]
    assert slow is not None
    assert fast is not None
    assert (slow.kind, fast.kind) == ("lognormal", "lognormal")
    assert slow.location == pytest.approx(math.exp(-1))
    assert math.sqrt(math.log1p(slow.scale**2)) == pytest.approx(0.5)
    assert fast.location == pytest.approx(10**0.3)
    assert math.sqrt(math.log1p(fast.scale**2)) == pytest.approx(0.2 * math.log(10))


def test_a_uniform_prior_that_is_narrower_than_the_bounds_is_listed(tmp_path: Path) -> None:
    text = PRIORS.replace("logNormal\t-1;0.5", "uniform\t0;5").replace("parameterScaleNormal\t0.3;0.2", "uniform\t1;2")
    found = import_file(problem(tmp_path, conditions=RATES, parameters=text), tmp_path / "out")
    assert ["prior `uniform`" in one.reason for one in found.left_out if "prior" in one.reason] == [True]
    assert all("slow" not in one.element for one in found.left_out)
