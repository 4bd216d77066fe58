"""What is said of new trajectories whose constants differ between groups (`per COLUMN ~ …`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from gbspec.analysis.systems import Individuals

if TYPE_CHECKING:
    from gbspec.analysis.prediction.solutions import Start
    from gbspec.backends import GeneratedModule
    from gbspec.data import Trajectory
    from gbspec.ir import Model

SHOWN = 5
"""So many trajectories are named."""


class Solved(Protocol):
    """A predicted trajectory."""

    @property
    def start(self) -> Start:
        """What it begins with."""


def _listed(labels: Sequence[str]) -> str:
    return ", ".join(labels[:SHOWN]) + (", …" if len(labels) > SHOWN else "")


def said_of_groups(
    member: GeneratedModule, model: Model, items: Sequence[Trajectory], predicted: Sequence[Solved]
) -> list[str]:
    """A warning of each column of which several new trajectories have a value that the training data do not have, or
    of which the run has not kept what it learned: each was estimated from its own rows alone."""
    individuals = Individuals.of_member(member, model)
    if individuals is None or not individuals.shared:
        return []
    names, out = [condition.name for condition in model.conditions], []
    new = [item for item, one in zip(items, predicted, strict=True) if one.start.origin == "estimated"]
    population = member.info.get("population")
    kept = isinstance(population, Mapping) and "learned" in population
    for column in dict.fromkeys(one.column for one in individuals.shared):
        what = ", ".join(f"`{individuals.learnables[one.place].name}`" for one in individuals.shared
                         if one.column == column)  # fmt: skip
        members: dict[float, list[str]] = {}
        for item in new:
            value = float(item.condition[names.index(column)])
            if (column, value) not in individuals.learned:
                members.setdefault(value, []).append(f"`{item.label}`")
        apart = [labels for labels in members.values() if len(labels) > 1]
        if new and not kept:
            out.append(
                f"what the fit has learned of each value of `{column}` ({what}) is not in the run, which an older "
                "version made: new trajectories of a known value were estimated from their own rows alone. Fit again"
            )
        elif apart:
            listed = "; ".join(_listed(labels) for labels in apart[:SHOWN]) + ("; …" if len(apart) > SHOWN else "")
            same = "the same value of" if len(apart) == 1 else "several values in common of"
            out.append(
                f"several trajectories ({listed}) have {same} `{column}` of which the fit has learned nothing: what "
                f"they share ({what}) was estimated for each of them apart, from its own rows, and differs between them"
            )
    return out
