"""The Model: the meaning of a `.gb` file in sympy. Immutable; every part has its place in the text.

All symbols are `sympy.Symbol(name, real=True)`, one per name (see `symbol`). An application of an unknown is an
undefined sympy function of the unknown's name, `phi(x1, x2, Da)` (see `unknown_function`);
its value is given by `Unknown.postulate`. Intermediates (`let`, process rates) stay symbols in balances and
observations and are listed in an order in which each depends only on earlier ones; `Model.inlined` replaces them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, TypeAlias

import sympy

from gbspec.diagnostics import Span
from gbspec.ir.algebra import Algebraic, Equation, EquationBlock
from gbspec.ir.arrays import Element, Family, StateArray, Vector, runs
from gbspec.ir.declared import UNBOUNDED
from gbspec.ir.declared import Declared as Declared
from gbspec.ir.declared import Range as Range
from gbspec.ir.delays import Delay, timed
from gbspec.ir.distributions import Distribution, Noise
from gbspec.ir.events import Event, Switch
from gbspec.ir.forms import Form, Layout
from gbspec.ir.starts import MEASURED, Steady
from gbspec.ir.starts import Initial as Initial
from gbspec.ir.symbols import symbol as symbol
from gbspec.ir.symbols import unknown_function as unknown_function
from gbspec.ir.tables import Curve

Expr: TypeAlias = sympy.Expr


@dataclass(frozen=True)
class Time(Declared):
    """The independent variable. `start` None: every trajectory starts at its first row."""

    start: float | None = None


@dataclass(frozen=True)
class State(Declared):
    """A variable with a balance. `range` is for scaling and warnings; `start` is a guess of the initial value.
    `discrete`: only events change it, and its balance is zero. `history`: what it was before the start, an expression
    of constants, conditions and the time; None: what it is at the start."""

    range: Range | None = None
    start: float | None = None
    initial: Initial = MEASURED
    discrete: bool = False
    history: Expr | None = None


@dataclass(frozen=True)
class Condition(Declared):
    """A known quantity, constant within a trajectory; `column` is its name in the data.

    `categories`: their names, where its values are numbers of categories, 0, 1, and so on. `labels`: its cells may be
    texts, which only tell trajectories apart.
    """

    range: Range | None = None
    default: float | None = None
    column: str = ""
    categories: tuple[str, ...] = ()
    labels: bool = False


@dataclass(frozen=True)
class Input(Declared):
    """A known function of time, whose symbol is its value now; a rate of infusion if it names what it `infuses`."""

    interpolation: Literal["held", "linear"] = "held"
    range: Range | None = None
    default: float | None = None
    column: str = ""
    infuses: str = ""


@dataclass(frozen=True)
class Constant(Declared):
    """A known number."""

    value: float = 0.0


@dataclass(frozen=True)
class Prior:
    """`normal(mean, sd)` or `lognormal(median, cv)` of a learnable."""

    kind: Literal["normal", "lognormal"]
    location: float
    scale: float


@dataclass(frozen=True)
class Learnable(Declared):
    """A constant to be learned, inside `range` (open ends if a bound is strict; infinite without a bound).

    With a `distribution` between trajectories, start, range and prior are those of its median.
    """

    start: float = 1.0
    range: Range = UNBOUNDED
    prior: Prior | None = None
    per_trajectory: bool = False
    distribution: Distribution | None = None
    by_subject: bool = field(default=False, compare=False, repr=False)  # `per subject`, which means `per trajectory`

    @property
    def individual(self) -> Learnable:
        """The value of a single trajectory, with the range that its distribution allows."""
        if self.distribution is None or self.distribution.kind == "logitnormal":
            return self
        low = 0.0 if self.distribution.kind == "lognormal" else -math.inf
        return replace(self, range=Range(low, math.inf), prior=None)


@dataclass(frozen=True)
class Argument:
    """A formal argument of a network: the declared name, its unit and range."""

    name: str
    unit: str | None = None
    range: Range | None = None

    @property
    def symbol(self) -> sympy.Symbol:
        """The formal in postulates and contracts."""
        return symbol(self.name)


Promise: TypeAlias = Literal[
    "lower", "upper", "zero", "equals", "period", "increasing", "decreasing", "convex", "concave", "odd", "even"
]
"""The kinds of contracts."""


@dataclass(frozen=True)
class Contract:
    """A guarantee on one output: `lower`, `upper` (by `value`), `zero` (at argument = value), `equals` (`to` there),
    `period` (of length `value`), or how it depends on the argument."""

    kind: Promise
    value: Expr | None = None
    argument: str | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    to: Expr | None = None


NN = symbol("nn")
"""The network's raw output in `Unknown.postulate`; `nn` is reserved, so that it cannot clash with a name."""


@dataclass(frozen=True)
class Unknown(Declared):
    """One function to be learned: output `output` of network `network` of the Model.

    Its value is `postulate` with `NN` the network's output and the formals its arguments; `postulate == NN` if the
    user gave none. `neutral` is the value of `nn` without a correction (1 if it is a factor, else 0).
    """

    network: int = 0
    output: int = 0
    postulate: Expr = NN
    neutral: float = 0.0
    contracts: tuple[Contract, ...] = ()
    form: Form | None = None
    """The form that guarantees its contracts (`gbspec.passes.contracts`); None: the postulate is used directly."""


Activation = Literal["silu", "tanh", "softplus", "relu", "gelu", "sigmoid", "elu", "sin"]


@dataclass(frozen=True)
class Network:
    """A multilayer perceptron shared by the outputs `outputs` (names of unknowns, in order)."""

    outputs: tuple[str, ...]
    arguments: tuple[Argument, ...]
    hidden: tuple[int, ...] = (32, 32)
    activation: Activation = "silu"
    layout: Layout | None = None
    """The directions of its units if contracts need them monotone; None: every weight is free."""
    spline: tuple[int, ...] = ()
    """The numbers of coefficients in each argument if it is a spline: these are its biases, and it has no layers."""
    smooth: tuple[int, ...] = ()
    """The biases of a spline with a prior: the second differences of its coefficients."""
    between: bool = False
    """Whether a spline has in addition what half the distance of its knots would add, by which its size is judged."""
    extra: tuple[int, ...] = ()
    """The biases of what it has in addition."""
    cyclic: tuple[int, ...] = ()
    """The arguments in whose place contracts give it a cosine, which needs no scale from the data."""

    @property
    def name(self) -> str:
        """The network's name in weights files: its outputs joined by `_`."""
        return "_".join(self.outputs)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Widths of all layers: arguments, hidden layers, outputs (extra ones, which contracts need, included)."""
        gates = self.layout.gates if self.layout is not None else 0
        return (len(self.arguments), *self.hidden, len(self.outputs) + gates)

    @property
    def parameters(self) -> int:
        """Number of weights and biases that its outputs depend on: of a spline, its coefficients."""
        return self.sizes[-1] if self.spline else sum((a + 1) * b for a, b in pairwise(self.sizes))


@dataclass(frozen=True)
class Table(Declared):
    """A known function given by points; `units` are those of its arguments."""

    arguments: tuple[str, ...]
    curve: Curve
    units: tuple[str | None, ...] = ()


@dataclass(frozen=True)
class Intermediate(Declared):
    """A named expression: a `let`, or the rate of a process under the process's name."""

    value: Expr = sympy.S.Zero
    kind: Literal["let", "rate"] = "let"


@dataclass(frozen=True)
class Process(Declared):
    """A conversion: net stoichiometric coefficients (produced minus consumed) by state name; its rate is the symbol."""

    stoichiometry: tuple[tuple[str, Expr], ...] = ()


@dataclass(frozen=True)
class Channel(Declared):
    """A measured quantity; `state` is the index of the state measured directly, None if it is an expression."""

    value: Expr = sympy.S.Zero
    state: int | None = None
    noise: Noise | None = None
    column: str = ""


@dataclass(frozen=True)
class Dose:
    """Additions to a state, from the column `dose_STATE` of the data: amount times `fraction`, `lag` later. Those that
    last (`duration` where the data do not say; None: never) are the input `infusion`, in its balance times that."""

    state: str
    fraction: Expr = sympy.S.One
    lag: Expr = sympy.S.Zero
    duration: Expr | None = None
    infusion: str = ""
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Diffusion:
    """The random disturbance of a state (Ito): `value` times the increment of a Wiener process of its own.

    `relative` is `value` over the state if this does not depend on the state: then the state's logarithm has a
    disturbance of this size, whatever the state is; else None. With `between` (a, b) the size is proportional to
    (x - a)(b - x), and `relative` is that of the disturbance of the logit, ln((x - a)/(b - x)).
    """

    state: str
    value: Expr
    relative: Expr | None = None
    between: tuple[float, float] | None = None
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Claim(Declared):
    """`conserve`: a quantity whose rate of change is claimed to be `rate`."""

    value: Expr = sympy.S.Zero
    rate: Expr = sympy.S.Zero


@dataclass(frozen=True)
class TruthConstant:
    """The reference value of a learnable."""

    name: str
    value: float


@dataclass(frozen=True)
class TruthFunction:
    """The reference of an unknown; `value` is in `parameters`, constants and learnables (at their truths)."""

    name: str
    parameters: tuple[str, ...]
    value: Expr


@dataclass(frozen=True)
class Model:
    """A whole model. Vectors (states, balances; channels; constants) are in the order of these tuples."""

    name: str
    title: str = ""
    time: Time = Time("t")
    states: tuple[State, ...] = ()
    conditions: tuple[Condition, ...] = ()
    inputs: tuple[Input, ...] = ()
    constants: tuple[Constant, ...] = ()
    learnables: tuple[Learnable, ...] = ()
    implied: tuple[Learnable, ...] = ()
    """What is learned beside the declared constants: medians, spreads and correlations of distributions, noises."""
    correlated: tuple[tuple[str, ...], ...] = ()
    """Groups of learnables whose deviations are correlated."""
    networks: tuple[Network, ...] = ()
    unknowns: tuple[Unknown, ...] = ()
    tables: tuple[Table, ...] = ()
    intermediates: tuple[Intermediate, ...] = ()
    processes: tuple[Process, ...] = ()
    balances: tuple[Expr, ...] = ()
    channels: tuple[Channel, ...] = ()
    doses: tuple[Dose, ...] = ()
    diffusions: tuple[Diffusion, ...] = ()
    delays: tuple[Delay, ...] = ()
    steady: Steady | None = None
    events: tuple[Event, ...] = ()  # in the order in which they happen at one time
    switches: tuple[Switch, ...] = ()  # where steps are cut, in a Model that engines solve so; no file has any
    algebraics: tuple[Algebraic, ...] = ()  # in the order of the blocks, without those that are intermediates
    constraints: tuple[Equation, ...] = ()
    blocks: tuple[EquationBlock, ...] = ()
    claims: tuple[Claim, ...] = ()
    truth_constants: tuple[TruthConstant, ...] = ()
    truth_functions: tuple[TruthFunction, ...] = ()
    arrays: tuple[StateArray, ...] = ()
    families: tuple[Family, ...] = ()
    """Short forms of entries of the vectors above, which have the single entries as well (see `gbspec.ir.arrays`)."""
    text: str = ""
    """The model as one `.gb` text, `extends` resolved; stored in run directories."""
    allowed: tuple[tuple[str, str | None], ...] = ()
    """Warnings that the author accepts: codes, each with the name it is accepted for (None: any)."""

    @property
    def class_name(self) -> str:
        """The generated module's class: the model's name in CamelCase."""
        return "".join(part[:1].upper() + part[1:] for part in self.name.split("_") if part) or "Model"

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of all constants, known then learnable: the order of the constants' vector everywhere."""
        return (*(c.name for c in self.constants), *(k.name for k in self.learnables))

    @cached_property
    def distributed(self) -> tuple[Learnable, ...]:
        """The learnables with a distribution between trajectories."""
        return tuple(k for k in self.learnables if k.distribution is not None)

    @cached_property
    def marginal(self) -> bool:
        """Whether its likelihood has learned spreads or noises, so that it is fitted by the marginal likelihood."""
        learned = any(c.noise is not None and c.noise.value is not None for c in self.channels)
        return bool(self.distributed) or learned

    @cached_property
    def state_index(self) -> Mapping[str, int]:
        """Index of each state by name."""
        return {state.name: i for i, state in enumerate(self.states)}

    def runs(self, vector: Vector) -> Iterator[Family | int]:
        """The entries of a vector in order: families, and positions of single entries."""
        sizes = {"channels": len(self.channels), "intermediates": len(self.intermediates)}
        return runs(self.families, vector, sizes.get(vector, len(self.states)))

    def equations(self, vector: Vector | Literal["closures"]) -> list[tuple[Expr, Expr]]:
        """Left and right sides for display: one per family, with an `Element` on the left; or those of array ends.

        The left sides are the names of states, channels or intermediates. Channels that measure a state directly, and
        initial values without an expression, are left out.
        """
        if vector == "closures":
            return [(Element(a.symbol, sympy.Integer(k)), value) for a in self.arrays for k, value in a.ends]
        if vector in ("channels", "intermediates"):
            entries = [(item.symbol, item.value) for item in getattr(self, vector)]
        else:
            values = self.balances if vector == "balances" else [s.initial.value for s in self.states]
            entries = [(s.symbol, value) for s, value in zip(self.states, values, strict=True)]
        found: list[tuple[Expr, Expr]] = []
        for run in self.runs(vector):
            if isinstance(run, int):
                found.append(entries[run])
            elif run.index is None:
                found.append((entries[run.begin][0], run.value))
            else:
                found.append((Element(symbol(run.array), run.index), run.value))
        return [(left, right) for left, right in found if right is not None and (vector != "channels" or left != right)]

    @cached_property
    def unknown_names(self) -> frozenset[str]:
        """Names of the unknowns."""
        return frozenset(u.name for u in self.unknowns)

    @property
    def complete(self) -> bool:
        """Whether it can be evaluated without weights: it has no unknown function."""
        return not self.unknowns

    @cached_property
    def has_truth(self) -> bool:
        """Whether every unknown has a truth (learnables without one have their starting values)."""
        known = {truth.name for truth in self.truth_functions}
        return all(unknown.name in known for unknown in self.unknowns)

    def accepts(self, code: str, name: str | None = None) -> bool:
        """Whether an `allow` accepts the warning `code` about `name`."""
        return any(allowed == code and about in (None, name) for allowed, about in self.allowed)

    def timed(self, expression: Expr) -> Expr:
        """The expression for display, with each delayed value as its quantity at an earlier time, `x(t - tau)`."""
        return timed(expression, self.delays, self.time.symbol)

    def inlined(self, expressions: Iterable[Expr]) -> tuple[Expr, ...]:
        """The expressions with every intermediate substituted."""
        expressions = tuple(expressions)
        if not self.intermediates or not any(one.free_symbols for one in expressions):
            return expressions
        found = self._inlined
        for one in expressions:
            if one not in found:
                found[one] = one.xreplace(self._values)
        return tuple(found[one] for one in expressions)

    @cached_property
    def _values(self) -> dict[sympy.Symbol, Expr]:
        """What each intermediate stands for, without other intermediates."""
        table: dict[sympy.Symbol, Expr] = {}
        for item in self.intermediates:
            table[item.symbol] = item.value.xreplace(table)
        return table

    @cached_property
    def _inlined(self) -> dict[Expr, Expr]:
        """Expressions with every intermediate substituted: sympy takes seconds where conditions depend on others."""
        return {}
