"""Checks that a built site works without a network: no page or style sheet loads anything from an address.

    python docs/site/offline.py build/site

Links that a reader may follow are allowed; scripts, style sheets, fonts, images and frames are not.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

REMOTE = re.compile(r"(?:https?:)?//", re.I)
ATTRIBUTES = {
    "script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src", "embed": "src",
    "object": "data", "link": "href",
}  # fmt: skip
METADATA = {"canonical", "alternate", "author", "license"}
"""Kinds of `link` that say something and load nothing."""
STYLE = re.compile(r"(?:url\(\s*['\"]?|@import\s+['\"])((?:https?:)?//[^'\")\s]+)", re.I)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.style = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = dict(attributes)
        self.style = tag == "style"
        self.found += STYLE.findall(given.get("style") or "")
        if tag == "link" and METADATA & set((given.get("rel") or "").split()):
            return
        target = given.get(ATTRIBUTES.get(tag, "")) or ""
        if REMOTE.match(target):
            self.found.append(target)

    def handle_data(self, data: str) -> None:
        if self.style:
            self.found += STYLE.findall(data)


def remote(path: Path) -> Iterator[str]:
    """What a page or a style sheet loads from an address."""
    text = path.read_text(encoding="utf-8", errors="replace")
    if path.suffix == ".css":
        yield from STYLE.findall(text)
        return
    page = _Page()
    page.feed(text)
    yield from page.found


def main(folder: str) -> int:
    """Prints what is found; 1 if anything is, or if there is no page."""
    paths = [path for path in sorted(Path(folder).rglob("*")) if path.suffix in (".html", ".css")]
    found = [(path, address) for path in paths for address in remote(path)]
    for path, address in found:
        print(f"{path}: loads {address}")
    print(f"{len(paths)} pages and style sheets, {len(found)} addresses from which they load")
    return int(bool(found) or not paths)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
