"""docs/reliability.md: its tests are there, its figures are those of the tables, its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")


def table(name: str) -> str:
    return (ROOT / "docs" / "studies" / f"{name}.md").read_text(encoding="utf-8")


def test_every_test_that_it_names_is_there() -> None:
    commands = re.findall(r"`pytest ([^`]*)`", TEXT)
    assert len(commands) > 20
    for command in commands:
        for node in re.sub(r' -k (".*"|\S+)', "", command).split():
            path, _, name = node.partition("::")
            assert (ROOT / path).exists(), path
            assert not name or f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), node


def test_every_point_has_a_command() -> None:
    points = re.findall(r"^\| (\d+) \| [^|]+ \| `(?:pytest|gbspec|python -m) [^|]*` \|$", TEXT, re.M)
    assert list(dict.fromkeys(points)) == [str(number) for number in range(1, 21)]


def test_its_figures_are_those_of_the_tables() -> None:
    kills = re.findall(r"^\| [\w -]+ \| (\d+) \| \d+ \| \d+ \| (\d+) \| 0 \|$", table("kills"), re.M)
    total, continued = (sum(int(number) for number in column) for column in zip(*kills, strict=True))
    assert f"{continued} of {total} runs continued" in TEXT
    _, mutants, killed, alike, survived, idle, share = re.findall(
        r"^\| (all) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) % \|$", table("mutants"), re.M
    )[0]
    assert int(killed) + int(alike) + int(survived) + int(idle) == int(mutants) and int(share) >= 90
    assert f"{killed} of {mutants} killed, {alike} equivalent" in TEXT
    commands = sum(int(count) for count in re.findall(r"^\| (?:0|1|70), .* \| (\d+) \|$", table("tampered"), re.M))
    offered, pairs = re.findall(r"^## .*: (\d+) of (\d+) pairs are offered$", table("pairs"), re.M)[0]
    assert f"{offered} of {pairs} pairs are offered" in TEXT
    assert f"{commands} commands: none ended as a defect" in TEXT


def test_every_link_leads_somewhere() -> None:
    assert all((ROOT / "docs" / target).exists() for target in re.findall(r"\]\(([^)#]+)\)", TEXT))
