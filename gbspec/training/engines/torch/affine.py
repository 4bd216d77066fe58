"""Right-hand sides that are affine in states, inputs and unknowns, in as few operations as in hand-written code.

`gbspec.ir.affinity` decides whether they are. The generated module's equations are then evaluated once per unroll with
`Form`s, that is, sums of multiples of states, inputs and outputs of networks, in place of numbers:

    dx/dt = shift + x A + u U + sum over the calls of networks of hidden(x, u) G

where hidden is the input of a network's last layer. Constants and scales are in the matrices; values that differ
between trajectories are in the first layers' biases and the shift. All are computed once per unroll, differentiably.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor

from gbspec.backends import Arithmetic, GeneratedModule, Network, Networks
from gbspec.diagnostics import Defect
from gbspec.ir import Model, is_affine

Coefficient = float | Tensor
Key = tuple[str | int, ...]
Field = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A right-hand side as a function of times [B], states [B, n_states] and inputs [B, n_inputs]."""


class NotAffineError(Defect):
    """The equations are not affine although the analysis of the Model says that they are."""


def _refuse(*_: object) -> NoReturn:
    raise NotAffineError("a right-hand side is not affine")


_known: dict[tuple[type[GeneratedModule], frozenset[str]], bool] = {}


def affine_by_model(model: Model, module: GeneratedModule) -> bool:
    """Whether a model's right-hand side is affine; decided once for each generated class, of which `module` is an
    instance, and for the constants that differ between trajectories: a population makes all of them free."""
    key = type(module), frozenset(k.name for k in model.learnables if k.per_trajectory)
    if key not in _known:
        _known[key] = is_affine(model)
    return _known[key]


@dataclass(frozen=True, eq=False)
class Form:
    """`constant` plus the sum over the keys of `terms[key]` times the quantity that the key denotes."""

    terms: dict[Key, Coefficient]
    constant: Coefficient = 0.0

    def __add__(self, other: Form | Coefficient) -> Form:
        other = form_of(other)
        terms = dict(self.terms)
        for key, value in other.terms.items():
            terms[key] = terms[key] + value if key in terms else value
        return Form(terms, self.constant + other.constant)

    def __mul__(self, factor: Form | Coefficient) -> Form:
        if isinstance(factor, Form):
            raise NotAffineError("a right-hand side is not affine")
        return Form({key: value * factor for key, value in self.terms.items()}, self.constant * factor)

    def __neg__(self) -> Form:
        return self.__mul__(-1.0)

    def __sub__(self, other: Form | Coefficient) -> Form:
        return self.__add__(form_of(other).__mul__(-1.0))

    def __rsub__(self, other: Form | Coefficient) -> Form:
        return self.__mul__(-1.0).__add__(other)

    def __truediv__(self, divisor: Coefficient) -> Form:
        return self.__mul__(1.0 / divisor)

    __radd__ = __add__
    __rmul__ = __mul__
    __rtruediv__ = __floordiv__ = __pow__ = __rpow__ = __mod__ = __rmod__ = __abs__ = __pos__ = _refuse
    __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = __bool__ = __float__ = _refuse


def form_of(value: Form | Coefficient) -> Form:
    """A value as a form; numbers and tensors are constants."""
    return value if isinstance(value, Form) else Form({}, value)


def _arithmetic(ops: Arithmetic) -> Arithmetic:
    """The torch arithmetic, in which only sums accept forms."""

    def only_numbers(function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object) -> object:
            flat = [x for a in arguments for x in (a if isinstance(a, tuple) else (a,))]
            return _refuse() if any(isinstance(x, Form) for x in flat) else function(*arguments)

        return call

    table = {name: only_numbers(value) if callable(value) else value for name, value in vars(ops).items()}
    table |= {"unpack": lambda x: x, "pack": lambda like, parts: parts, "fill": lambda like, x: x}
    return SimpleNamespace(**table)


_Calls = list[tuple[Network, list[Form]]]
"""The networks that were called, with their arguments."""


@dataclass(frozen=True)
class _Call:
    """A call of a network: its first layer over states (with a bias) and over inputs, and the layers after it."""

    network: Network
    states: Tensor
    inputs: Tensor | None
    bias: Tensor
    hidden: Sequence[tuple[Tensor, Tensor]]
    last: Tensor

    def added(self, out: Tensor, x: Tensor, u: Tensor) -> Tensor:
        """`out` [B, n_states], with what the call contributes to the right-hand sides."""
        bias = self.bias if self.inputs is None else torch.addmm(self.bias, u, self.inputs)
        moved: Tensor = self.network.through([(self.states, bias), *self.hidden, (self.last, out)], x)
        return moved


@dataclass(frozen=True)
class Affine:
    """The matrices of such a right-hand side for P trajectories; None: zero. `shift` is [n_states] or [P, n_states]."""

    shift: Tensor
    states: Tensor | None
    inputs: Tensor | None
    calls: Sequence[_Call]

    def at(self, rows: Tensor | slice) -> Field:
        """The right-hand side for some of the trajectories."""
        shift = _rows(self.shift, rows)
        calls = [_Call(**vars(call) | {"bias": _rows(call.bias, rows)}) for call in self.calls]

        def field(t: Tensor, x: Tensor, u: Tensor) -> Tensor:
            out = shift if self.states is None else torch.addmm(shift, x, self.states)
            out = out if self.inputs is None else torch.addmm(out, u, self.inputs)
            for call in calls:
                out = call.added(out, x, u)
            return out

        return field


def _rows(table: Tensor, rows: Tensor | slice) -> Tensor:
    return table[rows] if table.ndim > 1 else table


class _Probe:
    """A network that records its calls and returns forms; it has the numbers that the forms of contracts use."""

    def __init__(self, network: Network, calls: _Calls) -> None:
        if hasattr(network, "scale"):
            self.center, self.scale, self.input_scale = network.center, network.scale, network.input_scale
        self._calls = calls
        self._network = network.call if hasattr(network, "call") else network
        if not hasattr(self._network, "through") or len(self._network.layers) < 2:
            raise NotAffineError("a right-hand side is not affine")

    def __call__(self, *arguments: Form | Coefficient) -> tuple[Form, ...]:
        number, outputs = len(self._calls), self._network.layers[-1][0].shape[1]
        self._calls.append((self._network, [form_of(argument) for argument in arguments]))
        return tuple(Form({("output", number, i): 1.0}) for i in range(outputs))


def affine(
    module: GeneratedModule, ops: Arithmetic, condition: Tensor, constants: Sequence[Tensor], networks: Networks
) -> Affine:
    """The right-hand side for trajectories with these conditions [P, n_conditions] and constants ([P] or [] each).

    Raises NotAffineError if it is not affine, or its matrices would differ between trajectories.
    """
    calls: _Calls = []
    probes = tuple(_Probe(network, calls) for network in networks)
    states = tuple(("state", i) for i in range(len(module.states)))
    inputs = tuple(("input", i) for i in range(len(module.inputs)))
    rows = module.equations.rhs(
        _arithmetic(ops),
        Form({("time",): 1.0}),
        tuple(Form({key: 1.0}) for key in states),
        condition.unbind(1),
        tuple(Form({key: 1.0}) for key in inputs),
        tuple(constants),
        probes,
    )
    return _assembled([form_of(row) for row in rows], states, inputs, calls, condition)


def _assembled(
    rows: Sequence[Form],
    states: Sequence[Key],
    inputs: Sequence[Key],
    calls: _Calls,
    like: Tensor,
) -> Affine:
    """The matrices, from the form of each row and the recorded calls of networks."""
    shift, made = _constant(rows, like), []
    known = {*states, *inputs}
    for number, (network, arguments) in enumerate(calls):
        _within(arguments, {*states, *inputs})
        (first, bias), *hidden, (last, last_bias) = network.layers
        outputs = [("output", number, i) for i in range(last.shape[1])]
        into, aside = (_matrix(arguments, keys, like) for keys in (states, inputs))
        out = _matrix(rows, outputs, like)
        known.update(outputs)
        if out is None:
            continue
        start = first.new_zeros((len(states), first.shape[1])) if into is None else into @ first
        bias = bias + _constant(arguments, like) @ first
        made.append(_Call(network, start, None if aside is None else aside @ first, bias, hidden, last @ out))
        shift = shift + last_bias @ out
    _within(rows, known)
    moved = _matrix(rows, states, like)
    if moved is None and not made:
        moved = like.new_zeros((len(states), len(states)))
    return Affine(shift, moved, _matrix(rows, inputs, like), made)


def _within(forms: Iterable[Form], known: set[Key]) -> None:
    """Raises NotAffineError for forms with other terms: times, and outputs of networks as arguments of networks."""
    if any(key not in known for form in forms for key in form.terms):
        raise NotAffineError("a right-hand side is not affine")


def _matrix(forms: Sequence[Form], keys: Sequence[Key], like: Tensor) -> Tensor | None:
    """Coefficients [keys, forms]; None if all are absent."""
    place = {key: i for i, key in enumerate(keys)}
    terms = [(key, j, value) for j, form in enumerate(forms) for key, value in form.terms.items() if key in place]
    if not terms:
        return None
    if any(isinstance(value, Tensor) and value.ndim for *_, value in terms):
        raise NotAffineError("a right-hand side is not affine")
    values = torch.stack([_tensor(value, like) for *_, value in terms])
    at = torch.tensor([(place[key], j) for key, j, _ in terms], device=like.device)
    return like.new_zeros(len(keys), len(forms)).index_put(tuple(at.T), values)


def _constant(forms: Sequence[Form], like: Tensor) -> Tensor:
    """Constants [forms], or [P, forms] where they differ between trajectories."""
    parts = [_tensor(form.constant, like) for form in forms]
    shape = np.broadcast_shapes(*(part.shape for part in parts))
    return torch.stack([part.expand(shape) for part in parts], -1)


def _tensor(value: Coefficient, like: Tensor) -> Tensor:
    return value.to(like) if isinstance(value, Tensor) else like.new_tensor(value)
