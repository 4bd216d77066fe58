"""A syntax tree as text (`--dump`): each statement with its place, then its parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

from gbspec.syntax import ast
from gbspec.syntax.walking import fold

_Prefix = tuple[str, list[str]]
"""An operator (empty for a leaf or a group) and its operands as text."""

_IN_A_LINE = (*ast.Expression.__args__, *ast.UnitExpression.__args__, ast.Text)


def dump(file: ast.File) -> str:
    """Every statement of a file, in the order of the text. Ends with a line end."""
    return "\n".join(line for statement in file.statements for line in statement_lines(statement)) + "\n"


def statement_lines(statement: ast.Node, file: str = "") -> list[str]:
    """A statement: its kind and place (`ConstStatement 3:1`, or `m.gb:3:1`), then the parts that were written."""
    place = ":".join(map(str, statement.span.position[:2]))
    return [f"{type(statement).__name__} {f'{file}:' if file else ''}{place}", *_parts(statement, "  ")]


def prefix(node: ast.Node) -> str:
    """An expression or a unit in one line, operators first: `a + b + c*(d - 1)` is `(+ a b (* c (group (- d 1))))`.

    A chain of one operator, which nests to its left, is shown as one operation.
    """
    return _written(fold(node, _prefix))


def _parts(node: ast.Node, indent: str) -> Iterator[str]:
    for field in fields(node):
        value = getattr(node, field.name)
        if field.name == "span" or value is None or value is False or value == ():
            continue
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, _IN_A_LINE):
                yield f"{indent}{field.name} {prefix(part)}"
            elif isinstance(part, ast.Node):
                yield f"{indent}{field.name} {type(part).__name__}"
                yield from _parts(part, indent + "  ")
            else:
                yield f"{indent}{field.name} {part}"


def _prefix(node: ast.Node, parts: tuple[_Prefix, ...]) -> _Prefix:
    match node:
        case ast.Number(text=text) | ast.Name(text=text) | ast.UnitName(text=text) | ast.UnitNumber(text=text):
            return "", [text]
        case ast.Text(value=value):
            return "", [f'"{value}"']
        case ast.Binary(operator=operator) | ast.UnitBinary(operator=operator) if parts[0][0] == operator != "^":
            chain = parts[0][1]  # extended in place: no other result refers to it
            chain.append(_written(parts[1]))
            return operator, chain
        case (
            ast.Binary(operator=operator)
            | ast.UnitBinary(operator=operator)
            | ast.Unary(operator=operator)
            | ast.Comparison(operator=operator)
            | ast.Logic(operator=operator)
        ):
            return operator, list(map(_written, parts))
        case ast.Call():
            return _written(parts[0]), list(map(_written, parts[1:]))
        case ast.Index():
            return "", [f"{_written(parts[0])}[{_written(parts[1])}]"]
        case ast.RateOf():
            return "", [f"{_written(parts[0])}'"]
        case ast.Conversion():
            return "in", list(map(_written, parts))
        case ast.Conditional():
            return "if", list(map(_written, parts))
        case _:
            return "group", list(map(_written, parts))


def _written(parts: _Prefix) -> str:
    operator, operands = parts
    return f"({' '.join((operator, *operands))})" if operator else operands[0]
