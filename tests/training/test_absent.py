"""Categories that the data do not have."""

from __future__ import annotations

from pathlib import Path

from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.training.runs.absent import without_data
from tests.texts import model_of

STRAINS = """model strains
state X
condition strain in {"wild type", mutant, other}
learn k = 1 in [0.1, 5] per strain
learn s = 1
X' = -k*X + s
observe X
"""


def remarks(folder: Path, strains: str) -> list[str]:
    model = model_of(STRAINS, folder)
    path = folder / "data.csv"
    rows = "".join(f"{i},{t},{1 - t / 3},{strain}\n" for i, strain in enumerate(strains.split(",")) for t in (0, 1))
    path.write_text("trajectory,t,X,strain\n" + rows, encoding="utf-8")
    return without_data(model, tables.read_data(path, model, Findings()))


def test_the_constant_of_a_category_without_data_is_named(tmp_path: Path) -> None:
    (told,) = remarks(tmp_path, "wild type,mutant")
    assert told.startswith('no trajectory has the `strain` "other", so that nothing is learned of `k_other`, whose')


def test_nothing_is_said_where_every_category_has_data(tmp_path: Path) -> None:
    assert remarks(tmp_path, "wild type,mutant,other") == []
