"""Hessians of the Lagrangian, exact and learned, against the whole in one piece."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from mjx_drax import LogBarrier, Trajectory, from_function
from mjx_drax.method.model import Multipliers, expand
from mjx_drax.method.schedules import Weights
from mjx_drax.polish.curvature import measured_hessian, with_exact_hessian
from mjx_drax.polish.secant import Secant, symmetric_update, with_curvature
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.trajectory import Stagewise

K, NX, NU = 3, 2, 1
N = NX + NU
rng = np.random.default_rng(0)
BENT = rng.normal(size=(NX, N, N))  # second derivatives of f


def quadratic(x, u):
    z = jnp.concatenate([x, u])
    return 0.3 * z[:NX] + 0.1 * z[2] + 0.1 * jnp.einsum("aij,i,j->a", BENT, z, z)


def posed(f, **changes):
    given = {
        "running_residual": lambda x, u: jnp.array([x[0] * u[0], x[1] - 1.0, u[0]]),
        "terminal_residual": lambda x: jnp.sin(x) * x[::-1],
        "equality": lambda x, u: jnp.array([x[0] * u[0]]),
        "inequality": lambda x, u: jnp.array([x @ x - 4.0]),
        "terminal_equality": lambda x: x[:1] * x[1] ** 2,
    }
    return from_function(f, x_init=[0.3, -0.2], nu=NU, dt=1.0, horizon=float(K), **given | changes)


def somewhere(problem, seed):
    """Knots, and multipliers that are the same for all seeds."""
    rng = np.random.default_rng(7)
    rows = problem.constraint.rows, problem.terminal_constraint.rows
    shapes = (K, NX), (K, rows[0]), (rows[1],)
    lambda_, stage, end = (jnp.asarray(rng.normal(size=shape)) for shape in shapes)
    rng = np.random.default_rng(seed)
    knots = Trajectory(jnp.asarray(rng.normal(size=(K, NX))), jnp.asarray(rng.normal(size=(K, NU))))
    return knots, Multipliers(lambda_, Stagewise(stage, end))


def derivatives(problem, knots, multipliers):
    """First derivatives, and Gauss-Newton's Hessian."""
    weights = Weights(*map(jnp.asarray, (0.0, 1.0, 0.0, 0.0)))
    at = problem, LogBarrier(), knots, multipliers, weights, Autodiff(), jax.random.key(0)
    return jax.jit(lambda: expand(*at).derivatives)()


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@pytest.mark.slow
def test_the_exact_hessian_is_that_of_the_whole_lagrangian():
    problem = posed(
        lambda x, u: jnp.array([x[0] * jnp.exp(u[0]), jnp.sin(x[0] * x[1]) + u[0] ** 3])
    )
    knots, multipliers = somewhere(problem, 1)
    flat, knots_of = ravel_pytree(knots)
    forces = multipliers.constraints

    def lagrangian(z):
        values = problem.values(knots_of(z))
        of_rows = jnp.sum(forces.stage * values.constraints.stage)
        of_end = jnp.sum(forces.terminal * values.constraints.terminal)
        return values.cost + jnp.sum(multipliers.dynamics * values.defects) + of_rows + of_end

    whole = np.asarray(jax.hessian(lagrangian)(flat))
    cost = derivatives(problem, knots, multipliers).cost
    H = with_exact_hessian(problem, knots, multipliers, cost, Autodiff())
    dense = np.zeros_like(whole)
    for k in range(K):
        u = K * NX + k * NU + np.arange(NU)
        dense[np.ix_(u, u)] = H.Huu[k]
        x = k * NX + np.arange(NX)  # of x_{k+1}
        dense[np.ix_(x, x)] = H.Hxx[k + 1]
        if k:
            before = (k - 1) * NX + np.arange(NX)
            dense[np.ix_(u, before)] = H.Hux[k]
            dense[np.ix_(before, u)] = H.Hux[k].T
    np.testing.assert_allclose(dense, whole, atol=1e-12)
    np.testing.assert_array_equal(H.gx, cost.gx)
    assert np.abs(H.Hxx - cost.Hxx).max() > 0.1  # Gauss-Newton's is another


def stage_blocks(cost):
    """Hessians of the stages in (dx, du), (K, N, N)."""
    rows = [np.block([[cost.Hxx[k], cost.Hux[k].T], [cost.Hux[k], cost.Huu[k]]]) for k in range(K)]
    return np.stack(rows)


MOVES = jnp.ones(N)


def learned(problem, steps):
    """What is learned from so many steps, and what there was to learn."""
    secant = Secant.none(problem)
    for i in range(steps + 1):
        knots, multipliers = somewhere(problem, i)
        found = derivatives(problem, knots, multipliers)
        at = problem, knots, found, multipliers, MOVES
        secant = secant.updated(*at, learns=jnp.asarray(i > 0))
    exact = with_exact_hessian(problem, knots, multipliers, found.cost, Autodiff())
    return secant, found.cost, exact


@pytest.mark.slow
def test_stages_learn_the_curvature_of_a_quadratic_lagrangian_in_as_many_steps_as_numbers():
    """The cost's Hessian is known; that of dynamics and constraints, constant here, is learned."""
    problem = posed(quadratic, running_residual=lambda x, u: jnp.concatenate([x, u]))
    secant, cost, exact = learned(problem, N)
    missing = stage_blocks(exact) - stage_blocks(cost)
    assert np.abs(missing).max() > 0.1
    np.testing.assert_allclose(secant.B[1:], missing[1:], atol=1e-9)
    # x_0 does not move: at the first stage only what controls do is learned
    np.testing.assert_allclose(secant.B[0] @ np.eye(N)[2], missing[0][:, 2], atol=1e-9)
    one = learned(problem, 1)[0]
    assert np.abs(one.B[1:] - missing[1:]).max() > 0.1
    added = with_curvature(cost, one.B)
    np.testing.assert_allclose(stage_blocks(added) - stage_blocks(cost), one.B, atol=1e-12)


def test_differences_measure_the_hessian_and_stay_away_from_where_controls_are_cut_off():
    def f(x, u):
        return jnp.array([x[0] * jnp.exp(u[0]), jnp.sin(x[0] * x[1]) + u[0] ** 3])

    box = (-0.5, 0.5)
    whole = posed(f, u_bounds=box)
    cut_off = posed(lambda x, u: f(x, jnp.clip(u, *box)), u_bounds=box)
    knots, multipliers = somewhere(whole, 1)
    knots = replace(knots, u=jnp.array([[0.5], [-0.5], [0.1]]))
    cost = derivatives(whole, knots, multipliers).cost
    exact = jax.jit(with_exact_hessian)(whole, knots, multipliers, cost, Autodiff())
    for problem in (whole, cut_off):
        ones = jnp.ones(NX), 2.0 * jnp.ones(NU)
        H = jax.jit(measured_hessian)(problem, knots, multipliers, *ones)
        np.testing.assert_allclose(H, stage_blocks(exact), atol=0.01)
        np.testing.assert_allclose(H[2], stage_blocks(exact)[2], atol=1e-5)  # inside


@pytest.mark.slow
def test_nothing_is_learned_from_standing_still_or_from_rounding():
    problem = posed(quadratic)
    secant = learned(problem, N)[0]
    knots, multipliers = somewhere(problem, N)
    moved = replace(knots, u=knots.u + 1e-15)
    for near in (knots, moved):
        found = derivatives(problem, near, multipliers)
        again = secant.updated(problem, near, found, multipliers, MOVES, learns=jnp.asarray(True))
        np.testing.assert_array_equal(again.B, secant.B)
    far, _ = somewhere(problem, 50)
    found = derivatives(problem, far, multipliers)
    still = secant.updated(problem, far, found, multipliers, MOVES, learns=jnp.asarray(False))
    np.testing.assert_array_equal(still.B, secant.B)
    np.testing.assert_array_equal(still.x, problem.with_start(far)[:-1])


@pytest.mark.slow
def test_what_is_known_survives_small_steps_whatever_their_direction():
    problem = posed(
        lambda x, u: jnp.array([x[0] * jnp.exp(u[0]), jnp.sin(x[0] * x[1]) + u[0] ** 3])
    )
    knots, multipliers = somewhere(problem, 1)
    found = derivatives(problem, knots, multipliers)
    exact = with_exact_hessian(problem, knots, multipliers, found.cost, Autodiff())
    known = stage_blocks(exact) - stage_blocks(found.cost)
    here = Secant.none(problem).updated(
        problem, knots, found, multipliers, MOVES, learns=jnp.asarray(False)
    )
    here = replace(here, B=known)

    @jax.jit
    def after(key):
        of_x, of_u = jax.random.split(key)
        x = knots.x + 1e-5 * jax.random.normal(of_x, knots.x.shape)
        near = replace(knots, x=x, u=knots.u + 1e-5 * jax.random.normal(of_u, knots.u.shape))
        found = derivatives(problem, near, multipliers)
        return here.updated(problem, near, found, multipliers, MOVES, jnp.asarray(True)).B

    changes = np.abs(jax.vmap(after)(jax.random.split(jax.random.key(0), 1000)) - known)
    assert np.median(changes.max(axis=(1, 2, 3))) > 1e-7
    assert changes.max() < 0.02


def test_what_is_learned_has_no_units():
    rng = np.random.default_rng(0)
    units = jnp.array([1e3, 1e-2, 30.0])
    for i in range(20):
        s = rng.normal(size=N)
        r = rng.normal(size=N)
        if i % 2:  # orthogonal to the step
            r -= r @ s / (s @ s) * s
        D = symmetric_update(jnp.asarray(r), jnp.asarray(s), MOVES)
        np.testing.assert_allclose(D @ s, r, atol=1e-9)
        np.testing.assert_allclose(D, D.T)
        other = symmetric_update(r / units, s * units, units)
        np.testing.assert_allclose(other * jnp.outer(units, units), D, rtol=1e-9, atol=1e-12)
