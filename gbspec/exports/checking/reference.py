"""What the generated module computes at points, and the size that rounding errors are measured by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from gbspec.arrays import Array
from gbspec.backends import Casadi, Evaluator
from gbspec.data import DoseEvents, Signal
from gbspec.exports.checking.points import Points
from gbspec.exports.programs import Programs
from gbspec.exports.subject import Exported
from gbspec.ir import Expr

Pair = tuple[Array, Array]


def with_past(exported: Exported, points: Points) -> Points:
    """The points with the delayed values of a trajectory that was just begun, and their derivatives along the points'
    directions: they depend on the time and on constants, but not on the state."""
    if not exported.model.delays:
        return points
    evaluator, count = Evaluator(exported.instance), len(exported.model.inputs)
    x0 = evaluator.initial(exported.states, exported.conditions)
    late, moved = evaluator.late_at_first(exported.start), []
    values, slopes = [], late.jacobian()
    for row, direction in zip(zip(*points.arguments, strict=True), zip(*points.along, strict=True), strict=True):
        given = (row[0], x0, row[2], exported.inputs, row[4])
        values.append(np.array(late(*given)).ravel())
        blocks = slopes(*given, np.zeros(late.size_out(0)))
        kept = [(np.array(blocks[i]), np.atleast_1d(direction[i])) for i in (0, 2, 4)]
        moved.append(sum((block @ part for block, part in kept), np.zeros(len(values[-1]))))
    inputs = np.concatenate([points.inputs[:, :count], np.array(values)], axis=1)
    t, x, condition, given_inputs, constants = points.along
    along = (t, x, condition, np.concatenate([given_inputs[:, :count], np.array(moved)], axis=1), constants)
    return replace(points, inputs=inputs, along=along)


@dataclass(frozen=True)
class Reference:
    """Values of the generated module at points, each with the size of its terms: its own, and that of each argument's
    contribution (the slope by the argument times the argument)."""

    exported: Exported
    programs: Programs
    points: Points

    @cached_property
    def evaluator(self) -> Evaluator:
        """The evaluator of the module."""
        return Evaluator(self.exported.instance)

    @cached_property
    def rhs(self) -> Pair:
        """The right-hand side [R, states] and its size."""
        return self._module("rhs"), self._sizes(self.evaluator.rhs, self._module("rhs"))

    @cached_property
    def observe(self) -> Pair:
        """The channels [R, channels] and their size."""
        return self._module("observe"), self._sizes(self.evaluator.observe, self._module("observe"))

    @cached_property
    def rhs_along(self) -> Pair:
        """The derivative of the right-hand side along the points' directions, and the sum of its absolute terms."""
        return self._along(self.evaluator.rhs)

    @cached_property
    def observe_along(self) -> Pair:
        """The same of the channels."""
        return self._along(self.evaluator.observe)

    @cached_property
    def algebraics(self) -> Pair:
        """The algebraic variables [R, n] and their size."""
        if not self.exported.model.algebraics:
            return self._none, self._none
        t, x, condition, inputs, constants = self.points.arguments
        instance = self.exported.instance
        math, networks = instance.arithmetic("numpy"), instance.numpy_networks()
        found = instance.equations.algebraic(math, t, x, condition, inputs, tuple(constants.T), networks)
        values = np.asarray(found, dtype=np.float64)
        return values, np.abs(values) + 1.0

    @cached_property
    def lags(self) -> Pair:
        """How long delays are [R, lags], and their size."""
        _, _, condition, _, constants = self.points.arguments
        instance = self.exported.instance
        found = instance.equations.lags(instance.arithmetic("numpy"), condition, tuple(constants.T))
        values = np.stack(
            [np.broadcast_to(np.asarray(lag, dtype=np.float64), len(self.points)) for lag in found], axis=1
        )
        return values, np.abs(values)

    @cached_property
    def delayed(self) -> Pair:
        """What is delayed [R, delays], at its own time, and its size."""
        t, x, condition, inputs, constants = self.points.arguments
        instance, own = self.exported.instance, inputs[:, : len(self.exported.model.inputs)]
        math, networks = instance.arithmetic("numpy"), instance.numpy_networks()
        found = instance.equations.delayed(math, t, x, condition, own, tuple(constants.T), networks)
        values = np.asarray(found, dtype=np.float64)
        return values, np.abs(values) + np.abs(x).max(axis=1, keepdims=True)

    def _module(self, name: str) -> Array:
        """A method of the equations over numpy's arrays."""
        t, x, condition, inputs, constants = self.points.arguments
        equations, math = self.exported.instance.equations, self.exported.instance.arithmetic("numpy")
        method = equations.rhs if name == "rhs" else equations.observe
        networks = self.exported.instance.numpy_networks()
        with np.errstate(all="ignore"):
            found = method(math, t, x, condition, inputs, tuple(constants.T), networks)
        return np.asarray(found, dtype=np.float64)

    def _blocks(self, function: Casadi) -> list[list[Array]]:
        """For each point the derivatives by each argument: matrices [outputs, size of the argument]."""
        slopes = function.jacobian()
        out = []
        for row in zip(*self.points.arguments, strict=True):
            found = slopes(*row, np.zeros(function.size_out(0)))
            blocks = found if isinstance(found, tuple) else (found,)
            out.append([np.array(block, dtype=np.float64) for block in blocks])
        return out

    def _sizes(self, function: Casadi, values: Array) -> Array:
        sizes = np.abs(values).copy()
        for i, (blocks, row) in enumerate(
            zip(self._blocks(function), zip(*self.points.arguments, strict=True), strict=True)
        ):
            for block, argument in zip(blocks, row, strict=True):
                sizes[i] += np.abs(block) @ np.abs(np.atleast_1d(argument))
        return sizes

    def _along(self, function: Casadi) -> Pair:
        values, sizes = [], []
        for blocks, row in zip(self._blocks(function), zip(*self.points.along, strict=True), strict=True):
            parts = [(block, np.atleast_1d(argument)) for block, argument in zip(blocks, row, strict=True)]
            values.append(sum(block @ direction for block, direction in parts))
            sizes.append(sum(np.abs(block) @ np.abs(direction) for block, direction in parts))
        return np.array(values), np.array(sizes)

    # -------------------------------------------------------------- learned functions
    @cached_property
    def functions(self) -> Pair:
        """The value of each application of an unknown [R, applications], and its size."""
        columns = [self._value(item.node) for item in self.programs.applications]
        values = np.stack([np.broadcast_to(c, len(self.points)) for c in columns], axis=1) if columns else self._none
        return values, np.abs(values) + 1.0

    @property
    def _none(self) -> Array:
        return np.zeros((len(self.points), 0))

    def _value(self, node: Expr) -> Array:
        """An expression at the points."""
        table = (
            {app: sympy.Dummy(real=True) for app in node.atoms(AppliedUndef)}
            if not isinstance(node, AppliedUndef)
            else {}
        )
        if isinstance(node, AppliedUndef):
            arguments = [np.broadcast_to(self._value(a), len(self.points)) for a in node.args]
            return self.unknown(node.func.__name__, arguments)
        model = self.exported.model
        declared = (*model.states, *model.conditions, *model.inputs)
        known = [item.symbol for item in declared] + [delay.symbol for delay in model.delays]
        known += [item.symbol for item in (*model.constants, *model.learnables, *model.algebraics)]
        symbols = [model.time.symbol, *known, *table.values()]
        function = sympy.lambdify(symbols, node.xreplace(table), modules="numpy", dummify=True)
        t, x, condition, inputs, constants = self.points.arguments
        inner = [self._value(app) for app in table]
        with np.errstate(all="ignore"):
            columns = (*x.T, *condition.T, *inputs.T, *constants.T, *self.algebraics[0].T)
            return np.asarray(function(t, *columns, *inner), dtype=np.float64)

    def unknown(self, name: str, arguments: list[Array]) -> Array:
        """The values [R] of an unknown at arguments [R] each."""
        instance = self.exported.instance
        _, output, method = instance.equations.unknowns[name]
        math, networks = instance.arithmetic("numpy"), instance.numpy_networks()
        with np.errstate(all="ignore"):
            found = method(math, tuple(self.points.constants.T), networks, *arguments)
        return np.asarray(np.broadcast_to(found[output], len(self.points)), dtype=np.float64)

    # -------------------------------------------------------------- over time
    def sizes_of_steps(self, most: float) -> Array:
        """Sizes [R] of steps to compare: at most `most`, and so short that rounding errors do not grow in a step."""
        rates = [float(np.abs(blocks[1]).sum(axis=1).max()) for blocks in self._blocks(self.evaluator.rhs)]
        return np.minimum(most, 1.0 / np.maximum(rates, 1e-300))

    def step(self, h: Array) -> Pair:
        """The states [R, n] after a step of size h [R] with the inputs held, and the size of their terms."""
        instance, math = self.exported.instance, self.exported.instance.arithmetic("numpy")
        equations, networks = instance.equations, instance.numpy_networks()
        nodes, found = len(self.exported.method.nodes), []
        for size, (t, x, condition, inputs, constants) in zip(h, zip(*self.points.arguments, strict=True), strict=True):
            field = equations.field(math, condition, tuple(constants), networks)
            with np.errstate(all="ignore"):
                found.append(equations.step(math, field, equations.grid(math, t, size), x, (inputs,) * nodes))
        after = np.array(found, dtype=np.float64)
        return after, np.abs(self.points.x) + h[:, None] * self.rhs[1]

    def trajectory(self, course: Course, point: int = 0) -> Pair:
        """The states [T, n] of a course from the states of a point, by the module's steps, and the delayed values."""
        start = self.evaluator.initial(self.points.x[point], self.points.condition[point], self.points.constants[point])
        return self.evaluator.followed_fixed(
            start,
            course.times,
            self.points.condition[point],
            course.inputs,
            course.start,
            max_step=course.max_step,
            doses=course.doses,
            constants=self.points.constants[point],
        )

    def channels(self, course: Course, states: Array, late: Array, point: int = 0) -> Array:
        """The channels [T, C] along states and delayed values."""
        return self.evaluator.observe_many(
            course.times,
            states,
            self.points.condition[point],
            np.concatenate([course.inputs_at(self.exported), late], axis=1),
            self.points.constants[point],
        )


@dataclass(frozen=True)
class Course:
    """A trajectory to compare: output times from `start`, inputs, doses, and the largest step."""

    start: float
    times: Array
    inputs: tuple[Signal, ...]
    doses: tuple[DoseEvents, ...]
    max_step: float

    def inputs_at(self, exported: Exported) -> Array:
        """The inputs [T, m] at the output times."""
        from gbspec.data import evaluate

        columns = [
            evaluate(signal, item.interpolation, self.times)
            for signal, item in zip(self.inputs, exported.model.inputs, strict=True)
        ]
        return np.stack(columns, axis=1) if columns else np.zeros((len(self.times), 0))
