"""One member of a run: runs the stages, writes checkpoints and history, and always ends with usable weights."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.data import Estimated, Trajectories, beginnings, fingerprint
from gbspec.diagnostics import ComputationError
from gbspec.files import aside, finite
from gbspec.ir import Model
from gbspec.runs import COVARIANCE, StageRecord, Summary, files, sealed
from gbspec.training.optimise import Certainty, InnovationsFit, LevenbergMarquardt, OtherMaxima, Outcome, Stage
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Parameters
from gbspec.training.progress import Progress, Update
from gbspec.training.recipe import (
    Context,
    Planned,
    Reached,
    held_out_score,
    left_for_intervals,
    plan,
    recognition,
    said_of_switches,
    step_fraction,
)
from gbspec.training.runs.beginning import as_left, beginning
from gbspec.training.runs.coarseness import said_of_splines
from gbspec.training.runs.deviations import deviations_of_kept, said_of_left, take_deviations
from gbspec.training.runs.disturbed import certainties, steps_of, summarise
from gbspec.training.runs.ended_early import NO_FIT, NO_FITS, said_of_end, said_of_no_maximum, without_whole
from gbspec.training.runs.happening import said_of_events
from gbspec.training.runs.maximum import noise_before, note_end, return_to_maximum
from gbspec.training.runs.pace import seconds_left
from gbspec.training.runs.past import said_of_past
from gbspec.training.runs.populations import with_population
from gbspec.training.runs.position import Position, checkpoint, write_position
from gbspec.training.runs.signals import uninterrupted
from gbspec.training.runs.steady import unsteady
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.tied import HELPS, without_loosened
from gbspec.training.runs.uncertain import take_uncertain
from gbspec.training.runs.verdict import interval_factor
from gbspec.training.stages import MAYBE, StageName

SAVE_EVERY = 5.0
"""Seconds between saved states within a stage; one is also written at every stage's end and on interruption."""
SAVING_SHARE = 0.05
"""The share of the time that saving may take where it is slow: the whole solution is computed each time."""

TIGHT = 1e-3
"""Stages whose tolerance is at most this are expected to converge; the size of the next step is the criterion."""


def fit_member(
    model: Model,
    module: type[GeneratedModule],
    trajectories: Trajectories,
    options: TrainOptions,
    member: int,
    directory: Path,
    progress: Progress,
    stop: Callable[[], bool] = lambda: False,
) -> MemberResult:
    """Fits one member and writes its weights and checkpoints under `directory` (members/K).

    Raises ComputationError if the estimation fails (the member then has no weights), and Interrupted, after writing the
    current weights, when the process is asked to end or `stop()`, which is called after every iteration, returns True.
    """
    torch.manual_seed(options.seed + member)
    seed = options.seed + member
    kept = checkpoint(directory) if options.resume else None
    began = time.monotonic()
    with uninterrupted() as interrupted:
        begun = beginning(
            model, module, trajectories, options, seed, kept, lambda text: progress.message(f"member {member}: {text}")
        )
        runner = _Runner(*begun, member, directory, progress)
        if kept is None:
            runner.record_preparation(time.monotonic() - began)
            runner.save()
        if runner.context.choice.remark and member == 0:
            progress.message(runner.context.choice.remark)
        try:
            return runner.run(lambda: interrupted() or stop())
        except ComputationError:
            (directory / files.WEIGHTS).unlink(missing_ok=True)  # those saved on the way belong to no result
            raise


class Interrupted(KeyboardInterrupt):
    """Raised instead of KeyboardInterrupt once a member's files are written; `result` is its intermediate result."""

    def __init__(self, result: MemberResult) -> None:
        self.result = result
        super().__init__("interrupted")


def _fit(stage: Stage) -> Stage:
    """The fit that a stage continues, or the stage itself."""
    return stage.fit if isinstance(stage, OtherMaxima) else stage


class _Runner:
    def __init__(
        self,
        context: Context,
        parameters: Parameters,
        position: Position,
        member: int,
        directory: Path,
        progress: Progress,
    ) -> None:
        self.context, self.member = context, member
        self.directory, self.progress = directory, progress
        self.position = position
        as_left(context, position)
        self.plan = plan(context, parameters)
        # Stages that keep measured initial values leave their entries at zero, which represents the measured value.
        self.parameters = context.parameters(parameters.fixed, released=True)
        self._began = time.monotonic() - self.position.seconds
        self._saved, self._saving = time.monotonic(), 0.0

    # ---------------------------------------------------------------- running
    def record_preparation(self, seconds: float) -> None:
        """Records the warm start in the history, as if it were a stage."""
        position = self.position
        position.seconds = seconds
        self._began = time.monotonic() - seconds
        name = StageName.WARM_START.value if self.context.options.warm_start else "start"
        position.marks[StageName.WARM_START] = position.theta
        constants = self._constants(position.theta)
        position.history.append((name, 1, seconds, position.loss, constants))
        position.stages.append(StageRecord(name, 1, position.loss, seconds))
        names = [k.name for k in self.parameters.model.learnables]
        self.progress.update(
            Update(self.member, name, 1, 1, position.loss, seconds, None, dict(zip(names, constants, strict=True)))
        )

    def run(self, stop: Callable[[], bool]) -> MemberResult:
        """Runs all stages from the present position on; `stop` is called after every iteration."""
        position = self.position
        if position.finished:
            return self._result()
        try:
            while position.stage < len(self.plan):
                if stop():
                    raise KeyboardInterrupt
                begun = self._run_stage(self.plan[position.stage], stop)
                position.stage, position.iteration, position.state = position.stage + 1, 0, {}
                if begun:
                    self.save()
        except KeyboardInterrupt:
            raise Interrupted(self.save()) from None
        position.finished = True
        return self.save()

    def _run_stage(self, planned: Planned, stop: Callable[[], bool]) -> bool:
        """Whether the stage was due. One that was not leaves nothing to save: a resumed run decides the same again."""
        position = self.position
        # A stage that goes on is the last of the records: it is made again from those before it, as at its beginning.
        before = position.stages[:-1] if position.iteration else position.stages
        begun, weights = [stage.name for stage in before], self.context.estimated
        if position.iteration == 0:
            if not planned.due(self._reached(position.theta, begun)):
                note = f"the stage `{planned.name}` was requested, but had nothing to do"
                if self.context.options.named_stages and planned.name not in begun and note not in position.notes:
                    position.notes.append(note)
                return False
            position.entry, position.entry_ridge = position.theta, position.ridge
            if planned.weigh is not None:
                self._weigh(planned.weigh(self._reached(position.theta, begun)))
        stage, at_end = planned.make(self._reached(position.entry, begun)), False
        try:
            if position.iteration == 0:
                position.state = stage.begin(position.theta)
                position.stages.append(StageRecord(stage.name, 0, None, 0.0))
            elif not position.state:
                position.state = stage.begin(position.theta)
            self.context.cutting = self.context.cutting or planned.name is StageName.CUT
            unfinished = self._take_steps(stage, stop)
            note_end(position, planned.name, unfinished)
            at_end = unfinished is None
        except ComputationError as error:
            position.notes.append(self._after_failure(planned, error))
            marginal = self.context.model.marginal
            if position.iteration and position.maximum and (marginal or isinstance(stage, OtherMaxima)):
                self._weigh(noise_before(stage, position))
                return_to_maximum(position, self._held_out if self._choosing else None)
                return True
            if position.iteration == 0:
                del position.stages[len(begun) :]
                if without_whole(position.notes):
                    position.certainty = Certainty(freedom=position.certainty.freedom)
                self.context.cutting = self.context.cutting and planned.name is not StageName.CUT
                self._weigh(weights)
                return True
        position.marks[planned.name] = position.theta
        self._take_certainty(stage, at_end)
        return True

    def _reached(self, theta: Array, begun: list[str]) -> Reached:
        position = self.position
        taken = {stage.name: stage.iterations for stage in position.stages}
        return Reached(theta, position.marks, begun, position.ridge, position.damping, taken, position.maximum)

    def _after_failure(self, planned: Planned, error: ComputationError) -> str:
        """What is said of a stage that failed. Raises its error if there is no fit to keep and no remedy follows."""
        position = self.position
        if set(position.marks) - NO_FITS:
            marginal, begun = self.context.model.marginal, position.iteration > 0
            return said_of_end(planned.name, error, marginal, position.maximum, begun)
        if not any(later.name is StageName.HORIZONS for later in self.plan[position.stage + 1 :]):
            raise error
        if position.iteration:  # what blew up on the way is no better a start than the one before
            position.theta = position.entry
        fits = (later.name for later in self.plan[position.stage + 1 :] if later.name not in NO_FITS)
        segments = next(fits) is StageName.HORIZONS
        instead = "segments of the trajectories are tried instead" if segments else "the next one begins where it began"
        said = f"the stage `{planned.name}` failed: {error.what}; {instead}"
        self.progress.message(f"member {self.member}: {said}")
        return said

    def _weigh(self, noise: Estimated | None) -> None:
        """Weighs channels by this noise from now on; the best vector so far is scored again, with the same weights."""
        position = self.position
        if noise is self.context.estimated:
            return
        self.context.estimated = position.estimated = noise
        if self._choosing:
            position.best_score = self._held_out(position.best, [stage.name for stage in self.position.fitted_stages])

    @property
    def _choosing(self) -> bool:
        """Whether held-out data choose the vector that is kept: of networks alone, which may go on to fit noise."""
        return bool(len(self.context.held) and self.parameters.n_weights)

    def _held_out(self, theta: Array, begun: list[str]) -> float:
        """The score of a vector after the stages that have begun, by the held-out data."""
        return held_out_score(self.context, self.parameters, theta, step_fraction(begun))

    def _take_steps(self, stage: Stage, stop: Callable[[], bool]) -> ComputationError | None:
        """The steps of a stage that remain; returns why its end is no maximum of a likelihood, if that is so. Raises
        ComputationError if a step is impossible."""
        position = self.position
        began = time.monotonic() - position.stages[-1].seconds
        while position.iteration < stage.total:
            outcome = stage.step(position.state, position.iteration)
            self._record(stage, outcome, time.monotonic() - began)
            if outcome.done or outcome.unfinished is not None:
                return outcome.unfinished
            if stop():
                raise KeyboardInterrupt
            if time.monotonic() - self._saved > max(SAVE_EVERY, self._saving / SAVING_SHARE):
                self.save()
        return None

    def _take_certainty(self, stage: Stage, at_end: bool) -> None:
        """Keeps the standard deviations of the last stage that has any; a change of the vector invalidates them. There
        are none of a likelihood that did not come to its end (`at_end`), and none of a fit of intervals that was kept
        in place of one of whole solutions."""
        position, fit = self.position, _fit(stage)
        of_intervals = left_for_intervals(position.marks) is not None or without_whole(position.notes)
        if of_intervals or (isinstance(fit, InnovationsFit) and not at_end):
            position.certainty = Certainty(freedom=position.certainty.freedom)
        elif isinstance(fit, InnovationsFit) and (fit is stage or not np.array_equal(position.theta, position.entry)):
            position.certainty, said = without_loosened(fit.certainty(position.state), self.parameters)
            # What was said at another maximum is no longer true.
            position.notes = [note for note in position.notes if not note.endswith(HELPS)] + said
        elif isinstance(stage, LevenbergMarquardt):
            # For a stage that may end while the loss still falls by a few percent the curvature is not meaningful.
            known = stage.options.tolerance <= TIGHT
            position.certainty = stage.certainty(position.state) if known else Certainty()
        elif not np.array_equal(position.theta, position.entry):
            position.certainty = Certainty(freedom=position.certainty.freedom)

    def _record(self, stage: Stage, outcome: Outcome, stage_seconds: float) -> None:
        position = self.position
        position.state, position.theta, position.loss = outcome.state, outcome.state["theta"], outcome.loss
        position.ridge = float(outcome.state.get("ridge", np.array(position.ridge)))
        position.damping = float(outcome.state.get("damping", np.array(position.damping)))
        position.iteration += 1
        fit = _fit(stage)
        if isinstance(fit, InnovationsFit):
            self.context.estimated = position.estimated = fit.estimated(position.state)
        if outcome.note:
            position.notes.append(outcome.note)
        position.seconds = time.monotonic() - self._began
        constants = self._constants(position.theta)
        position.history.append((stage.name, position.iteration, position.seconds, outcome.loss, constants))
        position.stages[-1] = StageRecord(
            stage.name, position.iteration, outcome.loss, stage_seconds, outcome.remark or None, outcome.search
        )
        self._score()
        names = [one.name for one in self.parameters.model.learnables]
        self.progress.update(
            Update(
                self.member,
                stage.name,
                position.iteration,
                stage.total,
                outcome.loss,
                position.seconds,
                self._seconds_left(stage),
                dict(zip(names, constants, strict=True)),
                outcome.remark,
            )
        )

    def _score(self) -> None:
        """Keeps the vector that best predicts held-out data; the last one without these, or without a network to stop.
        Pooled stages before a likelihood have not estimated its spreads and noises yet."""
        position, score = self.position, self.position.loss
        if self._choosing:
            names = [stage.name for stage in position.stages]
            pooled = self.context.model.marginal and StageName.MARGINAL not in names
            score = math.inf if pooled else self._held_out(position.theta, names)
            if not score <= position.best_score:
                return
        position.best, position.best_score, position.best_stages = position.theta, score, len(position.stages)
        position.held = self._choosing  # until the stage comes to its end there

    def _constants(self, theta: Array) -> tuple[float, ...]:
        """Learned constants, in natural units; of those per trajectory the mean, or their distribution's median."""
        values = self.parameters.constants(torch.from_numpy(theta)).numpy()
        known = len(self.parameters.model.constants)
        if not len(values):
            return ()
        medians, found = self.parameters.medians(theta), values[:, known:].mean(axis=0)
        names = [k.name for k in self.parameters.model.learnables]
        return tuple(medians.get(name, float(x)) for name, x in zip(names, found, strict=True))

    def _seconds_left(self, stage: Stage) -> float | None:
        position, totals = self.position, {planned.name.value: planned.total for planned in self.plan}
        later = [p.name.value for p in self.plan[position.stage + 1 :] if p.name not in MAYBE]
        now, functions = position.stages[-1], bool(self.context.model.networks)
        return seconds_left(position.stages[:-1], now, totals | {stage.name: stage.total}, later, functions)

    # ---------------------------------------------------------------- files
    def _result(self) -> MemberResult:
        position = self.position
        freedom = position.certainty.freedom
        fitted = self.position.fitted_stages
        result = summarise(self.context, self.parameters, position.best, freedom, position.seconds, fitted)
        result.stages = list(position.stages)
        more: dict[str, object] = {}
        names, marginal, shared = [stage.name for stage in fitted], self.context.model.marginal, None
        if position.finished and marginal:
            given = self.context, self.parameters, position.best, names, float(position.ridge)
            result, found = with_population(result, *given, position.maximum, position.held)
            result.population, result.objective = found.record, found.objective
            found.tables.write(self.directory)
            more, shared = {"population": found.info}, found.covariance
            result.left += said_of_no_maximum(position.notes, position.maximum, position.held)
        instance = self._write_weights(result, names, more)
        (self.directory / COVARIANCE).unlink(missing_ok=True)
        factor = interval_factor(result.channels, result.likelihood)
        if position.finished:
            result.left += self._unsteady(instance)
            known = certainties(self.context, self.parameters, position.best, names, instance)
            known = replace(known, covariance=shared) if marginal else known.widened(factor)
            if result.likelihood is not None and any(NO_FIT in note for note in position.notes):
                result.likelihood, known = result.likelihood.without_maximum(), replace(known, covariance=None)
            known.write(self.directory)
            result.left += said_of_switches(self.context, self.parameters, position.best, names)
        if position.finished and not marginal:
            result.left += said_of_splines(self.context, self.parameters, position.best, names)
            result.left += said_of_past(self.context, self.parameters, position.best, names, result.channels)
            if self.context.model.events:
                engine = self.context.engine(self.parameters, 0.0, step_fraction(names))
                result.left += said_of_events(engine, position.best, known.covariance)
        result.history, result.notes = list(position.history), list(position.notes)
        take_deviations(result, self.parameters, position.certainty, factor)
        left = left_for_intervals(position.marks)
        if position.finished and left is not None:
            engine = self.context.engine(self.parameters, 0.0, step_fraction(names))
            other = left if StageName.CHOICE in names else None  # with `--holdout` the best one may be from before
            result.sd |= deviations_of_kept(engine, position.best, other, known.covariance)
            result.notes += said_of_left(engine, position.best, other) if other is not None else []
        if position.finished:
            of_fit = self.context, self.parameters, position.best, names
            take_uncertain(result, *of_fit, known).write(self.directory)
        result.finished = position.finished
        return result

    def _write_weights(self, result: MemberResult, names: list[str], more: dict[str, object]) -> GeneratedModule:
        """Writes the weights file, with what it says of the fit; returns the module with these weights. `names` are
        those of the stages that led to the result."""
        position = self.position
        weights = self.parameters.natural(position.best) | {"initial": result.initial}
        if position.finished and self.context.options.initial == "recognition":
            blend = 0.0 if StageName.AUTOREGRESSIVE in position.marks else self.context.options.blend
            weights |= recognition(self.context, self.parameters, position.best, blend)
        info = {
            **steps_of(self.context, self.parameters, position.best, names),
            "solver": self.context.method.name,
            "seed": self.context.seed,
            "labels": result.labels,
            # Learned initial states are looked up by the content of a trajectory, in any table.
            "fingerprints": [fingerprint(item) for item in self.context.trajectories.items],
            "beginnings": beginnings(self.context.trajectories.items),
            "ends": [item.end for item in self.context.trajectories.items],
            **more,
        }
        path = self.directory / files.WEIGHTS
        path.parent.mkdir(parents=True, exist_ok=True)
        with aside(path) as temporary:
            instance = type(self.context.module)(weights, sealed(info, weights, self._summary(result)))
            instance.save(temporary)
        return instance

    def _unsteady(self, instance: GeneratedModule) -> list[str]:
        """What is to be said of trajectories that do not begin in the steady state that the table asks for."""
        with torch.no_grad():
            constants = self.parameters.constants(torch.from_numpy(self.position.best)).numpy()
        return unsteady(instance, self.context.trajectories.items, constants)

    def _summary(self, result: MemberResult) -> Summary:
        """What the weights file says of the fit."""
        known = {name: value for name, value in result.constants.items() if math.isfinite(value)}
        return Summary(
            result.seed,
            finite(result.loss),
            {name: finite(value) for name, value in result.rmse.items()},
            result.seconds,
            tuple(replace(stage, loss=finite(stage.loss)) for stage in result.stages),
            {name: finite(value) for name, value in result.noise.items()},
            known,
            self.position.finished,
        )

    def save(self) -> MemberResult:
        """Writes the checkpoints and the weights, so that whatever ends the process, this state can be used."""
        began = time.monotonic()
        write_position(self.directory, self.position, self.parameters.fixed, self.context.kind)
        result = self._result()
        self._saved = time.monotonic()
        self._saving = self._saved - began
        return result
