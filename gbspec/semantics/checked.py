"""The result of the semantic checks: the statements of a model without errors, and its names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from gbspec.semantics.allow import Allowed
from gbspec.semantics.declared_arrays import DeclaredArray
from gbspec.semantics.merge import Item
from gbspec.semantics.numbers import Numbers
from gbspec.semantics.processes import Term
from gbspec.semantics.table import Table
from gbspec.semantics.tables import Points
from gbspec.syntax import ast

S = TypeVar("S", bound=ast.Node)


@dataclass(frozen=True)
class Checked:
    """A model without errors, before lowering.

    `order` has the names of `let`s and processes, each after all it depends on; `constants` the values of the `const`s;
    `terms` the sides of each process (True: consumed); `truths` the values of the truths of learnables; `allowed` the
    warnings that the author accepts.
    """

    items: tuple[Item, ...]
    table: Table
    order: tuple[str, ...]
    constants: Mapping[str, float]
    numbers: Numbers
    terms: Mapping[str, tuple[tuple[bool, Term], ...]]
    truths: Mapping[str, float]
    allowed: Allowed
    source: tuple[Item, ...] = ()
    """The statements before arrays are expanded."""
    arrays: Mapping[str, DeclaredArray] = field(default_factory=dict)
    tables: Mapping[str, Points] = field(default_factory=dict)

    def all(self, kind: type[S]) -> Iterator[S]:
        """The statements of one kind, in the order of the model."""
        for item in self.items:
            if isinstance(item.statement, kind):
                yield item.statement
