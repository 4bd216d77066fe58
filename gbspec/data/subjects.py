"""`per subject`, which means `per trajectory`, beside a column of subjects that have several trajectories."""

from __future__ import annotations

from gbspec.data.cells import pairs
from gbspec.data.columns import SUBJECT
from gbspec.data.sheet import SHOWN, Sheet
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import Model


def warn_of_subjects(sheet: Sheet, trajectory: str | None, model: Model, findings: Findings) -> None:
    """Warns (GB711) where trajectories of one subject are taken for different subjects."""
    if trajectory is None or SUBJECT not in sheet.columns or not any(k.by_subject for k in model.learnables):
        return
    labels: dict[str, list[str]] = {}
    for subject, label in pairs(sheet, SUBJECT, trajectory):
        labels.setdefault(subject, []).append(label)
    several = {subject: found for subject, found in labels.items() if len(found) > 1}
    if not several:
        return
    subject, found = next(iter(several.items()))
    names = ", ".join(f"`{label}`" for label in found[:SHOWN]) + ", …" * (len(found) > SHOWN)
    others = f", and {len(several) - 1:,} more have several" if len(several) > 1 else ""
    findings.warning(
        "GB711",
        f"`per subject` means `per trajectory` and does not look at the column `{SUBJECT}`, in which `{subject}` has "
        f"{len(found)} trajectories ({names}){others}: they are taken for different subjects",
        Cell(sheet.path, sheet.header, SUBJECT),
        help="rename the column, as `person`, and write `per person ~ lognormal`, with `per trajectory ~ lognormal` "
        "for what also differs between the trajectories of a person; or write `per trajectory`, if that is meant",
        subject=SUBJECT,
    )
