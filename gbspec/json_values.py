"""The types of JSON that the whole package speaks of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

Json: TypeAlias = "str | int | float | bool | Sequence[Json] | Mapping[str, Json] | None"
"""A value that JSON can express."""
JsonObject: TypeAlias = dict[str, Any]
"""An object as it is read from JSON, or from TOML: those who ask it for a key know what is there."""
