"""States of a model in float64, in numpy as MuJoCo has them, and single steps of its C engine.

x = [qpos (nq), qvel (nv), act (na)]; tangent vectors are [dq (nv), dv (nv), da (na)], and dq turns
quaternions in their own frame. `joints` is the same arithmetic in JAX.
"""

from __future__ import annotations

import contextlib
import copy
import threading
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from mjx_drax.base.meanwhile import Meanwhile
from mjx_drax.physics.contacts.pairs import Contacts, Pair, left_out, of_hulls
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import Joints

Floats = npt.NDArray[np.floating]

_FILTER = threading.RLock()

STOPPED = 10.0
"""Damping times timestep, in inertias, above which a velocity is no state that a model comes to. A
base that is held by a damping of 1e11 would be pushed with as many newtons."""


def _hush() -> Any:
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    return before


quiet = Meanwhile(_hush, mujoco.set_mju_user_warning)
"""Inside of this MuJoCo prints no warnings, and writes no MUJOCO_LOG.TXT into the folder.

It has one handler for all threads."""


def finite(states: Floats) -> Floats:
    """The states (T, ...) of a replay, up to the first that is not finite."""
    return states[: int(np.cumprod(np.isfinite(states).all(axis=1)).sum())]


def stopped_at_once(model: mujoco.MjModel) -> npt.NDArray[np.bool_]:
    """Which velocities damping ends within a timestep, (nv,)."""
    stopped: npt.NDArray[np.bool_] = model.dof_damping * model.opt.timestep > STOPPED * model.dof_M0
    return stopped


def set_state(model: mujoco.MjModel, data: mujoco.MjData, x: Floats) -> None:
    """Write x (nx,) into the C engine's data."""
    nq, nv = model.nq, model.nv
    data.qpos[:], data.qvel[:], data.act[:] = x[:nq], x[nq : nq + nv], x[nq + nv :]


def between(model: mujoco.MjModel, one: Floats, other: Floats) -> Floats:
    """The tangent vector (nv,) that leads from one position (nq,) to the other."""
    out = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, out, 1.0, one, other)
    return out


def moved(model: mujoco.MjModel, qpos: Floats, dq: Floats, by: float = 1.0) -> Floats:
    """The position (nq,) reached from qpos along by * dq, a tangent vector (nv,)."""
    out = np.array(qpos, float)
    mujoco.mj_integratePos(model, out, dq, by)
    return out


def differences(joints: Joints, x: Floats, y: Floats) -> Floats:
    """x - y in the tangent space at y, (n, ndx), for states (n, nx).

    As `mj_differentiatePos` has it, which takes one state at a time, and `Joints.difference`, which
    would be compiled for every number of states.
    """
    parts = [
        _rotations(y[:, q], x[:, q]) if turning else x[:, q] - y[:, q]
        for q, _, turning in joints.parts()
    ]
    return np.concatenate([*parts, x[:, joints.nq :] - y[:, joints.nq :]], axis=1)


def _rotations(p: Floats, q: Floats) -> Floats:
    """The rotation vectors (n, 3) [rad], of length up to pi, that lead from p to q (n, 4)."""
    turn = np.einsum("ijk,nj,nk->ni", _FROM_TO, p, q)
    v = turn[:, 1:]
    sine = np.sqrt(np.einsum("ni,ni->n", v, v))
    angle = 2.0 * np.arctan2(sine, turn[:, 0])
    angle -= 2.0 * np.pi * (angle > np.pi)
    return np.asarray(v * (angle / np.maximum(sine, np.finfo(float).tiny))[:, None])


_FROM_TO = np.zeros((4, 4, 4))
"""Entries of p^-1 q, for quaternions p and q, are sums of _FROM_TO_ijk p_j q_k."""
_FROM_TO[0] = np.eye(4)
for _i, _j, _k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
    _FROM_TO[_i, 0, _i] = _FROM_TO[_i, _k, _j] = 1.0
    _FROM_TO[_i, _i, 0] = _FROM_TO[_i, _j, _k] = -1.0


def difference(model: mujoco.MjModel, x: Floats, y: Floats) -> Floats:
    """The same for one state (nx,), (ndx,)."""
    dq = between(model, y[: model.nq], x[: model.nq])
    return np.concatenate([dq, x[model.nq :] - y[model.nq :]])


def integrate(model: mujoco.MjModel, x: Floats, dx: Floats) -> Floats:
    """x + dx, the state (nx,) reached from x along the tangent vector dx (ndx,)."""
    nq, nv = model.nq, model.nv
    return np.concatenate([moved(model, x[:nq], dx[:nv]), x[nq:] + dx[nv:]])


def interpolated(model: mujoco.MjModel, qpos: Floats, times: Floats, time: float) -> Floats:
    """Position (nq,) at a time [s], at constant velocity between qpos (T, nq) at rising times (T,).

    Before the first time it is the first position, after the last time the last.
    """
    time = float(np.clip(time, times[0], times[-1]))
    last = int(np.searchsorted(times, time, side="right")) - 1
    if last == len(times) - 1:
        return qpos[last]
    share = (time - times[last]) / (times[last + 1] - times[last])
    return moved(model, qpos[last], between(model, qpos[last], qpos[last + 1]), share)


@contextlib.contextmanager
def without(pairs: Collection[Pair]) -> Iterator[None]:
    """Keep the C engine from making contacts between pairs of geoms; of a <pair> it makes them.

    MuJoCo has one filter for all threads, so one thread at a time does this.
    """
    if not pairs:
        yield
        return
    both = {*pairs, *((b, a) for a, b in pairs)}
    with _FILTER:
        before = mujoco.get_mjcb_contactfilter()
        mujoco.set_mjcb_contactfilter(lambda model, data, a, b: (a, b) in both)
        try:
            yield
        finally:
            mujoco.set_mjcb_contactfilter(before)


CONVERGED = {
    "iterations": 200,
    "ls_iterations": 100,
    "tolerance": 1e-12,
    "ls_tolerance": 0.01,
    "ccd_iterations": 200,
    "ccd_tolerance": 1e-10,
}
"""Options at which the C engine's contact solver, Newton's method, ends at the minimum, and its
search for contacts of meshes at the least overlap.

In nine models (humanoids, a dog, walkers, a pushed block) it took at most eleven iterations, and
velocities were within 3e-13 of those after a thousand. Of hulls that overlap by 8 cm, 35 iterations
(the default) found one contact of four. The default tolerance of that search, 1e-6, moves
velocities of a hand that holds an ellipsoid by 6e-5."""


def converged(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model, whose contact solver converges, whatever the model's own options are."""
    model = copy.deepcopy(model)
    for option, value in CONVERGED.items():
        setattr(model.opt, option, value)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return model


class Engine:
    """Single steps of the C engine.

    Attributes:
        model: which is stepped; contact solvers converge, whatever the options given.
    """

    def __init__(
        self, model: mujoco.MjModel, contacts: Contacts = True, as_given: bool = False
    ) -> None:
        """A copy of the model, `as_given` with its own options for the contact solver."""
        self.model = copy.deepcopy(model) if as_given else converged(model)
        self.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        if not contacts:
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._without = left_out(self.model, contacts)
        pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
        unwanted = [(a, b) in self._without or (b, a) in self._without for a, b in pairs]
        self.model.pair_margin[unwanted] = -mujoco.mjMAXVAL

    def step(self, x: Floats, u: Floats, steps: int = 1) -> Floats:
        """The state (nx,) some steps after x (nx,) under u (nu,); NaN if it diverges."""
        data = mujoco.MjData(self.model)
        set_state(self.model, data, x)
        data.ctrl[:] = u
        with quiet(), without(self._without):
            mujoco.mj_step(self.model, data, steps)
        if data.time < (steps - 0.5) * self.model.opt.timestep:  # MuJoCo has reset it
            return np.full_like(x, np.nan)
        return np.concatenate([data.qpos, data.qvel, data.act])

    def active_contacts(self, x: Floats) -> int:
        """Contacts that act at x (nx,), of the friction dimension that has the most."""
        contact = self._contacts(x)
        return int(np.bincount(contact.dim[contact.efc_address >= 0], minlength=1).max())

    def touching(self, x: Floats) -> set[Pair]:
        """The pairs of geoms whose contacts act at x (nx,)."""
        contact = self._contacts(x)
        return {(a, b) for a, b in contact.geom[contact.efc_address >= 0].tolist()}

    def hulls_touch(self, x: Floats) -> bool:
        """Whether at x (nx,) a contact of a mesh with a box or a mesh acts."""
        return any(of_hulls(self.model, pair) for pair in self.touching(x))

    def _contacts(self, x: Floats) -> Any:
        """All contacts at x (nx,), whether they act or not."""
        data = mujoco.MjData(self.model)
        set_state(self.model, data, x)
        with quiet(), without(self._without):
            mujoco.mj_forward(self.model, data)
        return data.contact

    def slopes(self, x: Floats, u: Floats, eps: float = 1e-6) -> Floats:
        """[df/dx df/du] in tangent space by differences to either side, (2, ndx, ndx + nu)."""
        reached, ndx = self.step(x, u), 2 * self.model.nv + self.model.na

        def change(dz: Floats) -> Floats:
            end = self.step(integrate(self.model, x, dz[:ndx]), u + dz[ndx:])
            return difference(self.model, end, reached)

        units = eps * np.eye(ndx + self.model.nu)
        sides = [[sign * change(sign * e) / eps for e in units] for sign in (1.0, -1.0)]
        return np.swapaxes(sides, 1, 2)
