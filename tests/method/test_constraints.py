"""Constraints and their slack variables against dense linear algebra and KKT points.

At one knot M = [J'WJ ...; ...] over (dz, ds) is formed whole here, and never in the library.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial

from mjx_drax import Constant, GaussNewton, Langevin, LogBarrier, Trajectory, from_function, solve
from mjx_drax.method.bounds import Projection
from mjx_drax.method.descent import augmented_lagrangian
from mjx_drax.method.gauss_newton import eliminate, slack_noise, slack_step
from mjx_drax.method.model import Multipliers, expand
from mjx_drax.method.schedules import Weights
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.trajectory import Stagewise
from mjx_drax.search import iterate
from mjx_drax.solution.program import from_program, minimize


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize(("equalities", "inequalities"), [(2, 3), (0, 2), (2, 0)])
def test_elimination_is_the_schur_complement(equalities, inequalities):
    n, m = 4, equalities + inequalities
    rng = np.random.default_rng(m)
    mu = rng.uniform(3.0, 30.0, m)  # a penalty for each row
    J, r, nu = rng.normal(size=(m, n)), rng.normal(size=m), rng.normal(size=m)
    slope, curvature = rng.normal(size=inequalities), rng.uniform(0.5, 50.0, inequalities)
    H, grad = 2.0 * np.eye(n), rng.normal(size=n)  # what the cost has to say about dz
    S = np.eye(m)[:, equalities:]  # d residual / d slack
    whole = np.hstack([J, S])
    M = whole.T * mu @ whole
    M[:n, :n] += H
    M[n:, n:] += np.diag(curvature)
    full = whole.T @ (nu + mu * r) + np.concatenate([grad, slope])

    gradient, hessian, block = eliminate(*map(jnp.asarray, (J, r, nu, slope, curvature)), mu)
    zz, zs, ss = M[:n, :n], M[:n, n:], M[n:, n:]
    np.testing.assert_allclose(hessian, zz - H - zs @ np.linalg.solve(ss, zs.T), atol=1e-12)
    reduced = full[:n] - grad - zs @ np.linalg.solve(ss, full[n:])
    np.testing.assert_allclose(gradient, reduced, atol=1e-12)

    step = -np.linalg.solve(M, full)
    dz, nz, white = step[:n], rng.normal(size=n), rng.normal(size=inequalities)
    ds, rate = slack_step(block, jnp.asarray(dz), mu)
    ns = slack_noise(block, jnp.asarray(nz), jnp.asarray(white), mu)
    np.testing.assert_allclose(ds, step[n:], atol=1e-12)
    np.testing.assert_allclose(rate, mu * (r + whole @ step), atol=1e-11)
    # under N(0, M^-1), given nz: mean -ss^-1 sz nz and covariance ss^-1
    spread = np.linalg.cholesky(np.linalg.inv(ss)) @ white
    np.testing.assert_allclose(ns, -np.linalg.solve(ss, zs.T @ nz) + spread, atol=1e-12)


K, NX, NU = 3, 2, 2
RATE = np.array([[0.9, 0.3], [-0.2, 1.0]])
WEIGHTS = Weights(*map(jnp.asarray, (0.5, 5.0, 0.2, 0.3)))  # sigma, mu, delta, rho


def bent(bend, x, u):
    return RATE @ x + 0.1 * u + bend * jnp.sin(x[::-1] * u)


def running(x, u):
    return jnp.concatenate([0.7 * x, u[:1] + 0.2 * x[:1], u[1:] - 1.0])


def terminal(x):
    return 2.0 * (x - 1.0)


def equality(bend, x, u):
    return jnp.array([u[0] + x[1] - 0.3 + bend * u[1] ** 2])


def inequality(bend, x, u):
    return jnp.array([u[0] - u[1] - 1.5, x[0] - 1.0 + bend * u[0] ** 3])


def terminal_equality(bend, x):
    return jnp.array([x[0] - 0.4 + bend * x[1] ** 2])


def terminal_inequality(x):
    return x[1:] - 0.8


def constrained(bend):
    """Equalities and inequalities at the stages and at the end; all linear where bend = 0."""
    return from_function(
        Partial(bent, bend),
        x_init=[0.5, -0.3],
        nu=NU,
        dt=1.0,
        horizon=K,
        running_residual=running,
        terminal_residual=terminal,
        equality=Partial(equality, bend),
        inequality=Partial(inequality, bend),
        terminal_equality=Partial(terminal_equality, bend),
        terminal_inequality=terminal_inequality,
        x_bounds=(-3.0, 3.0),
        u_bounds=([-2.0, -np.inf], [np.inf, 2.0]),
    )


def somewhere(seed=0):
    """A point strictly inside the bounds, positive slacks, and multipliers."""
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(0.5 * rng.normal(size=shape))

    slack = Stagewise(jnp.asarray(rng.uniform(0.1, 1, (K, 2))), jnp.asarray(rng.uniform(0.1, 1, 1)))
    multipliers = Multipliers(normal(K, NX), Stagewise(normal(K, 3), normal(2)))
    return Trajectory(normal(K, NX), normal(K, NU), slack), multipliers


@jax.jit
def dense(problem, trajectory, multipliers):
    """M, the gradient of L_mu, h and its Jacobian, over all variables and slacks in one vector."""
    point, unravel = ravel_pytree(trajectory)

    def lagrangian(p):
        z = unravel(p)
        values = problem.values(z)
        return augmented_lagrangian(problem, LogBarrier(), z, multipliers, WEIGHTS, values).sum()

    def h(p):
        z = unravel(p)
        constraints = problem.with_slack(problem.constraints(z), z.slack)
        return ravel_pytree(Multipliers(problem.defects(z), constraints))[0]

    def convex(p):
        barrier = WEIGHTS.barrier * LogBarrier().value(problem.bounds, unravel(p)).sum()
        return problem.cost(unravel(p)) + barrier

    J = jax.jacobian(h)(point)
    M = (
        jax.hessian(convex)(point)
        + WEIGHTS.penalty * J.T @ J
        + WEIGHTS.damping * jnp.eye(len(point))
    )
    return M, jax.grad(lagrangian)(point), h(point), J, jax.hessian(lagrangian)(point)


@jax.jit
def direction(problem, trajectory, multipliers, key):
    by, key_model = Autodiff(), jax.random.split(key)[0]
    at = trajectory, multipliers, WEIGHTS
    model = expand(problem, LogBarrier(), *at, by, key_model)
    return GaussNewton().direction(problem, model, key, ())


@pytest.mark.parametrize("bend", [0.0, 0.4], ids=["linear", "nonlinear"])
def test_gauss_newtons_direction_is_that_of_the_dense_metric(bend):
    problem, (trajectory, multipliers) = constrained(bend), somewhere()
    M, gradient, h, J, hessian = dense(problem, trajectory, multipliers)
    if bend == 0.0:  # M is then all of the Hessian of L_mu, and delta
        np.testing.assert_allclose(hessian + WEIGHTS.damping * np.eye(len(M)), M, atol=1e-11)
    to = direction(problem, trajectory, multipliers, jax.random.key(0))
    step = -np.linalg.solve(M, gradient)
    np.testing.assert_allclose(ravel_pytree(to.drift)[0], step, atol=1e-10)
    rates = ravel_pytree(to.multipliers)[0]
    np.testing.assert_allclose(rates, WEIGHTS.penalty * (h + J @ step), atol=1e-9)


def test_gauss_newtons_noise_has_covariance_1_over_m():
    problem, (trajectory, multipliers) = constrained(0.4), somewhere()
    M = dense(problem, trajectory, multipliers)[0]
    draws = 20_000

    @jax.jit
    @jax.vmap
    def noise(key):
        return ravel_pytree(direction(problem, trajectory, multipliers, key).noise)[0]

    white = noise(jax.random.split(jax.random.key(0), draws)) @ np.linalg.cholesky(M)
    np.testing.assert_allclose(white.mean(0), 0, atol=6 / draws**0.5)
    np.testing.assert_allclose(white.T @ white / draws, np.eye(len(M)), atol=6 * (2 / draws) ** 0.5)


DT, N = 0.2, 10
TARGET = np.array([1.0, 0.0])
FORWARD, PUSH = np.array([[1.0, DT], [0.0, 1.0]]), np.array([0.5 * DT**2, DT])


def push(x, u):
    return FORWARD @ x + PUSH * u[0]


def effort(x, u):
    return jnp.array([u[0], 0.5 * x[1]])


def miss(target, x):
    return x - target


def limits(limit, x, u):
    return jnp.array([x[1] - limit, x[1] + u[0] - 1.2, u[0] - 50.0])


def cart(**rest):
    """A mass pushed from rest: min sum 1/2 u^2 + 1/2 (x_2 / 2)^2."""
    return from_function(
        push, x_init=[0.0, 0.0], nu=1, dt=DT, horizon=N * DT, running_residual=effort, **rest
    )


FIXED_END = {"terminal_equality": Partial(miss, TARGET)}


def kkt():
    """Controls, states and the end's multipliers, condensed: x_k = sum_j F^(k-1-j) P u_j."""
    response = np.zeros((N, 2, N))
    for k in range(N):
        for j in range(k + 1):
            response[k, :, j] = np.linalg.matrix_power(FORWARD, k - j) @ PUSH
    speed, E = response[:-1, 1], response[-1]
    H = np.eye(N) + 0.25 * speed.T @ speed
    whole = np.block([[H, E.T], [E, np.zeros((2, 2))]])
    u, multipliers = np.split(np.linalg.solve(whole, np.append(np.zeros(N), TARGET)), [N])
    return u, response @ u, multipliers


@pytest.mark.slow
def test_a_fixed_end_is_reached_along_the_kkt_trajectory():
    u, x, multipliers = kkt()
    found = solve(cart(**FIXED_END), chains=2, solver=Langevin())
    np.testing.assert_allclose(found.trajectories.x[:, -1], [TARGET] * 2, atol=1e-5)
    np.testing.assert_allclose(found.trajectories.u[:, :, 0], [u] * 2, atol=1e-5)
    np.testing.assert_allclose(found.trajectories.x, [x] * 2, atol=1e-5)
    at_end = found.multipliers.constraints.terminal
    np.testing.assert_allclose(at_end, [multipliers] * 2, atol=1e-4)
    assert found.certified


LIMIT = 0.7


@pytest.mark.slow
def test_a_speed_limit_is_kept_and_felt():
    _, x, _ = kkt()
    assert x[:, 1].max() > LIMIT + 0.05  # without it
    problem = cart(**FIXED_END, inequality=Partial(limits, LIMIT))
    found = solve(problem, chains=2)
    assert found.feasible.all()
    x, u = np.asarray(problem.with_start(found.best))[:-1], found.best.u[:, 0]
    g = np.stack([x[:, 1] - LIMIT, x[:, 1] + u - 1.2, u - 50.0], axis=1)
    nu, slack = found.multipliers.constraints.stage[found.best_chain], found.best.slack.stage
    assert g.max() < 1e-3
    np.testing.assert_allclose(g + slack, 0, atol=1e-3)
    assert g[:, :2].max(axis=0).min() > -5e-3  # both limits are felt
    assert nu[:, :2].max(axis=0).min() > 0.1
    assert nu.min() > -1e-3
    np.testing.assert_allclose(nu * slack, 0, atol=5e-3)
    assert nu[:, 2].max() < 1e-3  # and this one is not


def run(solver, problem):
    knots = Trajectory(jnp.zeros((1, N, 2)), jnp.zeros((1, N, 1)))
    stop = solver.iterations + solver.tail
    begun = iterate.start(solver, problem, knots, jax.random.key(0))
    return iterate.advance(solver, problem, begun, 0, stop)[0]


SHORT = Langevin(iterations=15, tail=5)


@pytest.mark.slow
def test_numbers_of_constraints_change_without_recompiling():
    before, ends = iterate.iterate._cache_size(), []
    for limit, target in ((0.7, TARGET), (0.4, TARGET), (0.7, 2 * TARGET)):
        problem = cart(inequality=Partial(limits, limit), terminal_equality=Partial(miss, target))
        ends.append(run(SHORT, problem).trajectory.u)
    assert iterate.iterate._cache_size() - before == 1
    assert not np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [Projection()])
def test_gauss_newton_keeps_inequalities_whatever_the_bounds(bounds):
    # min 1/2 (x - 2)^2 s.t. x <= 1
    program = from_program(1, residual=lambda x: x - 2.0, inequality=lambda x: x - 1.0)
    found = minimize(program, chains=1, solver=Langevin(noise=Constant(0.0), bounds=bounds))
    np.testing.assert_allclose(found.x, 1.0, atol=1e-2)
