"""Events within steps. Only modules of models with events have them, without everything above the line `# <body>`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gbspec.backends.module.template.arithmetic import _torch_arithmetic
from gbspec.backends.module.template.vectors import _tensor

# <body>
# ---------------------------------------------------------------------- events
# `equations.events` has (name, timed, armed) of each event, in the order in which they happen at one time, timed ones
# first; `guards` a number for each of the others, which becomes positive or zero where its condition becomes true;
# `ranks` the priority of each event, where one is computed (else the order is that of `events`);
# `timing` the first time of each timed one, its interval and its last time (None where there is none); `happen` the
# state after each event. A step is cut where an event happens: its time is found without derivatives, and a last
# correction by Newton's method gives it those of the implicit function.

_CASCADE = 100  # most events at one time
_TICK = 1e3  # rates are differences over at least so many bands, in steps of which nothing else would be seen
_CLOSE = 100  # most times of events in one step
_SHORT = 20  # most of them that follow each other within the band
_FALLING, _NEAR = 6, 1e5  # so many ever shorter intervals, the last within this many bands or ten ticks, have no end


def _band(x: Any, grid: list[float]) -> float:
    """How far apart times are the same one: at least their rounding in the type of `x`, or a periodic event at the end
    of a step would happen twice in float32."""
    import torch

    return max(1e-11 * (grid[-1] - grid[0]), torch.finfo(x.dtype).eps * max(abs(grid[0]), abs(grid[-1])))


class _Events:
    """Steps of a batch that are cut where events happen, in each row at times of its own.

    `given` are conditions, constants and networks; `quiet` the same for the search, which records nothing. Within
    `band` of its end a step leaves an event to the next one, so that what arrives at that time comes first. Where
    events follow each other without end the state becomes NaN, and `trouble` says why (`strict`: ArithmeticError).
    """

    def __init__(self, equations: Any, given: Any, quiet: Any, band: float, strict: bool) -> None:
        self.equations, self.given, self.quiet, self.band, self.strict = equations, given, quiet, band, strict
        self.timed = sum(timed for _, timed, _ in equations.events)
        self.trouble = ""

    def across(self, t: Any, h: Any, x: Any, u: Any, origin: Any, before: Any, divide: Any = None) -> Any:
        """The state after a step of size h from t with inputs `u` at its nodes; trajectories start at `origin`, and
        `before` are state and inputs before what arrived at t. `divide(size)`, for methods with matrices, is the
        division by that of a part with some size; without it each part has a matrix of its own."""
        import torch

        span = self._span(t, h, x, u)
        span.divide = divide
        x, on, turn, rated = self._begun(span, x, origin, before)
        at, left = span.begin, span.length
        gaps = _Gaps(at, self.band, span.tick)
        for _ in range(_CLOSE):
            with torch.no_grad():
                wait, last = self._waits(span, at.detach(), left.detach(), x.detach(), on, turn, rated)
                rated, first = None, wait.amin(-1)
                found = gaps.bounded(first)
            if not found.any():
                end = span.step(at, left, x, self.given) if torch.is_grad_enabled() or last is None else last
                return self._without(gaps.endless, end, at)
            size = torch.where(found, torch.where(found, first, torch.zeros_like(first)), left)
            shift = self._correction(span, at, size, x, wait, turn, found)
            held = self._kept(span, at, left, x, on, turn)
            x = span.step(at, size + shift, x, self.given)
            at, left = at + size + shift, torch.where(found, left - size - shift, torch.zeros_like(left))
            pending = found.unsqueeze(-1) & (wait <= (first + 0.01 * self.band).unsqueeze(-1))
            x, on, turn = self._happen(span, at, x, pending, on, turn)
            at, left, x, on, turn = self._settled(span, held, (at, left, x, on, turn))
        return self._without(found | gaps.endless, x, at)

    def ahead(self, t: Any, h: Any, x: Any, u: Any, origin: Any, before: Any, prepare: Any) -> tuple[Any, Any, Any]:
        """For the choice of a step: the state after what happens at its start, the time until the next event in it
        (infinite: none), and its inputs as a function of time. `prepare(x, inputs)` makes `divide` there."""
        span = self._span(t, h, x, u)
        x, on, turn, rated = self._begun(span, x, origin, before)
        span.divide = prepare(x, span.inputs)
        wait, _ = self._waits(span, span.begin, span.length, x, on, turn, rated)
        return x, wait.amin(-1), span.inputs

    def _span(self, t: Any, h: Any, x: Any, u: Any) -> Any:
        return _Span(self, t, h, x, u)

    def _begun(self, span: Any, x: Any, origin: Any, before: Any) -> tuple[Any, Any, Any, Any]:
        """The state after the events at the start of a step, with what `_start` says of it."""
        import torch

        with torch.no_grad():
            on, pending, turn, rated = self._start(span, x.detach(), _tensor(origin, x), before)
        if not pending.any():
            return x, on, turn, rated
        return *self._happen(span, span.begin, x, pending, on, turn), None

    def _kept(self, span: Any, *place: Any) -> Any:
        """What is known of a place, should it be gone back to."""

    def _settled(self, span: Any, held: Any, place: Any) -> Any:
        """Where a step goes on: at the place that it has reached."""
        return place

    def _turned(self, span: Any, chosen: Any) -> None:
        """Called where events were chosen, before conditions are looked at again."""

    def _without(self, endless: Any, x: Any, at: Any) -> Any:
        """The states, NaN in the rows in which events follow each other without end."""
        import torch

        if not endless.any():
            return x
        self._tell("events follow each other at ever shorter intervals", at[endless])
        return torch.where(endless.unsqueeze(-1), torch.full_like(x, float("nan")), x)

    def _tell(self, trouble: str, at: Any) -> None:
        self.trouble = trouble
        if self.strict:
            raise ArithmeticError(f"{trouble} at t = {float(at.max()):.6g}")

    # ---------------------------------------------------------------- the start of a step
    def _start(self, span: Any, x: Any, origin: Any, before: Any) -> tuple[Any, Any, Any, Any]:
        """Which conditions are true, which events what arrived makes happen, the number of the next time of each timed
        event, and the guards with their rates."""
        import torch

        guard, rate = self._rated(span, span.begin.detach(), x)
        zone = 2 * self.band * rate.abs()
        starting = ((span.begin - origin).abs() <= self.band).unsqueeze(-1)
        on = torch.where(starting, guard >= 0, (guard > zone) | ((guard >= 0) & (rate <= 0)))
        earlier = guard
        if before is not None:
            earlier = self._guards(span.begin.detach(), before[0].detach(), before[1], self.quiet)
        arrived = (earlier < 0) & (guard >= 0) & ((earlier < -zone) | (guard > zone))
        armed = torch.tensor([armed for _, timed, armed in self.equations.events if not timed], dtype=torch.bool)
        arrived = arrived | (starting & armed.to(x.device) & (guard >= 0))
        times = [self._number(time, span, origin) for time in self._timing(self.quiet)]
        none = torch.zeros((*x.shape[:-1], self.timed), dtype=torch.bool, device=x.device)
        turn = torch.stack(times, -1) if times else x.new_zeros((*x.shape[:-1], 0))
        self.origin = origin
        return on & ~arrived, torch.cat([none, arrived], -1), turn, (guard, rate)

    def _number(self, timing: Any, span: Any, origin: Any) -> Any:
        """How many times of a timed event lie before a step."""
        import torch

        begin = span.begin.detach()
        at, every, _ = timing
        passed = begin - 2 * self.band - (origin if at is None else at)
        if every is None:
            return (passed > 0).to(begin.dtype)
        return torch.clamp(torch.ceil(passed / every), min=0.0)

    def _timing(self, given: Any) -> Any:
        condition, constants, _ = given
        return self.equations.timing(_torch_arithmetic(), condition, constants) if self.timed else ()

    # ---------------------------------------------------------------- guards and their rates
    def _guards(self, t: Any, x: Any, u: Any, given: Any) -> Any:
        condition, constants, networks = given
        return self.equations.guards(_torch_arithmetic(), t, x, condition, u, constants, networks)

    def _rated(self, span: Any, t: Any, x: Any) -> tuple[Any, Any]:
        """The guards at a state, and their rates of change, by a difference, since no result contains them."""
        condition, constants, networks = self.quiet
        u = span.inputs(t)
        speed = self.equations.rhs(_torch_arithmetic(), t, x, condition, u, constants, networks)
        guard = self._guards(t, x, u, self.quiet)
        later = self._guards(t + span.tick, x + span.tick.unsqueeze(-1) * speed, span.inputs(t + span.tick), self.quiet)
        return guard, (later - guard) / span.tick.unsqueeze(-1)

    def _after(self, span: Any, at: Any, size: Any, x: Any) -> tuple[Any, Any, Any]:
        """Guards and their rates after a step of some size, and the state there."""
        end = span.step(at, size, x, self.quiet)
        return *self._rated(span, at + size, end), end

    def _pace(self, span: Any, at: Any, size: Any, x: Any, which: Any) -> Any:
        """How the guard of the event with the number `which` changes with the size of the step, exactly."""
        import torch

        with torch.enable_grad():
            size = size.detach().requires_grad_()
            end = span.step(at.detach(), size, x.detach(), self.quiet)
            guard = self._guards(at.detach() + size, end, span.inputs(at.detach() + size), self.quiet)
            guards = torch.cat([size.unsqueeze(-1).expand(*size.shape, self.timed), guard], -1)
            return torch.autograd.grad(guards.gather(-1, which).sum(), size)[0]

    # ---------------------------------------------------------------- times
    def _waits(self, span: Any, at: Any, left: Any, x: Any, on: Any, turn: Any, start: Any) -> tuple[Any, Any]:
        """The time until each event happens in the rest of a step [..., events], infinite where it does not; and the
        state at its end, if that was computed."""
        import torch

        limit = left - 2 * self.band
        found = [time - at for time in self._times(self.quiet, turn)]
        found = [torch.where((wait < limit) & (left > 0), wait.clamp(min=0.0), torch.inf) for wait in found]
        last = None
        if on.shape[-1]:
            start = self._rated(span, at, x) if start is None else start
            end = self._after(span, at, left, x)
            last = end[2]
            for j in range(on.shape[-1]):
                ends = tuple(part[..., j] for part in (*start, *end[:2]))
                if not _Search.needed(on[..., j], ends).any():
                    found.append(torch.full_like(at, torch.inf))
                    continue

                def follow(size: Any, j: int = j) -> tuple[Any, Any]:
                    value, rate, _ = self._after(span, at, size, x)
                    return value[..., j], rate[..., j]

                search = _Search(follow, left)
                wait = search.first(on[..., j], ends, 2 * self.band, at)
                found.append(torch.where((wait < limit) & (left > 0), wait, torch.inf))
        return torch.stack(found, -1), last

    def _times(self, given: Any, turn: Any) -> list[Any]:
        """The next time of each timed event; infinite after its last one."""
        import torch

        found = []
        for k, (at, every, until) in enumerate(self._timing(given)):
            number = turn[..., k]
            first = (self.origin if at is None else at) + torch.zeros_like(number)
            time = first if every is None else first + number * every
            gone = number > 0 if every is None else torch.as_tensor(every <= 0) & (number > 0)
            if until is not None:
                gone = gone | (time > until + self.band)
            found.append(torch.where(gone, torch.full_like(time, torch.inf), time))
        return found

    def _correction(self, span: Any, at: Any, size: Any, x: Any, wait: Any, turn: Any, found: Any) -> Any:
        """What is missing of the time of the first event: almost zero, with its derivatives."""
        import torch

        which = wait.argmin(-1, keepdim=True)
        pace = self._pace(span, at, size, x, which)
        pace = torch.where(found & (pace != 0), pace, torch.ones_like(pace))
        now = at + size
        values = [now - torch.where(torch.isfinite(time), time, now) for time in self._times(self.given, turn)]
        if wait.shape[-1] > self.timed:
            end = span.step(at, size, x, self.given)
            values += self._guards(now, end, span.inputs(now), self.given).unbind(-1)
        value = torch.stack([part.expand(found.shape) for part in values], -1).gather(-1, which)[..., 0]
        return torch.where(found, -value / pace, torch.zeros_like(value))

    # ---------------------------------------------------------------- what events do
    def _happen(self, span: Any, at: Any, x: Any, pending: Any, on: Any, turn: Any) -> tuple[Any, Any, Any]:
        """The state after the pending events, and after those that they cause."""
        import torch

        condition, constants, networks = self.given
        for _ in range(_CASCADE):
            acting = pending.any(-1)
            if not acting.any():
                return x, on, turn
            first = self._first(span, at.detach(), x.detach(), pending)
            chosen = torch.nn.functional.one_hot(first, pending.shape[-1]).bool() & acting.unsqueeze(-1)
            u = span.inputs(at)
            states = self.equations.happen(_torch_arithmetic(), at, x, condition, u, constants, networks)
            after = x
            for k, state in enumerate(states):
                if chosen[..., k].any():
                    after = torch.where(chosen[..., k, None], state, after)
                    if not torch.isfinite(after.detach()[chosen[..., k]]).all():
                        self._tell(f"the event `{self.equations.events[k][0]}` sets what is not a finite number", at)
            with torch.no_grad():
                pending, on, turn = self._follow(
                    span, at.detach(), x.detach(), after.detach(), (pending, on, turn), chosen
                )
            x = after
        self._tell(f"more than {_CASCADE} events happen at one time", at)
        return torch.where(pending.any(-1, keepdim=True), torch.full_like(x, float("nan")), x), on, turn

    def _first(self, span: Any, at: Any, x: Any, pending: Any) -> Any:
        """The number of the pending event that comes first: timed ones, then by priority, then as in `events`."""
        import torch

        if not hasattr(self.equations, "ranks"):
            return pending.to(torch.int64).argmax(-1)
        condition, constants, networks = self.quiet
        ranks = self.equations.ranks(_torch_arithmetic(), at, x, condition, span.inputs(at), constants, networks)
        timed = torch.arange(pending.shape[-1], device=pending.device) < self.timed
        pending = torch.where((pending & timed).any(-1, keepdim=True), pending & timed, pending)
        lowest = torch.full_like(ranks, -torch.inf)
        return torch.where(pending, torch.nan_to_num(ranks, nan=torch.finfo(x.dtype).min), lowest).argmax(-1)

    def _follow(self, span: Any, at: Any, x: Any, after: Any, flags: Any, chosen: Any) -> tuple[Any, Any, Any]:
        """What is pending, true and next after the chosen events."""
        import torch

        pending, on, turn = flags
        u, fired = span.inputs(at), chosen[..., self.timed :]
        earlier = self._guards(at, x, u, self.quiet)
        self._turned(span, chosen)
        guard, rate = self._rated(span, at, after)
        zone = 2 * self.band * rate.abs()
        acting = chosen.any(-1, keepdim=True)
        caused = acting & ~on & ~fired & (guard >= 0) & ((earlier < 0) | (guard > zone))
        # A guard that the event did not change is zero up to rounding: only its rate says which sign follows.
        still = torch.where(guard == earlier, (rate > 0) | (guard > zone), guard >= 0)
        on = torch.where(acting, (on | fired) & still, on)
        pending = pending & ~chosen
        pending[..., self.timed :] |= caused
        return pending, on, turn + chosen[..., : self.timed].to(turn.dtype)


class _Span:
    """A step that events may cut: its start, its length, and the inputs within it, which are linear in time."""

    def __init__(self, events: _Events, t: Any, h: Any, x: Any, u: Any) -> None:
        self._equations, self._first, self._last = events.equations, u[0], u[-1]
        self.begin, self.length = (_tensor(value, x).expand(x.shape[:-1]) for value in (t, h))
        self.divide: Any = None
        length = self.length.detach()
        self._unit = length.where(length != 0, length + 1)
        self.tick = (1e-6 * self._unit).clamp(min=_TICK * events.band)

    def inputs(self, time: Any) -> Any:
        """The inputs at a time in the step."""
        if not self._first.shape[-1]:
            return self._first
        length = self.length.where(self.length != 0, self._unit)
        return self._first + ((time - self.begin) / length).unsqueeze(-1) * (self._last - self._first)

    def step(self, time: Any, size: Any, x: Any, given: Any) -> Any:
        """One step of the method from some time within."""
        m = _torch_arithmetic()
        grid = self._equations.grid(m, time, size)
        u = tuple(self.inputs(node) for node in grid[0])
        solve = () if self.divide is None else (self.divide(size),)
        return self._equations.step(m, self._equations.field(m, *given), grid, x, u, *solve)


class _Gaps:
    """The intervals between events within a step, and the rows in which these have no end.

    Where each one is shorter than the one before, rounding would hide the next events long before they are as short as
    the band; a ball would fall through the floor.
    """

    def __init__(self, like: Any, band: float, tick: Any) -> None:
        import torch

        # Rates of conditions are differences over a tick, and say nothing where intervals are shorter.
        self.near = (10 * tick).clamp(min=_NEAR * band)
        self.band, self.last = band, torch.full_like(like, torch.inf)
        self.short, self.falling, self.endless = (torch.zeros_like(like, dtype=torch.int64) for _ in range(3))
        self.endless = self.endless > 0

    def bounded(self, first: Any) -> Any:
        """Where there is a next event, after the time `first`, and its row has an end."""
        import torch

        found = torch.isfinite(first)
        self.short = torch.where(found & (first <= self.band), self.short + 1, 0)
        self.falling = torch.where(found & (first < 0.99 * self.last), self.falling + 1, 0)
        near = (self.falling > _FALLING) & (first <= self.near)
        self.endless = self.endless | (self.short > _SHORT) | (found & near)
        self.last = first
        return found & ~self.endless


class _Search:
    """The search for the first time at which a guard becomes positive, from `follow(size)`: its value and its rate."""

    def __init__(self, follow: Callable[[Any], tuple[Any, Any]], left: Any) -> None:
        self.follow, self.left = follow, left

    @staticmethod
    def needed(on: Any, ends: Any) -> Any:
        """Where an event is possible, by value and rate at both ends of a step."""
        g0, r0, g1, r1 = ends
        return ((g1 >= 0) & (~on | ((r0 < 0) & (r1 > 0)))) | (~on & (((r0 > 0) & (r1 < 0)) | (g0 >= 0)))

    def first(self, on: Any, ends: Any, band: float, at: Any) -> Any:
        """The time; infinite where there is none. `ends`: value and rate at both ends; `on`: the condition is true."""
        import torch

        g0, r0, g1, r1 = ends
        due = ~on & (g0 >= 0) & (g0 <= band * r0.abs()) & (r0 > 0)
        below = ~on & (g0 < 0)
        above = ~below & ~due
        low, high = torch.zeros_like(g0), self.left.clone()
        crosses = below & (g1 >= 0)
        peak = below & (g1 < 0) & (r0 > 0) & (r1 < 0)
        if peak.any():
            place, value = self._extreme(ends, peak, 1.0)
            crosses, high = crosses | (peak & (value > 0)), torch.where(peak, place, high)
        dip = above & (g1 >= 0) & ((r0 < 0) & (r1 > 0))
        if dip.any():
            place, value = self._extreme(ends, dip, -1.0)
            crosses, low = crosses | (dip & (value < 0)), torch.where(dip, place, low)
        wait = torch.where(due, torch.zeros_like(g0), torch.full_like(g0, torch.inf))
        return torch.where(crosses, self._root(low, high, crosses, at), wait) if crosses.any() else wait

    def _extreme(self, ends: Any, rows: Any, sign: float) -> tuple[Any, Any]:
        """A time within the step at which the guard, as a cubic polynomial, has its extremum, and its value there;
        repeated on the part of the step with the extremum while the sign is not the wanted one."""
        import torch

        ga, ra, gb, rb = ends
        a, b = torch.zeros_like(ga), self.left.clone()
        for _ in range(4):
            length = torch.where(b > a, b - a, torch.ones_like(a))
            chord = (gb - ga) / length
            square, linear = 3 * (ra + rb - 2 * chord), 2 * (3 * chord - 2 * ra - rb)
            root = torch.sqrt((linear**2 - 4 * square * ra).clamp(min=0.0))
            half = -0.5 * (linear + torch.where(linear < 0, -root, root))
            one, other = half / square, ra / half
            share = torch.where((one > 0) & (one < 1), one, other)
            share = torch.where((share > 0) & (share < 1), share, torch.full_like(share, 0.5))
            place = torch.where(rows, a + share * (b - a), self.left)
            value, rate = self.follow(place)
            if bool((sign * value[rows] > 0).all()):
                break
            early = sign * rate > 0
            a, ga, ra = (torch.where(early, new, old) for new, old in ((place, a), (value, ga), (rate, ra)))
            b, gb, rb = (torch.where(early, old, new) for new, old in ((place, b), (value, gb), (rate, rb)))
        return place, value

    def _root(self, low: Any, high: Any, rows: Any, at: Any) -> Any:
        """The time at which the guard is zero, between one at which it is negative and one at which it is not."""
        import torch

        exact = 4 * torch.finfo(low.dtype).eps * (at.abs() + self.left)
        size = torch.where(rows, 0.5 * (low + high), self.left)
        done = ~rows
        for _ in range(100):
            value, rate = self.follow(size)
            low, high = torch.where(value < 0, size, low), torch.where(value < 0, high, size)
            new = size - value / rate
            close = (new - size).abs() <= exact
            inside = torch.isfinite(new) & (new >= low) & (new <= high)
            new = torch.where(inside | close, new, 0.5 * (low + high))
            size = torch.where(done, size, new)
            done = done | close | (high - low <= exact)
            if done.all():
                break
        return size.clamp(min=0.0)
