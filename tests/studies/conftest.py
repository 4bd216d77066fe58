"""Cases that are fitted in seconds, and records as members leave them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gbspec.runs import StageRecord, StepRecord
from gbspec.studies.record import Counts, Fitted, Record

DECAY = """\
model decay "First-order decay, rate unknown"
state N in [0, 2] = 1
unknown rate(N) by mlp(4)
learn k = 0.5 in [0.1, 2]
N' = -k*N - rate(N)
observe N
truth rate(N) = 0.3*N^2
truth k = 0.7
"""

CASES = """
[sampling]
trajectories = 4
span = 2
dt = 0.25
initial = { N = [0.5, 2] }

[metrics]
conditions = 1
points = 2
rhs-points = 4

[training]
method = "lm"
epochs = 2
warm-start = false
members = 2

[case.ONE]
title = "the first"
model = "decay"
published = { solution = 1e-2, constants = 1e-1 }

[case.TWO]
tables = ["eigenvalues", "initial-states"]
title = "the second"
model = "decay"
sampling = { noise = 0.1 }
training = { members = 1 }
"""


@pytest.fixture
def cases(tmp_path: Path) -> Path:
    """A folder with a model and two cases."""
    (tmp_path / "decay.gb").write_text(DECAY)
    path = tmp_path / "cases.toml"
    path.write_text(CASES)
    return path


def fitted(solution: float, **more: Any) -> Fitted:
    """What a finished member reached."""
    given: dict[str, Any] = {
        "data": Counts(4, 36, 36),
        "cpu_seconds": 10.0,
        "wall_seconds": 20.0,
        "other_cpu_seconds": 1.0,
        "loss": 0.5,
        "stages": (StageRecord("start", 1, 0.5, 0.1),),
        "constants": {"k": 0.7},
        "max_step": 0.25,
        "errors": {"solution": {"L1": 2 * solution, "L2": solution, "Linf": 3 * solution, "failed": 0}},
        "nrmse": {"N": 0.1},
        "unsolved": (),
        "step_check": StepRecord(1e-6, 1e-6, 0.25, 4),
        "step_warning": None,
        "warnings": (),
        "versions": {"gbspec": "1"},
    }
    return Fitted(**given | more)


def record(member: int, solution: float, *, case: str = "ONE", seed: int | None = None, settings: str = "",
           resumed: bool = False, **more: Any) -> Record:  # fmt: skip
    """A finished member as `gbspec.studies.member` writes it; `more` are fields of what it reached."""
    return Record(
        case=case,
        member=member,
        seed=member if seed is None else seed,
        settings=settings,
        resumed=resumed,
        finished="2026-01-01",
        machine="here",
        fitted=fitted(solution, cpu_seconds=10.0 + member, **more),
    )
