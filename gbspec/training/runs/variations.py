"""The options that a sweep varies, and the runs of all their combinations."""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any, Literal, TypeAlias, get_args, get_origin

from gbspec.diagnostics import Findings
from gbspec.training.options import TrainOptions

Setting: TypeAlias = Any
"""The value of an option: of the type of the field that it names."""
# A type annotation is `Any` here: a class, a union and `tuple[int, ...]` have no common type.
FIXED = frozenset({"resume", "workers", "threads", "scheduler"})
"""Options of a call, which a sweep accepts but does not vary."""


@dataclass(frozen=True)
class Point:
    """One run of a sweep: its name, which is also that of its directory, its varied options, and all options."""

    name: str
    varied: dict[str, Setting]
    options: TrainOptions


def points(texts: Sequence[str], base: TrainOptions, findings: Findings) -> list[Point]:
    """Every combination of the variations `NAME=VALUE,VALUE,...`, the last one varying fastest, the rest from `base`.

    Errors are recorded in `findings`: GB862 for an invalid variation, GB850 for an invalid value.
    """
    varied: dict[str, list[Setting]] = {}
    for text in texts:
        name, values = _variation(text, findings)
        if name in varied:
            findings.error("GB862", f"`--vary` gives `{name}` twice", None, help="give all its values at once")
        varied[name] = values
    if not texts:
        help_text = "name at least one option and its values: --vary effort=low,normal"
        findings.error("GB862", "nothing is varied", None, help=help_text)
    out = []
    for combination in product(*varied.values()):
        chosen = dict(zip(varied, combination, strict=True))
        if all(name in _types() for name in chosen):
            name = ",".join(f"{name}={_text(value)}" for name, value in chosen.items())
            out.append(Point(name, chosen, replace(base, **chosen)))
    for name, values in varied.items():
        for value in values if name in _types() else ():
            replace(TrainOptions(), **{name: value}).check(findings)
    base.check(findings)
    return out


def _variation(text: str, findings: Findings) -> tuple[str, list[Setting]]:
    """The option and its valid values; invalid ones are recorded and omitted."""
    before, _, after = text.partition("=")
    name = before.strip().replace("-", "_")
    if name not in _types():
        from gbspec.data import similar

        near = similar(name, list(_types()))
        message = f"`--vary {text}`: no option that can be varied is called `{before.strip()}`"
        findings.error("GB862", message, None, help=f"did you mean `{near}`?" if near else "see `gbspec train --help`")
        return name, []
    values: list[Setting] = []
    for part in (each.strip() for each in after.split(",")):
        try:
            value = _read(part, _types()[name])
        except ValueError:
            message = f"`--vary {text}`: `{part}` is not a valid value of `{name}`"
            findings.error("GB862", message, None, help=f"separate values by commas: --vary {name}=…,…")
            continue
        if value in values:
            findings.error("GB862", f"`--vary {text}` gives `{part}` twice", None, help="give it once")
        values.append(value)
    return name, values


def _types() -> dict[str, Any]:
    """The options that can be varied, with their types."""
    hints = typing.get_type_hints(TrainOptions)
    return {field.name: hints[field.name] for field in fields(TrainOptions) if field.name not in FIXED}


def _read(text: str, kind: Any) -> Setting:
    """The value of type `kind` that a text represents; raises ValueError. Further conditions are checked by the
    options."""
    if get_origin(kind) is types.UnionType:
        kind = next(part for part in get_args(kind) if part is not types.NoneType)
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError(text)
        return text.lower() == "true"
    if kind is str or get_origin(kind) is Literal:
        return text
    return kind(text)


def _text(value: Setting) -> str:
    """A value as written in the name of a directory."""
    return f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)
