"""The kinds of names in a model."""

from __future__ import annotations

from enum import Enum


class Kind(Enum):
    """The kind of a name; the value is its description in messages."""

    TIME = "the time"
    STATE = "a state"
    CONDITION = "a condition"
    INPUT = "an input"
    CONST = "a constant"
    LEARN = "a learnable constant"
    LET = "a `let`"
    FUNCTION = "a function"
    TABLE = "a table"
    UNKNOWN = "an unknown function"
    PROCESS = "a process"
    CHANNEL = "a measured channel"
    CLAIM = "a `conserve` claim"
    EVENT = "an event"
    ALGEBRAIC = "an algebraic variable"
    EQUATION = "an equation"


VALUES = frozenset(Kind) - {Kind.CHANNEL, Kind.CLAIM, Kind.EVENT, Kind.EQUATION}
"""The kinds that may occur in an expression."""
