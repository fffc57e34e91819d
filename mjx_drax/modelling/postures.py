"""A task for any model: reach a posture from its default state.

In the posture MuJoCo's C engine ends under smooth random controls within the model's limits, so it
can be reached in the given time, though perhaps not held.
"""

from __future__ import annotations

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.modelling.terms import Terms
from mjx_drax.physics.actuators import control_ranges
from mjx_drax.physics.agreement.checks import checked_start
from mjx_drax.physics.c_engine.states import Engine, between
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjcf import from_mjcf, steps_between_knots
from mjx_drax.physics.mjx_model import free_ranges
from mjx_drax.physics.source import Given, load, model_name
from mjx_drax.problem.problem import Problem

TOLERANCE = 0.02
"""Largest |qpos - posture|, in tangent space [rad, m], that counts as reached."""

LEAST_KNOTS, RANDOM_CONTROLS, TRIALS, SHRINK = 5, 4, 20, 0.7
"""Least knots of a motion; random controls that a motion interpolates; most motions that are tried;
and the factor on the controls from each of these to the next."""


def reach(
    source: Given,
    seed: int = 0,
    horizon: float = 0.3,
    name: str | None = None,
) -> Problem:
    """Reach a random posture at the end of the horizon with little control.

    Args:
        source: MJCF file, XML string, `mujoco.MjSpec` or `mujoco.MjModel`.
        seed: of the posture.
        horizon: duration [s]; shorter where motions leave the ranges of joints before its end.
        name: by default the model's.

    Raises:
        DraxError: the model cannot be used, or no motion stays within the ranges of its joints.
    """
    model = load(source)
    name = name or model_name(model)
    x_init, bounded = checked_start(model, name)
    steps = steps_between_knots(model, None)
    dt, limits = steps * model.opt.timestep, control_ranges(model)
    path = _motion(model, name, x_init, bounded, steps, max(LEAST_KNOTS, round(horizon / dt)), seed)
    target = path[-1, : model.nq]
    on = Terms(model)
    half = np.maximum(0.5 * (limits[1] - limits[0]), 1e-6)

    def goal(data: mujoco.MjData) -> bool:
        return bool(np.abs(between(model, target, data.qpos)).max() < TOLERANCE)

    return from_mjcf(
        model,
        horizon=dt * (len(path) - 1),
        running_residual=on.control(weight=1e-3 / half**2),
        terminal_residual=on.posture(target, weight=1e3),
        u_bounds=limits,
        goal=goal,
        name=name,
    )


def _motion(
    model: mujoco.MjModel,
    name: str,
    x_init: np.ndarray,
    bounded: np.ndarray,
    steps: int,
    knots: int,
    seed: int,
) -> np.ndarray:
    """States (K + 1, nx), K <= knots, of the motion that stays longest in the ranges of joints."""
    engine, rng, limits = Engine(model), np.random.default_rng(seed), control_ranges(model)
    where = model.jnt_qposadr[bounded]
    lower, upper = (end[bounded] for end in free_ranges(model))
    best, rest = x_init[None], np.clip(0.0, *limits)
    for trial in range(TRIALS):
        nodes = rest + SHRINK**trial * (rng.uniform(*limits, (RANDOM_CONTROLS, model.nu)) - rest)
        at = np.linspace(0, RANDOM_CONTROLS - 1, knots)
        controls = [np.interp(at, np.arange(RANDOM_CONTROLS), column) for column in nodes.T]
        path = [x_init]
        for u in np.stack(controls, axis=1):
            x = engine.step(path[-1], u, steps)
            inside = np.all((x[where] > lower) & (x[where] < upper))
            if not (inside and np.isfinite(x).all()):
                break
            path.append(x)
        if len(path) > len(best):
            best = np.stack(path)
        if len(best) > knots:
            return best
    if len(best) <= LEAST_KNOTS:
        raise DraxError(
            f"{name} leaves the ranges of its joints within {LEAST_KNOTS} knots under any of "
            f"{TRIALS} random controls: give it a keyframe from which it can move."
        )
    return best
