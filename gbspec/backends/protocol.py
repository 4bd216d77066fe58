"""What the generated module offers to the rest of gbspec: its class, its instances with weights, and its equations.

A batch of vectors is [..., n]; what the equations take and give is of the library whose arithmetic they get (torch,
casadi or numpy), so that they have no type here. `template/model.py` of the module's backend documents each method.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol, Self, TypeAlias

from gbspec.arrays import Array
from gbspec.json_values import JsonObject

Value: TypeAlias = Any
"""A number, an array, a torch tensor or a casadi expression, or a tuple of them: an operand of an arithmetic."""
Arithmetic: TypeAlias = Any
"""The functions that equations call; `GeneratedModule.arithmetic` returns those of torch, casadi or numpy."""
Casadi: TypeAlias = Any
"""A function, an expression or a matrix of casadi, whose annotations are incomplete: MX, SX and DM share no type."""
Network: TypeAlias = Any
"""A network as the equations call it; a torch network may also have `layers`."""
Networks: TypeAlias = Sequence[Network]


class Equations(Protocol):
    """The equations for any arithmetic. The model chooses the name of time, so that all parameters are positional."""

    @property
    def unknowns(self) -> Mapping[str, tuple[int, int, Value]]:
        """For each unknown: the index of its network, the index of its output there, and its function."""

    def rhs(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """The time derivative of each state."""

    def observe(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """The value of each channel."""

    def initial(self, math: Arithmetic, state: Value, condition: Value, constants: Value, /) -> Value:
        """The initial state: `state`, with the initial values that the model gives inserted."""

    @property
    def steady_states(self) -> Sequence[int]:
        """The states that start in a steady state; in models that have any."""

    def steady(self, math: Arithmetic, condition: Value, inputs: Value, constants: Value, /) -> Value:
        """Conditions and inputs while a steady state is sought, the sums that are conserved, and a number that is
        positive where a trajectory starts so; in such models."""

    def resumed(self, math: Arithmetic, state: Value, condition: Value, constants: Value, /) -> Value:
        """The start that follows a steady state; in models that set states then."""

    def settled(self, slopes: Value, jacobians: Value, start: Value, laws: Value, /) -> Value:
        """The steady states [P, s] reached from starts, numpy, and the failures by row; in such models."""

    def followed(self, module: Value, start: Value, condition: Value, inputs: Value, constants: Value, /) -> Value:
        """A start [n], numpy, in place of which there is the steady state that is reached, and the failure if there is
        none; where events may happen on the way, for an instance of the module."""

    def doses(self, math: Arithmetic, condition: Value, constants: Value, /) -> Value:
        """For each dose the fraction of it that arrives, and the lag after which it does."""

    def diffusions(self, math: Arithmetic, state: Value, condition: Value, inputs: Value, constants: Value, /) -> Value:
        """The sizes of random disturbances (of logarithms where they are relative); in models that have any."""

    @property
    def events(self) -> Sequence[tuple[str, bool, bool]]:
        """Name, whether it has given times, and whether it is armed, of each event; in models that have any."""

    def guards(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """A number for each event with a condition, which becomes positive where the condition becomes true."""

    def ranks(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """The priority of each event, in models where one is computed."""

    def timing(self, math: Arithmetic, condition: Value, constants: Value, /) -> Value:
        """For each event at given times the first one, the interval and the last one."""

    def happen(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """The state after each event."""

    @property
    def whole(self) -> Sequence[bool]:
        """Whether right sides jump where a value of `schedule` passes a whole number, else where it passes 0."""

    def schedule(self, math: Arithmetic, t: Value, condition: Value, constants: Value, /) -> Sequence[Value]:
        """What decides when right sides jump, as far as it depends on the time alone; in models that have any."""

    @property
    def blocks(self) -> Sequence[tuple[Value, ...]]:
        """The blocks of algebraic equations, in models that have any: the method of their residuals, that of their
        derivatives, the names of the equations, and name, start and range of each variable."""

    def algebraic(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """The algebraic variables, in models that have any."""

    def unsolved(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> str:
        """Which algebraic equations have no solution at a point, in words; empty where all have one."""

    def cutting(self, given: Value, quiet: Value, band: float, strict: bool, /) -> Value:
        """Steps of a batch that are cut where events happen, torch; in models that have any."""

    @property
    def delays(self) -> Sequence[tuple[str, int]]:
        """Name and index of the lag of each delay, whose values follow the inputs; in models that have any."""

    def lags(self, math: Arithmetic, condition: Value, constants: Value, /) -> Value:
        """The times of delays, each once."""

    def delayed(
        self,
        math: Arithmetic,
        t: Value,
        state: Value,
        condition: Value,
        inputs: Value,
        constants: Value,
        networks: Networks,
        /,
    ) -> Value:
        """What is delayed, from the state and the inputs of an earlier time."""

    def history(self, math: Arithmetic, t: Value, state: Value, condition: Value, constants: Value, /) -> Value:
        """The state at a time before the start, where it was `state`."""

    def past(self, given: Value, begin: Value, start: Value, inputs: Value, /) -> Value:
        """The solution so far of a batch, torch."""

    def grid(self, math: Arithmetic, t: Value, h: Value, /) -> Value:
        """The times at which a step of size h from t needs inputs, and the fractions of h that it uses."""

    def step(self, math: Arithmetic, rhs: Value, grid: Value, state: Value, inputs: Value, /) -> Value:
        """One step of state' = rhs(time, state, inputs), with the inputs at the grid's times."""

    def field(self, math: Arithmetic, condition: Value, constants: Value, networks: Networks, /) -> Value:
        """`rhs` as a function of time, state and inputs."""


class GeneratedModule(Protocol):
    """An instance of a generated class: a model with its weights. `type[GeneratedModule]` is the class."""

    title: ClassVar[str]
    solver: ClassVar[str]
    time: ClassVar[str]
    states: ClassVar[tuple[str, ...]]
    conditions: ClassVar[tuple[str, ...]]
    inputs: ClassVar[tuple[str, ...]]
    channels: ClassVar[tuple[str, ...]]
    unknowns: ClassVar[tuple[str, ...]]
    constants: ClassVar[tuple[str, ...]]
    learnables: ClassVar[tuple[str, ...]]
    per_trajectory: ClassVar[tuple[str, ...]]
    doses: ClassVar[tuple[str, ...]]
    interpolation: ClassVar[tuple[str, ...]]
    channel_states: ClassVar[tuple[int | None, ...]]
    defaults: ClassVar[dict[str, tuple[float | None, ...]]]
    ranges: ClassVar[dict[str, tuple[float, float]]]
    units: ClassVar[dict[str, str]]
    descriptions: ClassVar[dict[str, str]]
    networks: ClassVar[tuple[JsonObject, ...]]

    weights: dict[str, Array]
    info: JsonObject

    def __init__(
        self, weights: Mapping[str, Value] | None = None, info: Mapping[str, object] | None = None
    ) -> None: ...

    @property
    def equations(self) -> Equations:
        """The equations, which the class has too."""

    @classmethod
    def load(cls, path: str | os.PathLike[str], member: int = 0) -> Self:
        """Reads weights from a run directory or a weights file."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the weights and `info`."""

    @classmethod
    def random(cls, seed: int = 0) -> Self:
        """Fresh weights."""

    @classmethod
    def shapes(cls) -> dict[str, tuple[int, ...]]:
        """The names and shapes of the required weights."""

    @staticmethod
    def arithmetic(library: str) -> Arithmetic:
        """The functions that the equations use: of "torch", "casadi" or "numpy"."""

    def torch_networks(self, weights: Mapping[str, Value], tape: list[Value] | None = None) -> Networks:
        """The networks over torch tensors named like `weights`."""

    def casadi_networks(self) -> Networks:
        """The networks over casadi's symbols."""

    def numpy_networks(self) -> Networks:
        """The networks over arrays."""

    def weight_slopes(self, weights: Mapping[str, Value]) -> dict[str, Value]:
        """Derivatives of the weights that layers use by those that are trained."""

    def function_slopes(self, name: str, arguments: Array) -> dict[str, Array]:
        """Derivatives of an unknown's values at points [P, n_arguments] with respect to its network's trained weights
        and the constants: arrays [P, ...] by name."""

    def rhs_slopes(
        self, x: Array, by: Array, t: float, condition: Array, inputs: Array, constants: Array
    ) -> dict[str, Array]:
        """Derivatives of `by` [P, n_states] times dx/dt at states [P, n_states] with respect to the trained weights and
        the constants: arrays [P, ...] by name."""

    def rhs(self, t: Value, x: Value, condition: Value = None, inputs: Value = None, constants: Value = None) -> Value:
        """dx/dt [..., n_states], torch."""

    def observe(
        self, t: Value, x: Value, condition: Value = None, inputs: Value = None, constants: Value = None
    ) -> Value:
        """The channels [..., n_channels], torch."""

    def initial(self, x0: Value, condition: Value = None, constants: Value = None, inputs: Value = None) -> Value:
        """The initial state: x0, with the initial values that the model gives inserted; torch."""

    def step(
        self, t: Value, x: Value, h: Value, condition: Value = None, inputs: Value = None, constants: Value = None
    ) -> Value:
        """One step of size h, torch."""

    def simulate(
        self,
        x0: Value,
        times: Value,
        condition: Value = None,
        inputs: Value = None,
        max_step: float | None = None,
        constants: Value = None,
        tolerance: float | None = None,
    ) -> Value:
        """States [..., n_times, n_states] at the times, torch."""

    @property
    def functions(self) -> dict[str, Callable[..., Value]]:
        """The unknown functions by name, torch."""

    def casadi_rhs(self, symbolic_constants: bool = False) -> Casadi:
        """casadi.Function rhs(t, x, condition, inputs[, constants]) -> dx."""

    def casadi_observe(self, symbolic_constants: bool = False) -> Casadi:
        """casadi.Function observe(t, x, condition, inputs[, constants]) -> y."""

    def casadi_jacobian(self, symbolic_constants: bool = False) -> Casadi:
        """casadi.Function jacobian(t, x, condition, inputs[, constants]) -> d(dx)/dx."""

    def casadi_function(self, name: str, symbolic_constants: bool = False) -> Casadi:
        """casadi.Function of an unknown: (arguments[, constants]) -> its value."""
