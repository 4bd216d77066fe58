"""`event`: something that happens at a time, or when a condition becomes true, and sets states."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Assignment, Expression, Text
from gbspec.syntax.statements.base import Entry, Formula, Named, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class EventStatement(Named, Formula):
    """`event off when T >= high: on = 0`, or `event feed at t1 every 24 until t2: S = S + 5`."""

    entry = Entry(
        word="event",
        meaning="sets states when a condition becomes true, or at given times; right sides see the values before",
        example="event off when T >= high: on = 0",
        title="events",
        symbol="Event",
        kind=Kind.EVENT,
        role="event",
        reserved=False,
    )
    assignments: tuple[Assignment, ...]
    condition: Expression | None = None
    at: Expression | None = None
    every: Expression | None = None
    until: Expression | None = None
    after: Expression | None = None
    queue: Expression | None = None
    priority: Expression | None = None
    transient: bool = False
    sampled: bool = False
    armed: bool = False
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `event NAME`, its clauses and its assignments."""
        found = reader.gather(children, "an event")
        name = reader.declared(children[1])
        timed = [word for word in ("at", "every", "until") if word in found]
        if "when" not in found and not {"at", "every"} & found.keys():
            reader.problem(
                "GB345",
                f"the event `{name.text}` does not say when it happens",
                name.span,
                help=f"write `event {name.text} when CONDITION: …`, or `event {name.text} at TIME: …`",
            )
        elif "when" in found and timed:
            reader.problem(
                "GB345",
                f"the event `{name.text}` has both `when` and `{timed[0]}`",
                name.span,
                help="write two events: one for the condition, one for the times",
            )
        for word in ("after", "queue", "transient", "sampled", "armed"):
            if word in found and timed:
                reader.problem(
                    "GB345",
                    f"`{word}` is for an event with a condition, and `{name.text}` happens at given times",
                    name.span,
                    help=f"leave out `{word}`" + ("; add the delay to the time" if word == "after" else ""),
                )
        return cls(
            reader.over(children),
            name,
            found.get("assignments", ()),
            found.get("when"),
            found.get("at"),
            found.get("every"),
            found.get("until"),
            found.get("after"),
            found.get("queue"),
            found.get("priority"),
            "transient" in found,
            "sampled" in found,
            "armed" in found,
            found.get("text"),
        )

    def places(self) -> Iterator[Place]:
        """The condition, the times, and the right sides."""
        if self.condition is not None:
            yield Place(self.condition, rules.ANY)
        for time in (self.at, self.every, self.until):
            if time is not None:
                yield Place(time, rules.TIMING)
        if self.queue is not None:
            yield Place(self.queue, rules.CONSTANT)
        for value in (self.after, self.priority):
            if value is not None:
                yield Place(value, rules.ANY)
        for assignment in self.assignments:
            yield Place(assignment.value, rules.ANY)
