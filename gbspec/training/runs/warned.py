"""The warnings of a fit, in the order in which they matter."""

from __future__ import annotations

import numpy as np

from gbspec.ir import Model
from gbspec.runs import last_search
from gbspec.training.options import TrainOptions
from gbspec.training.runs import verdict
from gbspec.training.runs.ended_early import without_whole
from gbspec.training.runs.minima import found_once, said_of_minima
from gbspec.training.runs.outlying import said_of_outlying
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.unused import said_of_unused
from gbspec.training.stages import most_iterations


def warnings_of(results: dict[int, MemberResult], options: TrainOptions, model: Model | None = None) -> list[str]:
    """Warnings that a user must know before relying on the fit: what concerns whole fits, then residuals and states,
    then single constants."""
    whole, parts, single = [], [], []
    missing = options.members - len(results)
    if missing > 0:
        whole.append(f"{missing} of {options.members} members {'was' if missing == 1 else 'were'} not fitted")
    for member, result in sorted(results.items()):
        if not result.finished:
            whole.append(f"member {member}: training was interrupted; `--resume` continues it")
        blown = [verdict.blown_up(result.failed)] if result.failed else []
        followed = verdict.verdicts(result.channels, model, result.bounded)
        whole += [f"member {member}: {text}" for text in (*blown, *followed, *result.left, *result.notes)]
        left = [*verdict.lacking(result.channels), *_of_residuals(result, options, model)]
        if model is not None:
            left += verdict.above_stated(result.noise, model, result.tabled, last_search(result.stages))
            left += verdict.below_stated(result.noise, model, result.channels, result.freedom, result.tabled)
        parts += [f"member {member}: {text}" for text in (*left, *result.beyond)]
        single += [f"member {member}: {text}" for text in result.tied]
    if model is not None:
        single += said_of_unused(options, model, {one.name for result in results.values() for one in result.stages})
    return [*whole, *said_of_minima(results), *found_once(results, options.effort, model), *parts, *single]


def _of_residuals(result: MemberResult, options: TrainOptions, model: Model | None) -> list[str]:
    """What is said of outliers and autocorrelated residuals, also of a fit without intervals, since it did not rest."""
    far = said_of_outlying(result.channels, result.outlying, model, result.rmse)
    if result.likelihood is not None:
        return [*far, *verdict.innovations(result.channels or {}, result.likelihood, model, result.rmse)]
    own = {k.name for k in model.learnables if k.per_trajectory} if model is not None else set()
    shared = {name: sd for name, sd in result.sd.items() if name not in own}
    each = np.array(list(shared.values()), dtype=np.float64)
    deviations = each if shared else result.own_sd
    told = result.bounded | result.tied_to_bounds  # by themselves, with the reason why they have no interval
    told_own = result.misjudged_own | result.bounded_own
    explained = shared.keys() <= told if shared else len(told_own) == result.own_sd.size
    at_rest = result.misjudged or result.misjudged_own or explained or without_whole(result.notes)
    if not deviations.size or np.isfinite(deviations).any() or at_rest:
        # A standard deviation of zero is that of a constant at a bound, which has no interval either.
        every = np.concatenate([each, np.ravel(result.own_sd)])
        certain = model is None or bool(model.networks) or bool((np.isfinite(every) & (every > 0)).any())
        return [*far, *verdict.autocorrelations(result.channels, model, result.rmse, certain, result.noise)]
    if model is not None and model.marginal:
        return []
    if not result.finished:  # that is said by itself
        return far
    ended = ""
    for stage in result.stages:  # what the last stage of several iterations says
        most = most_iterations(stage.name, options.effort)
        if most > 1:
            ended = f" (`{stage.name}` ended after its {most} iterations)" if stage.iterations == most else ""
    return [*far, *verdict.unrested(result.channels, ended, model, bool(result.bounded))]
