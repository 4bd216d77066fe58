"""Structural identifiability: a table of cases with known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.cli.commands.check import examination_summary
from gbspec.diagnostics import Findings
from gbspec.passes import Examination, examine
from gbspec.passes.identifiability import Identifiability, by_one_trajectory, identifiability
from gbspec.passes.identifiability.directions import Directions, absorbers, find
from gbspec.passes.identifiability.question import Question, pose
from gbspec.passes.identifiability.report import BUDGET
from gbspec.passes.identifiability.series import Effort
from gbspec.passes.identifiability.undecided import Open
from tests.passes.identifiability_cases import FURTHER, UNDECIDED
from tests.texts import SHIPPED, model_at, model_of

TWO = "state x\nstate y\ny' = -y\n"
PAIR = "observe x\nobserve y\n"
COMPARTMENTS = (
    "condition D\nstate a\nstate b\nlearn k10 = 1\nlearn k12 = 0.7\nlearn k21 = 0.4\n"
    "a' = -(k10 + k12)*a + k21*b\nb' = k12*a - k21*b\nobserve a\nallow GB403\n"
)
TANKS = "input F held\nstate h1\nstate h2\nlearn k = 1\nunknown q(h)\nobserve h1\nobserve h2\n"

CASES: dict[str, tuple[str, int, set[str], set[str]]] = {
    # name: (text, number of directions, constants in them, unknowns that absorb)
    "decay": ("state x\nlearn k = 1\nx' = -k*x\nobserve x\n", 0, set(), set()),
    "decay from a known start, each with its own rate": (
        "state x\nlearn k = 1 per trajectory\ninitial x = 1\nx' = -k*x\nobserve x\n", 0, set(), set()
    ),
    "product of constants": ("state x\nlearn a = 1\nlearn b = 1\nx' = -a*b*x\nobserve x\n", 1, {"a", "b"}, set()),
    "sum of constants": ("state x\nlearn a = 1\nlearn b = 2\nx' = -(a + b)*x\nobserve x\n", 1, {"a", "b"}, set()),
    "factor of an unknown": (TWO + "learn k = 1\nunknown mu(y)\nx' = k*mu(y)*x\n" + PAIR, 1, {"k"}, {"mu"}),
    "constant added to an unknown": ("state x\nlearn k = 1\nunknown f(x)\nx' = f(x) + k\nobserve x\n", 1, {"k"}, {"f"}),
    "line added to an unknown": ("state x\nlearn k = 1\nunknown f(x)\nx' = f(x) + k*x\nobserve x\n", 1, {"k"}, {"f"}),
    "exponential added to an unknown": (
        "state x\nlearn k = 1\nunknown f(x)\nx' = f(x) + k*exp(x)\nobserve x\n", 1, {"k"}, {"f"}
    ),
    "exponential with rate added to an unknown": (
        "state x\nlearn k = 1\nunknown f(x)\nx' = f(x) + exp(k*x)\nobserve x\n", 1, {"k"}, {"f"}
    ),
    "another variable separates": (TWO + "learn k = 1\nunknown f(x)\nx' = f(x) + k*x*y\n" + PAIR, 0, set(), set()),
    "variable shared by the unknown": (TWO + "learn k = 1\nunknown f(x, y)\nx' = f + k*x*y\n" + PAIR, 1, {"k"}, {"f"}),
    "a second balance separates": (
        "state x\nstate y\nlearn k = 1\nunknown f(x, y)\nx' = f\ny' = k*f\n" + PAIR, 0, set(), set()
    ),
    "both balances scaled": (
        "state x\nstate y\nlearn k = 1\nlearn c = 2\nunknown f(x, y)\nx' = c*f\ny' = k*f\n" + PAIR, 1, {"k", "c"}, {"f"}
    ),
    "scaled argument": ("state x\nlearn k = 1\nunknown f(u)\nx' = f(k*x)\nobserve x\n", 1, {"k"}, {"f"}),
    "shifted argument": ("state x\nlearn k = 1\nunknown f(u)\nx' = f(x + k)\nobserve x\n", 1, {"k"}, {"f"}),
    "scaled argument, another term": (TWO + "learn k = 1\nunknown f(u)\nx' = f(k*x) + k*y\n" + PAIR, 0, set(), set()),
    "argument with another variable": (TWO + "learn k = 1\nunknown f(u)\nx' = f(x + k*y)\n" + PAIR, 0, set(), set()),
    "one function at two places, scaled": (
        TANKS + "h1' = F - k*q(h1)\nh2' = k*q(h1) - k*q(h2)\n", 1, {"k"}, {"q"}
    ),
    "one function at two places, one scaled": (TANKS + "h1' = F - q(h1)\nh2' = q(h1) - k*q(h2)\n", 0, set(), set()),
    "factor in a postulate": ("state x\nlearn K = 1\nunknown f(x) = K*x*nn\nx' = f\nobserve x\n", 1, {"K"}, {"f"}),
    "shape in a postulate": (
        "state x\nlearn K = 1\nunknown f(x) = x/(K + x)*nn\nx' = f\nobserve x\n", 1, {"K"}, {"f"}
    ),
    "slope in an additive postulate": (
        "state x\nlearn a = 1\nunknown f(x) = a*x + nn\nx' = f\nobserve x\n", 1, {"a"}, {"f"}
    ),
    "a prior separates": (
        "state x\nlearn k = 1 prior normal(1, 0.1)\nunknown f(x)\nx' = k*f\nobserve x\n", 0, set(), set()
    ),
    "a constant for each trajectory": (
        "state x\nlearn k = 1\nlearn a = 1 per trajectory\nx' = -k*a*x\nobserve x\n", 1, {"k"}, {"a"}
    ),
    "a condition separates": ("state x\ncondition D\nlearn k = 1\nx' = -k*D*x\nobserve x\n", 0, set(), set()),
    "condition as an argument": (
        "state x\ncondition D\nlearn k = 1\nunknown f(x, D)\nx' = f + k*D\nobserve x\n", 1, {"k"}, {"f"}
    ),
    "an input separates": (
        "state x\ninput F linear\nlearn k = 1\nunknown f(x)\nx' = f + k*F\nobserve x\n", 0, set(), set()
    ),
    "time separates": ("state x\nlearn k = 1\nunknown f(x)\nx' = f + k*t\nobserve x\n", 0, set(), set()),
    "product with time": ("state x\nlearn k = 1\nunknown f(x)\nx' = f*k*t\nobserve x\n", 1, {"k"}, {"f"}),
    "scale of a channel": ("state x\nlearn k = 1\nlearn s = 2\nx' = -k*x\nobserve y = s*x\n", 1, {"s"}, set()),
    "scaled channel, initial value known": (
        "state x\nlearn k = 1\nlearn s = 2\nx' = -k*x\ninitial x = 1\nobserve y = s*x\n", 0, set(), set()
    ),
    "shared initial value learned": (
        "state x\nlearn k = 1\nlearn s = 2\nlearn x0 = 1\nx' = -k*x\ninitial x = x0\nobserve y = s*x\n",
        1, {"s", "x0"}, set(),
    ),
    "Michaelis-Menten kinetics with a scaled channel": (
        "state S\nlearn V = 1\nlearn K = 0.5\nlearn s = 2\nS' = -V*S/(K + S)\nobserve y = s*S\n",
        1, {"V", "K", "s"}, set(),
    ),
    "a sum of decays": (
        "state x\nstate y\nlearn a = 1\nlearn b = 0.3\nx' = -a*x\ny' = -b*y\nobserve s = x + y\n", 0, set(), set()
    ),
    "no effect": ("state x\nstate z\nlearn k = 1\nx' = -x\nz' = k*x - z\nobserve x\n", 1, {"k"}, set()),
    "two compartments": (COMPARTMENTS, 1, {"k10", "k12", "k21"}, set()),
    "two compartments after a dose": (COMPARTMENTS + "initial a = D\ninitial b = 0\n", 0, set(), set()),
    "epidemic with an unknown reported fraction": (
        "state S\nstate I\nconst N = 2\nlearn beta = 1\nlearn gamma = 0.4\nlearn part = 0.5\n"
        "S' = -beta*S*I/N\nI' = beta*S*I/N - gamma*I\nobserve y = part*I\n",
        1, {"beta", "part"}, set(),
    ),
    "a zero determines an added constant": (
        "state x\nlearn k = 1\nunknown f(x) zero at x = 0\nx' = f + k\nobserve x\n", 0, set(), set()
    ),
    "a zero does not determine a slope": (
        "state x\nlearn k = 1\nunknown f(x) zero at x = 0\nx' = f + k*x\nobserve x\n", 1, {"k"}, {"f"}
    ),
    "a zero in one of two arguments": (
        TWO + "learn k = 1\nunknown f(x, y) zero at x = 0\nx' = f + k*y\n" + PAIR, 0, set(), set()
    ),
    "a zero at no dose": (
        "state x\nstate c\nlearn k = 1\nunknown f(c) zero at c = 0\nx' = f + k\nc' = -c\n"
        "observe x\nobserve c\ndose c\n", 0, set(), set(),
    ),
    "a zero before the first dose of what is not measured": (
        "state x\nstate c\nlearn k = 1\nlearn e = 0.3\nunknown f(c) zero at c = 0\nx' = k*x - f*x\nc' = -e*c\n"
        "initial c = 0\nobserve x\ndose c\n", 0, set(), set(),
    ),
    "a value that a dose alone leads to": (
        "state x\nstate c\nlearn k = 1\nunknown f(c) equals 2 at c = 5\nx' = f + k\nc' = -c\n"
        "initial c = 0\nobserve x\ndose c\n", 0, set(), set(),
    ),
    "a zero before the first dose from a known start at a known time": (
        "time t from 0\nstate x\nstate c\nlearn k = 1\nunknown f(c) zero at c = 0\nx' = f + k\nc' = -c\n"
        "initial x = 1\ninitial c = 0\nobserve x\ndose c\n", 0, set(), set(),
    ),
    "branches": (
        "state x\nlearn a = 1\nlearn b = 1\nx' = if(x > 0.1, -a*b*x, 1)\nobserve x\n", 1, {"a", "b"}, set()
    ),
}  # fmt: skip


def answer(text: str, *, all_states: bool = False) -> tuple[int, set[str], set[str]]:
    problem = pose(model_of("model m\n" + text), all_states=all_states)
    return told(problem, find(problem, Effort(2e9)))


def told(problem: Question, found: Directions | Open) -> tuple[int, set[str], set[str]]:
    """The number of directions, the constants in them, and the unknowns that absorb."""
    assert not isinstance(found, Open)
    names = [k.name for k in problem.sought]
    moving = {n for n, row in zip(names, found.basis, strict=True) if np.max(np.abs(row), initial=0) > 1e-6}
    unknowns = {u for direction in found.basis.T for u in absorbers(found, direction)}
    return found.basis.shape[1], moving, unknowns


@pytest.mark.parametrize("name", CASES)
def test_known_answer(name: str) -> None:
    text, count, constants, unknowns = CASES[name]
    assert answer(text) == (count, constants, unknowns)


@pytest.mark.parametrize("name", FURTHER)
def test_known_answer_with_branches_doses_and_inputs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, count, constants, unknowns, _ = FURTHER[name]
    answers: list[tuple[Question, Directions | Open]] = []

    def recorded(problem: Question, effort: Effort) -> Directions | Open:
        answers.append((problem, find(problem, effort)))
        return answers[-1][1]

    monkeypatch.setattr("gbspec.passes.identifiability.report.find", recorded)
    assert identifiability(model_of("model m\n" + text), Findings(), budget=2e9).decided
    assert told(*answers[1]) == (count, constants, unknowns), "the second question is that of the declared channels"


@pytest.mark.parametrize("name", UNDECIDED)
def test_what_the_ranges_do_not_decide_is_said_to_be_undecided(name: str) -> None:
    text, _ = UNDECIDED[name]
    findings = Findings()
    found = identifiability(model_of("model m\n" + text), findings, budget=2e9)
    assert (found.decided, found.sets, list(findings)) == (False, (), [])
    assert found.doubtful


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            UNDECIDED["rates that differ by fifteen decades, with a branch"][0],
            "for slow: effects on what is observed are too small",
        ),
        (UNDECIDED["overflow that a known start may reach"][0], "for r: it depends on which branches and values the"),
    ],
)
def test_the_reason_for_which_it_is_undecided_is_that_of_the_model(text: str, reason: str) -> None:
    summary = examination_summary(examine(model_of("model m\n" + text), Findings()))
    assert f"identifiability of the learned constants could not be decided {reason}" in summary


def test_no_branches_are_named_where_there_are_none() -> None:
    examination = Examination((), Identifiability(False, doubtful=("b",)))
    assert examination_summary(examination).endswith("decided for b: it depends on which values the data reach\n")


def test_the_infusion_of_the_language_s_page_is_identifiable() -> None:
    page = (SHIPPED[0].parents[2] / "docs" / "language.md").read_text("utf-8")
    text = "model infusion" + page.split("model infusion", 1)[1].split("```", 1)[0]
    assert identifiability(model_of(text), Findings()).sets == ()


PAPER: list[tuple[str, list[str], int, set[str]]] = [
    # model, states that are not observed, number of directions, constants in them
    ("urp_gb2", [], 0, set()),
    ("urp_gb2", ["x2"], 2, {"B", "beta"}),
    ("urp_gb2", ["x1"], 2, {"B", "beta"}),
    ("bf_gb2", [], 0, set()),
    ("bf_gb2", ["z"], 1, {"sigma", "eta"}),
    ("bf_gb2", ["v"], 2, {"omega", "sigma"}),
    ("bf_gb2", ["u"], 0, set()),
    ("bf_gb2", ["v", "z"], 4, {"omega", "sigma", "rho", "eta"}),
]


def paper(name: str, unseen: list[str]) -> str:
    """The text of a bundled model without its first line and without what is not observed."""
    (path,) = (p for p in SHIPPED if p.stem == name)
    text = "".join(line for line in model_at(path).text.splitlines(keepends=True) if not line.startswith("model"))
    for state in unseen:
        text = text.replace(f"observe {state}\n", "")
    return text


@pytest.mark.parametrize(("name", "unseen", "count", "constants"), PAPER)
def test_the_paper_s_systems(name: str, unseen: list[str], count: int, constants: set[str]) -> None:
    assert answer(paper(name, unseen))[:2] == (count, constants)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_the_effort_for_bundled_models_suffices(path: Path) -> None:
    model = model_at(path)
    if model.algebraics or model.delays:  # not examined
        assert not identifiability(model, Findings()).decided
        return
    for all_states in (True, False):
        effort = Effort(BUDGET / 2)
        find(pose(model, all_states=all_states), effort)
        assert effort.left > 0


def test_effort_that_ends_gives_no_answer() -> None:
    problem = pose(model_of("model m\n" + TANKS + "h1' = F - q(h1)\nh2' = q(h1) - k*q(h2)\n"), all_states=True)
    ample = Effort(1e12)
    assert not isinstance(find(problem, ample), Open)
    needed = 1e12 - ample.left
    assert isinstance(find(problem, Effort(0.9 * needed)), Open)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("state x\nlearn k = 1\nunknown f(t)\nx' = -k*x + f\nobserve x\n", [("k", "f")]),
        (
            "state x\nstate y\nlearn k = 1\nlearn a = 2\nunknown f(t)\nx' = f - k*x\ny' = x - a*y\nobserve x\n"
            "observe y\n",
            [("k", "f")],
        ),
        (
            "state S\nstate I\nlearn g = 0.1\nunknown b(t) >= 0\nS' = -b*S*I\nI' = b*S*I - g*I\nobserve y = 1000*I\n",
            [("g", "b")],
        ),
        ("state x\nlearn k = 1\nunknown f(t) period 3 in t\nx' = -k*x + f\nobserve x\n", []),
        ("state x\nlearn k = 1\nunknown f(x)\nx' = f + k\nobserve x\n", []),
        ("state x\ninput u held\nlearn a = 1\nunknown f(t)\nx' = f - x + a*u\nobserve x\n", []),
    ],
)
def test_a_function_of_time_follows_any_single_trajectory(text: str, found: list[tuple[str, str]]) -> None:
    """Where trajectories from other initial values would tell them apart, which is what `check` answers."""
    model = model_of("model m\ntime t\n" + text)
    assert [(*each.constants, *each.unknowns) for each in by_one_trajectory(model, budget=2e9)] == found
    if found:
        findings = Findings()
        identifiability(model, findings)
        assert not list(findings)
