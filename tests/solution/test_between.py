"""Inequalities between knots: what a replay of a model breaks there is told, and nothing else."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import made_up, point

from mjx_drax import Tolerances, from_mjcf
from mjx_drax.solution.between import broken_between_knots

SLED = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.05" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="x" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def gliding(**given):
    """A solution that glides by 0.1 m from each of its ten knots to the next."""
    rest = {"horizon": 1.0, "dt": 0.1, "x_init": [0.0, 1.0], "terminal_residual": lambda d: d.qpos}
    solution = made_up(from_mjcf(SLED, **{**rest, **given}), 3)
    K, dt = solution.problem.horizon, float(solution.problem.dynamics.dt)
    states = np.stack([dt * np.arange(K + 1), np.ones(K + 1)], axis=1)[None].repeat(3, axis=0)
    ran = replace(solution.open_loop, states=states)
    knots = replace(solution.trajectories, x=states[:, 1:].astype(np.float32))
    return replace(solution, trajectories=knots, open_loop=ran, feedback=ran)


def wall(at):
    """How deep the sled is inside of a wall that is 6 cm thick, and does not touch."""
    return lambda data, u: jnp.stack([data.qpos[0] - 9.0, 0.03 - jnp.abs(data.qpos[0] - at)])


def test_a_wall_that_is_jumped_between_two_knots_is_told():
    solution = gliding(inequality=wall(0.55))
    broken = broken_between_knots(solution, 0)
    assert (broken.entry, broken.knot) == (1, 5)
    assert broken.size == pytest.approx(0.03, abs=1e-6)
    assert "between knots 5 and 6, after 0.5 s, inequality [1] is broken by 3.0e-02" in str(
        solution
    )


def test_a_wall_that_is_jumped_after_the_last_stage_is_told():
    broken = broken_between_knots(gliding(inequality=wall(0.95)), 0)
    assert (broken.entry, broken.knot) == (1, 9)
    assert broken.size == pytest.approx(0.03, abs=1e-6)


def test_of_several_the_one_that_is_broken_most_by_its_tolerance_is_told():
    def two(data, u):
        wall_in_mm = 30.0 - 1e3 * jnp.abs(data.qpos[0] - 0.55)
        return jnp.stack([0.01 * wall_in_mm, 0.03 - jnp.abs(data.qpos[0] - 0.75)])

    given = gliding(inequality=two)
    found = replace(given, tolerances=Tolerances(inequality=[1.0, 1e-4]))
    # by 0.3 where 1.0 is allowed is nothing; by 0.03 where 1e-4 is
    assert broken_between_knots(found, 0).entry == 1
    found = replace(given, tolerances=Tolerances(inequality=[1e-1, 1e-4]))
    assert broken_between_knots(found, 0).entry == 1  # 3 times, and 300 times what is allowed


def once(data, u, knot):
    """The sled is not past 0.52 m at knot 5."""
    return jnp.where(knot.index == 5, data.qpos - 0.52, -1.0)


def at_last(data, u, knot):
    """The sled is not past 0.92 m at the last stage."""
    return jnp.where(knot.index == 9, data.qpos - 0.92, -1.0)


@pytest.mark.parametrize(
    "given",
    [
        {"inequality": wall(2.0)},
        {"inequality": once},
        {"inequality": at_last},
        {"inequality": wall(0.55), "dt": 0.01},
        {"inequality": wall(0.55), "rates": 1},
        {},
    ],
    ids=["elsewhere", "once", "at-last", "every-step", "rates", "none"],
)
def test_nothing_else_is_told(given):
    assert broken_between_knots(gliding(**given), 0) is None


def test_of_functions_nothing_is_known_between_knots():
    solution = made_up(point(inequality=lambda x, u: 1.0 + 0.0 * x[0]))
    assert broken_between_knots(solution, 0) is None
