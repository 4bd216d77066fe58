"""paper/paper.md: its references exist, and its numbers are those of the committed tables."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAPER = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
BIB = (ROOT / "paper" / "paper.bib").read_text(encoding="utf-8")


def text(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def test_every_reference_is_in_the_list_and_every_entry_is_cited() -> None:
    cited = set(re.findall(r"@([a-z]+\d{4})", PAPER))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", BIB, re.M))


def test_the_model_is_that_of_the_readme() -> None:
    (shown,) = re.findall(r"^```\n(model .*?)^```$", PAPER, re.S | re.M)
    assert f"```gb\n{shown}```" in text("README.md")


def test_the_numbers_are_those_of_the_tables() -> None:
    factors = {
        case: float(cells.split("|")[4])
        for case, cells in re.findall(
            r"^\| (\w+) \| right-hand side \|(.*)$", text("docs/studies/paper/table.md"), re.M
        )
    }
    main = {name for name in factors if not name.endswith("PUBLISHED")}
    reactor = [factors[name] for name in main if not name.startswith("BF")]
    chemostat = [factors[name] for name in ("BF_BB", "BF_GB1", "BF_GB2")]
    assert f"{min(reactor):.0f} to {round(max(reactor), -2):.0f}" == "440 to 1600" and "factors of 440 to 1600" in PAPER
    assert f"{min(chemostat):.0f} to {max(chemostat):.0f}" == "12 to 56" and "12 to 56" in PAPER
    ((sets, found),) = re.findall(r"^\| all \| \| (\d+) \| (\d+) \(", text("docs/studies/known_forms.md"), re.M)
    assert f"{found} of {sets} fits" in PAPER
    inside = re.findall(r"^\| all \| \| (\w+) \| \| (\d+) \| (\d+) % \|", text("docs/studies/coverage.md"), re.M)
    ((_, cases, constants), (_, _, functions)) = inside
    assert f"{constants} % of {cases} cases" in PAPER and f"functions in {functions} % of" in PAPER
    step = text("benchmarks/results/step.md")
    assert all(number in step for number in ("56.3", "124.2", "202.7"))
    assert "56 ms" in PAPER and "124 ms" in PAPER and "203 ms" in PAPER
    kills = re.findall(r"^\| [\w -]+ \| (\d+) \| \d+ \| \d+ \| (\d+) \| 0 \|$", text("docs/studies/kills.md"), re.M)
    total = sum(int(runs) for runs, _ in kills)
    assert total == sum(int(continued) for _, continued in kills) and f"all {total} runs" in PAPER
