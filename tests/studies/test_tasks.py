"""Tasks and models: they load and are built, stand or hover, and obstacles are real in MuJoCo."""

import functools
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest

from mjx_drax import tasks
from mjx_drax.models import path
from mjx_drax.tasks.quadrotor import BARS, GATES, MARGIN, OPEN, funnels

SIZES = {  # nq, nv, nu and K
    "double_pendulum_swingup": (3, 3, 1, 150),
    "quadrotor_planar": (3, 3, 2, 100),
    "car_bug_trap": (3, 3, 2, 119),
    "car_deep_trap": (3, 3, 2, 140),
    "arm_reach": (7, 7, 7, 50),
    "quadrotor": (7, 6, 4, 100),
    "hopper_jump": (6, 6, 3, 60),
    "box_push": (5, 5, 2, 50),
    "quadruped_step": (19, 18, 12, 60),
    "humanoid_stand": (28, 27, 21, 60),
}
TOUCHING = ("hopper_jump", "box_push", "quadruped_step", "humanoid_stand")
AGAINST = {  # the controls drive straight into an obstacle, after so many steps
    "quadrotor_planar": ({"qpos": [-2.0, 1.0, -0.3]}, [2.6, 2.6], 100),
    "car_bug_trap": ({}, [1.0, 1.0], 100),
    "car_deep_trap": ({}, [1.0, 1.0], 100),
    "arm_reach": ({}, [0.2, -0.25, 0.0, -0.13, 0.0, 0.0, 0.0], 200),
}


def model(name):
    return mujoco.MjModel.from_xml_path(str(path(name)))


def started(model):
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    return data


@functools.cache
def problem_of(name):
    return tasks.load(name).make()


@pytest.mark.parametrize("name", SIZES)
def test_is_built_with_its_sizes_and_starts_short_of_its_goal(name):
    problem = problem_of(name)
    host = problem.dynamics.mj_model
    assert (host.nq, host.nv, host.nu, problem.horizon) == SIZES[name]
    assert problem.reached(np.asarray(problem.x_init, float)) is False
    assert problem.dynamics.kinked == (name in TOUCHING)


@pytest.mark.parametrize("name", ["quadrotor_planar", "quadrotor", "arm_reach"])
def test_start_is_clear(name):
    problem = problem_of(name)
    u = np.zeros(problem.dynamics.nu)
    values = jax.jit(lambda x: problem.constraint(problem.dynamics.observe(x, u), u))
    assert np.all(np.asarray(values(problem.x_init)) <= 0)


@pytest.mark.parametrize("name", AGAINST)
def test_obstacles_stop_in_the_c_engine_what_runs_into_them(name):
    problem = problem_of(name)
    host = problem.dynamics.mj_model
    start, control, steps = AGAINST[name]
    data = started(host)
    for key, value in start.items():
        getattr(data, key)[:] = value
    data.ctrl[:] = control
    mujoco.mj_forward(host, data)
    assert data.ncon == 0
    touched = False
    for _ in range(steps):
        mujoco.mj_step(host, data)
        touched |= data.ncon > 0
    assert touched


@pytest.mark.parametrize("name", ["quadrotor", "quadruped", "humanoid"])
def test_stands_or_hovers_under_a_constant_control(name):
    host = model(name)
    data = started(host)
    data.ctrl[:] = host.key_ctrl[0] if host.nkey else 9.81 / 4
    height = data.qpos[2]
    mujoco.mj_step(host, data, 200)
    assert abs(data.qpos[2] - height) < 0.03
    assert data.xmat[1, 8] > 0.99
    assert np.abs(data.qvel).max() < 0.2


@pytest.mark.parametrize("name", ["hopper", "box_push", "quadruped", "humanoid"])
def test_only_the_pairs_that_matter_can_touch(name):
    host = model(name)
    touching = {g for g in range(host.ngeom) if host.geom_contype[g] or host.geom_conaffinity[g]}
    kinds = {mujoco.mjtGeom(host.geom_type[g]) for g in touching}
    plane, sphere = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE
    assert kinds == {sphere, mujoco.mjtGeom.mjGEOM_BOX if name == "box_push" else plane}
    assert not any(host.geom_contype[g] and host.geom_conaffinity[g] for g in touching)


def test_clearances_are_those_of_mujoco():
    """Of the quadrotor, against mj_geomDistance, wherever it is."""
    problem = problem_of("quadrotor")
    host, u = problem.dynamics.mj_model, np.zeros(problem.dynamics.nu)
    clearance = jax.jit(lambda x: problem.constraint(problem.dynamics.observe(x, u), u))
    data, rng = started(host), np.random.default_rng(0)
    hull, bars = host.geom("hull").id, [host.geom(name).id for name in BARS]
    assert set(bars) == set(np.flatnonzero((host.geom_bodyid == 0) & (host.geom_contype != 0)))
    for _ in range(20):
        data.qpos[:3] = rng.uniform([-3, -1.5, 0.3], [3, 1.5, 2.5])
        mujoco.mj_forward(host, data)
        rows = np.asarray(clearance(np.concatenate([data.qpos, data.qvel])))
        ours = MARGIN - rows[: len(BARS)]
        theirs = [mujoco.mj_geomDistance(host, data, hull, g, 10.0, None) for g in bars]
        apart = np.array(theirs) > 0  # inside, MuJoCo's is another measure
        assert np.abs(ours - theirs)[apart].max(initial=0) < 1e-4


def test_funnels_lead_through_the_gates():
    """In a gate's plane only its middle is free; far from it all is."""
    for gate, middle in enumerate(GATES):
        for off, inside in ((0.0, True), (0.9 * OPEN, True), (1.1 * OPEN, False)):
            position = np.add(middle, [0.0, 0.0, off])
            data = SimpleNamespace(qpos=np.append(position, [1, 0, 0, 0]))
            assert (np.asarray(funnels(data, None))[gate] <= 0) == inside
    data = SimpleNamespace(qpos=np.array([0.0, 2.0, 3.0, 1, 0, 0, 0]))
    assert (np.asarray(funnels(data, None)) < 0).all()
