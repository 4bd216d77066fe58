"""Resolves the names in expressions. Each error is reported once, however often it occurs."""

from __future__ import annotations

from dataclasses import dataclass, field

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics import delays
from gbspec.semantics.expressions import operands
from gbspec.semantics.merge import Merged
from gbspec.semantics.sites import Site
from gbspec.semantics.table import Declaration, Table
from gbspec.semantics.vocabulary import CONSTANTS, arity, suggestion
from gbspec.syntax import FUNCTIONS, VALUES, Kind, ast

_NOT_OFFERED = {
    "lag": "write `delay(X, tau)`: what X was a time tau ago",
    **dict.fromkeys(
        ("random", "rand", "randn", "noise", "normal", "gauss", "uniform"),
        "no function is random; `diffusion x = …` disturbs a state, and `noise normal(…)` of `observe` a measurement",
    ),
    **dict.fromkeys(("integral", "integrate"), "an integral is a state: `state y`, `y' = …`, `initial y = 0`"),
}
"""Functions that other languages have, and what takes their place here."""

_FLAT = frozenset({"sign", "floor", "ceil"})
"""Functions whose slope is 0 almost everywhere."""

_NO_ARGUMENTS = frozenset({Kind.FUNCTION, Kind.TABLE, Kind.UNKNOWN, Kind.CHANNEL, Kind.CLAIM})
"""Kinds of names that cannot be an argument of an unknown by name."""

_SUGGESTIONS = 20
_MOST = 200  # undeclared names that are reported one by one
_PLACES = 4


@dataclass
class Missing:
    """An undeclared name: where it occurs, the formal arguments known there, whether it is called."""

    spans: list[Span]
    formals: frozenset[str]
    called: bool


@dataclass
class Resolver:
    """Resolves expressions one after the other and collects undeclared names, to report each once."""

    table: Table
    findings: Findings
    missing: dict[str, Missing] = field(default_factory=dict)
    unapplied: list[tuple[ast.Name, Declaration, list[ast.Name]]] = field(default_factory=list)
    """Unknowns used without arguments, with those of their declared arguments that are not names of the model."""

    def resolve(self, site: Site) -> None:
        """Fills the site's references; reports wrong calls and misplaced `nn` and arrays."""
        stack: list[tuple[ast.Expression, bool]] = [(site.expression, True)]
        while stack:
            node, smooth = stack.pop()
            match node:
                case ast.Name():
                    self._name(node, site, smooth)
                case ast.Call(function=ast.Name(text="net")):
                    self._net(node, site)
                    continue
                case ast.Call() if delays.is_delay(node, self.table) and delays.DELAY not in site.formals:
                    delays.check(node, site, self.table, self.findings)
                case ast.Call():
                    self._call(node, site, smooth)
                case _:
                    pass
            parts = operands(node)
            if isinstance(node, ast.Conditional):
                stack.append((node.otherwise, smooth))
                stack.append((node.then, smooth))
                stack.append((node.condition, False))
            elif isinstance(node, ast.Call) and node.function.text in _FLAT:
                stack.extend((part, False) for part in reversed(parts))
            else:
                stack.extend((part, smooth) for part in reversed(parts))

    def report_missing(self, merged: Merged) -> None:
        """Reports each undeclared name once, at its first place."""
        names = [name for name in self.missing if merged.lacks(name)]
        for number, name in enumerate(names[:_MOST]):
            missing = self.missing[name]
            places = {(s.source.path, s.start): s for s in missing.spans}
            spans = [places[key] for key in sorted(places)]
            what = "no function is named" if missing.called else "undeclared name"
            self.findings.error(
                "GB201",
                f"{what} `{name}`",
                spans[0],
                label="not declared",
                labels=[Label(span, "also here") for span in spans[1:_PLACES]],
                notes=self._further(len(spans) - _PLACES, len(names) - _MOST if number == _MOST - 1 else 0),
                help=(_NOT_OFFERED.get(name, "") if missing.called else "")
                or self._rate(name)
                or (suggestion(name, self._candidates(missing)) if number < _SUGGESTIONS else "")
                or f"declare it, for example `{'function' if missing.called else 'const'} {name}"
                f"{'(x)' if missing.called else ''} = …`",
                subject=name,
            )

    @staticmethod
    def _further(places: int, names: int) -> list[str]:
        """Notes on what is not shown: further places of a name, and further names."""
        notes = [f"and in {places} more places"] if places > 0 else []
        return notes + ([f"and {names:,} more names are not declared"] if names > 0 else [])

    def report_unapplied(self, merged: Merged) -> None:
        """Reports each unknown used without arguments whose declared arguments are not all names of the model."""
        told: set[str] = set()
        for node, unknown, undeclared in self.unapplied:
            lacking = all(
                n.text in merged.arrays or (merged.lacks(n.text) and n.text not in self.missing) for n in undeclared
            )
            if not lacking or unknown.name in told:
                continue
            told.add(unknown.name)
            names = " and ".join(f"`{n.text}`" for n in undeclared)
            self.findings.error(
                "GB206",
                f"`{node.text}` is used without arguments, but {names} of its declaration is not a name of the model",
                node.span,
                label="applied to what?",
                labels=[Label(n.span, "declared with this argument") for n in undeclared],
                help=f"give its arguments: `{_usage(unknown)}` with values of this model",
            )

    # ------------------------------------------------------------------------------------------------------- names

    def _use(self, name: str, span: Span, site: Site, smooth: bool) -> None:
        site.references.names.setdefault(name, span)
        if smooth:
            site.references.smooth.add(name)

    def _not_found(self, name: ast.Name, site: Site, *, called: bool) -> None:
        site.references.complete = False
        missing = self.missing.get(name.text)
        if missing is None:
            missing = self.missing[name.text] = Missing([], frozenset(site.formals), called)
        missing.spans.append(name.span)

    def _rate(self, name: str) -> str:
        """The help for a rate of change that is written `dX/dt`; empty for other names."""
        state = self.table.get(name[1:]) if name.startswith("d") else None
        if state is None or state.kind is not Kind.STATE:
            return ""
        return f"a measured rate of change is written `{name[1:]}'`, in `observe`; elsewhere its expression is a `let`"

    def _candidates(self, missing: Missing) -> frozenset[str]:
        """The names of which an undeclared one may be a misspelling."""
        kinds = (Kind.FUNCTION, Kind.TABLE, Kind.UNKNOWN) if missing.called else None
        pool = {n for n, d in self.table.items() if kinds is None or d.kind in kinds}
        return frozenset(pool | (set(FUNCTIONS) if missing.called else missing.formals))

    def _name(self, node: ast.Name, site: Site, smooth: bool) -> None:
        name = node.text
        if name in site.formals or name in CONSTANTS:
            return
        if name == "nn":
            if not site.nn:
                site.references.complete = False
                self.findings.error(
                    "GB217",
                    "`nn` is the output of the network, which only the postulate of an unknown has",
                    node.span,
                    help="write it in the declaration: `unknown f(x) = g(x)*nn`, and `f` here",
                )
            return
        declaration = self.table.get(name)
        if declaration is None:
            if name in FUNCTIONS:
                self._without_arguments(node, site, "a function", name)
            else:
                self._not_found(node, site, called=False)
        elif declaration.kind in (Kind.FUNCTION, Kind.TABLE):
            self._without_arguments(node, site, declaration.kind.value, _usage(declaration), declaration.span)
        elif declaration.kind not in VALUES:
            self._no_value(node, declaration, site)
        else:
            self._use(name, node.span, site, smooth)
            if declaration.kind is Kind.UNKNOWN:
                self._bare_unknown(node, declaration, site, smooth)

    def _bare_unknown(self, node: ast.Name, unknown: Declaration, site: Site, smooth: bool) -> None:
        """Resolves an unknown without parentheses: it is applied to the names of its declaration in this scope."""
        assert isinstance(unknown.statement, ast.UnknownStatement)
        undeclared = []
        for argument in unknown.statement.arguments:
            text = argument.name.text
            declaration = self.table.get(text)
            if text in site.formals:
                continue
            if declaration is None or declaration.kind in _NO_ARGUMENTS:
                undeclared.append(argument.name)
            else:
                self._use(text, node.span, site, smooth)
        if undeclared:
            site.references.complete = False
            self.unapplied.append((node, unknown, undeclared))

    def _without_arguments(self, node: ast.Name, site: Site, what: str, usage: str, at: Span | None = None) -> None:
        site.references.complete = False
        self.findings.error(
            "GB205",
            f"`{node.text}` is {what} and needs its arguments here",
            node.span,
            labels=[Label(at, "declared here")] if at is not None else [],
            help=f"write `{usage}`" if "(" in usage else f"write `{usage}(…)`",
        )

    def _no_value(self, node: ast.Name, declaration: Declaration, site: Site) -> None:
        site.references.complete = False
        help_text = "write the expression itself, or name it with `let`"
        if declaration.kind is Kind.CHANNEL:
            help_text = f"name the expression first: `let {node.text}_value = …`, and use that in both places"
        elif declaration.kind is Kind.EVENT:
            help_text = f"count it: `discrete n in [0, 100] = 0`, and `n = n + 1` among what `{node.text}` sets"
        self.findings.error(
            "GB213",
            f"`{node.text}` is {declaration.kind.value} and has no value in expressions",
            node.span,
            labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
            help=help_text,
        )

    # ------------------------------------------------------------------------------------------------------- calls

    def _call(self, node: ast.Call, site: Site, smooth: bool) -> None:
        name, count = node.function, len(node.arguments)
        if name.text in site.formals or name.text in CONSTANTS or name.text == "nn":
            self._not_a_function(node, "an argument" if name.text in site.formals else "a number", None, site)
            return
        declaration = self.table.get(name.text)
        if declaration is None:
            if name.text in FUNCTIONS:
                least, most = arity(name.text)
                if count < least or (most is not None and count > most):
                    self._wrong_arity(node, least, site, None, at_least=most is None)
            else:
                self._not_found(name, site, called=True)
            return
        match declaration.statement:
            case ast.FunctionStatement(parameters=parameters):
                expected = len(parameters)
            case ast.UnknownStatement(arguments=arguments) | ast.TableStatement(arguments=arguments):
                expected = len(arguments)
            case _:
                self._not_a_function(node, declaration.kind.value, declaration.span, site)
                return
        self._use(name.text, name.span, site, smooth)
        if count != expected:
            self._wrong_arity(node, expected, site, declaration)

    def _net(self, node: ast.Call, site: Site) -> None:
        argument = node.arguments[0] if len(node.arguments) == 1 else None
        declaration = self.table.get(argument.text) if isinstance(argument, ast.Name) else None
        if isinstance(argument, ast.Name) and declaration is not None and declaration.kind is Kind.STATE:
            site.references.nets.setdefault(argument.text, node.span)
        elif isinstance(argument, ast.Name) and declaration is None and argument.text not in site.formals:
            self._not_found(argument, site, called=False)
        else:
            site.references.complete = False
            self.findings.error(
                "GB218",
                "`net(…)` takes the name of one state",
                node.span if argument is None else argument.span,
                label="not a state" if argument is not None else "",
                help="`net(X)` is the sum of all processes' contributions to the rate of change of the state `X`",
            )

    def _not_a_function(self, node: ast.Call, what: str, at: Span | None, site: Site) -> None:
        site.references.complete = False
        name = node.function.text
        self.findings.error(
            "GB204",
            f"`{name}` is {what}, not a function",
            node.span,
            labels=[Label(at, "declared here")] if at is not None else [],
            help=self._instead_of_a_call(name, node.arguments),
        )

    def _instead_of_a_call(self, name: str, arguments: tuple[ast.Expression, ...]) -> str:
        """What to write in place of `x(t)`, `x(t - tau)` or any other call of what is no function."""
        match arguments:
            case (ast.Name() as only,) if self._is_time(only):
                return f"write `{name}` for its value at the current time"
            case (ast.Binary(operator="-", left=left, right=right),) if self._is_time(left):
                return f"write `delay({name}, {right.span.text})`: what `{name}` was that time ago"
            case _:
                return f"to multiply, write `{name}*(…)`; a function is declared with `function {name}(x) = …`"

    def _is_time(self, node: ast.Expression) -> bool:
        declaration = self.table.get(node.text) if isinstance(node, ast.Name) else None
        return declaration is not None and declaration.kind is Kind.TIME

    def _wrong_arity(
        self, node: ast.Call, expected: int, site: Site, declaration: Declaration | None, *, at_least: bool = False
    ) -> None:
        site.references.complete = False
        count = len(node.arguments)
        takes = f"{'at least ' if at_least else ''}{expected} argument{'' if expected == 1 else 's'}"
        self.findings.error(
            "GB207",
            f"`{node.function.text}` takes {takes}, {count} {'is' if count == 1 else 'are'} given",
            node.span,
            labels=[Label(declaration.span, "declared here")] if declaration and declaration.span else [],
            help=f"write `{_usage(declaration)}`" if declaration else "",
        )


def _usage(declaration: Declaration) -> str:
    """A call of a function with the arguments of its declaration, as text."""
    match declaration.statement:
        case ast.FunctionStatement(parameters=parameters):
            names = [p.text for p in parameters]
        case ast.UnknownStatement(arguments=arguments) | ast.TableStatement(arguments=arguments):
            names = [a.name.text for a in arguments]
        case _:
            names = []
    return f"{declaration.name}({', '.join(names)})"
