"""The stage that looks for other maxima of a likelihood at rest: those as high, or higher, are named.

A much higher one is taken, another one only where it is nearer to the declared starting values.

A search of least squares tries many starts, and a likelihood begins where it ends: that may be between two maxima (two
rates that may be exchanged are fitted as equal), or beside the wrong one. From places where constants have exchanged
their roles (`exchanges`) the likelihood goes on for some iterations, one in each step of the stage; the state of the
trial that is under way is kept beside that of the best maximum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Protocol

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.optimise.equal import ALIKE, differ, listed, nearest, no_rise, said_of_others
from gbspec.training.optimise.exchanges import exchanged, exchanges
from gbspec.training.optimise.stage import Outcome, Stage, State, scalar
from gbspec.training.problem import Bijections

GLANCES, STARTS = 2, 3
"""So many exchanges are looked at for each iteration of the likelihood (a solution takes about a tenth of one), and
from so many it goes on at most."""
FAR = 30.0
"""It goes on where an exchange raises what is looked at by less than this, on the scale of -2 log likelihood."""
SHARE, FEWEST = 1 / 4, 3
"""The share of the iterations of the likelihood that those may take together which are not about as high, and the least
number of these."""
HIGH = 2.0
"""A trial within so much of the maximum, in -2 log likelihood, may take as many iterations as the likelihood did."""
SLOW = 0.1
"""A trial further off ends where an iteration lowers -2 log likelihood by less than this share of what is missing."""
CLEARLY = 10.0
"""A maximum that is higher by less, in -2 log likelihood, is taken only if it is nearer to the declared values: of two
rates that may be exchanged the likelier ones may be those that nobody means (a drug absorbed for days)."""
LEFT = (
    "where this fit was before; that is a maximum too. Narrower bounds or a prior say which is meant, where more is "
    "known than the data tell"
)
TRIAL, FOUND, BEFORE = "trial.", "found{}.", "before."
"""What the entries begin with that are of the trial under way, of other maxima that were found, and of the maximum at
which the stage began, where a higher one was found."""


class Maximised(Protocol):
    """A likelihood that has come to rest, and the constants of it that may exchange their roles."""

    @property
    def fit(self) -> Stage:
        """The stage that maximises it."""

    @property
    def names(self) -> Sequence[str]:
        """The names [k] of the constants."""

    @property
    def maps(self) -> Bijections:
        """Their bounds."""

    @property
    def declared(self) -> Array:
        """Their declared values [k]."""

    @property
    def units(self) -> Array:
        """The exponents [k, d] of their units."""

    @property
    def count(self) -> int:
        """The number of measured values."""

    def at(self, theta: Array) -> State:
        """The state of the fit at a vector at which it has come to rest."""

    def values(self, state: State) -> Array:
        """The constants [k] of a state."""

    def moved(self, state: State, matrix: Array) -> State:
        """The state from which the fit begins after an exchange."""

    def glance(self, state: State) -> float:
        """A number on the scale of -2 log likelihood that an exchange leaves as it is, or about."""

    def objective(self, state: State) -> float:
        """-2 log likelihood with what priors contribute; infinite where the model cannot be solved."""

    def finer(self, state: State) -> float:
        """The same at half the solver's step."""

    def between(self, one: State, other: State) -> float:
        """The same half-way between two states."""


class OtherMaxima:
    """The stage. `taken` is the number of iterations in which the likelihood came to rest."""

    def __init__(self, name: str, total: int, of: Maximised, taken: int) -> None:
        self.name, self.total, self.of = name, total, of
        self.fit = of.fit
        self.share, self.taken = max(int(SHARE * taken), FEWEST), max(taken, FEWEST)

    def possible(self, theta: Array) -> bool:
        """Whether constants may exchange their roles within their bounds."""
        return next(self._exchanges({"theta": theta}), None) is not None

    def _exchanges(self, state: State) -> Iterator[Array]:
        of = self.of
        return exchanges(of.values(state), of.declared, of.maps, of.units)

    def begin(self, theta: Array) -> State:
        """The state at the maximum, with the exchanges from which to go on, the best first."""
        of, state, size = self.of, self.of.at(theta), len(self.of.names)
        matrices, before = list(islice(self._exchanges(state), GLANCES * self.taken)), of.values(state)
        least, first = of.objective(state), of.glance(state)
        rises = np.array([self._glance(state, one) for one in matrices]) - first
        kept: list[Array] = []
        for i in np.argsort(rises, kind="stable"):
            new = exchanged(before, matrices[i])
            if rises[i] < FAR and len(kept) < STARTS and all(differ(new, exchanged(before, one)) for one in kept):
                kept.append(matrices[i])
        numbers = {"used": 0.0, "places": float(len(kept)), "all": 0.0, "begun": least}
        more = {name: np.array(value) for name, value in numbers.items()} | {"first": before}
        return state | more | {"exchanges": np.array(kept).reshape(-1, size, size), "values": np.array([least])}

    def beginning(self, state: State) -> State:
        """The state of the fit at the maximum at which the stage began."""
        return _under(state, BEFORE) or _kept(state)

    def _glance(self, state: State, matrix: Array) -> float:
        return _or_infinite(lambda: self.of.glance(self.of.moved(state, matrix)))

    def step(self, state: State, iteration: int) -> Outcome:
        """One iteration of the trial under way, or of the next one; after the last one the best maximum goes on."""
        state, trial = dict(state), _under(state, TRIAL)
        if scalar(state, "all") >= self.share:
            state["exchanges"] = state["exchanges"][:0]
        if not trial and len(state["exchanges"]):
            trial = self._begun(_kept(state), state["exchanges"][0])
            state |= {"exchanges": state["exchanges"][1:], "used": np.array(0.0)}
        if trial:
            state = self._tried(state, trial)
        if iteration + 1 >= self.total or not (_under(state, TRIAL) or len(state["exchanges"])):
            return self._ended(state)
        places = int(scalar(state, "places"))
        said = f"exchange {places - len(state['exchanges'])} of {places} of constants"
        return Outcome(state, self._loss(state), False, remark=said)

    def _begun(self, state: State, matrix: Array) -> State:
        """The state from which a trial begins; empty where the model cannot be computed there."""
        try:
            return self.of.moved(state, matrix)
        except ComputationError:
            return {}

    def _tried(self, state: State, trial: State) -> State:
        """The state after an iteration of a trial: it goes on, or is a maximum, or has come to nothing."""
        rest = {name: value for name, value in state.items() if not name.startswith(TRIAL)}
        used, whole = int(scalar(state, "used")), int(scalar(state, "all"))
        try:
            outcome = self.fit.step(trial, used)
            rise, before = (self.of.objective(one) - float(state["values"][0]) for one in (outcome.state, trial))
        except ComputationError:
            return rest
        rest |= {"used": np.array(used + 1.0), "all": np.array(whole + float(rise >= HIGH))}
        if outcome.unfinished is not None:
            return rest  # no step leads higher although it is no maximum
        if outcome.done:
            return self._with(rest, outcome.state, rise)
        most = self.total if rise < -ALIKE else self.taken if rise < HIGH else used + self.share - whole
        slow = rise >= HIGH and used > 0 and before - rise < SLOW * rise
        if used + 1 >= most or slow or not self._apart(outcome.state, _kept(rest)):
            return rest
        return rest | _named(TRIAL, outcome.state)

    def _apart(self, one: State, other: State) -> bool:
        return differ(self.of.values(one), self.of.values(other))

    def _with(self, state: State, maximum: State, rise: float) -> State:
        """The state with another maximum, higher by `rise` in -2 log likelihood than the one it began with: those are
        kept that the data do not tell from the best."""
        known = _maxima(state)
        higher = rise < -ALIKE
        if not rise <= ALIKE or not (higher or all(self._separate(maximum, one) for one in known)):
            return state
        # A step that is too long makes maxima up.
        finer = [_or_infinite(partial(self.of.finer, one)) for one in (maximum, known[0])]
        if not np.isfinite(finer).all():
            return state
        rise = max(rise, finer[0] - finer[1])
        values = np.append(state["values"], state["values"][0] + rise)
        kept = np.flatnonzero(values <= values.min() + ALIKE)
        first, *others = ([*known, maximum][i] for i in kept)
        new = _numbers(state) | first | {"values": values[kept]}
        if 0 not in kept:
            new |= _named(BEFORE, _under(state, BEFORE) or known[0])
        for i, one in enumerate(others):
            new |= _named(FOUND.format(i), one)
        return new

    def _separate(self, one: State, other: State) -> bool:
        """Whether two maxima differ in a constant, and half-way between them the likelihood is lower."""
        if not self._apart(one, other):
            return False
        highest = max(self.of.objective(one), self.of.objective(other))
        return not _or_infinite(lambda: self.of.between(one, other)) <= highest + no_rise(self.of.count)

    def _ended(self, state: State) -> Outcome:
        """The end: of maxima as high the one that is nearest to the declared values, else the highest."""
        of, found, rises = self.of, _maxima(state), state["values"] - state["values"].min()
        as_good = np.flatnonzero(rises <= no_rise(of.count))
        places = np.array([of.maps.from_natural(of.values(found[i])) for i in as_good])
        taken = int(as_good[nearest(places, of.maps.from_natural(of.declared))])
        told = [(self._text(of.values(found[i])), float(rises[i])) for i in range(len(found)) if i != taken]
        new: State = _numbers(state) | found[taken] | {"values": np.array([of.objective(found[taken])])}
        fell = scalar(state, "begun") - float(new["values"][0])
        before = _under(state, BEFORE)
        if before and fell < CLEARLY and not self._nearer(found[taken], before):
            return self._stayed(state, before, found[taken], fell)
        said = self._said(state, len(told), fell)
        note = f"{said}, {LEFT}" if ALIKE < fell < CLEARLY and not told else said_of_others(told, of.count)
        return Outcome(new, self._loss(new), True, note, said)

    def _nearer(self, one: State, other: State) -> bool:
        """Whether one state is nearer to the declared values than another."""
        of = self.of
        places = np.array([of.maps.from_natural(of.values(each)) for each in (other, one)])
        return nearest(places, of.maps.from_natural(of.declared)) == 1

    def _stayed(self, state: State, before: State, higher: State, fell: float) -> Outcome:
        """The end at the maximum at which the stage began, although there is a higher one."""
        text = self._text(self.of.values(higher))
        note = (
            f"the likelihood has a higher maximum: at {text}, -2 log likelihood is lower by {fell:.3g}. The one nearer "
            "to the declared starting values was kept; begin there if the other one is meant, or exclude it by "
            "narrower bounds or a prior"
        )
        new: State = _numbers(state) | before | {"values": np.array([scalar(state, "begun")])}
        return Outcome(new, self._loss(new), True, note, f"-2 log likelihood would be lower by {fell:.3g} at {text}")

    def _said(self, state: State, others: int, fell: float) -> str:
        """How the search ended, with the number of other maxima as high and the fall of -2 log likelihood."""
        if fell > ALIKE:
            return f"-2 log likelihood is lower by {fell:.3g} than at {self._text(state['first'])}"
        if not scalar(state, "places"):
            return "constants that exchange their roles fit worse"
        return f"{others or 'no'} other as high where constants exchange their roles"

    def _text(self, values: Array) -> str:
        return listed(self.of.names, values)

    def _loss(self, state: State) -> float:
        """The objective as a mean over the values."""
        return float(state["values"][0]) / (2 * self.of.count)


def _or_infinite(objective: Callable[[], float]) -> float:
    """An objective; infinite where the model cannot be computed."""
    try:
        return objective()
    except ComputationError:
        return float("inf")


_NUMBERS = frozenset({"exchanges", "values", "first", "used", "places", "all", "begun"})


def _numbers(state: State) -> State:
    """The entries of the stage itself."""
    return {name: value for name, value in state.items() if name in _NUMBERS}


def _under(state: State, prefix: str) -> State:
    """The entries that begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _named(prefix: str, state: State) -> State:
    """The entries with a prefix."""
    return {f"{prefix}{name}": value for name, value in state.items()}


def _kept(state: State) -> State:
    """The state of the fit at the first of the maxima."""
    return {name: value for name, value in state.items() if "." not in name and name not in _NUMBERS}


def _maxima(state: State) -> list[State]:
    """The states of the fit at all maxima that the data do not tell apart."""
    others = range(len(state["values"]) - 1)
    return [_kept(state), *(_under(state, FOUND.format(i)) for i in others)]
