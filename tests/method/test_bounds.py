"""The log barrier: its derivatives, the rule that keeps knots inside, and both in a solve."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from mjx_drax import (
    Constant,
    Geometric,
    Identity,
    Langevin,
    LogBarrier,
    Trajectory,
    from_function,
    solve,
)
from mjx_drax.method.bounds import FOLLOW
from mjx_drax.problem.trajectory import Box, box

K, NX, NU = 5, 3, 2
INF = np.inf
BARRIER = LogBarrier()
BOUNDS = box(NX, NU, ([-1.0, -INF, -INF], [2.0, 0.5, INF]), ([0.0, -INF], [1.0, INF]))
FREE = Box(*(np.full(n, end) for n, end in ((NX, -INF), (NX, INF), (NU, -INF), (NU, INF))))


def inside(seed=0):
    """A trajectory strictly inside BOUNDS."""
    x, u = jax.random.uniform(jax.random.key(seed), (2, K, NX), minval=0.05, maxval=0.45)
    return Trajectory(x, u[:, :NU])


def flat(z):
    return np.concatenate([np.ravel(z.x), np.ravel(z.u)])


def assert_inside(bounds, z, strictly=False):
    for side, sign in zip(bounds.sides(z), (1, -1), strict=True):
        slack = sign * (flat(z) - flat(side))
        assert np.all(slack > 0 if strictly else slack >= 0)


def test_value_is_minus_the_sum_of_log_slacks_of_a_stage():
    z = inside()
    x, u = np.asarray(z.x), np.asarray(z.u)
    finite = [x[:, 0] + 1, 2 - x[:, 0], 0.5 - x[:, 1], u[:, 0], 1 - u[:, 0]]
    np.testing.assert_allclose(
        BARRIER.value(BOUNDS, z), -np.sum(np.log(finite), axis=0), rtol=1e-5, atol=1e-6
    )


def test_derivatives_are_those_of_the_value():
    with jax.enable_x64(True):
        z = jax.tree.map(lambda a: jnp.asarray(a, float), inside())
        points, unravel = ravel_pytree(z)

        def value(p):
            return 0.3 * BARRIER.value(BOUNDS, unravel(p)).sum()

        slope, curvature = BARRIER.derivatives(BOUNDS, z, 0.3)
        np.testing.assert_allclose(flat(slope), jax.jit(jax.grad(value))(points), rtol=1e-12)
        hessian = jax.jit(jax.hessian(value))(points)
        np.testing.assert_allclose(np.diag(flat(curvature)), hessian, rtol=1e-12)


def test_multipliers_follow_newtons_step_towards_the_central_path():
    rho, z = 0.3, inside()
    central = BARRIER.multipliers(BOUNDS, z, rho)
    v = jax.tree.map(lambda a: 1.5 * a, central)
    step = jax.tree.map(lambda a: jnp.full_like(a, 1e-3), z)
    new = jax.tree.map(jnp.add, z, step)
    for sign, end, before, after in zip(
        (1, -1), BOUNDS.sides(z), v, BARRIER.follow(BOUNDS, z, new, v, rho, 1.0), strict=True
    ):
        slack, bounded = sign * (flat(z) - flat(end)), jnp.isfinite(flat(end))
        dv, ds = flat(after) - flat(before), sign * flat(step)
        slack, dv, ds, old = (a[bounded] for a in (slack, dv, ds, flat(before)))
        np.testing.assert_allclose(slack * old + slack * dv + old * ds, rho, rtol=1e-4)
        assert not np.any(flat(after)[~bounded])


def test_multipliers_stay_within_a_factor_of_the_central_path():
    rho, z = 0.3, inside()
    for share in (1e-9, 1e9):
        wild = jax.tree.map(lambda a, share=share: share * a, BARRIER.multipliers(BOUNDS, z, rho))
        held = BARRIER.follow(BOUNDS, z, z, wild, rho, 0.0)
        central = BARRIER.multipliers(BOUNDS, z, rho)
        allowed = np.clip(share, 1 / FOLLOW, FOLLOW)
        for a, b in zip(held, central, strict=True):
            np.testing.assert_allclose(flat(a), allowed * flat(b), rtol=1e-5)


def test_curvature_is_the_multiplier_over_the_slack():
    z = inside()
    v = jax.tree.map(lambda a: 2.0 * a, BARRIER.multipliers(BOUNDS, z, 0.3))
    slope, curvature = BARRIER.derivatives(BOUNDS, z, 0.3, v)
    primal = BARRIER.derivatives(BOUNDS, z, 0.3)
    np.testing.assert_array_equal(flat(slope), flat(primal[0]))
    np.testing.assert_allclose(flat(curvature), 2.0 * flat(primal[1]), rtol=1e-6)


def test_infinite_bounds_contribute_nothing():
    z = inside()
    for part in (BARRIER.value(FREE, z), *map(flat, BARRIER.derivatives(FREE, z, 1.0))):
        assert not np.any(part)
    far = jax.tree.map(lambda a: 1e9 * a, z)
    np.testing.assert_array_equal(flat(BARRIER.confine(FREE, z, far)), flat(far))
    np.testing.assert_array_equal(flat(BARRIER.interior(FREE, far)), flat(far))


def test_time_varying_bounds_hold_knot_by_knot():
    ends = np.linspace(1.0, 2.0, K)[:, None] * np.ones(NX)
    bounds = replace(FREE, x_lower=-ends, x_upper=ends)
    z = BARRIER.confine(bounds, inside(), Trajectory(np.full((K, NX), 9.0), np.zeros((K, NU))))
    assert_inside(bounds, z, strictly=True)
    np.testing.assert_allclose(z.x, 0.1 * inside().x + 0.9 * ends, rtol=1e-5)
    assert bounds.violation(Trajectory(ends + 0.25, np.zeros((K, NU)))) == pytest.approx(0.25)


@pytest.mark.parametrize("size", [1.0, 1e3, 1e30, -1e30])
def test_confine_keeps_every_element_strictly_inside(size):
    old = inside()
    new = BARRIER.confine(BOUNDS, old, jax.tree.map(lambda a: a + size, old))
    assert_inside(BOUNDS, new, strictly=True)


def test_confine_leaves_a_share_of_the_slack_and_short_steps_alone():
    old = inside()
    far = BARRIER.confine(BOUNDS, old, jax.tree.map(lambda a: a + 1e6, old))
    np.testing.assert_allclose(2 - far.x[:, 0], 0.1 * (2 - old.x[:, 0]), rtol=1e-5)
    near = jax.tree.map(lambda a: a + 1e-3, old)
    np.testing.assert_array_equal(flat(BARRIER.confine(BOUNDS, old, near)), flat(near))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_number_of_huge_steps_leaves_the_box_or_breaks_the_derivatives(sign):
    z = inside()
    for _ in range(60):
        z = BARRIER.confine(BOUNDS, z, jax.tree.map(lambda a: a + sign * 1e30, z))
        assert_inside(BOUNDS, z)
    bounded = jnp.isfinite(flat(BOUNDS.sides(z)[sign > 0]))
    assert np.isfinite(BARRIER.value(BOUNDS, z)).all()
    for part in BARRIER.derivatives(BOUNDS, z, 1.0):
        assert part.x.dtype == np.float32
        assert np.isfinite(flat(part)).all()
    back = BARRIER.confine(BOUNDS, z, inside())
    assert np.abs(flat(back) - flat(z))[bounded].min() > 0  # nothing is stuck at its bound


def test_derivatives_stay_finite_on_and_beyond_the_bounds():
    for shift in (0.0, 1e-9, -1e-9, -1.0, 1.0):
        z = Trajectory(jnp.full((K, NX), -1.0 + shift), jnp.full((K, NU), 0.0 + shift))
        for part in BARRIER.derivatives(BOUNDS, z, 1.0):
            assert np.isfinite(flat(part)).all()
        assert np.isfinite(BARRIER.value(BOUNDS, z)).all()


def test_interior_is_the_nearest_point_a_margin_away():
    z = Trajectory(jnp.full((K, NX), 9.0), jnp.full((K, NU), -9.0))
    moved = BARRIER.interior(
        BOUNDS, z
    )  # the margin is 1 % of a width, or 0.01 where one end is free
    np.testing.assert_allclose(moved.x, np.tile([2 - 0.03, 0.5 - 0.01, 9.0], (K, 1)), rtol=1e-6)
    np.testing.assert_allclose(moved.u, np.tile([0.01, -9.0], (K, 1)), rtol=1e-6)
    np.testing.assert_array_equal(flat(BARRIER.interior(BOUNDS, inside())), flat(inside()))


def test_violation_is_the_largest_distance_outside():
    z = inside()
    assert BOUNDS.violation(z) == 0
    assert BOUNDS.violation(replace(z, x=z.x.at[2, 0].set(-1.5))) == pytest.approx(0.5)
    assert BOUNDS.violation(replace(z, u=z.u.at[1, 0].set(1.25))) == pytest.approx(0.25)
    assert BOUNDS.violation(replace(z, x=z.x.at[2, 2].set(1e9))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("preconditioner", [None, Identity()])
def test_a_solve_never_violates_bounds_that_it_presses_against(preconditioner):
    dt, limit = 0.2, 0.7
    problem = from_function(
        lambda x, u: x + dt * jnp.array([x[1], u[0]]),
        x_init=[0.0, 0.0],
        nu=1,
        dt=dt,
        horizon=2.0,
        running_residual=lambda x, u: 0.01 * u,
        terminal_residual=lambda x: 10.0 * (x - jnp.array([2.0, 0.0])),
        x_bounds=([-1.0, -limit], [3.0, limit]),
        u_bounds=(-1.0, 1.0),
    )
    solver = Langevin(
        iterations=40,
        tail=30,
        noise=Constant(3.0),
        penalty=Geometric(100.0, 1000.0),
        barrier_weight=Geometric(0.1, 1e-3, 1e-6),
    )
    if preconditioner is not None:
        solver = replace(solver, preconditioner=preconditioner, step_size=1e-3)
    seen = []
    solution = solve(problem, chains=8, solver=solver, progress=lambda *a: seen.append(a[2]))
    assert (solution.max_violation == 0).all()
    assert all((info.max_violation == 0).all() for info in seen)
    if preconditioner is None:
        assert solution.feasible.mean() > 0.5
        assert solution.best.u.max() > 0.99
        assert solution.open_loop.controls.max() <= 1.0
