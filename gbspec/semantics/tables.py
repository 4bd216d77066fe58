"""The points of tables: read from the model or from a file, checked, and put in order."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

from gbspec.diagnostics import Findings, Span
from gbspec.files import TooLargeError, read_bytes
from gbspec.semantics.merge import Item
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import ast

MOST_POINTS = 5000
"""The most points of a table: in a model that is typed, and in the code of every backend, they are constants."""
MOST_BYTES = 1_000_000
MOST_ARGUMENTS = 2

Row = tuple[float, ...]


@dataclass(frozen=True)
class Points:
    """The places of each argument, increasing, and the values at all their combinations, the last argument fastest."""

    knots: tuple[Row, ...]
    values: Row

    @property
    def text(self) -> str:
        """The points as a model has them: `= (0.0, 3.2), (1.0, 4.2)`, over several lines."""
        points = [f"({', '.join(map(repr, (*place, value)))})" for place, value in self._pairs()]
        lines, line = [], "= "
        for point in points[:-1]:
            if len(line) > 80:
                lines.append(line.rstrip())
                line = "    "
            line += f"{point}, "
        return "\n".join([*lines, line + points[-1]])

    def _pairs(self) -> Iterable[tuple[Row, float]]:
        return zip(product(*self.knots), self.values, strict=True)


def check(items: Iterable[Item], findings: Findings) -> dict[str, Points]:
    """The points of every table without errors."""
    found: dict[str, Points] = {}
    for item in items:
        statement = item.statement
        if not isinstance(statement, ast.TableStatement):
            continue
        if not _possible(statement, findings):
            continue
        rows = _written(statement, findings) if statement.file is None else _read(statement, statement.file, findings)
        points = None if rows is None else _ordered(statement, rows, findings)
        if points is not None:
            found[statement.name.text] = points
    return found


def _possible(statement: ast.TableStatement, findings: Findings) -> bool:
    """Whether the table has a number of arguments, and an interpolation, that exist."""
    count = len(statement.arguments)
    if count > MOST_ARGUMENTS:
        findings.error(
            "GB253",
            f"the table `{statement.name.text}` has {count} arguments; at most {MOST_ARGUMENTS} are possible",
            statement.arguments[MOST_ARGUMENTS].span,
            help="write it as a combination of tables of one or two arguments",
        )
    elif count == MOST_ARGUMENTS and statement.interpolation == "pchip":
        findings.error(
            "GB253",
            "`pchip` is for one argument, and this table has two",
            statement.name.span,
            help="write `linear`, which keeps within the points too, or `cubic`",
        )
    else:
        return count > 0  # a table without arguments is reported with other empty lists of parameters
    return False


# --------------------------------------------------------------------------------------------------------- the numbers
def _written(statement: ast.TableStatement, findings: Findings) -> list[Row] | None:
    """The points that stand in the model."""
    wanted = len(statement.arguments) + 1
    rows = []
    for point in statement.points:
        if len(point.numbers) != wanted:
            names = ", ".join([*(a.name.text for a in statement.arguments), statement.name.text])
            findings.error(
                "GB251",
                f"this point has {len(point.numbers)} numbers, and one of this table has {wanted}",
                point.span,
                help=f"a point is `({names})`: the arguments, then the value",
            )
            return None
        rows.append(tuple(number.value for number in point.numbers))
    return rows or None


def _read(statement: ast.TableStatement, file: ast.PointsFile, findings: Findings) -> list[Row] | None:
    """The points of a file: columns by their names, or without a header in the order of the statement."""
    text = _text(file, findings)
    if text is None:
        return None
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    separator = next((mark for mark in ";\t," if lines and mark in lines[0]), ",")
    cells = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)]
    names = [*(a.name.text for a in statement.arguments), statement.name.text]
    places: list[int] | None = list(range(len(names)))
    first = 0
    if cells and any(_number(cell) is None for cell in cells[0]):
        places, first = _columns(cells[0], names, file, findings), 1
    if places is None:
        return None
    rows = []
    for line, row in enumerate(cells[first:], start=first + 1):
        values = [_number(row[place]) if place < len(row) else None for place in places]
        if None in values or (not first and len(row) != len(names)):
            _wrong_row(file, line, names, row, values, findings)
            return None
        rows.append(tuple(value for value in values if value is not None))
    return rows


def _text(file: ast.PointsFile, findings: Findings) -> str | None:
    folder = Path(file.span.source.path).parent
    path = folder / file.path.value
    inside = not Path(file.path.value).is_absolute() and path.resolve().is_relative_to(folder.resolve())
    help_ = 'write the path relative to this file, as in `from "ocv.csv"` or `from "tables/ocv.csv"`'
    if not inside or path.resolve() == folder.resolve():
        reason = "it is not in or below the folder of this file"
    else:
        try:
            return read_bytes(path, MOST_BYTES).decode("utf-8-sig")
        except FileNotFoundError:
            near = sorted(p.name for p in path.parent.iterdir() if p.is_file()) if path.parent.is_dir() else []
            reason, help_ = "there is no such file", suggestion(path.name, near)
        except UnicodeDecodeError:
            reason, help_ = "it is not UTF-8 text", "save it as CSV, in UTF-8"
        except TooLargeError:
            reason, help_ = f"it is larger than {MOST_BYTES:,} bytes", f"a table has at most {MOST_POINTS:,} points"
        except (OSError, ValueError) as error:
            strerror = error.strerror if isinstance(error, OSError) else None
            reason, help_ = strerror or str(error), ""
    findings.error("GB250", f"cannot read the points in `{file.path.value}`: {reason}", file.path.span, help=help_)
    return None


def _columns(header: Sequence[str], names: Sequence[str], file: ast.PointsFile, findings: Findings) -> list[int] | None:
    missing = [name for name in names if name not in header]
    if not missing:
        return [header.index(name) for name in names]
    listed = ", ".join(f"`{cell}`" for cell in header[:12])
    findings.error(
        "GB251",
        f"`{file.path.value}` has no column `{missing[0]}`",
        file.path.span,
        label=f"its columns are {listed}",
        help=suggestion(missing[0], header)
        or "name the columns like the arguments and the table, or leave the header "
        "out: then they stand in the order of the arguments, the value last",
    )
    return None


def _wrong_row(
    file: ast.PointsFile,
    line: int,
    names: Sequence[str],
    row: Sequence[str],
    values: Sequence[float | None],
    findings: Findings,
) -> None:
    place = next((i for i, value in enumerate(values) if value is None), None)
    what = f"it has {len(row)} cells, and {len(names)} are needed"
    if place is not None:
        text = next((cell for cell in row if _number(cell) is None), "")
        what = f"the column `{names[place]}` has `{text}`, which is not a number"
    findings.error(
        "GB251",
        f"row {line} of the points in `{file.path.value}`: {what}",
        file.path.span,
        help="write numbers with a decimal point; rows count without comments and empty lines",
    )


def _number(text: str) -> float | None:
    try:
        value = float(text) if "_" not in text else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None


# ---------------------------------------------------------------------------------------------------------- the points
def _ordered(statement: ast.TableStatement, rows: Sequence[Row], findings: Findings) -> Points | None:
    """The points in order, if they make a function: two places or more of each argument, every combination once."""
    place: Span = statement.file.path.span if statement.file is not None else statement.points[0].span
    if statement.file is None:
        place = place.to(statement.points[-1].span)
    knots = tuple(tuple(sorted({row[i] for row in rows})) for i in range(len(statement.arguments)))
    table: dict[Row, float] = {row[:-1]: row[-1] for row in rows}
    names = [argument.name.text for argument in statement.arguments]
    problem, help_ = "", ""
    if any(not math.isfinite(number) for row in rows for number in row):
        problem, help_ = "a number is too large for a double", ""
    elif len(rows) > MOST_POINTS:
        problem, help_ = f"it has {len(rows):,} points; at most {MOST_POINTS:,} are read", "keep every second one"
    elif len(table) < len(rows):
        twice = next(p for i, p in enumerate(row[:-1] for row in rows) if any(r[:-1] == p for r in rows[:i]))
        problem = f"there are two points at {_at(names, twice)}"
        help_ = "a function has one value at each place; for a jump, use `if`"
    elif any(len(places) < 2 for places in knots):
        short = next(name for name, places in zip(names, knots, strict=True) if len(places) < 2)
        problem, help_ = f"a table needs two places of `{short}` or more", "a single value is a `const`"
    elif len(table) < math.prod(map(len, knots)):
        lacking = next(p for p in product(*knots) if p not in table)
        problem = f"there is no point at {_at(names, lacking)}"
        help_ = f"a table of two arguments is a grid: each of the {len(knots[0])} places of `{names[0]}` with each "
        help_ += f"of the {len(knots[1])} of `{names[1]}`"
    elif any(b - a < 1e-12 * max(abs(places[0]), abs(places[-1])) for places in knots for a, b in pairwise(places)):
        problem, help_ = "two places are so close that no slope between them is certain", "delete one of them"
    if problem:
        findings.error("GB252", f"the points of `{statement.name.text}`: {problem}", place, help=help_)
        return None
    return Points(knots, tuple(table[p] for p in product(*knots)))


def _at(names: Sequence[str], place: Row) -> str:
    return ", ".join(f"`{name} = {value:g}`" for name, value in zip(names, place, strict=True))


def written_out(items: Iterable[Item], tables: Mapping[str, Points]) -> list[tuple[Span, str]]:
    """Where a model names files of points, and the points that stand there in a text without them."""
    return [
        (item.statement.file.span, tables[item.statement.name.text].text)
        for item in items
        if isinstance(item.statement, ast.TableStatement) and item.statement.file is not None
    ]
