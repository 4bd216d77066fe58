"""Checks populations: constants that are distributed between trajectories, effects, correlations, learned noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from gbspec.diagnostics import Findings, Label
from gbspec.ir import WITH_DENSITY
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.numbers import Numbers
from gbspec.semantics.table import Table
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import PREDICTION, Kind, ast, target_name

KINDS = ("lognormal", "normal", "logitnormal")
"""The distributions of constants between trajectories."""
SUBJECT = "subject"
GROUPS = frozenset({"trajectory", SUBJECT})
"""Columns between whose values constants may differ; both mean a trajectory of the data."""


def check(items: Iterable[Item], table: Table, numbers: Numbers, findings: Findings, merged: Merged) -> None:
    """Reports groupings, distributions and correlations that are not possible, and models that mix ways of fitting."""
    items = list(items)
    _Checks(items, table, numbers, findings, merged).all()


def columns(items: Iterable[Item]) -> set[str]:
    """The columns by which constants and effects are grouped, trajectories apart."""
    found = set()
    for statement in (item.statement for item in items):
        if isinstance(statement, ast.LearnStatement):
            found |= {grouping.column.value for grouping in statement.groupings}
        elif isinstance(statement, ast.EffectStatement):
            found.add(statement.per.column.value)
    return found - GROUPS


def without_cuts(items: Iterable[Item]) -> str:
    """Why steps of fits do not end where values jump at times that depend on what is learned: `disturbances`; empty:
    they end there."""
    return "disturbances" if any(isinstance(item.statement, ast.DiffusionStatement) for item in items) else ""


class _Checks:
    def __init__(self, items: list[Item], table: Table, numbers: Numbers, findings: Findings, merged: Merged) -> None:
        self.items, self.table, self.numbers, self.findings, self.merged = items, table, numbers, findings, merged
        self.learned = [i.statement for i in items if isinstance(i.statement, ast.LearnStatement)]
        self.effects = [i.statement for i in items if isinstance(i.statement, ast.EffectStatement)]
        self.distributed = {s.name.text for s in self.learned if s.per is not None and s.per.spread is not None}

    def all(self) -> None:
        """All checks."""
        for statement in self.learned:
            self._groupings(statement)
            for grouping in statement.groupings:
                if grouping.spread is not None:
                    self._distribution(statement, grouping.spread)
        for effect in self.effects:
            self._column(effect.per)
        for effect in self.effects:
            if effect.per.spread is not None:
                self.findings.error(
                    "GB420",
                    "an effect is standard normal, and takes no distribution",
                    effect.per.spread.span,
                    help=f"write `effect {effect.name.text} per trajectory`",
                )
        self._correlations()
        self._noise()
        others, remedy = self._with_a_likelihood()
        if others:
            self._values_of_their_own(others, remedy)
        if self.distributed or self.effects:
            self._learned_starts()

    def _groupings(self, statement: ast.LearnStatement) -> None:
        """Checks the columns by which a constant differs, and that its distributions are of one kind."""
        first = statement.per
        for grouping in statement.groupings:
            self._column(grouping)
            if grouping.spread is None and grouping.column.value not in GROUPS:
                self._without_distribution(statement, grouping)
            elif first is not None and grouping is not first:
                self._together(statement, first, grouping)

    def _without_distribution(self, statement: ast.LearnStatement, grouping: ast.Grouping) -> None:
        """Reports a value for each group whose groups are not known, or that stands with what is not offered."""
        column = grouping.column.value
        declared = self.table[column].statement if column in self.table else None
        message, other = f"a value for each `{column}` without a distribution", f"`per {column} ~ lognormal`"
        if not (isinstance(declared, ast.ConditionStatement) and declared.categories is not None):
            if declared is None and not self.merged.lacks(column):
                return  # perhaps declared by a statement that could not be read
            message += " needs its categories"
            near = suggestion(column, self._with_categories()) if declared is None else ""
            help = near or f"write {other}, or declare them: `condition {column} in {{a, b}}`"
        elif statement.row:
            message += " is not offered for a row of constants"
            help = "declare a constant for each of the row's places"
        else:
            message += " has no other `per`"
            help = f"leave the other out, or write {other}"
        self.findings.error("GB421", message, grouping.span, help=help)

    def _with_categories(self) -> list[str]:
        """The conditions that are categories."""
        declared = ((name, found.statement) for name, found in self.table.items())
        return [n for n, s in declared if isinstance(s, ast.ConditionStatement) and s.categories is not None]

    def _together(self, statement: ast.LearnStatement, first: ast.Grouping, other: ast.Grouping) -> None:
        """Checks a further grouping against the first."""
        name = statement.name.text
        if {first.column.value, other.column.value} <= GROUPS:
            column = "keep one of the two; for several trajectories of a subject, give their column another name"
            kind = "lognormal" if first.spread is None else first.spread.kind.text
            how = f"{column}, as `person`, and write `per trajectory ~ {kind} per person ~ {kind}`"
            self._grouping_error(other, "`per trajectory` and `per subject` mean the same", how)
        elif first.spread is None or other.spread is None:
            self._grouping_error(
                other,
                f"`{name}` has a distribution in one grouping and none in the other",
                f"write `per {first.column.value} ~ lognormal per {other.column.value} ~ lognormal`",
            )
        elif first.spread.kind.text != other.spread.kind.text:
            self._grouping_error(
                other,
                f"`{name}` is {first.spread.kind.text} between the values of `{first.column.value}` and "
                f"{other.spread.kind.text} between those of `{other.column.value}`: deviations would not add",
                "use one kind of distribution",
            )

    def _grouping_error(self, place: ast.Grouping, message: str, help: str) -> None:
        self.findings.error("GB432", message, place.span, help=help)

    def _column(self, per: ast.Grouping) -> None:
        """Checks that a column of groups has the name of nothing else than a condition."""
        column = per.column.value
        declaration = self.table.get(column)
        if column in GROUPS or declaration is None or declaration.kind is Kind.CONDITION:
            return
        self.findings.error(
            "GB433",
            f"`per {column}` names a column of the table, but `{column}` is {declaration.kind.value}",
            per.column.span,
            labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
            help="give the column another name",
        )

    def _distribution(self, statement: ast.LearnStatement, spread: ast.Distribution) -> None:
        kind, name = spread.kind.text, statement.name.text
        if kind not in KINDS:
            self.findings.error(
                "GB420",
                f"`{kind}` is not a distribution of constants between trajectories",
                spread.kind.span,
                help=suggestion(kind, frozenset(KINDS)) or "write `lognormal`, `normal` or `logitnormal`",
            )
            return
        if len(spread.arguments) > 1:
            self.findings.error(
                "GB420",
                f"`{kind}` takes one number, how far the values lie apart: the median is the starting value",
                spread.span,
                help=f"write `learn {name} = 3 per trajectory ~ {kind}(0.3)`",
            )
            return
        if spread.arguments:
            self._apart(statement, spread)
        ends = self.numbers.bounds(statement)
        if ends is None:
            return
        if kind == "lognormal" and (ends[0] < 0 or self._start(statement) <= 0):
            self.findings.error(
                "GB423",
                f"`{name}` is lognormal, so that its median is positive, but its bounds do not keep it so",
                statement.name.span,
                help=f"bound it, for example `learn {name} = 1 > 0 per trajectory ~ lognormal`, or use `normal`",
            )
        if kind == "logitnormal" and not all(map(math.isfinite, ends)):
            self.findings.error(
                "GB423",
                f"`{name}` is logitnormal, which keeps every value between two bounds, and does not have both",
                statement.name.span,
                help=f"write them, for example `learn {name} in [0, 1] per trajectory ~ logitnormal`",
            )

    def _start(self, statement: ast.LearnStatement) -> float:
        value = self.numbers.start(statement)
        return 1.0 if value is None else value

    def _apart(self, statement: ast.LearnStatement, spread: ast.Distribution) -> None:
        """Checks the number that says how far values lie apart: a number, a constant, or one learnable."""
        argument = spread.arguments[0]
        inner = argument
        while isinstance(inner, ast.Group):
            inner = inner.inner
        value = self.numbers.value(argument)
        if value is not None and value < 0:
            self.findings.error("GB422", "a standard deviation is not negative", argument.span)
        learned = {s.name.text: s for s in self.learned}
        if isinstance(inner, ast.Name) and inner.text in learned:
            other = learned[inner.text]
            ends = self.numbers.bounds(other)
            if other.per is not None:
                self._spread_error(argument, f"`{inner.text}` differs between trajectories itself")
            elif ends is not None and ends[0] < 0:
                self._spread_error(
                    argument, f"`{inner.text}` may become negative", f"write `learn {inner.text} = 0.3 > 0`"
                )
        elif value is None and self.numbers.sites.complete(argument):
            self._spread_error(argument, "this is neither a number nor the name of a learnable constant")

    def _spread_error(self, argument: ast.Expression, why: str, help: str = "") -> None:
        self.findings.error(
            "GB422",
            f"{why}, and says how far values lie apart",
            argument.span,
            help=help or "give a number or a `learn`",
        )

    def _correlations(self) -> None:
        seen: dict[str, ast.Name] = {}
        for statement in (i.statement for i in self.items if isinstance(i.statement, ast.CorrelateStatement)):
            if len(statement.constants) < 2:
                self.findings.error(
                    "GB424", "`correlate` takes two names or more", statement.span, help="write `correlate CL, V`"
                )
            for name in statement.constants:
                declaration = self.table.get(name.text)
                if name.text in seen:
                    self.findings.error(
                        "GB424",
                        f"`{name.text}` stands in `correlate` twice",
                        name.span,
                        label="again",
                        labels=[Label(seen[name.text].span, "the first")],
                        help="name all constants that are correlated in one `correlate`",
                    )
                elif declaration is not None and name.text not in self._random and self._is_learned(name.text):
                    self.findings.error(
                        "GB424",
                        f"`{name.text}` has no distribution between trajectories",
                        name.span,
                        labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
                        help=f"write `learn {name.text} = … per trajectory ~ lognormal`",
                    )
                elif name.text in self._random and name.text not in self._between_trajectories:
                    self.findings.error(
                        "GB434",
                        f"`{name.text}` does not differ between trajectories, but between groups of them, whose "
                        "correlations are not offered yet",
                        name.span,
                        help=f"leave `{name.text}` out of `correlate`",
                    )
                seen.setdefault(name.text, name)

    @property
    def _random(self) -> set[str]:
        return self.distributed | {s.name.text for s in self.effects}

    @property
    def _between_trajectories(self) -> set[str]:
        """What has a distribution between trajectories."""
        of_learned = {s.name.text for s in self.learned for g in s.groupings if g.spread and g.column.value in GROUPS}
        return of_learned | {s.name.text for s in self.effects if s.per.column.value in GROUPS}

    def _is_learned(self, name: str) -> bool:
        return isinstance(self.table[name].statement, ast.LearnStatement)

    def _noise(self) -> None:
        """Reports constants of single trajectories in noises."""
        own = {s.name.text for s in self.learned if s.per is not None} | {s.name.text for s in self.effects}
        for statement in (i.statement for i in self.items if isinstance(i.statement, ast.ObserveStatement)):
            for name in self._named(statement):
                if name in own:
                    self.findings.error(
                        "GB425",
                        f"the noise of `{target_name(statement.target).text}` uses `{name}`, which differs between "
                        "trajectories; that is not offered yet",
                        statement.noise.span if statement.noise is not None else statement.span,
                        help="use constants that all trajectories share",
                    )

    def _named(self, statement: ast.ObserveStatement) -> Iterator[str]:
        for argument in statement.noise.arguments if statement.noise is not None else ():
            yield from self.numbers.sites[argument].references.names

    def _with_a_likelihood(self) -> tuple[str, str]:
        """What the marginal likelihood is needed for, and what may be written instead; empty without any."""
        if self.distributed or self.effects:
            return "others that have one", ""
        statements = [item.statement for item in self.items]
        if any(isinstance(statement, ast.DiffusionStatement) for statement in statements):
            return "", ""  # these have a likelihood of their own, and no such noises
        for statement in statements:
            if not isinstance(statement, ast.ObserveStatement) or statement.noise is None:
                continue
            name = target_name(statement.target).text
            written = (part for argument in statement.noise.arguments for part in walk(argument))
            names = {part.text for part in written if isinstance(part, ast.Name)}
            known = not {PREDICTION, name} & names
            form = WITH_DENSITY.get(statement.noise.kind.text)
            if form is not None:
                return f"the noise of `{name}`, which is {form.whose}", ", or another noise"
            if not known or any(self._is_learned(each) for each in names if each in self.table):
                what = "is learned" if known else "depends on the predicted value"
                return f"the noise of `{name}`, which {what}", "; or leave the noise out: it is estimated then"
        return "", ""

    def _values_of_their_own(self, others: str, remedy: str) -> None:
        """Reports constants that are estimated for each trajectory beside what is fitted by the marginal likelihood,
        where they have no distribution. `others` and `remedy` are of `_with_a_likelihood`."""
        for statement in self.learned:
            if statement.per is not None and statement.per.spread is None and statement.per.column.value in GROUPS:
                self.findings.error(
                    "GB426",
                    f"`{statement.name.text}` has a value for each trajectory and no distribution, beside {others}",
                    statement.per.span,
                    help=f"write `learn {statement.name.text} = … per trajectory ~ lognormal`, or leave "
                    f"`per trajectory` out{remedy}",
                )

    def _learned_starts(self) -> None:
        """Reports starts that are learned for each trajectory beside distributions."""
        for item in self.items:
            if isinstance(item.statement, ast.InitialStatement) and item.statement.value is None:
                name = target_name(item.statement.target).text
                self.findings.error(
                    "GB426",
                    f"the start of `{name}` is learned for each trajectory and has no distribution, beside constants "
                    "that have one",
                    item.statement.span,
                    help=f"write `learn {name}_0 = … per trajectory ~ lognormal` and `initial {name} = {name}_0`",
                )
