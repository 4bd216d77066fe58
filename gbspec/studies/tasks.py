"""What a study has to do: which cases were meant, with which settings, and one task for each member of each.

The order is by member first: every case has its first fit before any has its second, so that a table of an unfinished
study is fair to all of them.
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
from gbspec.json_values import JsonObject
from gbspec.studies.options import StudyOptions
from gbspec.training import TrainOptions

SET_BY_THE_STUDY = ("members", "seed", "workers", "threads", "scheduler", "resume")
"""Options of training that a case cannot have, since the study gives them."""


@dataclass(frozen=True)
class Study:
    """Chosen cases in order, each with how many members it has and the options that they are trained with."""

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
    """One fit of one case. `seed` is that of its data and of its weights."""

    case: Case
    member: int
    seed: int
    training: TrainOptions

    @property
    def name(self) -> str:
        """As it is called in messages."""
        return f"{self.case.name} member {self.member}"

    @property
    def settings(self) -> str:
        """A fingerprint of everything that the result depends on but the seed and gbspec itself.

        Raises UserError where the model is wrong.
        """
        from gbspec import frontend

        sampling, metrics = (dataclasses.asdict(part) for part in (self.case.sampling, self.case.metrics))
        training = self.training.settings(SET_BY_THE_STUDY)
        sampling.pop("seed")
        source = frontend.load_model(str(self.case.model), Findings()).text.encode()  # what it extends is in there
        data = self.case.data.read_bytes() if self.case.data else b""
        parts = [hashlib.sha256(source).hexdigest(), hashlib.sha256(data).hexdigest(), sampling, metrics, training]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def study_of(texts: Sequence[str], options: StudyOptions) -> Study:
    """The study that the arguments of `gbspec study` mean.

    Raises UserError: GB801 where there are no such cases, GB743 where a case is not among them, GB741 and GB742 where a
    case's training is not what `gbspec train` knows.
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
    """The cases named by `FILE`, `FOLDER` or `FILE:CASE,CASE` texts, and among them those of `--case`."""
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
    """The cases of a file that are meant where none is named; all of them where `--case` will name some."""
    return [case for case in cases if names or case.training.members]


def cases_file(text: str) -> Path:
    """The `cases.toml` meant: a file, a folder that has one, or the name of a folder of shipped models."""
    for path in (Path(text), Path(text) / FILE, models_folder() / text / FILE):
        if path.is_file():
            return path
    known = sorted(path.parent.name for path in models_folder().glob(f"*/{FILE}"))
    meant = similar(text, known)
    advice = f"is `{meant}` meant?" if meant else f"name a `cases.toml`, or one of {', '.join(known)}"
    raise UserError([Diagnostic("GB801", f"there are no cases `{text}`", None, help=advice)])


def _training(case: Case, options: StudyOptions, findings: Findings) -> TrainOptions:
    """How the members of a case are trained; what is wrong with that goes into `findings`."""
    place = Cell(str(case.model.parent / FILE)) if case.model else None

    def report(code: str, key: str, what: str) -> None:
        findings.error(code, f"`case.{case.name}.training.{key}` {what}", place)

    given: JsonObject = {"effort": options.effort or case.training.effort, **case.training.more}
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
