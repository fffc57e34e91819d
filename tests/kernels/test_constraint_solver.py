"""Accelerations under constraints: the plain solver, and its GPU kernel, interpreted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.constraint_solver import Constraints, constrained_minimum, law, minima


def drawn(rows=6, nv=5, m=7):
    """Of every two rows of J one has friction, which may slide; two more have two sides."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(rows, nv, nv))
    M, force = half @ half.swapaxes(1, 2) + np.eye(nv), 3.0 * rng.normal(size=(rows, nv))
    loss, both = np.zeros((2, rows, m))
    both[:, :4], loss[:, 2:4] = 1.0, 0.3
    given = Constraints(
        M,
        rng.normal(size=(rows, m, nv)),
        rng.uniform(0.5, 20.0, size=(rows, m)),
        rng.normal(size=(rows, m)),
        loss,
        both,
        force,
        np.linalg.solve(M, force[..., None])[..., 0],
    )
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given)


def test_the_gradient_is_zero_and_the_factor_is_that_of_the_hessian():
    given = drawn()

    def gradient(given, a):
        return given.M @ a - given.force - given.J.T @ law(given, given.J @ a - given.aref)[1]

    @jax.jit
    @jax.vmap
    def checked(given):
        a, factor = constrained_minimum(given)
        return gradient(given, a), factor @ factor.T, jax.jacfwd(gradient, argnums=1)(given, a)

    slope, seen, hessian = checked(given)
    assert np.abs(slope).max() < 1e-4
    np.testing.assert_allclose(seen, hessian, rtol=1e-4, atol=1e-3)


@pytest.mark.slow
def test_the_kernel_finds_the_same_accelerations():
    given = drawn()
    wanted, _ = jax.jit(jax.vmap(constrained_minimum))(given)
    found = minima(given, interpret=True)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


def test_law_is_one_function_and_its_derivatives():
    given = jax.tree.map(lambda a: a[0], drawn())
    y = jnp.linspace(-1.0, 1.0, 7 * 41).reshape(41, 7)
    by_y = jax.vmap(jax.jacfwd(lambda y: jnp.sum(law(given, y)[0])))(y)
    cost, push, slope = law(given, y)
    np.testing.assert_allclose(push, -by_y, atol=1e-5)
    assert np.all(np.asarray(cost) >= -1e-6)
    assert np.all(np.asarray(slope) >= 0)
