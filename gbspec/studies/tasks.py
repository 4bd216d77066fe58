"""The tasks of a study: which cases are selected, with which settings, and one task for each member of each case.

The order is by member first: every case has its first fit before any has its second, so that a table of an unfinished
study treats all cases alike.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gbspec.data import FILE, Case, Cases, load_cases, models_folder, overlay, similar
from gbspec.diagnostics import Cell, Diagnostic, Findings, UserError
from gbspec.studies.options import StudyOptions
from gbspec.training import TrainOptions

SET_BY_THE_STUDY = ("members", "seed", "workers", "threads", "scheduler", "resume")
"""Options of training that a case cannot set, since the study sets them."""


@dataclass(frozen=True)
class Study:
    """The selected cases in order, each with its number of members and the options of their training."""

    cases: tuple[Case, ...]
    members: tuple[int, ...]
    training: tuple[TrainOptions, ...]
    seed: int

    def tasks(self) -> list[Task]:
        """All fits, member by member."""
        return [
            Task(case, member, self.seed + member, training)
            for member in range(max(self.members, default=0))
            for case, count, training in zip(self.cases, self.members, self.training, strict=True)
            if member < count
        ]


@dataclass(frozen=True)
class Task:
    """One fit of one case. `seed` is used for its data and for its weights."""

    case: Case
    member: int
    seed: int
    training: TrainOptions

    @property
    def name(self) -> str:
        """Its name in messages."""
        return f"{self.case.name} member {self.member}"

    @property
    def settings(self) -> str:
        """A fingerprint of everything that the result depends on except the seed and gbspec itself.

        Raises UserError if the model is invalid.
        """
        from gbspec import frontend

        sampling, metrics = (dataclasses.asdict(part) for part in (self.case.sampling, self.case.metrics))
        training = self.training.settings(SET_BY_THE_STUDY)
        sampling.pop("seed")
        source = frontend.load_model(str(self.case.model), Findings()).text.encode()  # with the models it extends
        data = self.case.data.read_bytes() if self.case.data else b""
        parts = [hashlib.sha256(source).hexdigest(), hashlib.sha256(data).hexdigest(), sampling, metrics, training]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def study_of(texts: Sequence[str], options: StudyOptions) -> Study:
    """The study that the arguments of `gbspec study` denote.

    Raises UserError: GB801 if there are no such cases, GB743 if a case is not among them, GB741 and GB742 if a case has
    training options that `gbspec train` does not have.
    """
    options.check()
    chosen = _chosen(texts, options.case)
    findings = Findings()
    changed = tuple(
        replace(case, sampling=replace(case.sampling, noise=options.noise)) if options.noise is not None else case
        for case in chosen
    )
    training = tuple(_training(case, options, findings) for case in changed)
    findings.raise_if_failed()
    members = tuple(options.members or case.training.members or 1 for case in changed)
    return Study(changed, members, training, options.seed)


def _chosen(texts: Sequence[str], names: Sequence[str]) -> tuple[Case, ...]:
    """The cases named by `FILE`, `FOLDER` or `FILE:CASE,CASE` texts, restricted to those of `--case`."""
    chosen: list[Case] = []
    for text in texts:
        place, _, listed = text.partition(":")
        cases = load_cases(cases_file(place))
        wanted = [name for name in listed.split(",") if name]
        chosen += [cases.case(name) for name in wanted] if wanted else _default(cases.cases, names)
    if names:
        pool = Cases(None, Case("", "", None), tuple(chosen))
        chosen = [pool.case(name) for name in names]
    twice = {case.name for i, case in enumerate(chosen) if case.name in {other.name for other in chosen[:i]}}
    if twice:
        message = f"the case `{sorted(twice)[0]}` is named twice"
        raise UserError([Diagnostic("GB820", message, None, help="name it once, or rename one in its `cases.toml`")])
    return tuple(chosen)


def _default(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """The cases of a file if none is named: the default ones, or all of them if `--case` selects among them."""
    return [case for case in cases if names or case.training.members]


def cases_file(text: str) -> Path:
    """The path of the `cases.toml` that a file, a folder, or the name of a folder of bundled models denotes."""
    for path in (Path(text), Path(text) / FILE, models_folder() / text / FILE):
        if path.is_file():
            return path
    known = sorted(path.parent.name for path in models_folder().glob(f"*/{FILE}"))
    meant = similar(text, known)
    advice = f"did you mean `{meant}`?" if meant else f"name a `cases.toml`, or one of {', '.join(known)}"
    raise UserError([Diagnostic("GB801", f"there are no cases `{text}`", None, help=advice)])


def _training(case: Case, options: StudyOptions, findings: Findings) -> TrainOptions:
    """The options with which the members of a case are trained; errors in them are added to `findings`."""
    place = Cell(str(case.model.parent / FILE)) if case.model else None

    def report(code: str, key: str, what: str) -> None:
        findings.error(code, f"`case.{case.name}.training.{key}` {what}", place)

    given: dict[str, object] = {"effort": options.effort or case.training.effort, **case.training.more}
    for name in SET_BY_THE_STUDY:
        if given.pop(name, None) is not None:
            report("GB741", name, "is given by the study, not by a case")
    if case.training.max_step is not None:
        given["max_step"] = case.training.max_step
    made = overlay(TrainOptions(), given, report)
    wrong = Findings()
    made.check(wrong)
    for diagnostic in wrong:
        report("GB742", str(diagnostic.subject), f"is wrong: {diagnostic.message}")
    return made
