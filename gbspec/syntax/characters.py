"""The characters of a statement, before its grammar: signs from word processors, invisible characters, open strings.

`clean` gives the text that the parser reads: of the same length as the statement, comments blanked, signs that have a
plain spelling replaced by it (and reported), so that the rest of the statement is checked too.
"""

from __future__ import annotations

import re
import unicodedata

from gbspec.diagnostics import Diagnostic, Label, Span
from gbspec.syntax.chunks import Chunk

_PIECE = re.compile(
    r'(?P<string>"[^"\n]*")|(?P<curly>[“”„«»][^“”„«»"\n]*[“”„«»"])|(?P<open>"[^\n]*)|(?P<comment>#[^\n]*)'
)
_STRING = re.compile(r'"[^"\n]*"')
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f]")
_UNUSUAL = re.compile(r"[^\x20-\x7e\n\t]")

# The plain spelling of a sign, and the character that replaces it while the statement is parsed.
_PLAIN = {
    **dict.fromkeys("·⋅∙×∗⨯•", ("*", "*")),
    **dict.fromkeys("−–—‐‑﹣－", ("-", "-")),
    **dict.fromkeys("÷∕⁄", ("/", "/")),
    **dict.fromkeys("’‘′ʹ´ʼ", ("'", "'")),
    **dict.fromkeys("→⟶➝", ("->", "→")),
    **dict.fromkeys("≤⩽≦", ("<=", "≤")),
    **dict.fromkeys("≥⩾≧", (">=", "≥")),
    "＝": ("=", "="),
    "，": (",", ","),
    "：": (":", ":"),
    "（": ("(", "("),
    "）": (")", ")"),
    "［": ("[", "["),
    "］": ("]", "]"),
    "＋": ("+", "+"),
    "＊": ("*", "*"),
    "／": ("/", "/"),
}
_HINTS = {
    "√": "write `sqrt(…)`",
    "∞": "leave the bound out where there is none",
    "≠": "write `not a == b`",
    "°": "write the unit's name, e.g. `degC` for degrees Celsius",
    "∂": "a balance is written `x' = …`",
    "∆": "use the Greek letter `Δ` (capital delta) or a word",
    "∑": "write each term, or `sum(c)` for an array of states",
    "∏": "write each factor",
    "±": "noise is written `noise normal(sd)`",
    "½": "write `1/2`",
    "¼": "write `1/4`",
    "¾": "write `3/4`",
    "⇌": "write two processes, one for each direction",
    "⇄": "write two processes, one for each direction",
    "←": "reverse it: consumed `->` produced",
}


def clean(chunk: Chunk) -> tuple[str | None, list[Diagnostic]]:
    """The text to parse and the diagnostics about its characters; None for the text if it cannot be parsed."""
    text = chunk.source.text[chunk.start : chunk.end]
    if text.isascii() and '"' not in text and "#" not in text and not _UNUSUAL.search(text):
        return text, []
    parts: list[str] = []
    findings: list[Diagnostic] = []
    place = 0
    readable = True
    for piece in _PIECE.finditer(text):
        parts.append(text[place : piece.start()])
        place = piece.end()
        span = Span(chunk.source, chunk.start + piece.start(), chunk.start + piece.end())
        match piece.lastgroup:
            case "comment":
                parts.append(" " * len(piece[0]))
            case "open":
                findings.append(_open_string(span))
                readable = False
            case "curly":
                findings.append(_curly_quotes(span))
                parts.append(f'"{piece[0][1:-1]}"')
            case _:
                parts.append(piece[0])
    parts.append(text[place:])
    joined = "".join(parts)
    if not readable:
        return None, findings
    replaced, unusual = _replace(chunk, joined)
    return replaced, findings + unusual


def _open_string(span: Span) -> Diagnostic:
    start = Span(span.source, span.start, span.start + 1)
    return Diagnostic(
        "GB108",
        "this text is not closed",
        start,
        label="begins here",
        help='close it with `"` on the same line; a text cannot span several lines',
    )


def _curly_quotes(span: Span) -> Diagnostic:
    return Diagnostic(
        "GB005",
        f"`{span.text[0]}` and `{span.text[-1]}` are typographic quotation marks",
        span,
        label="this text",
        help=f'write `"{span.text[1:-1]}"`',
    )


def _replace(chunk: Chunk, text: str) -> tuple[str | None, list[Diagnostic]]:
    """Handles unusual characters outside strings; the same character is reported once per statement."""
    if text.isascii() and not _UNUSUAL.search(text):
        return text, []
    letters = list(text)
    places: dict[str, list[int]] = {}
    raised = -1  # where a run of superscripts or subscripts ends: it is reported once
    outside = _STRING.sub(lambda found: " " * len(found[0]), text)
    for found in _UNUSUAL.finditer(outside):
        at, character = found.start(), found[0]
        if character in _PLAIN:
            letters[at] = _PLAIN[character][1]
        elif unicodedata.category(character) == "Zs":
            letters[at] = " "
            continue
        elif ("a" + character).isidentifier():
            continue
        if unicodedata.decomposition(character).startswith(("<super>", "<sub>")):
            if at == raised:
                raised += 1
                continue
            raised = at + 1
        places.setdefault(character, []).append(at)
    for string in _STRING.finditer(text):
        for control in _CONTROL.finditer(text, *string.span()):
            places.setdefault(control[0], []).append(control.start())
    findings = [_unusual(chunk, character, where) for character, where in places.items()]
    readable = all(character in _PLAIN for character in places)
    return ("".join(letters) if readable else None), findings


def _unusual(chunk: Chunk, character: str, places: list[int]) -> Diagnostic:
    spans = [Span(chunk.source, chunk.start + at, chunk.start + at + 1) for at in places]
    again = tuple(Label(span, "and here") for span in spans[1:4])
    if character in _PLAIN:
        plain = _PLAIN[character][0]
        message = f"`{character}` ({_described(character)}) is written `{plain}` here"
        return Diagnostic("GB005", message, spans[0], labels=again, help=f"write `{plain}`")
    if unicodedata.category(character) in ("Cc", "Cf", "Zl", "Zp", "Co", "Cn", "Cs"):
        name = unicodedata.name(character, "a control character").lower()
        message = f"there is an invisible character (U+{ord(character):04X}, {name}) here"
        return Diagnostic("GB004", message, spans[0], labels=again, help="delete it; it often comes with pasted text")
    if unicodedata.decomposition(character).startswith("<super>"):
        message = f"`{character}` (a superscript) is not read as a power"
        power = _run(spans[0], "<super>")
        return Diagnostic("GB006", message, spans[0], labels=again, help=f"write `^{power}`")
    if unicodedata.decomposition(character).startswith("<sub>"):
        message = f"`{character}` (a subscript) is not allowed in a name"
        index = _run(spans[0], "<sub>")
        return Diagnostic("GB006", message, spans[0], labels=again, help=f"write `{index}` or `_{index}`")
    message = f"`{character}` ({_described(character)}) has no meaning here"
    hint = _HINTS.get(character, "names are letters of any script, digits and `_`; everything else is plain ASCII")
    return Diagnostic("GB007", message, spans[0], labels=again, help=hint)


def _run(first: Span, kind: str) -> str:
    """The plain spelling of a run of superscripts or subscripts."""
    text, end = first.source.text, first.start
    while end < len(text) and unicodedata.decomposition(text[end]).startswith(kind):
        end += 1
    return unicodedata.normalize("NFKC", text[first.start : end]).replace("−", "-")


def _described(character: str) -> str:
    return unicodedata.name(character, f"U+{ord(character):04X}").lower()
