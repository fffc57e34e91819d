"""Initial guesses in state space: `solve(problem, guess=guesses.waypoints(problem, [...]))`.

A path of positions q(t) becomes a trajectory: q_k = q(k dt), velocities by backward differences in
tangent space, v_k = (q_k - q_{k-1}) / dt, and controls by `physics.actuators.inverse_dynamics`,
with the least change from rest, which is the middle of the control bounds (0 where they are
infinite). An actuator with a state, whose force does not depend on u at once, stays at rest, and so
do all actuators at a knot where there is no finite answer: a guess never fails for its controls.

States and controls are clipped to their bounds; activations stay as they are in x_init. Positions
are interpolated by MuJoCo's own functions, which turn quaternions about one axis.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mjx_drax.base.errors import (
    DraxError,
    require_not_negative,
    require_positive,
    require_whole,
    shown,
)
from mjx_drax.base.numbers import numbers
from mjx_drax.physics.actuators import inverse_dynamics, middle_control
from mjx_drax.physics.c_engine.states import between, interpolated, moved
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import BALL, FREE
from mjx_drax.physics.source import index
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

Pose = str | ArrayLike
"""Name of a keyframe, or qpos (nq,)."""


def still(problem: Problem) -> Trajectory:
    """The pose of x_init, held at rest; without a model, x_init and the middle of the controls."""
    if mujoco_model(problem.dynamics) is not None:
        return waypoints(problem, [])
    K, dynamics = problem.horizon, problem.dynamics
    x = np.broadcast_to(problem.x_init, (K, dynamics.nx))
    return _bounded(problem, x, np.broadcast_to(middle_control(problem.bounds), (K, dynamics.nu)))


def waypoints(problem: Problem, poses: Iterable[tuple[float, Pose]]) -> Trajectory:
    """Through poses at given times, [(time [s], pose), ...]; a pose is qpos or a keyframe's name.

    Positions go on a straight line from one to the next, quaternions about one axis, at constant
    speed. The motion starts at x_init at time 0, unless a pose is given for it; the last is held.

    Raises:
        DraxError: a time is negative, not finite or given twice; a pose does not fit the model; the
            problem has no model.
    """
    model = _model(problem)
    given: dict[float, np.ndarray] = {}
    try:
        pairs = [(time, pose) for time, pose in poses]
    except (TypeError, ValueError) as error:
        raise DraxError(f"the poses are {shown(poses)}: give pairs (time [s], pose).") from error
    for time, pose in pairs:
        require_not_negative("time of a waypoint", time)
        if float(time) in given:
            raise DraxError(f"two waypoints are at {time} s: give each its own time.")
        given[float(time)] = _qpos(model, pose)
    given.setdefault(0.0, _qpos(model, problem.x_init[: model.nq]))
    times = sorted(given)
    return _through(problem, np.array(times), np.array([given[t] for t in times]))


def keyframes(
    problem: Problem, names: Sequence[str] | Mapping[float, str] | None = None
) -> Trajectory:
    """Through keyframes of the model: evenly spread in order, or at the times of {time [s]: name}.

    The first is at time 0 and the last at the horizon; a single one is at the horizon. By default
    all of them, in the order of the model. Only their qpos is used.

    Raises:
        DraxError: there are none, or none of that name; the problem has no model.
    """
    model = _model(problem)
    if isinstance(names, Mapping):
        return waypoints(problem, names.items())
    if isinstance(names, str) or not (names is None or isinstance(names, Iterable)):
        raise DraxError(f"names are {shown(names)}: give a list of keyframes, or {{time: name}}.")
    poses: Sequence[Pose] = list(model.key_qpos) if names is None else list(names)
    if not len(poses):
        raise DraxError(f"{problem.name} has no keyframe to go through: add some, or name some.")
    end = float(_elapsed(problem)[-1])
    times = np.linspace(0, end, len(poses)) if len(poses) > 1 else [end]
    return waypoints(problem, zip(times, poses, strict=True))


def path(problem: Problem, qpos: ArrayLike, dt: float | None = None) -> Trajectory:
    """Along a recorded or planned path of positions (T, nq), resampled at the knots.

    Args:
        problem: from a model.
        qpos: the positions, the first at time 0.
        dt: time between them [s]; by default they are stretched over the horizon. A path that ends
            earlier is held there, a longer one is cut.

    Raises:
        DraxError: the path does not fit the model, or dt is not a positive number; the problem has
            no model.
    """
    model = _model(problem)
    try:
        rows = list(numbers(qpos))
    except (TypeError, ValueError) as error:
        raise DraxError(
            f"the path is {shown(qpos)}: give numbers of shape (T, {model.nq})."
        ) from error
    poses = np.array([_qpos(model, row) for row in rows])
    if not len(poses):
        raise DraxError(f"the path is empty: give positions of shape (T, {model.nq}).")
    if dt is None:
        return _through(problem, np.linspace(0, float(_elapsed(problem)[-1]), len(poses)), poses)
    require_positive("dt of the path", dt, "a positive number of seconds")
    return _through(problem, dt * np.arange(len(poses)), poses)


def spread(
    problem: Problem, trajectory: Trajectory, chains: int, seed: int = 0, scale: float = 0.1
) -> Trajectory:
    """A batch (chains, K, ...) about a trajectory: itself, and smoothly perturbed copies.

    To positions, activations and controls random sums of sines are added that are 0 at time 0, and
    to velocities what follows from those of the positions. All stay within the bounds.

    Args:
        problem: whose bounds and scatter box are used.
        trajectory: x (K, nx), u (K, nu).
        chains: how many.
        seed: of the perturbations.
        scale: their standard deviation at the end, in half-widths of the scatter box (in units of
            pi rad for rotations of ball and free joints).

    Raises:
        DraxError: the trajectory has another shape; chains or scale are not positive.
    """
    K, nx, nu = problem.horizon, problem.dynamics.given_nx, problem.dynamics.nu
    if not isinstance(trajectory, Trajectory):
        raise DraxError(f"the trajectory is {shown(trajectory)}: give a Trajectory(x, u).")
    try:
        x, u = numbers(trajectory.x), numbers(trajectory.u)
    except (TypeError, ValueError) as error:
        raise DraxError(f"the trajectory is {shown(trajectory)}: give numbers.") from error
    if x.shape == (K, problem.dynamics.nx):  # further states are found anew
        x = x[:, :nx]
    if x.shape != (K, nx) or u.shape != (K, nu):
        raise DraxError(
            f"the trajectory has shapes {x.shape} and {u.shape}: give x ({K}, {nx}) and "
            f"u ({K}, {nu})."
        )
    require_whole("chains", chains)
    require_whole("seed", seed, 0)
    require_positive("scale", scale)
    rng, box = np.random.default_rng(seed), problem.scatter
    half_x, half_u = (
        scale * np.asarray(high - low, float) / 2
        for low, high in (
            (box.x_lower[..., :nx], box.x_upper[..., :nx]),
            (box.u_lower, box.u_upper),
        )
    )
    model = mujoco_model(problem.dynamics)
    du = half_u * _waves(rng, chains, K, nu)[:, :-1]
    if model is None:
        return _bounded(problem, x + half_x * _waves(rng, chains, K, nx)[:, 1:], u + du)
    turn = _per_dof(model, half_x, scale * np.pi) * _waves(rng, chains, K, model.nv)[:, 1:]
    speed = np.diff(turn, axis=1, prepend=0) / np.diff(_elapsed(problem))[:, None]
    act = half_x[..., model.nq + model.nv :] * _waves(rng, chains, K, model.na)[:, 1:]
    q, rest = np.split(np.broadcast_to(x, (chains, K, nx)), [model.nq], axis=-1)
    turned = [moved(model, *pair) for pair in zip(_rows(q), _rows(turn), strict=True)]
    rest = rest + np.concatenate([speed, act], axis=-1)
    states = np.concatenate([np.reshape(turned, q.shape), rest], axis=-1)
    return _bounded(problem, states, u + du)


def _rows(array: np.ndarray) -> np.ndarray:
    return array.reshape(-1, array.shape[-1])


def _waves(rng: np.random.Generator, chains: int, K: int, size: int) -> np.ndarray:
    """Random functions of the knots 0..K, (chains, K + 1, size); those of the first chain are 0.

    Sums of sin((j - 1/2) pi k / K), j = 1..4, with standard deviations in proportion to 1 / j. At
    k = K the standard deviation of the sum is 1.
    """
    j = np.arange(1, 5)
    weights = rng.normal(size=(chains, 4, size)) / (j * np.linalg.norm(1 / j))[:, None]
    weights[0] = 0
    return np.sin(np.outer(np.arange(K + 1) / K, np.pi * (j - 0.5))) @ weights


def _per_dof(model: mujoco.MjModel, widths: np.ndarray, turn: float) -> np.ndarray:
    """Widths for the entries of qvel (..., nv) from those for x (..., nx); `turn` for rotations."""
    joint = model.dof_jntid
    place = np.arange(model.nv) - model.jnt_dofadr[joint]
    kind = model.jnt_type[joint]
    rotates = (kind == BALL) | ((kind == FREE) & (place >= 3))
    return np.where(rotates, turn, widths[..., model.jnt_qposadr[joint] + place])


def _model(problem: Problem) -> mujoco.MjModel:
    model = mujoco_model(problem.dynamics)
    if model is None:
        raise DraxError(
            f"{problem.name} has no MuJoCo model, so it has no poses: give guess=Trajectory(x, u)."
        )
    return model


def _qpos(model: mujoco.MjModel, pose: Any) -> np.ndarray:
    """qpos (nq,) with unit quaternions, of a keyframe's name or of numbers."""
    if isinstance(pose, str):
        return np.array(model.key_qpos[index(model, "keyframe", pose)])
    try:
        qpos = np.array(numbers(pose))
    except (TypeError, ValueError) as error:
        raise DraxError(
            f"a pose is {shown(pose)}: give qpos, or the name of a keyframe."
        ) from error
    if qpos.shape != (model.nq,) or not np.isfinite(qpos).all():
        raise DraxError(
            f"a pose is {shown(pose)}, of shape {qpos.shape}: give {model.nq} finite numbers."
        )
    mujoco.mj_normalizeQuat(model, qpos)
    return qpos


def _through(problem: Problem, times: np.ndarray, qpos: np.ndarray) -> Trajectory:
    """The trajectory along positions (T, nq) at rising times (T,)."""
    model, elapsed = _model(problem), _elapsed(problem)
    dt = np.diff(elapsed)
    q = np.array([interpolated(model, qpos, times, time) for time in elapsed])
    v = np.array([between(model, *pair) for pair in itertools.pairwise(q)]) / dt[:, None]
    start = np.asarray(problem.x_init, float)[: problem.dynamics.given_nx]
    act = np.broadcast_to(start[model.nq + model.nv :], (problem.horizon, model.na))
    states = np.concatenate([start[None], np.concatenate([q[1:], v, act], axis=1)])
    u = inverse_dynamics(model, states, dt, middle_control(problem.bounds))
    return _bounded(problem, states[1:], u)


def _bounded(problem: Problem, x: np.ndarray, u: np.ndarray) -> Trajectory:
    box, nx = problem.bounds, x.shape[-1]  # without further states
    lower, upper = box.x_lower[..., :nx], box.x_upper[..., :nx]
    return Trajectory(jnp.clip(x, lower, upper), jnp.clip(u, box.u_lower, box.u_upper))


def _elapsed(problem: Problem) -> np.ndarray:
    """Times of x_0..x_K since x_0 (K + 1,) [s]."""
    return np.asarray(problem.times, float) - float(problem.t_init)
