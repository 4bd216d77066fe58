"""Expands arrays of states: `state c[1..N]` becomes `c_1` to `c_N`, a balance with an index one balance per element.

Indices are resolved here, so that all later checks see names only. An element beyond an end, such as `c[0]`, is
replaced by the expression of its closure: `c[0] = …`.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Container, Mapping
from typing import assert_never

from gbspec.diagnostics import Findings, Label, Span, UserError
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.declared_arrays import (
    Declared,
    DeclaredArray,
    constant_values,
    declarations,
    element_name,
    indexed_by,
    is_place,
    mentions_index,
    summed,
)
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.rewriting import rebuilt, with_expressions
from gbspec.syntax import MOST_PARTS, MOST_WRITTEN_OUT, Kind, Place, ast, children, refused

LARGEST = 2000
"""The most elements that an array may have."""


def expand(merged: Merged, findings: Findings) -> tuple[Merged, dict[str, DeclaredArray]]:
    """The statements with arrays expanded, and the arrays; without arrays the statements are returned unchanged."""
    indexed = list(declarations(merged.items))
    if not indexed and not any(mentions_index(item.statement) for item in merged.items):
        return merged, {}
    return _Expansion(merged, findings).run(indexed)


def running_index(target: ast.Name | ast.Index, constants: Container[str]) -> str | None:
    """The running index of a statement for every element: a bare name that is not a constant; else None."""
    if isinstance(target, ast.Index) and isinstance(target.index, ast.Name) and target.index.text not in constants:
        return target.index.text
    return None


def _variables(statement: ast.Statement) -> tuple[ast.Name, ...]:
    """The names that a statement declares for use in expressions, except the time."""
    return () if statement.entry.kind in (Kind.TIME, Kind.CHANNEL) else statement.declares()


class _Expansion:
    def __init__(self, merged: Merged, findings: Findings) -> None:
        self._merged = merged
        self._findings = findings
        self._arrays: dict[str, DeclaredArray] = {}
        self._unsure: set[str] = set()
        self._named: set[str] = set()
        self._told: Counter[Span] = Counter()
        self._functions = {
            i.statement.name.text: i.statement for i in merged.items if isinstance(i.statement, ast.FunctionStatement)
        }
        self._values = constant_values(merged.items, self._functions)
        self._declared = {n.text: n for i in merged.items for n in _variables(i.statement)}

    def run(self, indexed: list[Declared]) -> tuple[Merged, dict[str, DeclaredArray]]:
        for declared in indexed:
            self._declare(declared)
        for item in self._merged.items:
            if isinstance(item.statement, ast.ClosureStatement):
                self._close(item.statement)
        items = self._all_written_out()
        expanded = dataclasses.replace(
            self._merged, items=tuple(items), arrays=frozenset(self._unsure), in_indices=frozenset(self._named)
        )
        return expanded, self._arrays

    def _all_written_out(self) -> list[Item]:
        """Every statement for every element. Raises `UserError` (GB010) first if these are too many, or too long."""
        count, size = 0, 0
        for item in self._merged.items:
            copies = self._copies(item.statement)
            count += copies
            size += copies * self._weight(item.statement)
        if count > MOST_WRITTEN_OUT or size > MOST_PARTS:
            what = f"{count:,} statements; at most {MOST_WRITTEN_OUT:,} are read"
            if count <= MOST_WRITTEN_OUT:
                what = f"{size:,} names, numbers and operations; at most {MOST_PARTS:,} are read"
            path = self._merged.items[0].statement.span.source.path
            raise UserError([refused(path, f"written out for the elements of its arrays, this model has {what}")])
        return [new for item in self._merged.items for new in self._written_out(item)]

    def _copies(self, statement: ast.Statement) -> int:
        """For how many elements a statement is written out."""
        match statement:
            case (
                ast.StateStatement(declarator=ast.Declarator(name=name, first=first))
                | ast.AlgebraicStatement(declarator=ast.Declarator(name=name, first=first))
            ) if first is not None:
                array = self._arrays.get(name.text)
            case ast.EquationStatement(target=ast.Index() as target):
                array = indexed_by(statement, running_index(target, self._values), self._arrays)
            case ast.LearnStatement(name=name):
                array = self._arrays.get(name.text)
            case ast.About(target=ast.Name(text=text)):
                array = self._arrays.get(text)
            case ast.About(target=ast.Index() as target) if running_index(target, self._values) is not None:
                array = self._arrays.get(target.array.text)
            case _:
                return 1
        return 1 if array is None else array.last - array.first + 1

    def _weight(self, statement: ast.Statement) -> int:
        """The parts of a statement's expressions, `sum(c)` counted as the sum of all elements."""
        parts = [p for root in children(statement) if isinstance(root, ast.Expression) for p in walk(root)]
        arrays_summed = [name for part in parts for name in summed(part)]
        arrays = [self._arrays[name] for name in arrays_summed if name in self._arrays]
        return len(parts) + sum(2 * (array.last - array.first + 1) for array in arrays)

    # --------------------------------------------------------------------------------------------------- declarations

    def _whole(self, node: ast.Expression, what: str, extra: Mapping[str, float] | None = None) -> int | None:
        self._named.update(part.text for part in walk(node) if isinstance(part, ast.Name))
        value = Evaluator({**self._values, **(extra or {})}, self._functions)(node)
        if value is not None and value == int(value):
            return int(value)
        if not self._first_at(node):  # an index that is wrong for many elements is reported once
            return None
        self._findings.error(
            "GB240",
            f"{what} must be a whole number" + ("" if value is None else f", not {value:g}"),
            node.span,
            help="write numbers and constants there, and `i` in a balance for every `i`",
        )
        return None

    def _first_at(self, node: ast.Node, most: int = 1) -> bool:
        """Whether fewer than `most` errors were reported at this place in the text; counts this one."""
        self._told[node.span] += 1
        return self._told[node.span] <= most

    def _declare(self, declared: Declared) -> None:
        name = declared.name
        self._unsure.add(name.text)
        first, last = (self._whole(e, "an end of an array") for e in declared.ends)
        if first is None or last is None:
            return
        if not 0 <= last - first < LARGEST:
            self._findings.error(
                "GB240",
                f"`{name.text}` would have {max(last - first + 1, 0)} elements; an array has 1 to {LARGEST}",
                declared.span,
            )
            return
        self._arrays[name.text] = DeclaredArray(name.text, declared.span, first, last, declared.row, declared.algebraic)

    def _close(self, statement: ast.ClosureStatement) -> None:
        array = self._arrays.get(statement.target.array.text)
        if array is None:
            self._no_array(statement.target.array)
            return
        index = self._whole(statement.target.index, "an index")
        if index is None:
            return
        if array.row:
            what = f"`{array.name}` is a row of constants to be learned, which have no equations"
            help_ = "a known value is a `const`; a start and bounds stand in the declaration of the row"
            if array.algebraic:
                what = f"`{array.name}` is an array of algebraic variables, whose equations have names"
                help_ = f"write `equation NAME: {statement.target.span.text} = …`"
            self._findings.error("GB254", what, statement.target.span, help=help_)
            return
        if array.first <= index <= array.last:
            self._findings.error(
                "GB241",
                f"`{array.name}[{index}]` is a state: it needs a balance, not an equation",
                statement.target.span,
                labels=[Label(array.span, f"from {array.range}")],
                help=f"an equation is for an element beyond an end: `{array.name}[{array.first - 1}] = …`; an"
                " initial value is given by `initial`",
            )
        array.ends[index] = statement

    def _no_array(self, name: ast.Name) -> None:
        if name.text not in self._unsure and self._merged.lacks(name.text):
            known = name.text in self._declared
            self._findings.error(
                "GB204" if known else "GB201",
                f"`{name.text}` is not an array" if known else f"no array is named `{name.text}`",
                name.span,
                labels=[Label(self._declared[name.text].span, "declared here")] if known else [],
                help=f"declare it with its indices: `state {name.text}[1..10]`; a unit is written after `:`",
            )
        self._unsure.add(name.text)

    # ------------------------------------------------------------------------------------------------------ statements

    def _written_out(self, item: Item) -> list[Item]:
        statement = item.statement
        match statement:
            case ast.ClosureStatement():
                return []
            case ast.StateStatement(declarator=declarator) | ast.AlgebraicStatement(declarator=declarator) if (
                declarator.first is not None
            ):
                array = self._arrays.get(declarator.name.text)
                names = array.elements if array is not None else ()
                one = self._rewritten(self._item(item, declarator=ast.Declarator(declarator.span, declarator.name)), {})
                return [
                    self._item(one, declarator=ast.Declarator(declarator.span, self._at(declarator.name, n)))
                    for n in names
                ]
            case ast.EquationStatement(target=ast.Index() as target):
                return self._equations(item, statement, target)
            case (
                ast.BalanceStatement(target=target)
                | ast.InitialStatement(target=target)
                | ast.ObserveStatement(target=target)
                | ast.DoseStatement(target=target)
                | ast.DiffusionStatement(target=target)
            ):
                return self._about(item, target)
            case ast.LearnStatement(name=name, row=row) if row:
                array = self._arrays.get(name.text)
                names = array.elements if array is not None else ()
                one = self._rewritten(self._item(item, row=()), {})
                return [self._item(one, name=self._at(name, n)) for n in names]
            case ast.TruthStatement() if statement.index is not None or statement.target.text in self._arrays:
                return self._truth(item, statement)
            case ast.Remark() | ast.Formula() | ast.UnknownStatement() | ast.LearnStatement() | ast.ConstStatement():
                return [self._rewritten(item, {})]
            case ast.StateStatement() | ast.ConditionStatement() | ast.InputStatement() | ast.TimeStatement():
                return [self._rewritten(item, {})]
            case ast.AlgebraicStatement():
                return [self._rewritten(item, {})]
            case _:
                assert_never(statement)

    def _equations(self, item: Item, statement: ast.EquationStatement, target: ast.Index) -> list[Item]:
        """An equation for an element, or one for each element of the array that has its running index."""
        loop = running_index(target, self._values)
        if loop is None:
            index = self._whole(target.index, "an index")
            found = {} if index is None else {index: dict[str, int]()}
        elif (array := indexed_by(statement, loop, self._arrays)) is not None:
            found = {i: {loop: i} for i in range(array.first, array.last + 1)}
        else:
            what = (
                f"no array in the equation `{target.array.text}` has the index `{loop}`, so that its elements are open"
            )
            self._findings.error("GB354", what, target.span, help=f"index an algebraic variable by it: `c[{loop}]`")
            return []
        names = {i: ast.Name(target.span, element_name(target.array.text, i)) for i in found}
        return [self._rewritten(self._item(item, target=names[i]), values) for i, values in found.items()]

    def _truth(self, item: Item, statement: ast.TruthStatement) -> list[Item]:
        """The truth of an element of a row, or of all with the same value."""
        name, array = statement.target, self._arrays.get(statement.target.text)
        if array is None:
            self._no_array(name)
            return []
        names = array.elements
        if statement.index is not None:
            index = self._whole(statement.index, "an index")
            if index is None or not self._exists(array, index, name, f"its elements are {array.range}"):
                return []
            names = (array.element(index),)
        one = self._rewritten(self._item(item, index=None), {})
        return [self._item(one, target=self._at(name, n)) for n in names]

    @staticmethod
    def _at(name: ast.Name, text: str) -> ast.Name:
        return ast.Name(name.span, text)

    @staticmethod
    def _item(item: Item, **changes: object) -> Item:
        return Item(dataclasses.replace(item.statement, **changes), item.text)  # type: ignore[arg-type] # fields by name

    def _about(self, item: Item, target: ast.Name | ast.Index) -> list[Item]:
        """Expands a statement about an element, every element (`c[i]`, or the array's name), or a plain name."""
        name = target.array if isinstance(target, ast.Index) else target
        array = self._arrays.get(name.text)
        if array is None:
            if isinstance(target, ast.Index):
                self._no_array(name)
                return []
            return [self._rewritten(item, {})] if name.text not in self._unsure else []
        loop = running_index(target, self._values)
        if isinstance(item.statement, ast.ObserveStatement) and item.statement.value is not None:
            self._channel_like_a_state(array, target)
            return []
        if loop is None and isinstance(target, ast.Index):
            index = self._whole(target.index, "an index")
            if index is None or not self._exists(array, index, target, f"its elements are {array.range}"):
                return []
            return [self._element(item, array, index, {})]
        bound = [{loop: i} if loop else {} for i in range(array.first, array.last + 1)]
        return [self._element(item, array, array.first + k, values) for k, values in enumerate(bound)]

    def _channel_like_a_state(self, array: DeclaredArray, target: ast.Name | ast.Index) -> None:
        self._findings.error(
            "GB202",
            f"`{array.name}` is declared twice",
            target.span,
            label="again",
            labels=[Label(array.span, "first declared here")],
            help=f"to measure it directly write `observe {target.span.text}`; an expression needs another name",
        )

    def _exists(self, array: DeclaredArray, index: int, node: ast.Node, help_text: str = "") -> bool:
        if array.first <= index <= array.last:
            return True
        if not self._first_at(node, most=2):  # an index that is wrong for many elements is reported at both ends
            return False
        remedy = f"its elements are {array.range}"
        if not array.row:
            remedy = f"define it by an equation: `{array.name}[{index}] = …`"
        self._findings.error(
            "GB242",
            f"`{array.name}` has no element {index}",
            node.span,
            labels=[Label(array.span, f"from {array.range}")],
            help=help_text or remedy,
        )
        return False

    def _element(self, item: Item, array: DeclaredArray, index: int, values: Mapping[str, int]) -> Item:
        name = item.statement.target  # type: ignore[union-attr] # only statements about a target come here
        target = ast.Name(name.span, array.element(index))
        new = self._item(item, target=target)
        if isinstance(new.statement, ast.ObserveStatement) and new.statement.column is None:
            new = self._item(new, column=ast.Text(name.span, f"{array.name}[{index}]"))
        return self._rewritten(new, values)

    # ----------------------------------------------------------------------------------------------------- expressions

    def _rewritten(self, item: Item, values: Mapping[str, int]) -> Item:
        """The statement with indices resolved in all of its expressions; `values` are those of running indices."""

        def put(place: Place) -> ast.Expression:
            return self._expression(place.expression, values, place.formals, ())

        return Item(with_expressions(item.statement, put), item.text)

    def _expression(
        self,
        root: ast.Expression,
        values: Mapping[str, int],
        formals: frozenset[str],
        within: tuple[tuple[str, int], ...],
    ) -> ast.Expression:
        def put(node: ast.Expression) -> ast.Expression:
            match node:
                case ast.Name(text=text) if text in values and text not in formals:
                    return ast.Number(node.span, str(values[text]))
                case ast.Name(text=text) if text in self._arrays and text not in formals:
                    self._whole_array(node)
                    return node
                case ast.Index():
                    return self._index(node, values, formals, within)
                case ast.RateOf(target=ast.Index() as element):
                    found = self._index(element, values, formals, within)
                    return dataclasses.replace(node, target=found) if isinstance(found, ast.Name) else found
                case ast.Call(function=ast.Name(text="sum")):
                    return self._sum(node)
                case ast.Name() | ast.Call() | ast.Number() | ast.Unary() | ast.Binary() | ast.RateOf():
                    return node
                case ast.Comparison() | ast.Logic() | ast.Conditional() | ast.Group() | ast.Conversion():
                    return node
                case _:
                    assert_never(node)

        return rebuilt(root, put, is_place)

    def _index(
        self,
        node: ast.Index,
        values: Mapping[str, int],
        formals: frozenset[str],
        within: tuple[tuple[str, int], ...],
    ) -> ast.Expression:
        array = self._arrays.get(node.array.text)
        nothing = node.array  # a name that later checks ignore, since the error here was reported
        if array is None:
            self._no_array(node.array)
            return nothing
        index = self._whole(node.index, "an index", {name: float(v) for name, v in values.items()})
        if index is None:
            return nothing
        end = array.ends.get(index)
        if end is None or array.first <= index <= array.last:
            return ast.Name(node.span, array.element(index)) if self._exists(array, index, node) else nothing
        if (array.name, index) in within:
            self._findings.error(
                "GB208",
                f"the end `{array.name}[{index}]` depends on itself",
                end.target.span,
                help="write it in terms of elements inside the range",
            )
            return nothing
        inside = self._expression(end.value, {}, frozenset(), (*within, (array.name, index)))
        return ast.Group(node.span, inside)

    def _whole_array(self, node: ast.Name) -> None:
        self._findings.error(
            "GB243",
            f"`{node.text}` is an array, and one element of it is needed here",
            node.span,
            help=f"name an element, `{node.text}[i]` or `{node.text}[1]`, or all together: `sum({node.text})`",
        )

    def _sum(self, node: ast.Call) -> ast.Expression:
        argument = node.arguments[0] if len(node.arguments) == 1 else None
        array = self._arrays.get(argument.text) if isinstance(argument, ast.Name) else None
        if array is None:
            if not (isinstance(argument, ast.Name) and argument.text in self._unsure):
                self._findings.error(
                    "GB243",
                    "`sum(…)` takes the name of one array of states",
                    node.span,
                    help="it adds up all elements; other sums are written with `+`",
                )
            self._unsure.add(node.function.text)
            return node.function
        total: ast.Expression = ast.Name(node.span, array.element(array.first))
        for i in range(array.first + 1, array.last + 1):
            total = ast.Binary(node.span, "+", total, ast.Name(node.span, array.element(i)))
        return ast.Group(node.span, total)
