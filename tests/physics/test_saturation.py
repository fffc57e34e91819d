"""Controls beyond which actuators give their largest force anyway."""

from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest

from mjx_drax import Restarts, Rollouts, from_mjcf, solve
from mjx_drax.physics.c_engine.states import set_state

ARM = """
<mujoco model="arm"><option timestep="0.01"/><compiler angle="radian"/><worldbody>
  <body><joint name="one" axis="0 1 0" damping="0.3" {joint}/>
    <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1" contype="0" conaffinity="0"/>
    <body pos="0 0 -0.5"><joint name="two" type="slide" axis="0 0 1"/>
      <geom size="0.05" mass="0.3" contype="0" conaffinity="0"/></body></body>
</worldbody><actuator>{actuators}</actuator></mujoco>"""
SERVO = '<position joint="one" kp="60" kv="4" ctrlrange="-4 4" forcerange="-4 3" gear="{}"/>'
MOTOR = '<motor joint="two" ctrlrange="-9 9" forcerange="-5 6" gear="2"/>'
HELD = '<position joint="one" kp="60" ctrlrange="-4 4"/>'
RANGE = 'actuatorfrcrange="-4 3" actuatorfrclimited="true"'


def arm(actuators, joint=""):
    return mujoco.MjModel.from_xml_string(ARM.format(actuators=actuators, joint=joint))


def planned(model, weight=0.03, horizon=1.5):
    def end(data):
        return jax.numpy.concatenate([14 * (data.qpos[:1] - np.pi), 3 * data.qvel[:1]])

    return from_mjcf(
        model, horizon=horizon, running_residual=lambda data, u: weight * u, terminal_residual=end
    )


@pytest.mark.parametrize(
    ("actuators", "joint"),
    [
        (SERVO.format(1) + MOTOR, ""),
        (SERVO.format(-2) + MOTOR, ""),
        (HELD + MOTOR, RANGE),
        (HELD.replace("/>", ' gear="-2"/>') + MOTOR, RANGE),
        (SERVO.format(2) + MOTOR, RANGE),
    ],
)
def test_forces_end_where_controls_are_said_to_be_of_no_more_use(actuators, joint):
    model, rng = arm(actuators, joint), np.random.default_rng(0)
    dynamics, data = planned(model).dynamics, mujoco.MjData(model)
    model.actuator_ctrllimited[:] = 0

    def force(u):
        data.ctrl[:] = u
        mujoco.mj_forward(model, data)
        return data.qfrc_actuator.copy()

    x = rng.normal(size=(10, 4))
    lower, upper = map(np.asarray, dynamics.useful_controls(jax.numpy.asarray(x)))
    assert lower.shape == upper.shape == (10, 2)
    for state, low, high in zip(x, lower, upper, strict=True):
        set_state(model, data, state)
        width = high - low
        for end, out in ((low, -width), (high, width)):
            np.testing.assert_allclose(force(end + out), force(end + 1e-4 * out), atol=1e-9)
            inside = np.abs(force(end) - force(end - 0.01 * out))
            np.testing.assert_allclose(inside, 0.01 * np.abs(force(high) - force(low)), atol=1e-4)


def test_no_ends_where_forces_have_no_ranges_or_contacts_act():
    unlimited = planned(arm(HELD))
    assert unlimited.dynamics.useful_controls(unlimited.x_init[None]) is None
    assert not unlimited.saturates
    dry = planned(arm(SERVO.format(1), 'frictionloss="0.1"'))
    assert dry.dynamics.useful_controls(dry.x_init[None]) is None
    lifts = arm(HELD + MOTOR, f'{RANGE} actuatorgravcomp="true"')  # they lift beside it
    assert np.isinf(planned(lifts).dynamics.useful_controls(np.zeros((1, 4)))[0][0, 0])
    only_motor = planned(arm(MOTOR.replace("-9 9", "-1 1")))
    assert not only_motor.saturates  # its controls end before its forces do
    free = planned(arm(SERVO.format(1) + HELD.replace('"one"', '"two"')))
    lower, upper = free.dynamics.useful_controls(free.x_init[None])
    assert np.isinf(lower[0, 1])
    assert np.isinf(upper[0, 1])


def test_chains_start_with_forces_inside_of_their_ranges_and_come_back():
    problem = planned(arm(SERVO.format(1)))
    knots = jax.vmap(problem.draw)(jax.random.split(jax.random.key(0), 50))
    states = jax.numpy.concatenate([knots.x[:, :1] * 0 + problem.x_init, knots.x[:, :-1]], axis=1)
    lower, upper = problem.dynamics.useful_controls(states)
    ends = [np.clip(end, -4.0, 4.0) for end in (lower, upper)]
    assert np.all((knots.u >= ends[0] - 1e-6) & (knots.u <= ends[1] + 1e-6))
    assert np.ptp(knots.u) > 2.0
    one = jax.tree.map(lambda a: a[0], knots)
    back = problem.with_useful_controls(replace(one, u=jax.numpy.full_like(one.u, 3.9)))
    low, high = lower[0], upper[0]
    reached = (low > -4) & (high < 3.9)
    assert reached.any()
    np.testing.assert_allclose(
        np.asarray(back.u)[reached], np.asarray(high - 0.05 * (high - low))[reached], rtol=1e-5
    )
    np.testing.assert_array_equal(np.asarray(back.u)[low > 3.9], 3.9)


def test_plans_of_servos_that_may_saturate_are_rolled_out():
    assert Restarts().for_problem(planned(arm(SERVO.format(1))), 8).rollouts == Rollouts()
    assert not Restarts().for_problem(planned(arm(HELD)), 8).rollouts.asked


@pytest.mark.slow
def test_a_servo_with_a_force_range_swings_up():
    """It ended at 470 with the default settings before, a rollout of which costs 0.06."""
    rod = ARM[: ARM.index("    <body pos")] + "</body>" + ARM[ARM.index("</worldbody>") :]
    servo = SERVO.format(1).replace("-4 3", "-4 4")
    model = mujoco.MjModel.from_xml_string(rod.format(joint="", actuators=servo))
    solution = solve(planned(model), chains=8, seed=0)
    assert solution.certified
    assert solution.replay_cost[solution.best_chain] < 0.15
