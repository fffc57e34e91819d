"""Descent directions where states hold quaternions: a ball joint, K = 5, every metric.

The ball turns by a formula, because MJX would take minutes to compile for all metrics.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import LBFGS, Diagonal, DraxError, GaussNewton, Identity, Langevin, from_mjcf, solve
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.method.descent import augmented_lagrangian
from mjx_drax.method.model import expand
from mjx_drax.method.schedules import Weights
from mjx_drax.modelling.terms import Terms
from mjx_drax.physics.joints import Joints
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search import iterate

K = 5


class Seen(NamedTuple):
    qpos: jax.Array
    qvel: jax.Array


@register_dataclass
@dataclass(frozen=True)
class Spinning(Dynamics):
    """A ball of inertia 0.1 kg m^2 under torques and damping; x = [q (4), w (3)]."""

    nx, ndx, nu = 7, 6, 3
    joints: ClassVar[Joints] = Joints(4, 3, ((0, 0),))
    dt: float = field(default=0.02, metadata={"static": True})

    def step(self, x, u):
        change = self.dt * (u - 0.1 * x[4:]) / 0.1
        return self.joints.integrate(x, jnp.concatenate([self.dt * (x[4:] + change), change]))

    def observe(self, x, u):
        return Seen(x[:4], x[4:])

    def difference(self, x, y):
        return self.joints.difference(x, y)

    def integrate(self, x, dx):
        return self.joints.integrate(x, dx)

    def valid(self, x):
        return self.joints.normalized(x)

    def tangent(self, numbers):
        return self.joints.tangent(numbers)


XML = """
<mujoco model="top">
  <option timestep="0.02"><flag contact="disable"/></option>
  <worldbody><body>
    <joint name="pivot" type="ball" damping="0.1"/>
    <geom type="box" size="0.1 0.2 0.3" mass="1" pos="0 0.05 0.1"/>
  </body></worldbody>
  <actuator>
    <motor joint="pivot" gear="1 0 0"/><motor joint="pivot" gear="0 1 0"/>
    <motor joint="pivot" gear="0 0 1"/>
  </actuator>
</mujoco>"""
TURNED = [0.8, 0.0, 0.6, 0.0]
WEIGHTS = Weights(*map(jnp.asarray, (0.0, 10.0, 0.1, 0.01)))
METRICS = [Identity(), Diagonal(), GaussNewton(), LBFGS()]


def problem():
    on = Terms(XML)
    model = from_mjcf(
        XML,
        horizon=K * 0.02,
        running_residual=on.control(weight=0.1),
        terminal_residual=on.posture({"pivot": TURNED}, weight=10.0) + on.velocity(),
        u_bounds=(-3, 3),
    )
    return replace(model, dynamics=Spinning())


@pytest.fixture(scope="module")
def task():
    return problem()


@pytest.fixture(scope="module")
def chain(task):
    """Knots, multipliers that are not zero, and the merit of knots displaced by tangent numbers."""
    solver = Langevin()
    state = solver.init(task, task.draw(jax.random.key(0)), jax.random.key(1))
    knots, multipliers = state.trajectory, state.multipliers
    rng = np.random.default_rng(0)
    rates = jnp.asarray(rng.normal(size=multipliers.dynamics.shape), jnp.float32)
    multipliers = replace(multipliers, dynamics=rates, bounds=None)

    @jax.jit
    def merit(change):
        moved = task.displaced(knots, change)
        at = moved, multipliers, WEIGHTS, task.values(moved)
        return jnp.sum(augmented_lagrangian(task, solver.bounds, *at))

    return knots, multipliers, merit


def direction(metric, task, chain):
    knots, multipliers, _ = chain

    @jax.jit
    def found(task, knots, multipliers):
        at, key = (knots, multipliers, WEIGHTS), jax.random.key(0)
        model = expand(task, Langevin().bounds, *at, metric.derivatives, jax.random.split(key)[0])
        return metric.direction(task, model, key, metric.memory(task, knots))

    return found(task, knots, multipliers)


def along(merit, change, size=1e-2):
    """The derivative of the merit along a change of unit length, by central differences."""
    length = np.sqrt(sum(float(jnp.sum(a**2)) for a in jax.tree.leaves(change)))
    ends = [merit(jax.tree.map(lambda a, s=s: s * size / length * a, change)) for s in (1, -1)]
    return float(ends[0] - ends[1]) / (2 * size), length


@pytest.mark.parametrize("metric", METRICS, ids=lambda m: type(m).__name__)
def test_drifts_go_downhill_in_tangent_space(metric, task, chain):
    found = direction(metric, task, chain)
    assert found.drift.x.shape == found.noise.x.shape == (K, 6)
    assert found.multipliers.dynamics.shape == (K, 6)
    assert found.gains.shape == (K, 3, 6)
    slope, _ = along(chain[2], found.drift)
    assert slope < 0


def test_the_identitys_drift_is_the_steepest_descent(task, chain):
    drift = direction(Identity(), task, chain).drift
    slope, length = along(chain[2], drift)
    assert slope == pytest.approx(-length, rel=1e-2)
    rng = np.random.default_rng(1)
    for _ in range(5):
        other = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape), a.dtype), drift)
        slope, size = along(chain[2], other)
        product = sum(
            jax.tree.leaves(jax.tree.map(lambda a, b: float(jnp.sum(a * b)), drift, other))
        )
        assert slope == pytest.approx(-product / size, abs=1e-2 * length)


@pytest.mark.slow
def test_the_tail_needs_few_steps_and_keeps_quaternions_unit(task):
    solver = Langevin(iterations=0, tail=15)
    start = jax.vmap(task.draw)(jax.random.split(jax.random.key(0), 4))
    state = iterate.start(solver, task, start, jax.random.key(0))
    state, _ = iterate.advance(solver, task, state, 0, 15)
    lengths = np.linalg.norm(state.trajectory.x[..., :4], axis=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
    assert float(jax.vmap(task.max_defect)(state.trajectory).max()) < 1e-3


def test_metropolis_adjustment_is_refused(task):
    with pytest.raises(DraxError, match="adjusted=True, but states of top hold quaternions"):
        solve(task, chains=1, solver=Langevin(adjusted=True, preconditioner=Identity()))


def test_given_knots_are_scaled_to_unit_quaternions(task):
    x = np.ones((K, 7))
    guess = Trajectory(x, np.zeros((K, 3)))
    seen = replace(task, guess=lambda key: guess).draw(None)
    np.testing.assert_allclose(seen.x[:, :4], 0.5)


def test_a_share_of_the_way_between_two_plans_turns_by_that_share():
    ball = problem()
    keys = jax.random.split(jax.random.key(0))
    here, there = (jax.vmap(ball.draw)(jax.random.split(key, 2)) for key in keys)
    shared, own = iterate.partition(iterate.Question(Langevin(), ball), None)
    part = iterate.between(own, shared, here, there, 0.25)
    off = jax.vmap(jax.vmap(Spinning().difference))
    np.testing.assert_allclose(off(part.x, here.x), 0.25 * off(there.x, here.x), atol=1e-5)
    np.testing.assert_allclose(part.u, here.u + 0.25 * (there.u - here.u), atol=1e-6)
    np.testing.assert_allclose(jnp.linalg.norm(part.x[..., :4], axis=-1), 1.0, atol=1e-5)
