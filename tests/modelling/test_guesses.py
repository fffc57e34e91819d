"""Guesses from poses and paths: positions, velocities, controls, and batches of them."""

import jax
import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError, from_function, from_mjcf, guesses
from mjx_drax.physics.actuators import inverse_dynamics
from mjx_drax.search.initial import initial_knots

ARM = """
<mujoco model="arm">
  <option timestep="0.01"><flag contact="disable"/></option>
  <worldbody>
    <body><joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.25" limited="true"/>
      <geom size="0.1"/>
      <body pos="0.3 0 0"><joint name="wrist" axis="0 1 0"/><geom size="0.1" pos="1 0 0"/></body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <keyframe>
    <key name="low" qpos="-0.4 0"/><key name="high" qpos="0.2 3"/><key name="back" qpos="0 -1"/>
  </keyframe>
</mujoco>"""
MOTORS = (
    '<motor joint="lift" gear="2" ctrlrange="-200 200" ctrllimited="true"/>'
    '<position joint="wrist" kp="50" kv="3" forcerange="-1 1" forcelimited="true"/>'
)
K = 20


def arm(actuators=MOTORS, **rest):
    xml = ARM.format(actuators=actuators)
    settings = {"horizon": 0.2, "dt": 0.01, "running_residual": lambda data, u: u, **rest}
    return from_mjcf(xml, **settings)


PROBLEM = arm()
LOW, HIGH, BACK = np.array([[-0.4, 0], [0.2, 3], [0, -1.0]])


def turning(x_scatter=(-2, 2)):
    """A model with a free and a ball joint."""
    xml = """
    <mujoco model="turning"><worldbody>
      <body><joint type="slide" range="-1 1" limited="true"/><geom size="0.1"/></body>
      <body><freejoint/><geom size="0.1 0.2 0.3" type="box"/>
        <body pos="1 0 0"><joint name="ball" type="ball"/><geom size="0.1" pos="0.1 0 0"/></body>
      </body></worldbody>
      <actuator><motor joint="ball" gear="1 0 0"/></actuator></mujoco>"""
    return from_mjcf(
        xml,
        horizon=1.0,
        dt=0.1,
        running_residual=lambda data, u: u,
        x_bounds=([-1] + [-np.inf] * 21, [1] + [np.inf] * 21),
        u_bounds=(-1, 1),
        x_scatter=x_scatter,
        contacts=False,
    )


def positions(trajectory):
    return np.asarray(trajectory.x)[..., :2]


def close(a, b, tolerance=1e-5):
    np.testing.assert_allclose(np.asarray(a), b, atol=tolerance)


def test_waypoints_are_reached_on_straight_lines_and_held():
    guess = guesses.waypoints(PROBLEM, [(0.15, HIGH), (0.1, "back")])
    q, v = positions(guess), np.asarray(guess.x)[:, 2:]
    close(q[4], (LOW + BACK) / 2)  # x_5, half way from x_init at 0
    close(q[9], BACK)
    close(q[11], BACK + 0.4 * (HIGH - BACK))
    close(q[14:], np.broadcast_to(HIGH, (6, 2)))
    close(v, np.diff(np.concatenate([LOW[None], q]), axis=0) / 0.01, 1e-3)


def test_keyframes_are_spread_over_the_horizon_or_at_their_times():
    close(positions(guesses.keyframes(PROBLEM))[[9, 19]], [HIGH, BACK])
    close(positions(guesses.keyframes(PROBLEM, ["back"]))[[9, 19]], [(LOW + BACK) / 2, BACK])
    close(positions(guesses.keyframes(PROBLEM, {0.05: "high"}))[[4, 19]], [HIGH, HIGH])


def test_a_path_is_stretched_or_kept_in_time():
    wave = np.stack([0.2 * np.sin(np.linspace(0, 3, 61)), np.linspace(0, 3, 61)], axis=1)
    close(positions(guesses.path(PROBLEM, wave)), wave[3::3])
    slow = positions(guesses.path(PROBLEM, wave[:31], dt=0.005))
    close(slow[:15], wave[2:31:2])
    close(slow[15:], np.broadcast_to(wave[30], (5, 2)))


def test_still_holds_the_pose_against_gravity():
    problem = arm(x_init=[0.1, 0.3, 2, 2], u_bounds=([-50, -9], [200, 9]))
    guess, model = guesses.still(problem), problem.dynamics.mj_model
    close(guess.x, np.broadcast_to([0.1, 0.3, 0, 0], (K, 4)))
    data = mujoco.MjData(model)
    model.actuator_forcelimited[:] = 0
    data.qpos[:], data.ctrl[:] = [0.1, 0.3], guess.u[5]
    mujoco.mj_forward(model, data)
    close(data.qacc, [0, 0], 1e-3)


def test_controls_are_those_that_drive_the_engine_along_the_path():
    model = PROBLEM.dynamics.mj_model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    applied = rng.normal(size=(K, 2)) * [20, 0.01] + [42, 0]
    states = np.zeros((K + 1, 4))
    model.actuator_forcelimited[:] = 0
    for k, u in enumerate(applied):
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        states[k + 1] = np.concatenate([data.qpos, data.qvel])
    model.actuator_forcelimited[1] = 1
    found = inverse_dynamics(model, states, 0.01, np.zeros(2))
    close(found, applied, 1e-6)
    assert model.actuator_forcelimited[1]  # a copy was unlimited
    # The same through a problem, whose velocities are the differences of the path's positions.
    problem = arm(x_init=states[0])
    guess = guesses.path(problem, states[:, :2], dt=0.01)
    close(guess.x, states[1:], 1e-3)
    close(guess.u[1:], applied[1:], 0.05)


@pytest.mark.parametrize("by_actuators", ["true", "false"])
def test_an_arm_whose_weight_is_compensated_is_held_by_nothing(by_actuators):
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body gravcomp="1">
        <joint name="j" axis="0 1 0" actuatorgravcomp="{by_actuators}"/>
        <geom size="0.1" pos="0.5 0 0" mass="2"/></body></worldbody>
        <actuator><motor joint="j"/></actuator></mujoco>"""
    )
    close(inverse_dynamics(model, np.zeros((2, 2)), 0.01, np.zeros(1)), 0.0, 1e-9)


def test_controls_without_an_answer_are_the_middle_of_their_bounds():
    stateful = (
        '<general joint="lift" dyntype="filter" dynprm="0.1" ctrlrange="-1 3" ctrllimited="true"/>'
        '<motor joint="wrist" ctrlrange="-0.1 0.1" ctrllimited="true"/>'
    )
    guess = guesses.keyframes(arm(stateful))
    close(guess.u[:, 0], 1)
    close(np.abs(guess.u[1:, 1]).max(), 0.1)  # clipped
    assert np.isfinite(guess.x).all()
    nowhere = np.full((3, 4), np.nan)
    close(
        inverse_dynamics(PROBLEM.dynamics.mj_model, nowhere, 0.01, np.array([1, 2.0])), [[1, 2]] * 2
    )


def test_quaternions_turn_about_one_axis_and_stay_unit():
    problem, end = turning(), np.zeros(12)
    axis, quaternion = np.array([0, 0.6, 0.8]), np.zeros(4)
    end[1:4] = [1, 2, 3]
    end[4], end[8] = 5, 1  # of any length
    mujoco.mju_axisAngle2Quat(quaternion, axis, 2.0)
    end[8:12] = -quaternion  # of any sign
    guess = guesses.waypoints(problem, [(1.0, end)])
    q, v = np.split(np.asarray(guess.x), [12], axis=1)
    close(q[4, 1:4], [0.5, 1, 1.5])
    mujoco.mju_axisAngle2Quat(quaternion, axis, 1.0)
    close(np.abs(q[4, 8:12] @ quaternion), 1)
    close(v[:, 7:10], np.broadcast_to(2 * axis, (10, 3)))
    batch = guesses.spread(problem, guess, 5, scale=0.3)
    q = np.asarray(batch.x)[..., :12]
    close(np.linalg.norm(q[..., 8:12], axis=-1), 1)
    close(np.linalg.norm(q[..., 4:8], axis=-1), 1)
    assert np.abs(q[1:, -1, 8:12] @ end[8:12]).max() < 0.999


def test_a_spread_is_as_wide_as_the_scatter_and_turns_by_angles():
    """Velocities add up to how far each coordinate has gone; no entry of x_scatter is an angle."""
    widths = 1.0 + np.arange(22)
    problem = turning((-widths, widths))
    batch = guesses.spread(problem, guesses.still(problem), 300, scale=0.3)
    gone = 0.1 * np.asarray(batch.x)[..., 12:].sum(axis=1)
    expected = 0.3 * np.array([1.0, 2.0, 3.0, 4.0, *6 * [np.pi]])
    np.testing.assert_allclose(gone.std(axis=0), expected, rtol=0.1)


def test_a_spread_is_smooth_begins_together_and_keeps_the_bounds():
    centre = guesses.keyframes(PROBLEM, ["high"])
    batch = guesses.spread(PROBLEM, centre, 64, seed=1)
    x, u = np.asarray(batch.x), np.asarray(batch.u)
    assert x.shape == (64, K, 4)
    assert u.shape == (64, K, 2)
    close(x[0], centre.x)
    close(u[:, 0], np.broadcast_to(centre.u[0], (64, 2)))
    wrist = x[1:, :, 1] - np.asarray(centre.x)[:, 1]
    assert 0.5 < wrist[:, -1].std() / (0.1 * np.pi) < 1.5
    assert wrist[:, 0].std() / (0.1 * np.pi) < 0.4
    speed = x[1:, :, 3] - np.asarray(centre.x)[:, 3]
    close(np.diff(wrist, axis=1, prepend=0) / 0.01, speed, 1e-3)
    assert x[..., 0].min() >= -0.5
    assert x[..., 0].max() <= 0.25
    again = guesses.spread(PROBLEM, centre, 64, seed=1)
    close(again.x, x, 0)
    knots = initial_knots(PROBLEM, 64, batch, jax.random.key(0))
    close(knots.x, x, 0)


def test_without_a_model_there_is_a_still_guess_and_its_spread():
    problem = from_function(
        lambda x, u: x + 0.1 * u,
        x_init=[1.0, 2.0],
        nu=2,
        dt=0.1,
        horizon=1.0,
        running_residual=lambda x, u: u,
        u_bounds=([1, -np.inf], [3, np.inf]),
        name="plane",
    )
    guess = guesses.still(problem)
    close(guess.x, np.broadcast_to([1, 2], (10, 2)))
    close(guess.u, np.broadcast_to([2, 0], (10, 2)))
    assert guesses.spread(problem, guess, 3).x.shape == (3, 10, 2)
    for make in (guesses.keyframes, lambda p: guesses.path(p, [[0]])):
        with pytest.raises(DraxError, match="plane has no MuJoCo model"):
            make(problem)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: guesses.waypoints(PROBLEM, [(0.1, "top")]), "no keyframe 'top': there is 'low'"),
        (lambda: guesses.waypoints(PROBLEM, [(0.1, [1, 2, 3])]), "of shape .3,.: give 2 finite"),
        (lambda: guesses.waypoints(PROBLEM, [(-1, HIGH)]), "time of a waypoint is -1"),
        (lambda: guesses.waypoints(PROBLEM, [(0, HIGH), (0, LOW)]), "two waypoints are at 0 s"),
        (lambda: guesses.keyframes(PROBLEM, []), "arm has no keyframe to go through"),
        (lambda: guesses.path(PROBLEM, [[0, np.nan]]), "give 2 finite numbers"),
        (lambda: guesses.path(PROBLEM, [[0, 1]], dt=0), "dt of the path is 0"),
        (lambda: guesses.path(PROBLEM, []), "the path is empty"),
        (lambda: guesses.path(PROBLEM, "walk.npy"), "the path is 'walk.npy'"),
        (lambda: guesses.spread(PROBLEM, guesses.still(PROBLEM), 0), "chains is 0"),
        (lambda: guesses.spread(PROBLEM, guesses.still(arm(horizon=0.1)), 2), r"\(10, 4\)"),
    ],
)
def test_mistakes_are_named(make, says):
    with pytest.raises(DraxError, match=says):
        make()


def test_times_of_guesses_are_counted_from_x_0():
    later = PROBLEM.at_time(5.0)
    for guess in (
        lambda problem: guesses.waypoints(problem, [(0.15, HIGH), (0.1, "back")]),
        guesses.keyframes,
        lambda problem: guesses.path(problem, np.linspace(LOW, HIGH, 7)),
    ):
        close(positions(guess(later)), positions(guess(PROBLEM)))


def test_models_with_further_states_have_guesses_of_their_own():
    problem = arm(running_residual=lambda data, u, knot: knot.rate, rates=1)
    guess = guesses.waypoints(problem, [(0.1, "back")])
    assert guess.x.shape[-1] == problem.dynamics.given_nx < problem.dynamics.nx
    assert initial_knots(problem, 2, guess, None).x.shape[-1] == problem.dynamics.nx


@pytest.mark.parametrize(
    ("horizon", "knots"), [((0.1, 0.5), K), ([(0.05, 0.15), (0.3, 0.5)], [K // 2, K // 2])]
)
def test_velocities_of_a_guess_fit_its_steps_where_durations_are_free(horizon, knots):
    problem = arm(horizon=horizon, knots=knots, dt=None)
    guess = guesses.path(problem, np.linspace(LOW, HIGH, 50))
    q = np.concatenate([problem.x_init[None, :2], positions(guess)])
    moves = np.diff(q[1:], axis=0) / np.diff(problem.times[1:])[:, None]
    close(guess.x[1:, 2:4], moves)
    apart = guesses.spread(problem, guess, 3)
    turns = np.asarray(apart.x[..., :2] - guess.x[:, :2])
    speeds = np.diff(turns, axis=1) / np.diff(problem.times[1:])[:, None]
    np.testing.assert_allclose(apart.x[:, 1:, 2:4] - guess.x[1:, 2:4], speeds, atol=2e-3)
