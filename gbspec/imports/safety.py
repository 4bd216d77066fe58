"""Reading XML from anywhere: its size, its depth, its encoding and its entities are checked before a library sees it.

The check reads the text once with expat, which keeps nothing and resolves nothing outside of the file. A document type
declaration is refused altogether, and with it every entity beside the five of XML.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from gbspec.diagnostics import Cell, Diagnostic, UserError
from gbspec.files import TooLargeError, existing, read_bytes

MOST_BYTES = 20_000_000
"""The size of a file."""
DEEPEST = 200
"""The depth of its elements; libraries and this package follow formulas by recursion."""
MOST_ELEMENTS = 200_000
"""The number of its elements; a library needs some kilobytes for each."""
MOST_DECLARED = 5_000
"""The number of quantities and reactions: each becomes up to four statements, of which a model has at most 10,000."""
_DECLARING = frozenset(("compartment", "species", "parameter", "localParameter", "reaction"))
_ENCODING = re.compile(rb"""^\s*<\?xml[^>]*?encoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
_ENCODINGS = {b"utf-8", b"us-ascii", b"ascii", b"iso-8859-1"}
HELP = "is this file complete, and what you expect? docs/howto/import.md has the limits"


def read_file(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file. Raises `UserError` (GB894) if it is larger than is read."""
    existing(path)
    try:
        return read_bytes(path, most)
    except TooLargeError:
        raise refused(path, f"it is larger than {most:,} bytes") from None


@dataclass(frozen=True)
class Root:
    """The outermost element of an XML file: its name without prefix, its namespace, and its attributes."""

    name: str
    namespace: str
    attributes: Mapping[str, str]


def read_xml(path: str | Path) -> tuple[bytes, Root]:
    """The bytes of an XML file that a library may be given, and its root. Raises `UserError` (GB894)."""
    data = read_file(path)
    if data.startswith((b"\xff\xfe", b"\xfe\xff", b"\x00", b"<\x00")):
        raise refused(path, "it is not UTF-8")
    said = _ENCODING.match(data.removeprefix(b"\xef\xbb\xbf"))
    if said is not None and said[1].lower() not in _ENCODINGS:
        raise refused(path, f"its encoding `{said[1].decode('ascii')}` is not read; save it as UTF-8")
    return data, _scan(path, data)


def refused(path: str | Path, reason: str, line: int | None = None) -> UserError:
    """The error (GB894) of a file that is not read."""
    return UserError([Diagnostic("GB894", f"`{path}` is not read: {reason}", Cell(str(path), line), help=HELP)])


class _StopError(Exception):
    """What the scan found, and where."""


def _scan(path: str | Path, data: bytes) -> Root:
    parser = expat.ParserCreate()
    depth = count = quantities = 0
    roots: list[Root] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count, quantities
        depth, count, quantities = depth + 1, count + 1, quantities + (name.rpartition(":")[2] in _DECLARING)
        if not roots:
            prefix, _, plain = name.rpartition(":")
            space = attributes.get(f"xmlns:{prefix}" if prefix else "xmlns", "")
            roots.append(Root(plain, space, attributes))
        if depth > DEEPEST:
            raise _StopError(f"its elements are more than {DEEPEST} deep")
        if count > MOST_ELEMENTS:
            raise _StopError(f"it has more than {MOST_ELEMENTS:,} elements")
        if quantities > MOST_DECLARED:
            raise _StopError(f"it has more than {MOST_DECLARED:,} quantities and reactions")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    def declared(*given: object) -> None:
        raise _StopError("it has a document type declaration, which can define entities")

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.StartDoctypeDeclHandler = declared
    try:
        parser.Parse(data, True)
    except _StopError as found:
        raise refused(path, str(found), parser.CurrentLineNumber) from None
    except expat.ExpatError as error:
        raise refused(path, f"it is no well-formed XML: {expat.ErrorString(error.code)}", error.lineno) from None
    return roots[0]
