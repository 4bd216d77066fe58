"""Events on the page of a report."""

from __future__ import annotations

from xml.dom.minidom import parseString

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
