"""Switches of right-hand sides within steps. Only modules of models whose steps are cut there have them, without
everything above the line `# <body>`."""

from __future__ import annotations

from typing import Any

from gbspec.backends.module.template.events import _Events, _Span

# <body>
# ---------------------------------------------------------------------- switches
# The last `equations.switches` pairs of events are switches of right-hand sides: they set nothing, and happen where a
# quantity becomes positive, and negative. While a part of a step is taken, right-hand sides are held on one side of
# each by a number behind the inputs, which is added to that quantity.

_HELD = 1e30  # a number beyond every such quantity
_MOST_SWITCHES = 6  # most times of switches in one step


class _Switched(_Events):
    """Steps that are cut where right-hand sides switch, besides events.

    Where that cannot be done, the rest of a step is taken as without: from before a switch along which the solution
    slides, since both sides lead to it; after more than `_MOST_SWITCHES` switches; where a part ends on the other side
    without a switch on its way. Where a right-hand side has no value beyond its switch, steps are cut, but nothing is
    held.
    """

    def __init__(self, equations: Any, given: Any, quiet: Any, band: float, strict: bool) -> None:
        super().__init__(equations, given, quiet, band, strict)
        self.first = len(equations.events) - 2 * equations.switches
        self.split = self.first - self.timed

    def _span(self, t: Any, h: Any, x: Any, u: Any) -> Any:
        return _Sides(self, t, h, x, u)

    def _start(self, span: Any, x: Any, origin: Any, before: Any) -> tuple[Any, Any, Any, Any]:
        import torch

        if before is not None:
            before = before[0], torch.cat([before[1], torch.zeros_like(span.sides)], -1)
        on, pending, turn, rated = super()._start(span, x, origin, before)
        guard, rate = (part[..., self.split :] for part in rated)
        on[..., self.split :], span.sides = self._placed(guard, rate)
        pending[..., self.first :] = False
        return on, pending, turn, None if (guard.abs() <= 2 * self.band * rate.abs()).any() else rated

    def _placed(self, guard: Any, rate: Any) -> tuple[Any, Any]:
        """Which events of switches are not to come, and the sides, at a state with these guards."""
        import torch

        on = (guard > 2 * self.band * rate.abs()) | ((guard >= 0) & (rate <= 0))
        up, down = on[..., ::2], on[..., 1::2]
        # Where neither is true the switch lies here, and the side before it counts.
        above = up | (~down & (guard[..., ::2] < 0))
        return on, torch.where(above, _HELD, -_HELD).to(guard.dtype)

    def _waits(self, span: Any, at: Any, left: Any, x: Any, on: Any, turn: Any, start: Any) -> tuple[Any, Any]:
        import torch

        wait, last = super()._waits(span, at, left, x, on, turn, start)
        if (lost := ~torch.isfinite(last).all(-1) & (span.sides != 0).any(-1)).any():
            span.release(lost)
            wait, last = super()._waits(span, at, left, x, on, turn, None)
        wait = self._allowed(span, wait)
        crossing = torch.isfinite(wait.amin(-1)) & (wait.argmin(-1) >= self.first)
        if (many := crossing & (span.count >= _MOST_SWITCHES)).any():
            span.suspend(many.unsqueeze(-1))
            wait, last = super()._waits(span, at, left, x, on, turn, None)
            wait = self._allowed(span, wait)
        span.count = span.count + crossing.to(span.count.dtype)
        if (missed := self._missed(span, at, left, last) & ~torch.isfinite(wait.amin(-1))).any():
            span.release(missed)
            last = torch.where(missed.unsqueeze(-1), span.step(at, left, x, self.quiet), last)
        return wait, last

    def _allowed(self, span: Any, wait: Any) -> Any:
        """The waits without those for suspended switches."""
        import torch

        out = wait.clone()
        out[..., self.first :] = torch.where(span.pairs(span.suspended), torch.inf, wait[..., self.first :])
        return out

    def _missed(self, span: Any, at: Any, left: Any, end: Any) -> Any:
        """Where the rest of a step, taken on some sides of the switches, ends on the other side of one."""
        guard, rate = (part[..., self.split :: 2] for part in self._rated(span, at + left, end))
        beyond = guard.abs() > 4 * self.band * rate.abs()
        return ((guard * span.sides < 0) & beyond).any(-1) & (left > 0)

    def _kept(self, span: Any, *place: Any) -> Any:
        return place, span.sides

    def _settled(self, span: Any, held: Any, place: Any) -> Any:
        import torch

        if not span.slid.any():
            return place
        rows, (earlier, sides) = span.slid, held
        span.sides = torch.where(rows.unsqueeze(-1) & ~span.released, sides, span.sides)
        span.slid = torch.zeros_like(rows)
        wide = [rows if then.ndim == rows.ndim else rows.unsqueeze(-1) for then in earlier]
        return tuple(torch.where(*each) for each in zip(wide, earlier, place, strict=True))

    def _turned(self, span: Any, chosen: Any) -> None:
        import torch

        up, down = chosen[..., self.first :: 2], chosen[..., self.first + 1 :: 2]
        turned = (up | down) & ~span.released
        span.sides = torch.where(turned, torch.where(up, _HELD, -_HELD).to(span.sides.dtype), span.sides)

    def _follow(self, span: Any, at: Any, x: Any, after: Any, flags: Any, chosen: Any) -> tuple[Any, Any, Any]:
        import torch

        pending, on, turn = super()._follow(span, at, x, after, flags, chosen)
        earlier = self._guards(at, x, span.inputs(at), self.quiet)[..., self.split :]
        guard, rate = (part[..., self.split :] for part in self._rated(span, at, after))
        fired, own = chosen[..., self.first :], on[..., self.split :]
        # An event that changes the state may put it on another side, without a switch on the way.
        jumped = chosen.any(-1, keepdim=True) & (guard != earlier) & ~fired
        placed, sides = self._placed(guard, rate)
        on = torch.cat([on[..., : self.split], torch.where(jumped, placed, own)], -1)
        span.sides = torch.where(jumped[..., ::2] & ~span.released, sides, span.sides)
        # A quantity that does not go on to the side that it has reached slides.
        slides = fired & ~own
        span.suspend(slides[..., ::2] | slides[..., 1::2])
        span.slid = span.slid | slides.any(-1)
        waiting = flags[0][..., self.first :] & ~fired & ~jumped & ~span.pairs(span.suspended)
        return torch.cat([pending[..., : self.first], waiting], -1), on, turn


class _Sides(_Span):
    """A step with the sides [..., switches] on which right-hand sides are held, behind the inputs; 0: not held."""

    def __init__(self, events: _Switched, t: Any, h: Any, x: Any, u: Any) -> None:
        import torch

        super().__init__(events, t, h, x, u)
        self.sides = torch.zeros((*x.shape[:-1], events.equations.switches), dtype=x.dtype, device=x.device)
        self.suspended, self.released = (torch.zeros_like(self.sides) > 0 for _ in range(2))
        self.count = torch.zeros(x.shape[:-1], dtype=torch.int64, device=x.device)
        self.slid = self.count > 0

    def inputs(self, time: Any) -> Any:
        import torch

        return torch.cat([super().inputs(time).expand(*self.sides.shape[:-1], -1), self.sides], -1)

    def pairs(self, each: Any) -> Any:
        """A value of each switch for both of its events."""
        return each.repeat_interleave(2, -1)

    def release(self, rows: Any) -> None:
        """Holds nothing any more in some rows."""
        import torch

        self.released = self.released | rows.unsqueeze(-1)
        self.sides = torch.where(self.released, torch.zeros_like(self.sides), self.sides)

    def suspend(self, which: Any) -> None:
        """Neither holds nor cuts at these switches any more."""
        import torch

        self.suspended = self.suspended | which
        self.released = self.released | which
        self.sides = torch.where(self.suspended, torch.zeros_like(self.sides), self.sides)
