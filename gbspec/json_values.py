"""Types of JSON values, used throughout the package."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

Json: TypeAlias = "str | int | float | bool | Sequence[Json] | Mapping[str, Json] | None"
"""A value that JSON can express."""
JsonObject: TypeAlias = dict[str, Any]
"""An object read from JSON or TOML; its readers know the types of its values."""
