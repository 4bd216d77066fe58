"""Every method has exactly its declared order: the order conditions of rooted trees hold up to it and not beyond."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache
from math import prod

import numpy as np
import pytest

from gbspec.diagnostics import UserError
from gbspec.ir.methods import (
    DOPRI5,
    METHODS,
    RK4,
    RK38,
    ROS34PW2,
    Explicit,
    Method,
    RosenbrockW,
    listed,
    method_named,
)

Tree = tuple["Tree", ...]
"""A rooted tree: the sorted subtrees of its root."""

EVERY = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
EXPLICIT = [method for method in METHODS.values() if isinstance(method, Explicit)]
EVERY_EXPLICIT = pytest.mark.parametrize("method", EXPLICIT, ids=[method.name for method in EXPLICIT])


@cache
def trees(order: int) -> tuple[Tree, ...]:
    """All rooted trees with the given number of vertices."""
    return tuple(sorted(set(forests(order - 1))))


@cache
def forests(vertices: int) -> tuple[Tree, ...]:
    """All multisets of trees with the given total number of vertices, each sorted."""
    if not vertices:
        return ((),)
    return tuple(
        tuple(sorted((tree, *rest)))
        for size in range(1, vertices + 1)
        for tree in trees(size)
        for rest in forests(vertices - size)
    )


def vertices(tree: Tree) -> int:
    return 1 + sum(map(vertices, tree))


def density(tree: Tree) -> int:
    return vertices(tree) * prod(map(density, tree))


def at_stages(method: Method, tree: Tree) -> list[Fraction]:
    """The elementary weight of a tree at each Runge-Kutta stage."""
    grown = [at_stages(method, branch) for branch in tree]
    return [prod((dot(row, branch) for branch in grown), start=Fraction(1)) for row in method.a]


def dot(weights: Sequence[Fraction], values: Sequence[Fraction]) -> Fraction:
    return sum((w * v for w, v in zip(weights, values, strict=False)), Fraction(0))


def holds(method: Method, tree: Tree) -> bool:
    return dot(method.b, at_stages(method, tree)) == Fraction(1, density(tree))


def test_there_are_as_many_trees_as_there_should_be() -> None:
    assert [len(trees(n)) for n in range(1, 8)] == [1, 1, 2, 4, 9, 20, 48]  # Cayley


@EVERY_EXPLICIT
def test_the_order_is_the_one_claimed(method: Method) -> None:
    for order in range(1, method.order + 1):
        assert [tree for tree in trees(order) if not holds(method, tree)] == []
    assert not all(holds(method, tree) for tree in trees(method.order + 1))


@EVERY_EXPLICIT
def test_the_error_estimate_vanishes_to_the_order_of_the_embedded_method(method: Method) -> None:
    assert (method.b_error is None) == (method.embedded_order is None)
    if method.b_error is None or method.embedded_order is None:
        return
    assert sum(method.b_error) == 0

    def estimate(order: int) -> list[Fraction]:
        return [dot(method.b_error or (), at_stages(method, tree)) for tree in trees(order)]

    for order in range(1, method.embedded_order + 1):
        assert not any(estimate(order))
    assert any(estimate(method.embedded_order + 1))


# ------------------------------------------------------------------------------------------------ Rosenbrock-W
TwoKinds = tuple[bool, tuple["TwoKinds", ...]]
"""A tree with two kinds of vertices: whether the root stands for M (it then has one branch), and the branches."""
ROUNDING = 1e-15


@cache
def two_kinds(order: int) -> tuple[TwoKinds, ...]:
    """All trees of W-methods: vertices for M have one branch; others stand for derivatives of the right-hand side."""
    plain = [(False, forest) for forest in forests_of_two(order - 1)]
    fat = [(True, (tree,)) for tree in two_kinds(order - 1)] if order > 1 else []
    return (*plain, *fat)


@cache
def forests_of_two(count: int) -> tuple[tuple[TwoKinds, ...], ...]:
    found = {()} if not count else set()
    for size in range(1, count + 1):
        found |= {tuple(sorted((tree, *rest))) for tree in two_kinds(size) for rest in forests_of_two(count - size)}
    return tuple(sorted(found))


def of_w_method(method: RosenbrockW, tree: TwoKinds) -> list[Fraction]:
    """The elementary weight of a tree at each Runge-Kutta stage."""
    matrix, branches = tree
    grown = [of_w_method(method, branch) for branch in branches]
    if matrix:
        return [dot((*row, method.gamma), grown[0]) for row in method.g]
    return [prod((dot(row, branch) for branch in grown), start=Fraction(1)) for row in method.a]


def wanted(tree: TwoKinds) -> Fraction:
    """1 over the density; 0 for a tree with M, on which the solution does not depend."""

    def bare(tree: TwoKinds) -> Tree | None:
        branches = [bare(branch) for branch in tree[1]]
        return None if tree[0] or None in branches else tuple(b for b in branches if b is not None)

    found = bare(tree)
    return Fraction(0) if found is None else Fraction(1, density(found))


def defects(method: RosenbrockW, weights: Sequence[Fraction], order: int) -> list[float]:
    return [abs(float(dot(weights, of_w_method(method, tree)) - wanted(tree))) for tree in two_kinds(order)]


def test_there_are_as_many_trees_of_w_methods_as_there_should_be() -> None:
    assert [len(two_kinds(n)) for n in range(1, 5)] == [1, 2, 5, 13]  # Steihaug and Wolfbrandt (1979)


def test_the_order_of_the_rosenbrock_method_does_not_depend_on_its_matrix() -> None:
    method = ROS34PW2
    embedded = [b - e for b, e in zip(method.b, method.b_error, strict=True)]
    for weights, order in ((method.b, method.order), (embedded, method.embedded_order)):
        for k in range(1, order + 1):
            assert max(defects(method, weights, k)) < ROUNDING
        assert max(defects(method, weights, order + 1)) > 1e-3


def test_the_rosenbrock_method_is_l_stable_and_stiffly_accurate() -> None:
    method, n = ROS34PW2, 4
    a, g = (np.array([[*map(float, row), *[0.0] * (n - len(row))] for row in rows]) for rows in (method.a, method.g))
    both, b = a + g + float(method.gamma) * np.eye(n), np.array(list(map(float, method.b)))
    assert np.abs(both[-1] - b).max() < ROUNDING, "the last stage is the step"

    def growth(z: complex) -> float:
        return float(abs(1 + z * b @ np.linalg.solve(np.eye(n) - z * both, np.ones(n))))

    assert max(growth(1j * y) for y in np.logspace(-3, 4, 400)) < 1 + 1e-12
    assert growth(-1e8) < 1e-7 and growth(-1e4) < 1e-3


def test_invalid_rosenbrock_methods_are_refused() -> None:
    with pytest.raises(ValueError, match="not those of a Rosenbrock-W method"):
        replace(ROS34PW2, b_error=(Fraction(1),))
    with pytest.raises(ValueError, match="outside the step"):
        replace(ROS34PW2, a=((), (Fraction(2),), (Fraction(1), Fraction(0)), (Fraction(0), Fraction(0), Fraction(1))))


def test_nodes_are_distinct_sorted_and_have_the_ends() -> None:
    half, third = Fraction(1, 2), Fraction(1, 3)
    assert RK4.nodes == (0, half, 1) and RK38.nodes == (0, third, 2 * third, 1)
    assert DOPRI5.nodes == (0, Fraction(1, 5), Fraction(3, 10), Fraction(4, 5), Fraction(8, 9), 1)
    assert DOPRI5.b_error is not None and len(DOPRI5.b_error) == 7
    assert DOPRI5.advancing == 6, "the seventh serves the error estimate alone"
    euler = Explicit("euler", 1, ((),), (Fraction(1),), "", "")
    assert euler.nodes == (0, 1)


@pytest.mark.parametrize(
    ("a", "b", "b_error"),
    [
        (((), (Fraction(2),)), (Fraction(1, 2),) * 2, None),
        (((), (Fraction(-1),)), (Fraction(1, 2),) * 2, None),
        (((Fraction(1),),), (Fraction(1),), None),
        (((),), (Fraction(1),) * 2, None),
        (((),), (Fraction(1),), (Fraction(0),) * 2),
    ],
    ids=["beyond the step", "before the step", "implicit", "weights", "error weights"],
)
def test_invalid_explicit_methods_are_refused(
    a: tuple[tuple[Fraction, ...], ...], b: tuple[Fraction, ...], b_error: tuple[Fraction, ...] | None
) -> None:
    with pytest.raises(ValueError, match="`wrong`"):
        Explicit("wrong", 1, a, b, "", "", b_error, None)


@EVERY
def test_every_method_says_what_it_is_and_where_it_is_from(method: Method) -> None:
    assert METHODS[method.name] is method and method_named(method.name) is method
    assert f"`{method.name}`, {method.help}" in listed()
    assert re.search(r"\(\d{4}\)", method.source) and method.name.isidentifier()


def test_a_name_that_no_method_has() -> None:
    with pytest.raises(UserError) as caught:
        method_named("rk5")
    (diagnostic,) = caught.value.diagnostics
    assert diagnostic.code == "GB850"
    assert diagnostic.message.startswith("`--solver rk5` must be one of `rk4`, `rk38`, `dopri5`")
    assert all(f"`{name}`" in diagnostic.message for name in METHODS)
