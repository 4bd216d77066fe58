"""The loss and the learned constants over the time of training."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gbspec.report import collect
from gbspec.report.content import History
from gbspec.report.description import Axis, Block, Figure, Line, Mark, Panel, Points, Row, Span, Text
from gbspec.report.source import MissingError, Source
from gbspec.report.style import MEMBERS


def build(source: Source) -> Figure:
    """The history of every member."""
    members = collect.history(source.run)
    if not members:
        raise MissingError("the run has no `history.csv`", "fit")
    return figure(members)


def figure(members: Sequence[History]) -> Figure:
    """The loss, in each stage by itself since every stage has its own, and below it each constant; every other stage of
    the first member is shaded."""
    grounds, words = _stages(members[0])
    time = Axis("time of training", "s")
    loss = Panel((*grounds, *words, *_losses(members)), time, Axis("loss", log=True), "",
                 legend=True, width=6.4, height=2.6)  # fmt: skip
    constants = [
        Panel((*grounds, *_curves(members, name)), time, Axis(name), width=6.4, height=1.25)
        for name in members[0].constants
    ]
    return Figure(((Block(tuple(Row((panel,)) for panel in (loss, *constants)), shared="column"),),))


def _losses(members: Sequence[History]) -> list[Mark]:
    """The loss of each member with a gap between stages; of a stage with one value a point."""
    marks: list[Mark] = []
    for k, member in enumerate(members):
        label, color = f"member {member.member}", MEMBERS[k % len(MEMBERS)]
        gaps = _starts(member)[1:]
        seconds, loss = (np.insert(each, gaps, np.nan) for each in (member.seconds, member.loss))
        hover = [stage for i, stage in enumerate(member.stage) for stage in ("", stage)[(i not in gaps) :]]
        marks.append(Line(seconds, loss, label, color, 1.3, hover=tuple(hover)))
        alone = [a for a, b in pairwise([*_starts(member), len(member.stage)]) if b == a + 1]
        if alone:
            names = tuple(member.stage[i] for i in alone)
            marks.append(Points(member.seconds[alone], member.loss[alone], label, color, 2.6, hover=names))
    return marks


def _curves(members: Sequence[History], name: str) -> list[Mark]:
    """A constant of each member."""
    return [
        Line(m.seconds, m.constants[name], f"member {m.member}", MEMBERS[k % len(MEMBERS)], 1.3, hover=m.stage)
        for k, m in enumerate(members)
    ]


def _starts(member: History) -> list[int]:
    """Where each stage begins."""
    stage = member.stage
    return [i for i in range(len(stage)) if i == 0 or stage[i] != stage[i - 1]]


def _stages(member: History) -> tuple[list[Span], list[Text]]:
    """A background for every other stage of a member, and the names of stages that are long enough for them."""
    if not member.stage:
        return [], []
    stage, seconds = member.stage, member.seconds
    starts = _starts(member)
    total = float(seconds[-1] - seconds[0]) or 1.0
    grounds, words = [], []
    for k, (first, last) in enumerate(pairwise([*starts, len(stage) - 1])):
        left, right = float(seconds[first]), float(seconds[last])
        if k % 2:
            grounds.append(Span("x", left, right, color="#f2f4f7"))
        if (right - left) / total > 0.013 * len(stage[first]):
            words.append(Text((left + right) / 2, stage[first]))
    return grounds, words
