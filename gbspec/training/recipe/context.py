"""The context of one member's stages: data, curves, packings, and the layout of the trainable vector."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.backends import GeneratedModule, load_module
from gbspec.data import Estimated, Scales, Trajectories, absent_channels, absent_states, scales_of
from gbspec.ir import METHODS, Method, Model, RosenbrockW, coordinates_of, linear_in_states
from gbspec.passes import Switched, with_switches
from gbspec.training.engines import Choice, Engine, choose
from gbspec.training.options import TrainOptions
from gbspec.training.problem import (
    Control,
    Forcing,
    Integers,
    Packed,
    Parameters,
    Problem,
    Scaling,
    Weights,
    default_max_step,
    measured_states,
    pack,
    scaling_of,
    teacher_forcing,
)
from gbspec.training.starts import CurveKind, Curves, Points, collocate, fit_curves, with_derived

TOLERANCE = 1e-5
"""The first relative tolerance of adaptive steps; later stages take less where errors show."""


def is_adaptive(method: Method, options: TrainOptions) -> bool:
    """Whether a method takes adaptive steps: a stiff one always, an explicit one with a tolerance."""
    return isinstance(method, RosenbrockW) or options.tolerance is not None


@dataclass
class Context:
    """The data of one member and everything derived from them; rebuilt identically on resume.

    `held` are the trajectories (or a single trajectory's last rows) excluded by `--holdout`; their own initial states
    are fitted, but they have no influence on shared parameters. `estimated` is the noise by which channels are weighed,
    once residuals have shown it. `absent` [N, n_states]: states that are absent from a trajectory, whose zeros do not
    count (`gbspec.data.absence`). `cutting`: whether steps end where right-hand sides switch, from now on.
    """

    model: Model
    module: GeneratedModule
    trajectories: Trajectories
    held: Trajectories
    options: TrainOptions
    seed: int
    max_step: float
    kind: CurveKind
    curves: Curves
    points: Points
    start_value: Array
    start_free: Array
    absent: Mask
    state_scale: Array
    choice: Choice = field(default_factory=Choice)
    estimated: Estimated | None = None
    unsized: Mask | None = None
    """The states [n_states] whose size nothing declares, so that their starts are solved for; None: no such state."""
    cutting: bool = False
    _packed: dict[tuple[float, int | None], Packed] = field(default_factory=dict)

    @property
    def method(self) -> Method:
        """The method of the solver."""
        return METHODS[self.module.solver]

    @property
    def adaptive(self) -> bool:
        """Whether steps are chosen by the error estimate."""
        return is_adaptive(self.method, self.options)

    def tolerance(self, fraction: float = 1.0) -> float | None:
        """The relative tolerance of adaptive steps: a tenth for every halving of `fraction`; None for fixed steps."""
        first = TOLERANCE if self.options.tolerance is None else self.options.tolerance
        return first * 0.1 ** float(-np.log2(fraction)) if self.adaptive else None

    def steps(self, fraction: float) -> dict[str, float | None]:
        """The largest step of the solver, or the tolerance of adaptive ones, as stored with the weights."""
        found: dict[str, float | None] = {"max_step": self.max_step * fraction}
        if self.adaptive:
            found = {"max_step": self.options.max_step, "tolerance": self.tolerance(fraction)}
        return found | {"switches": 1.0} if self.cutting else found

    def finer(self, fraction: float) -> Context:
        """The same data at `fraction` of the largest step."""
        if self.adaptive:
            return self
        out = replace(self, max_step=fraction * self.max_step, _packed={})
        return out.cut() if self.cutting else out

    def control(self, fraction: float = 1.0) -> Control | None:
        """The control of adaptive steps; None for fixed ones."""
        rtol = self.tolerance(fraction)
        return None if rtol is None else Control(rtol, self.state_scale)

    def packed(self, fraction: float = 1.0, draw: int | None = None) -> Packed:
        """The packing at `fraction` of the largest step; with random sub-steps, `draw` is the number of the draw."""
        draw = draw if self.options.random_substeps and not self.adaptive else None
        key = (1.0 if self.adaptive else fraction, draw)
        if key not in self._packed:
            rng = None if draw is None else np.random.default_rng([self.seed, 31, draw])
            if draw is not None:
                self._packed = {k: v for k, v in self._packed.items() if k[1] is None}
            self._packed[key] = self.pack(self.trajectories, fraction, rng, self.absent)
        return self._packed[key]

    def pack(
        self,
        trajectories: Trajectories,
        fraction: float = 1.0,
        rng: np.random.Generator | None = None,
        absent: Mask | None = None,
    ) -> Packed:
        """The packing of some trajectories for the solver's method; adaptive steps divide its sub-steps."""
        most = self.max_step if self.adaptive else fraction * self.max_step
        packed = pack(trajectories, self.model, most, rng, self.method)
        absent = absent_states(self.model, trajectories.items) if absent is None else absent
        return packed.without(absent_channels(self.model, absent))

    def posed(self, packed: Packed, forcing: Forcing, fraction: float = 1.0) -> Problem:
        """The problem of packed data."""
        module = self._cut[1] if self.cutting else self.module
        return Problem(self.solved, module, packed, forcing, self.scaling(packed), self.control(fraction))

    @property
    def solved(self) -> Model:
        """The model that is solved: with switches of its right-hand sides where steps end there."""
        switched = self._cut[0].model if self.cutting else None
        return self.model if switched is None else switched

    @cached_property
    def _cut(self) -> tuple[Switched, GeneratedModule]:
        switched = with_switches(self.model)
        made = None if switched.model is None else load_module(switched.model, self.method).random(self.seed)
        return switched, made or self.module

    @property
    def switched(self) -> Switched:
        """The model whose steps end where its right-hand sides switch."""
        return self._cut[0]

    def cut(self, cutting: bool = True) -> Context:
        """The same, with steps that end where right-hand sides switch; without if not `cutting`."""
        out = replace(self, cutting=cutting)
        out.__dict__["_cut"] = self._cut  # generated once
        return out

    def problem(self, blend: float = 1.0, fraction: float = 1.0, draw: int | None = None) -> Problem:
        """The training problem with teacher forcing of strength `blend`."""
        packed = self.packed(fraction, draw)
        forcing = teacher_forcing(self.model, packed, blend)
        return self.posed(packed, forcing, fraction)

    def scaled(self, estimated: Estimated | None) -> Scales:
        """The scales of the channels with these estimates of their noise."""
        return scales_of(self.model, self.trajectories, estimated)

    def scaling(self, packed: Packed) -> Scaling:
        """The scales of residuals at the rows of a packing, with the present weights of the channels."""
        return scaling_of(self.model, packed, self.trajectories, self.estimated)

    def engine(
        self, parameters: Parameters, blend: float = 1.0, fraction: float = 1.0, draw: int | None = None
    ) -> Engine:
        """The engine of the problem with teacher forcing of strength `blend`, for this layout of the vector."""
        return self.choice.engine(self.problem(blend, fraction, draw), parameters)

    def parameters(self, fixed: Weights, *, released: bool = False) -> Parameters:
        """The layout of the trainable vector, with the networks' scales `fixed`.

        `released`: measured initial values are learned too, and the measurements treated like all others.
        """
        made = Parameters(self.model, self.start_value, self.state_scale, self.start_free, fixed)
        return self.released(made) if released else made

    def released(self, parameters: Parameters) -> Parameters:
        """The layout in which measured initial values are learned too, and the measurements treated like all others."""
        return replace(parameters, start_free=released_starts(self.model, parameters.start_free, self.absent))


def build_context(
    model: Model,
    module: type[GeneratedModule],
    trajectories: Trajectories,
    options: TrainOptions,
    seed: int,
    kind: CurveKind = "interpolating",
) -> Context:
    """The context: splits off the held-out data, which are the same for all members, since their likelihoods are
    compared, and prepares the rest; `seed` is the member's, and `kind` that of the curves."""
    kept, held = split(trajectories, options.holdout, options.seed)
    method = METHODS[module.solver]
    max_step = exact_step(model, trajectories, options.max_step)
    if max_step is None:
        max_step = np.inf if is_adaptive(method, options) else default_max_step(trajectories)
    instance = module.random(seed)
    curves = with_derived(model, instance, kept, fit_curves(model, kept, kind))
    absent = absent_states(model, kept.items)
    packed = pack(kept, model, max_step, method=method).without(absent_channels(model, absent))
    state_scale = state_scales(model, packed, kept)
    value, free = start_states(model, kept, curves, packed)
    for i, each in enumerate(coordinates_of(model)):
        value[:, i] = each.well_inside(value[:, i], state_scale[i])
    value[absent], free[absent] = 0.0, 0.0
    context = Context(
        model,
        instance,
        kept,
        held,
        options,
        seed,
        max_step,
        kind,
        curves,
        collocate(model, kept, curves, value),
        value,
        free,
        absent,
        state_scale,
        choose(model, module, options, packed.substeps),
    )
    context._packed[1.0, None] = packed
    # A likelihood has no stage that would decide it later, and its derivatives are wrong without.
    at_once = options.switches == "on" or (options.switches == "auto" and model.marginal)
    context.cutting = at_once and context.switched.model is not None
    return context


def without_steps(model: Model) -> bool:
    """Whether the moments of a model with disturbances are exact between two rows, whatever the step."""
    linear = linear_in_states(model) if model.diffusions else None
    return linear is not None and linear.steady


def exact_step(model: Model, trajectories: Trajectories, chosen: float | None) -> float | None:
    """The largest step: the one that is `chosen`; without it, or where steps change nothing, that of the longest
    trajectory for a model with disturbances that is linear in its states; None if neither is known."""
    if not model.diffusions or linear_in_states(model) is None or (chosen and not without_steps(model)):
        return chosen
    return max((item.end - item.start for item in trajectories.items), default=1.0) or 1.0


def split(trajectories: Trajectories, fraction: float, seed: int) -> tuple[Trajectories, Trajectories]:
    """Training and held-out part: whole trajectories drawn at random, or the last rows of a single one."""
    if fraction <= 0 or not len(trajectories):
        return trajectories, trajectories.subset([])
    if len(trajectories) > 1:
        count = int(np.clip(round(fraction * len(trajectories)), 1, len(trajectories) - 1))
        drawn = np.random.default_rng([seed, 41]).permutation(len(trajectories))
        return trajectories.subset(sorted(drawn[count:].tolist())), trajectories.subset(sorted(drawn[:count].tolist()))
    item = trajectories.items[0]
    rows = len(item.times)
    cut = int(np.clip(round((1 - fraction) * rows), min(2, rows), max(rows - 1, 1)))
    return replace(trajectories, items=(item.at_rows(slice(cut)),)), trajectories


def state_scales(model: Model, packed: Packed, trajectories: Trajectories) -> Array:
    """Typical size of each state: the standard deviation of its data, else from its range, else from its initial
    value."""
    values, _ = measured_states(model, packed)
    out = np.ones(len(model.states))
    for i, state in enumerate(model.states):
        column = values[np.isfinite(values[:, i]), i]
        if len(column) > 1 and column.std() > 0:
            out[i] = column.std()
        elif state.range is not None and state.range.bounded:
            out[i] = (state.range.high - state.range.low) / np.sqrt(12)
        elif state.start:
            out[i] = abs(state.start)
    return out


def start_states(model: Model, trajectories: Trajectories, curves: Curves, packed: Packed) -> tuple[Array, Array]:
    """Initial states of the trajectories, and a mask of the learned ones: [N, n_states] each.

    A state that is measured at the initial time has the measured initial value, which is not learned (unless
    `initial X learn` requests it). Otherwise the guess is the end of its curve, its declared initial value, or the
    middle of its range.
    """
    measured, seen = measured_states(model, packed)
    value, free = np.zeros((len(trajectories), len(model.states))), learned_starts(model, packed)
    at_start = _rows_at_start(packed)
    for i in range(len(model.states)):
        guess = _guess(model, i, measured[:, i])
        for k, item in enumerate(trajectories.items):
            curve = curves.items[k][i]
            value[k, i] = curve.extended(np.array([item.start]))[0] if curve is not None else guess
        first = at_start[seen[at_start, i]]
        value[packed.row_trajectory[first], i] = measured[first, i]
    return value, free


def learned_starts(model: Model, packed: Packed) -> Array:
    """A mask [N, n_states] of the initial states that neither the model gives nor a measurement at the start."""
    _, seen = measured_states(model, packed)
    free = np.ones((packed.trajectories, len(model.states)))
    at_start = _rows_at_start(packed)
    for i, state in enumerate(model.states):
        if state.initial.kind == "measured":
            free[packed.row_trajectory[at_start[seen[at_start, i]]], i] = 0.0
        elif state.initial.known:
            free[:, i] = 0.0
    return free


def _rows_at_start(packed: Packed) -> Integers:
    return np.flatnonzero((packed.row_index == 0) & (packed.row_step == 0))


def released_starts(model: Model, free: Array, absent: Mask) -> Array:
    """The mask of learned initial states [N, n_states] if measured ones are released: all except expressions, and
    states that are absent."""
    expressed = np.array([state.initial.known for state in model.states], dtype=bool)
    return np.where(expressed | absent, free, 1.0)


def _guess(model: Model, index: int, measured: Array) -> float:
    state = model.states[index]
    seen = measured[np.isfinite(measured)]
    if len(seen):
        return float(np.median(seen))
    if state.start is not None:
        return state.start
    if state.range is not None and state.range.bounded:
        return (state.range.low + state.range.high) / 2
    return 0.0
