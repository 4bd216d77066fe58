"""The recipe of models with random disturbances: after the warm start, the likelihood of innovations."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import Trajectories, unstated
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import METHODS, Model, RosenbrockW, noise_form
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.optimise import InnovationsFit, OtherInnovations, OtherMaxima, Stage
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Parameters, teacher_forcing
from gbspec.training.recipe.context import Context, start_states, without_steps
from gbspec.training.recipe.planned import Planned, Reached
from gbspec.training.recipe.stiffness import solver_of
from gbspec.training.stages import StageName
from gbspec.training.starts import fit_curves


def check_disturbed(model: Model, options: TrainOptions) -> None:
    """Raises UserError for options that a model with disturbances (GB770) or delays (GB768) cannot have."""
    found = []
    stiff = options.tolerance is not None or isinstance(METHODS.get(solver_of(options)), RosenbrockW)
    if stiff and model.delays:
        message = "adaptive steps and stiff solvers are not offered yet for a model with delays: their steps are fixed"
        help = "leave out `--solver` and `--tolerance`; `--max-step` gives a shorter step"
        found.append(Diagnostic("GB768", message, None, help=help))
    if not model.diffusions:
        if found:
            raise UserError(found)
        return
    if options.method != "auto":
        message = f"`--method {options.method}` is not for a model with `diffusion`: only the likelihood is maximised"
        found.append(Diagnostic("GB770", message, None, help="leave it out"))
    if options.forcing != "teacher":
        message = f"`--forcing {options.forcing}` is not for a model with `diffusion`: no measurement resets a state"
        found.append(Diagnostic("GB770", message, None, help="leave it out"))
    if found:
        raise UserError(found)


def said_of_step(model: Model, options: TrainOptions) -> list[str]:
    """A remark for a step that changes nothing."""
    if options.max_step is None or not without_steps(model):
        return []
    return [
        f"`--max-step {options.max_step:g}` changes nothing: the model is linear in its states, and what disturbs them "
        "follows exactly from row to row"
    ]


def check_limits(model: Model, data: Trajectories) -> list[str]:
    """A remark for channels with limits whose noise is not known. Raises UserError for limits of a model with
    disturbances (GB784), or under a noise with a density of its own (GB785)."""
    limited = np.zeros(len(model.channels), dtype=bool)
    for item in data.items:
        limited |= (item.censored.side != 0).any(axis=0)
    if model.diffusions and limited.any():
        name = model.channels[int(np.argmax(limited))].name
        message = f"`{name}` has censored values, which are not offered together with `diffusion`"
        help = "leave these cells empty, or leave out the diffusions"
        raise UserError([Diagnostic("GB784", message, None, help=help)])
    for i, channel in enumerate(model.channels):
        form = noise_form(channel)
        if limited[i] and form is not None and form.density:
            message = f"`{channel.name}` has censored values, which are not offered together with `noise {form.kind}`"
            help = "write `noise normal(…)`, or leave these cells empty"
            raise UserError([Diagnostic("GB785", message, channel.span, help=help)])
    unknown = limited & unstated(model, data) & np.array([c.noise is None for c in model.channels], dtype=bool)
    names = ", ".join(f"`{model.channels[int(i)].name}`" for i in np.flatnonzero(unknown))
    if not names:
        return []
    return [
        f"the noise of {names} is not stated, so that censored values are bounds of predictions until it is estimated: "
        "state it (`noise normal(0.05)`), or learn it (`learn s = 0.1 > 0`, `noise normal(s)`), and they contribute "
        "their probability"
    ]


def disturbed_stage(context: Context, parameters: Parameters, total: int) -> Planned:
    """The one stage that fits a model with disturbances."""

    def make(reached: Reached) -> Stage:
        module = context.module
        declared = parameters.vector(module.weights)
        declared[: parameters.n_weights] = reached.theta[: parameters.n_weights]
        ridge = context.options.ridge
        return InnovationsFit(StageName.INNOVATIONS, total, lambda: filter_of(context, parameters), [declared], ridge)

    return Planned(StageName.INNOVATIONS, total, make)


def other_maxima(context: Context, parameters: Parameters, total: int) -> Planned:
    """The search for other maxima of a known form, where constants exchange their roles."""

    def made(reached: Reached) -> OtherMaxima:
        fit = InnovationsFit(
            StageName.INNOVATIONS, total, lambda: filter_of(context, parameters), [], context.options.ridge
        )
        vector = partial(whole_vector, context, fit.engine)
        of = OtherInnovations(fit, vector, lambda: FilterEngine.of(context.problem(0.0, 0.5), parameters))
        return OtherMaxima(StageName.OTHER_MAXIMA, total, of, reached.iterations.get(StageName.INNOVATIONS, 0))

    def possible(reached: Reached) -> bool:
        return not parameters.n_weights and reached.maximum and made(reached).possible(reached.theta)

    return Planned(StageName.OTHER_MAXIMA, total, made, possible=possible)


def filter_of(context: Context, parameters: Parameters) -> FilterEngine:
    """The filter of the training data."""
    return FilterEngine.of(context.problem(0.0), parameters)


def whole_vector(context: Context, engine: FilterEngine, theta: Array) -> Array:
    """The vector of the likelihood: the trainable one, and the noises as they are known so far."""
    log_sd = engine.noise.first()
    if context.estimated is not None:
        known = context.estimated.noise[engine.noise.learned]
        log_sd = np.where(np.isfinite(known) & (known > 0), np.log(np.where(known > 0, known, 1.0)), log_sd)
    return np.concatenate([theta, log_sd])


def held_out_filter(context: Context, parameters: Parameters, theta: Array) -> tuple[FilterEngine, Filtered, Mask]:
    """The filter of the held-out data, and which of its values [R, C] are held out: of a single trajectory, which it
    runs through from the start, those of the last rows alone."""
    held, model = context.held, context.model
    packed = context.pack(held)
    problem = context.posed(packed, teacher_forcing(model, packed, 0.0))
    value, free = start_states(model, held, fit_curves(model, held), packed)
    local = replace(parameters, start_value=value, start_free=free)
    own = theta[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
    block = np.tile(own.mean(axis=0), (len(held), 1))
    vector = np.concatenate([theta[: parameters.n_shared], block.ravel()])
    engine = FilterEngine.of(problem, local)
    return engine, engine.filtered(whole_vector(context, engine, vector)), _held_out(context, engine)


def _held_out(context: Context, engine: FilterEngine) -> Mask:
    counted, held = engine.problem.valued, context.held
    if len(held) == 1 and held.items[0].label == context.trajectories.items[0].label:
        later = engine.problem.packed.row_time > context.trajectories.items[0].end
        counted = counted & later[:, None]
    return counted


def held_out_likelihood(context: Context, parameters: Parameters, theta: Array) -> float:
    """The negative log likelihood of the held-out values, over their number."""
    _, found, counted = held_out_filter(context, parameters, theta)
    if not found.finite:
        return float("inf")
    error, variance = found.error[counted], found.variance[counted]
    return float(0.5 * np.mean(error**2 / variance + np.log(2 * np.pi * variance))) if counted.any() else 0.0
