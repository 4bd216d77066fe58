"""Values given by `--set` are written to the text that a run stores."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Source
from gbspec.syntax.settings import with_settings

CASES = [
    ("const Q = 1/3  # share", {"Q": 2.0}, "const Q = 2.0  # share"),
    ("const Q : L = 1", {"P": 2.0}, "const Q : L = 1"),
    ("learn k = 1 in [0, 10]", {"k": 3.0}, "learn k = 3.0 in [0, 10]"),
    ("learn k = 1 in [0, 10]", {"k": 30.0}, "learn k = 30.0 in [0, 30.0]"),
    ("learn k : 1/h in [-2, 10]", {"k": -3.0}, "learn k = -3.0 : 1/h in [-3.0, 10]"),
    ("learn k = 1 > 0", {"k": -1.0}, "learn k = -1.0 > -1.0"),
    ("learn μ = 1", {"μ": 1e-5}, "learn μ = 1e-05"),
    ("condition D in [0, 1]", {"D": 0.5}, "condition D = 0.5 in [0, 1]"),
    ("condition D in [0, 1] = 0.1", {"D": 2.0}, "condition D in [0, 2.0] = 2.0"),
    ("input F held", {"F": 2.0}, "input F = 2.0 held"),
    ("truth k = 1", {"k": 2.0}, "truth k = 1"),
]


@pytest.mark.parametrize(("statement", "values", "wanted"), CASES, ids=[case[0] for case in CASES])
def test_the_text_has_the_value(statement: str, values: dict[str, float], wanted: str) -> None:
    assert with_settings(Source("m.gb", f"model m\n{statement}\n"), values) == f"model m\n{wanted}\n"


def test_several_values_at_once() -> None:
    text = "model m\nconst a = 1\nlearn b = 1\nconst c = 1\n"
    wanted = "model m\nconst a = 10.0\nlearn b = 20.0\nconst c = 30.0\n"
    assert with_settings(Source("m.gb", text), {"c": 30.0, "a": 10.0, "b": 20.0}) == wanted
