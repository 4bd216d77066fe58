"""A model without states.

This file is a template and a valid module at once. A line that ends in `# {{key}}` and a region between `# {{key` and
`# key}}` are replaced by what a model needs there.
"""  # {{docstring}}

from __future__ import annotations

import functools
import itertools
import json
import math as _math
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar  # {{typing}}

import numpy as np

# {{interface
from gbspec.backends.module.template.arithmetic import _arithmetic, _torch_arithmetic
from gbspec.backends.module.template.delays import _delayed_solution, _width
from gbspec.backends.module.template.directions import _weight_slopes
from gbspec.backends.module.template.events import _band
from gbspec.backends.module.template.networks import _casadi_name, _casadi_network, _numpy_network, _torch_network
from gbspec.backends.module.template.slopes import _function_slopes, _rhs_slopes
from gbspec.backends.module.template.steady import _steady_starts
from gbspec.backends.module.template.stepping import _Adaptive
from gbspec.backends.module.template.tensors import _read_tensors, _write_tensors
from gbspec.backends.module.template.vectors import _by_name, _signal, _spread, _tensor, _vector
from gbspec.backends.module.template.weights import _array, _described, _misfits, _random_weights, _required_shapes

_USED_BY_SIBLINGS = (_math, functools, struct, SimpleNamespace)
INTERFACE = 0
# interface}}


class Template:  # {{class}}
    """A model without states."""  # {{class docstring}}

    # {{attributes
    title: ClassVar[str] = ""
    solver: ClassVar[str] = "rk4"
    time: ClassVar[str] = "t"
    states: ClassVar[tuple[str, ...]] = ()
    conditions: ClassVar[tuple[str, ...]] = ()
    inputs: ClassVar[tuple[str, ...]] = ()
    channels: ClassVar[tuple[str, ...]] = ()
    unknowns: ClassVar[tuple[str, ...]] = ()
    constants: ClassVar[tuple[str, ...]] = ()
    learnables: ClassVar[tuple[str, ...]] = ()
    per_trajectory: ClassVar[tuple[str, ...]] = ()
    doses: ClassVar[tuple[str, ...]] = ()
    interpolation: ClassVar[tuple[str, ...]] = ()
    channel_states: ClassVar[tuple[int | None, ...]] = ()
    defaults: ClassVar[dict[str, tuple[float | None, ...]]] = {"constants": (), "conditions": (), "inputs": ()}
    ranges: ClassVar[dict[str, tuple[float, float]]] = {}
    units: ClassVar[dict[str, str]] = {}
    descriptions: ClassVar[dict[str, str]] = {}
    networks: ClassVar[tuple[dict[str, Any], ...]] = ()
    # attributes}}

    class equations:  # noqa: N801  (a namespace)
        """The equations, for torch, casadi and numpy, each called without an instance.

        math: the arithmetic of one of these; state, condition, inputs: vectors, components on the last axis (in casadi,
        columns); constants: a tuple; networks: a tuple of functions, each called with its arguments one by one and
        returning a tuple of its outputs.
        """

        # {{equations
        @classmethod
        def rhs(cls, math: Any, t: Any, state: Any, condition: Any, inputs: Any, constants: Any, networks: Any) -> Any:
            """The time derivative of each state."""
            return math.pack(state, ())

        @classmethod
        def observe(
            cls, math: Any, t: Any, state: Any, condition: Any, inputs: Any, constants: Any, networks: Any
        ) -> Any:
            """The value of each channel."""
            return math.pack(state, ())

        @classmethod
        def initial(cls, math: Any, state: Any, condition: Any, constants: Any) -> Any:
            """The initial state: `state`, with the initial values that the model gives inserted."""
            return state

        @classmethod
        def doses(cls, math: Any, condition: Any, constants: Any) -> Any:
            """For each dose the fraction of it that arrives, and the lag after which it does."""
            return ()

        @staticmethod
        def grid(math: Any, t: Any, h: Any) -> Any:
            """The times at which a step of size h from t needs inputs, and the fractions of h that it uses."""
            return (), ()

        @staticmethod
        def step(math: Any, rhs: Any, grid: Any, state: Any, inputs: Any) -> Any:
            """One step of state' = rhs(time, state, inputs)."""
            return state

        unknowns: ClassVar[dict[str, tuple[int, int, Any]]] = {}
        # equations}}

        @classmethod
        def field(cls, math: Any, condition: Any, constants: Any, networks: Any) -> Any:
            """`rhs` as a function of time, state and inputs."""
            return lambda t, state, inputs: cls.rhs(math, t, state, condition, inputs, constants, networks)

    # ------------------------------------------------------------------ weights
    # `self.weights` maps names to float64 arrays:
    #   network.NAME.LAYER.weight [out, in] and .bias [out]
    #   network.NAME.input_center, .input_scale [in], .output_center, .output_scale [out]: fixed, not trained
    #   network.NAME.input_low, .input_high [in]: the trained range, for reports (optional)
    #   constants [n_constants]: in the order of `constants`
    #   initial [n_trajectories, n_states], per_trajectory.NAME [n_trajectories]: of the training data (optional)
    #   recognition.*: a network that gives initial states of new trajectories (optional)

    def __init__(self, weights: Mapping[str, Any] | None = None, info: Mapping[str, Any] | None = None) -> None:
        """Takes weights by name (needed only with unknown functions) and `info` to store with them.

        Raises ValueError if a name is missing or unknown, or if a shape does not fit this model.
        """
        if weights is None:
            if self.networks:
                raise ValueError(f"{type(self).__name__} has unknown functions: use load(path) or random(seed)")
            weights = {"constants": self.defaults["constants"]}
        self.weights: dict[str, Any] = {name: _array(value) for name, value in weights.items()}
        self.info: dict[str, Any] = dict(info or {})
        self._tensors: dict[str, Any] = {}
        self._ready: dict[Any, Any] = {}
        wrong = _misfits(self, self.weights)
        if wrong:
            raise ValueError(f"the weights do not fit {type(self).__name__}: {'; '.join(wrong)}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({_described(self)})"

    def __getstate__(self) -> dict[str, Any]:
        """What pickle and copy keep: all but what is computed again when it is used."""
        return {name: value for name, value in self.__dict__.items() if name != "functions"} | {"_ready": {}}

    def with_weights(self, weights: Mapping[str, Any]) -> Template:
        """This model with torch tensors in place of some of its weights, by the names of `weights`.

        Gradients of `rhs`, `observe`, `step`, `simulate` and `functions` reach these tensors.
        """
        made = type(self)({**self.weights, **weights}, self.info)
        made._tensors = dict(weights)
        return made

    @classmethod
    def load(cls, path: str | os.PathLike[str], member: int = 0) -> Template:
        """Reads weights: `path` is a run directory (its member number `member`) or a .safetensors file.

        Raises FileNotFoundError, and ValueError if the file is malformed or belongs to another model.
        """
        place = Path(path)
        if place.is_dir():
            place = place / "members" / str(member) / "weights.safetensors"
        arrays, metadata = _read_tensors(place)
        try:
            return cls(arrays, dict(json.loads(metadata.get("info", "{}"))))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{place}: {error}") from None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the weights, with `info` (which must be convertible to JSON), as a .safetensors file."""
        _write_tensors(path, self.weights, {"model": type(self).__name__, "info": json.dumps(self.info)})

    @classmethod
    def random(cls, seed: int = 0) -> Template:
        """Random weights: uniform in +-1/sqrt(inputs), in the last layer a tenth of that, inputs scaled by ranges."""
        return cls(_random_weights(cls, np.random.default_rng(seed)))

    @classmethod
    def shapes(cls) -> dict[str, tuple[int, ...]]:
        """The names and shapes of the required weights."""
        return _required_shapes(cls)

    @staticmethod
    def arithmetic(library: str) -> Any:
        """The functions that the equations use: of "torch", "casadi" or "numpy"."""
        return _arithmetic(library)

    def torch_networks(self, weights: Mapping[str, Any], tape: list[Any] | None = None) -> tuple[Any, ...]:
        """The networks over torch tensors named like `self.weights`; gradients reach those that require them.

        With a tape, every linear layer appends (network, layer, its input, its output before the activation), in the
        order of the calls, and weights are used unscaled; otherwise the scales are multiplied into them once.
        """
        return tuple(_torch_network(network, weights, i, tape) for i, network in enumerate(self.networks))

    def weight_slopes(self, weights: Mapping[str, Any]) -> dict[str, Any]:
        """Elementwise derivatives of the weights that layers use with respect to the trained ones, as arrays by name.

        Networks without monotone arguments use the trained weights, and are omitted.
        """
        slopes: dict[str, Any] = {}
        for network in self.networks:
            if network["layout"] is not None:
                slopes |= _weight_slopes(network, weights)
        return slopes

    def casadi_networks(self) -> tuple[Any, ...]:
        """The networks over casadi's symbols, with their weights as numbers."""
        return tuple(_casadi_network(network, self.weights) for network in self.networks)

    def numpy_networks(self) -> tuple[Any, ...]:
        """The networks over arrays."""
        return tuple(_numpy_network(network, self.weights) for network in self.networks)

    # ------------------------------------------------------------------ torch
    # Shapes: [...] is any batch, the same for all arguments up to broadcasting. Numbers, lists and arrays become
    # float64 tensors; tensors keep their type and device. `condition` and `inputs` may be omitted if the model has
    # none, or has defaults for all; they and the state may also be given as {name: value}. `constants` replaces values
    # by name (numbers, or tensors of the batch's shape, which gradients reach).

    @classmethod
    def state(cls, values: Mapping[str, Any] | None = None, /, **named: Any) -> Any:
        """A state [..., n_states] from the value [...] of each state by name: state(x1=0.5, x2=1.5)."""
        return _by_name(cls, "states", {**(values or {}), **named})

    @classmethod
    def condition(cls, values: Mapping[str, Any] | None = None, /, **named: Any) -> Any:
        """Conditions [..., n_conditions] by name; those that are left out have their defaults."""
        return _by_name(cls, "conditions", {**(values or {}), **named})

    @classmethod
    def input(cls, values: Mapping[str, Any] | None = None, /, **named: Any) -> Any:
        """Inputs [..., n_inputs] by name; those that are left out have their defaults."""
        return _by_name(cls, "inputs", {**(values or {}), **named})

    def rhs(self, t: Any, x: Any, condition: Any = None, inputs: Any = None, constants: Any = None) -> Any:
        """dx/dt [..., n_states] at time t (a number or [...]), state x [..., n_states]; see above for the rest."""
        x, condition, inputs = self._arguments(x, condition, inputs)
        k, f = self._parameters(x, constants)
        return self.equations.rhs(_torch_arithmetic(), _tensor(t, x), x, condition, inputs, k, f)

    def observe(self, t: Any, x: Any, condition: Any = None, inputs: Any = None, constants: Any = None) -> Any:
        """The channels [..., n_channels] at time t, state x [..., n_states]."""
        x, condition, inputs = self._arguments(x, condition, inputs)
        k, f = self._parameters(x, constants)
        return self.equations.observe(_torch_arithmetic(), _tensor(t, x), x, condition, inputs, k, f)

    def initial(self, x0: Any, condition: Any = None, constants: Any = None, inputs: Any = None) -> Any:
        """The initial state [..., n_states]: x0, with what the model gives inserted; steady starts use `inputs`."""
        x, condition, _ = self._arguments(x0, condition, None, need_inputs=False)
        k, f = self._parameters(x, constants)
        start = self.equations.initial(_torch_arithmetic(), x, condition, k)
        # [steady
        start = _steady_starts(self, *self._arguments(start, condition, inputs), k, f)
        # steady]
        return start  # noqa: RET504

    def step(self, t: Any, x: Any, h: Any, condition: Any = None, inputs: Any = None, constants: Any = None) -> Any:
        """One step of `solver`, of size h (a number or [...]) from x [..., n_states] at t, with constant `inputs`."""
        x, condition, inputs = self._arguments(x, condition, inputs)
        (k, f), m = self._parameters(x, constants), _torch_arithmetic()
        grid = self.equations.grid(m, _tensor(t, x), _tensor(h, x))
        return self.equations.step(m, self.equations.field(m, condition, k, f), grid, x, (inputs,) * len(grid[0]))

    def simulate(
        self,
        x0: Any,
        times: Any,
        condition: Any = None,
        inputs: Any = None,
        max_step: float | None = None,
        constants: Any = None,
        tolerance: float | None = None,
    ) -> Any:
        """States [..., n_times, n_states] at increasing `times` [n_times] from x0 [..., n_states], by `solver`.

        `inputs`: values at the times [..., n_times, n_inputs], held or interpolated as the model declares, or a
        function of time that returns [..., n_inputs]. Between two times the steps are equal and at most
        `max_step` (default: that of the training if stored with the weights, else one step), or adaptive with a
        relative `tolerance` (default: that of a training with adaptive steps). Differentiable.
        """
        import torch

        x, condition, _ = self._arguments(x0, condition, None, need_inputs=False)
        k, f = self._parameters(x, constants)
        grid = [float(time) for time in times]
        if not grid or any(not b > a for a, b in itertools.pairwise(grid)):
            raise ValueError("times must increase, and there must be at least one")
        limit = max_step if max_step is not None else self.info.get("max_step")
        if limit is not None and not limit > 0:
            raise ValueError(f"max_step must be positive, not {limit}")
        signal = _signal(self, inputs, grid, x)
        x = _spread(x, condition, signal(0, grid[0]), k)
        # [delays
        if "delays" in vars(self.equations):
            return _delayed_solution(self, x, grid, (condition, k, f), inputs, limit)
        # delays]
        path, m = [x], _torch_arithmetic()
        rhs = self.equations.field(m, condition, k, f)
        accuracy = self.info.get("tolerance") if tolerance is None and max_step is None else tolerance
        adaptive = None if accuracy is None else _Adaptive(accuracy, limit)
        # [events
        cut: Any = self.equations
        events = cut.cutting((condition, k, f), (condition, k, f), _band(x, grid), True)
        # events]
        for i, (start, end) in enumerate(itertools.pairwise(grid)):

            def step(t: float, h: float, x: Any, i: int = i) -> Any:
                nodes, sizes = self.equations.grid(m, t, h)
                u = tuple(signal(i, node) for node in nodes)
                # [events
                if events is not None:
                    return events.across(t, h, x, u, grid[0], (x, signal(i - 1, t)) if i and t == grid[i] else None)
                # events]
                return self.equations.step(m, rhs, ([_tensor(node, x) for node in nodes], sizes), x, u)

            count = 1 if limit is None else max(1, _math.ceil((end - start) / limit - 1e-9))
            h = (end - start) / count
            if adaptive is not None:
                x = adaptive.across(step, x, start, end)
            for j in range(count if adaptive is None else 0):
                x = step(start + j * h, h, x)
            path.append(x)
        return torch.stack(path, -2)

    @functools.cached_property
    def functions(self) -> dict[str, Callable[..., Any]]:
        """The unknown functions by name: of one tensor [..., n_arguments], or of separate arguments -> [...]."""
        return {name: functools.partial(self._function, name) for name in self.unknowns}

    def function_slopes(self, name: str, arguments: Any) -> dict[str, Any]:
        """Derivatives of an unknown's values at points [P, n_arguments] by weights and constants: arrays [P, ...]."""
        return _function_slopes(self, name, arguments)

    def rhs_slopes(self, x: Any, by: Any, t: float, condition: Any, inputs: Any, constants: Any) -> dict[str, Any]:
        """Derivatives of `by` times dx/dt, both [P, n_states], by weights and constants: arrays [P, ...]."""
        return _rhs_slopes(self, x, by, t, condition, inputs, constants)

    def _function(self, name: str, *arguments: Any, constants: Any = None) -> Any:
        index, output, method = self.equations.unknowns[name]
        count = len(self.networks[index]["arguments"])
        if len(arguments) == 1 and count != 1:
            arguments = (_vector(arguments[0], count, f"the arguments of {name}"),)
        parts = arguments[0].unbind(-1) if len(arguments) == 1 and count != 1 else arguments
        if len(parts) != count:
            raise ValueError(f"{name} takes {count} arguments, not {len(parts)}")
        values = [_tensor(part) for part in parts]
        if count == 1 and values[0].ndim and values[0].shape[-1] == 1:
            values = [values[0][..., 0]]
        k, f = self._parameters(values[0], constants)
        return _tensor(method(_torch_arithmetic(), k, f, *values)[output], values[0])

    def _arguments(self, x: Any, condition: Any, inputs: Any, need_inputs: bool = True) -> tuple[Any, Any, Any]:
        """State, condition and inputs as tensors of the right length and of the state's type."""
        x = _vector(self.state(x) if isinstance(x, Mapping) else x, len(self.states), "the state")
        condition = self.defaulted(condition, "conditions", x)
        # [delays
        if need_inputs and "delays" in vars(self.equations):
            return x, condition, _vector(inputs, _width(self), "inputs and delayed values", x)
        # delays]
        return x, condition, self.defaulted(inputs, "inputs", x) if need_inputs else None

    def defaulted(self, value: Any, kind: str, x: Any) -> Any:
        """Conditions or inputs (the `kind`) as a tensor like `x`, with their defaults where `value` is None."""
        names, defaults = getattr(self, kind), self.defaults[kind]
        if isinstance(value, Mapping):
            value = _by_name(self, kind, value)
        if value is None:
            lacking = [name for name, default in zip(names, defaults, strict=True) if default is None]
            if lacking:
                raise ValueError(f"{kind} must be given: {', '.join(lacking)} has no default")
            value = defaults
        return _vector(value, len(names), kind, x)

    def _parameters(self, like: Any, constants: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Constants and networks in the type and on the device of a tensor."""
        key = (like.dtype, like.device)
        found = self._ready.get(key)
        if found is None:
            weights = {name: _tensor(value, like) for name, value in {**self.weights, **self._tensors}.items()}
            found = tuple(weights["constants"].unbind()), self.torch_networks(weights)
            if not self._tensors:  # their graph is needed once for each backward pass
                self._ready[key] = found
        k, f = found
        if constants:
            surplus = set(constants) - set(self.constants)
            if surplus:
                raise ValueError(f"there is no constant {', '.join(sorted(surplus))}")
            k = tuple(
                _tensor(constants[name], like) if name in constants else value
                for name, value in zip(self.constants, k, strict=True)
            )
        return k, f

    # ------------------------------------------------------------------ casadi
    # Vectors are columns. With symbolic_constants the last input is the vector of `constants`, else they are numbers.

    def casadi_rhs(self, symbolic_constants: bool = False) -> Any:
        """casadi.Function rhs(t, x, condition, inputs) -> dx, including the networks."""
        return self._casadi("rhs", "dx", self.equations.rhs, symbolic_constants)

    def casadi_observe(self, symbolic_constants: bool = False) -> Any:
        """casadi.Function observe(t, x, condition, inputs) -> y."""
        return self._casadi("observe", "y", self.equations.observe, symbolic_constants)

    def casadi_jacobian(self, symbolic_constants: bool = False) -> Any:
        """casadi.Function jacobian(t, x, condition, inputs) -> J, d(dx)/dx [n_states, n_states]."""
        return self._casadi("jacobian", "J", self.equations.rhs, symbolic_constants, derivative=True)

    def casadi_function(self, name: str, symbolic_constants: bool = False) -> Any:
        """casadi.Function of an unknown: the vector of its arguments -> its value."""
        import casadi as ca

        index, output, method = self.equations.unknowns[name]
        arguments = {"arguments": ca.MX.sym("arguments", len(self.networks[index]["arguments"]))}
        k = ca.MX(ca.DM(self.weights["constants"]))
        if symbolic_constants:
            k = arguments["constants"] = ca.MX.sym("constants", len(self.constants))
        m = _arithmetic("casadi")
        value = method(m, m.unpack(k), self.casadi_networks(), *m.unpack(arguments["arguments"]))[output]
        return ca.Function(_casadi_name(name), [*arguments.values()], [value], [*arguments], ["value"])

    def _casadi(self, name: str, result: str, equations: Any, symbolic: bool, derivative: bool = False) -> Any:
        import casadi as ca

        # Networks are products of matrices, which casadi keeps whole in MX; in SX each multiplication is a node.
        kind: Any = ca.MX if self.networks else ca.SX
        # [algebraic
        kind = ca.MX  # in which functions are called, such as the search for algebraic variables
        # algebraic]
        sizes = {"t": 1, "x": len(self.states), "condition": len(self.conditions), "inputs": len(self.inputs)}
        # [delays
        sizes["inputs"] = _width(self)
        # delays]
        arguments = {key: kind.sym(key, size) for key, size in sizes.items()}
        values, k = [*arguments.values()], kind(ca.DM(self.weights["constants"]))
        if symbolic:
            k = arguments["constants"] = kind.sym("constants", len(self.constants))
        m = _arithmetic("casadi")
        vector = equations(m, *values, m.unpack(k), self.casadi_networks())
        vector = ca.jacobian(vector, arguments["x"]) if derivative else vector
        return ca.Function(name, [*arguments.values()], [ca.densify(vector)], [*arguments], [result])
