"""Small parts of declarations: the time, the neutral value of `nn`, the text of units and descriptions."""

from __future__ import annotations

from gbspec.ir import model as ir
from gbspec.lower.expressions import parts_of
from gbspec.semantics import Checked, chain
from gbspec.syntax import Kind, ast


def neutral(postulate: ast.Expression) -> float:
    """The value of `nn` without correction: 1 if it occurs only as a factor (or divisor, or power of one), else 0."""
    stack: list[tuple[ast.Expression, bool]] = [(postulate, False)]
    while stack:
        node, factor = stack.pop()
        match node:
            case ast.Name(text="nn") if not factor:
                return 0.0
            case ast.Group(inner=inner):
                stack.append((inner, factor))
            case ast.Binary(operator="*" | "/"):
                stack.extend((part, True) for _, part in chain(node))
            case ast.Binary(operator="^", left=left, right=right):
                stack.extend(((left, factor), (right, False)))
            case ast.Unary(operand=operand):
                stack.append((operand, factor))
            case _:
                stack.extend((part, False) for part in parts_of(node))
    return 1.0


def unit_text(unit: ast.UnitExpression | None) -> str | None:
    """A unit in canonical text: without spaces, with parentheses only where needed."""
    if unit is None:
        return None
    tail: list[str] = []
    while isinstance(unit, ast.UnitBinary):  # a long chain leans to the left
        right = unit_text(unit.right) or ""
        if isinstance(unit.right, ast.UnitBinary) and unit.right.operator != "^":
            right = f"({right})"
        tail.append(f"{unit.operator}{right}")
        if unit.operator == "^" and isinstance(unit.left, ast.UnitBinary):
            return f"({unit_text(unit.left)})" + "".join(reversed(tail))
        unit = unit.left
    return unit.text + "".join(reversed(tail))


def string(text: ast.Text | None) -> str:
    """The value of an optional string."""
    return text.value if text is not None else ""


def time_of(checked: Checked) -> ir.Time:
    """The time, by its statement or by the name that it has without one."""
    statement = next(checked.all(ast.TimeStatement), None)
    if statement is None:
        return ir.Time(next(name for name, one in checked.table.items() if one.kind is Kind.TIME))
    return ir.Time(
        statement.name.text,
        checked.numbers.value(statement.start),
        unit=unit_text(statement.unit),
        description=string(statement.description),
        span=statement.name.span,
    )
