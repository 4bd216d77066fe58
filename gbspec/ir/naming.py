"""Names for statements that are yet to be written."""

from __future__ import annotations

from gbspec.ir.model import Model


def new_name(model: Model, name: str) -> str:
    """The name with as many underscores as nothing in the model has."""
    groups = (model.states, model.inputs, model.intermediates, model.conditions, model.algebraics, model.unknowns)
    others = (model.tables, model.channels, model.events)
    taken = {one.name for group in (*groups, *others) for one in group}
    taken |= {model.time.name, *model.constant_names}
    while name in taken:
        name += "_"
    return name
