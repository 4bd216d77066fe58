"""The catalogue of codes: the meaning of each diagnostic, a minimal text that causes it, and the corrected text."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from types import MappingProxyType

from gbspec.diagnostics.diagnostic import Defect, Diagnostic, UserError


@dataclass(frozen=True)
class Entry:
    """The entry of one code; `topic` is the catalogue's file that has it."""

    code: str
    title: str
    explanation: str
    wrong: str
    right: str
    topic: str


@cache
def entries() -> Mapping[str, Entry]:
    """Every entry by its code, in the order of the codes; raises `Defect` if two entries have the same code."""
    found: dict[str, Entry] = {}
    for resource in files(__package__).iterdir():
        if not resource.name.endswith(".toml"):
            continue
        topic = resource.name.removesuffix(".toml")
        for code, fields in tomllib.loads(resource.read_text(encoding="utf-8")).items():
            if code in found:
                raise Defect(f"{code} is in the catalogue twice: {found[code].topic} and {topic}")
            texts = {key: str(value).strip("\n") for key, value in fields.items()}
            found[code] = Entry(code, texts["title"], texts["explanation"], texts["wrong"], texts["right"], topic)
    return MappingProxyType(dict(sorted(found.items())))


def all_codes() -> tuple[str, ...]:
    """Every code, in order."""
    return tuple(entries())


def explain(code: str) -> Entry:
    """The entry of a code, in upper or lower case; raises `UserError` (GB009) if there is none."""
    wanted = code.strip().upper()
    if wanted in entries():
        return entries()[wanted]
    raise UserError([Diagnostic("GB009", f"there is no code `{code}`", None, help=_instead(wanted))])


def _instead(wanted: str) -> str:
    """A hint for a code that does not exist: the codes of the same hundred, else the range of codes."""
    same_kind = [code for code in all_codes() if code[:3] == wanted[:3]]
    close = get_close_matches(wanted, same_kind or all_codes(), n=1, cutoff=0.5)
    if same_kind:
        meant = f"did you mean `{close[0]}`? " if close else ""
        return f"{meant}The codes of this kind are {_shortened(same_kind)}"
    if close and len(wanted) != len(close[0]):
        return f"did you mean `{close[0]}`?"
    kinds = sorted({code[:3] for code in all_codes()})
    first, last = f"{kinds[0]}xx", f"{kinds[-1]}xx"
    return f"codes run from `{first}` to `{last}`, such as `GB201`; a diagnostic shows its code in brackets"


def _shortened(codes: list[str]) -> str:
    """Codes in a list, runs of numbers as one: `GB701 to GB716, GB719`."""
    runs: list[list[str]] = []
    for code in codes:
        if runs and int(code[2:]) == int(runs[-1][-1][2:]) + 1:
            runs[-1].append(code)
        else:
            runs.append([code])
    return ", ".join(run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
