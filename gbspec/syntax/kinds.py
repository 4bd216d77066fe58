"""What the names of a model stand for."""

from __future__ import annotations

from enum import Enum


class Kind(Enum):
    """What a name stands for; the value is how a person would call it."""

    TIME = "the time"
    STATE = "a state"
    CONDITION = "a condition"
    INPUT = "an input"
    CONST = "a constant"
    LEARN = "a learnable constant"
    LET = "a `let`"
    FUNCTION = "a function"
    UNKNOWN = "an unknown function"
    PROCESS = "a process"
    CHANNEL = "a measured channel"
    CLAIM = "a `conserve` claim"


VALUES = frozenset(Kind) - {Kind.CHANNEL, Kind.CLAIM}
"""What may stand in an expression."""
