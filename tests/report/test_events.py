"""Events on the page of a report."""

from __future__ import annotations

import math
from pathlib import Path
from xml.dom.minidom import parseString

import gbspec
from gbspec.report.html.page import _equations
from tests.texts import model_of

MODEL = """model room
time t : h from 0
state T in [10, 30] = 20
discrete on = 1
event start when T <= 18: on = 1, T = T + 0.1
event dusk at 9 every 24 until 90: on = 0
event tick every 2: on = 1 - on
T' = 6*on - T
observe T
"""


def test_events_say_when_they_happen_and_what_they_set() -> None:
    blocks = dict(_equations(model_of(MODEL)))
    shown = str(blocks["Events"])
    parseString(shown)  # well formed
    for part in ("start:", "≤", "dusk:", "<mn>24</mn>", "<mn>90</mn>", "tick:", "≔", "⇒"):
        assert part in shown, part
    assert "Events" not in dict(_equations(model_of("model m\nstate x = 1\nx' = -x\nobserve x\n")))


def test_a_report_leaves_the_eigenvalues_of_a_switching_model_out(tmp_path: Path) -> None:
    text = "model m\nstate x in [0, 2] = 1\ndiscrete low = 0\nlearn k = 0.5 in [0.1, 2]\nx' = -k*x + 0.01*low\n"
    (tmp_path / "m.gb").write_text(f"{text}event fall when x <= 0.8: low = 1\nobserve x\n")
    (tmp_path / "t.csv").write_text("t,x\n" + "".join(f"{0.2 * i},{math.exp(-0.1 * i)}\n" for i in range(6)))
    run = gbspec.load(tmp_path / "m.gb").train(
        tmp_path / "t.csv",
        tmp_path / "run",
        method="lm",
        epochs=1,
        effort="low",
        half_step=False,
        warm_start=False,
        backend="torch",
    )
    page = run.report(tmp_path / "report.html").read_text(encoding="utf-8")
    assert "fall" in page and "eigenvalues of the Jacobian" not in page
