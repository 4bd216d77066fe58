"""A fit says which events never happen, which come and go within its uncertainty, and why starts cannot be solved."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.trajectories import Trajectories
from gbspec.runs.covariance import Covariance
from gbspec.training.engines.choice import native_engine
from gbspec.training.engines.counting import happened
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.runs.happening import said_of_events
from gbspec.training.starts.search import Search
from tests.events.models import BALL
from tests.training.conftest import model_of, problem_of, trajectory

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.usefixtures("quick_fits")

CAUGHT = BALL.replace("observe h\n", "learn c = 0.5 in [0.2, 1]\nevent catch when h >= 9: v = c*v\nobserve h\n")


def ball(text: str, e: float = 0.8, span: float = 3.0) -> tuple[NativeEngine, np.ndarray]:
    """The engine of one trajectory, and the vector of a restitution (and of g = 9.81)."""
    times = np.linspace(0.0, span, 7)[1:]
    data = Trajectories((trajectory("drop", 0.0, times, np.ones((6, 2)), []),), ("h", "n"))
    problem, parameters, theta = problem_of(model_of(text), data, 0.25, blend=0.0)
    constants = np.array([e, 9.81, 0.5])[: len(problem.model.learnables)]
    return native_engine(problem, parameters), parameters.vector(parameters.natural(theta), constants)


def covariance(engine: NativeEngine, deviations: list[float]) -> Covariance:
    names, none = tuple(k.name for k in engine.problem.model.learnables), np.zeros((0, 0))
    k = len(names)
    return Covariance((), names, 1.0, none, np.zeros(0), np.zeros((k, 0)), np.diag(np.array(deviations[:k]) ** 2))


def test_events_are_counted() -> None:
    engine, theta = ball(BALL)
    found = happened(engine, theta)
    assert found is not None and found.counts.tolist() == [[2]] and not found.endless.any()
    assert happened(TorchEngine(engine.problem, engine.parameters), theta) is None


def test_balls_at_rest_are_endless() -> None:
    engine, theta = ball(BALL, 0.5, 5.0)
    found = happened(engine, theta)
    assert found is not None and found.endless.tolist() == [True]


def test_an_event_that_never_happens_is_told_with_what_it_alone_depends_on() -> None:
    engine, theta = ball(CAUGHT)
    assert said_of_events(engine, theta, None) == [
        "the event `catch` never happens in the fitted solutions, so that nothing moves `c` from where the fit began: "
        "if the event happens in the data, begin where the solutions reach it (other starting values or bounds)"
    ]


def test_events_that_come_and_go_within_the_uncertainty_are_told() -> None:
    engine, theta = ball(BALL)
    assert said_of_events(engine, theta, covariance(engine, [1e-4, 1e-3])) == []
    (said,) = said_of_events(engine, theta, covariance(engine, [0.12, 1e-3]))
    assert "events come and go: `bounce` (2 times in trajectory `drop`, 1 to 3)" in said


def test_the_search_says_why_starts_cannot_be_solved() -> None:
    engine, theta = ball(BALL, span=5.0)
    search = Search(engine, None, 0, "low")
    state = search.begin(theta)
    lost = int(state["drawn"] - state["survived"])
    assert lost > 0 and int(state["endless"]) == lost
    assert f"starts can be solved (in {lost} events follow each other without end), " in search.step(state, 0).remark
