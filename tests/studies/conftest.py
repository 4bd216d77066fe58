"""Cases that are fitted in seconds, and records as members leave them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

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


def record(member: int, solution: float, **more: Any) -> dict[str, Any]:
    """A finished member as `gbspec.studies.member` writes it."""
    return {
        "case": "ONE",
        "member": member,
        "seed": member,
        "settings": "",
        "resumed": False,
        "finished": "2026-01-01",
        "machine": "here",
        "errors": {"solution": {"L1": 2 * solution, "L2": solution, "Linf": 3 * solution, "failed": 0}},
        "nrmse": {"N": 0.1},
        "constants": {"k": 0.7},
        "cpu_seconds": 10.0 + member,
        "wall_seconds": 20.0,
        "loss": 0.5,
        "step_warning": None,
        "versions": {"gbspec": "1"},
        **more,
    }
