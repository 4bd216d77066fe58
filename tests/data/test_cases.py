"""Cases: the values of a `cases.toml`, its defaults, and all of its errors reported at once."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from gbspec.data.cases import FILE, Cases, find_cases, load_cases
from gbspec.data.sampling import SimulateOptions, boxes, clocks
from gbspec.data.shipped import models_folder, shipped_model, shipped_models
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.diagnostics.catalogue import entries

GOOD = """
[sampling]
span = 20
channels = 0.5
initial = { x = [0, 1], y = [2, 3] }

[metrics]
settle = 100
scales = { x = 2 }

[training]
max-step = 0.25
random-steps = true

[case.Cell]
title = "the cell"

[case.other]
model = "cell"
sampling = { span = 5, keep-start = true, initial = { y = [4, 5] }, clock = { x = 0.1 }, channels = "own-clock" }
metrics = { window = [1, 2] }
training = { effort = "high", random-steps = false, epochs = 10 }
published = { solution = 1e-2 }
"""


def written(folder: Path, text: str) -> Path:
    (folder / "cell.gb").write_text("model cell\n")
    path = folder / FILE
    path.write_text(text)
    return path


def cases(folder: Path, text: str) -> Cases:
    return load_cases(written(folder, text))


def test_a_case_says_what_differs(tmp_path: Path) -> None:
    found = cases(tmp_path, GOOD)
    own, other = found.cases
    assert (own.name, own.title, own.model) == ("Cell", "the cell", tmp_path / "cell.gb")
    assert own.sampling == SimulateOptions(span=20.0, channels="0.5", initial={"x": (0, 1), "y": (2, 3)})
    assert own.metrics.scales == {"x": 2.0} and own.training.more == {"random_steps": True}
    assert other.sampling.initial == {"x": (0, 1), "y": (4, 5)}
    assert (other.sampling.span, other.sampling.keep_start, other.sampling.clock) == (5.0, True, {"x": 0.1})
    assert (other.metrics.settle, other.metrics.window) == (100.0, (1.0, 2.0))
    assert (other.training.max_step, other.training.effort) == (0.25, "high")
    assert other.training.more == {"random_steps": False, "epochs": 10}
    assert other.published == {"solution": 0.01}


def test_a_case_is_found_by_its_name_or_its_models(tmp_path: Path) -> None:
    written(tmp_path, GOOD)
    found = find_cases(tmp_path / "cell.gb")
    assert found.of_model("cell").name == "Cell"
    assert found.of_model("stranger") == found.base and found.base.sampling.span == 20
    assert found.case("OTHER").name == "other"
    with pytest.raises(UserError) as caught:
        found.case("othr")
    assert (caught.value.diagnostics[0].code, caught.value.diagnostics[0].help) == ("GB743", "is `other` meant?")


def test_without_a_file_the_defaults_hold(tmp_path: Path) -> None:
    found = find_cases(tmp_path / "cell.gb")
    assert found.base.sampling == SimulateOptions() and found.cases == () and found.path is None
    with pytest.raises(UserError):
        found.case("any")


def test_metrics_are_filled_in_from_the_sampling(tmp_path: Path) -> None:
    plain = find_cases(tmp_path / "cell.gb").base.metrics.settled(50.0)
    assert (plain.settle, plain.horizon, plain.window) == (10.0, 25.0, (10.0, 50.0))
    given = cases(tmp_path, GOOD).case("other").metrics.settled(50.0)
    assert (given.settle, given.window) == (100.0, (1.0, 2.0))


def test_cases_can_be_sent_to_another_process(tmp_path: Path) -> None:
    found = cases(tmp_path, GOOD)
    assert pickle.loads(pickle.dumps(found)) == found


WRONG = [
    ("[sampling", "GB740", "TOML"),
    ("[sampling]\nspn = 3\n", "GB741", "`sampling.spn`"),
    ("[smapling]\nspan = 3\n", "GB741", "`smapling`"),
    ("sampling = 3\n", "GB742", "`sampling` must be a table"),
    ("[sampling]\nspan = 'long'\n", "GB742", "`sampling.span` must be a number"),
    ("[sampling]\nspan = true\n", "GB742", "`sampling.span` must be a number"),
    ("[sampling]\ntrajectories = 2.5\n", "GB742", "a whole number"),
    ("[sampling]\nkeep-start = 1\n", "GB742", "true or false"),
    ("[sampling]\nsampling = 'poisson'\n", "GB742", "`regular` or `gamma`"),
    ("[sampling]\ninitial = { x = [1, 0] }\n", "GB742", "[low, high]"),
    ("[sampling]\ninitial = { x = [1] }\n", "GB742", "[low, high]"),
    ("[sampling]\ninitial = { x = ['a', 'b'] }\n", "GB742", "[low, high]"),
    ("[sampling]\ninitial = 3\n", "GB742", "a table"),
    ("[sampling]\nreject = 'x > 4'\n", "GB742", "a list"),
    ("[sampling]\ndt = -1\n", "GB742", "above zero"),
    ("[sampling]\nchannels = 1.5\n", "GB742", "own-clock"),
    ("[sampling]\nclock = { x = 1 }\n", "GB742", "own-clock"),
    ("[metrics]\nwindow = [1, 2, 3]\n", "GB742", "[low, high]"),
    ("[metrics]\nscales = { x = 'big' }\n", "GB742", "a number"),
    ("[training]\nmax-step = 'small'\n", "GB742", "a number"),
    ("[training]\nlayers = [1, 2]\n", "GB742", "`training.layers`"),
    ("case = 3\n", "GB742", "`case` must be a table"),
    ("[case]\nx = 3\n", "GB742", "`case.x` must be a table"),
    ("[case.none]\n", "GB742", "`case.none.model` names no file"),
    ("[case.cell]\ntitle = 3\n", "GB742", "`case.cell.title`"),
    ("[case.cell]\ntables = ['spectra']\n", "GB742", "`case.cell.tables`"),
    ("[case.cell]\ntables = 'eigenvalues'\n", "GB742", "`case.cell.tables`"),
    ("[case.cell]\ndata = 'none.csv'\n", "GB742", "`case.cell.data`"),
    ("[case.cell.published]\nrhs = 'good'\n", "GB742", "a number"),
    ("[case.cell.sampling]\nspan = 0\n", "GB742", "`case.cell.sampling.span`"),
]


@pytest.mark.parametrize(("text", "code", "part"), WRONG)
def test_what_is_wrong_in_a_file(tmp_path: Path, text: str, code: str, part: str) -> None:
    with pytest.raises(UserError) as caught:
        cases(tmp_path, text)
    (finding,) = caught.value.diagnostics
    assert finding.code == code and part in finding.message


def test_everything_wrong_is_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        cases(tmp_path, "".join(text for text, _, _ in WRONG[1:3]) + "[case.none]\n")
    assert sorted(d.code for d in caught.value.diagnostics) == ["GB741", "GB741", "GB742"]


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError):
        load_cases(tmp_path / FILE)


def test_boxes_are_read_from_the_command_line() -> None:
    read = boxes("--initial")
    assert read(["x1=0.2:0.95", "x2=-1e-3"]) == {"x1": (0.2, 0.95), "x2": (-0.001, -0.001)}
    assert read([]) == {}
    assert clocks(["x1=0.5"]) == {"x1": 0.5}


@pytest.mark.parametrize("text", ["x1", "x1=", "=1:2", "x1=1:", "x1=a:b", "x1=2:1", "x1=nan:1", "x1=0:inf", "x1=1:2:3"])
def test_boxes_that_cannot_be_read(text: str) -> None:
    with pytest.raises(UserError) as caught:
        boxes("--initial")([text, "also wrong"])
    assert [d.code for d in caught.value.diagnostics] == ["GB750", "GB750"]
    with pytest.raises(UserError):
        clocks([text])


@pytest.mark.parametrize(
    "wrong",
    [{"trajectories": 0}, {"span": 0.0}, {"span": float("inf")}, {"dt": float("nan")}, {"noise": -0.1}, {"seed": -1},
     {"channels": "some"}, {"channels": "0"}, {"channels": "1.01"}, {"clock": {"x": 1.0}}],
)  # fmt: skip
def test_options_that_cannot_be(wrong: dict[str, object]) -> None:
    findings = Findings()
    SimulateOptions(**wrong).check(findings)  # type: ignore[arg-type]  # one option by name
    (only,) = findings
    assert isinstance(only, Diagnostic) and only.code == "GB754" and only.code in entries()


def test_bundled_models_are_found_by_name() -> None:
    assert shipped_model("urp_gb2") == models_folder() / "urp" / "urp_gb2.gb"
    assert len(shipped_models()) >= 10
    with pytest.raises(UserError) as caught:
        shipped_model("urp_gb3")
    assert caught.value.diagnostics[0].code == "GB744" and "urp_gb" in caught.value.diagnostics[0].help
