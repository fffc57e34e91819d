"""Steps of the unconstrained flow: the densities they sample, and the bounds they keep.

X <- X - alpha M^-1 grad c + sigma sqrt(2 alpha) n,  n ~ N(0, M^-1): as alpha -> 0, exp(-c/sigma^2)
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import Constant, DraxError, GaussNewton, Geometric, Identity, Langevin, LogBarrier
from mjx_drax.method.bounds import Projection, Reflection
from mjx_drax.problem.trajectory import Trajectory, box
from mjx_drax.search.iterate import advance, start
from mjx_drax.solution.program import from_program, minimize

Q = np.array([[2.0, 1.2], [1.2, 1.0]])
CENTRE = np.array([1.0, -2.0])
ROOT = np.linalg.cholesky(Q).T
SIGMA, CHAINS = 0.6, 10_000

QUADRATIC = from_program(2, residual=lambda x: ROOT @ (x - CENTRE))  # c = 1/2 e'Qe
NOISY = Langevin(noise=Constant(SIGMA), damping=Constant(0.0), iterations=10**6)


def sampled(solver, steps):
    knots = Trajectory(jnp.zeros((CHAINS, 1, 0)), jnp.tile(jnp.asarray(CENTRE), (CHAINS, 1, 1)))
    begun = start(solver, QUADRATIC, knots, jax.random.key(0))
    state, _ = advance(solver, QUADRATIC, begun, 0, steps)
    return np.asarray(state.trajectory.u[:, 0], float)


def assert_gaussian(x, covariance):
    """Six standard errors on every mean and covariance, in coordinates where they are white."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), (x - CENTRE).T)
    np.testing.assert_allclose(white.mean(1), 0, atol=6 / len(x) ** 0.5)
    np.testing.assert_allclose(white @ white.T / len(x), np.eye(2), atol=6 * (2 / len(x)) ** 0.5)


BOLTZMANN = SIGMA**2 * np.linalg.inv(Q)  # exp(-c / sigma^2)


@pytest.mark.slow
def test_small_steps_sample_the_boltzmann_density():
    solver = replace(NOISY, preconditioner=Identity(), step_size=0.03)
    assert_gaussian(sampled(solver, 700), BOLTZMANN)


@pytest.mark.slow
def test_large_steps_sample_their_own_gaussian_and_adjusted_ones_the_right_one():
    # e <- (1 - alpha Q) e + sigma sqrt(2 alpha) n has S = sigma^2 Q^-1 (1 - alpha Q / 2)^-1
    alpha = 0.4
    solver = replace(NOISY, preconditioner=Identity(), step_size=alpha)
    assert_gaussian(sampled(solver, 200), BOLTZMANN @ np.linalg.inv(np.eye(2) - alpha * Q / 2))
    with pytest.raises(AssertionError):
        assert_gaussian(sampled(solver, 200), BOLTZMANN)
    assert_gaussian(sampled(replace(solver, adjusted=True), 300), BOLTZMANN)


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "damping"), [(0.05, 0.0), (0.8, 0.0), (0.5, 1.0)])
def test_gauss_newton_samples_the_gaussian_of_its_step_size(alpha, damping):
    # With M = Q + delta: S = sigma^2 Q^-1 (1 - alpha M^-1 Q / 2)^-1
    solver = replace(NOISY, step_size=alpha, damping=Constant(damping))
    share = np.linalg.solve(Q + damping * np.eye(2), Q)
    expected = BOLTZMANN @ np.linalg.inv(np.eye(2) - alpha * share / 2)
    assert_gaussian(sampled(solver, 200), expected)


def test_adjusted_steps_need_a_constant_metric():
    solver = Langevin(adjusted=True, preconditioner=GaussNewton())
    with pytest.raises(DraxError, match=r"adjusted=True with GaussNewton.*Identity"):
        minimize(QUADRATIC, chains=1, solver=solver)


@pytest.mark.slow
def test_annealing_finds_the_deeper_of_two_wells():
    program = from_program(1, cost=lambda x: (x[0] ** 2 - 1) ** 2 + 0.5 * x[0], scatter=(-1.5, 1.5))
    annealed = Langevin(
        preconditioner=Identity(),
        step_size=0.02,
        noise=Geometric(1.0, 0.1),
        iterations=3000,
        tail=20,
    )
    shares = []
    for solver in (annealed, replace(annealed, noise=Constant(0.0))):
        shares.append((minimize(program, chains=1000, solver=solver).x < 0).mean())
    # without noise, what starts left of the hilltop x = 0.127, which is uniform in +-1.5
    assert shares[1] == pytest.approx(1.627 / 3.0, abs=0.06)
    assert shares[0] > 0.9, shares


LOWER, UPPER = np.array([0.0, -np.inf, -1.0, -np.inf]), np.array([1.0, 2.0, np.inf, np.inf])


def confined(bounds, new, old=0.5):
    sides = box(0, 4, None, (LOWER, UPPER))
    knots = [
        Trajectory(jnp.zeros((1, 0)), jnp.asarray(np.broadcast_to(z, (1, 4)), float))
        for z in (old, new)
    ]
    return np.asarray(bounds.confine(sides, *knots).u[0])


@pytest.mark.parametrize(
    ("new", "folded"),
    [
        (0.25, [0.25, 0.25, 0.25, 0.25]),  # inside
        (-0.25, [0.25, -0.25, -0.25, -0.25]),  # at the lower wall
        (1.25, [0.75, 1.25, 1.25, 1.25]),  # at the upper one
        (2.25, [0.25, 1.75, 2.25, 2.25]),  # twice; once where only the upper side is bounded
        (-3.25, [0.75, -3.25, 1.25, -3.25]),  # four times; once where only the lower side is
        (7.5, [0.5, -3.5, 7.5, 7.5]),
    ],
)
def test_reflection_folds_and_projection_clips(new, folded):
    np.testing.assert_allclose(confined(Reflection(), new), folded, atol=1e-6)
    np.testing.assert_array_equal(confined(Projection(), new), np.clip(new, LOWER, UPPER))


BOUNDED = from_program(2, cost=lambda x: 0.5 * x @ Q @ x - x[0] - 3.0 * x[1], bounds=(0.0, 1.0))
CORNER = np.array([0.0, 1.0])  # the gradient there is (0.2, -2)


@pytest.mark.parametrize("bounds", [LogBarrier(), Projection(), Reflection()])
@pytest.mark.parametrize(
    "preconditioner", [Identity(), pytest.param(GaussNewton(), marks=pytest.mark.slow)]
)
def test_every_noisy_step_stays_inside_and_the_optimum_is_found(bounds, preconditioner):
    solver = Langevin(
        preconditioner=preconditioner,
        bounds=bounds,
        noise=Geometric(3.0, 1e-3),
        step_size=0.02,
        barrier_weight=Geometric(0.01, 1e-3, 1e-4),
        iterations=1000,
        tail=100,
    )
    knots = Trajectory(jnp.zeros((64, 1, 0)), jnp.full((64, 1, 2), 0.5))
    state = start(solver, BOUNDED, knots, jax.random.key(0))
    walls = []
    for i in range(8):
        state, _ = advance(solver, BOUNDED, state, i, i + 1)
        x = np.asarray(state.trajectory.u)
        assert x.min() >= 0
        assert x.max() <= 1
        walls.append(np.minimum(x, 1 - x).min())
    assert min(walls) < 0.05  # they were tried
    x = np.asarray(advance(solver, BOUNDED, state, 8, 1100)[0].trajectory.u[:, 0])
    assert (np.abs(x - CORNER).max(1) < 0.1).mean() > 0.9, x


def test_reflection_takes_a_variable_that_is_fixed():
    sides = box(0, 1, None, (0.5, 0.5))
    knots = Trajectory(jnp.zeros((1, 0)), jnp.full((1, 1), 0.7))
    assert Reflection().confine(sides, knots, knots).u[0, 0] == 0.5
