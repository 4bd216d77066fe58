"""JSON into frozen dataclasses by their annotations, and back; every invalid value is reported with its key.

A field may be a str, int, float, bool, None, Literal, tuple, Mapping from names, another such dataclass, or a union of
these. A field without a default is required. A dataclass with a field `others` keeps unknown keys; otherwise they are
dropped. A field with the metadata OMITTED is left out of the JSON where it is None.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from gbspec.files import read_bytes

T = TypeVar("T")
# A type annotation is `Any` here: a class, a union and `tuple[int, ...]` have no common type.

OTHERS = "others"
"""The field of a dataclass that holds unknown keys."""
OMITTED = {"omitted": True}
"""The metadata of a field whose value None is left out of the JSON, instead of null; its default is None."""
WORDS = {str: "a text", int: "a whole number", float: "a number", bool: "true or false", NoneType: "null"}
LARGEST = 2**64
"""Bound on the magnitude of integers: that of the seeds that torch takes."""
SHOWN = 40
"""Number of characters of a wrong value that are quoted in a message."""


class JsonError(ValueError):
    """JSON of unexpected form; `findings` has a sentence for each wrong key."""

    def __init__(self, findings: list[str]) -> None:
        self.findings = tuple(findings)
        super().__init__("; ".join(findings))


def read_object(path: Path) -> dict[str, object]:
    """The JSON object in a file. Raises JsonError if the file holds anything else, OSError if it cannot be read."""
    try:
        content = json.loads(read_bytes(path).decode("utf-8"), parse_constant=_refuse)
        json.dumps(content, ensure_ascii=False).encode("utf-8")  # an unpaired surrogate is valid JSON but not text
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, huge numbers, nested too deeply
        raise JsonError([str(error)]) from None
    if not isinstance(content, dict):
        raise JsonError([f"it holds {_shown(content)}; expected an object"])
    return content


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number of JSON")


def decode(kind: type[T], value: object, key: str = "") -> T:
    """A dataclass from a JSON value whose keys are below `key`. Raises JsonError with all errors in it."""
    findings: list[str] = []
    found: T = _read(kind, value, key, findings)
    if findings:
        raise JsonError(findings)
    return found


def encode(value: object) -> Any:
    """The JSON value of a dataclass or of a part of one: keys in the order of the fields, unknown keys last."""
    if is_dataclass(value) and not isinstance(value, type):
        written = [f.name for f in fields(value) if f.name != OTHERS and not _left_out(f, value)]
        known = {name: encode(getattr(value, name)) for name in written}
        return known | dict(getattr(value, OTHERS, {}))
    if isinstance(value, Mapping):
        return {name: encode(item) for name, item in value.items()}
    return [encode(item) for item in value] if isinstance(value, tuple) else value


def _left_out(declared: Field[Any], value: object) -> bool:
    return declared.metadata == OMITTED and getattr(value, declared.name) is None


def _read(kind: Any, value: Any, key: str, findings: list[str]) -> Any:
    """The value converted to `kind`; None, and an entry in `findings`, if it does not fit."""
    alternatives = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    fitting = next((one for one in alternatives if _fits(one, value)), None)
    if fitting is None:
        expected = " or ".join(map(_word, alternatives))
        findings.append(f"`{key}` is {_shown(value)}; expected {expected}")
        return None
    if is_dataclass(fitting):
        return _read_fields(fitting, value, key, findings)
    origin, arguments = get_origin(fitting), get_args(fitting)
    if origin is tuple:
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        entries = enumerate(zip(kinds, value, strict=True))
        return tuple(_read(one, item, f"{key}[{i}]", findings) for i, (one, item) in entries)
    if origin is Mapping:
        return {name: _read(arguments[1], item, _below(key, name), findings) for name, item in value.items()}
    return float(value) if fitting is float else value


def _read_fields(kind: Any, value: dict[str, Any], key: str, findings: list[str]) -> Any:
    known, found = _fields(kind), {}
    for name, (one, declared) in known.items():
        if name in value:
            found[name] = _read(one, value[name], _below(key, name), findings)
        elif declared.default is MISSING and declared.default_factory is MISSING:
            findings.append(f"`{_below(key, name)}` is missing; expected {_word(one)}")
    if any(f.name == OTHERS for f in fields(kind)):
        found[OTHERS] = {name: item for name, item in value.items() if name not in known}
    return None if findings else kind(**found)


@cache
def _fields(kind: Any) -> dict[str, tuple[Any, Field[Any]]]:
    """The fields that occur in the JSON: for each its type and its declaration."""
    hints = get_type_hints(kind)
    return {f.name: (hints[f.name], f) for f in fields(kind) if f.name != OTHERS}


def _fits(kind: Any, value: Any) -> bool:
    """Whether a value is of a kind; its parts are not examined."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return any(type(value) is type(one) and value == one for one in arguments)
    if origin is tuple:
        return isinstance(value, list) and (arguments[-1] is Ellipsis or len(value) == len(arguments))
    if is_dataclass(kind) or origin is Mapping:
        return isinstance(value, dict)
    if type(value) is int and kind in (int, float):
        return -LARGEST <= value < LARGEST
    return type(value) is kind and (kind is not float or math.isfinite(value))


def _word(kind: Any) -> str:
    """The expected kind, in words."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(map(_word, arguments))
    if origin is Literal:
        return "one of " + ", ".join(json.dumps(one) for one in arguments)
    if origin is tuple:
        return f"a list of {_many(arguments[0])}" if arguments[-1] is Ellipsis else f"a list of {len(arguments)}"
    return WORDS.get(kind, "an object")


def _many(kind: Any) -> str:
    return {str: "texts", int: "whole numbers", float: "numbers"}.get(kind, "entries")


def _shown(value: object) -> str:
    """A wrong value for a message: the value if it is short, otherwise its kind."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else f"a list of {len(value)}"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}…"


def _below(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name
