"""Model predictive control: shifting, falling back, and the loop with MuJoCo's C engine."""

import copy
import json
import textwrap
import time
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import double_integrator, robot

from mjx_drax import (
    MPC,
    Background,
    DraxError,
    Identity,
    Langevin,
    Plant,
    Push,
    Restarts,
    from_function,
    from_mjcf,
)
from mjx_drax.base.errors import DraxWarning
from mjx_drax.cli import main
from mjx_drax.control import mpc
from mjx_drax.control import trials as loop
from mjx_drax.control.plant import random_pushes
from mjx_drax.control.shift import shifted
from mjx_drax.physics.c_engine.states import CONVERGED
from mjx_drax.search.engine import Search
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.iterate import advance, start

DT, K = 0.1, 15
FAST = Restarts(replace(Restarts().flow, iterations=30, tail=30), descent=40, attempts=1)

SLIDER = """
<mujoco model="slider">
  <option timestep="0.01" integrator="Euler"><flag contact="disable"/></option>
  <worldbody><body name="cart">
    <joint name="slide" type="slide" axis="1 0 0"/>
    <geom size="0.05" mass="1"/>
  </body></worldbody>
  <actuator><motor joint="slide" gear="10" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


def f(x, u):
    """An inverted pendulum with limited torque, x = 0 upright."""
    return x + DT * jnp.array([x[1], 2.0 * jnp.sin(x[0]) + 4.0 * u[0]])


def stepped(x, u):
    return np.asarray(f(jnp.asarray(x), jnp.asarray(u)), float)


def balance(**more):
    return from_function(
        f,
        x_init=[0.5, 0.0],
        nu=1,
        dt=DT,
        horizon=K * DT,
        running_residual=lambda x, u: 0.3 * u,
        terminal_residual=lambda x: 3.0 * x,
        u_bounds=(-1.0, 1.0),
        **more,
    )


@pytest.fixture(scope="module")
def solved():
    policy = MPC(balance(), chains=4, explorers=1, hold=1.0, solver=FAST)
    policy.reset([0.5, 0.0])
    return policy


@pytest.fixture
def policy(solved):
    solved.rewind()
    return solved


def test_a_pendulum_is_balanced_after_a_push_without_recompiling(policy):
    x = np.array([0.5, 0.0])
    before = policy.planner._cache_size()
    for k in range(60):
        x = stepped(x, policy(x, k * DT))
        if k == 20:
            x = x + np.array([0.1, -0.8])
    assert np.abs(x).max() < 0.02
    assert policy.planner._cache_size() == before
    assert policy.statistics.plans == 59
    assert policy.statistics.failed == 0
    assert np.median(policy.statistics.max_defects) < 1e-4
    infeasible = policy.statistics.infeasible
    said = repr(policy.statistics)
    assert said.startswith(f"<Statistics of 59 plans, {infeasible} infeasible: median ")
    assert repr(policy.latest).startswith("<Plan of ")


@pytest.mark.slow
def test_a_plan_may_begin_beyond_a_bound():
    policy = MPC(balance(x_bounds=([-1.0, -2.0], [0.6, 2.0])), chains=2, explorers=0, solver=FAST)
    measured = np.array([0.63, 0.0])
    policy(measured, 0.0)
    np.testing.assert_allclose(policy.latest.x[0], measured, rtol=1e-6)
    assert policy.statistics.failed == 0
    assert policy.latest.x[1:, 0].max() < 0.63


@pytest.mark.slow
def test_a_reset_has_what_functions_read_by_then():
    aim = np.array([0.5])
    policy = MPC(
        from_function(
            lambda x, u: x + DT * u,
            x_init=[0.0],
            nu=1,
            dt=DT,
            horizon=K * DT,
            running_residual=lambda x, u: 0.1 * u,
            terminal_residual=lambda x: 10.0 * (x - jnp.asarray(aim)),
        ),
        chains=2,
        explorers=0,
        solver=FAST,
    )
    for aim[0] in (0.5, -0.5):
        policy.reset([0.0])
        assert policy.latest.x[-1] == pytest.approx(aim, abs=0.02)
        assert policy.plan([0.0], DT).x[-1] == pytest.approx(aim, abs=0.02)


@pytest.mark.slow
def test_a_chain_that_is_alone_is_led_back_after_a_push():
    policy, x, defects = MPC(balance(), chains=1, iterations=1, solver=FAST), [6.0, -6.0], []
    policy.reset([0.5, 0.0])
    for k in (1, 2):
        x = stepped(x, policy(x, k * DT))
        defects.append(policy.statistics.max_defects[-1])
    assert defects[1] < 0.2 * defects[0]


def servo(integrator="implicitfast", joint=""):
    """A pendulum that a servo of little force brings to 1 rad."""
    text = f"""
    <mujoco><option timestep="0.01" integrator="{integrator}"/><worldbody><body>
      <joint name="one" axis="0 1 0" damping="0.3" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1"/>
    </body></worldbody><actuator>
      <position joint="one" kp="60" kv="4" ctrlrange="-4 4" forcerange="-6 6"/>
    </actuator></mujoco>"""

    def off(data, u=0.0):
        return jnp.concatenate([14.0 * (data.qpos - 1.0), 3.0 * data.qvel])

    def running(data, u):
        return jnp.concatenate([0.3 * data.qvel, 3.0 * (u - data.qpos)])

    return from_mjcf(text, horizon=1.0, dt=0.02, running_residual=running, terminal_residual=off)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_servos_are_driven_up_to_where_their_forces_end_and_no_further(integrator):
    problem = servo(integrator)
    policy, plant, forces = MPC(problem, chains=2, explorers=0, solver=FAST), Plant(problem), []
    policy.reset(plant.measured())
    while plant.time < 2.0:
        if plant.time == pytest.approx(1.0):
            plant.data.qvel += 3.0
        plant.step(policy(plant.measured(), plant.time))
        forces.append(abs(plant.data.actuator_force[0]))
    assert 5.9 < max(forces) < 6.0
    assert np.mean(np.array(policy.statistics.max_defects) < 1e-3) > 0.9
    np.testing.assert_allclose(plant.state, [1.0, 0.0], atol=0.05)


@pytest.mark.slow
def test_servos_start_from_a_plan_with_their_true_forces_where_none_else_is_found(monkeypatch):
    """The first search, whose forces have no ends, is made to find nothing that counts."""
    run, searches = Search.run, []

    def spied(search):
        found = run(search)
        searches.append(search)
        if len(searches) == 1:
            missed = np.ones(len(found.chains.missed), bool)
            found = replace(found, chains=replace(found.chains, missed=missed))
        return found

    monkeypatch.setattr(Search, "run", spied)
    problem = servo()
    policy = MPC(problem, chains=2, explorers=0, solver=FAST)
    plan = policy.reset(problem.x_init)
    free, true, again = searches
    ranges = [float(s.family.problem.dynamics.model.actuator_forcerange[0, 1]) for s in searches]
    assert ranges[1] == 6.0
    assert ranges[0] == ranges[2] > 6.0
    assert free.guess is true.guess is None
    assert again.guess is not None
    assert plan.max_defect < 1e-3
    np.testing.assert_allclose(plan.x[-1], [1.0, 0.0], atol=0.05)


@pytest.mark.slow
def test_servos_with_dry_friction_are_solved_in_steps_first(monkeypatch):
    searches = []
    run = Search.run
    monkeypatch.setattr(Search, "run", lambda search: searches.append(search) or run(search))
    problem = servo(joint='frictionloss="0.05"')
    policy, plant = MPC(problem, chains=2, explorers=0, solver=FAST), Plant(problem)
    policy.reset(plant.measured())
    assert len(searches) >= 2
    while plant.time < 2.0:
        plant.step(policy(plant.measured(), plant.time))
    np.testing.assert_allclose(plant.state, [1.0, 0.0], atol=0.1)


@pytest.mark.slow
def test_a_constant_in_the_cost_does_not_heat_explorers():
    noise = []
    for constant in (0.0, 100.0):
        policy = MPC(balance(running_cost=lambda x, u, c=constant: c), chains=2, solver=FAST)
        policy.reset([0.5, 0.0])
        noise.append(policy._now(np.array([0.5, 0.0]), DT, 1.0)[0].noise)
    assert noise[1] == pytest.approx(noise[0], rel=1e-2)


@pytest.mark.slow
def test_float64_stays_float64():
    with jax.enable_x64(True):
        policy = MPC(balance(), chains=2, explorers=1, hold=1.0, solver=FAST)
        policy.reset([0.5, 0.0])
        x = np.array([0.5, 0.0])
        for k in range(3):
            x = stepped(x, policy(x, k * DT))
        assert policy.statistics.failed == 0
        assert {a.dtype for a in (policy.latest.x, policy.latest.u, policy.latest.gains)} == {
            np.dtype(float)
        }
        weight = policy.problem.running.residual.args[0].args[-1]
        assert weight == np.sqrt(DT)  # of `hold`, to the last bit


@pytest.fixture(scope="module")
def in_float64():
    return MPC(balance().in_float64(), chains=2, explorers=1, hold=1.0, solver=FAST)


def test_a_problem_in_float64_is_planned_for_in_float64(in_float64):
    policy = in_float64
    x = np.array([0.5, 0.0])
    for k in range(3):
        x = stepped(x, policy(x, k * DT))
    assert policy.statistics.failed == 0
    assert policy.latest.x.dtype == np.float64


def test_going_back_keeps_the_precision_and_gives_the_same_plans(in_float64):
    policy = in_float64
    policy.reset([0.5, 0.0])
    first = [policy.plan([0.4, 0.1], DT).u, policy.plan([0.3, 0.1], 2 * DT).u]
    policy.rewind()
    again = [policy.plan([0.4, 0.1], DT).u, policy.plan([0.3, 0.1], 2 * DT).u]
    assert again[0].dtype == float
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(*first)


def test_a_time_before_the_plan_in_use_says_how_to_begin_anew(policy):
    policy([0.5, 0.0], 20 * DT)
    for call in (policy, policy.plan):
        with pytest.raises(DraxError, match=r"plan in use is of 2 s: to begin anew call policy"):
            call([0.5, 0.0], 0.0)
    policy.rewind()
    policy([0.5, 0.0], DT)
    assert policy.latest.time == DT


def test_a_plan_that_was_interrupted_says_how_to_go_on(policy, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(policy, "planner", interrupt)
        with pytest.raises(KeyboardInterrupt):
            policy.plan([0.5, 0.0], DT)
    with pytest.raises(DraxError, match=r"the last plan was interrupted: call policy.reset\(x\)"):
        policy.plan([0.5, 0.0], DT)
    policy.control([0.5, 0.0], DT)
    policy.rewind()
    policy.plan([0.5, 0.0], DT)


def test_a_shift_by_one_knot_moves_all_that_is_carried():
    problem, flow, key = balance(), FAST.flow, jax.random.key(0)
    states = start(flow, problem, initial_knots(problem, 1, None, key), key)
    states, _ = advance(flow, problem, states, 0, 60)
    chain, shift = jax.tree.map(lambda a: a[0], states), jax.jit(shifted)
    later = shift(flow, problem, jnp.float32(1.0), chain)
    for now, then in (
        (later.trajectory.x, chain.trajectory.x),
        (later.trajectory.u, chain.trajectory.u),
        (later.multipliers.dynamics, chain.multipliers.dynamics),
        (later.multipliers.bounds[0].u, chain.multipliers.bounds[0].u),
        (later.gains, chain.gains),
    ):
        assert np.abs(then).max() > 0.0
        np.testing.assert_allclose(now[:-1], then[1:], rtol=1e-6)
    last = f(chain.trajectory.x[-1], chain.trajectory.u[-1])
    np.testing.assert_allclose(later.trajectory.x[-1], last, rtol=1e-5)
    half = shift(flow, problem, jnp.float32(2.5), chain)
    middle = 0.5 * (chain.trajectory.x[2:-1] + chain.trajectory.x[3:])
    np.testing.assert_allclose(half.trajectory.x[: K - 3], middle, atol=1e-6)


def test_between_plans_the_feedback_acts_about_the_interpolated_plan(policy):
    plan = policy.latest
    planned = 0.6 * plan.x[3] + 0.4 * plan.x[4]
    np.testing.assert_allclose(policy.control(planned, 3.4 * DT), plan.u[3], atol=1e-5)
    off = np.array([1e-3, -2e-3])
    np.testing.assert_allclose(
        policy.control(planned + off, 3.4 * DT), plan.u[3] + plan.gains[3] @ off, atol=1e-5
    )
    assert policy.control(planned + 100.0, 3.4 * DT).item() in (-1.0, 1.0)  # clipped
    policy.control(planned, 1e6)  # long after the last knot


def test_what_is_not_finite_changes_nothing_and_is_counted(policy, monkeypatch):
    t, shifts, now = DT, [], mpc.Now
    monkeypatch.setattr(mpc, "Now", lambda **new: shifts.append(float(new["by"])) or now(**new))
    u = policy([np.nan, 0.0], t)
    np.testing.assert_allclose(u, policy.latest.u[1])
    assert policy.statistics.unmeasured == 1
    assert policy.statistics.plans == 0
    good = policy.latest
    policy.plan([1e30, 0.0], t)  # its plan overflows
    assert policy.statistics.failed == 1
    assert policy.latest is good
    policy.plan(good.x[2], 2 * t)
    assert policy.latest.time == 2 * t
    assert policy.latest.max_defect < 1e-2
    np.testing.assert_allclose(shifts, [1.0, 1.0])  # by 2 in all, not by 3


def test_the_terminal_cost_along_the_horizon():
    problem, x, u = balance(), jnp.array([0.3, -0.2]), jnp.array([0.5])
    held = mpc.holding(problem, 2.0)
    added = float(held.running_cost(x, u) - problem.running_cost(x, u))
    assert added == pytest.approx(2.0 * DT * float(problem.terminal_cost(x)), rel=1e-5)
    assert mpc.holding(problem, 0.0) is problem


def test_a_thread_plans_beside_the_loop(policy):
    x = np.array([0.5, 0.0])
    with Background(policy) as newest:
        for k in range(40):
            x = stepped(x, newest(x, k * DT))
            time.sleep(0.02)
    assert policy.statistics.plans > 3
    assert np.abs(x).max() < 0.1


def test_a_wrong_call_is_refused_and_the_thread_plans_on(policy):
    with Background(policy) as newest:
        for x, t in (([0.5, 0.0], np.nan), ([0.5, 0.0], -9.0), ([0.5], DT)):
            with pytest.raises(DraxError):
                newest(x, t)
        before = policy.statistics.plans
        newest([0.5, 0.0], 5 * DT)
        while policy.statistics.plans == before:
            newest([0.5, 0.0], 5 * DT)
            time.sleep(0.01)


def test_an_error_in_the_thread_reaches_the_caller(policy, monkeypatch):
    def fail(x, t):
        raise ValueError("no")

    monkeypatch.setattr(policy, "plan", fail)

    def call():
        for k in range(200):
            newest([0.5, 0.0], k * DT)
            time.sleep(0.01)

    with Background(policy) as newest, pytest.raises(RuntimeError, match="thread has failed"):
        call()

    def call_once():
        with Background(policy) as newest:
            newest([0.5, 0.0], DT)
            time.sleep(0.05)

    with pytest.raises(RuntimeError, match="thread has failed"):
        call_once()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"chains": 0}, "chains is 0"),
        ({"iterations": 0}, "iterations is 0"),
        ({"iterations": 99}, "the solver's tail has 60"),
        ({"explorers": 8}, "explorers is 8 of 8 chains"),
        ({"hold": -1.0}, "hold is -1"),
        ({"every": 0.5}, "every is 0.5"),
        ({"solver": Langevin(preconditioner=Identity())}, "Identity, which brings no feedback"),
    ],
)
def test_settings_that_are_refused(settings, words):
    with pytest.raises(DraxError, match=words):
        MPC(balance(), **settings)


def test_bounds_that_change_along_the_horizon_are_refused():
    problem = balance()
    tighter = replace(problem.bounds, u_upper=jnp.linspace(1.0, 0.5, K)[:, None])
    with pytest.raises(DraxError, match="differ from knot to knot"):
        MPC(replace(problem, bounds=tighter))


def test_a_policy_without_a_plan_says_what_to_do():
    with pytest.raises(DraxError, match=r"call policy.reset\(x\)"):
        MPC(balance()).control([0.0, 0.0], 0.0)


@pytest.fixture(scope="module")
def slider():
    return from_mjcf(
        SLIDER,
        horizon=0.5,
        dt=0.02,
        terminal_residual=lambda data: jnp.concatenate([5.0 * data.qpos, data.qvel]),
        running_residual=lambda data, u: 0.1 * u,
        goal=lambda data: abs(data.qpos[0]) < 0.02 and abs(data.qvel[0]) < 0.1,
    )


def test_the_plant_is_pushed_heavier_and_noisy(slider):
    push = Push(0.02, "cart", (5.0, 0.0, 0.0), lasts=0.05)
    light, heavy = Plant(slider, pushes=[push]), Plant(slider, mass=2.0, pushes=[push])
    for plant in (light, heavy):
        while plant.time < 0.2:
            plant.step(np.zeros(1))
    assert light.data.qvel[0] == pytest.approx(5.0 * 0.05, rel=1e-6)
    assert heavy.data.qvel[0] == pytest.approx(5.0 * 0.05 / 2.0, rel=1e-6)
    assert slider.dynamics.mj_model.body_mass[1] == 1.0
    np.testing.assert_array_equal(light.measured(), light.state)
    noisy = Plant(slider, noise=0.1, shaking=1.0, seed=1)
    off = np.array([noisy.measured() - noisy.state for _ in range(400)])
    np.testing.assert_allclose(off.std(0), 0.1, rtol=0.15)
    noisy.step(np.zeros(1))
    assert noisy.data.qvel[0] != 0.0


def test_the_contact_solver_of_the_plant_converges(slider):
    dynamics = slider.dynamics
    early = copy.deepcopy(dynamics.mj_model)
    early.opt.iterations, early.opt.ls_iterations = 1, 4
    plant = Plant(replace(slider, dynamics=replace(dynamics, mj_model=early)))
    assert plant.model.opt.iterations == CONVERGED["iterations"]
    assert early.opt.iterations == 1


def test_a_push_on_no_body_and_a_mass_of_nothing_are_refused(slider):
    with pytest.raises(DraxError, match="has no body 'leg'"):
        Plant(slider, pushes=[Push(0.0, "leg", (1.0, 0.0, 0.0))])
    with pytest.raises(DraxError, match="mass is 0"):
        Plant(slider, mass=0.0)
    with pytest.raises(DraxError, match="no model to simulate"):
        Plant(balance())


def test_random_pushes_are_spread_over_time(slider):
    pushes = random_pushes(slider, 3, 2.0, (1.0, 4.0), seed=5)
    assert [1 <= p.time - i <= 2 for i, p in enumerate(pushes)] == [True] * 3
    assert {abs(p.force[0]) for p in pushes} == {20.0}  # 2 m/s for 1 kg in 0.1 s


def test_random_pushes_are_on_bodies_with_names(slider):
    unnamed = mujoco.MjModel.from_xml_string(SLIDER.replace('name="cart"', ""))
    problem = replace(slider, dynamics=replace(slider.dynamics, mj_model=unnamed))
    with pytest.raises(DraxError, match="no moving body with a name"):
        random_pushes(problem, 1, 2.0, (0.0, 1.0), 0)


def test_a_second_run_goes_on_where_the_first_ended(slider):
    plant, policy = Plant(slider), MPC(slider, chains=2, explorers=0, every=10**6, solver=FAST)
    policy.reset(slider.x_init)
    assert len(loop.simulate(policy, plant, 0.1).controls) == 10
    assert len(loop.simulate(policy, plant, 0.1).controls) == 10


@pytest.mark.parametrize("by", ["data", "time"])
def test_what_a_run_cost_counts_its_own_times(by):
    def off(x, *u, knot):
        target = knot.data if by == "data" else jnp.sin(knot.time)
        return (x[0] - target) ** 2

    problem = from_function(
        f,
        x_init=[0.0, 0.0],
        nu=1,
        dt=DT,
        horizon=5 * DT,
        running_cost=off,
        terminal_cost=off,
        data=jnp.sin if by == "data" else None,
    )
    for begin in (0.0, 1.0):
        times = begin + DT / 2 * np.arange(61)  # the plant takes two steps for each control
        states = np.stack([np.sin(times), 0 * times], axis=1)
        motion = loop.Motion(
            times, states, np.zeros((60, 1)), None, None, (), np.zeros((60, 0)), 0.0
        )
        assert loop._driven(SimpleNamespace(original=problem), motion)[0] < 1e-9
        motion.states[:, 0] += 0.1
        cost, _ = loop._driven(SimpleNamespace(original=problem), motion)
        assert cost == pytest.approx(31 * 0.01, rel=1e-3)


def test_ctrl_c_in_the_first_solve_ends_the_program(slider, monkeypatch):
    policy = MPC(slider, chains=2, explorers=0, solver=FAST)
    stopped = SimpleNamespace(run=lambda: SimpleNamespace(interrupted=True))
    monkeypatch.setattr(mpc, "Search", lambda *_, **__: stopped)
    with pytest.raises(KeyboardInterrupt):
        policy.reset(slider.x_init)


def test_pushes_and_plant_have_the_model_of_a_problem_with_rates():
    problem = robot(rates=1, running_cost=lambda data, u, knot: knot.rate @ knot.rate)
    push = random_pushes(problem, 1, 2.0, (0.0, 1.0), seed=0)[0]
    assert Plant(problem, pushes=[push]).model.body(push.body).mass > 0.0


def test_pushes_need_a_model():
    with pytest.raises(DraxError, match="no model to simulate"):
        random_pushes(double_integrator(running_cost=lambda x, u: u @ u), 1, 2.0, (0.0, 1.0), 0)


@pytest.mark.slow
def test_trials_in_the_loop_recover_and_are_summed_up(slider):
    policy = MPC(slider, chains=2, explorers=0, hold=1.0, solver=FAST)
    policy.reset(slider.x_init)
    trials = loop.Trials(policy, 5.5, False).run(2, 1, 1.0, mass=1.2)
    numbers = trials.summary()
    assert numbers["success_rate"] == 1.0
    assert numbers["plans_per_s"] > 0.0
    assert set(numbers["latency_s"]) == {"p50", "p90", "p99"}
    assert numbers["cost"] > 0.0
    json.dumps(numbers)
    assert "2 of 2 end in the goal" in "\n".join(loop.lines(numbers))
    with pytest.raises(DraxError, match="leaves no time for pushes"):
        loop.Trials(policy, 2.0, False).run(1, 1, 1.0)
    policy.rewind()
    motion = loop.simulate(policy, Plant(slider), 0.4, realtime=True)
    assert motion.states.shape == (41, 2)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [[], ["--async"]])
def test_a_cartpole_swings_up_and_bears_pushes(mode, tmp_path, capsys):
    status = main(
        ["mpc", "cartpole", "--chains", "4", "--runs", "2", "--out", str(tmp_path), *mode]
    )
    numbers = json.loads((tmp_path / "mpc.json").read_text())
    assert "plans/s" in capsys.readouterr().out
    assert numbers["runs"] == 2
    assert numbers["horizon"] == 100
    if not mode:  # in real time it depends on the computer
        assert status == 0
        assert numbers["success_rate"] == 1.0


def test_the_command_drives_a_model_by_a_cost_file(tmp_path, capsys):
    (tmp_path / "slider.xml").write_text(SLIDER)
    cost = """
    horizon, dt, x_init = 0.6, 0.02, [0.1, 0.0]
    def running_cost(data, u): return 1e-2 * u[0] ** 2
    def terminal_residual(data): return 10.0 * jnp.append(data.qpos, data.qvel)
    def goal(data): return abs(data.qpos[0]) < 0.02
    """
    (tmp_path / "cost.py").write_text("import jax.numpy as jnp\n" + textwrap.dedent(cost))
    mine = ["--model", str(tmp_path / "slider.xml"), "--cost", str(tmp_path / "cost.py")]
    few = ["--chains", "2", "--runs", "1", "--pushes", "0", "--duration", "3"]
    assert main(["mpc", *mine, *few, "--out", str(tmp_path)]) == 0
    assert "slider: K = 30 knots, 2 chains" in capsys.readouterr().out
    assert json.loads((tmp_path / "mpc.json").read_text())["success_rate"] == 1.0
    assert main(["mpc", "cartpole", *mine]) == 2
    assert "both the task 'cartpole' and --model or --cost" in capsys.readouterr().err
    assert main(["mpc"]) == 2


def test_the_command_refuses_before_it_compiles(capsys):
    assert main(["mpc", "cartpole", "--mass", "0"]) == 2
    assert "mass is 0" in capsys.readouterr().err
    assert main(["mpc", "cartpole", "--pushes", "-1"]) == 2
    assert main(["mpc", "bug_trap"]) == 2
    assert "no model to simulate" in capsys.readouterr().err


@pytest.mark.slow
def test_what_a_run_breaks_and_what_no_plan_keeps_is_told():
    problem = from_mjcf(
        SLIDER,
        horizon=0.5,
        dt=0.02,
        x_bounds=([-0.3, -9.0], [9.0, 9.0]),
        running_residual=lambda data, u: 0.1 * u,
        inequality=lambda data, u: data.qpos - 0.1,
        terminal_equality=lambda data: data.qpos - 99.0,
    )
    policy = MPC(problem, chains=2, explorers=0, solver=FAST)
    with pytest.warns(DraxWarning, match="no plan of the first solve is feasible"):
        policy.reset(problem.x_init)
    times = 0.02 * np.arange(31)
    states = np.zeros((31, 2))
    states[20, 0], states[25, 0] = 0.35, -0.7
    statistics = mpc.Statistics([0.1] * 3, [0.0] * 3, [1e-6, 2e-3, 5.0], plans=3, infeasible=2)
    of_plant = times, states, np.zeros((30, 1))
    motion = loop.Motion(*of_plant, statistics, True, [], np.zeros((30, 0)), 0.002)
    numbers = loop.Trials(policy, 0.6, True, [motion]).summary()
    assert numbers["broken"] == pytest.approx({"inequality": 0.25, "state bounds": 0.4}, rel=1e-5)
    assert numbers["infeasible_plans"] == 2
    said = "\n".join(loop.lines(numbers))
    assert "0 failed, 2 infeasible" in said
    assert "broken    inequality by 0.25, state bounds by 0.4, at most" in said
    assert "in real time, 2.0 ms behind the clock at most" in said


def test_a_goal_is_asked_at_the_time_of_the_plant(slider):
    asked = []

    def late(data):
        asked.append(data.time)
        return data.time > 2.5

    policy = MPC(replace(slider, goal=late), chains=2, explorers=0, every=10**6, solver=FAST)
    policy.reset(slider.x_init)
    trials = loop.Trials(policy, 3.0, False).run(1, 0, 1.0)
    assert asked[-1] == pytest.approx(3.0)
    numbers = trials.summary()
    assert numbers["success_rate"] == 1.0
    assert numbers["plans"] == 0  # no time for a further one, and nothing fails
    assert numbers["plans_per_s"] is None
    assert "no further plans" in "\n".join(loop.lines(numbers))


def test_a_polish_needs_no_tail():
    problem = balance(inequality=lambda x, u: x[:1] - 9.0)
    MPC(problem, iterations=FAST.flow.tail + 1, solver=FAST)
    with pytest.raises(DraxError, match="iterations is 31, but the solver's tail has 30"):
        MPC(balance(), iterations=FAST.flow.tail + 1, solver=FAST)
