"""A condition whose column is empty in a table to predict on is named once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import tampering

MODEL = """model fall
time t : h
condition u : K in [280, 320] = 300
state x : g in [0, 9] = 1
learn k : 1/h = 0.3 in [0, 5]
x' = -k*x*u/(300 in K)
observe x
"""
TRAIN = ["--method", "lm", "--epochs", "2", "--no-warm-start", "--workers", "1", "--threads", "1"]


@pytest.mark.parametrize(("trained", "named"), [("290", "the training data had 290"), ("300", "GB793")])
def test_an_empty_condition_is_named_once(tmp_path: Path, trained: str, named: str) -> None:
    (tmp_path / "fall.gb").write_text(MODEL)
    rows = [f"{t},{x}" for t, x in ((0, 1), (1, 0.7), (2, 0.5), (3, 0.34))]
    (tmp_path / "data.csv").write_text("t,x,u\n" + "".join(f"{row},{trained}\n" for row in rows))
    (tmp_path / "new.csv").write_text("t,x,u\n" + "".join(f"{row},\n" for row in rows))
    status, _, said = tampering.called(("train", "fall.gb", "data.csv", "-o", "run", *TRAIN), tmp_path)
    assert status == 0, said
    status, out, said = tampering.called(("predict", "run", "new.csv", "-o", "p.csv"), tmp_path)
    told = [line for line in (out + said).splitlines() if "default, 300" in line]
    assert status == 0 and len(told) == 1 and named in told[0], told
