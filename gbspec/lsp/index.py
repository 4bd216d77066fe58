"""Resolves every name in a file to a symbol, for hover, definition, references and renaming.

Names of a model are one namespace through all files that extend one another; units are another. The parameters of a
`function`, the arguments of an `unknown` and the parameters of a `truth` are local to their statement and shadow
those of the model, with two exceptions: an unknown that is somewhere used without parentheses is applied to the names
of its declaration, and an argument without a range takes that of the state, condition or input of the same name for
contracts. Those arguments *are* the model's names and are renamed with them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, assert_never

from gbspec.diagnostics import Span
from gbspec.syntax import FUNCTIONS, ast, children, walk

DEFAULT_TIME = "t"
"""The name of the time in a model without a `time` statement."""

Space = Literal["name", "unit", "argument", "model", "word", "code"]


@dataclass(frozen=True)
class Symbol:
    """The symbol of a name. `home` is the statement of an argument, or the kind of a word of the language."""

    space: Space
    name: str
    home: str = ""


@dataclass(frozen=True)
class Occurrence:
    """One place that refers to a symbol.

    `implied`: its name is not written there: `phi` without parentheses takes the arguments of its declaration by name.
    """

    symbol: Symbol
    span: Span
    statement: ast.Statement
    declares: bool = False
    implied: bool = False


@dataclass(frozen=True)
class Names:
    """The declarations in the files of a model that are needed to resolve names.

    `declared` has the time's name even if no statement declares it; `arguments` are those of each unknown with the
    statement they belong to; `bare` the unknowns that are used somewhere without parentheses; `lent` those arguments
    of each unknown that take the range of the model's quantity of the same name.
    """

    declared: frozenset[str]
    units: frozenset[str]
    arguments: Mapping[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)
    bare: frozenset[str] = frozenset()
    lent: Mapping[str, frozenset[str]] = field(default_factory=dict)


Scope = Mapping[str, Symbol]


def names_of(files: Sequence[ast.File]) -> Names:
    """The declarations of a file and of those that it extends; `files` has the nearest first."""
    found: set[str] = set()
    units: set[str] = set()
    arguments: dict[str, tuple[str, tuple[str, ...]]] = {}
    for file in files:
        for statement in file.statements:
            found.update(name.text for name in statement.declares())
            if isinstance(statement, ast.UnitStatement):
                units.add(statement.name.text)
            elif isinstance(statement, ast.UnknownStatement):
                formals = tuple(a.name.text for a in statement.arguments)
                for name in statement.names:
                    arguments.setdefault(name.text, (home(statement), formals))
    if not any(isinstance(s, ast.TimeStatement) for file in files for s in file.statements):
        found.add(DEFAULT_TIME)
    return Names(frozenset(found), frozenset(units), arguments, _bare(files, frozenset(arguments)), _lent(files))


def occurrences(file: ast.File, names: Names) -> tuple[Occurrence, ...]:
    """Every name in a file with its symbol, in the order of the text."""
    found = [o for statement in file.statements for o in _Statement(statement, names).all()]
    return tuple(sorted(found, key=lambda o: (o.span.start, o.implied)))


def at(found: Sequence[Occurrence], offset: int) -> Occurrence | None:
    """The occurrence at an offset: the name around it, else the one that ends there; None without a name."""
    written = [o for o in found if not o.implied and o.span.start <= offset <= o.span.end]
    return max(written, key=lambda o: o.span.start, default=None)


def home(statement: ast.Statement) -> str:
    """A key unique to a statement, so that the arguments of two statements are different symbols."""
    return f"{statement.span.source.path}:{statement.span.start}"


def _bare(files: Sequence[ast.File], unknowns: frozenset[str]) -> frozenset[str]:
    """The unknowns that occur somewhere in an expression without parentheses."""
    found: set[str] = set()
    for statement in (s for file in files for s in file.statements):
        if isinstance(statement, ast.Remark):
            continue
        skipped = {id(name) for name in statement.declares()}
        if isinstance(statement, ast.TruthStatement):
            skipped.add(id(statement.target))
        for node in walk(statement):
            match node:
                case ast.Call(function=function):
                    skipped.add(id(function))
                case ast.Bound() | ast.RangeContract() | ast.ZeroAt() | ast.EqualsAt() | ast.Shaped() | ast.Periodic():
                    skipped.add(id(node.name))
                case ast.Name(text=text) if text in unknowns and id(node) not in skipped:
                    found.add(text)
                case _:
                    pass
    return frozenset(found)


def _lent(files: Sequence[ast.File]) -> dict[str, frozenset[str]]:
    """For each unknown with contracts, the arguments whose range is that of the model's quantity of that name."""
    ranged: dict[str, bool] = {}
    unknowns: dict[str, ast.UnknownStatement] = {}
    for statement in (s for file in files for s in file.statements):
        match statement:
            case (
                ast.StateStatement(declarator=ast.Declarator(name=name, first=first), range=range)
                | ast.AlgebraicStatement(declarator=ast.Declarator(name=name, first=first), range=range)
            ):
                if first is None:
                    ranged.setdefault(name.text, range is not None)
            case ast.ConditionStatement(name=name, range=range) | ast.InputStatement(name=name, range=range):
                ranged.setdefault(name.text, range is not None)
            case ast.UnknownStatement(names=outputs):
                for name in outputs:
                    unknowns.setdefault(name.text, statement)
            case ast.Remark() | ast.Formula() | ast.About() | ast.TimeStatement() | ast.ConstStatement():
                pass
            case ast.LearnStatement():
                pass  # its range bounds an estimate, and is not the domain of an argument
            case _:
                assert_never(statement)
    return {
        output: frozenset(
            a.name.text for a in s.arguments if s.contracts and a.range is None and ranged.get(a.name.text, False)
        )
        for output, s in unknowns.items()
    }


class _Statement:
    """The occurrences in one statement."""

    def __init__(self, statement: ast.Statement, names: Names) -> None:
        self.statement, self.names = statement, names
        self.found: list[Occurrence] = []

    def all(self) -> list[Occurrence]:
        """Every name of the statement."""
        if isinstance(self.statement, ast.Remark):
            for mention in self.statement.mentions():
                self._mentioned(mention)
        else:
            self._parts()
        return self.found

    def _mentioned(self, mention: ast.Mention) -> None:
        name, space = mention.name, mention.space
        if space == "name":
            self._name(name, {})
        else:
            text = name.text.upper() if space == "code" else name.text
            self._add(Symbol(space, text), name.span, declares=mention.declares)

    def _parts(self) -> None:
        """The declared names, the statement's own names, and its expressions."""
        scope, formals = self._scope()
        declaring = {id(name) for name in self.statement.declares()} | formals
        for part in children(self.statement):
            if id(part) in formals and isinstance(part, ast.Name):
                self._add(scope[part.text], part.span, declares=True)
            else:
                self._visit(part, scope if self._sees_arguments(part) else {}, scope, declaring)

    def _scope(self) -> tuple[dict[str, Symbol], set[int]]:
        """The names local to the statement, and the nodes that declare them."""
        match self.statement:
            case ast.UnknownStatement(names=outputs, arguments=arguments):
                return self._arguments(home(self.statement), [a.name.text for a in arguments], outputs), set()
            case ast.TruthStatement(target=name, parameters=None) if name.text in self.names.arguments:
                return self._arguments(*self.names.arguments[name.text], (name,)), set()
            case statement:
                own = (*statement.formals(), *self._counters(statement))
                return self._own(own), {id(name) for name in own}

    def _counters(self, statement: ast.Statement) -> tuple[ast.Name, ...]:
        """The running indices of a statement about every element of an array: `i` of `c[i]`."""
        if not isinstance(statement, ast.About) or not isinstance(statement.target, ast.Index):
            return ()
        index = walk(statement.target.index)
        return tuple(n for n in index if isinstance(n, ast.Name) and n.text not in self.names.declared)

    def _own(self, parameters: Sequence[ast.Name]) -> dict[str, Symbol]:
        return {p.text: Symbol("argument", p.text, home(self.statement)) for p in parameters}

    def _arguments(self, owner: str, arguments: Sequence[str], outputs: Sequence[ast.Name]) -> dict[str, Symbol]:
        bare = any(name.text in self.names.bare for name in outputs)
        lent = frozenset[str]().union(*(self.names.lent.get(name.text, ()) for name in outputs))
        tied = self.names.declared if bare else lent
        return {a: Symbol("name", a) if a in tied else Symbol("argument", a, owner) for a in arguments}

    def _sees_arguments(self, part: ast.Node) -> bool:
        """Whether a part can use the local names: only postulates and contracts can in the case of an unknown."""
        statement = self.statement
        if isinstance(statement, ast.UnknownStatement):
            return any(part is p for p in (*statement.postulates, *statement.contracts))
        return not (isinstance(statement, ast.TruthStatement) and part is statement.target)

    def _visit(self, root: ast.Node, scope: Scope, formals: Scope, declaring: set[int]) -> None:
        stack: list[ast.Node] = [root]
        while stack:
            node = stack.pop()
            match node:
                case ast.Name() if id(node) in declaring:
                    self._add(scope.get(node.text, Symbol("name", node.text)), node.span, declares=True)
                case ast.Name():
                    self._name(node, scope)
                    self._implied(node, scope)
                case ast.Call(function=function, arguments=arguments):
                    self._called(function, scope)
                    stack.extend(arguments)
                case ast.Argument(name=name):
                    symbol = formals[name.text]
                    self._add(symbol, name.span, declares=symbol.space == "argument")
                    stack.extend(part for part in (node.unit, node.range) if part is not None)
                case ast.Bound() | ast.RangeContract() | ast.ZeroAt() | ast.EqualsAt() | ast.Shaped() | ast.Periodic():
                    stack.extend(self._contract(node, scope))
                case ast.Distribution(kind=kind, arguments=arguments):
                    self._add(Symbol("word", kind.text, "distribution"), kind.span)
                    stack.extend(arguments)
                case ast.NetworkSpec():
                    stack.extend(self._network(node))
                case ast.UnitName(text=text):
                    self._add(Symbol("unit", text), node.span)
                case _:
                    stack.extend(children(node))

    def _contract(self, node: ast.Contract, scope: Scope) -> list[ast.Node]:
        """Records the names of a contract and returns its expressions."""
        if node.name is not None:
            self._add(Symbol("name", node.name.text), node.name.span)
        match node:
            case ast.Bound(value=value):
                return [value]
            case ast.RangeContract(interval=interval):
                return [interval]
            case ast.ZeroAt(argument=argument, value=value):
                self._name(argument, scope)
                return [value]
            case ast.EqualsAt(value=value, argument=argument, place=place):
                self._name(argument, scope)
                return [value, place]
            case ast.Periodic(period=period, argument=argument):
                self._name(argument, scope)
                return [period]
            case ast.Shaped(argument=argument):
                self._name(argument, scope)
                return []

    def _network(self, network: ast.NetworkSpec) -> Iterator[ast.Node]:
        self._add(Symbol("word", network.kind.text, "network"), network.kind.span)
        yield from network.widths
        for option in network.options:
            self._add(Symbol("word", option.name.text, "option"), option.name.span)
            if isinstance(option.value, ast.Name):
                self._add(Symbol("word", option.value.text, "activation"), option.value.span)
            else:
                yield option.value

    def _name(self, name: ast.Name, scope: Scope) -> None:
        known = scope.get(name.text)
        if known is None and name.text in ("pi", "nn") and name.text not in self.names.declared:
            known = Symbol("word", name.text, "value")
        self._add(known or Symbol("name", name.text), name.span)

    def _called(self, function: ast.Name, scope: Scope) -> None:
        word = function.text in FUNCTIONS or function.text in ("net", "sum", "delay")
        if word and function.text not in self.names.declared:
            self._add(Symbol("word", function.text, "function"), function.span)
        else:
            self._name(function, scope)

    def _implied(self, name: ast.Name, scope: Scope) -> None:
        """Records the names to which an unknown without parentheses is implicitly applied."""
        if name.text in self.names.arguments and name.text not in scope:
            for argument in self.names.arguments[name.text][1]:
                if argument in scope:
                    self._add(scope[argument], name.span, implied=True)

    def _add(self, symbol: Symbol, span: Span, *, declares: bool = False, implied: bool = False) -> None:
        self.found.append(Occurrence(symbol, span, self.statement, declares, implied))
