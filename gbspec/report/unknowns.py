"""The learned functions over the region that the data cover: along each argument, over planes, with the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy.core.function import AppliedUndef

from gbspec.analysis import fences, function_bands
from gbspec.arrays import Array
from gbspec.backends import Evaluator, load_module
from gbspec.ir import NN, Channel, Condition, Constant, Expr, Model, State, Unknown
from gbspec.passes import with_truth
from gbspec.report.collect import Fitted, units, visited
from gbspec.report.content import LearnedFunction, Plane, Slice

CURVE, GRID = 160, 60
TICKS = 120
"""Number of marks that show the positions of data along a slice."""
NEAR = 20
"""Number of points near a slice that are needed to determine its range."""
FAR = 0.06
"""Parts of a plane further than this (in widths of the axes) from every visited point are left blank."""
EDGE = 0.02
"""The fraction of visited points omitted at either end of an argument's range, so that outliers do not matter."""


def learned_functions(fitted: Fitted) -> tuple[LearnedFunction, ...]:
    """Every unknown of the model, in order."""
    found = []
    for unknown in fitted.model.unknowns:
        arguments = fitted.model.networks[unknown.network].arguments
        points = visited(fitted, unknown.network)
        truth = truth_of(fitted.model, unknown.name) if fitted.truth is not None else None
        supposed = postulate_of(fitted, unknown)
        names = tuple(argument.name for argument in arguments)
        network = fitted.model.networks[unknown.network].name
        found.append(_Drawn(fitted, unknown.name, network, names, points, truth, supposed).function())
    return tuple(found)


class Expression:
    """An expression of some parameters as a function of points.

    It is evaluated as the channel of a model that has the parameters as conditions and `constants` as constants.
    """

    def __init__(self, value: Expr, parameters: tuple[str, ...], constants: Sequence[Constant]) -> None:
        clock = State("gbspec_clock")
        stand_in = Model(
            "expression",
            states=(clock,),
            balances=(clock.symbol * 0,),
            conditions=tuple(Condition(parameter) for parameter in parameters),
            channels=(Channel("value", value=value),),
            constants=tuple(c for c in constants if c.name not in parameters),
        )
        self.evaluator = Evaluator(load_module(stand_in)())

    def __call__(self, arguments: Array) -> Array:
        """Values [P] at points [P, A]."""
        return self.evaluator.observe_many(0.0, np.zeros((len(arguments), 1)), arguments)[:, 0]


def truth_of(model: Model, name: str) -> Expression | None:
    """The truth of an unknown, None where there is none."""
    found = next((t for t in model.truth_functions if t.name == name), None)
    return None if found is None else Expression(found.value, found.parameters, with_truth(model).constants)


def postulate_of(fitted: Fitted, unknown: Unknown) -> Expression | None:
    """The postulate of an unknown, with learned constants; None if there is none."""
    if unknown.postulate == NN:
        return None
    model, evaluator = fitted.model, fitted.evaluators[0]
    learned = zip(model.constant_names, evaluator.constants, strict=True)
    constants = [Constant(name, value=float(value)) for name, value in learned]
    arguments = tuple(argument.name for argument in model.networks[unknown.network].arguments)
    return Expression(unknown.postulate.xreplace({NN: sympy.Float(unknown.neutral)}), arguments, constants)


def argument_units(model: Model, unknown: Unknown) -> tuple[str, ...]:
    """The units of the arguments of an unknown: those declared with it, else, where it is applied to one named value
    alone (a state, condition, input, `let` or algebraic variable), that one's; empty where there is none."""
    known = units(model)
    values = [
        *model.balances,
        *(channel.value for channel in model.channels),
        *(item.value for item in model.intermediates),
        *(item.residual for item in model.constraints),
    ]
    found = []
    for i, argument in enumerate(model.networks[unknown.network].arguments):
        # a `let` without a unit of its own may stand for a state that has one
        given = (_applied(unknown, i, each) for each in (values, model.inlined(values)))
        named = [known[names.pop()] for names in given if len(names) == 1 and names <= known.keys()]
        found.append(argument.unit or next(iter(named), ""))
    return tuple(found)


def _applied(unknown: Unknown, i: int, values: Sequence[Expr]) -> set[str]:
    """What an unknown is applied to in some values, in its argument `i`, as texts."""
    calls = {node for value in values for node in value.atoms(AppliedUndef) if node.func.__name__ == unknown.name}
    return {str(node.args[i]) for node in calls}


class _Drawn:
    """One unknown over the points [P, A] that were visited."""

    def __init__(
        self,
        fitted: Fitted,
        name: str,
        network: str,
        arguments: tuple[str, ...],
        points: Array,
        truth: Expression | None,
        postulate: Expression | None,
    ) -> None:
        self.fitted, self.name, self.network = fitted, name, network
        self.arguments, self.points = arguments, points
        self.truth, self.postulate = truth, postulate
        self.low = np.quantile(points, EDGE, axis=0)
        self.high = np.quantile(points, 1 - EDGE, axis=0)
        self.middle = np.median(points, axis=0)
        self.fence = fences(fitted.run).get(network)
        unknown = next(u for u in fitted.model.unknowns if u.name == name)
        self.unit = unknown.unit or ""
        self.units = argument_units(fitted.model, unknown)

    def function(self) -> LearnedFunction:
        """Slices, plane and values at the points."""
        varying = [i for i in range(len(self.arguments)) if self.high[i] > self.low[i]]
        return LearnedFunction(
            self.name,
            self.arguments,
            self.points,
            self.members(self.points),
            self.true(self.points),
            tuple(
                sorted((self.slice(i) for i in varying), key=lambda piece: -float(np.ptp(piece.members.mean(axis=0))))
            ),
            self.plane(varying[0], varying[1]) if len(varying) > 1 else None,
            self.unit,
        )

    def members(self, points: Array) -> Array:
        """Values [M, P] of every member."""
        return np.stack([e.functions_many(self.name, points) for e in self.fitted.evaluators])

    def true(self, points: Array) -> Array | None:
        """Values [P] of the truth."""
        return None if self.truth is None else self.truth(points)

    def supposed(self, points: Array) -> Array | None:
        """Values [P] of the postulate."""
        return None if self.postulate is None else self.postulate(points)

    def slice(self, i: int) -> Slice:
        """The function along argument `i` within the range of the data, with the others at their medians."""
        x = np.linspace(*self.reach(i), CURVE)
        points = np.tile(self.middle, (CURVE, 1))
        points[:, i] = x
        column = self.points[:, i]
        near = column[(column >= x[0]) & (column <= x[-1])]
        return Slice(
            self.arguments[i],
            x,
            self.members(points),
            self.true(points),
            self._label({i}),
            self.supposed(points),
            near[:: max(1, len(near) // TICKS)],
            self.trained(i),
            self.band(points),
            None if self.fence is None else self.fence.beyond(points),
            self.units[i],
        )

    def band(self, points: Array) -> Array | None:
        """The ends [2, P] of the 90 % band; None if it is not known."""
        _, low, high = function_bands(self.fitted.run, self.name, points)
        return np.stack([low, high]) if np.isfinite(low).all() and np.isfinite(high).all() else None

    def trained(self, i: int) -> tuple[float, float] | None:
        """The range of argument `i` in which the network was trained, None if the weights do not contain it."""
        weights = self.fitted.evaluators[0].instance.weights
        ends = [weights.get(f"network.{self.network}.input_{end}") for end in ("low", "high")]
        if ends[0] is None or ends[1] is None or not ends[0][i] < ends[1][i]:
            return None  # for an unmeasured state only a guess was known when the range was set
        return float(ends[0][i]), float(ends[1][i])

    def reach(self, i: int) -> tuple[float, float]:
        """The range of argument `i` among the points whose other arguments lie in their middle halves."""
        lower, upper = np.quantile(self.points, [0.25, 0.75], axis=0)
        inside = (self.points >= lower) & (self.points <= upper)
        inside[:, i] = True
        column = self.points[inside.all(axis=1), i]
        if len(column) < NEAR:
            return float(self.low[i]), float(self.high[i])
        low, high = np.quantile(column, [EDGE, 1 - EDGE])
        return (float(low), float(high)) if high > low else (float(self.low[i]), float(self.high[i]))

    def plane(self, i: int, j: int) -> Plane:
        """The function over the plane of two arguments, the others at their medians."""
        x, y = np.linspace(self.low[i], self.high[i], GRID), np.linspace(self.low[j], self.high[j], GRID)
        points = np.tile(self.middle, (GRID * GRID, 1))
        points[:, i], points[:, j] = (axis.ravel() for axis in np.meshgrid(x, y))
        true = self.true(points)
        far = self._far(points[:, [i, j]], [i, j])
        learned = np.where(far, np.nan, self.members(points).mean(axis=0)).reshape(GRID, GRID)
        reference = None if true is None else np.where(far, np.nan, true).reshape(GRID, GRID)
        half = self._half_width(points, far)
        return Plane(self.arguments[i], self.arguments[j], x, y, learned, reference, self._label({i, j}), half,
                     (self.units[i], self.units[j]))  # fmt: skip

    def _half_width(self, points: Array, far: NDArray[np.bool_]) -> Array | None:
        """Half the width of the 90 % band [Y, X] over the points of a plane, blank where they are `far`."""
        if far.all():
            return None
        ends = self.band(points[~far])
        if ends is None:
            return None
        half = np.full(GRID * GRID, np.nan)
        half[~far] = (ends[1] - ends[0]) / 2
        return half.reshape(GRID, GRID)

    def _far(self, places: Array, columns: list[int]) -> NDArray[np.bool_]:
        """The mask of points `places` [P, 2] in the plane of two arguments that are far from every visited point."""
        from scipy.spatial import KDTree

        width = self.high[columns] - self.low[columns]
        distance, _ = KDTree(self.points[:, columns] / width).query(places / width)
        return np.asarray(distance > FAR, dtype=np.bool_)

    def _label(self, varied: set[int]) -> str:
        fixed = [i for i in range(len(self.arguments)) if i not in varied]
        return ", ".join(f"{self.arguments[i]} = {self.middle[i]:.3g}" for i in fixed)
