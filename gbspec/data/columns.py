"""Assigns columns, or names of the long layout, to the quantities of a model."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, assert_never

from gbspec.data.names import cell_name, similar
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import NOISES
from gbspec.syntax import REFUSED, is_name, normalise

if TYPE_CHECKING:
    from gbspec.data.sheet import Sheet
    from gbspec.ir import Model, Range

Role = Literal["channel", "condition", "input", "dose", "sd", "regimen", "limit"]

TRAJECTORY = "trajectory"
SUBJECT = "subject"
MOST_SURPLUS = 50
"""The columns that are not used and are reported one by one."""
REGIMEN = ("dur", "rate", "ii", "addl", "ss")
"""What a table may say of a dose besides its amount, in columns such as `dur_STATE`: how long it lasts, or at which
rate it is given; the interval of its repetitions and their number; whether it is given in a steady state."""
LONG = ("name", "value")
"""The columns by which the long layout is recognised."""
LABELS = frozenset(
    {
        "run",
        "runs",
        "run_id",
        "experiment",
        "exp",
        "trial",
        "batch",
        "id",
        "series",
        "traj",
        "subject",
        "patient",
        "animal",
        "sample",
        "group",
        "cell",
        "test",
        "cycle",
        "replicate",
    }
)
"""Names of columns, in lower case, that may tell experiments apart."""
TIMES = frozenset(
    {"t", "time", "times", "timestamp", "datetime", "date", "day", "days", "hour", "hours", "h", "hr", "min", "minute"}
    | {"minutes", "s", "sec", "second", "seconds", "week", "weeks", "month", "months", "year", "years", "age", "tad"}
)
"""Names of columns, in lower case, that may hold the time."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that a table may contain: `role`, `index` among its kind in the model, and its column's name."""

    role: Role
    index: int
    name: str
    column: str
    required: bool
    range: Range | None = None
    positive: bool = False
    """Whether its values must be above zero (a channel with lognormal noise)."""
    counts: bool = False
    """Whether its values must be whole numbers from 0 (a channel with the noise of counts)."""
    categories: tuple[str, ...] = ()
    """The names that stand in its cells (a condition with categories)."""
    labels: bool = False
    """Whether its cells may be texts, which only tell trajectories apart."""
    word: str = ""
    """What is said of a dose, for the role `regimen`: one of `REGIMEN`."""
    instead: str = ""
    """The column that may stand in place of this one: the rate of infusion, in place of doses."""

    def lacks(self, columns: Collection[str]) -> bool:
        """Whether a table of these columns (or names of the long layout) lacks it."""
        return self.required and self.column not in columns and (not self.instead or self.instead not in columns)


def quantities(model: Model, require_channels: bool = True, regimens: bool = True) -> tuple[Quantity, ...]:
    """All quantities that a table for the model may contain, channels first; those of `REGIMEN` only if wanted, and
    where nothing else has such a column."""
    found: list[Quantity] = []
    for i, channel in enumerate(model.channels):
        column = cell_name(channel.column or channel.name)
        bounds = None if channel.state is None else model.states[channel.state].range
        positive = channel.noise is not None and channel.noise.kind == "lognormal"
        made = Quantity("channel", i, channel.name, column, require_channels, bounds, positive)
        found.append(replace(made, counts=channel.noise is not None and NOISES[channel.noise.kind].counts))
    for i, channel in enumerate(model.channels):
        column = "sd_" + cell_name(channel.column or channel.name)
        found.append(Quantity("sd", i, channel.name, column, False))
    for i, channel in enumerate(model.channels):
        column = "limit_" + cell_name(channel.column or channel.name)
        found.append(Quantity("limit", i, channel.name, column, False))
    for i, condition in enumerate(model.conditions):
        column = cell_name(condition.column or condition.name)
        made = Quantity("condition", i, condition.name, column, condition.default is None, condition.range)
        found.append(replace(made, categories=condition.categories, labels=condition.labels))
    for i, signal in enumerate(model.inputs):
        column = cell_name(signal.column or signal.name)
        found.append(Quantity("input", i, signal.name, column, signal.default is None, signal.range))
    for i, dose in enumerate(model.doses):
        rate = next((q.column for q in found if dose.infusion and q.role == "input" and q.name == dose.infusion), "")
        found.append(Quantity("dose", i, dose.state, f"dose_{cell_name(dose.state)}", True, instead=rate))
    if regimens:
        taken = {quantity.column for quantity in found} | {cell_name(model.time.name), TRAJECTORY}
        for i, dose in enumerate(model.doses):
            columns = ((word, f"{word}_{cell_name(dose.state)}") for word in REGIMEN)
            found += [Quantity("regimen", i, dose.state, c, False, word=word) for word, c in columns if c not in taken]
    return tuple(found)


@dataclass(frozen=True)
class Layout:
    """The layout of a sheet, with the columns of time, trajectory and quantities."""

    long: bool
    time: str
    trajectory: str | None
    columns: tuple[Quantity, ...]
    remedies: Mapping[str, str] = field(default_factory=dict)
    """For names that the model does not declare: what would declare them."""


def recognise(sheet: Sheet, model: Model, wanted: tuple[Quantity, ...], findings: Findings) -> Layout | None:
    """Finds the table's layout and columns; reports missing (GB710) and surplus (GB711) ones.

    None if the table cannot be read further (no column of time).
    """
    present = set(sheet.names)
    taken = {quantity.column for quantity in wanted}
    long = all(name in present and name not in taken for name in LONG)
    time = _time(sheet, model, taken)
    spare = [name for name in sheet.names if name not in taken and name not in (time, TRAJECTORY)]
    if time is None:
        _missing(sheet, model.time.name, "the time", spare, findings, (), _other_time(sheet, model, spare))
        return None
    trajectory = TRAJECTORY if TRAJECTORY in present and TRAJECTORY not in taken else None
    told = {SUBJECT} if trajectory is not None and any(k.by_subject for k in model.learnables) else set[str]()
    spare = [name for name in spare if name not in told]  # `subjects` says what there is to say
    if long:
        spare = [name for name in sheet.names if name not in (time, trajectory, *LONG, "sd", *told)]
        _surplus(sheet, spare, (), findings, _unnamed_labels(spare, trajectory))
        return Layout(True, time, trajectory, wanted, unread(model))
    columns = tuple(quantity for quantity in wanted if quantity.column in present)
    absent = [quantity for quantity in wanted if quantity.lacks(present)]
    suggested: set[str] = set()
    for quantity in absent:
        other = _instead(sheet, model, quantity, absent, spare)
        suggested |= _missing(sheet, quantity.column, describe(quantity), spare, findings, _notes(quantity), other)
    optional = [q.column for q in wanted if not q.required and q.column not in present]
    remedies = {**_unnamed_labels(spare, trajectory), **unread(model)}
    _surplus(sheet, [name for name in spare if name not in suggested], optional, findings, remedies)
    return Layout(False, time, trajectory, columns)


@dataclass(frozen=True)
class Form:
    """The columns of a model's tables: the time, whether trajectories start at a time that the model gives, and the
    quantities."""

    time: str
    starts: bool
    quantities: tuple[Quantity, ...]


def form_of(model: Model) -> Form:
    """The columns of the tables for a model."""
    return Form(model.time.name, model.time.start is not None, quantities(model, regimens=False))


def describe(quantity: Quantity) -> str:
    """The description of a quantity for a message."""
    match quantity.role:
        case "channel":
            return f"the channel `{quantity.name}`"
        case "sd":
            return f"the standard deviation of `{quantity.name}`"
        case "limit":
            return f"whether values of `{quantity.name}` are limits"
        case "dose":
            return f"the doses to `{quantity.name}`"
        case "regimen":
            return f"`{quantity.word}` of the doses to `{quantity.name}`"
        case "condition" | "input":
            return f"the {quantity.role} `{quantity.name}`"
        case role:
            assert_never(role)


def labelling(name: str) -> bool:
    """Whether a column of that name may tell experiments apart."""
    return name.casefold() in LABELS or similar(name, [TRAJECTORY]) is not None


def _unnamed_labels(spare: Iterable[str], trajectory: str | None) -> dict[str, str]:
    """What is said of columns that are not used and may tell trajectories apart, where none is read for that."""
    if trajectory is not None:
        return {}
    return {
        name: f"does it tell trajectories apart? There is no column `{TRAJECTORY}`, so that all rows are one "
        f"trajectory: rename the column `{TRAJECTORY}`"
        for name in spare
        if labelling(name)
    }


def _other_time(sheet: Sheet, model: Model, spare: list[str]) -> tuple[str, str] | None:
    """A column that is not used and by its name holds the time, with what can be written."""
    known = model.time.name.casefold()
    found = [name for name in spare if name.casefold() == known or name.casefold() in TIMES]
    if not found:
        return None
    name = min(found, key=lambda each: each.casefold() != known)
    help = f"does `{name}` hold it? Rename the column `{model.time.name}`"
    if is_name(name) and normalise(name) not in REFUSED | _declared(model):
        help += f", or the time of the model, `time {name}`"
    if not _has_numbers(sheet, name):
        help += "; times are numbers, such as days since the first row"
    return name, help


def _declared(model: Model) -> set[str]:
    """The names of a model, of which the time can be none."""
    found = [model.states, model.conditions, model.inputs, model.constants, model.learnables, model.implied]
    found += [model.unknowns, model.tables, model.intermediates, model.algebraics, model.channels]
    return {array.name for array in model.arrays} | {item.name for group in found for item in group}


def _notes(quantity: Quantity) -> tuple[str, ...]:
    if quantity.role == "channel":
        return ("its cells may be empty where it was not measured",)
    if quantity.instead:
        return (f"or give the rate of infusion over time, in a column `{quantity.instead}`",)
    return ()


def _time(sheet: Sheet, model: Model, taken: set[str]) -> str | None:
    """The column of time: that with the name of the model's time, else `t`."""
    for name in (cell_name(model.time.name), "t"):
        if name in sheet.columns and name not in taken:
            return name
    return None


def _missing(
    sheet: Sheet,
    column: str,
    what: str,
    spare: list[str],
    findings: Findings,
    notes: tuple[str, ...],
    other: tuple[str, str] | None = None,
) -> set[str]:
    """Reports a missing column; returns the surplus column that probably replaces it: one of similar name, or the
    `other` with what can be written."""
    meant = similar(column, spare)
    if meant is None and other is not None:
        meant, help = other
    else:
        help = f"rename the column `{meant}`" if meant else f"its columns are {_list(sheet.names)}"
    findings.error(
        "GB710",
        f"the table has no column `{column}` for {what}",
        Cell(sheet.path, sheet.header, column),
        help=help,
        notes=notes,
    )
    return {meant} if meant else set()


def _instead(
    sheet: Sheet, model: Model, quantity: Quantity, absent: list[Quantity], spare: list[str]
) -> tuple[str, str] | None:
    """The only column of numbers that is not used, where one channel lacks its column, with what can be written."""
    if quantity.role != "channel" or [other.role for other in absent].count("channel") > 1:
        return None
    likely = [name for name in spare if name.casefold() not in LABELS and _has_numbers(sheet, name)]
    if len(likely) != 1:
        return None
    channel = model.channels[quantity.index]
    measured = "…" if channel.state is None else model.states[channel.state].name
    value = "" if measured == channel.name else f" = {measured}"
    help = f'does `{likely[0]}` hold it? Write `observe {channel.name}{value} as "{likely[0]}"`, or rename the column'
    return likely[0], help


def _has_numbers(sheet: Sheet, name: str) -> bool:
    """Whether a column has numbers, and no text besides that is longer than a sign of what is missing."""
    column = sheet.columns[name]
    if not column.dtype.is_numeric() and str(column.dtype) != "String":
        return False
    texts = column.cast(str).drop_nulls().str.strip_chars()
    texts = texts.str.replace(",", ".") if sheet.decimal_comma else texts
    values = texts.cast(float, strict=False)
    return bool(values.is_not_null().any()) and bool((values.is_not_null() | (texts.str.len_chars() <= 4)).all())


def unread(model: Model) -> dict[str, str]:
    """For columns that the model does not read as it is, but names: what declares them."""
    seen = {channel.state for channel in model.channels}
    states = [state.name for i, state in enumerate(model.states) if i not in seen]
    values = [constant.name for constant in (*model.constants, *model.learnables)]
    observed = {cell_name(name): f"`observe {name}` in the model declares that it is measured" for name in states}
    given = {cell_name(name): f"`condition {name}` in place of the constant takes it from the table" for name in values}
    return {**given, **observed, **_unread_infusions(model)}


def _unread_infusions(model: Model) -> dict[str, str]:
    """For columns that would give the rates of infusions if the model's doses could last: what declares them."""
    return {
        f"infusion_{cell_name(dose.state)}": f"`dose {dose.state} over 0` in the model declares it: doses that may last"
        for dose in model.doses
        if not dose.infusion
    }


def _surplus(
    sheet: Sheet, names: Iterable[str], optional: Iterable[str], findings: Findings, remedies: Mapping[str, str]
) -> None:
    """Warns of columns that the model does not declare; `remedies` say of some what declares them."""
    given, known = list(names), list(optional)
    for rank, name in enumerate(given[:MOST_SURPLUS], start=1):
        meant = similar(name, known)
        further = len(given) - MOST_SURPLUS if rank == MOST_SURPLUS else 0
        findings.warning(
            "GB711",
            f"column `{name}` is not used: the model reads nothing of that name",
            Cell(sheet.path, sheet.header, name),
            help=remedies.get(name) or (f"is `{meant}` meant?" if meant else ""),
            notes=(f"and {further:,} more columns are not used",) if further > 0 else (),
            subject=name,
        )


def _list(names: Iterable[str]) -> str:
    """At most twelve names as a list for a message."""
    shown = [f"`{name}`" for name in names]
    return ", ".join(shown) if len(shown) <= 12 else ", ".join(shown[:12]) + f" and {len(shown) - 12} more"
