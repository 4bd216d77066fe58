"""Models whose functions are all known: the published least squares are reached."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data.table import read
from gbspec.diagnostics import Findings
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of

pytestmark = pytest.mark.usefixtures("quick_fits")

DATA = Path(__file__).parents[3] / "shared" / "data"

ALPHA_PINENE = """model alpha_pinene
time t from 0
state y1
state y2
state y3
state y4
state y5
learn p1 = 1e-4 > 0
learn p2 = 1e-4 > 0
learn p3 = 1e-4 > 0
learn p4 = 1e-4 > 0
learn p5 = 1e-4 > 0
y1' = -(p1 + p2)*y1
y2' = p1*y1
y3' = p2*y1 - (p3 + p4)*y3 + p5*y5
y4' = p3*y3
y5' = p4*y3 - p5*y5
initial y1 = 100
initial y2 = 0
initial y3 = 0
initial y4 = 0
initial y5 = 0
observe y1 noise normal(1)
observe y2 noise normal(1)
observe y3 noise normal(1)
observe y4 noise normal(1)
observe y5 noise normal(1)
"""

GAS_OIL = """model gas_oil
time t from 0
state y1
state y2
learn k1 = 1 in [0, 100]
learn k2 = 1 in [0, 100]
learn k3 = 1 in [0, 100]
y1' = -(k1 + k3)*y1^2
y2' = k1*y1^2 - k2*y2
initial y1 = 1
initial y2 = 0
observe y1 noise normal(1)
observe y2 noise normal(1)
"""


@pytest.mark.parametrize(
    ("text", "table", "expected"),
    [
        (ALPHA_PINENE, "alpha_pinene.csv", 19.872),
        (GAS_OIL, "gas_oil.csv", 0.0052366),
    ],
)
def test_reaches_the_published_sum_of_squares(text: str, table: str, expected: float, tmp_path: Path) -> None:
    if not (DATA / table).is_file():
        pytest.skip(f"the table {table} is not there")
    model, findings = model_of(text), Findings()
    data = read(DATA / table, model, findings)
    run = train(model, data, TrainOptions(), tmp_path / "run")
    counts = np.isfinite(data.items[0].values).sum(axis=0)
    rmse = run.fit.members[0].rmse
    total = sum(n * rmse[name] ** 2 for n, name in zip(counts, data.channels, strict=True))
    assert total == pytest.approx(expected, rel=1e-4)
