"""Accelerations under constraints: the plain solver, and its GPU kernel, interpreted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.constraint_solver import (
    Constraints,
    changes,
    constrained_minimum,
    law,
    minima,
)


def drawn(rows=6, nv=5, m=7):
    """Of every two rows of J one has friction, which may slide; two more have two sides."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(rows, nv, nv))
    D = rng.uniform(0.5, 20.0, size=(rows, m))
    lower, upper = np.full((rows, m), -np.inf), np.zeros((rows, m))
    upper[:, :2] = np.inf
    lower[:, 2:4], upper[:, 2:4] = -0.3 / D[:, 2:4], 0.3 / D[:, 2:4]
    given = Constraints(
        half @ half.swapaxes(1, 2) + np.eye(nv),
        rng.normal(size=(rows, m, nv)),
        D,
        rng.normal(size=(rows, m)),
        lower,
        upper,
        rng.normal(size=(rows, nv)),
    )
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given)


def gradient(given, a):
    return given.M @ (a - given.a0) - given.J.T @ law(given, given.J @ a - given.aref)[0]


def test_the_gradient_is_zero_and_the_factor_is_that_of_the_hessian():
    given = drawn()

    @jax.jit
    @jax.vmap
    def checked(given):
        a, factor = constrained_minimum(given)
        return gradient(given, a), factor @ factor.T, jax.jacfwd(gradient, argnums=1)(given, a)

    slope, seen, hessian = checked(given)
    assert np.abs(slope).max() < 1e-4
    np.testing.assert_allclose(seen, hessian, rtol=1e-4, atol=1e-3)


def test_a_stiff_contact_early_on_the_way_does_not_end_the_search():
    """Minimize 1/2 |a|^2 + 1/2 (a_1 - 1000)^2, where a_1 <= a_2 / 2 + 0.01, almost."""
    rows = [jnp.array([[1.0, 0.0], [-1.0, 0.5]]), jnp.array([1.0, 1e6]), jnp.array([1e3, -0.01])]
    bounds = jnp.full(2, -jnp.inf), jnp.zeros(2)
    found, _ = constrained_minimum(Constraints(jnp.eye(2), *rows, *bounds, jnp.zeros(2)))
    np.testing.assert_allclose(found, [1e3 / 6, 1e3 / 3], rtol=1e-3)


def test_an_enormous_force_elsewhere_changes_nothing():
    given = drawn()
    apart = given._replace(
        M=jnp.pad(given.M, ((0, 0), (0, 1), (0, 1))).at[:, -1, -1].set(1.0),
        J=jnp.pad(given.J, ((0, 0), (0, 0), (0, 1))),
        a0=jnp.pad(given.a0, ((0, 0), (0, 1)), constant_values=1e12),
    )
    wanted, _ = jax.jit(jax.vmap(constrained_minimum))(given)
    found, _ = jax.jit(jax.vmap(constrained_minimum))(apart)
    np.testing.assert_allclose(found[:, :-1], wanted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found[:, -1], 1e12)


@pytest.mark.slow
def test_the_kernel_finds_the_same_accelerations():
    given = drawn()
    wanted, _ = jax.jit(jax.vmap(constrained_minimum))(given)
    found = minima(given, interpret=True)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


def test_changes_are_those_of_a_function_whose_slope_is_the_law():
    given = jax.tree.map(lambda a: a[0], drawn())
    y = jnp.linspace(-1.0, 1.0, 7 * 41).reshape(41, 7)
    h = jnp.asarray(np.random.default_rng(1).normal(size=(41, 7)), jnp.float32)
    push, slope = law(given, y)
    change, of_slope = changes(given, y, h)
    np.testing.assert_allclose(of_slope, push - law(given, y + h)[0], atol=1e-4)
    np.testing.assert_allclose(changes(given, y, -h)[0] >= 0, True)
    np.testing.assert_allclose(change, _integral(given, y, h), atol=2e-2)
    assert np.all(np.asarray(slope) >= 0)


def _integral(given, y, h, n=2000):
    """Of s'(y + t) - s'(y) over t from 0 to h."""
    shares = (jnp.arange(n) + 0.5)[:, None, None] / n
    return jnp.mean((law(given, y)[0] - law(given, y + shares * h)[0]) * h, axis=0)
