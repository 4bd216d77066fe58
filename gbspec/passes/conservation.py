"""Linear conservation laws of a Model, valid for all unknown functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import sympy
from sympy.polys.matrices import DomainMatrix

from gbspec.ir import Condition, Expr, Model, in_language, uninfused
from gbspec.passes.terms import Opened, branching, constants_of, larger_than

K = TypeVar("K")

PRIME = 2**61 - 1
"""Ranks are first computed modulo this prime, constants at random residues (wrong with probability about 1e-15)."""

LARGEST = 70_000
"""Rates are substituted only if expressions have at most this many nodes; else each rate is a free symbol."""


@dataclass(frozen=True)
class Law:
    """A linear combination of states that is constant in time; coefficients in constants and learnables."""

    coefficients: tuple[tuple[str, Expr], ...]
    conditions: tuple[Condition, ...] = field(default=(), compare=False, repr=False)
    """Those of the model, for the names of their categories."""

    @property
    def expression(self) -> Expr:
        """The conserved quantity."""
        return sympy.Add(*(c * sympy.Symbol(name, real=True) for name, c in self.coefficients))

    def __str__(self) -> str:
        return in_language(self.expression, self.conditions)


def as_text(expression: Expr) -> str:
    """An expression as a user would write it."""
    return in_language(expression)


def linear_laws(model: Model) -> tuple[Law, ...]:
    """A basis of all constant linear combinations of states whose rate of change vanishes identically.

    Each balance is a sum of terms, a constant coefficient times a varying factor; distinct factors count as
    independent (laws that depend on identities between functions, such as sin^2 + cos^2 = 1, are not found). The laws
    are the left null space of the matrix of coefficients, over the field of rational functions of the constants.
    """
    laws = _laws(model, uninfused(model), 0)
    if larger_than(model, LARGEST):
        return laws
    return _completed(laws, _laws(model, model.inlined(uninfused(model)), len(laws)))


def _laws(model: Model, balances: Sequence[Expr], known: int) -> tuple[Law, ...]:
    """A basis of the laws of these balances; empty if their number does not exceed `known`."""
    opened = Opened(constants_of(model))
    rows = [opened.split(opened.open(balance)) for balance in balances]
    conserved, count = _left_null_support(rows)
    if count <= known:
        return ()
    # With a branch as a generator sympy's polynomials are not defined, or wrong: each is one free symbol.
    branches = {b: sympy.Dummy("b", real=True) for row in rows for c in row.values() for b in branching(c)}
    vectors = _null_space([{key: c.xreplace(branches) for key, c in rows[i].items()} for i in conserved])
    back = {symbol: branch for branch, symbol in branches.items()}
    found = ([opened.close(value.xreplace(back)) for value in vector] for vector in vectors)
    names = [model.states[i].name for i in conserved]
    pairs = (tuple((n, v) for n, v in zip(names, law, strict=True) if v != 0) for law in found)
    return tuple(Law(coefficients, model.conditions) for coefficients in pairs)


def _completed(laws: tuple[Law, ...], every: tuple[Law, ...]) -> tuple[Law, ...]:
    """The laws that hold for all rates, then those of the others that are independent of them."""
    kept: list[Law] = []
    for law in (*laws, *every):
        rows = [{sympy.Symbol(name): c for name, c in other.coefficients} for other in (*kept, law)]
        if not _left_null_support(rows)[1]:
            kept.append(law)
    return tuple(kept)


# ------------------------------------------------------------------------------------------------------ linear algebra


def _left_null_support(rows: Sequence[Mapping[Expr, Expr]]) -> tuple[list[int], int]:
    """The rows that occur in some vanishing combination, and the dimension of these combinations, modulo a prime.

    Constants have residues from a fixed sequence, so that the result is deterministic.
    """
    values: dict[sympy.Symbol, int] = {}
    numeric = [{column: _residue(c, values) for column, c in row.items()} for row in rows]
    pivots: dict[Expr, tuple[dict[Expr, int], dict[int, int]]] = {}
    support: set[int] = set()
    count = 0
    for index in _core(numeric):
        row = numeric[index]
        current = {column: c for column, c in row.items() if c}
        combination = {index: 1}
        while current:
            column = next((c for c in current if c in pivots), None)
            if column is None:
                column, lead = next(iter(current.items()))
                inverse = pow(lead, -1, PRIME)
                scaled = {c: v * inverse % PRIME for c, v in current.items()}
                pivots[column] = scaled, {i: v * inverse % PRIME for i, v in combination.items()}
                break
            factor = current[column]
            other, made_of = pivots[column]
            _subtract(current, other, factor)
            _subtract(combination, made_of, factor)
        if not current:
            support.update(combination)
            count += 1
    return sorted(support), count


def _core(rows: Sequence[Mapping[Expr, int]]) -> list[int]:
    """The rows that remain when rows with the only entry of a column are removed repeatedly.

    A removed row occurs in no vanishing combination; elimination on the remaining rows causes little fill-in.
    """
    users: dict[Expr, set[int]] = {}
    for index, row in enumerate(rows):
        for column, value in row.items():
            if value:
                users.setdefault(column, set()).add(index)
    left = set(range(len(rows)))
    lone = [column for column, own in users.items() if len(own) == 1]
    while lone:
        for index in users[lone.pop()] & left:
            left.discard(index)
            for column, value in rows[index].items():
                if value:
                    users[column].discard(index)
                    if len(users[column]) == 1:
                        lone.append(column)
    return sorted(left)


def _subtract(target: dict[K, int], other: Mapping[K, int], factor: int) -> None:
    for key, value in other.items():
        difference = (target.get(key, 0) - factor * value) % PRIME
        if difference:
            target[key] = difference
        else:
            target.pop(key, None)


def _residue(coefficient: Expr, values: dict[sympy.Symbol, int]) -> int:
    """A coefficient modulo the prime; a part that is not a rational function of symbols gets a random residue."""
    if coefficient.is_Rational:
        return int(coefficient.p) * pow(int(coefficient.q), -1, PRIME) % PRIME
    atoms = _with_atoms(coefficient)
    for s in sorted(coefficient.free_symbols | atoms.free_symbols, key=str):
        values.setdefault(_identity(s), pow(48271, 7 * len(values) + 11, PRIME))
    numerator, denominator = sympy.fraction(sympy.together(atoms))
    table = {s: sympy.Integer(values[_identity(s)]) for s in atoms.free_symbols}
    top, bottom = (sympy.Rational(part.xreplace(table)) for part in (numerator, denominator))
    value = top / bottom
    return int(value.p) * pow(int(value.q), -1, PRIME) % PRIME


def _with_atoms(e: Expr) -> Expr:
    """The expression with its parts that are no rational function of symbols, such as an `if`, each as one symbol.

    From the outside in: the parts of an `if` are pairs and conditions, which no symbol can replace.
    """
    if not _is_rational_operation(e):
        return sympy.Dummy(str(e))
    return e.func(*map(_with_atoms, e.args)) if e.args and not e.is_Rational else e


def _identity(s: sympy.Symbol) -> sympy.Symbol:
    return sympy.Symbol(s.name)


def _is_rational_operation(e: Expr) -> bool:
    integer_power = e.is_Pow and e.exp.is_Integer and abs(e.exp) <= 64
    return bool(e.is_Add or e.is_Mul or e.is_Rational or e.is_Symbol or integer_power)


def _null_space(rows: Sequence[Mapping[Expr, Expr]]) -> list[list[Expr]]:
    """A basis of the vanishing combinations of rows, without denominators, the first coefficient positive."""
    columns = {column: i for i, column in enumerate(dict.fromkeys(c for row in rows for c in row))}
    distinct = list(dict.fromkeys(c for row in rows for c in row.values()))
    domain, elements = sympy.construct_domain(distinct or [sympy.S.One], field=True, extension=True)
    converted = dict(zip(distinct, elements, strict=False))
    entries: dict[int, dict[int, object]] = {}
    for j, row in enumerate(rows):
        for column, coefficient in row.items():
            entries.setdefault(columns[column], {})[j] = converted[coefficient]
    matrix = DomainMatrix(entries, (max(len(columns), 1), len(rows)), domain)
    basis = matrix.to_sparse().nullspace().to_Matrix()
    return [_cleared([basis[i, j] for j in range(basis.cols)]) for i in range(basis.rows)]


def _cleared(vector: Sequence[Expr]) -> list[Expr]:
    if all(value.is_Rational for value in vector):
        scale = sympy.Rational(sympy.ilcm(1, *(v.q for v in vector)), sympy.igcd(0, *(v.p for v in vector)))
        return [value * abs(scale) * sympy.sign(next(v for v in vector if v)) for value in vector]
    fractions = [sympy.fraction(sympy.together(value)) for value in vector]
    common = sympy.lcm_list([denominator for _, denominator in fractions])
    whole = [sympy.cancel(value * common) for value in vector]
    factor = sympy.gcd_list([value for value in whole if value != 0])
    whole = [sympy.factor_terms(sympy.cancel(value / factor)) for value in whole]
    first = next(value for value in whole if value != 0)
    return [-value for value in whole] if first.could_extract_minus_sign() else whole
