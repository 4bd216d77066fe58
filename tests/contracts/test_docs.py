"""The examples of docs/contracts.md compile, and the codes and files that it names exist."""

from __future__ import annotations

import re
from pathlib import Path

from gbspec.diagnostics.catalogue import entries
from tests.contracts.helpers import whole_model

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "contracts.md").read_text(encoding="utf-8")


def test_examples_keep_their_contracts() -> None:
    examples = re.findall(r"^```gb\n(.*?)^```$", TEXT, re.S | re.M)
    assert examples
    for example in examples:
        assert all(unknown.form is not None for unknown in whole_model(example).unknowns)


def test_codes_and_files_exist() -> None:
    assert set(re.findall(r"GB\d{3}", TEXT)) <= set(entries())
    for name in re.findall(r"`((?:gbspec|benchmarks)/[a-z_/]+\.py)`", TEXT):
        assert (ROOT / name).is_file(), name
