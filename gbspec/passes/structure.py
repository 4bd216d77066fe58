"""The structure of algebraic equations: which of them determine which variables, and in which order.

A maximum matching pairs equations with variables. What it leaves over are errors that name the equations and variables
of the over- or underdetermined part (Dulmage and Mendelsohn); else the strongly connected components of the matching
are the blocks, each of which is solved after those that it depends on. Blocks whose variables formulas give are solved
here (`gbspec.passes.linear`), and the variables become intermediates of the Model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import sympy

from gbspec.diagnostics import Findings, Span
from gbspec.ir import Equation, EquationBlock, Expr, Intermediate, Model, between_jumps
from gbspec.passes.linear import solved_by_formulas
from gbspec.passes.regularity import dependent

Incidence = Sequence[frozenset[int]]
"""For each equation the variables in it."""
MOST_DERIVATIVES = 3
"""How often an equation without algebraic variables is differentiated to find one."""
LONG = 160
"""A derivative whose text is longer is not shown."""


def with_structure(model: Model, findings: Findings) -> Model:
    """The model with its equations in blocks, and explicit ones as intermediates.

    Errors: too many equations (GB355), too few (GB356), a variable in no equation (GB357), an equation without a
    variable (GB358), equations that do not determine their variables (GB359), an index above 1 (GB360), and what is not
    offered together with algebraic variables (GB361).
    """
    if not model.algebraics and not model.constraints:
        return model
    found = _Structure(model, findings)
    blocks = found.blocks()
    if blocks is None:
        return model
    solved = _with_blocks(model, found.residuals, blocks)
    _refuse_together(solved, findings)
    return solved


class _Structure:
    def __init__(self, model: Model, findings: Findings) -> None:
        self._model, self._findings = model, findings
        self.residuals = model.inlined([equation.residual for equation in model.constraints])
        self._variables = [item.symbol for item in model.algebraics]
        place = {symbol: i for i, symbol in enumerate(self._variables)}
        self._inside: Incidence = [
            frozenset(place[s] for s in residual.free_symbols if s in place) for residual in self.residuals
        ]
        self._told: set[int] = set()
        """Variables that an error names already."""

    def blocks(self) -> list[tuple[list[int], list[int]]] | None:
        """Equations and variables of each block, in the order of solution; None after an error."""
        if self._without_variables() | self._without_equations():
            return None
        partner = _matching(self._inside)
        if len(partner) < max(len(self._inside), len(self._variables)):
            self._unmatched(partner)
            return None
        blocks = _components(self._inside, partner)
        variable_of = {equation: variable for variable, equation in partner.items()}
        found = [(sorted(block), sorted(variable_of[e] for e in block)) for block in blocks]
        good = [self._regular(equations, variables) for equations, variables in found]
        return found if all(good) else None

    # ------------------------------------------------------------------------------------------------------- errors

    def _names(self, variables: Iterable[int]) -> str:
        return _listed([self._variables[i].name for i in sorted(variables)])

    def _without_variables(self) -> bool:
        """Reports equations in which there is no algebraic variable."""
        bare = [i for i, inside in enumerate(self._inside) if not inside]
        for i in bare:
            equation, residual = self._model.constraints[i], self.residuals[i]
            states = [s.name for s in self._model.states if s.symbol in residual.free_symbols]
            if states:
                self._higher_index(equation, residual, states)
                continue
            self._findings.error(
                "GB358",
                f"the equation `{equation.name}` holds no algebraic variable, so that it determines none",
                equation.span,
                help="leave it out; a value is named by `let NAME = …`",
                subject=equation.name,
            )
        return bool(bare)

    def _higher_index(self, equation: Equation, residual: Expr, states: Sequence[str]) -> None:
        """Reports an equation between states, with the derivative that would hold an algebraic variable."""
        derivative, times = residual, 0
        variables: set[sympy.Symbol] = set()
        while times < MOST_DERIVATIVES and not variables:
            derivative, times = self._derivative(derivative), times + 1
            variables = derivative.free_symbols & set(self._variables)
        if variables:
            names = sorted(symbol.name for symbol in variables)
            self._told |= {self._variables.index(symbol) for symbol in variables}
            text = str(derivative).replace("**", "^")
            shown = f": `equation {equation.name}: 0 = {text}`" if len(text) < LONG else ""
            often = "once" if times == 1 else f"{times} times"
            help = (
                f"differentiated {often} with respect to time it holds {_listed(names)}{shown}; starts that satisfy "
                "the equation then keep it, up to the error of the solution"
            )
        else:
            help = f"a state can be left out: give {_listed(states[-1:])} by `let` instead of a balance"
        self._findings.error(
            "GB360",
            f"the equation `{equation.name}` holds no algebraic variable, and restricts {_listed(states)}, which have "
            "balances: the index of the system is above 1",
            equation.span,
            help=help,
            subject=equation.name,
        )

    def _derivative(self, residual: Expr) -> Expr:
        """The derivative with respect to time, with the balances for the rates of states."""
        if residual.has(sympy.core.function.AppliedUndef):
            return sympy.S.Zero
        balances = self._model.inlined(self._model.balances)
        parts = [
            between_jumps(residual, state.symbol) * rate
            for state, rate in zip(self._model.states, balances, strict=True)
        ]
        return sympy.Add(*parts, between_jumps(residual, self._model.time.symbol))

    def _without_equations(self) -> bool:
        """Reports variables that occur in no equation."""
        used = frozenset[int]().union(*self._inside)
        lost = [i for i in range(len(self._variables)) if i not in used]
        for i in lost:
            if i not in self._told:
                name = self._variables[i].name
                self._findings.error(
                    "GB357",
                    f"the algebraic variable `{name}` is in no equation",
                    self._model.algebraics[i].span,
                    help=f"add one, `equation NAME: 0 = …` with `{name}` in it; with a balance it would be a `state`",
                    subject=name,
                )
        return bool(lost)

    def _unmatched(self, partner: Mapping[int, int]) -> None:
        """Reports the over- and the underdetermined part of the system."""
        over = _reached([i for i in range(len(self._inside)) if i not in partner.values()], self._inside, partner)
        if over:
            equations = [self._model.constraints[i] for i in sorted(over)]
            variables = frozenset[int]().union(*(self._inside[i] for i in over))
            few = len(self._model.constraints) <= len(self._variables)
            surplus = len(over) - len(variables)
            message = (
                f"the equations {_listed([e.name for e in equations])} hold only {self._names(variables)}: "
                f"{surplus if surplus > 1 else 'one'} of them {'are' if surplus > 1 else 'is'} too many"
            )
            help = "leave it out, or declare another algebraic variable that it determines"
            if few:
                help = "another equation is needed for the variables that are left; " + _INDEX
            self._findings.error("GB359" if few else "GB355", message, equations[-1].span, help=help)
            if few:
                return
        users: dict[int, set[int]] = {}
        for equation, inside in enumerate(self._inside):
            for variable in inside:
                users.setdefault(variable, set()).add(equation)
        variable_of = {equation: variable for variable, equation in partner.items()}
        open_ = {i for i in range(len(self._variables)) if i not in partner}
        lacking, pending = len(open_), list(open_)
        while pending:
            for equation in users[pending.pop()]:
                variable = variable_of[equation]
                if variable not in open_:
                    open_.add(variable)
                    pending.append(variable)
        if open_:
            names = sorted({e for i in open_ for e in users[i]})
            held = _listed([self._model.constraints[e].name for e in names])
            are = "is" if len(names) == 1 else "are"
            self._findings.error(
                "GB356",
                f"{lacking if lacking > 1 else 'one'} {'equations are' if lacking > 1 else 'equation is'} missing: "
                f"for {self._names(open_)} there {are} only {held}",
                self._model.algebraics[min(open_)].span,
                help="add `equation NAME: 0 = …` for it, or make one of them a `let`, a `const` or a `learn`",
            )

    def _regular(self, equations: Sequence[int], variables: Sequence[int]) -> bool:
        """Whether the derivatives of a block's equations by its variables are independent somewhere."""
        residuals = [self.residuals[i] for i in equations]
        wrong = dependent(self._model, residuals, [self._variables[i] for i in variables])
        if wrong:
            named = [self._model.constraints[equations[i]] for i in wrong]
            alone = len(named) == 1
            self._findings.error(
                "GB359",
                f"the equation{'' if alone else 's'} {_listed([e.name for e in named])} "
                f"{'does' if alone else 'do'} not determine {self._names(variables)}: "
                + ("its derivative is zero" if alone else "their derivatives by them depend on each other everywhere"),
                named[-1].span,
                help="one of them must say something else about these variables; " + _INDEX,
            )
        return not wrong


_INDEX = (
    "where they restrict states the index is above 1: the combination of them without algebraic variables, "
    "differentiated with respect to time, is an equation that helps"
)


def _listed(names: Sequence[str]) -> str:
    few = [f"`{name}`" for name in names[:6]] + (["…"] if len(names) > 6 else [])
    return few[0] if len(few) == 1 else ", ".join(few[:-1]) + " and " + few[-1]


# -------------------------------------------------------------------------------------------------------- the graph
def _matching(inside: Incidence) -> dict[int, int]:
    """The equation of each matched variable, as many as possible, by augmenting paths."""
    partner: dict[int, int] = {}
    for root in range(len(inside)):
        before: dict[int, int] = {}  # the equation from which each variable was reached
        pending, free = [root], None
        while pending and free is None:
            equation = pending.pop(0)
            for variable in sorted(inside[equation]):
                if variable not in before:
                    before[variable] = equation
                    if variable not in partner:
                        free = variable
                        break
                    pending.append(partner[variable])
        owned = {equation: variable for variable, equation in partner.items()}
        while free is not None:
            equation = before[free]
            partner[free] = equation
            free = owned.get(equation) if equation != root else None
    return partner


def _reached(roots: Iterable[int], inside: Incidence, partner: Mapping[int, int]) -> set[int]:
    """The equations on alternating paths from unmatched equations."""
    found, pending = set(roots), list(roots)
    while pending:
        for variable in inside[pending.pop()]:
            other = partner.get(variable)
            if other is not None and other not in found:
                found.add(other)
                pending.append(other)
    return found


def _components(inside: Incidence, partner: Mapping[int, int]) -> list[list[int]]:
    """The strongly connected components of equations, each after those whose variables it needs (Tarjan)."""
    needs = [[partner[v] for v in sorted(variables)] for variables in inside]
    number: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[int] = []
    found: list[list[int]] = []
    for root in range(len(inside)):
        if root in number:
            continue
        path = [(root, iter(needs[root]))]
        number[root] = low[root] = len(number)
        stack.append(root)
        while path:
            node, following = path[-1]
            step = next(following, None)
            if step is None:
                path.pop()
                if path:
                    low[path[-1][0]] = min(low[path[-1][0]], low[node])
                if low[node] == number[node]:
                    cut = stack.index(node)
                    found.append(stack[cut:])
                    del stack[cut:]
            elif step not in number:
                number[step] = low[step] = len(number)
                stack.append(step)
                path.append((step, iter(needs[step])))
            elif step in stack:
                low[node] = min(low[node], number[step])
    return found


# ----------------------------------------------------------------------------------------------------- the solution
def _with_blocks(model: Model, residuals: Sequence[Expr], found: Sequence[tuple[list[int], list[int]]]) -> Model:
    """The model with blocks; variables that a formula gives become its first intermediates."""
    blocks: list[EquationBlock] = []
    kept, formulas = [], []
    for equations, variables in found:
        own = [model.algebraics[i] for i in variables]
        values = solved_by_formulas([residuals[i] for i in equations], [item.symbol for item in own])
        names = tuple(model.constraints[i].name for i in equations)
        blocks.append(EquationBlock(names, tuple(item.name for item in own), bool(values)))
        kept += [] if values else own
        formulas += [
            Intermediate(item.name, value, unit=item.unit, description=item.description, span=item.span)
            for item, value in zip(own, values, strict=False)
        ]
    moved = tuple(
        replace(family, begin=family.begin + len(formulas)) if family.vector == "intermediates" else family
        for family in model.families
    )
    return replace(
        model,
        algebraics=tuple(kept),
        blocks=tuple(blocks),
        intermediates=(*formulas, *model.intermediates),
        families=moved,
    )


def _refuse_together(model: Model, findings: Findings) -> None:
    """Errors for what is not offered together with algebraic variables that need a solver (GB361)."""
    if not model.algebraics:
        return
    first = model.algebraics[0].name

    def refuse(what: str, place: Span | None, help: str) -> None:
        message = f"{what}, which is not offered yet together with the algebraic variable `{first}`"
        findings.error("GB361", message, place, help=help)

    for event in model.events:
        refuse(
            f"`{event.name}` is an event", event.span, "leave out the events, or solve the equations by hand (`let`)"
        )
    for delay in model.delays:
        refuse(f"`{delay.source}` is delayed", delay.span, "leave out the delay")
    for diffusion in model.diffusions:
        refuse(f"`{diffusion.state}` has a diffusion", diffusion.span, "leave out the diffusion")
    for learnable in model.learnables:
        if learnable.distribution is not None:
            help = "leave out `~ …`, so that each trajectory has a value of its own"
            refuse(f"`{learnable.name}` is distributed between trajectories", learnable.span, help)
    for channel in model.channels:
        if channel.noise is not None and channel.noise.value is not None:
            refuse(f"the noise of `{channel.name}` holds learned constants", channel.span, "give it a number")
