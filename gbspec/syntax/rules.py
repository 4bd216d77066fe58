"""What may stand in an expression, by where it stands."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.syntax.kinds import VALUES, Kind


@dataclass(frozen=True)
class Rule:
    """An expression's place: how to call it, what may be named in it, and the code of a finding against it."""

    place: str
    allowed: frozenset[Kind]
    meant: str
    code: str = "GB213"
    refused_within: frozenset[Kind] = frozenset()
    """Kinds that may stand there themselves, but not inside a `let` or a function that is named there."""


_FIXED = frozenset({Kind.CONST, Kind.LEARN, Kind.FUNCTION, Kind.LET})

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
    "constants, learnable constants, conditions and the starts of other states",
    "GB308",
)
DOSING = Rule(
    "the fraction or the lag of a dose",
    _FIXED | {Kind.CONDITION},
    "constants, learnable constants and conditions",
    "GB313",
)
CLAIM = Rule(
    "a `conserve` claim",
    VALUES - {Kind.UNKNOWN},
    "states, constants, learnable constants, conditions, inputs and the time",
    "GB213",
)
