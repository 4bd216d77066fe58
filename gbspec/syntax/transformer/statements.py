"""The rules of statements."""

# ruff: noqa: D102 - each method is named after the rule of gb.lark whose node it builds

from __future__ import annotations

from typing import Any

from lark import Token, Transformer

from gbspec.syntax import ast
from gbspec.syntax.names import STATEMENTS
from gbspec.syntax.transformer.clauses import ClauseRules
from gbspec.syntax.transformer.parts import Children, Names, tokens


class Builder(Transformer[Token, ast.Node], ClauseRules):
    """The rules of statements."""

    def __init__(self) -> None:
        Transformer.__init__(self)
        ClauseRules.__init__(self)

    def _required(self, children: Children, found: dict[str, Any], kind: str, message: str, help: str) -> Any:
        """A clause that the statement cannot do without."""
        if kind in found:
            return found[kind]
        span = self.over(children)
        self.problem("GB129", message, span, help=help)
        return ast.Number(span, "0")

    def model_statement(self, children: Children) -> ast.ModelStatement:
        found = self.gather(children, "`model`")
        name = self.name_at(children[1])
        return ast.ModelStatement(self.over(children), name, found.get("text"), found.get("extends"))

    def time_statement(self, children: Children) -> ast.TimeStatement:
        found = self.gather(children, "`time`")
        name = self.declared(children[1])
        return ast.TimeStatement(self.over(children), name, found.get("unit"), found.get("from"), found.get("text"))

    def unit_statement(self, children: Children) -> ast.UnitStatement:
        found = self.gather(children, "`unit`")
        return ast.UnitStatement(self.over(children), self.name_at(children[1]), found.get("text"))

    def state_statement(self, children: Children) -> ast.StateStatement:
        found = self.gather(children, "a state")
        declarator: ast.Declarator = children[1]
        if declarator.name.text in STATEMENTS:
            self.problem(
                "GB149",
                f"a state cannot be called `{declarator.name.text}`: its balance would begin like that statement",
                declarator.name.span,
                help="choose another name",
            )
        return ast.StateStatement(
            self.over(children),
            declarator,
            found.get("unit"),
            found.get("range"),
            found.get("value"),
            found.get("text"),
        )

    def condition_statement(self, children: Children) -> ast.ConditionStatement:
        found = self.gather(children, "a condition")
        return ast.ConditionStatement(
            self.over(children),
            self.declared(children[1]),
            found.get("unit"),
            found.get("range"),
            found.get("value"),
            found.get("column"),
            found.get("text"),
        )

    def input_statement(self, children: Children) -> ast.InputStatement:
        found = self.gather(children, "an input")
        return ast.InputStatement(
            self.over(children),
            self.declared(children[1]),
            found.get("unit"),
            found.get("range"),
            found.get("interpolation"),
            found.get("value"),
            found.get("column"),
            found.get("text"),
        )

    def const_statement(self, children: Children) -> ast.ConstStatement:
        found = self.gather(children, "a constant")
        name = self.declared(children[1])
        message = f"the constant `{name.text}` has no value"
        help = f"write `const {name.text} = …`, or `learn {name.text} = …` if it is to be learned"
        value = self._required(children, found, "value", message, help)
        return ast.ConstStatement(self.over(children), name, value, found.get("unit"), found.get("text"))

    def learn_statement(self, children: Children) -> ast.LearnStatement:
        found = self.gather(children, "a learnable constant")
        return ast.LearnStatement(
            self.over(children),
            self.declared(children[1]),
            found.get("unit"),
            found.get("value"),
            found.get("range"),
            found["bounds"],
            found.get("prior"),
            found.get("per_trajectory", False),
            found.get("text"),
        )

    def let_statement(self, children: Children) -> ast.LetStatement:
        found = self.gather(children, "`let`")
        name = self.declared(children[1])
        message = f"`let {name.text}` names no expression"
        value = self._required(children, found, "value", message, f"write `let {name.text} = …`")
        return ast.LetStatement(self.over(children), name, value, found.get("unit"), found.get("text"))

    def function_statement(self, children: Children) -> ast.FunctionStatement:
        found = self.gather(children, "a function")
        name = self.declared(children[1])
        formals = next((child.items for child in children if isinstance(child, Names)), ())
        head = self.place(children[1], tokens(children, "RPAR")[0]).text
        message = f"the function `{name.text}` says nothing"
        help = f"write `function {head} = …`; a function to be learned is `unknown {head}`"
        value = self._required(children, found, "value", message, help)
        return ast.FunctionStatement(self.over(children), name, formals, value, found.get("text"))

    def unknown_statement(self, children: Children) -> ast.UnknownStatement:
        found = self.gather(children, "an unknown function")
        return ast.UnknownStatement(
            self.over(children),
            children[1].items,
            next((child for child in children if isinstance(child, tuple)), ()),
            found.get("unit", ()),
            found["contracts"],
            found.get("postulates", ()),
            found.get("network"),
            found.get("text"),
        )

    def process_statement(self, children: Children) -> ast.ProcessStatement:
        found = self.gather(children, "a process")
        name = self.declared(children[1])
        message = f"the process `{name.text}` has no rate"
        rate = self._required(children, found, "rate", message, "write `rate …` after what it converts")
        return ast.ProcessStatement(
            self.over(children), name, found.get("consumed"), found.get("produced"), rate, found.get("text")
        )

    def balance_statement(self, children: Children) -> ast.BalanceStatement:
        found = self.gather(children, "a balance")
        return ast.BalanceStatement(self.over(children), children[0], found["value"], found.get("text"))

    def closure_statement(self, children: Children) -> ast.ClosureStatement:
        found = self.gather(children, "the end of an array")
        return ast.ClosureStatement(self.over(children), children[0], found["value"])

    def initial_statement(self, children: Children) -> ast.InitialStatement:
        found = self.gather(children, "`initial`")
        target: ast.Name | ast.Index = children[1]
        if ("value" in found) == ("learned" in found):
            self.problem(
                "GB129",
                f"`initial {target.span.text}` needs either `= …` or `learn`",
                self.over(children),
                help=f"write `initial {target.span.text} = …` where the start is known, else `… learn`",
            )
        return ast.InitialStatement(self.over(children), target, found.get("value"), found.get("text"))

    def observe_statement(self, children: Children) -> ast.ObserveStatement:
        found = self.gather(children, "a channel")
        return ast.ObserveStatement(
            self.over(children),
            children[1],
            found.get("value"),
            found.get("unit"),
            found.get("noise"),
            found.get("column"),
            found.get("text"),
        )

    def dose_statement(self, children: Children) -> ast.DoseStatement:
        found = self.gather(children, "a dose")
        return ast.DoseStatement(
            self.over(children), children[1], found.get("times"), found.get("lag"), found.get("text")
        )

    def conserve_statement(self, children: Children) -> ast.ConserveStatement:
        found = self.gather(children, "`conserve`")
        name = self.declared(children[1])
        message = f"`conserve {name.text}` does not say what is conserved"
        value = self._required(children, found, "value", message, f"write `conserve {name.text} = …`")
        return ast.ConserveStatement(self.over(children), name, value, found.get("rate"), found.get("text"))

    def truth_statement(self, children: Children) -> ast.TruthStatement:
        found = self.gather(children, "a truth")
        formals = next((child.items for child in children if isinstance(child, Names)), None)
        return ast.TruthStatement(self.over(children), self.name_at(children[1]), found["value"], formals)

    def allow_statement(self, children: Children) -> ast.AllowStatement:
        code, *name = (self.name_at(token) for token in children[1:])
        return ast.AllowStatement(self.over(children), code, name[0] if name else None)

    def without_statement(self, children: Children) -> ast.WithoutStatement:
        first, *second = (self.name_at(token) for token in children[1:])
        if not second:
            return ast.WithoutStatement(self.over(children), None, first)
        if first.text not in STATEMENTS:
            self.problem(
                "GB102",
                f"there is no statement `{first.text}` that `without` could remove",
                first.span,
                help="write `without observe x`, `without initial x`, …, or `without NAME` for what declares a name",
            )
        return ast.WithoutStatement(self.over(children), first, second[0])
