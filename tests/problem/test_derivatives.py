"""Derivatives from samples against exact ones, and solves that see function values only."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import norm

from mjx_drax import Constant, GaussNewton, Geometric, Identity, Langevin, from_function, solve
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.bounds import LogBarrier
from mjx_drax.method.model import Multipliers, expand, linearize
from mjx_drax.method.schedules import Weights
from mjx_drax.problem.cost import as_partial
from mjx_drax.problem.differentiators import Autodiff, Smoothed, without_gaps
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.problem.trajectory import Stagewise, Trajectory

N, M = 8, 5
W = np.random.default_rng(0).normal(size=(M, N)) / N**0.5
PHASE = np.arange(M) / M


def waves(dz):
    return jnp.sin(2.0 * W @ dz + PHASE)


def estimates(by, function, size, draws=64):
    return jax.jit(jax.vmap(lambda key: by.jacobian(function, size, key)[0]))(
        jax.random.split(jax.random.key(0), draws)
    )


def test_autodiff_is_exact():
    jacobian, value = Autodiff().jacobian(waves, N, jax.random.key(0))
    np.testing.assert_allclose(value, np.sin(PHASE), rtol=1e-6)
    np.testing.assert_allclose(jacobian, 2.0 * np.cos(PHASE)[:, None] * W, rtol=1e-5)
    hessian = Autodiff().hessian(lambda dz: waves(dz)[1], N)
    np.testing.assert_allclose(hessian, -4 * np.sin(PHASE[1]) * np.outer(W[1], W[1]), atol=1e-6)


@pytest.mark.parametrize(("pairs", "exact"), [(N - 1, False), (N, True), (3 * N, True)])
def test_smoothed_is_exact_for_linear_functions_from_as_many_pairs_as_unknowns(pairs, exact):
    own_W, own_phase = W.copy(), PHASE.copy()  # JAX knows the others in float32
    with jax.enable_x64(True):
        by = Smoothed(pairs=pairs, radius=0.5)
        jacobian, value = by.jacobian(lambda dz: own_W @ dz + own_phase, N, jax.random.key(1))
    assert (np.abs(jacobian - W).max() < 1e-3) == exact
    np.testing.assert_allclose(value, PHASE, rtol=1e-12)


def test_smoothed_approaches_the_gradient_of_the_smoothed_function():
    # E sin(w'(z + r n)) = exp(-r^2 |w|^2 / 2) sin(w'z)
    radius = 0.8
    damped = np.exp(-2.0 * radius**2 * np.sum(W**2, axis=1)) * np.cos(PHASE)
    exact, errors = 2.0 * damped[:, None] * W, []
    for pairs in (4, 16, 64, 256):
        off = estimates(Smoothed(pairs, radius), waves, N) - exact
        errors.append(np.sqrt(np.mean(off**2) / np.mean(exact**2)))
    assert errors[0] > 1.3 * errors[1] > 2.0 * errors[2] > 3.0 * errors[3], errors
    assert errors[2] / errors[3] == pytest.approx(2.0, rel=0.25)  # as 1 / sqrt(pairs)
    unsmoothed = 2.0 * np.cos(PHASE)[:, None] * W
    far = np.sqrt(np.mean((exact - unsmoothed) ** 2) / np.mean(exact**2))
    assert errors[3] < far / 3  # it is the smoothed function that it sees


def pendulum(x, u):
    rate = x[1] + 0.1 * (u[0] - 5.0 * jnp.sin(x[0]))
    return jnp.array([x[0] + 0.1 * rate, rate])


@pytest.mark.parametrize(("pairs", "least"), [(2, 0.3), (4, 0.999), (16, 0.9999)])
def test_directions_of_the_dynamics_jacobian(pairs, least):
    def f(dz):
        return pendulum(jnp.array([2.0, 1.0]) + dz[:2], dz[2:])

    exact = np.ravel(Autodiff().jacobian(f, 3, jax.random.key(0))[0])
    seen = np.reshape(estimates(Smoothed(pairs, 0.1), f, 3), (-1, exact.size))
    cosine = seen @ exact / np.linalg.norm(seen, axis=1) / np.linalg.norm(exact)
    assert np.quantile(cosine, 0.1) > least, np.quantile(cosine, 0.1)


def test_jumps_and_stairs_have_the_slope_of_their_smoothing():
    at, radius, steps = 0.3, 0.4, np.arange(-8, 8) + 0.5

    def stairs(dz):
        return jnp.concatenate([jnp.round(at + dz), jnp.where(at + dz > 0.1, 3.0, -1.0)])

    assert not np.any(Autodiff().jacobian(stairs, 1, jax.random.key(0))[0])  # what is to be mended
    slopes = [norm.pdf(steps, at, radius).sum(), 4.0 * norm.pdf(0.1, at, radius)]
    seen = estimates(Smoothed(1000, radius), stairs, 1)[:, :, 0]
    np.testing.assert_allclose(seen.mean(0), slopes, rtol=0.03)


def test_smoothed_gradients_are_unbiased_and_have_no_curvature():
    by = Smoothed(pairs=16, radius=0.1)
    slopes = estimates(by, lambda dz: jnp.sum(dz**2 + 3.0 * dz)[None], 3)  # even terms cancel
    np.testing.assert_allclose(slopes, 3.0, rtol=1e-3)
    assert not np.any(by.hessian(lambda dz: jnp.sum(dz**2), 3))


K = 4


def constrained():
    return from_function(
        pendulum,
        x_init=[0.3, 0.0],
        nu=1,
        dt=0.1,
        horizon=0.1 * K,
        running_cost=lambda x, u: jnp.sum(jnp.cos(x)) + jnp.sum(u**2),
        running_residual=lambda x, u: jnp.append(x * u, x[1]),
        terminal_residual=lambda x: 3.0 * jnp.sin(x),
        equality=lambda x, u: x[:1] * u - 0.2,
        inequality=lambda x, u: jnp.append(x**2 - 1.0, u[0] * x[1]),
        terminal_equality=lambda x: x[:1] ** 3,
        terminal_inequality=lambda x: x[1:] - 1.0,
        u_bounds=(-3.0, 3.0),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("by", "atol"),
    [(Autodiff(), 1e-10), pytest.param(Smoothed(64, 1e-4), 1e-4, marks=pytest.mark.slow)],
    ids=["exact", "sampled"],
)
def test_the_papers_flow_is_the_same_from_assembled_derivatives(by, atol):
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)

        def normal(*shape):
            return jnp.asarray(rng.normal(size=shape))

        slack = Stagewise(jnp.abs(normal(K, 3)), jnp.abs(normal(1)))
        z = Trajectory(normal(K, 2), normal(K, 1), slack)
        multipliers = Multipliers(normal(K, 2), Stagewise(normal(K, 4), normal(2)))
        weights = Weights(*map(jnp.asarray, (0.5, 5.0, 0.2, 0.3)))

        @jax.jit
        def direction(metric, problem, z, multipliers, weights):
            keys = jax.random.split(jax.random.key(0))
            at = z, multipliers, weights, metric.derivatives
            model = expand(problem, LogBarrier(), *at, keys[0])
            return metric.direction(problem, model, keys[1], ())

        at = constrained(), z, multipliers, weights
        one, other = (direction(Identity(derivatives), *at) for derivatives in (None, by))
        for part in ("drift", "noise", "multipliers"):
            flat, expected = (ravel_pytree(getattr(d, part))[0] for d in (other, one))
            scale = np.abs(expected).max()
            np.testing.assert_allclose(flat, expected, atol=atol * scale, err_msg=part)


SOLVER = Langevin(
    iterations=60, tail=60, noise=Geometric(0.3, 0.01), penalty=Geometric(100.0, 1000.0)
)


@pytest.mark.slow
def test_a_pendulum_is_solved_from_function_values_alone():
    problem = from_function(
        pendulum,
        x_init=[0.0, 0.0],
        nu=1,
        dt=0.1,
        horizon=2.0,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=lambda x: 5.0 * (x - jnp.array([1.0, 0.0])),
        u_bounds=(-6.0, 6.0),
    )
    solver = replace(SOLVER, preconditioner=GaussNewton(Smoothed(16, 1e-2)))
    found = solve(problem, chains=4, solver=solver)
    assert found.feasible.all(), found.max_defect
    assert found.certified
    np.testing.assert_allclose(found.best.x[-1], [1.0, 0.0], atol=0.1)


@pytest.mark.slow
def test_dynamics_without_a_useful_derivative_are_solved():
    # A push below 1/2 does nothing: from rest, exact derivatives see no reason to push
    def sledge(x, u):
        push = jnp.where(jnp.abs(u[0]) < 0.5, 0.0, u[0] - 0.5 * jnp.sign(u[0]))
        rate = x[1] + 0.1 * push
        return jnp.array([x[0] + 0.1 * rate, rate])

    problem = from_function(
        sledge,
        x_init=[0.0, 0.0],
        nu=1,
        dt=0.1,
        horizon=2.0,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=lambda x: 5.0 * (x - jnp.array([1.0, 0.0])),
    )
    rest = Trajectory(jnp.zeros((20, 2)), jnp.zeros((20, 1)))
    assert np.linalg.norm(jax.grad(problem.cost)(rest).u) == 0
    assert not np.any(jax.jacobian(sledge, 1)(jnp.zeros(2), jnp.zeros(1)))
    solver = replace(SOLVER, noise=Constant(0.0), preconditioner=GaussNewton(Smoothed(32, 0.3)))
    found = solve(problem, chains=4, solver=solver, guess=rest)
    assert found.feasible.all(), found.max_defect
    assert found.certified
    assert found.cost.max() < 0.1 * problem.cost(rest), found.cost


@pytest.mark.parametrize(
    ("bad", "expected"),
    [
        ([], [0, 1, 2, 3, 4]),
        ([2, 3], [0, 1, 1, 1, 4]),
        ([0, 1], [2, 2, 2, 3, 4]),
        ([0, 4], [1, 1, 2, 3, 3]),
    ],
)
def test_a_knot_without_a_derivative_takes_that_of_the_knot_before(bad, expected):
    J = jnp.arange(5.0)[:, None, None] * jnp.ones((5, 2, 3))
    found = without_gaps(J.at[jnp.array(bad, int), 1, 0].set(jnp.nan))
    np.testing.assert_array_equal(found, J[jnp.array(expected)])


def test_where_no_knot_has_a_derivative_none_is_made_up():
    assert jnp.isnan(without_gaps(jnp.full((5, 2, 3), jnp.nan))).all()


@register_dataclass
@dataclass(frozen=True)
class Tried(FunctionDynamics):
    """As dynamics of a model, whose derivatives `check` compares."""

    checked = True


@pytest.mark.parametrize(("kind", "whole"), [(Tried, True), (FunctionDynamics, False)])
def test_only_models_pass_over_a_knot_without_a_derivative(kind, whole):
    def step(x, u):  # has none at u = 0.5
        return x + 0.1 * u + 0.0 * jnp.sqrt(jnp.abs(u - 0.5))

    problem = from_function(
        step, x_init=[0.0], nu=1, dt=0.1, horizon=0.3, running_cost=lambda x, u: u @ u
    )
    problem = replace(problem, dynamics=kind(as_partial(step), 0.1, 1, 1))
    knots = Trajectory(jnp.zeros((3, 1)), jnp.array([[0.2], [0.5], [0.1]]))
    found = linearize(problem, knots, Autodiff(), jax.random.split(jax.random.key(0), 3))
    assert jnp.isfinite(found.h).all()
    assert bool(jnp.isfinite(found.B).all()) == whole
    np.testing.assert_allclose(found.B[jnp.array([0, 2]), 0, 0], 0.1, rtol=1e-5)
