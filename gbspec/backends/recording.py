"""The arguments with which a model calls its networks, recorded while its equations are evaluated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.backends.protocol import GeneratedModule, Network


class _Recorded:
    """A network that records the arguments of its calls; all other attributes are those of the network."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.calls: list[Array] = []

    def __call__(self, *arguments: Array | float) -> tuple[Array, ...]:
        self.calls.append(np.stack(np.broadcast_arrays(*arguments), axis=-1))
        found: tuple[Array, ...] = self.network(*arguments)
        return found

    @property
    def quiet(self) -> Network:
        """The network itself, for calls that are not recorded: those of a search for algebraic variables."""
        return self.network

    def __getattr__(self, name: str) -> object:
        return getattr(self.network, name)


def network_arguments(
    member: GeneratedModule, t: Array, states: Array, condition: Array, inputs: Array, constants: Array
) -> list[list[Array]]:
    """For each network the arguments [R, n_arguments] of each of its calls at R points: times [R], states [R, n],
    conditions, inputs [R, m] and constants [R, k]. A call for a whole array of states counts as one for each element;
    calls at a point of a contract (`zero at`) are left out. Delayed values are those of the same points, which lie on
    the same trajectories."""
    networks = [_Recorded(network) for network in member.numpy_networks()]
    own: Sequence[Array] = tuple(np.asarray(constants, dtype=np.float64).T)
    math = member.arithmetic("numpy")
    with np.errstate(all="ignore"):
        if hasattr(member.equations, "delays"):
            late = member.equations.delayed(math, t, states, condition, inputs, own, member.numpy_networks())
            inputs = np.concatenate([inputs, np.broadcast_to(late, (len(states), late.shape[-1]))], axis=-1)
        for method in (member.equations.rhs, member.equations.observe):
            method(math, t, states, condition, inputs, own, tuple(networks))
    return [[one for call in network.calls for one in _at_points(call, len(states))] for network in networks]


def _at_points(call: Array, count: int) -> Sequence[Array]:
    """The arguments [R, n_arguments] of a call at R points, one for each element of an array; none of another call."""
    if call.ndim < 2 or len(call) != count:
        return ()
    return tuple(np.moveaxis(call.reshape(count, -1, call.shape[-1]), 1, 0))
