"""Right-hand sides whose switches have a width, for solutions that slide along one.

Where both sides of a switch lead back to it, no step of an adaptive method ends: the solution stays at the switch, and
moves along it with the share of both sides that keeps it there (Filippov's solution). It is the limit of the solutions
with a right-hand side that goes over from one side to the other within a width, as this goes to zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from gbspec.backends.protocol import Casadi

WIDTH = 1e-8
"""The width of a switch: how far apart the sides of its comparison are where all states are off by this part of their
scales."""
LEAST = 1e-300
"""The least width: where states do not change the comparison, it is decided as before."""
MOST = 6
"""Most switches for which both sides of a right-hand side are written out: each doubles it."""
LONGEST = 200_000
"""Most instructions of a right-hand side that is written again."""
DEPTH = 8
"""How deep expressions are compared: the time doubles with each level."""


def widened(rhs: Casadi) -> Casadi | None:
    """casadi.Function (..., scales [n_states]) of a right-hand side (t, x, condition, inputs, constants) that goes over
    from one side to the other where comparisons of states, and signs, switch.

    None if it has none of these, or more than `LONGEST` instructions.
    """
    plain = rhs if rhs.is_a("SXFunction") else rhs.expand()
    if plain.n_instructions() > LONGEST:
        return None
    arguments = [ca.SX.sym(plain.name_in(i), plain.size1_in(i)) for i in range(plain.n_in())]
    scales = ca.SX.sym("scales", plain.size1_in(1))
    writer = _Writer(plain, arguments)
    out, switches = writer.written(guarded=True), writer.switches
    for switch in writer.bent()[:MOST]:
        first, second = (ca.substitute(out, switch.share, value) for value in (0, 1))
        out = _blended(switch.share, first, second)
    for switch in reversed(switches):
        out = ca.substitute(out, switch.share, switch.smooth(arguments[1], scales))
    return ca.Function("widened", [*arguments, scales], [out]) if switches else None


def _blended(share: Casadi, first: Casadi, second: Casadi) -> Casadi:
    """Both sides by their shares; one that has no value is not used where it has none of it."""
    return ca.if_else(share != 1, (1 - share) * first, 0) + ca.if_else(share != 0, share * second, 0)


@dataclass(frozen=True)
class _Switch:
    """A comparison: `share` is 1 where `larger` is above `smaller`, else 0, and in between within the width."""

    smaller: Casadi
    larger: Casadi
    share: Casadi

    def smooth(self, states: Casadi, scales: Casadi) -> Casadi:
        """The share at some states."""
        difference = self.larger - self.smaller
        width = WIDTH * ca.mtimes(ca.fabs(ca.jacobian(difference, states)), scales)
        return 0.5 * (1 + ca.tanh(difference / ca.fmax(width, LEAST)))


@dataclass
class _Writer:
    """Writes the instructions of a function again, with a symbol for each comparison of states."""

    plain: Casadi
    arguments: list[Casadi]
    switches: list[_Switch] = field(default_factory=list)

    def written(self, guarded: bool) -> Casadi:
        """The value of the function; `guarded`: what has no value on the other side of a switch is not used there."""
        plain, work = self.plain, [ca.SX(0)] * self.plain.sz_w()
        rows, columns = plain.sparsity_out(0).get_triplet()
        out = ca.SX(plain.sparsity_out(0))
        for k in range(plain.n_instructions()):
            code, into, given = plain.instruction_id(k), plain.instruction_output(k), plain.instruction_input(k)
            if code == ca.OP_INPUT:
                work[into[0]] = self.arguments[given[0]][given[1]]
            elif code == ca.OP_OUTPUT:
                out[rows[into[1]], columns[into[1]]] = work[given[0]]
            elif code == ca.OP_CONST:
                work[into[0]] = ca.SX(plain.instruction_constant(k))
            else:
                work[into[0]] = self._operated(code, [work[i] for i in given], guarded)
        return out

    def bent(self) -> list[_Switch]:
        """The switches with whose share the function does not change along a straight line, as where two comparisons
        are of the same."""
        if not self.switches:
            return []
        out = self.written(guarded=False)
        bent = ca.which_depends(out, ca.vertcat(*(one.share for one in self.switches)), 2, False)
        return [one for one, is_bent in zip(self.switches, bent, strict=True) if is_bent]

    def _operated(self, code: int, given: list[Casadi], guarded: bool) -> Casadi:
        if code in (ca.OP_LT, ca.OP_LE):
            return self._share(given[0], given[1], ca.SX.binary(code, *given))
        if code == ca.OP_SIGN:
            return 2 * self._share(ca.SX(0), given[0], 0.5 + 0.5 * ca.sign(given[0])) - 1
        if code == ca.OP_NOT:
            return 1 - given[0]
        if code == ca.OP_AND:
            return given[0] * given[1]
        if code == ca.OP_OR:
            return given[0] + given[1] - given[0] * given[1]
        if code == ca.OP_IF_ELSE_ZERO:
            return ca.if_else(given[0] != 0, given[0] * given[1], 0) if guarded else given[0] * given[1]
        return ca.SX.binary(code, *given) if len(given) == 2 else ca.SX.unary(code, *given)

    def _share(self, smaller: Casadi, larger: Casadi, sharp: Casadi) -> Casadi:
        """The share of the side on which one is larger than the other; `sharp` where states do not decide it."""
        if not ca.jacobian(larger - smaller, self.arguments[1]).nnz():
            return sharp
        for one in self.switches:
            if _same(one.smaller, smaller) and _same(one.larger, larger):
                return one.share
            if _same(one.smaller, larger) and _same(one.larger, smaller):
                return 1 - one.share
        self.switches.append(_Switch(smaller, larger, ca.SX.sym(f"share_{len(self.switches)}")))
        return self.switches[-1].share


def _same(one: Casadi, other: Casadi) -> bool:
    """Whether two expressions are the same."""
    return bool(ca.is_equal(one, other, DEPTH))
