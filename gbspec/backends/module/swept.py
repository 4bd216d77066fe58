"""Functions of casadi that carry a solution, its sensitivities to some constants, and the cotangents of both.

A model with networks has no expression for the derivative of an unknown function, but casadi differentiates the
generated step itself, with the networks' folded layers as symbols. A state here is the solution x and, one after the
other, its sensitivities dx/dk to the distributed constants k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca

from gbspec.backends.module.template.directions import _activations
from gbspec.backends.module.template.networks import _activation, _Raw
from gbspec.backends.protocol import Casadi, GeneratedModule
from gbspec.ir import METHODS


@dataclass(frozen=True)
class Swept:
    """The functions, for one trajectory each; `map` makes those of several.

    `start` (start, condition, constants) -> state; `step` (state, t, h, inputs at the nodes, amounts, condition,
    constants, layers) -> state; `observe` (state, t, inputs, condition, constants, layers) -> channels and, for each k,
    their derivatives. The others take the same and a cotangent of the result, and give those of constants for `start`,
    else of (state, constants, layers), or those of `…_back_constants` of (state, constants) alone. `amounts` are those
    of the doses that arrive before the step, by kind.
    """

    states: int
    layers: int
    start: Casadi
    start_back: Casadi
    step: Casadi
    step_back: Casadi
    step_back_constants: Casadi
    observe: Casadi
    observe_back: Casadi
    observe_back_constants: Casadi


def swept(instance: GeneratedModule, by: Sequence[int]) -> Swept:
    """The functions for the constants `by` (places among all constants) of an instance, whose scales are kept."""
    m, n = instance.arithmetic("casadi"), len(instance.states)
    sizes = {"condition": len(instance.conditions), "constants": len(instance.constants)}
    condition, constants = (ca.SX.sym(name, size) for name, size in sizes.items())
    layers = ca.SX.sym("layers", sum(_size(network["sizes"]) for network in instance.networks))
    networks = _networks(instance, layers)
    k = m.unpack(constants)

    x, t, h = ca.SX.sym("x", n), ca.SX.sym("t"), ca.SX.sym("h")
    nodes = [ca.SX.sym(name, len(instance.inputs)) for name in METHODS[instance.solver].input_names]
    amounts = ca.SX.sym("amounts", len(instance.doses))
    jump = ca.SX.zeros(n)
    for kind, (fraction, _) in enumerate(instance.equations.doses(m, condition, k)):
        jump[instance.states.index(instance.doses[kind])] += amounts[kind] * fraction
    rhs = instance.equations.field(m, condition, k, networks)
    after = instance.equations.step(m, rhs, instance.equations.grid(m, t, h), x + jump, tuple(nodes))
    wide = ca.SX.sym("state", n * (1 + len(by)))
    step = _with_sensitivities(after, x, constants, wide, by)

    begin = ca.SX.sym("start", n)
    initial = instance.equations.initial(m, begin, condition, k)
    first = ca.vertcat(initial, *(ca.jtimes(initial, constants, _unit(constants, i)) for i in by))
    inputs = ca.SX.sym("inputs", len(instance.inputs))
    seen = instance.equations.observe(m, t, x, condition, inputs, k, networks)
    observed = _with_sensitivities(seen, x, constants, wide, by)

    given = [wide, t, h, *nodes, amounts, condition, constants, layers]
    seen_at = [wide, t, inputs, condition, constants, layers]
    return Swept(
        n,
        layers.shape[0],
        *_with_cotangents("start", [begin, condition, constants], first, [[constants]]),
        *_with_cotangents("step", given, step, [[wide, constants, layers], [wide, constants]]),
        *_with_cotangents("observe", seen_at, observed, [[wide, constants, layers], [wide, constants]]),
    )


def _with_cotangents(
    name: str, given: list[Casadi], value: Casadi, by: Sequence[Sequence[Casadi]]
) -> tuple[Casadi, ...]:
    """The function of `given`, and those of its cotangents by each group of symbols."""
    value = ca.densify(ca.SX(value))
    cotangent = ca.SX.sym("cotangent", value.shape[0])
    found = [ca.Function(name, given, [value])]
    for number, of in enumerate(by):
        back = ca.densify(ca.jtimes(value, ca.vertcat(*of), cotangent, True))
        parts = ca.vertsplit(back, [0, *_ends([part.shape[0] for part in of])])
        found.append(ca.Function(f"{name}_back_{number}", [*given, cotangent], list(parts)))
    return tuple(found)


def _ends(sizes: Sequence[int]) -> list[int]:
    return [sum(sizes[: i + 1]) for i in range(len(sizes))]


def _unit(like: Casadi, place: int) -> Casadi:
    out = ca.SX.zeros(like.shape[0])
    out[place] = 1
    return out


def _with_sensitivities(value: Casadi, x: Casadi, constants: Casadi, wide: Casadi, by: Sequence[int]) -> Casadi:
    """A function of x and constants, and its total derivatives by some constants, as functions of the wide state."""
    n = x.shape[0]
    found = [value]
    for place, i in enumerate(by):
        sensitivity = wide[n * (1 + place) : n * (2 + place)]
        tangent = ca.vertcat(sensitivity, _unit(constants, i))
        found.append(ca.jtimes(value, ca.vertcat(x, constants), tangent))
    return ca.substitute(ca.vertcat(*found), x, wide[:n])


def _size(sizes: Sequence[int]) -> int:
    return sum((a + 1) * b for a, b in pairwise(sizes))


def _networks(instance: GeneratedModule, layers: Casadi) -> tuple[Casadi, ...]:
    """The networks with symbols for their folded layers: weights row by row, then biases."""
    found, position = [], 0
    m = instance.arithmetic("casadi")
    for network in instance.networks:
        sizes = network["sizes"]
        parts = []
        for width, height in pairwise(sizes):
            weight = ca.reshape(layers[position : position + width * height], width, height).T
            position += width * height
            parts.append((weight, layers[position : position + height]))
            position += height
        activations = _activations(
            network,
            _activation("casadi", network["activation"]),
            m,
            lambda z, counts: ca.vertsplit(z, [0, *_ends(counts)]),
            lambda each: ca.vertcat(*each),
        )
        call = _call(parts, activations)
        if network["raw"]:
            prefix = f"network.{network['name']}."
            scales = (instance.weights[prefix + name] for name in ("output_center", "output_scale", "input_scale"))
            call = _Raw(call, *scales)
        found.append(call)
    return tuple(found)


def _call(parts: list[tuple[Casadi, Casadi]], activations: list[Casadi]) -> Casadi:
    def call(*arguments: Casadi) -> Casadi:
        a = ca.vertcat(*arguments)
        for i, (weight, bias) in enumerate(parts):
            a = ca.mtimes(weight, activations[i - 1](a) if i else a) + bias
        return tuple(ca.vertsplit(a))

    return call
