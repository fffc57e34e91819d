"""Factors and equations of many positive definite matrices: kernels, interpreted, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.linalg import solve_positive
from mjx_drax.kernels.positive_matrices import THREADS, factors, solutions


def drawn(rows, n, m):
    rng = np.random.default_rng(n)
    half = rng.normal(size=(rows, n, n))
    return half @ half.swapaxes(1, 2) + 0.1 * np.eye(n), rng.normal(size=(rows, n, m))


@pytest.mark.parametrize(("rows", "n", "m"), [(THREADS + 3, 9, 1), (2, 11, 4)])
def test_it_solves_the_equations(rows, n, m):
    with jax.enable_x64(True):
        M, b = drawn(rows, n, m)
        found = solutions(jnp.asarray(np.tril(M)), jnp.asarray(b), interpret=True)
        np.testing.assert_allclose(found, np.linalg.solve(M, b), rtol=1e-8, atol=1e-8)


def test_it_factorizes_what_lies_below_the_diagonal():
    with jax.enable_x64(True):
        M, _ = drawn(THREADS + 1, 6, 1)
        found = factors(jnp.asarray(np.tril(M)), interpret=True)
        np.testing.assert_allclose(found, np.linalg.cholesky(M), rtol=1e-10, atol=1e-10)


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
