"""Used by the release workflow: that all files name one version, and the changes of a version.

python packaging/versions.py [TAG]             exits with 1 if a file, or the tag, names another version
python packaging/versions.py --changes TAG     prints the section of CHANGELOG.md
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OTHERS = {
    "gbspec/version.py": r'__version__ = "([^"]+)"',
    "CITATION.cff": r"^version: (\S+)$",
    "packaging/conda/recipe.yaml": r'^  version: "([^"]+)"$',
}
"""Files that name the version besides pyproject.toml, and how."""


def versions() -> dict[str, str]:
    """The version that each file names; empty where it names none."""
    found = {"pyproject.toml": tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]}
    for name, pattern in OTHERS.items():
        match = re.search(pattern, (ROOT / name).read_text("utf-8"), re.M)
        found[name] = match[1] if match else ""
    return found


def changes(version: str) -> str:
    """The section of a version in the changelog, without its heading; raises SystemExit if there is none."""
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    match = re.search(rf"^## \[{re.escape(version)}\][^\n]*\n(.*?)(?=^## \[|\Z)", text, re.S | re.M)
    if match is None:
        raise SystemExit(f"CHANGELOG.md has no section of {version}")
    return match[1].strip() + "\n"


def main(arguments: list[str]) -> int:
    """The command."""
    if arguments[:1] == ["--changes"]:
        print(changes(arguments[1].removeprefix("v")), end="")
        return 0
    found = versions()
    if arguments and arguments[0]:
        found["the tag"] = arguments[0].removeprefix("v")
    for name, version in found.items():
        print(f"{name}: {version or 'none'}")
    return int(len(set(found.values())) > 1)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
