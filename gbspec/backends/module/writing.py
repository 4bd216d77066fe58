"""The text of a method of the generated class."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gbspec.backends.printing import docstring

WIDTH = 120 - 8
"""The length of a line of a method, whose class stands in the model's."""


def left_side(names: Iterable[str]) -> str:
    """The left side of a tuple assignment."""
    listed = list(names)
    return f"({listed[0]},)" if len(listed) == 1 else ", ".join(listed)


def comma(names: Iterable[str]) -> str:
    """The entries of a tuple."""
    listed = list(names)
    return f"{listed[0]}," if len(listed) == 1 else ", ".join(listed)


def method_text(decorator: str, name: str, parameters: Sequence[str], document: str, body: Iterable[str]) -> str:
    """A method with its decorator and docstring, with every parameter annotated; `body`: its lines."""
    typed = [
        parameter
        if parameter == "cls"
        else ": Any = ".join(parameter.split("="))
        if "=" in parameter
        else f"{parameter}: Any"
        for parameter in parameters
    ]
    head = f"def {name}({', '.join(typed)}) -> Any:"
    if len(head) > WIDTH:
        head = f"def {name}(\n    {', '.join(typed)}\n) -> Any:"
    lines = [decorator, head]
    if document:
        lines.append(f"    {docstring(document)}")
    return "\n".join([*lines, *(f"    {line}" for line in body)])
