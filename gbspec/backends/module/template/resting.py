"""Steady starts with events on the way. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

from typing import Any

from gbspec.backends.module.template.events import _Events
from gbspec.backends.module.template.vectors import _tensor

# <body>
# ---------------------------------------------------------------------- steady starts with events
# Where events lie on the way to a steady state, the solution itself is followed, row by row: by steps of the module's
# method that are cut at events, each compared with two of half its size. Where the Jacobian at rest is regular,
# Newton's method ends it, and derivatives are those of the implicit function; else the rest is where the solution
# ended, with the derivatives of the steps.

_PRECISE = 1e-9  # error of a step, relative
_PATIENCE = 3_000  # most steps
_ENDLESS = "the solution from the declared starts, with its events, does not come to rest"


class _Calm(_Events):
    """Steps in which no event happens at a given time: times count from the start of a trajectory."""

    def _times(self, given: Any, turn: Any) -> list[Any]:
        import torch

        return [torch.full_like(turn[..., k], torch.inf) for k in range(self.timed)]


def _calmed(
    equations: Any, m: Any, start: Any, condition: Any, inputs: Any, constants: Any, networks: Any, search: Any
) -> tuple[Any, dict[int, tuple[int, str]]]:
    """What `_rested` returns, for models with events whose conditions may become true on the way."""
    import torch

    condition, inputs, _, _ = equations.steady(m, condition, inputs, constants)
    found, failed = [], {}
    for row in range(len(start)):
        own = tuple(value if value.ndim == 0 else value[row : row + 1] for value in constants)
        given = condition[row : row + 1], own, networks
        x, trouble = _Follower(equations, m, given, inputs[row : row + 1]).rest(start[row : row + 1])
        if trouble:
            x, failed[row] = torch.full_like(x, torch.nan), trouble
        found.append(x)
    return torch.cat(found), failed


class _Follower:
    """The solution of one row from its declared start; conditions and inputs do not change on the way."""

    def __init__(self, equations: Any, m: Any, given: Any, inputs: Any) -> None:
        import torch

        self.equations, self.m, self.given, self.u = equations, m, given, (inputs, inputs)
        self.free = list(equations.steady_states)
        self.rounding = torch.finfo(inputs.dtype).eps
        self.precise = max(_PRECISE, 200 * self.rounding)

    def rest(self, x: Any) -> tuple[Any, tuple[int, str] | None]:
        """The state at rest [1, n], or the state that moves most and the reason."""
        import torch

        origin, band, trouble, h, floor = 0.0, 0.0, "", None, None
        for _ in range(_PATIENCE):
            f, size = self.slopes(x).detach(), x.detach().abs()
            if floor is None:
                floor = torch.maximum(1e-3 * size, 1e-6 * size.amax().clamp(min=torch.finfo(x.dtype).tiny))
            size = size + floor
            if self.still(x, f, size):
                return self.ended(x, size), None
            if h is None:
                h = 1e-2 / float((f.abs() / size).amax())
            band = max(max(1e-11, 4 * self.rounding) * h, band)
            calm = _Calm(self.equations, self.given, self.given, band, False)
            with torch.no_grad():
                error = self.error(calm, h, x.detach(), origin, size)
            if error <= 1.0:
                x, origin = self.halves(calm, h, x, origin), -1.0
            elif (trouble := calm.trouble) or h * float((f.abs() / size).amax()) < 1e-15:
                break
            h *= min(max(0.8 * max(error, 1e-10) ** -0.2, 0.2), 4.0) if error < float("inf") else 0.2
        return x, (int((f.abs() / size)[0, self.free].argmax()), trouble or _ENDLESS)

    def slopes(self, x: Any) -> Any:
        """The rates of change [1, n]."""
        return self.equations.field(self.m, *self.given)(_tensor(0.0, x), x, self.u[0])

    def places(self, x: Any) -> Any:
        import torch

        return torch.tensor(self.free, dtype=torch.int64, device=x.device)

    def halves(self, calm: Any, h: float, x: Any, origin: float) -> Any:
        """Two steps of half the size; only at the first start no condition has become true yet."""
        for begin in (origin, -1.0):
            x = calm.across(0.0, h / 2, x, self.u, begin, None)
        return x

    def error(self, calm: Any, h: float, x: Any, origin: float, size: Any) -> float:
        """The difference of one step and two of half its size, in what is accepted."""
        once, twice = calm.across(0.0, h, x, self.u, origin, None), self.halves(calm, h, x, origin)
        found = float(((once - twice).abs() / (self.precise * (size + twice.abs()))).amax())
        return found if found == found else float("inf")

    def still(self, x: Any, f: Any, size: Any) -> bool:
        """Whether nothing changes any more: the slowest rate of the Jacobian says what is still to come."""
        if not bool((f != 0).any()):
            return True
        if float((f.abs() / size).amax()) > 1e-3 * float(self.jacobian(x).abs().amax()):
            return False
        rates = self.rates(x)
        sizes = rates.abs()
        moving = sizes > 1e-12 * sizes.amax()
        if not bool(moving.any()) or float(rates.real.amax()) > 1e-9 * float(sizes.amax()):
            return False
        return float((f.abs() / size).amax()) <= self.precise * float(sizes[moving].amin())

    def rates(self, x: Any) -> Any:
        import torch

        return torch.linalg.eigvals(self.jacobian(x))

    def jacobian(self, x: Any) -> Any:
        """Derivatives [s, s] of the free states' rates by these states, at one point."""
        import torch

        with torch.enable_grad():
            at = x.detach().requires_grad_()
            f = self.slopes(at)
            rows = [
                torch.autograd.grad(f[0, i], at, retain_graph=True, allow_unused=True)[0] if f.requires_grad else None
                for i in self.free
            ]
        zero = x.new_zeros(len(self.free))
        return torch.stack([zero if row is None else row[0, self.free] for row in rows])

    def ended(self, x: Any, size: Any) -> Any:
        """The state at rest, by Newton's method where the Jacobian is regular."""
        import torch

        scale = size[0, self.free]
        z = x
        for _ in range(4):
            matrix = self.jacobian(z) * scale
            tiny = torch.finfo(matrix.dtype).tiny
            values = torch.linalg.svdvals(matrix / matrix.abs().amax(-1, keepdim=True).clamp(min=tiny))
            if not bool(torch.isfinite(values).all()) or not float(values[-1]) > 1e-10 * float(values[0]):
                return x
            # Only what rests is without the steps' derivatives: these are those of the implicit function.
            begun = x.index_copy(-1, self.places(x), z.detach()[:, self.free])
            step = torch.linalg.solve(matrix, self.slopes(begun)[0, self.free]) * scale
            z = begun.index_add(-1, self.places(x), -step.unsqueeze(0))
        return z
