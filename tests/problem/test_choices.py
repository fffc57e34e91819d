"""Free x_0, parameters, free durations and rates of controls, against closed forms."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import DT, GOAL, K, arm, double_integrator, fastest, matrices, robot

from mjx_drax import (
    Constant,
    DraxError,
    Dynamics,
    Identity,
    Langevin,
    Solution,
    Trajectory,
    at_time,
    between,
    export_keyframes,
    from_function,
    from_mjcf,
    render,
    save_csv,
    solve,
    solve_batch,
)
from mjx_drax.base.errors import DraxWarning
from mjx_drax.physics.c_engine import stepper
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.solution.names import state_names
from mjx_drax.solution.violations import entry_name


@pytest.mark.slow
def test_the_least_time_of_a_double_integrator(tmp_path):
    problem = fastest()
    found = solve(problem, chains=4)
    assert found.optimal
    assert found.certified
    assert found.cost.min() == pytest.approx(2.0, abs=1e-4)  # 2 sqrt(d / a)
    assert found.times[-1] == pytest.approx(2.0, abs=1e-4)
    np.testing.assert_allclose(found.best.u[:, 0], np.sign(9.5 - np.arange(20)), atol=1e-2)
    assert state_names(problem.dynamics) == ["x0", "x1", "step"]
    found.save(tmp_path)
    loaded = Solution.load(tmp_path, problem)
    np.testing.assert_array_equal(loaded.times, found.times)
    np.testing.assert_array_equal(loaded.best.start, found.best.start)
    again = found.certify()
    np.testing.assert_array_equal(again.open_loop.states, found.open_loop.states)


@pytest.mark.slow
def test_least_times_of_many_distances():
    problem = fastest(
        data={"d": np.ones(21)},
        terminal_equality=lambda x, knot: x - jnp.stack([knot.data["d"], 0.0]),
    )
    distances = jnp.array([0.5, 1.0, 2.0])
    found = solve_batch(
        lambda d: replace(problem, data={"d": jnp.full(21, d)}), distances, chains=2
    )
    np.testing.assert_allclose(found.cost, 2 * np.sqrt(distances), atol=1e-3)


@pytest.mark.slow
def test_two_phases_each_take_their_least_time():
    def there(x, u, knot):
        return jnp.where(knot.index == 12, x - GOAL, 0.0)

    problem = fastest(
        horizon=[(0.5, 5.0), (0.5, 5.0)],
        knots=[12, 16],
        equality=there,
        terminal_equality=lambda x: x,
    )
    found = solve(problem, chains=4)
    assert found.optimal
    assert found.certified
    np.testing.assert_allclose(found.times[[12, -1]], [2.0, 4.0], atol=1e-3)


@pytest.mark.slow
def test_a_free_start_is_chosen_within_its_bounds():
    problem = double_integrator(
        running_residual=lambda x, u: u,
        terminal_equality=lambda x: x - GOAL,
        x_init_bounds=([-0.5, -2.0], [0.2, 2.0]),
    )
    found = solve(problem, chains=4)
    G, _ = matrices()
    A = np.array([[1, DT], [0, 1.0]])
    free = np.linalg.matrix_power(A, K)  # x_K = A^K x_0 + G u; x_0 = [0.2, v]
    rows = np.concatenate([np.concatenate([G[-1], free[:, 1:]], axis=1)])
    right = GOAL - free[:, 0] * 0.2
    weights = np.concatenate([np.ones(K), [1e-9]])  # v costs nothing
    solution = np.linalg.lstsq(rows / np.sqrt(weights), right, rcond=None)[0] / np.sqrt(weights)
    np.testing.assert_allclose(found.plans[found.best_chain, 0], [0.2, solution[-1]], atol=2e-3)
    np.testing.assert_allclose(found.best.u[:, 0], solution[:-1], atol=2e-3)
    assert found.optimal
    assert found.certified


@pytest.mark.slow
def test_a_model_chooses_the_period_and_the_first_speed_of_a_swing():
    """The cost is far from quadratic in both, so stages learn too little of it far out."""
    text = """
    <mujoco><option timestep="0.01"/><worldbody><body>
      <joint name="h" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
    </body></worldbody>
    <actuator><motor joint="h" ctrlrange="-2 2"/></actuator></mujoco>"""
    problem = from_mjcf(
        text,
        x_init=[0.8, 0.0],
        horizon=(0.5, 3.0),
        knots=60,
        x_init_bounds=([0.8, -6.0], [0.8, 6.0]),
        running_cost=lambda data, u, knot: knot.dt * u[0] ** 2,
        terminal_equality=lambda data, knot: jnp.append(data.qpos, data.qvel) - knot.x_init,
    )
    found = solve(problem, chains=4)
    assert found.optimal_chains.all()
    # by SLSQP on a rollout of the same steps in numpy: 0.0257669
    np.testing.assert_allclose(found.replay_cost, 0.0257669, rtol=1e-3)


def test_a_start_at_an_end_of_its_bounds_is_inside_after_rounding():
    start = 100.1  # 1.5e-6 less in float32
    problem = double_integrator(
        x_init=[start, 0.0],
        terminal_residual=lambda x: x - GOAL,
        x_init_bounds=([start, -1.0], [start + 1.0, 1.0]),
    )
    box = problem.bounds
    np.testing.assert_array_equal(box.start_lower, [0.0, -1.0])
    np.testing.assert_allclose(box.start_upper, [1.0, 1.0], atol=1e-5)


@pytest.mark.slow
def test_a_periodic_motion_is_the_steady_response():
    """x'' = -x - 0.1 x' + cos 2t + u: without u, x = Re (e^{2it} / (1 - 4 + 0.2i))."""

    def f(x, u, knot):
        h, t = knot.dt, knot.time

        def rate(x, t):
            return jnp.stack([x[1], -x[0] - 0.1 * x[1] + jnp.cos(2 * t) + u[0]])

        a = rate(x, t)
        b = rate(x + h / 2 * a, t + h / 2)
        c = rate(x + h / 2 * b, t + h / 2)
        d = rate(x + h * c, t + h)
        return x + h / 6 * (a + 2 * b + 2 * c + d)

    problem = from_function(
        f,
        x_init=np.zeros(2),
        x_init_bounds=(-5.0, 5.0),
        nu=1,
        horizon=np.pi,
        knots=40,
        running_residual=lambda x, u: u,
        terminal_equality=lambda x, knot: x - knot.x_init,
    )
    found = solve(problem, chains=2, precision=64)
    response = 1 / (1 - 4 + 0.2j)
    expected = [response.real, -2 * response.imag]
    np.testing.assert_allclose(found.plans[found.best_chain, 0, :2], expected, atol=1e-4)
    assert found.optimal
    assert found.certified


@pytest.mark.slow
def test_a_parameter_is_chosen_once():
    problem = from_function(
        lambda x, u, knot: x + DT * knot.parameters["speed"],
        x_init=np.zeros(2),
        nu=1,
        horizon=K * DT,
        dt=DT,
        running_residual=lambda x, u: u,
        terminal_residual=lambda x, knot: jnp.concatenate([x - 1.0, knot.parameters["speed"]]),
        parameters={"speed": (-2 * np.ones(2), 2 * np.ones(2)), "unused": (0.0, 1.0)},
    )
    found = solve(problem, chains=4)
    T = K * DT  # 1/2 |T p - 1|^2 + 1/2 |p|^2
    np.testing.assert_allclose(found.parameters["speed"], T / (T * T + 1), atol=1e-3)
    assert found.parameters["unused"].shape == ()
    assert found.certified
    names = state_names(problem.dynamics)
    assert names == ["x0", "x1", "speed_0", "speed_1", "unused"]


def test_the_c_engine_has_no_defects_of_its_own_motion_in_any_phase():
    problem = robot(horizon=[(0.03, 0.1), (0.05, 0.2)], knots=[5, 7], dt=None)
    steps = np.array([[0.01, 0.02], [0.008, 0.012]])
    plan = np.tile(np.asarray(problem.x_init, float), (2, 13, 1))
    plan[:, :, 2:] = steps[:, None]
    u = 0.3 * np.ones((2, 12, 1))
    states, _ = problem.replay(plan, u, np.zeros((2, 12, 1, 4)))
    assert np.abs(states[:, -1, 0] - states[:, 0, 0]).min() > 1e-3
    off = problem.engine_defects(states, u)
    assert off.shape == (2, 12, 4)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)
    np.testing.assert_array_equal(problem.engine_defects(states[1], u[1]), off[1])


@pytest.mark.slow
def test_the_c_engine_replays_the_changed_model_at_its_own_step():
    problem = robot(
        horizon=(0.05, 0.2),
        knots=10,
        dt=0.01,
        parameters={"mass": (0.5, 3.0)},
        model_numbers=lambda model, p: {"body_mass": model.body_mass.at[1].set(p["mass"])},
    )
    mass, h = np.array([0.7, 2.5]), np.array([0.004, 0.02])
    plan = np.tile(np.asarray(problem.x_init, float), (2, 11, 1))
    plan[:, :, 2], plan[:, :, 3] = mass[:, None], h[:, None]
    u = 0.3 * np.ones((2, 10, 1))
    states, _ = problem.replay(plan, u, np.zeros((2, 10, 1, 4)))
    for chain in range(2):
        model = mujoco.MjModel.from_xml_string(arm())
        model.body_mass[1], model.opt.timestep = mass[chain], h[chain]
        data = mujoco.MjData(model)
        data.qpos[:] = plan[chain, 0, :1]
        for _ in range(10):
            data.ctrl[:] = 0.3
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(states[chain, -1, :2], [data.qpos[0], data.qvel[0]], rtol=1e-9)
    start = problem.start_from(jnp.asarray(plan[0, 0], problem.x_init.dtype))
    knots = Trajectory(jnp.asarray(states[0, 1:]), jnp.asarray(u[0]), start=start)
    assert np.abs(problem.defects(knots)).max() < 1e-5  # f is that of the changed model, too


def test_a_replay_computes_the_numbers_of_a_model_once():
    seen = []

    def numbers(model, p):
        seen.append(p)
        return {"body_mass": model.body_mass.at[1].set(p["mass"])}

    problem = robot(
        horizon=(0.05, 0.2),
        knots=5,
        dt=0.01,
        parameters={"mass": (0.5, 3.0)},
        model_numbers=numbers,
    )
    plan = np.tile(np.asarray(problem.x_init, float), (2, 6, 1))
    seen.clear()
    problem.replay(plan, np.zeros((2, 5, 1)), np.zeros((2, 5, 1, 4)))
    assert len(seen) == 1


@pytest.mark.parametrize("length", [0.4, 0.9])
def test_goals_and_pictures_are_of_the_model_that_parameters_make(length):
    problem = robot(
        parameters={"length": (0.2, 1.0)},
        model_numbers=lambda model, p: {"site_pos": model.site_pos.at[0, 2].set(p["length"])},
        goal=lambda data: data.site("tip").xpos[2] > 0.5,
        horizon=0.04,
    )
    x = np.asarray(problem.x_init, float)
    x[:2], x[2] = 0.0, length
    other = x.copy()
    other[2] = 1.3 - length
    model = mujoco_model(problem.dynamics, x)
    data = problem.dynamics.observe_replayed(x, 0.0)
    assert model.site_pos[0, 2] == pytest.approx(length)
    assert mujoco_model(problem.dynamics).site_pos[0, 2] != pytest.approx(length)
    assert data.site("tip").xpos[2] == pytest.approx(length)
    assert problem.reached(x) == (length > 0.5)
    expected = [length > 0.5, length < 0.5, length > 0.5]
    np.testing.assert_array_equal(problem.all_reached(np.array([x, other, x]), [0.0] * 3), expected)


def numbered(field, entry, model):
    """A motion from rest where a number of the model is a parameter, 2.0, and its defects."""
    problem = robot(
        model,
        x_init=[0.0, 0.0],
        parameters={"p": (0.5, 3.0)},
        model_numbers=lambda m, p: {field: getattr(m, field).at[entry].set(p["p"])},
        horizon=0.1,
    )
    plan = np.tile([0.0, 0.0, 2.0], (1, 6, 1))
    states, u = problem.replay(plan, np.ones((1, 5, 1)), np.zeros((1, 5, 1, 3)))
    start = problem.start_from(jnp.asarray(plan[0, 0], problem.x_init.dtype))
    knots = Trajectory(jnp.asarray(states[0, 1:]), jnp.asarray(u[0]), start=start)
    return states[0], np.abs(problem.defects(knots)).max()


SLED = """
<mujoco><option timestep="0.01"/><worldbody>
  <body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="pull" joint="x" ctrlrange="-1 1"/></actuator></mujoco>
"""


def test_the_c_engine_takes_no_short_cut_by_what_numbers_were_before():
    """MuJoCo's compiler keeps the inertia of a sled and where a frame is that of its body."""
    states, off = numbered("body_mass", 1, SLED)
    assert states[-1, 1] == pytest.approx(0.1 / 2.0)  # F t / m
    assert off < 1e-6
    by_hand = arm().replace('<body name="link">', '<body name="link" simple="false">')
    states, off = numbered("body_ipos", (1, 0), by_hand)
    assert states[-1, 1] == pytest.approx(0.1 * (2 * 9.81 * 2.0 + 1) / (2 * 2.0**2), rel=0.02)
    assert off < 1e-5
    with pytest.raises(DraxError, match=r'body_ipos.*simple="false"'):
        numbered("body_ipos", (1, 0), arm())


@pytest.mark.parametrize("names", [(), ("mass",)])
def test_a_replay_gives_every_chain_its_model_once_if_at_all(names, monkeypatch):
    changed = []
    monkeypatch.setattr(stepper, "set_numbers", lambda model, *_: changed.append(model))
    problem = robot(
        horizon=(0.05, 0.2),
        knots=5,
        dt=0.01,
        parameters=dict.fromkeys(names, (0.5, 3.0)),
        model_numbers=masses if names else None,
    )
    plan = np.tile(np.asarray(problem.x_init, float), (2, 6, 1))
    problem.replay(plan, np.zeros((2, 5, 1)), np.zeros((2, 5, 1, problem.dynamics.ndx)))
    assert len(changed) == 2 * len(names)


def masses(model, p):
    return {"body_mass": model.body_mass.at[1].set(p["mass"])}


def test_a_chain_whose_numbers_the_engine_cannot_take_leaves_the_others_alone():
    problem = robot(SLED, x_init=[0.0, 0.0], parameters={"mass": (0.0, 3.0)}, model_numbers=masses)
    plan = np.tile([0.0, 0.0, 2.0], (2, 6, 1))
    plan[0, :, 2] = 0.0
    states, _ = problem.replay(plan, np.ones((2, 5, 1)), np.zeros((2, 5, 1, 3)))
    assert np.isnan(states[0, 1:, :2]).all()
    assert states[1, -1, 1] == pytest.approx(0.1 / 2.0)


@pytest.mark.slow
def test_rates_cost_and_are_bounded():
    problem = double_integrator(
        running_residual=lambda x, u, knot: knot.rate,
        terminal_equality=lambda x: x - GOAL,
        u_init=[0.5],
        rates=1,
    )
    found = solve(problem, chains=2)
    G, _ = matrices()
    D = (np.eye(K) - np.eye(K, k=-1)) / DT
    first = np.zeros(K)
    first[0] = 0.5 / DT  # rate = D u - first
    system = np.block([[D.T @ D, G[-1].T], [G[-1], np.zeros((2, 2))]])
    expected = np.linalg.solve(system, np.concatenate([D.T @ first, GOAL]))[:K]
    np.testing.assert_allclose(found.best.u[:, 0], expected, atol=5e-3)
    assert found.optimal
    assert found.certified
    limited = double_integrator(
        running_residual=lambda x, u: u,
        terminal_equality=lambda x: x - GOAL,
        u_init=[0.0],
        rate_bounds=(-2.0, 4.0),
    )
    found = solve(limited, chains=2)
    rate = np.diff(found.best.u[:, 0], prepend=0.0) / DT
    assert found.certified
    assert rate.max() == pytest.approx(4.0, abs=0.02)
    assert rate.min() > -2.02


def test_jerk_is_the_rate_of_the_rate():
    problem = double_integrator(
        running_residual=lambda x, u, knot: jnp.concatenate([knot.rate, knot.jerk]),
        rates=2,
        terminal_residual=lambda x: x,
    )
    u = np.random.default_rng(0).normal(size=(K, 1))
    knots = problem.started(Trajectory(jnp.zeros((K, 2)), jnp.asarray(u)))
    rate = np.concatenate([[0.0], np.diff(u[:, 0]) / DT])
    jerk = np.concatenate([[0.0, 0.0], np.diff(rate[1:]) / DT])
    costs = np.asarray(problem.costs(knots))[:-1]
    np.testing.assert_allclose(costs, 0.5 * (rate**2 + jerk**2), rtol=1e-3)


@pytest.mark.slow
def test_the_papers_own_flow_finds_a_start():
    problem = double_integrator(
        running_residual=lambda x, u: jnp.append(u, x[0] - 0.1),
        terminal_residual=lambda x, knot: x - knot.x_init,
        x_init_bounds=(-1.0, 1.0),
    )
    flow = Langevin(
        iterations=10,
        tail=500,
        step_size=0.02,
        noise=Constant(0.01),
        penalty=Constant(10.0),
        barrier_weight=Constant(1e-3),
        preconditioner=Identity(),
    )
    found = solve(problem, chains=1, solver=flow)
    assert found.plans[0, 0, 0] == pytest.approx(0.1, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("window", [(0.3, 1.0), (0.9, 1.2)])
def test_a_waypoint_is_passed_at_the_best_time_within_a_window(window):
    """Back to -0.1 m, then to 1 m at rest after 2 s, with least effort."""
    found = solve(
        fastest(
            horizon=[window, (0.5, 3.0)],
            knots=[20, 20],
            running_cost=lambda x, u, knot: knot.dt * u[0] ** 2,
            equality=lambda x, u, knot: jnp.where(knot.index == 20, x[:1] + 0.1, 0.0),
            terminal_equality=lambda x, knot: jnp.stack([x[0] - 1.0, x[1], knot.time - 2.0]),
            u_bounds=(-20.0, 20.0),
        ),
        chains=4,
    )

    def effort(distance, v_0, v_1, T):  # of the cubic from end to end
        return 12 * (distance - 0.5 * (v_0 + v_1) * T) ** 2 / T**3 + (v_1 - v_0) ** 2 / T

    t, v = np.meshgrid(np.linspace(*window, 301), np.linspace(-1, 1, 801))
    efforts = effort(-0.1, 0.0, v, t) + effort(1.1, v, 0.0, 2.0 - t)
    best = efforts.argmin()
    assert found.certified
    assert found.cost.min() == pytest.approx(efforts.min(), rel=4e-3)
    assert found.times[20] == pytest.approx(t.ravel()[best], abs=5e-3)


@pytest.mark.slow
def test_a_changed_model_is_saved_loaded_filmed_and_exported(tmp_path):
    problem = robot(
        horizon=(0.05, 0.4),
        knots=12,
        dt=0.01,
        parameters={"mass": (1.5, 3.0)},
        rates=1,
        model_numbers=lambda model, p: {"body_mass": model.body_mass.at[1].set(p["mass"])},
        running_cost=lambda data, u, knot: knot.dt * (1 + 1e-3 * knot.rate[0] ** 2),
        terminal_residual=lambda data, knot: jnp.stack(
            [30 * (data.qpos[0] - 0.5), data.qvel[0], 0.1 * (knot.parameters["mass"] - 2.0)]
        ),
    )
    found = solve(problem, chains=8)
    assert found.certified
    assert found.optimal
    assert found.parameters["mass"] == pytest.approx(2.0, abs=1e-2)
    found.save(tmp_path)
    loaded = Solution.load(tmp_path)
    assert loaded.parameters == found.parameters
    np.testing.assert_array_equal(loaded.times, found.times)
    names = save_csv(loaded, tmp_path / "motion.csv").read_text().splitlines()[0]
    assert names == "time,qpos_elbow,qvel_elbow,mass,step,before_ctrl_torque,ctrl_torque"
    with pytest.warns(DraxWarning, match=r"has chosen body_mass and timestep 0\.0"):
        export_keyframes(found, tmp_path / "robot.xml")
    with pytest.warns(DraxWarning, match=r"has chosen timestep 0\.0"):  # functions are not saved
        assert export_keyframes(loaded, tmp_path / "robot.xml").exists()
    assert render(loaded, tmp_path / "motion.mp4").stat().st_size > 1000


@pytest.mark.slow
def test_the_brachistochrone_and_the_fastest_swing_up():
    def slide(x, u, knot):
        h = knot.dt

        def rate(x):
            sine, cosine = jnp.sin(u[0]), jnp.cos(u[0])
            return jnp.stack([x[2] * sine, x[2] * cosine, 9.81 * cosine])

        a = rate(x)
        b = rate(x + h / 2 * a)
        c = rate(x + h / 2 * b)
        d = rate(x + h * c)
        return x + h / 6 * (a + 2 * b + 2 * c + d)

    found = solve(
        fastest(
            f=slide,
            x_init=np.zeros(3),
            horizon=(0.1, 5.0),
            knots=100,
            terminal_equality=lambda x: x[:2] - np.array([10.0, 5.0]),
            u_bounds=(-0.5, 3.2),
        ),
        chains=8,
    )
    assert found.certified
    assert found.cost.min() == pytest.approx(1.8012955, rel=1e-3)  # the cycloid's

    cart = """
    <mujoco><option timestep="0.01"><flag contact="disable"/></option><worldbody>
      <body><joint type="slide" axis="1 0 0" range="-2 2" limited="true"/>
        <geom type="box" size=".1 .1 .05" mass="1"/>
        <body><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"
          mass=".2"/></body></body></worldbody>
      <actuator><motor joint="slide" ctrlrange="-10 10" ctrllimited="true"/></actuator></mujoco>
    """.replace('<joint type="slide"', '<joint name="slide" type="slide"')
    upright = np.array([0.0, np.pi, 0.0, 0.0])
    problem = from_mjcf(
        cart,
        horizon=(0.5, 4.0),
        knots=60,
        dt=0.02,
        running_cost=lambda data, u, knot: knot.dt * (1 + 1e-4 * u[0] ** 2),
        terminal_equality=lambda data: jnp.concatenate([data.qpos, data.qvel]) - upright,
        goal=lambda data: abs(data.qpos[1] - np.pi) < 0.05,
    )
    found = solve(problem, chains=16)
    assert found.certified
    assert found.times[-1] < 1.3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": (2.0, 1.0)}, "0 < least < most"),
        ({"horizon": (1.0, 2.0), "knots": None}, "duration is free, from 1 to 2 s, .* knots=K"),
        ({"horizon": [(1.0, 2.0), (1.0, 2.0)], "knots": [3]}, "one for each phase|for phases"),
        ({"f": lambda x, u: x}, "f has no parameter knot"),
        ({"horizon": 1.0, "knots": None}, "give one of the two"),
        ({"parameters": {"m": (1.0, 1.0)}}, "the parameter 'm' is"),
        ({"parameters": [1.0]}, "give {name:"),
        ({"x_init_bounds": (1.0, 2.0)}, "lies outside of x_init_bounds"),
        ({"x_init_bounds": (np.zeros(3), np.ones(3))}, "x_init_bounds are"),
        ({"rates": 3}, "rates is 3"),
        (
            {
                "parameters": {"mass": (1, 2)},
                "running_cost": lambda x, u, knot: knot.parameters["m"],
            },
            "KeyError: 'm'.* Change it: knot.parameters has 'mass'",
        ),
        ({"rate_bounds": (1.0, -1.0)}, "rate_bounds are"),
        ({"u_init": [0.0]}, "nothing reads a rate"),
        ({"rates": 1, "u_init": [0.0, 1.0]}, "u_init has shape"),
        ({"rates": "a"}, "rates is 'a'"),
        ({"knots": 3.7}, "knots"),
        ({"data": lambda t: t}, "data is a function of time, and the horizon is free"),
    ],
)
def test_bad_choices_are_named(changes, message):
    with pytest.raises(DraxError, match=message):
        fastest(**changes)


def test_functions_may_hold_random_keys():
    key = jax.random.key(0)
    noise = from_function(
        lambda x, u: x + u,
        x_init=[0.0],
        nu=1,
        dt=DT,
        horizon=3 * DT,
        running_cost=lambda x, u: (u[0] - jax.random.uniform(key)) ** 2,
    )
    assert noise.horizon == 3


def test_rows_on_rates_are_called_so():
    problem = fastest(rate_bounds=(-9.0, 9.0), inequality=lambda x, u: x[:1] - 5.0)
    names = [entry_name(problem, "inequality", i) for i in range(3)]
    assert names == ["[0]", "[rate of u0]", "[rate of u0]"]
    assert entry_name(problem, "equality", 0) == "[0]"


def test_endless_rate_bounds_ask_for_nothing():
    problem = fastest(rate_bounds=(-np.inf, np.inf))
    assert problem.constraint.rows == 0


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (lambda model, p: {"mass": p["m"]}, "no such field"),
        (lambda model, p: {"body_mass": p["m"]}, r"the model has shape"),
        (lambda model, p: p["n"], "model_numbers failed"),
        (
            lambda model, p: {"body_gravcomp": model.body_gravcomp + p["m"]},
            "gives 'body_gravcomp' to what has none .* such as gravcomp=\"1e-6\"",
        ),
        (
            lambda model, p: {"opt": model.opt},
            "'opt' of shape None, and the model has no such field",
        ),
        (
            lambda model, p: {"jnt_range": model.jnt_range * p["m"]},
            "'jnt_range', but the ranges of joints that are driven are bounds of the plan",
        ),
    ],
)
def test_bad_numbers_of_a_model_are_named(numbers, message):
    with pytest.raises(DraxError, match=message):
        robot(parameters={"m": (1.0, 2.0)}, model_numbers=numbers)


def test_what_a_fixed_problem_cannot_use_is_named():
    with pytest.raises(DraxError, match="nothing reads a rate"):
        double_integrator(u_init=[0.0])
    with pytest.raises(DraxError, match="knots are for a free one"):
        robot(knots=10)


def test_a_last_control_outside_of_its_bounds_is_told():
    with pytest.warns(DraxWarning, match=r"u_init is \[5.0\], outside of the controls' bounds"):
        double_integrator(
            u_init=[5.0], rates=1, u_bounds=(-1.0, 1.0), running_residual=lambda x, u: u
        )


def test_a_last_control_leaves_bounds_of_x_0_and_durations_as_they_are():
    open_start = {"x_init_bounds": ([-0.1, 0.0], [0.1, 0.0]), "u_bounds": (-8.0, 8.0), "rates": 1}
    costs = {"running_residual": lambda x, u, knot: knot.rate}
    first, other = (
        double_integrator(**open_start, **costs, **more) for more in ({}, {"u_init": [0.0]})
    )
    jax.tree.map(np.testing.assert_array_equal, other.bounds, first.bounds)
    np.testing.assert_allclose(other.bounds.start_upper, [0.1])
    first, other = (fastest(rates=1, **more) for more in ({}, {"u_init": [0.0]}))
    jax.tree.map(np.testing.assert_array_equal, other.bounds, first.bounds)
    jax.tree.map(np.testing.assert_array_equal, other.scatter, first.scatter)


def test_windows_may_lie_within_the_longest_durations():
    slow = between(lambda x, u: u - 1.0, 4.0, 4.5)
    assert fastest(inequality=slow).horizon == 20
    with pytest.raises(DraxError, match="inequality holds from 6 to 7 s"):
        fastest(inequality=between(lambda x, u: u - 1.0, 6.0, 7.0))


def test_a_motion_that_may_end_before_a_time_that_is_asked_for_is_told():
    gate = at_time(lambda x, u: x[:1] - 0.2, 3.0)
    with pytest.warns(DraxWarning, match="in the shortest motion equality holds at 3 s, where it"):
        fastest(equality=gate)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fastest(equality=gate, horizon=(3.5, 5.0))
        fastest(inequality=between(lambda x, u: u - 1.0, 4.0, 4.5))  # for a while, if at all


def test_a_free_duration_and_rates_are_counted_from_where_x_0_is():
    problem = fastest(rates=1, u_init=None)
    knots, later = problem.draw(jax.random.key(0)), problem.at_time(3.0)

    def seen(problem):
        x, u, at = problem.stages(knots)
        return jax.vmap(lambda x, u, knot: problem.dynamics.at(knot).here(x, u))(x, u, at)

    now, then = seen(problem), seen(later)
    np.testing.assert_allclose(then.time - 3.0, now.time, atol=1e-5)
    np.testing.assert_array_equal(then.dt, now.dt)
    np.testing.assert_array_equal(then.rate, now.rate)
    assert now.rate[0] == 0.0 != now.rate[1]


def test_draws_agree_with_what_is_chosen():
    problem = fastest(parameters={"m": (1.0, 2.0)}, rates=1)
    knots = problem.draw(jax.random.key(0))
    states = np.asarray(problem.with_start(knots))
    extras = problem.dynamics.extras(states)
    assert np.ptp(extras.p) == np.ptp(extras.h) == 0.0
    assert 1.0 < extras.p[0, 0] < 2.0
    np.testing.assert_array_equal(extras.v[1:, 0], knots.u[:, 0])


def test_a_class_that_takes_no_step_of_a_free_duration_is_refused():
    class Fixed(Dynamics):
        dt, nx, nu = DT, 2, 1

        def step(self, x, u):
            return x + self.dt * jnp.stack([x[1], u[0]])

    given = {"x_init": [0.0, 0.0], "nu": 1, "running_cost": lambda x, u: u @ u}
    with pytest.raises(DraxError, match=r"horizon is free, and Fixed .* at\(knot\)"):
        from_function(Fixed(), horizon=(1.0, 6.0), knots=30, **given)
    with pytest.raises(DraxError, match=r"0\.5 s apart .* step of Fixed is"):
        from_function(Fixed(), horizon=3.0, dt=0.5, **given)


def test_data_of_a_free_duration_stay_rows():
    problem = from_function(
        lambda x, u, knot: x + knot.dt * u + 0.0 * knot.data,
        x_init=[0.0],
        nu=1,
        horizon=(0.5, 1.0),
        knots=4,
        data=np.zeros((5, 1)),
        running_cost=lambda x, u: u @ u,
    )
    with pytest.raises(DraxError, match="data is a function of time, and the horizon is free"):
        problem.with_data(lambda t: jnp.stack([t]))


def test_no_physics_step_of_a_free_duration_is_longer_than_the_models():
    free = robot(horizon=[(0.1, 0.4), (0.2, 1.0)], knots=[5, 7], dt=None)  # timestep 0.01
    substeps, longest = free.dynamics.inner.substeps, 1.0 / 7
    assert longest / substeps <= 0.01 < longest / (substeps - 1)
    assert free.dynamics.dt == pytest.approx(0.85 / 12)
    assert robot(horizon=(0.1, 0.4), knots=5, dt=0.02).dynamics.inner.substeps == 2
