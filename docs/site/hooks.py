"""What happens before Sphinx reads the pages: generated pages are written, links out of docs/ are made to fit."""

from __future__ import annotations

import re
from pathlib import Path

import reference

OUTSIDE = re.compile(r"\[([^\]\n]+)\]\((?:\.\./)+([^)\n]+)\)")
"""A link to a file of the repository above docs/."""


def prepare(docs: Path) -> None:
    """Writes the pages of docs/reference that are generated from the sources."""
    folder = docs / "reference"
    folder.mkdir(exist_ok=True)
    for name, text in reference.pages().items():
        path = folder / name
        # an unchanged page keeps its time, so that Sphinx does not read it again
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def titled(name: str, text: list[str]) -> None:
    """A page of a study that begins with its table gets its name as a title."""
    if name.startswith("studies/") and not text[0].lstrip().startswith("# "):
        words = Path(name).stem if Path(name).stem != "table" else Path(name).parent.name
        text[0] = f"# {words.replace('_', ' ').capitalize()}\n\n{text[0]}"


def repository_links(text: list[str], repository: str) -> None:
    """Links such as `](../models/urp/urp_gb2.gb)` lead to the repository, or become their text if none is known."""

    def replaced(link: re.Match[str]) -> str:
        if (Path(__file__).parents[1] / link[2]).exists():  # from a subfolder of docs/ to another page
            return link[0]
        return f"[{link[1]}]({repository}/{link[2]})" if repository else link[1]

    text[0] = OUTSIDE.sub(replaced, text[0])
