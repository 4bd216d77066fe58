"""What the generated module offers to the rest of gbspec: its class, its instances with weights, and its equations.

A batch of vectors is [..., n]; what the equations take and give is of the library whose arithmetic they get (torch,
casadi or numpy), so that they have no type here. `template/model.py` of the module's backend documents each method.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol, Self

from gbspec.arrays import Array


class Equations(Protocol):
    """The equations for any arithmetic: functions of a class. Time is named by the model, so all are by position."""

    @property
    def unknowns(self) -> Mapping[str, tuple[int, int, Any]]:
        """Of each unknown the number of its network, that of its output there, and its function."""

    def rhs(self, math: Any, t: Any, state: Any, condition: Any, inputs: Any, constants: Any, networks: Any, /) -> Any:
        """The time derivative of each state."""

    def observe(
        self, math: Any, t: Any, state: Any, condition: Any, inputs: Any, constants: Any, networks: Any, /
    ) -> Any:
        """The value of each channel."""

    def initial(self, math: Any, state: Any, condition: Any, constants: Any, /) -> Any:
        """The start `state` with every start put in that the model expresses."""

    def doses(self, math: Any, condition: Any, constants: Any, /) -> Any:
        """For each dose the fraction of it that arrives, and the lag after which it does."""

    def grid(self, math: Any, t: Any, h: Any, /) -> Any:
        """The times at which a step of size h from t needs inputs, and the parts of its size."""

    def step(self, math: Any, rhs: Any, grid: Any, state: Any, inputs: Any, /) -> Any:
        """One step of state' = rhs(time, state, inputs), with the inputs at the grid's times."""

    def field(self, math: Any, condition: Any, constants: Any, networks: Any, /) -> Any:
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
    networks: ClassVar[tuple[dict[str, Any], ...]]

    weights: dict[str, Array]
    info: dict[str, Any]

    def __init__(self, weights: Mapping[str, Any] | None = None, info: Mapping[str, Any] | None = None) -> None: ...

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
        """The names and shapes of the weights that a model cannot do without."""

    @staticmethod
    def arithmetic(library: str) -> Any:
        """The namespace in which the equations run: of "torch", "casadi" or "numpy"."""

    def torch_networks(self, weights: Mapping[str, Any], tape: list[Any] | None = None) -> tuple[Any, ...]:
        """The networks over torch tensors named like `weights`."""

    def casadi_networks(self) -> tuple[Any, ...]:
        """The networks over casadi's symbols."""

    def numpy_networks(self) -> tuple[Any, ...]:
        """The networks over arrays."""

    def weight_slopes(self, weights: Mapping[str, Any]) -> dict[str, Any]:
        """Derivatives of the weights that layers use by those that are trained."""

    def rhs(self, t: Any, x: Any, condition: Any = None, inputs: Any = None, constants: Any = None) -> Any:
        """dx/dt [..., n_states], torch."""

    def observe(self, t: Any, x: Any, condition: Any = None, inputs: Any = None, constants: Any = None) -> Any:
        """The channels [..., n_channels], torch."""

    def initial(self, x0: Any, condition: Any = None, constants: Any = None) -> Any:
        """The start with every state in its place whose start the model expresses, torch."""

    def step(self, t: Any, x: Any, h: Any, condition: Any = None, inputs: Any = None, constants: Any = None) -> Any:
        """One step of size h, torch."""

    def simulate(
        self,
        x0: Any,
        times: Any,
        condition: Any = None,
        inputs: Any = None,
        max_step: float | None = None,
        constants: Any = None,
    ) -> Any:
        """States [..., n_times, n_states] at the times, torch."""

    @property
    def functions(self) -> dict[str, Callable[..., Any]]:
        """The unknown functions by name, torch."""

    def casadi_rhs(self, symbolic_constants: bool = False) -> Any:
        """casadi.Function rhs(t, x, condition, inputs[, constants]) -> dx."""

    def casadi_observe(self, symbolic_constants: bool = False) -> Any:
        """casadi.Function observe(t, x, condition, inputs[, constants]) -> y."""

    def casadi_jacobian(self, symbolic_constants: bool = False) -> Any:
        """casadi.Function jacobian(t, x, condition, inputs[, constants]) -> d(dx)/dx."""

    def casadi_function(self, name: str, symbolic_constants: bool = False) -> Any:
        """casadi.Function of an unknown: (arguments[, constants]) -> its value."""
