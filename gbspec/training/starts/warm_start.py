"""Gradient matching: constants and networks from the slopes of splines, before any trajectory is solved.

1. *Elimination*: the networks' outputs are free numbers at each point; constants (and these numbers) minimise the
   robust distance of balances and slopes. Where there are more balances than outputs, this determines the constants
   without any assumption on the unknown functions; otherwise damping keeps them at their starting values.
2. *Scales*: the networks' inputs are scaled by their values at the points, outputs by the free numbers.
3. *Slope regression*: networks and constants together, by Adam on minibatches of points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.backends import GeneratedModule
from gbspec.data import sobol
from gbspec.ir import NN, Model, unknowns_in_equations
from gbspec.training.optimise import AdamMoments, one_cycle, prior_sd
from gbspec.training.problem import Bijections, Parameters, Weights
from gbspec.training.starts.slopes import FreeOutputs, Points, evaluate_elsewhere, evaluate_rhs

ELIMINATION_STEPS = 30
REGRESSION_STEPS = 1000
BATCH, EVALUATIONS = 256, 8192
"""Points of a minibatch; fewer if unknowns would be evaluated more often than this (arrays)."""
ELIMINATION_WORK = 2e9
"""Limit on the multiplications in one step of the elimination; if necessary fewer points are used."""
LESSER = 30.0
"""By how much less the guessed slope of an unmeasured state counts than that of a curve."""
PEAK_RATE = 5e-3
PRIOR = 0.5
"""Standard deviation of the constants' prior around their starting values, in trainable units: a factor of e^1.5."""


@dataclass(frozen=True)
class Eliminated:
    """Constants (trainable values [n_learnables]), and free outputs [M, Q] with the arguments of each application.

    `spread` are the arguments with states that have no curve spread over their declared ranges. `unseen` [Q]: outputs
    in no balance of a state with a curve, whose size is a guess. `elsewhere`, `elsewhere_spread`: the same arguments of
    the applications in channels and events, whose outputs are not estimated.
    """

    constants: Array
    outputs: Array
    arguments: tuple[tuple[int, Array], ...]
    spread: tuple[tuple[int, Array], ...]
    unseen: Mask
    elsewhere: tuple[tuple[int, Array], ...] = ()
    elsewhere_spread: tuple[tuple[int, Array], ...] = ()


def slope_mismatch(model: Model, module: GeneratedModule, points: Points, constants: Array) -> float:
    """The typical distance of balances and slopes at trainable constants, in units of the slopes, in a model whose
    functions are all known; infinite where it is not a number."""
    with torch.no_grad():
        k = _constants_at(model, torch.from_numpy(constants), len(points))
        found = evaluate_rhs(model, module, points, k, ()).numpy()
    apart = ((found - points.slope) / points.scale)[:, list(points.equations)]
    value = float(np.mean(np.log1p(apart**2))) if apart.size else 0.0
    return value if np.isfinite(value) else float("inf")


def _constants_at(model: Model, u: Tensor, count: int) -> Tensor:
    known = [torch.full((count,), c.value, dtype=torch.float64) for c in model.constants]
    natural = Bijections.of(model.learnables).to_natural(u)
    learned = [natural[..., i].expand(count) for i in range(len(model.learnables))]
    columns = known + learned
    return torch.stack(columns, -1) if columns else torch.zeros((count, 0), dtype=torch.float64)


class _Mismatch:
    """Balances minus slopes at M points, in units of the balances' scales [M, E], at trainable constants [n] and free
    outputs [M, Q].

    `rough`: constants are not estimated, and all balances are used, for orders of magnitude: states without curves
    have a guess as their value, and a slope of zero, since on average a state of bounded range has that. The scale of
    such a balance is the size of its terms without the networks. One without such terms would only say that what is
    unknown is zero: it has the size of its state over the time of the data as slope and scale. Either counts less than
    those with a curve, so that it decides only about outputs that these leave open.
    """

    def __init__(self, model: Model, module: GeneratedModule, points: Points, start: Array, rough: bool) -> None:
        self.model, self.module, self.points, self.fixed = model, module, points, rough
        self.equations = list(range(len(model.states))) if rough else list(points.equations)
        self.free = _free_outputs(model, module, points, start)
        scale, self.slope = points.scale.copy(), points.slope.copy()
        if rough:
            size = self._sizes(start)
            for i in set(self.equations) - set(points.rough):
                known = np.isfinite(size[i]) and size[i] > 0
                scale[i] = LESSER * (size[i] if known else self._rate(i))
                self.slope[:, i] = self.slope[:, i] if known else self._signed(i, start) * self._rate(i)
        self.scale = torch.from_numpy(scale[self.equations])

    def _rate(self, state: int) -> float:
        """The size of a state over the time of the data: of its range, or of its values at the points."""
        bounds, t = self.model.states[state].range, self.points.t
        width = (bounds.high - bounds.low) / np.sqrt(12) if bounds is not None and bounds.bounded else 0.0
        size = width or float(np.abs(self.points.x[:, state]).max(initial=0.0)) or 1.0
        return size / (float(np.ptp(t)) or 1.0) if len(t) else size

    def _signed(self, state: int, u: Array) -> float:
        """The sign of a balance that consists of unknown terms, where these are positive."""
        self.free.values = torch.ones((len(self.points), len(self.free.neutral)), dtype=torch.float64)
        with torch.no_grad():
            k = _constants_at(self.model, torch.from_numpy(u), len(self.points))
            found = evaluate_rhs(self.model, self.module, self.points, k, self.free.functions())[:, state]
        return -1.0 if float(found.sum()) < 0 else 1.0

    def _sizes(self, u: Array) -> Array:
        """The root mean square of each right-hand side [n_states], with the networks' outputs neutral."""
        count = len(self.points)
        self.free.values = torch.tensor(self.free.neutral, dtype=torch.float64).expand(count, -1)
        with torch.no_grad():
            k = _constants_at(self.model, torch.from_numpy(u), count)
            rhs = evaluate_rhs(self.model, self.module, self.points, k, self.free.functions()).numpy()
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(np.sqrt(np.mean(rhs**2, axis=0)))

    def _of(self, u: Array, outputs: Array, derivatives: bool) -> tuple[Tensor, Tensor, Tensor]:
        k = _constants_at(self.model, torch.from_numpy(u), len(self.points)).detach().requires_grad_(derivatives)
        self.free.values = o = torch.from_numpy(outputs).clone().requires_grad_(derivatives)
        rhs = evaluate_rhs(self.model, self.module, self.points, k, self.free.functions())
        return (rhs - torch.from_numpy(self.slope))[:, self.equations] / self.scale, o, k

    def weights(self, r: Array, sd: float) -> tuple[Array, float]:
        """The weights [M, E] of a mismatch, and its objective: Cauchy's, without influence of outliers; for orders of
        magnitude least squares, as most guessed balances would agree with an unknown that is zero."""
        square = (r / (3 * sd)) ** 2
        if self.fixed:
            return np.ones_like(r), float(square.sum())
        return 1.0 / (1.0 + square), float(np.log1p(square).sum())

    def values(self, u: Array, outputs: Array) -> Array:
        """The mismatch."""
        return np.asarray(self._of(u, outputs, False)[0].detach().numpy())

    def linear(self, u: Array, outputs: Array) -> tuple[Array, Array, Array]:
        """The mismatch and its derivatives with respect to outputs [M, E, Q] and constants [M, E, n]."""
        r, o, k = self._of(u, outputs, True)
        by_outputs, by_constants = [], []
        for i in range(len(self.equations)):
            found: tuple[Tensor | None, ...] = (None, None)
            if r.requires_grad:
                found = torch.autograd.grad(r[:, i].sum(), [o, k], retain_graph=True, allow_unused=True)
            by_outputs.append(torch.zeros_like(o) if found[0] is None else found[0])
            by_constants.append(torch.zeros_like(k) if found[1] is None else found[1])
        slope = Bijections.of(self.model.learnables).derivative(u) * (0.0 if self.fixed else 1.0)
        # Where a derivative has no value (a root at zero), the point says nothing of the constant.
        slopes = torch.stack(by_constants, 1).numpy()[:, :, len(self.model.constants) :]
        jac_k = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0) * slope
        return r.detach().numpy(), torch.stack(by_outputs, 1).numpy(), jac_k


def eliminate(model: Model, module: GeneratedModule, points: Points, start: Array) -> Eliminated:
    """Step 1 from the constants `start` (trainable values).

    Outputs that no comparable balance contains are estimated from all balances, with rough values of unmeasured states.
    """
    found = _of_balances(model, module, points, start)
    if not model.networks:
        return found
    at, spread = (_applied_elsewhere(model, module, some, found.constants) for some in (points, _spread(model, points)))
    return replace(found, elsewhere=at, elsewhere_spread=spread)


def _applied_elsewhere(
    model: Model, module: GeneratedModule, points: Points, constants: Array
) -> tuple[tuple[int, Array], ...]:
    """The arguments of networks in channels and events, with neutral outputs."""
    free = FreeOutputs(model, len(points))
    with torch.no_grad():
        k = _constants_at(model, torch.from_numpy(constants), len(points))
        evaluate_elsewhere(model, module, points, k, free.functions())
    return tuple(free.arguments)


def _of_balances(model: Model, module: GeneratedModule, points: Points, start: Array) -> Eliminated:
    """What balances tell, without applications elsewhere."""
    if unknowns_in_equations(model):
        return _as_declared(model, module, points, start)
    outputs = len(_free_outputs(model, module, points.some(np.arange(1)), start).neutral)
    enough = int(ELIMINATION_WORK / max(len(model.states) * outputs**2, 1)) + 1
    if len(points) > enough:
        points = points.some(np.linspace(0, len(points) - 1, enough).astype(np.int64))
    if not points.equations:
        return _eliminated(_Mismatch(model, module, points, start, rough=True), start)
    found = _eliminated(_Mismatch(model, module, points, start, rough=False), start)
    if found.unseen.any():
        rough = _eliminated(_Mismatch(model, module, points, start, rough=True), found.constants)
        mixed = np.where(found.unseen, rough.outputs, found.outputs)
        found = replace(found, outputs=mixed, unseen=found.unseen & rough.unseen)
    return found


def _as_declared(model: Model, module: GeneratedModule, points: Points, start: Array) -> Eliminated:
    """Neutral outputs and the constants' starts, with the arguments that a search for the algebraic variables asks for
    on its way: it calls the networks as often as it needs to, so that their outputs cannot be free numbers."""
    free = _free_outputs(model, module, _spread(model, points), start)
    outputs = np.tile(np.array(free.neutral), (len(points), 1)).reshape(len(points), -1)
    unseen = np.zeros(outputs.shape[1], dtype=np.bool_)
    return Eliminated(start, outputs, tuple(free.arguments), tuple(free.arguments), unseen)


def _eliminated(mismatch: _Mismatch, start: Array) -> Eliminated:
    """Constants and outputs by a damped Gauss-Newton iteration."""
    model, points, count = mismatch.model, mismatch.points, len(mismatch.points)
    unseen = np.ones(len(mismatch.free.neutral), dtype=np.bool_)
    shown = np.isin(mismatch.equations, points.rough)
    u, outputs = start.copy(), np.tile(np.array(mismatch.free.neutral), (count, 1)).reshape(count, -1)
    slopes = np.abs(points.slope[:, mismatch.equations]) / mismatch.scale.numpy()
    width = (float(np.median(slopes)) if count else 0.0) or 1.0  # all slopes are guessed where no state has a curve
    damping, best = 1e-2, np.inf
    center, deviation = _prior_of_constants(model, start)
    for _ in range(ELIMINATION_STEPS):
        r, jac_o, jac_k = mismatch.linear(u, outputs)
        if not np.isfinite(r).all():
            break
        unseen &= ~(jac_o[:, shown] != 0).any(axis=(0, 1))
        sd = max(1.4826 * float(np.median(np.abs(r))), 1e-4 * width)
        w, value = mismatch.weights(r, sd)
        # Points of one curve are not independent: the prior is weighted relative to the number of measurements.
        prior = count / points.measurements * (sd / deviation) ** 2
        du, do = _eliminated_step(r, jac_o, jac_k, w, damping * count, prior, u - center)
        new_r = mismatch.values(u + du, outputs + do)
        new = mismatch.weights(new_r, sd)[1] if np.isfinite(new_r).all() else np.inf
        if new < value:
            u, outputs, damping = u + du, outputs + do, max(damping / 5, 1e-8)
            if abs(best - new) < 1e-6 * max(new, 1e-12):
                break
            best = new
        else:
            damping *= 4
            if damping > 1e6:
                break
    spread = _free_outputs(model, mismatch.module, _spread(model, points), u).arguments
    return Eliminated(u, outputs, tuple(mismatch.free.arguments), tuple(spread), unseen)


def _spread(model: Model, points: Points) -> Points:
    """The points with states that have no curve spread over their declared ranges, or as solutions have them."""
    x, draws = (points.x if points.solved is None else points.solved).copy(), sobol(len(points), len(model.states), 0)
    for i, state in enumerate(model.states):
        if i not in points.rough and state.range is not None and state.range.bounded:
            x[:, i] = state.range.low + (state.range.high - state.range.low) * draws[:, i]
    return replace(points, x=x)


def _prior_of_constants(model: Model, start: Array) -> tuple[Array, Array]:
    """Prior means and standard deviations of the constants in trainable units [n]: as declared, else around `start`."""
    center, deviation = start.copy(), np.full(len(start), PRIOR)
    bijections = Bijections.of(model.learnables)
    declared = np.array([0.0 if k.prior is None else k.prior.location for k in model.learnables])
    at = bijections.from_natural(declared)
    slope = np.abs(bijections.derivative(at))
    for i, learnable in enumerate(model.learnables):
        if learnable.prior is not None and slope[i] > 0:
            width = prior_sd(learnable.prior) * (1 if learnable.prior.kind == "normal" else learnable.prior.location)
            center[i], deviation[i] = at[i], width / slope[i]
    return center, deviation


def _free_outputs(model: Model, module: GeneratedModule, points: Points, start: Array) -> FreeOutputs:
    """Free outputs for some points, after one evaluation that determines their number."""
    free = FreeOutputs(model, len(points))
    with torch.no_grad():
        constants = _constants_at(model, torch.from_numpy(start), len(points))
        evaluate_rhs(model, module, points, constants, free.functions())
    return free


def _eliminated_step(
    r: Array, jac_o: Array, jac_k: Array, w: Array, damping: float, prior: Array, offset: Array
) -> tuple[Array, Array]:
    """The Gauss-Newton step of constants [n] and free outputs [M, Q]; outputs are eliminated point by point.

    `prior` [n] is the precision of the constants' prior, `offset` [n] their distance from its center.
    """
    q = jac_o.shape[2]
    weighted = jac_o * w[:, :, None]
    h_oo = np.einsum("pei,pej->pij", weighted, jac_o)
    # The least-norm solution where a point does not determine its outputs.
    size = np.trace(h_oo, axis1=1, axis2=2).mean() / max(q, 1) if q else 1.0
    h_oo = h_oo + 1e-8 * max(size, 1e-300) * np.eye(q)
    g_o = np.einsum("pei,pe->pi", weighted, r)
    h_ok = np.einsum("pei,pek->pik", weighted, jac_k)
    solved_g = np.linalg.solve(h_oo, g_o[:, :, None])[:, :, 0] if q else g_o
    solved_k = np.linalg.solve(h_oo, h_ok) if q else h_ok
    h_kk = np.einsum("pei,pej->ij", jac_k * w[:, :, None], jac_k) - np.einsum("pik,pij->kj", h_ok, solved_k)
    g_k = np.einsum("pek,pe->k", jac_k * w[:, :, None], r) - np.einsum("pik,pi->k", h_ok, solved_g)
    if not len(g_k):
        return np.zeros(0), -solved_g
    du = -np.linalg.solve(h_kk + np.diag(damping + prior), g_k + prior * offset)
    do = -solved_g - np.einsum("pik,k->pi", solved_k, du)
    return du, do


def unseen_outputs(model: Model, eliminated: Eliminated) -> dict[str, Mask]:
    """For each network the outputs [n_outputs] that are in no balance of a state with a curve, and of which nothing
    else tells the size: not those with a postulate, nor the coefficients and gates of splines and contracts."""
    plain = {(u.network, u.output) for u in model.unknowns if u.postulate == NN}
    out = {
        network.name: np.array(
            [(i, k) in plain and not network.spline for k in range(network.sizes[-1])], dtype=np.bool_
        )
        for i, network in enumerate(model.networks)
    }
    position = 0
    for which, known in eliminated.arguments:
        width, each = len(model.networks[which].outputs), known.shape[1]
        columns = eliminated.unseen[position : position + width * each].reshape(width, each)
        out[model.networks[which].name][:width] &= columns.all(axis=1)
        position += width * each
    return out


def network_scales(model: Model, eliminated: Eliminated) -> Weights:
    """Step 2: input and output scales of every network, and the range that its inputs cover."""
    inputs, outputs = _applications(model, eliminated)
    out: Weights = {}
    for index, network in enumerate(model.networks):
        prefix = f"network.{network.name}."
        arguments = inputs.get(index, np.zeros((0, len(network.arguments))))
        arguments = arguments[np.isfinite(arguments).all(axis=1)]
        ranges = [argument.range for argument in network.arguments]
        low, high, center, scale = (np.zeros(len(ranges)) for _ in range(4))
        for i, bounds in enumerate(ranges):
            column = arguments[:, i]
            declared = (bounds.low, bounds.high) if bounds is not None and bounds.bounded else (-1.0, 1.0)
            varies = len(column) > 1 and float(column.std()) > 1e-9 * max(float(np.abs(column).max()), 1e-300)
            at_guess = not varies and bounds is not None and bounds.bounded  # a guess covers nothing
            low[i], high[i] = (column.min(), column.max()) if len(column) and not at_guess else declared
            center[i] = column.mean() if len(column) else (declared[0] + declared[1]) / 2
            scale[i] = column.std() if varies else max((declared[1] - declared[0]) / np.sqrt(12), 1e-12)
            if i in network.cyclic:  # the network gets a cosine in its place
                center[i], scale[i] = 0.0, np.sqrt(0.5)
        out |= {f"{prefix}input_center": center, f"{prefix}input_scale": scale}
        out |= {f"{prefix}input_low": low, f"{prefix}input_high": high}
        known = outputs.get(index, np.zeros((0, len(network.outputs))))
        center_out, scale_out = _output_scale(model, index, known)
        out |= {f"{prefix}output_center": center_out, f"{prefix}output_scale": scale_out}
    return out


def _applications(model: Model, eliminated: Eliminated) -> tuple[dict[int, Array], dict[int, Array]]:
    """The arguments [K, n_arguments] that are known of each network, and the free outputs [K, n_outputs]."""
    inputs: dict[int, list[Array]] = {}
    outputs: dict[int, list[Array]] = {}
    position = 0
    for (which, known), (_, spread) in zip(eliminated.arguments, eliminated.spread, strict=True):
        arguments = _covered(model, which, known, spread)
        width, (count, each, n_arguments) = len(model.networks[which].outputs), arguments.shape
        columns = eliminated.outputs[:, position : position + width * each].reshape(count, width, each)
        inputs.setdefault(which, []).append(arguments.reshape(-1, n_arguments))
        outputs.setdefault(which, []).append(columns.swapaxes(1, 2).reshape(-1, width))
        position += width * each
    for (which, known), (_, spread) in zip(eliminated.elsewhere, eliminated.elsewhere_spread, strict=True):
        found = _covered(model, which, known, spread, whole=True)
        found = found.reshape(-1, found.shape[-1])
        if not any(np.array_equal(found, other) for other in inputs.get(which, [])):  # as in `observe rate = mu(S)`
            inputs.setdefault(which, []).append(found)
    joined = ({which: np.concatenate(parts) for which, parts in found.items()} for found in (inputs, outputs))
    return next(joined), next(joined)


def _covered(model: Model, which: int, known: Array, spread: Array, whole: bool = False) -> Array:
    """The arguments of one application [M, E, n_arguments]: as known, or where nothing but the declared ranges of
    states without curves tells their size, those of such states. An argument with a range of its own covers this one,
    instead of a guess: with `whole` always, else where the guess lies beyond it."""
    ranges = [a.range for a in model.networks[which].arguments]
    given = np.array([bounds is not None and bounds.bounded for bounds in ranges], dtype=bool)
    arguments = np.where(given | ~np.isfinite(spread).all(axis=(0, 1)), known, spread)
    for i, bounds in enumerate(ranges):
        guess = known[..., i]  # of a state that nothing measures: it may lie beyond the argument's own range
        if bounds is None or not bounds.bounded or np.ptp(guess) > 0 or np.ptp(spread[..., i]) == 0:
            continue
        if whole or not bounds.low <= guess.flat[0] <= bounds.high:
            arguments[..., i] = np.linspace(bounds.low, bounds.high, len(known))[:, None]
    return arguments


def _output_scale(model: Model, network: int, outputs: Array) -> tuple[Array, Array]:
    """Robust center and scale of the free outputs; with a postulate the center is its neutral value."""
    unknowns = sorted((u for u in model.unknowns if u.network == network), key=lambda u: u.output)
    width = model.networks[network].sizes[-1]  # outputs beyond those of the unknowns are required by contracts
    center, scale = np.zeros(width), np.ones(width)
    for i, unknown in enumerate(unknowns):
        column = outputs[:, i]
        column = column[np.isfinite(column)]
        plain = unknown.postulate == NN
        if len(column) < 2:
            center[i], scale[i] = unknown.neutral, 1.0
            continue
        low, high = np.quantile(column, [0.02, 0.98])
        clipped = np.clip(column, low, high)
        center[i] = clipped.mean() if plain else unknown.neutral
        deviation = float(np.sqrt(np.mean((clipped - center[i]) ** 2)))
        size = max(float(np.abs(clipped).max()), 1e-300)
        scale[i] = deviation if deviation > 1e-6 * size else max(0.1 * size, 1e-12) if size > 1e-12 else 1.0
    return center, scale


def regress_slopes(parameters: Parameters, module: GeneratedModule, points: Points, theta: Array, seed: int) -> Array:
    """Step 3: weights and shared constants by Adam on minibatches of points; Huber's loss, a one-cycle schedule."""
    model = parameters.model
    if not points.equations or not model.networks:
        return theta
    rng = np.random.default_rng([seed, 11])
    shared, rest = theta[: parameters.n_shared].copy(), torch.from_numpy(theta[parameters.n_shared :])
    equations = list(points.equations)
    scale = torch.from_numpy(points.scale[equations])
    moments = AdamMoments.zero(len(shared))
    of_a_point = len(_free_outputs(model, module, points.some(np.arange(1)), np.zeros(len(model.learnables))).neutral)
    size = min(BATCH, len(points), EVALUATIONS // max(of_a_point, 1) + 1)
    for i in range(REGRESSION_STEPS):
        batch = points.some(rng.integers(0, len(points), size))
        leaf = torch.from_numpy(shared).requires_grad_()
        vector = torch.cat([leaf, rest])
        constants = parameters.constants(vector)[torch.from_numpy(batch.trajectory)]
        networks = module.torch_networks(parameters.weights(vector))
        rhs = evaluate_rhs(model, module, batch, constants, networks)
        r = (rhs[:, equations] - torch.from_numpy(batch.slope[:, equations])) / scale
        loss = torch.nn.functional.huber_loss(r, torch.zeros_like(r), delta=0.1)
        (gradient,) = torch.autograd.grad(loss, leaf)
        if not bool(torch.isfinite(gradient).all()):
            return theta
        moments, step = moments.advance(gradient.numpy(), one_cycle(i + 1, REGRESSION_STEPS, PEAK_RATE))
        shared = shared + step
    return np.concatenate([shared, theta[parameters.n_shared :]])
