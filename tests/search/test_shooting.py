"""Random shooting: changes of controls that are drawn, rolled out and kept where they help."""

from dataclasses import dataclass, replace
from functools import partial

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax import Restarts, Trajectory, from_dynamics, from_mjcf, solve, solve_batch
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.modelling.terms import Terms
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.search.restarts import Rollouts
from mjx_drax.search.shooting import PATIENCE, SMALLEST, Shots, changes, shoot

K, NU = 12, 2


def test_changes_are_of_all_sizes_and_smooth_in_time_or_in_a_window_of_it():
    drawn = changes((0, 1), 2000, 40, 3)
    assert drawn.shape == (2000, 40, 3)
    np.testing.assert_array_equal(drawn, changes((0, 1), 2000, 40, 3))
    assert (drawn != changes((0, 2), 2000, 40, 3)).any(axis=(1, 2)).mean() > 0.9
    size = np.abs(drawn).max(axis=(1, 2))
    for low, high in ((SMALLEST, 0.1), (0.1, 0.5), (0.5, 1.0)):
        assert 0.05 < ((low < size) & (size < high)).mean() < 0.6
    moved = np.abs(drawn).max(axis=2) > 0.0
    assert 0.3 < moved.all(axis=1).mean() < 0.7
    chosen = np.abs(drawn).max(axis=1) > 0.0
    assert 0.4 < chosen.all(axis=1).mean() < 0.8
    whole = drawn[moved.all(axis=1)]
    bends = (np.abs(np.diff(whole, 2, axis=1)).max(axis=2) > 1e-9).sum(axis=1)
    assert bends.min() == 0  # a line
    assert bends.max() > 25


def toy(wanted):
    """Rolls out nothing; the cost is the distance of controls to what each row wants."""

    def fire(rows, controls):
        u = controls.reshape(-1, K, NU)
        of = np.repeat(wanted[rows], controls.shape[1])
        cost = np.abs(u - of[:, None, None]).mean(axis=(1, 2))
        return Shots(u.cumsum(axis=1), u, cost, np.zeros(len(u)), np.zeros(len(u), bool))

    return fire


def shot(wanted, rows, fire=None, generations=60, told=lambda shots: None):
    count = len(wanted)
    ends = np.full((count, K, NU), -1.0), np.full((count, K, NU), 1.0)
    start = np.full((count, K, NU), 0.9)
    keys = [(0, row) for row in rows]
    given = fire or toy(wanted), start, ends, np.zeros(count), keys
    return shoot(*given, (16, generations), told)


def test_a_row_comes_to_what_it_wants_whatever_is_beside_it():
    wanted = np.array([-0.5, 0.2, 0.95])
    (found, ended), (alone, _) = shot(wanted, range(3)), shot(wanted[1:2], [1])
    assert ended
    assert (found.cost < 0.12).all()
    np.testing.assert_array_equal(found.controls[1], alone.controls[0])
    np.testing.assert_array_equal(found.states, found.controls.cumsum(axis=1))


def test_it_starts_in_the_middle_of_the_box_if_that_is_better():
    found, _ = shot(np.array([0.0, 0.9]), range(2), generations=0)
    np.testing.assert_array_equal(found.controls[:, 0, 0], [0.0, 0.9])


def test_a_row_that_gains_nothing_is_left_alone():
    counts = []

    def flat(rows, controls):
        counts.append(len(rows))
        shots = toy(np.array([0.0, 0.5]))(rows, controls)
        of = np.repeat(rows, controls.shape[1])
        return replace(shots, cost=np.where(of == 0, 1.0, shots.cost))

    shot(np.array([0.0, 0.5]), range(2), flat)
    assert counts[2 : 2 + PATIENCE] == [2] * PATIENCE
    assert counts[2 + PATIENCE] == 1


def test_what_is_sound_comes_before_what_is_cheap():
    def shots(cost, broken, missed):
        names = np.array(cost)[:, None, None]
        return Shots(names, names, np.array(cost), np.array(broken), np.array(missed))

    kept = shots([1.0, 1.0, 1.0, 1.0], [0.0, 0.5, 0.0, 0.0], [False, False, True, False])
    tried = shots([0.5, 2.0, 3.0, 2.0], [0.1, 0.0, 0.0, 0.0], [False, True, False, False])
    best = kept.better(tried, np.arange(4))
    np.testing.assert_array_equal(best.cost, [1.0, 2.0, 3.0, 1.0])
    gained = best.gained(kept, np.zeros(4))
    np.testing.assert_array_equal(gained, [False, True, True, False])
    slightly, clearly = (shots([c] * 4, kept.broken, kept.missed) for c in (0.995, 0.98))
    np.testing.assert_array_equal(slightly.gained(kept, np.zeros(4)), [False] * 4)
    np.testing.assert_array_equal(clearly.gained(kept, np.zeros(4))[[0, 2, 3]], [True] * 3)
    np.testing.assert_array_equal(slightly.gained(kept, np.full(4, 0.9))[[0, 2, 3]], [True] * 3)


def test_an_interrupt_keeps_what_was_found():
    seen = []

    def told(shots):
        seen.append(shots.cost)
        if len(seen) == 3:
            raise KeyboardInterrupt

    found, ended = shot(np.array([-0.5]), [0], told=told)
    assert not ended
    np.testing.assert_array_equal(found.cost, seen[-1])


@register_dataclass
@dataclass(frozen=True)
class Pusher(FunctionDynamics):
    """A hand at x[0] that follows u pushes a ball at x[1], which rolls at x[2] until it stops."""

    kinked = True


def pushed(x, u):
    force = 200.0 * jnp.maximum(x[0] - x[1], 0.0)
    speed = x[2] + 0.05 * (force - 1.0 * x[2])
    return jnp.array([x[0] + 0.05 * u[0], x[1] + 0.05 * speed, speed])


@register_dataclass
@dataclass(frozen=True)
class Rougher(Pusher):
    """As the replaying engine has it, the ball is a little rougher than f says."""

    def replay(self, *given):
        return Pusher(Partial(rougher), self.dt, self.nx, self.nu).replay(*given)


def rougher(x, u):
    return pushed(x, u) - jnp.array([0.0, 0.0, 0.002]) * x[2]


def pusher(kind=Pusher):
    """The ball is to lie 1 m further; the hand starts half a metre behind it, at rest."""
    return from_dynamics(
        kind(Partial(pushed), 0.05, 3, 1),
        x_init=[-0.5, 0.0, 0.0],
        horizon=1.5,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=lambda x: 10.0 * jnp.array([x[1] - 1.0, x[2]]),
        u_bounds=(-2.0, 2.0),
        goal=lambda x: abs(x[1] - 1.0) < 0.2,
    )


SHORT = {"descent": 5, "attempts": 1}
STILL = Trajectory(np.tile([-0.5, 0.0, 0.0], (30, 1)), np.zeros((30, 1)))


def test_chains_that_touch_nothing_find_the_contact():
    problem, given = pusher(), {"chains": 4, "guess": STILL, "progress": False}
    still = solve(problem, solver=Restarts(**SHORT, rollouts=Rollouts(samples=0)), **given)
    assert not still.success.any()
    np.testing.assert_allclose(still.replay_cost, 50.0, rtol=1e-3)
    found = solve(problem, solver=Restarts(**SHORT), **given)
    assert found.success.all()
    assert found.certified
    assert found.replay_cost.min() < 9.0

    done, calls = {}, []

    def interrupted(iterations, total, info):
        calls.append(np.asarray(info.cost))
        done[iterations] = done.get(iterations, 0) + 1
        if done[iterations] == 12:  # generations do not count as iterations
            raise KeyboardInterrupt

    early = solve(problem, solver=Restarts(**SHORT), **{**given, "progress": interrupted})
    assert (early.replay_cost < 40.0).all()
    np.testing.assert_allclose(early.replay_cost, calls[-1], rtol=1e-4)
    assert found.replay_cost.mean() < early.replay_cost.mean()


def test_without_a_goal_chains_that_touch_nothing_are_not_enough():
    """They are certified, and cost 50. What a shot does in the engine counts, whatever f says."""
    problem = replace(pusher(Rougher), goal=None)
    given = {"chains": 4, "guess": STILL, "progress": False}
    still = solve(problem, solver=Restarts(**SHORT, rollouts=Rollouts(samples=0)), **given)
    assert still.certified
    np.testing.assert_allclose(still.replay_cost, 50.0, rtol=1e-3)
    found = solve(problem, solver=Restarts(**SHORT), **given)
    assert found.success.all()
    assert found.certified
    assert found.replay_cost.max() < 9.0


@pytest.mark.slow
def test_problems_of_a_batch_shoot_as_if_alone():
    starts = np.array([[-0.5, 0.0, 0.0], [-0.3, 0.1, 0.0]], np.float32)
    one, problem = Restarts(**SHORT), pusher()
    make = partial(with_start, problem)
    both = solve_batch(make, starts, chains=4, solver=one)
    split = solve_batch(make, starts, chains=4, solver=one, chunk=1)
    assert both.certified.all()
    assert (both.chain_cost < 20.0).all()
    np.testing.assert_array_equal(both.u, split.u)
    np.testing.assert_array_equal(both.chain_cost, split.chain_cost)


def with_start(problem, x):
    return replace(problem, x_init=x)


FLICK = """<mujoco><option timestep="0.005"/><worldbody>
<body pos="0 0 0.5"><joint name="shoulder" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
  <body pos="0.2 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0.18 0 0" size="0.02" mass="0.2"/></body></body>
<body pos="0.45 0 0.35"><joint name="spin" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="-0.12 0 0 0.12 0 0" size="0.03" mass="0.3"/></body>
</worldbody><actuator><motor joint="shoulder" gear="2" ctrlrange="-1 1"/>
<motor joint="elbow" gear="1" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.slow
def test_an_arm_flicks_a_wheel_from_below():
    """It has to go around the wheel; descents end where nothing touches, at a cost of 72."""
    on = Terms(mujoco.MjModel.from_xml_string(FLICK))
    problem = from_mjcf(
        on.model,
        horizon=1.0,
        dt=0.02,
        running_residual=on.control(weight=1e-2) + on.velocity(weight=1e-4),
        terminal_residual=on.posture({"spin": 1.2}, weight=100.0) + on.velocity(weight=0.1),
        goal=lambda data: abs(data.qpos[2] - 1.2) < 0.2,
    )
    still = solve(problem, 4, solver=Restarts(attempts=1, rollouts=Rollouts(samples=0)))
    assert not still.success.any()
    for asked in (problem, replace(problem, goal=None)):
        found = solve(asked, 4, solver=Restarts(attempts=1))
        assert found.success.all()
        assert found.certified
        assert found.replay_cost.max() < 1.0
