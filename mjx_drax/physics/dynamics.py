"""Dynamics of a MuJoCo model: x_{k+1} = f(x_k, u_k) is one or more steps of MJX.

    x = [qpos (nq), qvel (nv), act (na)],    a tangent vector = [dq (nv), dv (nv), da (na)]

Planning differentiates MJX, in the precision of JAX. A result is certified by MuJoCo's C engine, in
float64, which steps the `mujoco.MjModel` that the MJX model was made of.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError
from mjx_drax.base.pytrees import HostOnly
from mjx_drax.kernels.scalarize import scalarized
from mjx_drax.physics import step as one_step
from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.engine import Rollout, mujoco
from mjx_drax.physics.joints import Joints
from mjx_drax.physics.mjx_model import has_constraints, kept_contacts, put_model
from mjx_drax.physics.observed import Observed
from mjx_drax.physics.source import Source, binary, model_name
from mjx_drax.physics.states import difference, integrate, quiet, set_state
from mjx_drax.problem.differentiators import Autodiff, Differentiator, InScalars
from mjx_drax.problem.dynamics import Dynamics

STEP_LIMIT = 2_000
"""Scalar operations of f, above which it stays in the array operations of MJX. Its derivatives may
take several times as many, and compilers need minutes for tens of thousands."""

KNOWN_SIZE = 4_096
"""Numbers in an array of a model, above which compiled functions know none of them."""

CHAINS_PER_THREAD = 8
"""Chains that a thread replays. Threads wait for each other at every knot, which takes longer than
a few steps do: for 64 chains of a hopper on two cores, 64 threads took five times as long as one.
"""

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""What a step of the C engine starts from: time, state, and what actuators and plugins remember."""

Known = tuple[tuple[int, ...], bytes, bytes]
"""Shape of an array, which of its entries are known, and these; as bytes, which can be hashed."""


@dataclass(frozen=True)
class Structure:
    """The numbers of a model that its compiled functions rely on.

    These are the zeros of its float arrays (a joint's offset, an inertia's tilt, a damping that is
    not there), the ones in its axes and quaternions, and all integers: most of the arithmetic of a
    step is multiplication by them. All other numbers may change without recompiling.

    Attributes:
        known: of each array of the model, in the order of its leaves; None where nothing is known.
    """

    known: tuple[Known | None, ...]

    @classmethod
    def of(cls, model: mjx.Model) -> Structure:
        """The structure of a model; nothing is known of the arrays that are traced."""
        leaves = jax.tree_util.tree_leaves_with_path(model)
        return cls(tuple(_known(path, leaf) for path, leaf in leaves))

    def fixed_in(self, model: mjx.Model) -> mjx.Model:
        """The same model, with constants for the numbers that are known."""
        leaves, tree = jax.tree.flatten(model)
        pairs = zip(leaves, self.known, strict=True)
        return jax.tree.unflatten(tree, [_fixed(leaf, known) for leaf, known in pairs])


def _known(path: tuple[Any, ...], leaf: Any) -> Known | None:
    if isinstance(leaf, jax.core.Tracer) or not hasattr(leaf, "shape") or leaf.size > KNOWN_SIZE:
        return None
    value = np.asarray(leaf)
    if value.dtype.kind != "f":
        return value.shape, np.ones(value.shape, bool).tobytes(), value.astype(float).tobytes()
    known = value == 0
    if str(path[-1]).endswith(("axis", "quat")):
        known |= np.abs(value) == 1
    return value.shape, known.tobytes(), np.where(known, value, 0).astype(float).tobytes()


def _fixed(leaf: Array, known: Known | None) -> Array:
    if known is None or known[0] != leaf.shape:
        return leaf
    which, value = (
        np.frombuffer(data, dtype).reshape(leaf.shape)
        for data, dtype in zip(known[1:], (bool, float), strict=True)
    )
    return jax.lax.select(which, value.astype(leaf.dtype), leaf)


KINKED_STATE_DAMPING = 0.001
"""Damping of states beside that of controls, where contacts, limits or dry friction act.

A contact moves velocities within a knot by many times as much as positions, and knots that are
damped like controls do not get there within an attempt; docs/models.md has the numbers.
"""


@dataclass(frozen=True, eq=False)
class MjxDynamics(Dynamics):
    """`substeps` steps of MJX under constant control; x = [qpos (nq), qvel (nv), act (na)].

    As a pytree it holds `model`, `dt` and `derivatives`, which are traced, and `substeps` and
    `structure`, which are static. `mj_model` and `origin` are no part of it: inside of compiled
    functions, and wherever a pytree is put together again, they are None.

    Attributes:
        model: the model that is planned with; its numbers (masses, gears, ...) are traced.
        dt: time between knots [s], substeps times the model's timestep.
        mj_model: the model that the C engine steps.
        substeps: physics steps in one control step.
        derivatives: how f is differentiated; None: exactly.
        origin: what `mj_model` was compiled from: a file, XML or a `Source`; None if unknown.
        structure: what compiled functions know of the model, found when this is constructed.
    """

    model: mjx.Model
    dt: float
    mj_model: mujoco.MjModel = field(metadata=HostOnly)
    substeps: int
    derivatives: Differentiator | None = None
    origin: str | Path | Source | None = field(default=None, metadata=HostOnly)
    structure: Structure = field(init=False)
    checked = True
    twice = False

    def __post_init__(self) -> None:
        """A model that replaces another one, as by `dataclasses.replace`, has its own structure."""
        object.__setattr__(self, "structure", Structure.of(self.model))

    def source(self) -> Source:
        """The model's MJCF, with the files that it needs.

        Raises:
            DraxError: there is none, or it is no longer what the model was compiled from.
        """
        if isinstance(self.origin, Source):
            return self.origin
        if self.origin is None:
            raise DraxError(
                f"{model_name(self.mj_model)} was given as a mujoco.MjModel, which cannot be "
                "written as MJCF: give from_mjcf its file or its XML."
            )
        return Source.of(self.origin, self.mj_model)

    @property
    def engine(self) -> str:
        """What replays a result."""
        return f"MuJoCo {mujoco.__version__} C engine, float64"

    @property
    def nx(self) -> int:  # type: ignore[override]
        """nq + nv + na."""
        return self.model.nq + self.model.nv + self.model.na

    @property
    def ndx(self) -> int:
        """2 nv + na: one less than nx for every ball or free joint."""
        return 2 * self.model.nv + self.model.na

    @property
    def nu(self) -> int:  # type: ignore[override]
        """Number of actuators."""
        return self.model.nu

    @property
    def joints(self) -> Joints:
        """Which entries of a state are quaternions, and its arithmetic."""
        return Joints.of(self.model)

    def difference(self, x: Array, y: Array) -> Array:
        """x - y in the tangent space at y, (ndx,)."""
        return self.joints.difference(x, y)

    def integrate(self, x: Array, dx: Array) -> Array:
        """x + dx, (nx,)."""
        return self.joints.integrate(x, dx)

    def valid(self, x: Array) -> Array:
        """x (..., nx) with quaternions of unit length."""
        return self.joints.normalized(x)

    def tangent(self, numbers: Array) -> Array:
        """Of numbers (..., nx), those of the tangent (..., ndx); rotation vectors get zeros."""
        return self.joints.tangent(numbers)

    def step(self, x: Array, u: Array) -> Array:
        """f(x, u), (nx,)."""
        return _step(self.model, self.structure, self.substeps, x, u)

    def observe(self, x: Array, u: Array) -> Observed:
        """`mjx.Data` at the knot, all computed: what a cost does not read costs nothing."""
        return Observed.of(self.model, _observe(self.model, self.structure, x, u))

    @property
    def kinked(self) -> bool:  # type: ignore[override]
        """Whether contacts, limits or dry friction act in f."""
        return has_constraints(self.model)

    @property
    def state_damping(self) -> float:  # type: ignore[override]
        """Damping of states beside that of controls; see `KINKED_STATE_DAMPING`."""
        return KINKED_STATE_DAMPING if self.kinked else 1.0

    @property
    def contacts(self) -> bool | int:
        """Whether the plan has contacts, or how many of each friction dimension it keeps."""
        if int(self.model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
            return False
        points = kept_contacts(self.model)
        return True if points is None else points

    def differentiator(self, by: Any) -> Any:
        """Exact derivatives in scalar arithmetic; others as they are."""
        return InScalars(by) if isinstance(by, Autodiff) else by

    def step_differentiator(self, by: Any) -> Any:
        """The model's own `derivatives`, if given; no scalars where f holds the contact solver."""
        return self.derivatives or (by if self.kinked else self.differentiator(by))

    def in_float64(self) -> MjxDynamics:
        """The same with the C engine's numbers, wherever the model has them rounded to float32."""
        with jax.enable_x64(True):
            bounded = self.mj_model.jnt_limited != np.asarray(self.model.jnt_limited)
            exact = put_model(self.mj_model, self.contacts, bounded)

            def unrounded(own: Any, leaf: Any) -> Any:
                own, leaf = np.asarray(own), np.asarray(leaf)
                if own.dtype.kind != "f" or own.shape != leaf.shape:
                    return own
                return np.where(own == leaf.astype(own.dtype), leaf, own.astype(float))

            return replace(self, model=jax.tree.map(unrounded, self.model, exact))

    def fingerprint(self) -> bytes:
        """The model of the C engine."""
        return binary(self.mj_model)

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """States and controls under u_k + K_k (x_k - plan_k) in the C engine; see `Dynamics`.

        All chains take the same knot before any takes the next. The constraint solver starts
        without a guess at each knot, so that x_{k+1} depends on x_k and u_k alone; `mj_step` in a
        loop starts it from the last knot's forces, and differs by the solver's tolerance.
        """
        model = self.mj_model
        lower, upper = (np.broadcast_to(side, u.shape[1:]) for side in limits)
        chains, knots = u.shape[:2]
        states, applied = np.full(plan.shape, np.nan), np.full(u.shape, np.nan)
        states[:, 0] = plan[:, 0]
        threads = min(-(-chains // CHAINS_PER_THREAD), os.cpu_count() or 1)
        models, workers = [model] * chains, [mujoco.MjData(model) for _ in range(threads)]
        start = np.empty(mujoco.mj_stateSize(model, _FULL_PHYSICS))
        mujoco.mj_getState(model, workers[0], start, _FULL_PHYSICS)
        time, x = 0, slice(1, 1 + self.nx)
        now, sound = np.tile(start, (chains, 1)), np.ones(chains, bool)
        now[:, x] = plan[:, 0]
        steps = np.empty((chains, self.substeps, len(start)))
        with quiet(), Rollout(nthread=threads if threads > 1 else 0) as engine:
            for k in range(knots):
                off = self.host_difference(states[:, k], plan[:, k])
                wanted = u[:, k] + np.einsum("cij,cj->ci", gains[:, k], off)
                applied[:, k] = np.clip(wanted, lower[k], upper[k])
                sound &= (np.abs(applied[:, k]) < mujoco.mjMAXVAL).all(axis=1)
                applied[~sound, k] = np.nan
                now[~sound] = start  # a state that can be stepped; its result is not used
                control = np.where(sound[:, None], applied[:, k], 0.0)
                engine.rollout(
                    models,
                    workers,
                    now,
                    np.repeat(control[:, None], self.substeps, axis=1),
                    nstep=self.substeps,
                    state=steps,
                    chunk_size=-(-chains // threads),
                    skip_checks=True,
                )
                now = steps[:, -1].copy()
                sound &= (np.abs(now) < mujoco.mjMAXVAL).all(axis=1)
                # The engine resets a state that diverges, and its time: it falls behind
                sound &= now[:, time] > (k + 1) * self.dt - 0.5 * model.opt.timestep
                states[sound, k + 1] = now[sound, x]
        return states, applied

    def host_difference(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """x - y in tangent space by the C engine, (..., ndx), for states (..., nx)."""
        if self.nx == self.ndx:
            return np.asarray(x - y)
        rows = (a.reshape(-1, self.nx) for a in np.broadcast_arrays(x, y))
        off = np.stack([difference(self.mj_model, *pair) for pair in zip(*rows, strict=True)])
        return off.reshape(*np.broadcast_shapes(x.shape, y.shape)[:-1], self.ndx)

    def host_integrate(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """x + dx by the C engine, (nx,)."""
        return integrate(self.mj_model, x, dx)

    def observe_replayed(self, x: np.ndarray) -> mujoco.MjData:
        """`mujoco.MjData` at a state (nx,), after mj_forward: what goals of replays receive."""
        data = mujoco.MjData(self.mj_model)
        set_state(self.mj_model, data, x)
        mujoco.mj_forward(self.mj_model, data)
        return data


_TRACED, _STATIC = ("model", "dt", "derivatives"), ("substeps", "structure")


def _flatten(dynamics: MjxDynamics) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    traced, static = (tuple(getattr(dynamics, n) for n in names) for names in (_TRACED, _STATIC))
    return traced, static


def _unflatten(static: tuple[Any, ...], traced: Iterable[Any]) -> MjxDynamics:
    """The dynamics with the structure they had, which traced numbers could not give."""
    dynamics = object.__new__(MjxDynamics)
    values = zip((*_TRACED, *_STATIC), (*traced, *static), strict=True)
    for name, value in (*values, ("mj_model", None), ("origin", None)):
        object.__setattr__(dynamics, name, value)
    return dynamics


jax.tree_util.register_pytree_node(MjxDynamics, _flatten, _unflatten)


def mujoco_model(dynamics: Dynamics) -> mujoco.MjModel | None:
    """The MuJoCo model that dynamics come from; None if they come from a function.

    The one place that asks whether dynamics are MuJoCo's. Not for compiled functions, where the
    model is not known.
    """
    return dynamics.mj_model if isinstance(dynamics, MjxDynamics) else None


def _observe(model: mjx.Model, structure: Structure, x: Array, u: Array) -> mjx.Data:
    return one_step.forward(structure.fixed_in(model), x, u)


def _step(model: mjx.Model, structure: Structure, substeps: int, x: Array, u: Array) -> Array:
    def steps(model: mjx.Model, x: Array, u: Array) -> Array:
        model = structure.fixed_in(model)

        def substep(x: Array, _: None) -> tuple[Array, None]:
            return one_step.step(model, x, u), None

        return jax.lax.scan(substep, x, length=substeps)[0]

    if not has_constraints(model):  # their forces come from a loop, which stays one of arrays
        steps = scalarized(steps, STEP_LIMIT)
    return steps(model, x, u)


# One trace of each, shared by all that differentiate it
_observe = jax.jit(_observe, static_argnums=1)
_step = jax.jit(_step, static_argnums=(1, 2))
