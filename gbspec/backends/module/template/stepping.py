"""Adaptive steps of the module's own solutions. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# <body>
# ---------------------------------------------------------------------- adaptive steps


class _Adaptive:
    """Steps whose two halves agree with the whole within a relative tolerance, the same for all rows of a batch."""

    def __init__(self, tolerance: float, limit: float | None) -> None:
        self.tolerance, self.limit = tolerance, limit
        self.size: float | None = None
        self.largest: Any = None

    def across(self, step: Callable[[float, float, Any], Any], x: Any, start: float, end: float) -> Any:
        """The state at the end of a span, from `step(t, h, x)`. Raises ArithmeticError where there is none."""
        t, size = start, self.size or (end - start)
        while t < end:
            size = min(size, self.limit or size)
            h = end - t if size >= 0.999 * (end - t) else size
            whole, half = step(t, h, x), step(t + h / 2, h / 2, step(t, h / 2, x))
            error = self._error(x, whole, half)
            if error <= 1:
                x, t = half, end if h == end - t else t + h
            elif t + 0.1 * h == t:
                raise ArithmeticError(f"there is no solution beyond {t:.6g}: its steps became too short")
            factor = min(max(0.9 * max(error, 1e-10) ** -0.25, 0.1), 5.0)
            # A step that was cut at the end of the span says nothing against the longer one that was wanted.
            size = max(size, h * factor) if error <= 1 and h < size else h * factor
        self.size = size
        return x

    def _error(self, x: Any, whole: Any, half: Any) -> float:
        """The largest difference in units of the tolerance; infinite where it is not a number."""
        sizes = [value.detach().abs().reshape(-1, value.shape[-1]).amax(0) for value in (x, half)]
        largest = sizes[0] if self.largest is None else self.largest
        floor = 1e-3 * largest.maximum(sizes[0]) + 1e-6 * largest.maximum(sizes[0]).max()
        limit = self.tolerance * (half.detach().abs().maximum(x.detach().abs()) + floor + 1e-300)
        found = float(((half - whole).detach().abs() / limit).max())
        if not found < float("inf"):
            return float("inf")
        self.largest = largest.maximum(sizes[0]).maximum(sizes[1]) if found <= 1 else largest
        return found
