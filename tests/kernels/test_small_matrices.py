"""Unrolled linear algebra of lists against numpy."""

from operator import mul, truediv

import numpy as np
import pytest

from mjx_drax.kernels import small_matrices as small

RNG = np.random.default_rng(0)


def lists(array):
    return array.tolist()


@pytest.mark.parametrize("n", [1, 2, 5])
def test_products(n):
    A, B, x, y = RNG.normal(size=(n, 3)), RNG.normal(size=(3, 4)), *RNG.normal(size=(2, 3))
    np.testing.assert_allclose(small.matmul(lists(A), lists(B)), A @ B)
    np.testing.assert_allclose(small.matvec(lists(A), lists(x)), A @ x)
    np.testing.assert_allclose(small.transpose(lists(A)), A.T)
    np.testing.assert_allclose(small.dot(lists(x), lists(y)), x @ y)
    np.testing.assert_allclose(small.minus_dot(1.0, lists(x), lists(y)), 1.0 - x @ y)
    np.testing.assert_allclose(small.add(lists(x), lists(y)), x + y)
    M = A @ A.T + np.triu(np.ones((n, n)), 1)
    np.testing.assert_allclose(small.symmetric(lists(M)), (M + M.T) / 2)


@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize(
    ("root", "divide", "diagonal"),
    [(np.sqrt, truediv, lambda d: d), (lambda x: 1 / np.sqrt(x), mul, lambda d: 1 / d)],
    ids=["the diagonal", "its inverse"],
)
def test_factors_and_solutions(n, root, divide, diagonal):
    half, b = RNG.normal(size=(n, n)), RNG.normal(size=(n, 2))
    M = half @ half.T + np.eye(n)
    L = small.cholesky(lists(M), root, divide)
    assert [len(row) for row in L] == list(range(1, n + 1))
    wanted = np.linalg.cholesky(M)
    kept = np.tril(wanted, -1) + np.diag(diagonal(np.diag(wanted)))
    for row, of_numpy in zip(L, kept, strict=True):
        np.testing.assert_allclose(row, of_numpy[: len(row)], rtol=1e-9)
    lower, upper = small.solve_lower(L, list(b), divide), small.solve_upper(L, list(b), divide)
    np.testing.assert_allclose(lower, np.linalg.solve(wanted, b), rtol=1e-9)
    np.testing.assert_allclose(upper, np.linalg.solve(wanted.T, b), rtol=1e-9)
