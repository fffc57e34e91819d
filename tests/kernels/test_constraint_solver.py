"""Accelerations under constraints: the plain solver, and its GPU kernel, interpreted."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels import elliptic_cones as elliptic
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


def drawn_with_cones(rows=8, nv=5):
    """Two contacts, of 3 and 4 rows, and a limit."""
    given, rng = drawn(rows, nv, 8), np.random.default_rng(1)
    of, normal = np.array([1, 1, 1, 2, 2, 2, 2, 0.0]), np.array([1, 0, 0, 1, 0, 0, 0, 0.0])
    friction = rng.uniform(0.3, 2.0, size=(rows, 8))
    mu = np.stack([friction[:, 1], friction[:, 4]], axis=1)[:, [0, 0, 0, 1, 1, 1, 1, 1]] / 3.0
    scale = np.where(of > 0, np.where(normal > 0, mu, friction), 0.0)
    weight = rng.uniform(1.0, 30.0, size=(rows, 2))[:, [0, 0, 0, 1, 1, 1, 1, 1]]
    cones = elliptic.Cones(
        *(np.broadcast_to(a, (rows, 8)) for a in (of, normal)), scale, mu, weight
    )
    bounds = np.full((rows, 8), -np.inf), np.zeros((rows, 8))
    given = given._replace(D=np.where(of > 0, 0.0, given.D), lower=bounds[0], upper=bounds[1])
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given._replace(cones=cones))


def potential(cones, y):
    """s(y) of the contacts, zone by zone as MuJoCo's documentation has it."""
    u, total = cones.scale * y, 0.0
    for contact in (1, 2):
        mine = cones.of == contact
        N = jnp.sum(jnp.where(mine, cones.normal * u, 0.0))
        T = jnp.sqrt(jnp.sum(jnp.where(mine, (1.0 - cones.normal) * u**2, 0.0)))
        mu, g = (jnp.max(jnp.where(mine, a, 0.0)) for a in (cones.mu, cones.weight))
        sliding = 0.5 * g * (N - mu * T) ** 2 / (1.0 + mu**2)
        sticking = jnp.where(mu * N + T <= 0.0, 0.5 * g * (N**2 + T**2), sliding)
        total += jnp.where(mu * T <= N, 0.0, sticking)
    return total


def test_cones_have_the_derivatives_and_the_changes_of_their_potential():
    def compared(cones, y, size, direction):
        def total(x):
            return elliptic.together(cones) @ x

        at, slope = elliptic.place(cones, total, y), jax.grad(potential, 1)
        h, ray = size * direction, elliptic.ray(cones, total, at, direction)
        change, rise = elliptic.changes(cones, at, ray, size)
        grown = potential(cones, y + h) - potential(cones, y) - slope(cones, y) @ h
        pairs = (
            (-elliptic.forces(cones, at), slope(cones, y)),
            (elliptic.curvature(cones, at), jax.hessian(potential, 1)(cones, y)),
            (change.sum(), grown),
            (rise, slope(cones, y + h) - slope(cones, y)),
        )
        return at.zone, pairs

    rng = np.random.default_rng(2)
    with jax.enable_x64(True):
        cones = jax.tree.map(lambda a: jnp.asarray(a[0], float), drawn_with_cones().cones)
        y, direction = rng.normal(size=(2, 200, 8))
        sizes = rng.choice([1e-3, 1.0, 4.0], size=200)
        zones, pairs = jax.jit(jax.vmap(partial(compared, cones)))(y, sizes, direction)
    for found, wanted in pairs:
        np.testing.assert_allclose(found, wanted, atol=1e-8)
    assert set(np.unique(zones)) == {0.0, elliptic.STICKS, elliptic.SLIDES, elliptic.OPEN}


@pytest.mark.slow
def test_among_cones_the_gradient_is_zero_and_the_factor_is_that_of_the_hessian():
    given = drawn_with_cones()

    def least(given, a):
        y, apart = given.J @ a - given.aref, a - given.a0
        limits = 0.5 * given.D @ jnp.clip(y, max=0.0) ** 2
        return 0.5 * apart @ given.M @ apart + limits + potential(given.cones, y)

    a, factor = jax.jit(jax.vmap(constrained_minimum))(given)
    slope, bent = (jax.vmap(d(least, 1))(given, a) for d in (jax.grad, jax.hessian))
    assert np.abs(slope).max() < 1e-4
    np.testing.assert_allclose(factor @ factor.mT, bent, rtol=1e-3, atol=1e-3)


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
@pytest.mark.parametrize("make", [drawn, drawn_with_cones])
def test_the_kernel_finds_the_same_accelerations(make):
    given = make()
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
