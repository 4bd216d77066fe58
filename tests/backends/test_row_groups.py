"""Rows of the Jacobian that one reverse pass gives together: of states whose balances share no state."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

from gbspec.backends.native.flat import flatten
from gbspec.backends.native.row_groups import groups_of, seen_states
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model

MODEL = """model grid
state s[1..9] in [0, 5] = 1
state total = 0
state q = 0
unknown f(x) by mlp(4)
s[i]' = s[i-1] - 2*s[i] + s[i+1] - f(s[i])
s[0] = s[2]
s[10] = 0
total' = sum(s)
q' = if(s[3] > 2, s[3]*sin(t), 1) + exp(-q)
observe total
"""


def test_a_grid_has_three_groups_however_long_it_is(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(MODEL)
    model = load_model(tmp_path / "m.gb", Findings())
    seen = [sorted(states) for states in seen_states(flatten(model, model.balances))]
    assert seen[:3] == [[0, 1], [0, 1, 2], [1, 2, 3]] and seen[8] == [7, 8]
    assert seen[9] == list(range(9)) and seen[10] == [2, 10]
    groups = groups_of(list(map(frozenset, seen)))
    assert groups[:9] == [0, 1, 2] * 3 and len(set(groups)) == 5
    for a, b in combinations(range(len(seen)), 2):
        assert groups[a] != groups[b] or not set(seen[a]) & set(seen[b])
