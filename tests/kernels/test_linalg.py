"""Small dense factorizations against numpy, unrolled (n <= 8) and by the library (n > 8)."""

import jax
import numpy as np
import pytest

from mjx_drax.kernels.linalg import (
    SUMMED_UP_TO,
    UNROLLED_UP_TO,
    cholesky,
    product,
    solve,
    solve_lower,
    solve_upper,
    symmetric,
    transposed_product,
)

BATCH = 3


@jax.jit
def everything(M, b):
    L = cholesky(M)
    return L, solve_lower(L, b), solve_upper(L, b), solve(L, b)


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def drawn(n, *columns):
    """Positive definite matrices (BATCH, n, n) and right-hand sides (BATCH, n, *columns)."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(BATCH, n, n))
    return root @ root.swapaxes(1, 2) + np.eye(n), rng.normal(size=(BATCH, n, *columns))


def expected(M, b):
    L = np.linalg.cholesky(M)
    return L, np.linalg.solve(L, b), np.linalg.solve(L.T, b), np.linalg.solve(M, b)


@pytest.mark.parametrize("n", range(1, 11))
def test_batched_matrix_right_hand_sides(n):
    M, b = drawn(n, 4)
    for seen, wanted in zip(
        jax.vmap(everything)(M, b), zip(*map(expected, M, b), strict=True), strict=True
    ):
        np.testing.assert_allclose(seen, np.stack(wanted), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n", [1, 3, UNROLLED_UP_TO, UNROLLED_UP_TO + 1])
def test_single_vector_right_hand_side(n):
    M, b = drawn(n)
    for seen, wanted in zip(everything(M[0], b[0]), expected(M[0], b[0]), strict=True):
        assert seen.shape == wanted.shape
        np.testing.assert_allclose(seen, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n", [4, 9])
def test_float32_stays_float32(n):
    M, b = (a.astype(np.float32) for a in drawn(n, 2))
    for seen, wanted in zip(everything(M[0], b[0]), expected(M[0], b[0]), strict=True):
        assert seen.dtype == np.float32
        np.testing.assert_allclose(seen, wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("n", [3, UNROLLED_UP_TO])
def test_only_the_lower_triangle_is_read(n):
    M = drawn(n)[0][0]
    spoiled = np.tril(M) + np.triu(np.full((n, n), np.nan), 1)
    np.testing.assert_allclose(cholesky(spoiled), np.linalg.cholesky(M), atol=1e-12)


@pytest.mark.parametrize("n", [2, 9])
def test_an_indefinite_matrix_gives_nan_not_an_exception(n):
    M = -np.eye(n)
    assert np.isnan(everything(M, np.ones(n))[3]).any()


def test_symmetric_part():
    M = np.arange(18.0).reshape(2, 3, 3)
    np.testing.assert_array_equal(symmetric(M), (M + M.swapaxes(1, 2)) / 2)


@pytest.mark.parametrize("columns", [(), (4,)])
@pytest.mark.parametrize("rows", [0, 3, SUMMED_UP_TO])
def test_transposed_products_are_the_same_however_they_are_written(rows, columns, monkeypatch):
    rng = np.random.default_rng(rows)
    J, A = rng.normal(size=(BATCH, rows, 5)), rng.normal(size=(BATCH, rows, *columns))
    wanted = np.einsum("bmn,bm...->bn...", J, A)
    np.testing.assert_allclose(jax.vmap(transposed_product)(J, A), wanted, atol=1e-9)

    def as_on_gpus(J, A, cpu, default):
        return default(J, A)

    monkeypatch.setattr(jax.lax, "platform_dependent", as_on_gpus)
    np.testing.assert_allclose(jax.vmap(transposed_product)(J, A), wanted, atol=1e-9)


@pytest.mark.parametrize("columns", [(), (4,)])
@pytest.mark.parametrize("k", [0, 1, UNROLLED_UP_TO, UNROLLED_UP_TO + 1])
def test_products_of_any_size_and_of_small_ones_without_the_library(k, columns):
    rng = np.random.default_rng(k)
    A, B = rng.normal(size=(BATCH, 3, k)), rng.normal(size=(BATCH, k, *columns))
    over = jax.vmap(product)
    np.testing.assert_allclose(over(A, B), np.einsum("bnk,bk...->bn...", A, B), atol=1e-9)
    calls_library = "dot_general" in str(jax.make_jaxpr(over)(A, B))
    assert calls_library == (not 0 < k <= UNROLLED_UP_TO)
