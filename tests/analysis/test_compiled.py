from __future__ import annotations

import casadi as ca
import numpy as np

from gbspec.analysis.systems.compiled import Compiled


def function() -> ca.Function:
    x, p, nothing = ca.MX.sym("x", 2), ca.MX.sym("p"), ca.MX.sym("u", 0)
    return ca.Function("f", [x, p, nothing], [p * x, ca.vertcat(ca.horzcat(x[0], 0), ca.horzcat(p, x[1]))])


def test_one_point_gives_columns_and_dense_matrices() -> None:
    vector, matrix = Compiled(function())([1.0, 2.0], 3.0, [])
    assert vector.tolist() == [3.0, 6.0]
    assert matrix.tolist() == [[1.0, 0.0], [3.0, 2.0]]


def test_results_are_not_overwritten_by_the_next_call() -> None:
    compiled = Compiled(function())
    first, _ = compiled([1.0, 2.0], 3.0, [])
    compiled([7.0, 7.0], 7.0, [])
    assert first.tolist() == [3.0, 6.0]


def test_many_points_agree_with_one_at_a_time() -> None:
    compiled = Compiled(function())
    x = np.random.default_rng(0).normal(size=(5, 2))
    vectors, matrices = compiled.many(x, [2.0], np.zeros(0))
    assert vectors.shape == (5, 2)
    assert matrices.shape == (5, 2, 2)
    for i in range(5):
        vector, matrix = compiled(x[i], 2.0, [])
        assert np.array_equal(vectors[i], vector)
        assert np.array_equal(matrices[i], matrix)
