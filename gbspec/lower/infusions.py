"""Lowers infusions: doses that last are a held input, their rate, in the balance of the state that they enter.

So every engine treats them as it treats inputs: their ends are boundaries of steps, and derivatives are exact.
"""

from __future__ import annotations

from dataclasses import replace

from gbspec.diagnostics import Findings
from gbspec.ir import Dose, Input, Model, Range, symbol
from gbspec.lower.populations import implied_name
from gbspec.semantics import Checked

COLUMN = "infusion_"
"""What precedes the state's name in the column that gives the rate of its infusion over time."""


def infused(model: Model, checked: Checked, findings: Findings) -> Model:
    """The model with an input for the infusions into each state that may have any.

    Errors: a lag that is learned (GB428), since the ends of infusions follow from the data alone.
    """
    if all(dose.duration is None for dose in model.doses):
        return model
    learned = {learnable.symbol for learnable in model.learnables}
    inputs, balances, doses = list(model.inputs), list(model.balances), []
    for dose in model.doses:
        if dose.duration is None:
            doses.append(dose)
            continue
        if dose.lag.free_symbols & learned:
            findings.error(
                "GB428",
                f"the lag of the infusions into `{dose.state}` is learned",
                dose.span,
                help="give the lag a value; a dose without `over` is given at once and may have a lag that is learned",
            )
        name = implied_name(COLUMN.removesuffix("_"), dose.state, checked)
        inputs.append(_rate(model, dose, name))
        balances[model.state_index[dose.state]] += dose.fraction * symbol(name)
        doses.append(replace(dose, infusion=name))
    return replace(model, inputs=tuple(inputs), balances=tuple(balances), doses=tuple(doses))


def _rate(model: Model, dose: Dose, name: str) -> Input:
    """The rate of infusion into a state."""
    amount, time = model.states[model.state_index[dose.state]].unit, model.time.unit
    whole = f"({amount})" if amount is not None and any(sign in amount for sign in "*/^") else amount
    return Input(
        name,
        range=Range(low=0.0),
        default=0.0,
        column=COLUMN + dose.state,
        infuses=dose.state,
        unit=None if amount is None or time is None else f"{whole}/{time}" if whole != "1" else f"1/{time}",
        description=f"rate of infusion into {dose.state}",
        span=dose.span,
    )


def refuse_elements(model: Model, findings: Findings) -> None:
    """Errors for infusions into elements of arrays (GB429), whose balances have one form for all elements."""
    entries = {
        model.states[place].name
        for family in model.families
        if family.vector == "balances"
        for place in range(family.begin, family.begin + family.count)
    }
    for dose in model.doses:
        if dose.duration is not None and dose.state in entries:
            findings.error(
                "GB429",
                f"infusions into an element of an array, `{dose.state}`, are not offered",
                dose.span,
                help="declare an `input`, the rate of infusion, and add it to the balances in which it arrives",
            )
