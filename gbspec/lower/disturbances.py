"""The disturbances of states: which of them are proportional to their state, and what they may depend on."""

from __future__ import annotations

from collections.abc import Collection

import sympy

from gbspec import ir
from gbspec.diagnostics import Findings, Span
from gbspec.ir import NOISES, Expr, symbol


def disturbance(
    name: str, value: Expr, states: Collection[str], numbers: dict[sympy.Symbol, float], place: Span, findings: Findings
) -> ir.Diffusion:
    """The disturbance of the state `name`; `numbers` are the values of constants.

    Errors: another state in it (GB340), a negative number (GB343). Warning: it depends on its state other than in
    proportion to it, or to its distances from two numbers (GB410).
    """
    own = symbol(name)
    others = sorted(s.name for s in value.free_symbols if s.name in states and s != own)
    if others:
        findings.error(
            "GB340",
            f"the diffusion of `{name}` depends on the state `{others[0]}`",
            place,
            help="it may depend on constants, learnable constants, conditions, inputs and the disturbed state itself",
        )
        return ir.Diffusion(name, sympy.S.Zero, span=place)
    known = {key: sympy.Float(each) for key, each in numbers.items()}
    relative, between = _relative(value, own, known)
    number = (value if relative is None else relative).xreplace(known)
    if number.is_number and number.is_negative:
        findings.error(
            "GB343",
            f"the diffusion of `{name}` is negative: {float(number):g}",
            place,
            help="it is a size, like a standard deviation: leave out the sign",
        )
    if relative is None and own in value.free_symbols:
        findings.warning(
            "GB410",
            f"the diffusion of `{name}` depends on `{name}`, but is not proportional to it",
            place,
            help=f"a size that is proportional to `{name}`, or to `{name}*(1 - {name})`, is treated exactly (its "
            "logarithm or logit is filtered); this one is taken at the estimated state. Accept it with "
            f"`allow GB410 {name}`",
            subject=name,
        )
    return ir.Diffusion(name, value, relative, between, span=place)


def _relative(
    value: Expr, own: sympy.Symbol, known: dict[sympy.Symbol, sympy.Float]
) -> tuple[Expr | None, tuple[float, float] | None]:
    """The size of the disturbance of a state's logarithm, or of its logit between two numbers, if it does not depend on
    the state; `known` are the values of constants."""
    if own not in value.free_symbols:
        return None, None
    relative = sympy.cancel(value / own)
    if own not in relative.free_symbols:
        return relative, None
    whole = sympy.cancel(value)
    if not whole.is_polynomial(own) or sympy.degree(whole, own) != 2:
        return None, None
    square, slope, rest = sympy.Poly(whole, own).all_coeffs()
    middle, product = (sympy.cancel(each).xreplace(known) for each in (-slope / (2 * square), rest / square))
    half = sympy.sqrt(middle**2 - product)
    if not (middle.is_number and product.is_number and half.is_real and half.is_positive):
        return None, None
    low, high = float(middle - half), float(middle + half)
    return sympy.cancel(-square) * sympy.Float(high - low), (low, high)


def refuse_together(model: ir.Model, findings: Findings) -> None:
    """Errors for what is not offered together with disturbances (GB344): doses whose lag is learned, constants that are
    distributed between trajectories, and noises with learned constants."""
    if not model.diffusions:
        return
    learned = {learnable.symbol for learnable in model.learnables}
    for dose in model.doses:
        if dose.lag.free_symbols & learned:
            message = f"the lag of the doses into `{dose.state}` is learned"
            _together(message, dose.span, "give the lag a value, or leave out the diffusions", findings)
    for learnable in model.learnables:
        if learnable.distribution is not None:
            help = "leave out `~ …`, so that each trajectory has a value of its own, or leave out the diffusions"
            _together(f"`{learnable.name}` is distributed between trajectories", learnable.span, help, findings)
    for channel in model.channels:
        if channel.noise is not None and channel.noise.value is not None:
            help = "leave out the noise: its standard deviation is then learned, or leave out the diffusions"
            if NOISES[channel.noise.kind].counts:
                root = f"`observe sqrt_{channel.name} = sqrt(…)`, with the roots of the counts in the table"
                help = f"write {root}: their standard deviation is then learned; or leave out the diffusions"
            if channel.noise.kind == "lognormal":
                logarithm = f"`observe ln_{channel.name} = log(…)`, whose standard deviation is learned"
                help = f"write {logarithm}, or give the noise a number, or leave out the diffusions"
            form = NOISES[channel.noise.kind]
            why = f"is {form.whose}" if form.density else "holds learned constants"
            _together(f"the noise of `{channel.name}` {why}", channel.span, help, findings)


def _together(what: str, place: Span | None, help: str, findings: Findings) -> None:
    findings.error("GB344", f"{what}, which is not offered together with `diffusion`", place, help=help)
