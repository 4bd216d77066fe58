"""report: one self-contained page with all sections."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner

import gbspec
from gbspec.cli.app import build, needed
from gbspec.diagnostics import Findings
from gbspec.operations import models, reporting
from gbspec.report.html import mathml

pytestmark = pytest.mark.usefixtures("quick_fits", "few_points")

Run = Callable[..., Any]
VOID = {"meta", "link", "img", "br", "hr", "input"}
SECTIONS = ("overview", "model", "fit", "functions", "constants", "metrics", "parity", "residuals", "history",
            "bifurcation", "eigenvalues", "starts", "phase", "reproduce")  # fmt: skip

PREY = """\
model prey "Predators <b>&</b> prey, what is eaten unknown"
time t : d
state N in [0, 3] = 1
state P in [0, 3] = 1 "never measured"
condition r in [0.8, 1.2]
learn m = 0.5 in [0, 2]
unknown eaten(N, P) = N*P + nn by mlp(6)
initial P learn
N' = r*N - eaten(N, P)
P' = 0.5*eaten(N, P) - m*P
observe N
truth m = 0.4
truth eaten(N, P) = N*P/(1 + 0.3*N)
"""


def call(*arguments: object) -> Any:
    texts = [str(argument) for argument in arguments]
    return CliRunner().invoke(build(needed(texts)), texts)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a run, its table and its report."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "prey.gb").write_text(PREY)
    made = call("simulate", folder / "prey.gb", "-o", folder / "prey.csv", "--trajectories", 4, "--span", 6)
    assert made.exit_code == 0, made.stderr
    made = call("train", folder / "prey.gb", folder / "prey.csv", "-o", folder / "run", "--method", "lm", "--epochs", 3,
                "--quiet")  # fmt: skip
    assert made.exit_code == 0, made.stderr
    made = call("report", folder / "run", "--over", "r", "--range", 0.8, 1.2)
    assert made.exit_code == 0, made.stderr
    yield folder


@pytest.fixture(scope="module")
def page(place: Path) -> str:
    return (place / "run" / "report.html").read_text(encoding="utf-8")


class Reader(HTMLParser):
    """Checks that tags are nested correctly, and collects all references to other resources."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.words += data


@pytest.fixture(scope="module")
def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    return reader


def test_the_page_is_well_formed_and_has_its_sections(read: Reader) -> None:
    assert read.open == []
    ids = [attrs["id"] for _, attrs in read.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    assert set(SECTIONS) <= set(ids)


def test_nothing_is_loaded_from_elsewhere(read: Reader) -> None:
    for tag, attrs in read.tags:
        assert not attrs.keys() & {"src", "srcset", "data", "poster"}, tag
        assert tag not in ("link", "iframe", "object", "embed", "img")
        assert (attrs.get("href") or "#").startswith("#")
        assert "url(" not in (attrs.get("style") or "")


def test_texts_of_users_are_escaped(page: str, read: Reader) -> None:
    assert "Predators <b>&</b> prey" in read.words
    assert not any(tag == "b" and not attrs for tag, attrs in read.tags[:4])
    assert "<b>&</b> prey" not in page.replace("\\u003c", "")


def test_equations_are_mathml_that_parses(page: str) -> None:
    found = re.findall(r"<math.*?</math>", page, flags=re.DOTALL)
    assert len(found) >= 2
    trees = [ElementTree.fromstring(one) for one in found]
    text = "".join("".join(tree.itertext()) for tree in trees)
    for name in ("N", "P", "eaten", "𝒩", "m"):
        assert name in text


def test_disturbed_balances_are_increments(tmp_path: Path) -> None:
    text = "model m\nstate x\nstate y[1..2]\nstate z\nlearn s = 0.2 > 0\nx' = 1 - x\ny[i]' = -y[i]\nz' = -z\n"
    (tmp_path / "m.gb").write_text(text + "diffusion x = s\ndiffusion y[i] = s\nobserve x noise normal(0.1)\n")
    model = gbspec.load(tmp_path / "m.gb").model
    shown = [mathml.equations([pair]) for pair in (*mathml.balances(model), *mathml.disturbances(model))]
    first, *_, family, second = ("".join(ElementTree.fromstring(one).itertext()) for one in shown)
    assert first == "dx=(1-x)dt+sdWx"
    assert len(shown) == 5 and "W" not in "".join(shown[1:3])
    assert family == "dy1=(dy1dt)balancedt+sdWy1" and second.endswith("sdWy2")


def test_the_plots_show_the_data_unmeasured_states_and_the_truth(page: str) -> None:
    (content,) = re.findall(r'<script type="application/json" id="charts">(.*?)</script>', page, flags=re.DOTALL)
    charts = json.loads(content)
    places = [int(n) for n in re.findall(r'data-chart="(\d+)"', page)]
    assert sorted(places) == list(range(len(charts)))
    titles = [note["text"] for chart in charts for note in chart["layout"]["annotations"]]
    assert titles.count("P: not measured") == 4 + 1  # and on the first screen
    names = {trace.get("name") for chart in charts for trace in chart["data"]}
    assert {"model", "learned", "truth", "measured", "postulate", "residual"} <= names
    first = next(trace for trace in charts[0]["data"] if trace["name"] == "measured")
    assert len(first["y"]) > 3
    assert any(chart["layout"]["images"] for chart in charts), "the plane of two arguments"


def test_solutions_are_not_called_learned(page: str) -> None:
    """Most of a solution is known: only functions, constants and initial states were learned."""
    (content,) = re.findall(r'<script type="application/json" id="charts">(.*?)</script>', page, flags=re.DOTALL)
    over_time = [one for one in json.loads(content) if one["layout"]["xaxis"]["title"]["text"] == "t [d]"]
    assert over_time
    assert not any(trace.get("name") == "learned" for one in over_time for trace in one["data"])


def test_the_first_screen_says_what_to_think_of_the_fit(read: Reader, page: str) -> None:
    ids = [attrs["id"] for tag, attrs in read.tags if tag == "section"]
    assert ids[0] == "overview"
    first = page[page.index('id="overview"') : page.index('id="fit"')]
    assert first.index("What to doubt") < first.index(">What to do<") < first.index("Learned constants")
    assert "<math" in first
    assert re.findall(r'data-chart="(\d+)"', first) == ["0", "1"]
    (content,) = re.findall(r'<script type="application/json" id="charts">(.*?)</script>', page, flags=re.DOTALL)
    trajectory, function = json.loads(content)[:2]
    assert {"model", "measured"} <= {trace["name"] for trace in trajectory["data"]}
    assert {"learned", "90 % band"} <= {trace["name"] for trace in function["data"]}


def test_the_page_is_small_and_follows_the_reader(page: str) -> None:
    assert len(page.encode()) < 2_000_000
    for feature in ("@media print", "prefers-color-scheme: dark", "max-width: 560px", "beforeprint"):
        assert feature in page


def test_sections_without_content_are_left_out(place: Path, here: Path) -> None:
    assert call("report", place / "run", "-o", "r.html").exit_code == 0
    text = Path("r.html").read_text(encoding="utf-8")
    assert 'id="bifurcation"' not in text  # it was not requested
    assert "There is nothing to show" not in text
    assert "Not requested" not in text


def test_the_page_tells_how_to_reproduce_the_run(read: Reader) -> None:
    assert "gbspec train model.gb" in read.words
    assert "--method lm --epochs 3" in read.words
    assert "learn m = 0.5 in [0, 2]" in read.words


def test_without_the_data_the_page_names_what_is_missing(place: Path, here: Path) -> None:
    shutil.copytree(place / "run", here / "run")
    fit = json.loads((here / "run" / "fit.json").read_text())
    fit["data"] |= {"path": "gone.csv", "absolute": "/gone.csv", "relative": "gone.csv"}
    (here / "run" / "fit.json").write_text(json.dumps(fit))
    refused = call("report", "run", "-o", "r.html")
    assert refused.exit_code == 1
    assert "gone.csv" in refused.stderr
    assert not Path("r.html").exists()
    # From Python, a page without data is possible: it says so first
    reporting.report(models.open_run("run", {}, Findings()), None, "r.html")
    text = Path("r.html").read_text(encoding="utf-8")
    assert "Without its data, this fit cannot be judged" in text
    assert 'id="fit"' not in text


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--over", "r"), "GB814"),
        (("--over", "q", "--range", "0", "1"), "GB872"),
        (("-o", "no/r.html"), "GB805"),
        (("--data", "absent.csv"), "GB70"),
    ],
)
def test_wrong_options(place: Path, here: Path, arguments: tuple[str, ...], code: str) -> None:
    result = call("report", place / "run", *arguments)
    assert result.exit_code == (2 if code == "GB814" else 1), result.output
    assert code in result.stderr


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@pytest.mark.parametrize("size", ["1280,900", "390,844"])
def test_a_browser_draws_it_without_a_script_error(place: Path, tmp_path: Path, size: str) -> None:
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    flags = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr")
    run = (f"--user-data-dir={tmp_path}", f"--window-size={size}", "--virtual-time-budget=30000", "--dump-dom")
    command = [browser, *flags, *run, (place / "run" / "report.html").as_uri()]
    made = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert made.returncode == 0, made.stderr[-2000:]
    assert "Uncaught" not in made.stderr
    assert "CONSOLE" not in made.stderr, made.stderr[-2000:]
    shown = len(re.findall(r'class="chart[^"]*" data-chart', made.stdout))
    hidden = 3  # all trajectories but the first are hidden until they are selected
    assert made.stdout.count('data-drawn="yes"') == shown - hidden > 10
    assert made.stdout.count('class="main-svg"') >= shown - hidden
