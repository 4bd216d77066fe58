"""Contracts of unknowns: a construction that satisfies them for all weights, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy

from gbspec.diagnostics import Findings, Label, Span
from gbspec.ir import NN, Form, Model, Network, Range, Unknown
from gbspec.passes.bent import ShapedBuilder
from gbspec.passes.constructions import Construction
from gbspec.passes.intervals import REAL, Box, Interval, of_range
from gbspec.passes.layouts import TooNarrow, layout
from gbspec.passes.requirements import Requirements, Wanted, requirements, wanted
from gbspec.passes.shapes import Refused, shown
from gbspec.passes.signs import Prover
from gbspec.passes.values import with_offset


def with_contracts(model: Model, findings: Findings) -> Model:
    """The model with a form for every unknown whose network has contracts, and a layout for the network.

    Records an error (GB603, GB605, GB607, GB608) for each contract that cannot be guaranteed; the network is then left
    unchanged.
    """
    networks, unknowns = list(model.networks), list(model.unknowns)
    for index, network in enumerate(model.networks):
        outputs = sorted((u for u in model.unknowns if u.network == index), key=lambda u: u.output)
        if not any(u.contracts for u in outputs) and not network.spline:
            continue
        plans = _plans(model, network, outputs, findings)
        if plans is None:
            continue
        kinds = [plan.built.kind for plan in plans]
        gates = [plan.built.kind for plan in plans for _ in range(plan.built.gates)]
        try:
            arranged = layout([*kinds, *gates], network.hidden, len(gates))
        except TooNarrow as problem:
            _narrow(network, outputs, problem, findings)
            continue
        cyclic = _cyclic(network, plans, findings)
        if cyclic is None:
            continue
        smooth = tuple(place for plan in plans for place in plan.built.smooth)
        extra = tuple(place for plan in plans for place in plan.built.extra)
        networks[index] = replace(network, layout=arranged, smooth=smooth, extra=extra, cyclic=cyclic)
        for unknown, plan in zip(outputs, plans, strict=True):
            unknowns[model.unknowns.index(unknown)] = replace(unknown, form=plan.form())
    return replace(model, networks=tuple(networks), unknowns=tuple(unknowns))


@dataclass(frozen=True)
class _Plan:
    """The plan for one output: its construction, the scope of the proofs, and notes on the decisions."""

    unknown: Unknown
    built: Construction
    needs: Requirements
    within: tuple[str, ...]

    def form(self) -> Form:
        """The form of the unknown: the construction in place of `nn`, or alone if it is a link."""
        value = self.built.value
        if self.needs.link is None:
            value = self.unknown.postulate.xreplace({NN: value})
        return Form(
            self.built.evaluations, value, "ranges" if self.within else "everywhere", self.within, self.needs.notes
        )


def _plans(model: Model, network: Network, outputs: Sequence[Unknown], findings: Findings) -> list[_Plan] | None:
    plans: list[_Plan] = []
    failed = False
    for unknown in outputs:
        try:
            first = len(outputs) + sum(plan.built.gates for plan in plans)
            plans.append(_plan(model, network, unknown, first))
        except Refused as reason:
            _refuse(unknown, reason, findings)
            failed = True
    return None if failed else plans


def _plan(model: Model, network: Network, unknown: Unknown, first_gate: int) -> _Plan:
    """Proves for all real arguments if that is possible, else within the arguments' ranges."""
    constants, arguments = _boxes(model, network)
    demands = wanted(unknown, network, Prover({**constants, **arguments}))
    _consistent(unknown, demands, Prover({**constants, **arguments}))
    used = {name: interval for name, interval in arguments.items() if interval != REAL}
    try:
        return _attempt(network, unknown, demands, Prover(constants), Prover({**constants, **used}), first_gate, ())
    except Refused as reason:
        if not used or reason.code == "GB603":
            raise
    ranges = Prover({**constants, **used})
    return _attempt(network, unknown, demands, ranges, ranges, first_gate, tuple(s.name for s in used))


def _attempt(
    network: Network,
    unknown: Unknown,
    demands: Wanted,
    prover: Prover,
    ranges: Prover,
    first_gate: int,
    within: tuple[str, ...],
) -> _Plan:
    if demands.lower is not None and demands.upper is not None and not prover.positive(demands.upper - demands.lower):
        raise Refused(
            "GB607",
            f"the upper bound `{shown(demands.upper)}` is not proved to be above the lower bound"
            f" `{shown(demands.lower)}`",
            [c for c in unknown.contracts if c.kind in ("lower", "upper")],
            "bound the constants in them: `learn k in [1, 2]`",
        )
    for bound in (demands.lower, demands.upper):
        if bound is not None and not prover.finite(bound):
            raise Refused(
                "GB607",
                f"the bound `{shown(bound)}` is not proved to be a finite number everywhere",
                [c for c in unknown.contracts if c.kind in ("lower", "upper")],
                "give the names in it ranges",
            )
    needs = requirements(unknown, network, demands, prover)
    builder = ShapedBuilder(unknown, network, prover, ranges, first_gate)
    if network.spline:
        builder.splined(needs.correction.shapes)
    if needs.link is not None:
        built = builder.linked(needs.correction, demands, needs.link)
    else:
        offset, around = with_offset(unknown, builder.formals, needs.correction, prover)
        built = builder.shaped(around, offset)
    return _Plan(unknown, built, needs, within)


def _cyclic(network: Network, plans: Sequence[_Plan], findings: Findings) -> tuple[int, ...] | None:
    """The arguments with a period; None, with an error (GB607), if they are not the same for all outputs."""
    found = [tuple(sorted(plan.needs.correction.shapes.periods)) for plan in plans]
    if len(set(found)) == 1:
        return found[0]
    odd = next(plan.unknown for plan, own in zip(plans, found, strict=True) if own)
    contracts = [c for c in odd.contracts if c.kind == "period"]
    message = f"`{odd.name}` shares a network with functions that do not have its period in `{contracts[0].argument}`"
    reason = Refused("GB607", message, contracts, "declare it in a statement of its own, with a network of its own")
    _refuse(odd, reason, findings)
    return None


def _boxes(model: Model, network: Network) -> tuple[Box, Box]:
    """Intervals of the constants, and of the arguments: their own, else those of the states or inputs of that name."""
    constants: dict[sympy.Symbol, Interval] = {c.symbol: Interval(c.value, c.value) for c in model.constants}
    # Training keeps a learnable strictly inside its bounds.
    constants |= {k.symbol: of_range(k.range, strict=True) for k in model.learnables}
    named: dict[str, Range | None] = {item.name: item.range for item in model.states}
    named |= {item.name: item.range for item in model.algebraics}
    named |= {item.name: item.range for item in model.conditions} | {item.name: item.range for item in model.inputs}
    formals = {a.symbol: of_range(a.range or named.get(a.name)) for a in network.arguments}
    return {s: i for s, i in constants.items() if s not in formals}, formals


def _consistent(unknown: Unknown, demands: Wanted, prover: Prover) -> None:
    """Raises `Refused` (GB603) if bounds contradict each other."""
    lower, upper = demands.lower, demands.upper
    if lower is None or upper is None:
        return
    if prover.nonnegative(lower - upper):
        raise Refused(
            "GB603",
            f"`{unknown.name}` cannot be at least `{shown(lower)}` and at most `{shown(upper)}`"
            + (" and still be learned" if prover.zero(lower - upper) else ""),
            [c for c in unknown.contracts if c.kind in ("lower", "upper")],
            "correct one of the bounds",
        )


def _refuse(unknown: Unknown, reason: Refused, findings: Findings) -> None:
    places = [c.span for c in reason.contracts if c.span is not None]
    findings.error(
        reason.code,
        reason.message,
        places[0] if places else unknown.span,
        labels=[Label(span, "with this contract") for span in _others(places)],
        help=reason.help,
        subject=unknown.name,
    )


def _others(places: Sequence[Span]) -> list[Span]:
    return [span for span in dict.fromkeys(places) if span != places[0]]


def _narrow(network: Network, outputs: Sequence[Unknown], problem: TooNarrow, findings: Findings) -> None:
    widths = ", ".join(str(max(width, 3 * problem.needed)) for width in network.hidden)
    findings.error(
        "GB608",
        f"the network of `{network.name}` is too narrow for its contracts: a hidden layer needs at least"
        f" {problem.needed} units",
        outputs[0].span,
        help=f"widen it: `by mlp({widths})`",
    )
