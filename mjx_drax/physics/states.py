"""States of a model on the host, in float64, by MuJoCo's own functions.

x = [qpos (nq), qvel (nv), act (na)]; tangent vectors are [dq (nv), dv (nv), da (na)], and dq turns
quaternions in their own frame. `joints` is the same arithmetic in JAX.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from mjx_drax.physics._mujoco import mujoco

Floats = npt.NDArray[np.floating]


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep MuJoCo from printing warnings, and from writing MUJOCO_LOG.TXT where the user stands."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


def finite(states: Floats) -> Floats:
    """The states (T, ...) of a replay, up to the first that is not finite."""
    return states[: int(np.cumprod(np.isfinite(states).all(axis=1)).sum())]


def set_state(model: mujoco.MjModel, data: mujoco.MjData, x: Floats) -> None:
    """Write x (nx,) into the C engine's data."""
    data.qpos[:], data.qvel[:], data.act[:] = np.split(x, [model.nq, model.nq + model.nv])


def between(model: mujoco.MjModel, one: Floats, other: Floats) -> Floats:
    """The tangent vector (nv,) that leads from one position (nq,) to the other."""
    out = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, out, 1.0, one, other)
    return out


def moved(model: mujoco.MjModel, qpos: Floats, dq: Floats, by: float = 1.0) -> Floats:
    """The position (nq,) reached from qpos along the tangent vector dq (nv,), a multiple of it."""
    out = np.array(qpos, float)
    mujoco.mj_integratePos(model, out, dq, by)
    return out


def difference(model: mujoco.MjModel, x: Floats, y: Floats) -> Floats:
    """x - y in the tangent space at y, (ndx,), for states (nx,)."""
    if model.nq == model.nv:
        return x - y
    nq = model.nq
    return np.concatenate([between(model, y[:nq], x[:nq]), x[nq:] - y[nq:]])


def integrate(model: mujoco.MjModel, x: Floats, dx: Floats) -> Floats:
    """x + dx, the state (nx,) reached from x along the tangent vector dx (ndx,)."""
    nq, nv = model.nq, model.nv
    return np.concatenate([moved(model, x[:nq], dx[:nv]), x[nq:] + dx[nv:]])


def interpolated(model: mujoco.MjModel, qpos: Floats, times: Floats, time: float) -> Floats:
    """Position (nq,) at a time [s], at constant velocity between qpos (T, nq) at rising times (T,).

    Before the first time and after the last it is held.
    """
    time = float(np.clip(time, times[0], times[-1]))
    last = int(np.searchsorted(times, time, side="right")) - 1
    if last == len(times) - 1:
        return qpos[last]
    share = (time - times[last]) / (times[last + 1] - times[last])
    return moved(model, qpos[last], between(model, qpos[last], qpos[last + 1]), share)
