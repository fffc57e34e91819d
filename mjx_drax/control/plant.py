"""The system that a policy drives: MuJoCo's C engine, which may differ from the planner's model.

It may be heavier than the model says, be pushed, shaken, and measured with noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, is_number, require_not_negative, require_positive, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.physics.c_engine.states import Floats, converged, integrate, set_state
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.source import index
from mjx_drax.problem.problem import Problem, require_problem

LASTS = 0.1
"""How long a push lasts [s], unless it says otherwise."""


@dataclass(frozen=True)
class Push:
    """A force on a body.

    Attributes:
        time: when it begins [s].
        body: name of the body, whose center of mass is pushed.
        force: in the world's frame, (3,) [N].
        lasts: how long [s].
    """

    time: float
    body: str
    force: tuple[float, float, float]
    lasts: float = LASTS


class Plant:
    """MuJoCo's C engine from a problem's x_init, one physics step at a time.

    As in the certificate its contact solver converges, whatever options the model's file has.

    >>> plant = mjx_drax.Plant(problem, mass=1.1, pushes=[mjx_drax.Push(2.0, "pole", (5, 0, 0))])
    >>> while plant.time < 5.0:
    ...     plant.step(policy(plant.measured(), plant.time))
    """

    def __init__(
        self,
        problem: Problem,
        *,
        mass: float = 1.0,
        noise: float = 0.0,
        shaking: float = 0.0,
        pushes: Sequence[Push] = (),
        seed: int = 0,
    ) -> None:
        """At rest in time; the problem's own model stays as it is.

        Args:
            problem: from `from_mjcf`.
            mass: factor on all masses and inertias, which the planner does not know of.
            noise: standard deviation of every entry of a measured state, in tangent space.
            shaking: standard deviation of random changes of velocities in one second.
            pushes: forces on bodies.
            seed: of noise and shaking.

        Raises:
            DraxError: a problem without a model, an unknown body, numbers that make no sense.
        """
        model = _model_of(problem)
        require_not_negative("noise", noise)
        require_not_negative("shaking", shaking)
        require_positive("mass", mass, "a positive factor, 1 for no error")
        if not isinstance(pushes, Sequence) or isinstance(pushes, str):
            raise DraxError(f"pushes are {shown(pushes)}: give a list of Push.")
        for push in pushes:
            _require_push(push)
        self.model: mujoco.MjModel = converged(model)
        self.model.body_mass[:] *= mass
        self.model.body_inertia[:] *= mass
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)
        start = np.asarray(problem.x_init, float)[: problem.dynamics.given_nx]
        set_state(self.model, self.data, start)
        self.noise, self.shaking = noise, shaking
        self._pushes = [(p, index(self.model, "body", p.body)) for p in pushes]
        self._random = np.random.default_rng(seed)

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return float(self.data.time)

    @property
    def state(self) -> Floats:
        """x (nx,), as it is."""
        return np.concatenate([self.data.qpos, self.data.qvel, self.data.act])

    def measured(self) -> Floats:
        """x (nx,) with noise."""
        if self.noise == 0.0:
            return self.state
        off = self.noise * self._random.standard_normal(2 * self.model.nv + self.model.na)
        return integrate(self.model, self.state, off)

    def step(self, u: Floats) -> None:
        """One physics step under a control (nu,).

        Raises:
            DraxError: u is no vector (nu,) of finite numbers, of which MuJoCo would start anew.
        """
        data, model = self.data, self.model
        control = _finite(u, model.nu)
        if control is None:
            raise DraxError(f"the control u is {shown(u)}: give {model.nu} finite numbers.")
        data.ctrl[:] = control
        data.xfrc_applied[:] = 0.0
        for push, body in self._pushes:
            if push.time <= self.time + 1e-9 < push.time + push.lasts:
                data.xfrc_applied[body, :3] += push.force
        if self.shaking > 0.0:
            root = self.shaking * np.sqrt(model.opt.timestep)
            data.qvel += root * self._random.standard_normal(model.nv)
        mujoco.mj_step(model, data)


def _finite(value: ArrayLike, size: int) -> Floats | None:
    """Finite numbers (size,); None for what is something else."""
    try:
        found = numbers(value)
    except (TypeError, ValueError):
        return None
    return found if found.shape == (size,) and np.isfinite(found).all() else None


def _require_push(push: object) -> None:
    if not isinstance(push, Push):
        raise DraxError(f"a push is {shown(push)}: give a Push(time, body, force).")
    if _finite(push.force, 3) is None:
        raise DraxError(f"the force of a push is {shown(push.force)}: give 3 finite numbers [N].")
    if not all(is_number(seconds) and seconds >= 0 for seconds in (push.time, push.lasts)):
        raise DraxError(
            f"a push begins at {shown(push.time)} and lasts {shown(push.lasts)}: give seconds, 0 "
            "or more."
        )


def _model_of(problem: Problem) -> mujoco.MjModel:
    """The problem's model.

    Raises:
        DraxError: it has none.
    """
    require_problem(problem)
    model = mujoco_model(problem.dynamics)
    if model is None:
        raise DraxError(
            f"{problem.name} has no model to simulate: use from_mjcf, or one of the tasks that "
            '`mjx-drax list` calls "from MJCF".'
        )
    return model


def random_pushes(
    problem: Problem, count: int, size: float, over: tuple[float, float], seed: int
) -> list[Push]:
    """Pushes on random moving bodies, that have a name, along the world's x axis to either side.

    Args:
        problem, count, seed: of how many pushes on the model of which problem.
        size: momentum of each, as a velocity [m/s] of the body it acts on.
        over: between which times [s]; one falls into each of `count` equal parts.
    """
    model = _model_of(problem)
    random = np.random.default_rng(seed)
    movable = np.flatnonzero((model.body_weldid != 0) & (model.body_mass > 0.0))
    movable = np.array([body for body in movable if model.body(body).name], int)
    if not movable.size:
        raise DraxError(f"{problem.name} has no moving body with a name: give one a name.")
    edges = np.linspace(*over, count + 1)
    pushes = []
    for begin, end in pairwise(edges):
        body = int(random.choice(movable))
        force = float(random.choice([-1.0, 1.0]) * size * model.body_mass[body] / LASTS)
        time = float(random.uniform(begin, end))
        pushes.append(Push(time, model.body(body).name, (force, 0.0, 0.0)))
    return pushes
