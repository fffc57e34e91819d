"""A task for any model: reach a posture that its actuators can bring it to, from its default state.

The posture is where MuJoCo's C engine ends under smooth random controls within the model's limits,
so it can be reached in the time that is given, if only passed through.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.modelling.terms import Terms
from mjx_drax.physics.actuators import control_ranges
from mjx_drax.physics.checks import checked_start
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjcf import from_mjcf, steps_between_knots
from mjx_drax.physics.mjx_model import free_ranges
from mjx_drax.physics.source import load, model_name
from mjx_drax.physics.states import Engine, between
from mjx_drax.problem.problem import Problem

NEAR = 0.02
"""Largest |qpos - posture|, in tangent space [rad, m], that reaches it."""

SHORTEST, NODES, DRAWS, SHRINK = 5, 4, 20, 0.7
"""Knots of a motion at least; random controls that each is led through; motions that are tried, and
what is left of the controls from each to the next."""


def reach(
    source: str | Path | mujoco.MjModel,
    seed: int = 0,
    horizon: float = 0.3,
    name: str | None = None,
) -> Problem:
    """Reach a random posture at the end of the horizon with little control.

    Args:
        source: MJCF file, XML string or `mujoco.MjModel`.
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
    path = _motion(model, name, x_init, bounded, steps, max(SHORTEST, round(horizon / dt)), seed)
    target = path[-1, : model.nq]
    on = Terms(model)
    half = np.maximum(0.5 * (limits[1] - limits[0]), 1e-6)

    def goal(data: mujoco.MjData) -> bool:
        return bool(np.abs(between(model, target, data.qpos)).max() < NEAR)

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
    """States (K + 1, nx), K <= knots, of the motion that stays in the joints' ranges longest."""
    engine, rng, limits = Engine(model), np.random.default_rng(seed), control_ranges(model)
    where = model.jnt_qposadr[bounded]
    lower, upper = (end[bounded] for end in free_ranges(model))
    best, rest = x_init[None], np.clip(0.0, *limits)
    for draw in range(DRAWS):
        nodes = rest + SHRINK**draw * (rng.uniform(*limits, (NODES, model.nu)) - rest)
        at = np.linspace(0, NODES - 1, knots)
        controls = [np.interp(at, np.arange(NODES), column) for column in nodes.T]
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
    if len(best) <= SHORTEST:
        raise DraxError(
            f"{name} leaves the ranges of its joints within {SHORTEST} knots under any of {DRAWS} "
            "random controls: give it a keyframe from which it can move."
        )
    return best
