"""What jumps at times of its own, as a method of the generated class."""

from __future__ import annotations

from gbspec.backends.module.equations import PARAMETERS, body_of
from gbspec.backends.module.writing import comma, method_text
from gbspec.backends.printing import Assignment, Names, temporary
from gbspec.ir import Model, scheduled


def methods(model: Model) -> list[str]:
    """`schedule` and `whole`, in models whose right sides jump at times that follow from the time alone."""
    found = scheduled(model)
    if not found:
        return []
    names = Names(PARAMETERS)
    for item in (model.time, *model.conditions, *model.constants, *model.learnables):
        names.claim(item.symbol)
    outputs = [
        Assignment(temporary(f"schedule{i}"), value, f"{'step' if steps else 'difference'}{i + 1}")
        for i, (value, steps) in enumerate(found)
    ]
    lines = body_of(model, outputs, names)
    lines.append(f"return ({comma(names[output.symbol] for output in outputs)})")
    head = "# whether right sides jump where `schedule` passes a whole number, else where it passes 0"
    table = f"{head}\nwhole: ClassVar[tuple[bool, ...]] = ({comma(str(steps) for _, steps in found)})"
    document = "What decides when right sides jump, as far as it depends on the time alone."
    parameters = ["cls", "math", names[model.time.symbol], "condition", "constants"]
    return [table, method_text("@classmethod", "schedule", parameters, document, lines)]
