"""The table of known answers as a page: the output of `gbspec check` for each case of `test_identifiability`.

python -m tests.passes.identifiability_table        rewrites docs/identifiability.md
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from gbspec.diagnostics import Diagnostic, Findings, Span
from gbspec.ir.model import Model
from gbspec.passes.identifiability import identifiability
from tests.passes.identifiability_cases import FURTHER, UNDECIDED
from tests.passes.test_identifiability import CASES, PAPER, paper
from tests.texts import model_of

PAGE = Path(__file__).parents[2] / "docs" / "identifiability.md"

HEAD = """# Structural identifiability: examples with known answers

`gbspec check` reports constants and functions that no data can distinguish, however many and exact the values are. This
table shows its answers for cases of the test suite (written by `python -m tests.passes.identifiability_table`).
Functions declared `unknown` are arbitrary functions of their arguments. States, conditions, inputs and the amounts of
doses may have any value within their declared ranges, inputs and doses at any time; every branch of `max`, `min`,
`abs`, `sign`, `floor` and `if` that this allows counts. Where it is open whether data reach a branch, the answer is
*undecided*, which is no warning. Of constants with a distribution the medians are sought, as if what is drawn for each
trajectory were known: what cannot be told apart then never can. A hidden state is among the remedies where observing
it is enough (of more than 8 it is not tried: *which may help*). Line numbers count from `model m`, the first.

| case | model | not distinguishable | transformation, or reason | lines | remedies |
|---|---|---|---|---|---|
"""


@cache
def cases() -> dict[str, tuple[str, Model]]:
    """Every case: the text that describes its model, and the model."""
    found = {
        name: (_shown(text), model_of("model m\n" + text))
        for name, (text, *_) in {**CASES, **FURTHER, **UNDECIDED}.items()
    }
    for name, unseen, *_ in PAPER:
        hidden = " and ".join(f"`{state}`" for state in unseen)
        title = f"`{name}`" + (f" without {hidden}" if unseen else "")
        found[title] = (
            f"bundled as `{name}`" + (f", {hidden} not observed" if unseen else ""),
            model_of("model m\n" + paper(name, unseen)),
        )
    return found


def row(name: str, shown: str, model: Model) -> str:
    """One row of the table."""
    findings = Findings()
    if not identifiability(model, findings, budget=4e9).decided:
        return f"| {name} | {shown} | undecided | | | |\n"
    told = [finding for finding in findings if finding.code in ("GB401", "GB402", "GB403", "GB404")]
    if not told:
        return f"| {name} | {shown} | nothing | | | |\n"
    columns = [
        "<br>".join(finding.message.split(" cannot ")[0] for finding in told),
        "<br>".join("; ".join(finding.notes) or finding.label for finding in told),
        "<br>".join(_lines(finding) for finding in told),
        "<br>".join(finding.help for finding in told),
    ]
    return f"| {name} | {shown} | " + " | ".join(column.replace("|", "\\|") for column in columns) + " |\n"


def _lines(finding: Diagnostic) -> str:
    """The lines that a diagnostic points to."""
    spans = [span for span in (finding.place, *(label.span for label in finding.labels)) if isinstance(span, Span)]
    return ", ".join(str(line) for line in sorted({span.position[0] for span in spans}))


def _shown(text: str) -> str:
    """A model's text in a cell of a table."""
    return "<br>".join(f"`{line}`" for line in text.strip().replace("|", "\\|").splitlines())


def main() -> None:
    """Writes the page."""
    PAGE.write_text(HEAD + "".join(row(name, *case) for name, case in cases().items()), encoding="utf-8")


if __name__ == "__main__":
    main()
