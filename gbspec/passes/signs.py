"""A prover of signs: is an expression >= 0 (or > 0) whenever its symbols lie in given intervals?

It answers yes or "not proved", never no. The methods, cheapest first: intervals; the signs of factors; a common
denominator; a polynomial whose coefficients are all of one sign after its variables have been shifted to the ends of
their intervals (Bernstein's form if both ends are finite); intervals again on halves of the box. A point where the
claim is false ends an attempt at once; large expressions and a spent budget end it too, so that every check ends. The
budget counts steps, not seconds, so that the answer does not depend on the machine.
"""

from __future__ import annotations

import math
import time
from collections import deque

import sympy

from gbspec.ir import Expr
from gbspec.passes.intervals import REAL, Box, Interval, enclosure

BUDGET = 2000
"""The maximal number of enclosures that a prover computes for all its questions; then all others are `not proved`."""

SECONDS = 5.0
"""The limit in seconds of this thread's processor time: a guard against single steps that take long, not reached by
expressions of a usual size."""

LARGEST = 300
"""Expressions with more operations than this are tried by intervals only."""

BOXES = 60
"""The maximal number of parts into which the box is divided."""


class _Budget:
    """The remaining steps and time, shared by all provers derived from one another."""

    def __init__(self) -> None:
        self._steps = 0
        self._until = time.thread_time() + SECONDS

    def step(self) -> None:
        """Counts one enclosure."""
        self._steps += 1

    @property
    def spent(self) -> bool:
        """Whether no steps or no time remain."""
        return self._steps > BUDGET or time.thread_time() > self._until


class Prover:
    """Answers questions about signs within one box. `box` maps symbols to intervals; others may be any real number."""

    def __init__(self, box: Box, budget: _Budget | None = None) -> None:
        self.box = dict(box)
        self._budget = budget or _Budget()
        self._known: dict[tuple[Expr, bool], bool] = {}

    def with_box(self, more: Box) -> Prover:
        """A prover that shares this one's budget, for a box with other intervals for some symbols."""
        return Prover({**self.box, **more}, self._budget)

    # ---------------------------------------------------------------- questions
    def positive(self, expression: Expr) -> bool:
        """Whether it is proved that the expression is defined and > 0 everywhere."""
        return self._holds(expression, True)

    def nonnegative(self, expression: Expr) -> bool:
        """Whether it is proved that the expression is defined and >= 0 everywhere."""
        return self._holds(expression, False)

    def zero(self, expression: Expr) -> bool:
        """Whether the expression is 0, identically."""
        if expression == 0:
            return True
        if self._budget.spent or sympy.count_ops(expression) > LARGEST:
            return False
        return bool(sympy.expand(sympy.fraction(sympy.together(expression))[0]) == 0)

    def sign(self, expression: Expr) -> int | None:
        """1 if >= 0 is proved, -1 if <= 0 is proved, 0 if identically zero, None if neither."""
        if self.zero(expression):
            return 0
        if self.nonnegative(expression):
            return 1
        return -1 if self.nonnegative(-expression) else None

    def finite(self, expression: Expr) -> bool:
        """Whether it is proved to be defined everywhere."""
        return enclosure(expression, self.box) is not None

    def slope(self, expression: Expr, variable: sympy.Symbol) -> Expr | None:
        """The derivative; None if the expression may jump, since the variable occurs in an `if`, `sign` or `floor`."""
        jumps = expression.atoms(sympy.Piecewise, sympy.sign, sympy.floor)
        if any(variable in jump.free_symbols for jump in jumps):
            return None
        derivative = sympy.diff(expression, variable)
        return None if derivative.has(sympy.DiracDelta, sympy.Derivative, sympy.Subs) else derivative

    # ---------------------------------------------------------------- proofs
    def _holds(self, expression: Expr, strict: bool) -> bool:
        key = (expression, strict)
        if key not in self._known:
            self._known[key] = False  # a circular attempt proves nothing
            self._known[key] = self._prove(expression, strict)
        return self._known[key]

    def _prove(self, expression: Expr, strict: bool) -> bool:
        found = self._enclosure(expression, self.box)
        if found is not None and _says(found, strict):
            return True
        if self._budget.spent or self._refuted(expression):
            return False
        if isinstance(expression, sympy.Mul):
            return self._product(expression.args, strict)
        if isinstance(expression, sympy.Pow) and expression.exp.is_Integer:
            return self._power(expression.base, int(expression.exp), strict)
        if isinstance(expression, sympy.Pow) and expression.exp.is_real and not expression.exp.has(sympy.Symbol):
            return self._holds(expression.base, strict or expression.exp < 0)
        if isinstance(expression, sympy.Piecewise):
            return all(self._holds(value, strict) for value, _ in expression.args)
        if isinstance(expression, sympy.Max | sympy.Min):
            some = any if isinstance(expression, sympy.Max) else all
            return found is not None and some(self._holds(part, strict) for part in expression.args)
        if isinstance(expression, sympy.Add) and sympy.count_ops(expression) <= LARGEST:
            if all(self._holds(part, False) for part in expression.args) and not strict:
                return True
            return self._sum(expression, strict) or self._halves(expression, strict)
        return self._halves(expression, strict)

    def _enclosure(self, expression: Expr, box: Box) -> Interval | None:
        self._budget.step()
        return enclosure(expression, box)

    def _refuted(self, expression: Expr) -> bool:
        """Whether the expression is negative at one of a few points inside the box."""
        symbols = sorted(expression.free_symbols, key=lambda s: str(s.name))
        for share in (0.5, 0.02, 0.98):
            for turned in (False, True):
                point = {}
                for i, symbol in enumerate(symbols):
                    value = _inside(self.box.get(symbol, REAL), 1 - share if turned and i % 2 else share)
                    point[symbol] = Interval(value, value)
                found = self._enclosure(expression, point)
                if found is not None and found.high < -1e-12 * max(1.0, -found.low):
                    return True
        return False

    def _product(self, factors: tuple[Expr, ...], strict: bool) -> bool:
        """Whether an even number of factors is proved negative and the others positive."""
        negative = False
        for factor in factors:
            if self._holds(factor, strict):
                continue
            if not self._holds(-factor, strict):
                return False
            negative = not negative
        return not negative

    def _power(self, base: Expr, exponent: int, strict: bool) -> bool:
        apart = self._holds(base, True) or self._holds(-base, True)
        if exponent % 2 == 0:
            return apart or (exponent > 0 and not strict and self.finite(base))
        return self._holds(base, strict or exponent < 0)

    def _sum(self, expression: Expr, strict: bool) -> bool:
        over, under = sympy.fraction(sympy.together(expression))
        if under != 1:
            if self._holds(under, True):
                return self._holds(over, strict)
            return self._holds(-under, True) and self._holds(sympy.expand_mul(-over), strict)
        factored = sympy.factor_terms(expression)
        if isinstance(factored, sympy.Mul) and self._product(factored.args, strict):
            return True
        return self._polynomial(expression, strict)

    def _polynomial(self, expression: Expr, strict: bool) -> bool:
        """Whether all coefficients in shifted variables are >= 0 (with a positive constant one if strict)."""
        try:
            polynomial = sympy.Poly(expression)
        except sympy.PolynomialError:
            return False
        if polynomial.total_degree() > 12 or len(polynomial.gens) > 6:
            return False
        # Generators are treated as independent, each in its interval: that is conservative, so a proof remains valid.
        stand_ins = [sympy.Dummy(f"g{i}", real=True) for i in range(len(polynomial.gens))]
        numerator = _rational(polynomial.as_expr(*stand_ins))
        fresh, left = [], []
        for i, (generator, stand_in) in enumerate(zip(polynomial.gens, stand_ins, strict=True)):
            interval = enclosure(generator, self.box)
            if interval is None:
                return False
            free = sympy.Dummy(f"p{i}", nonnegative=True)
            shifted = _shifted(interval, free)
            if shifted is None:
                left.append(stand_in)
                continue
            value, denominator = shifted
            degree = polynomial.degree(generator)
            numerator = sympy.expand(numerator.xreplace({stand_in: value / denominator}) * denominator**degree)
            numerator = sympy.expand(sympy.cancel(numerator)) if denominator != 1 else numerator
            fresh.append(free)
            if self._budget.spent:
                return False
        result = sympy.Poly(numerator, *fresh, *left) if fresh or left else None
        if result is None:
            return bool(numerator > 0 if strict else numerator >= 0)
        for powers, coefficient in result.terms():
            if not (coefficient.is_number and coefficient >= 0):
                return False
            if any(power % 2 for power in powers[len(fresh) :]):
                return False
        constant = result.coeff_monomial(1)
        return bool(constant > 0) if strict else True

    def _halves(self, expression: Expr, strict: bool) -> bool:
        """Bisects the box along its widest finite side until intervals decide on every part."""
        sides = [s for s in expression.free_symbols if _finite(self.box.get(s, REAL))]
        if not sides:
            return False
        start = {s: self.box[s] for s in sides}
        queue, count = deque([start]), 0
        while queue:
            part = queue.popleft()
            found = self._enclosure(expression, {**self.box, **part})
            if found is not None and _says(found, strict):
                continue
            count += 1
            if count > BOXES or self._budget.spent:
                return False
            widest = max(sides, key=lambda s: (part[s].high - part[s].low) / (start[s].high - start[s].low or 1.0))
            low, high = part[widest].low, part[widest].high
            middle = (low + high) / 2
            if not low < middle < high:
                return False
            queue.append({**part, widest: Interval(low, middle, part[widest].low_open)})
            queue.append({**part, widest: Interval(middle, high, False, part[widest].high_open)})
        return True


def _says(interval: Interval, strict: bool) -> bool:
    return interval.positive if strict else interval.nonnegative


def _inside(interval: Interval, share: float) -> float:
    """A number inside the interval; an infinite end is replaced by a distance of up to 100."""
    low = interval.low if math.isfinite(interval.low) else min(-100.0, interval.high - 100)
    high = interval.high if math.isfinite(interval.high) else max(100.0, low + 100)
    return low + (high - low) * share


def _finite(interval: Interval) -> bool:
    return math.isfinite(interval.low) and math.isfinite(interval.high)


def _shifted(interval: Interval, free: sympy.Symbol) -> tuple[Expr, Expr] | None:
    """A number of the interval as numerator / denominator in `free` >= 0; None if it may be any real number."""
    low, high = _exact(interval.low), _exact(interval.high)
    if _finite(interval):
        return low + high * free, 1 + free
    if math.isfinite(interval.low):
        return low + free, sympy.S.One
    if math.isfinite(interval.high):
        return high - free, sympy.S.One
    return None


def _rational(polynomial: Expr) -> Expr:
    """The polynomial with exact fractions for its decimal coefficients, since division of floats leaves a remainder."""
    return polynomial.xreplace({number: _exact(float(number)) for number in polynomial.atoms(sympy.Float)})


def _exact(value: float) -> Expr:
    return sympy.Rational(value) if math.isfinite(value) else sympy.S.Zero
