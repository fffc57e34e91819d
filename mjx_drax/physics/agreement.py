"""How far the MJX twin of a model is from MuJoCo's C engine: one step, and its derivatives.

Both take one physics step in float64 from the same states. What differs beyond rounding is what a
plan will be wrong about, and what the certificate would find only after a solve.
"""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, DraxWarning
from mjx_drax.physics import states as host
from mjx_drax.physics import step as physics
from mjx_drax.physics._mujoco import mujoco
from mjx_drax.physics.joints import Joints
from mjx_drax.physics.mjx_model import control_ranges, differences, free_ranges, twin

WRONG, NOTICEABLE = 1e-2, 1e-6
"""One-step errors of velocities [rad/s, m/s] above which a model is refused, or warned of."""

MOMENTS = (0.05, 0.2, 0.6)
"""Times [s] of the states that the C engine is compared at, along a motion from x_init."""

NUDGE, SPEED = 0.02, 0.5
"""Spreads of the positions [rad, m] and velocities of a state near x_init."""


@dataclass(frozen=True)
class Probes:
    """States (n, nx) and controls (n, nu) at which the engines are compared."""

    x: np.ndarray
    u: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """What a comparison found.

    Attributes:
        velocity: largest error of qvel after one step, (n,) [rad/s, m/s]; x_init comes first.
        jacobian: largest error of an entry of [df/dx df/du] at x_init, in tangent space, relative
            to the largest entry; NaN if it was not asked for. Where f has a kink, as at a limit, a
            column counts as right that is the derivative to one side.
    """

    velocity: np.ndarray
    jacobian: float = np.nan


class Engine:
    """Single steps of the C engine, x = [qpos, qvel, act], with constraints solved to rounding."""

    def __init__(self, model: mujoco.MjModel, contacts: bool | int = True) -> None:
        self.model = copy.deepcopy(model)
        self.model.opt.tolerance, self.model.opt.iterations = 0.0, 200
        self.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        if not contacts:
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def step(self, x: np.ndarray, u: np.ndarray, steps: int = 1) -> np.ndarray:
        """The state (nx,) some steps after x (nx,) under u (nu,)."""
        model, data = self.model, mujoco.MjData(self.model)
        host.set_state(model, data, x)
        data.ctrl[:] = u
        with host.quiet():
            mujoco.mj_step(model, data, steps)
        return np.concatenate([data.qpos, data.qvel, data.act])

    def touching(self, x: np.ndarray) -> int:
        """Contacts that act at x (nx,), of the friction dimension that has the most."""
        data = mujoco.MjData(self.model)
        host.set_state(self.model, data, x)
        with host.quiet():
            mujoco.mj_forward(self.model, data)
        acting = data.contact.dim[data.contact.efc_address >= 0]
        return int(np.bincount(acting, minlength=1).max())

    def jacobian(self, x: np.ndarray, u: np.ndarray, eps: float = 1e-6) -> np.ndarray:
        """[df/dx df/du] (ndx, ndx + nu) by central differences in tangent space."""
        return self.slopes(x, u, eps).mean(axis=0)

    def slopes(self, x: np.ndarray, u: np.ndarray, eps: float = 1e-6) -> np.ndarray:
        """The same by differences to either side, (2, ndx, ndx + nu)."""
        reached, ndx = self.step(x, u), 2 * self.model.nv + self.model.na

        def moved(dz: np.ndarray) -> np.ndarray:
            end = self.step(host.integrate(self.model, x, dz[:ndx]), u + dz[ndx:])
            return host.difference(self.model, end, reached)

        nudges = eps * np.eye(ndx + self.model.nu)
        sides = [[sign * moved(sign * e) / eps for e in nudges] for sign in (1.0, -1.0)]
        return np.swapaxes(sides, 1, 2)


def probes(engine: Engine, x_init: np.ndarray, bounded: np.ndarray, seed: int = 0) -> Probes:
    """x_init, a state near it, and states along a motion under constant random controls.

    Args:
        engine: which makes the motion.
        x_init: (nx,).
        bounded: joints whose positions are clipped to their ranges, (njnt,).
        seed: of the random numbers.
    """
    model, rng = engine.model, np.random.default_rng(seed)
    nv, scale = model.nv, np.zeros(2 * model.nv + model.na)
    scale[:nv], scale[nv : 2 * nv] = NUDGE, SPEED
    u = rng.uniform(*control_ranges(model), (2 + len(MOMENTS), model.nu))
    x = [x_init, host.integrate(model, x_init, scale * rng.normal(size=scale.shape))]
    for moment, control in zip(MOMENTS, u[2:], strict=True):
        x.append(engine.step(x_init, control, max(1, round(moment / model.opt.timestep))))
    states, where = np.stack(x), model.jnt_qposadr[bounded]
    lower, upper = free_ranges(model)
    states[:, where] = np.clip(states[:, where], lower[bounded], upper[bounded])
    usable = np.isfinite(states).all(axis=1)
    return Probes(states[usable], u[usable])


def compare(
    model: mujoco.MjModel,
    at: Probes,
    contacts: bool | int = True,
    bounded: np.ndarray | None = None,
    derivatives: bool = False,
) -> Agreement:
    """Compare one step of MJX with one of the C engine. Compiles the step.

    Args:
        model: which is not changed.
        at: states, x_init first, and controls.
        contacts, bounded: as for `twin`.
        derivatives: whether to compare them as well, at x_init.

    Raises:
        DraxError: MJX does not support the model.
    """
    engine, joints, nv = Engine(model, contacts), Joints.of(model), model.nv
    ndx = 2 * nv + model.na
    with jax.enable_x64(True):
        on_device = twin(model, contacts, bounded)

        def reached(x: Array, u: Array) -> Array:
            return physics.step(on_device, x, u)

        def slope(x: Array, u: Array) -> tuple[Array, Array]:
            end = reached(x, u)

            def moved(dz: Array) -> Array:
                near = reached(joints.integrate(x, dz[:ndx]), u + dz[ndx:])
                return joints.difference(near, end)

            return end, jax.jacfwd(moved)(jnp.zeros(ndx + model.nu))

        x, u = jnp.asarray(at.x), jnp.asarray(at.u)
        if derivatives:
            ends, slopes = jax.tree.map(np.asarray, jax.jit(jax.vmap(slope))(x, u))
        else:
            ends = np.asarray(jax.jit(jax.vmap(reached))(x, u))
    wanted = np.stack([engine.step(*pair) for pair in zip(at.x, at.u, strict=True)])
    velocities = slice(model.nq, model.nq + nv)
    error = np.abs(ends - wanted)[:, velocities].max(axis=1)
    if not derivatives:
        return Agreement(error)
    sides = engine.slopes(at.x[0], at.u[0])
    exact = np.stack([sides.mean(axis=0), *sides])
    off = np.abs(slopes[0] - exact).max(axis=1).min(axis=0)  # of each column
    return Agreement(error, float(off.max() / np.abs(exact[0]).max()))


def require(
    model: mujoco.MjModel,
    name: str,
    x_init: np.ndarray,
    contacts: bool | int,
    bounded: np.ndarray,
) -> None:
    """Refuse or warn of a model that MJX is known to compute differently, if it does so.

    Only models with `differences` are compared, because that compiles their step.

    Raises:
        DraxError: velocities after one step differ by more than `WRONG`.
    """
    found = differences(model, contacts)
    if not found:
        return
    at = probes(Engine(model, contacts), x_init, bounded)
    error = float(np.max(compare(model, at, contacts, bounded).velocity))
    words = (
        f"one step of MJX differs from MuJoCo's C engine by {error:.1e} in the velocities of "
        f"{name}: {'; '.join(found)}"
    )
    if not error <= WRONG:
        raise DraxError(f"{words}.")
    if error > NOTICEABLE:
        warnings.warn(f"{words}.", DraxWarning, stacklevel=3)


def require_near(
    model: mujoco.MjModel, name: str, x_init: np.ndarray, kept: int | None, bounded: np.ndarray
) -> None:
    """Warn where more contacts act than a plan keeps; `kept` are of each friction dimension.

    What is left out has no force in the plan, and the certificate would find that out later.
    """
    if kept is None:
        return
    engine = Engine(model)
    at = probes(engine, x_init, bounded).x
    most = max(engine.touching(x) for x in at)
    if most > kept:
        warnings.warn(
            f"{engine.touching(x_init)} contacts of one friction dimension act at the x_init of "
            f"{name} and up to {most} soon after, of which the plan keeps the nearest {kept}: give "
            f"contacts={most}.",
            DraxWarning,
            stacklevel=3,
        )
