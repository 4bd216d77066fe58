"""Every wrong file under tests/bad gets exactly the diagnostics of its `.expected` file.

`GBSPEC_REWRITE=1 pytest tests/bad` rewrites the expected files; read the difference before committing it.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, UserError
from gbspec.diagnostics.render import render_text

HERE = Path(__file__).parent
FILES = sorted(path for path in HERE.glob("*/*.gb") if not path.stem.startswith("_"))


def rendered_findings(path: Path) -> str:
    """The output of the whole front end for a file, with paths relative to the file's folder."""
    findings = Findings()
    try:
        run_front_end(path, findings)
    except UserError as error:
        findings.extend(error.diagnostics)
    return render_text(findings).replace(f"{path.parent}{os.sep}", "")


def run_front_end(path: Path, findings: Findings) -> None:
    """Runs all steps of `gbspec check`."""
    from gbspec.frontend import load_model
    from gbspec.passes.examination import examine

    examine(load_model(path, findings), findings)


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_wrong_file_gets_its_diagnostics(path: Path) -> None:
    found = rendered_findings(path)
    expected = path.with_suffix(".expected")
    if os.environ.get("GBSPEC_REWRITE"):
        expected.write_text(found, encoding="utf-8")
    assert expected.is_file(), f"no {expected.name}; run with GBSPEC_REWRITE=1 and read what it says"
    assert found == expected.read_text(encoding="utf-8")
    assert found, "a file under tests/bad must have an error or a warning"
