"""The kinds of names that may occur in an expression, by the expression's place."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.syntax.kinds import VALUES, Kind


@dataclass(frozen=True)
class Rule:
    """The rule for an expression: its description, the kinds allowed in it, and the code reported for other kinds."""

    place: str
    allowed: frozenset[Kind]
    meant: str
    code: str = "GB213"
    refused_within: frozenset[Kind] = frozenset()
    """Kinds that may occur there directly, but not inside a `let` or a function that is used there."""


_FIXED = frozenset({Kind.CONST, Kind.LEARN, Kind.FUNCTION, Kind.TABLE, Kind.LET})

ANY = Rule("an expression", VALUES, "values")
CONSTANT = Rule("a fixed number", frozenset({Kind.CONST, Kind.FUNCTION}), "numbers and constants", "GB224")
CONST_VALUE = Rule("the value of a constant", CONSTANT.allowed, "numbers and other constants", "GB224")
SIDE = Rule(
    "a side of a process",
    _FIXED | {Kind.STATE},
    "states, constants and learnable constants",
    "GB306",
    frozenset({Kind.STATE}),
)
POSTULATE = Rule("a postulate", _FIXED, "the arguments, `nn`, constants and learnable constants", "GB230")
TRUTH = Rule("a truth", _FIXED, "the arguments, constants and learnable constants", "GB221")
TRUTH_NUMBER = Rule(
    "the truth of a learnable constant",
    frozenset({Kind.CONST, Kind.LEARN, Kind.FUNCTION}),
    "numbers, constants and other learnable constants",
    "GB221",
    frozenset({Kind.LEARN}),
)
START = Rule(
    "a start",
    _FIXED | {Kind.CONDITION, Kind.STATE},
    "constants, learnable constants, conditions and the initial values of other states",
    "GB308",
)
HELD = Rule(
    "a value of `initial steady with`",
    _FIXED | {Kind.CONDITION},
    "constants, learnable constants and conditions",
    "GB377",
)
RESUMED = Rule(
    "a value of `initial steady then`",
    _FIXED | {Kind.CONDITION, Kind.STATE},
    "constants, learnable constants, conditions and the states in the steady state",
    "GB815",
)
SOUGHT = Rule(
    "the condition of `initial steady when`",
    frozenset({Kind.CONST, Kind.FUNCTION, Kind.LET, Kind.CONDITION}),
    "numbers, constants and conditions",
    "GB816",
)
DOSING = Rule(
    "the fraction or the lag of a dose",
    _FIXED | {Kind.CONDITION},
    "constants, learnable constants and conditions",
    "GB313",
)
DURATION = Rule(
    "the duration of an infusion",
    frozenset({Kind.CONST, Kind.FUNCTION, Kind.LET, Kind.CONDITION}),
    "numbers, constants and conditions",
    "GB427",
)
SPREAD = Rule(
    "how far values lie apart", frozenset({Kind.CONST, Kind.LEARN, Kind.FUNCTION}), "a number or a constant", "GB422"
)
NOISE = Rule(
    "a noise",
    frozenset({Kind.CONST, Kind.LEARN, Kind.FUNCTION}),
    "numbers, constants, learnable constants and `y`, the prediction",
    "GB224",
)
CORRELATED = Rule("`correlate`", frozenset({Kind.LEARN}), "learnable constants with a distribution", "GB424")
DISTURBANCE = Rule(
    "a diffusion",
    _FIXED | {Kind.CONDITION, Kind.INPUT, Kind.STATE},
    "constants, learnable constants, conditions, inputs and the disturbed state itself",
    "GB340",
)
TIMING = Rule(
    "the time of an event",
    _FIXED | {Kind.CONDITION},
    "constants, learnable constants and conditions",
    "GB352",
)
HISTORY = Rule(
    "a history",
    _FIXED | {Kind.CONDITION, Kind.TIME},
    "constants, learnable constants, conditions and the time",
    "GB370",
)
CLAIM = Rule(
    "a `conserve` claim",
    VALUES - {Kind.UNKNOWN},
    "states, constants, learnable constants, conditions, inputs and the time",
    "GB213",
)
