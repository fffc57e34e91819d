"""Equations of many positive definite matrices: kernels, interpreted, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.linalg import solve_positive
from mjx_drax.kernels.positive_matrices import COLUMNS, MOST, THREADS, fits, solutions


def drawn(rows, n, m):
    rng = np.random.default_rng(n)
    half = rng.normal(size=(rows, n, n))
    return half @ half.swapaxes(1, 2) + 0.1 * np.eye(n), rng.normal(size=(rows, n, m))


@pytest.mark.parametrize(
    ("rows", "n", "m"), [(THREADS + 3, 9, 1), (2, 11, 4), (3, 17, 1), (2, MOST, COLUMNS + 1)]
)
def test_it_solves_the_equations(rows, n, m):
    with jax.enable_x64(True):
        M, b = drawn(rows, n, m)
        found = solutions(jnp.asarray(np.tril(M)), jnp.asarray(b), interpret=True)
        np.testing.assert_allclose(found, np.linalg.solve(M, b), rtol=1e-8, atol=1e-8)


def test_one_that_is_not_positive_definite_gives_no_numbers():
    """As a Cholesky factor would: a search then sees that it must not go there."""
    M, b = (jnp.asarray(a, jnp.float32) for a in drawn(2, 14, 1))
    found = solutions(M.at[1, 5, 5].set(-1.0), b, interpret=True)
    assert [bool(jnp.isfinite(x).all()) for x in found] == [True, False]


def test_there_is_a_kernel_up_to_a_size_and_for_float64_up_to_a_smaller_one():
    def served(n, dtype):
        return fits(np.zeros((2, n, n), dtype))

    assert [served(n, np.float32) for n in (9, 13, MOST, MOST + 1)] == [True, True, True, False]
    assert [served(n, np.float64) for n in (9, 13)] == [True, False]


def test_any_number_of_batch_axes_gives_what_one_matrix_does():
    with jax.enable_x64(True):
        M, b = drawn(6, 9, 2)
        both = jax.vmap(jax.vmap(solve_positive, in_axes=(None, 0)))
        found = both(M[:3], b.reshape(3, 2, 9, 2))
        wanted = np.linalg.solve(M[:3, None], b.reshape(3, 2, 9, 2))
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8)
        vectors = jax.vmap(solve_positive)(M, b[..., 0])
        np.testing.assert_allclose(vectors, np.linalg.solve(M, b)[..., 0], rtol=1e-8, atol=1e-8)


def test_derivatives_are_those_of_the_equation():
    with jax.enable_x64(True):
        M, b = (jnp.asarray(a[0]) for a in drawn(1, 9, 1))
        dM, db = M + jnp.diag(b[:, 0]), 2.0 * b
        x, dx = jax.jvp(solve_positive, (M, b), (dM, db))
        np.testing.assert_allclose(M @ dx, db - dM @ x, rtol=1e-8, atol=1e-8)
