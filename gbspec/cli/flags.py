"""Flags made from frozen option dataclasses, so that each option is declared once: name, type, default, help.

A field becomes `--name-with-dashes`. Its metadata may contain `help`, `flag` (another spelling), `metavar`, and
`cli: False` for a field that has no flag. A field whose type has no simple text form (such as a mapping of ranges) has
`metadata["parse"]`: a function from the given texts to the value; the flag may then be repeated.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, Union

import typer

from gbspec.cli.groups import FIRST, group_of, place

# A type annotation is `Any` here: a class, a union and `tuple[int, ...]` have no common type.
Collect = Callable[[dict[str, object]], dict[str, object]]


def expand(parameters: Sequence[inspect.Parameter]) -> tuple[list[inspect.Parameter], Collect]:
    """The parameters with option dataclasses replaced by their flags, and a function that reassembles the values."""
    shown: list[inspect.Parameter] = []
    groups: dict[str, type] = {}
    for parameter in parameters:
        if dataclasses.is_dataclass(parameter.annotation) and isinstance(parameter.annotation, type):
            groups[parameter.name] = parameter.annotation
            shown += flags_of(parameter.annotation)
        else:
            shown.append(tidied(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)))

    def collect(given: dict[str, object]) -> dict[str, object]:
        rest = dict(given)
        for name, options in groups.items():
            values = {field.name: read(field, rest.pop(field.name)) for field in flagged(options)}
            rest[name] = options(**values)
        return rest

    return shown, collect


def hints(options: type) -> dict[str, Any]:
    """The field types of a dataclass, resolved."""
    return typing.get_type_hints(options)


def flagged(options: type) -> list[dataclasses.Field[object]]:
    """The fields that have a flag."""
    found = [field for field in dataclasses.fields(options) if field.metadata.get("cli", True)]
    return sorted(found, key=lambda field: place(options.__name__, field.name))


def default(field: dataclasses.Field[object]) -> object:
    """A field's default value."""
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    raise TypeError(f"the option {field.name} has no default")


def flags_of(options: type) -> list[inspect.Parameter]:
    """The command-line parameters for the fields of a dataclass, in the order of the help."""
    kinds = hints(options)
    return [flag(field, kinds[field.name], group_of(options.__name__, field.name)) for field in flagged(options)]


def flag(field: dataclasses.Field[object], hint: Any, group: str = FIRST) -> inspect.Parameter:
    """The command-line parameter for one field, shown in a group of the help."""
    meta = field.metadata
    spelling = meta.get("flag", "--" + field.name.replace("_", "-"))
    kind, value = _simple(hint), default(field)
    if "parse" in meta:
        kind, value = list[str], []
    elif kind is bool and value:
        spelling = f"{spelling}/--no-{spelling.removeprefix('--')}"
    shown = value not in (None, [], ())
    option = typer.Option(
        spelling,
        help=meta.get("help"),
        metavar=meta.get("metavar"),
        show_default=shown,
        rich_help_panel=group or None,
    )
    return tidied(
        inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, option], default=value)
    )


def tidied(parameter: inspect.Parameter) -> inspect.Parameter:
    """The parameter as the help shows it: no types of Python, and choices whose refusal names what is meant."""
    hint = parameter.annotation
    if typing.get_origin(hint) is not Annotated:
        return parameter
    kind, shown = typing.get_args(hint)[:2]
    bare = next((part for part in typing.get_args(kind) if typing.get_origin(part) is Literal), kind)
    shown = copy.copy(shown)  # several commands may share one declaration
    if typing.get_origin(bare) is Literal:
        choices = typing.get_args(bare)
        shown.parser = choice(choices)
        shown.metavar = shown.metavar or "|".join(choices)
        kind = str if bare is kind else str | None
    elif shown.metavar is None:
        shown.metavar = METAVARS.get(kind)
    return parameter.replace(annotation=Annotated[kind, shown])


METAVARS: dict[object, str] = {bool: "", int: "N", float: "NUMBER", str: "TEXT"}
"""What the help shows for the value of an option that does not say it; a switch has none."""


def choice(allowed: Sequence[str]) -> Callable[[str], str]:
    """A reader of one of some words; another one is wrong usage, with a suggestion."""

    def read(text: str) -> str:
        from gbspec.data import similar

        if text in allowed:
            return text
        meant = similar(text, allowed)
        advice = f" Did you mean '{meant}'?" if meant else ""
        raise typer.BadParameter(f"'{text}' is not one of {', '.join(allowed)}.{advice}")

    read.allowed = tuple(allowed)  # type: ignore[attr-defined]  # for completion
    return read


def choices(annotation: Any) -> tuple[str, ...]:
    """The words among which a parameter made by `tidied` chooses; empty if its value is free."""
    shown = typing.get_args(annotation)[1] if typing.get_origin(annotation) is Annotated else None
    return getattr(getattr(shown, "parser", None), "allowed", ())


def read(field: dataclasses.Field[object], given: object) -> object:
    """The field's value from typer's value."""
    if "parse" in field.metadata:
        return field.metadata["parse"](given) if given else default(field)
    return tuple(given) if isinstance(given, list) else given


def _simple(hint: Any) -> Any:
    """The type for typer: literals stay, tuples of one type become lists, unions with None stay optional."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        rest = [a for a in arguments if a is not type(None)]
        inner = _simple(rest[0]) if len(rest) == 1 else str
        return inner | None if type(None) in arguments else inner
    if origin is Literal:
        return hint
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return list[arguments[0]]  # type: ignore[valid-type]  # made at run time
    return hint
