"""What a finished fit says of its splines: which are too coarse for their data.

A spline that cannot follow its function has bands that contain the noise, but not what lies between the spline and the
function. Whether the data tell more than the spline can follow is tested by scores: of the additional coefficients
that half the distance of the knots would have, at the vector of the fit, without fitting them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import prod

import numpy as np
from scipy.stats import f as fisher

from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.diagnostics import Findings
from gbspec.ir import Model, Network
from gbspec.passes import with_contracts
from gbspec.training.optimise import lack_of_fit
from gbspec.training.problem import Integers, Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.summary import whole_solutions

SURE = 0.01
"""A spline is called too coarse where chance would give such scores in fewer fits than this."""
MOST = 60
"""The largest number of a spline's coefficients."""


def said_of_splines(context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]) -> list[str]:
    """A sentence for each spline of which the data tell more than it can follow; none with disturbances, whose
    likelihood is not that of residuals."""
    if context.model.diffusions:
        return []
    said, blend = [], 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
    for index, network in enumerate(context.model.networks):
        if network.spline and max(network.spline) > 4:
            found = _tested(context, parameters, theta, stages, blend, index)
            said += [] if found is None else [_sentence(network, found)]
    return said


def _tested(
    context: Context, parameters: Parameters, theta: Array, stages: Sequence[str], blend: float, index: int
) -> float | None:
    """The fraction of the sum of squares that twice the coefficients would remove; None if chance would too."""
    model = _finer(context.model, index)
    module = load_module(model, context.method)
    weights, extra = _weights(parameters, theta, model, index)
    finer = replace(
        context, model=model, module=module(weights), cutting=False, choice=context.choice.of_model(model, module)
    )
    fixed = {name: weights[name] for name in parameters.fixed}
    layout = replace(parameters, model=model, fixed=fixed)
    wide = np.concatenate([layout.vector(weights)[: layout.n_weights], theta[parameters.n_weights :]])
    engine = finer.engine(layout, blend, step_fraction(stages))
    splines = [_places(layout, one) for one in model.networks if one.spline]
    tested = _places(layout, model.networks[index])[extra]
    score = lack_of_fit(engine, wide, tested, np.setdiff1d(np.concatenate(splines), tested))
    if score is None or not min(score[1:]) >= 1:
        return None
    gain, numerator, denominator = score
    ratio = gain / numerator / max((1 - gain) / denominator, 1e-300)
    return gain if fisher.sf(ratio, numerator, denominator) < SURE else None


def _finer(model: Model, index: int) -> Model:
    """The model in which a spline has in addition what half the distance of its knots would add."""
    networks = list(model.networks)
    networks[index] = replace(networks[index], between=True, layout=None, smooth=())
    unknowns = [replace(one, form=None) if one.network == index else one for one in model.unknowns]
    return with_contracts(replace(model, networks=tuple(networks), unknowns=tuple(unknowns)), Findings())


def _weights(parameters: Parameters, theta: Array, model: Model, index: int) -> tuple[dict[str, Array], Integers]:
    """All arrays of the finer model with the same functions, and which of the spline's biases are additional."""
    network, weights = model.networks[index], parameters.natural(theta)
    size, extra = network.sizes[-1], np.array(network.extra, dtype=np.int64)
    kept = np.setdiff1d(np.arange(size), extra)
    for array in ("0.weight", "0.bias", "output_scale", "output_center"):
        name = f"network.{network.name}.{array}"
        given = weights[name]
        weights[name] = np.full((size, *given.shape[1:]), float(array == "output_scale"))
        weights[name][kept] = given
    return weights, extra


def _places(parameters: Parameters, network: Network) -> Integers:
    """Where the trainable vector has the biases of a spline."""
    position, name = 0, f"network.{network.name}.0.bias"
    for array, shape in parameters.weight_shapes.items():
        if array == name:
            return position + np.arange(prod(shape))
        position += prod(shape)
    raise KeyError(network.name)


def _sentence(network: Network, gain: float) -> str:
    names = ", ".join(f"`{name}`" for name in network.outputs)
    finer = tuple(min(2 * size - 3, MOST) for size in network.spline)
    written = ", ".join(map(str, finer))
    remedy = f"write `by spline({written})`" if finer != network.spline else "write `by mlp(16, 16)` instead"
    return (
        f"the spline of {names} is too coarse: twice its coefficients would remove {100 * gain:.2g} % of the sum of "
        f"squared residuals, more than chance does; its band contains the noise, not this error. What helps: {remedy}, "
        "or a narrower range of its argument"
    )
