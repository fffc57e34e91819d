"""Dynamics from a MuJoCo model: f(x, u) is one or more MJX steps, x = [qpos, qvel, act].

The same model is stepped by MuJoCo's C engine, in float64, when a result is certified.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from mujoco.rollout import Rollout
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, cut, reason, require_part, require_positive, shown
from mjx_drax.kernels.scalarize import scalarized
from mjx_drax.physics import agreement
from mjx_drax.physics import step as physics
from mjx_drax.physics._mujoco import mujoco
from mjx_drax.physics.joints import Joints
from mjx_drax.physics.mjx_model import (
    disabled,
    driven,
    free_ranges,
    has_constraints,
    nearest_only,
    twin,
)
from mjx_drax.physics.source import Source, is_binary, is_xml
from mjx_drax.physics.states import difference, quiet, set_state
from mjx_drax.physics.step import mjx
from mjx_drax.problem.checks import require_functions
from mjx_drax.problem.differentiators import Autodiff, Differentiator, InScalars
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.problem import (
    Aside,
    Box,
    Problem,
    Trajectory,
    box,
    checked,
    constraints_of,
    cost_of,
    knots,
    require_name,
    scatter_box,
    vector,
)

STEP_LIMIT = 2_000
"""Scalar operations of f, above which it stays in the array operations of MJX. Its derivatives may
take several times as many, and compilers need minutes for tens of thousands."""


SINGULAR = 1e-10
"""Least eigenvalue of the inertia, scaled to a diagonal of ones, that can be divided by."""

CHAINS_PER_THREAD = 8
"""Chains that a thread replays. To wait for each other at every knot costs threads more than a few
steps do: of 64 chains of a hopper on two cores, 64 threads took five times as long as one."""


class HostModel:
    """A `mujoco.MjModel` carried beside the numbers of a pytree.

    It takes no part in any compiled computation, so all of them compare equal: a model loaded
    again does not recompile. `origin` is the MJCF that it was compiled from, if it was.
    """

    def __init__(self, model: mujoco.MjModel, origin: str | Path | Source | None = None) -> None:
        self.model, self.origin = model, origin

    def source(self) -> Source:
        """The model's MJCF, with the files that it needs.

        Raises:
            DraxError: there is none, or it is no longer what the model was compiled from.
        """
        if isinstance(self.origin, Source):
            return self.origin
        if self.origin is None:
            raise DraxError(
                f"{model_name(self.model)} was given as a mujoco.MjModel, which cannot be written "
                "as MJCF: give from_mjcf its file or its XML."
            )
        return Source.of(self.origin, self.model)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HostModel)

    def __hash__(self) -> int:
        return hash(HostModel)


@dataclass(frozen=True)
class Structure:
    """The numbers of a model that its compiled functions rely on.

    These are the zeros of its float arrays (a joint's offset, an inertia's tilt, a damping that is
    not there), the ones in its axes and quaternions, and all integers: most of the arithmetic of a
    step is multiplication by them. All other numbers may change without recompiling.

    Attributes:
        known: for each leaf of the model its shape, which entries are known, and the entries, the
            latter two as bytes, which can be hashed; None where nothing is known.
    """

    known: tuple[tuple[tuple[int, ...], bytes, bytes] | None, ...]

    @classmethod
    def of(cls, model: mjx.Model) -> Structure:
        """The structure of a model; nothing is known of the leaves that are traced."""
        leaves = jax.tree_util.tree_leaves_with_path(model)
        return cls(tuple(_known(path, leaf) for path, leaf in leaves))

    def imposed(self, model: mjx.Model) -> mjx.Model:
        """The same model, in which what is known stands as a constant."""
        leaves, tree = jax.tree.flatten(model)
        pairs = zip(leaves, self.known, strict=True)
        return jax.tree.unflatten(tree, [_imposed(leaf, known) for leaf, known in pairs])


def _known(path: tuple[Any, ...], leaf: Any) -> tuple[tuple[int, ...], bytes, bytes] | None:
    if isinstance(leaf, jax.core.Tracer) or not hasattr(leaf, "shape") or leaf.size > 4096:
        return None
    value = np.asarray(leaf)
    if value.dtype.kind != "f":
        return value.shape, np.ones(value.shape, bool).tobytes(), value.astype(float).tobytes()
    known = value == 0
    if str(path[-1]).endswith(("axis", "quat")):
        known |= np.abs(value) == 1
    return value.shape, known.tobytes(), np.where(known, value, 0).astype(float).tobytes()


def _imposed(leaf: Array, known: tuple[tuple[int, ...], bytes, bytes] | None) -> Array:
    if known is None or known[0] != leaf.shape:
        return leaf
    which, value = (
        np.frombuffer(data, dtype).reshape(leaf.shape)
        for data, dtype in zip(known[1:], (bool, float), strict=True)
    )
    return jax.lax.select(which, value.astype(leaf.dtype), leaf)


@dataclass(frozen=True)
class MjxDynamics(Dynamics):
    """`substeps` steps of MJX under constant control; x = [qpos (nq), qvel (nv), act (na)].

    Attributes:
        model: the model on the device; its numbers (masses, gears, ...) are traced.
        dt: time between knots [s], substeps times the model's timestep.
        host: the model for MuJoCo's C engine.
        substeps: physics steps in one control step.
        derivatives: how f is differentiated; None: exactly.
        structure: what compiled functions know of the model, found when this is constructed.
    """

    model: mjx.Model
    dt: float
    host: HostModel
    substeps: int
    derivatives: Differentiator | None = None
    structure: Structure = field(init=False)

    def __post_init__(self) -> None:
        """A model that is put in later brings its own structure, by `dataclasses.replace` too."""
        object.__setattr__(self, "structure", Structure.of(self.model))

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The model that the C engine replays."""
        return self.host.model

    @property
    def engine(self) -> str:
        """What replays a result."""
        return f"MuJoCo {mujoco.__version__} C engine, float64"

    @property
    def nx(self) -> int:  # type: ignore[override]
        """nq + nv + na."""
        return self.model.nq + self.model.nv + self.model.na

    @property
    def ndx(self) -> int:  # type: ignore[override]
        """2 nv + na: one less than nx for every ball or free joint."""
        return 2 * self.model.nv + self.model.na

    @property
    def nu(self) -> int:  # type: ignore[override]
        """Number of actuators."""
        return self.model.nu

    @property
    def joints(self) -> Joints:
        """Where quaternions stand in a state."""
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

    def observe(self, x: Array, u: Array) -> mjx.Data:
        """`mjx.Data` at the knot, all computed: what a cost does not read costs nothing."""
        return _observe(self.model, self.structure, x, u)

    @property
    def kinked(self) -> bool:
        """Whether contacts, limits or dry friction act in f."""
        return has_constraints(self.model)

    @property
    def contacts(self) -> bool | int:
        """Whether the plan knows contacts, or how many of each friction dimension it keeps."""
        if int(self.model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
            return False
        points = nearest_only(self.model)
        return True if points is None else points

    def differentiator(self, by: Any) -> Any:
        """Exact derivatives in scalar arithmetic; others as they are."""
        return InScalars(by) if isinstance(by, Autodiff) else by

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """States and controls under u_k + K_k (x_k - plan_k) in the C engine; see `Dynamics`.

        All chains take a knot at a time. At each knot the constraint solver starts afresh, so that
        x_{k+1} depends on x_k and u_k alone; `mj_step` in a loop starts it from the last knot's
        forces, and differs by the solver's tolerance.
        """
        model = self.mj_model
        lower, upper = (np.broadcast_to(side, u.shape[1:]) for side in limits)
        chains, knots = u.shape[:2]
        states, applied = np.full(plan.shape, np.nan), np.full(u.shape, np.nan)
        states[:, 0] = plan[:, 0]
        threads = min(-(-chains // CHAINS_PER_THREAD), os.cpu_count() or 1)
        models, workers = [model] * chains, [mujoco.MjData(model) for _ in range(threads)]
        start = np.empty(mujoco.mj_stateSize(model, _PHYSICS))
        mujoco.mj_getState(model, workers[0], start, _PHYSICS)
        time, x = 0, slice(1, 1 + self.nx)
        now, sound = np.tile(start, (chains, 1)), np.ones(chains, bool)
        now[:, x] = plan[:, 0]
        steps = np.empty((chains, self.substeps, len(start)))
        with quiet(), Rollout(nthread=threads if threads > 1 else 0) as engine:
            for k in range(knots):
                off = self._differences(states[:, k], plan[:, k])
                wanted = u[:, k] + np.einsum("cij,cj->ci", gains[:, k], off)
                applied[:, k] = np.clip(wanted, lower[k], upper[k])
                sound &= (np.abs(applied[:, k]) < mujoco.mjMAXVAL).all(axis=1)
                applied[~sound, k] = np.nan
                now[~sound] = start  # something harmless, which nobody looks at
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
                # What blows up is reset by the engine, its time too, and takes no further step
                sound &= now[:, time] > (k + 1) * self.dt - 0.5 * model.opt.timestep
                states[sound, k + 1] = now[sound, x]
        return states, applied

    def _differences(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """x - y in tangent space, (n, ndx), for states (n, nx)."""
        if self.nx == self.ndx:
            return x - y
        return np.stack([difference(self.mj_model, *pair) for pair in zip(x, y, strict=True)])

    def deviation(self, states: np.ndarray, plan: np.ndarray) -> np.ndarray:
        """max|x - plan| in tangent space, (...,) for states and plan of shape (..., nx)."""
        plan = np.broadcast_to(plan, states.shape)
        off = self._differences(*(a.reshape(-1, self.nx) for a in (states, plan)))
        return np.abs(off).max(axis=-1).reshape(states.shape[:-1])

    def observe_replayed(self, x: np.ndarray) -> mujoco.MjData:
        """`mujoco.MjData` at a state (nx,), after mj_forward: what goals of replays receive."""
        data = mujoco.MjData(self.mj_model)
        set_state(self.mj_model, data, x)
        mujoco.mj_forward(self.mj_model, data)
        return data


def mujoco_model(dynamics: Dynamics) -> mujoco.MjModel | None:
    """The MuJoCo model that the dynamics come from; None if they come from a function.

    The one place that asks whether a problem is MuJoCo's.
    """
    return dynamics.mj_model if isinstance(dynamics, MjxDynamics) else None


def _flatten(dynamics: MjxDynamics) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    static = (dynamics.host, dynamics.substeps, dynamics.structure)
    return (dynamics.model, dynamics.dt, dynamics.derivatives), static


def _unflatten(static: tuple[Any, ...], traced: Iterable[Any]) -> MjxDynamics:
    """The same dynamics inside a compiled function, where only the structure is known."""
    dynamics = object.__new__(MjxDynamics)
    names = ("model", "dt", "derivatives", "host", "substeps", "structure")
    for name, value in zip(names, (*traced, *static), strict=True):
        object.__setattr__(dynamics, name, value)
    return dynamics


jax.tree_util.register_pytree_node(MjxDynamics, _flatten, _unflatten)


_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""What a step starts from: the time, the state, and what actuators and plugins remember."""


def _observe(model: mjx.Model, structure: Structure, x: Array, u: Array) -> mjx.Data:
    return physics.forward(structure.imposed(model), x, u)


def _step(model: mjx.Model, structure: Structure, substeps: int, x: Array, u: Array) -> Array:
    def steps(model: mjx.Model, x: Array, u: Array) -> Array:
        model = structure.imposed(model)

        def advance(x: Array, _: None) -> tuple[Array, None]:
            return physics.step(model, x, u), None

        return jax.lax.scan(advance, x, length=substeps)[0]

    if not has_constraints(model):  # whose forces come from a loop that ends when it is done
        steps = scalarized(steps, STEP_LIMIT)
    return steps(model, x, u)


# One trace of each, shared by all that differentiate it
_observe = jax.jit(_observe, static_argnums=1)
_step = jax.jit(_step, static_argnums=(1, 2))


def load(source: str | Path | mujoco.MjModel) -> mujoco.MjModel:
    """A model from a file, an XML string or a `mujoco.MjModel`.

    Raises:
        DraxError: the file is missing, MuJoCo cannot compile it, or it holds NaN.
    """
    model = source if isinstance(source, mujoco.MjModel) else _compiled(source)
    _require_finite(model)
    return model


def _compiled(source: str | Path) -> mujoco.MjModel:
    try:
        with quiet():
            if is_xml(source):
                return mujoco.MjModel.from_xml_string(source)
            if not Path(source).is_file():
                is_folder = Path(source).is_dir()
                what = "it is a folder; give a file in it" if is_folder else "check the path"
                raise DraxError(f"there is no model file {shown(str(source))}: {what}.")
            if is_binary(source):
                return mujoco.MjModel.from_binary_path(str(source))
            return mujoco.MjModel.from_xml_path(str(source))
    except TypeError as error:
        raise DraxError(
            f"the model is {shown(source)}: give an MJCF file, its XML as a text, or a "
            "mujoco.MjModel."
        ) from error
    except (ValueError, OSError, mujoco.FatalError) as error:
        if isinstance(error, DraxError):
            raise
        words = " ".join(str(error).split())
        fix = next((fix for part, fix in _FIXES.items() if part in words), "Correct the MJCF.")
        raise DraxError(
            f"MuJoCo cannot compile {shown(str(source))}: {cut(words)} {fix}"
        ) from error


_FIXES = {
    "'mujocoinclude'": "It is a part that models include: give the model's own file.",
    "Unrecognized XML model type": "Give an MJCF, which begins with <mujoco>, or a URDF.",
    "Error opening file": "Put that file there, or correct the path, meshdir or texturedir.",
}
"""What to do about some of MuJoCo's complaints."""


_GIVEN = ("body_", "dof_", "jnt_", "geom_", "tendon_", "actuator_", "eq_", "qpos_spring", "key_")
"""How arrays of a model are called that are as the MJCF says; those in 0 follow from others."""


def _require_finite(model: mujoco.MjModel) -> None:
    """Complain about numbers in a model that are none; MuJoCo itself only warns of them."""
    if not (np.isfinite(model.opt.timestep) and model.opt.timestep > 0):
        raise DraxError(
            f"the timestep of {model_name(model)} is {model.opt.timestep} s: give a positive one, "
            '<option timestep="0.01"/>.'
        )
    options = {f"opt.{name}": getattr(model.opt, name) for name in dir(model.opt)}
    given = [name for name in dir(model) if name.startswith(_GIVEN) and not name.endswith("0")]
    for name, value in {**options, **{name: getattr(model, name) for name in given}}.items():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            infinite_too = name in options  # ranges may be infinite
            wrong = value[~np.isfinite(value) if infinite_too else np.isnan(value)]
            if wrong.size:
                raise DraxError(
                    f"{name} of {model_name(model)} holds {wrong[0]}: give finite numbers in the "
                    "MJCF."
                )


_COUNTS = {
    "joint": "njnt",
    "site": "nsite",
    "body": "nbody",
    "geom": "ngeom",
    "actuator": "nu",
    "sensor": "nsensor",
    "keyframe": "nkey",
}


def index(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Number of an element of a model: a joint, site, body, geom, actuator, sensor or keyframe.

    Raises:
        DraxError: there is none of that name; lists those that there are.
    """
    element = getattr(model, "key" if kind == "keyframe" else kind)
    names = [element(i).name for i in range(getattr(model, _COUNTS[kind]))]
    if not isinstance(name, str) or not name or name not in names:
        known = ", ".join(repr(n) for n in names if n) or "no named one; add one"
        raise DraxError(f"{model_name(model)} has no {kind} {shown(name)}: there is {known}.")
    return names.index(name)


def from_mjcf(
    model: str | Path | mujoco.MjModel,
    *,
    horizon: float,
    running_cost: Callable[..., Any] | None = None,
    terminal_cost: Callable[..., Any] | None = None,
    running_residual: Callable[..., Any] | None = None,
    terminal_residual: Callable[..., Any] | None = None,
    equality: Callable[..., Any] | None = None,
    inequality: Callable[..., Any] | None = None,
    terminal_equality: Callable[..., Any] | None = None,
    terminal_inequality: Callable[..., Any] | None = None,
    dt: float | None = None,
    x_init: ArrayLike | None = None,
    x_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    u_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    x_scatter: tuple[ArrayLike, ArrayLike] | None = None,
    u_scatter: tuple[ArrayLike, ArrayLike] | None = None,
    contacts: bool | int = True,
    derivatives: Differentiator | None = None,
    goal: Callable[[Any], Any] | None = None,
    guess: Callable[[Array], Trajectory] | None = None,
    name: str | None = None,
) -> Problem:
    """A problem whose dynamics are those of a MuJoCo model.

    Costs see `mjx.Data` after `mjx.forward` (qpos, qvel, site and body positions, sensors, ...);
    what they do not read is not computed. Joint ranges and control ranges of the model become
    bounds, which are intersected with `x_bounds` and `u_bounds`.

    Args:
        model: MJCF file, XML string or `mujoco.MjModel`.
        horizon: duration [s]; K = horizon / dt knots, rounded.
        running_cost: l(data, u), a scalar, summed over the knots as it stands.
        terminal_cost: phi(data), a scalar.
        running_residual: r(data, u) (n,): adds 1/2 |r|^2 to the running cost.
        terminal_residual: r(data) (n,): adds 1/2 |r|^2 to the terminal cost.
        equality: c(data, u) (m,), held at 0 at every stage k = 0..K-1.
        inequality: g(data, u) (m,), held <= 0 at every stage.
        terminal_equality: c(data) (m,), held at 0 at x_K.
        terminal_inequality: g(data) (m,), held <= 0 at x_K.
        dt: control step [s], a multiple of the model's timestep; by default the multiple that comes
            closest to 0.02 s.
        x_init: x_0 = [qpos, qvel, act]; by default the first keyframe, else the default pose.
        x_bounds: (lower, upper) on states, each broadcastable to (nx,).
        u_bounds: (lower, upper) on controls, each broadcastable to (nu,).
        x_scatter: box for initial knots; by default the bounds, and where those are infinite +-pi
            rad for hinges, +-1 m for slides and free joints, +-0.3 for the parts of quaternions and
            +-5 (rad/s or m/s) for velocities about x_init. Every second chain then starts nearer to
            x_init, some more than others. Where contacts, limits or dry friction act, or states
            hold quaternions, all do, also with a box given here: see `Problem.draw`.
        u_scatter: the same for controls; by default their bounds, or +-1 where those are infinite.
            Where contacts, limits or dry friction act, about the controls that hold x_init.
        contacts: how many contact points the plan keeps, of each friction dimension (condim): the
            nearest ones in every state. True keeps all where there are at most 32, else 32. False
            plans as if nothing could touch, which is right where constraints keep things apart. The
            C engine that certifies keeps all its contacts.
        derivatives: of f; by default exact, also in contact. `Smoothed()` fits them to samples,
            which feel a contact from as far as they are drawn.
        goal: goal(mujoco.MjData of the last state) -> bool, what a replay must reach.
        guess: guess(key) -> Trajectory, instead of the scatter boxes.
        name: used in files and tables; by default the model's name.

    Raises:
        DraxError: the model cannot be used (saying which element and why), or arguments misfit; a
            function computes something else when it is traced again.

    Warns:
        DraxWarning: MJX computes the model a little differently from the C engine.
    """
    require_functions(
        running_cost=running_cost,
        terminal_cost=terminal_cost,
        running_residual=running_residual,
        terminal_residual=terminal_residual,
        equality=equality,
        inequality=inequality,
        terminal_equality=terminal_equality,
        terminal_inequality=terminal_inequality,
        goal=goal,
        guess=guess,
    )
    if derivatives is not None:
        require_part("derivatives", derivatives, "jacobian", "Smoothed()")
    host = load(model)
    name = str(model_name(host)) if name is None else name
    require_name(name)
    require_movable(host, name)
    substeps = steps_between_knots(host, dt)
    K = knots(horizon, substeps * host.opt.timestep)
    x0 = initial_state(host, name, x_init)
    require_regular(host, name, x0)
    bounded = bounded_joints(host, x0)
    dynamics = MjxDynamics(
        twin(host, contacts, bounded),
        substeps * host.opt.timestep,
        HostModel(host, _origin(model)),
        substeps,
        derivatives,
    )
    require_traceable(name, dynamics.observe, host)
    bounds = _bounds(host, bounded, dynamics, x_bounds, u_bounds)
    agreement.require(host, name, x0, contacts, bounded)
    agreement.require_near(host, name, x0, nearest_only(dynamics.model), bounded)
    constraint, terminal_constraint = constraints_of(
        dynamics, equality, inequality, terminal_equality, terminal_inequality
    )
    return checked(
        Problem(
            dynamics=dynamics,
            running=cost_of(running_cost, running_residual),
            terminal=cost_of(terminal_cost, terminal_residual),
            constraint=constraint,
            terminal_constraint=terminal_constraint,
            x_init=jnp.asarray(x0),
            bounds=bounds,
            scatter=_scatter(dynamics, bounds, x0, x_scatter, u_scatter),
            aside=Aside(goal, guess, name),
            horizon=K,
            near=x_scatter is None,
        )
    )


def _origin(model: str | Path | mujoco.MjModel) -> str | Path | None:
    """The XML that the user gave, or its file's absolute path."""
    if isinstance(model, mujoco.MjModel) or is_binary(model):
        return None
    return model if is_xml(model) else Path(model).resolve()


def model_name(model: mujoco.MjModel) -> str:
    """What the model calls itself."""
    return model.names[: model.names.index(b"\0")].decode() or "model"


def steps_between_knots(model: mujoco.MjModel, dt: float | None) -> int:
    """Physics steps in a control step of dt [s], which must be a multiple of the timestep."""
    timestep = model.opt.timestep
    if dt is None:
        return max(1, round(0.02 / timestep))
    require_positive("dt", dt, "a positive number of seconds")
    substeps = round(dt / timestep)
    if substeps < 1 or abs(substeps * timestep - dt) > 1e-6 * dt:
        raise DraxError(
            f"dt is {dt} s, not a multiple of the model's timestep {timestep} s: "
            f"give {max(1, substeps) * timestep:g}."
        )
    return substeps


def require_movable(model: mujoco.MjModel, name: str) -> None:
    """Raise a DraxError for a model that no trajectory can be planned for."""
    if model.nv == 0:
        raise DraxError(f"{name} has no joints: there is nothing to move; add a <joint>.")
    if model.nu == 0:
        raise DraxError(f"{name} has no actuators: add an <actuator> (to MJCF: a URDF has none).")
    if disabled(model).all():
        raise DraxError(
            f"all actuators of {name} are disabled: clear the flag actuation and "
            "actuatorgroupdisable in <option>."
        )


def require_regular(model: mujoco.MjModel, name: str, x_init: np.ndarray) -> None:
    """Raise a DraxError for a model whose acceleration cannot be found at x_init (nx,)."""
    data = mujoco.MjData(model)
    set_state(model, data, x_init)
    with quiet():
        mujoco.mj_forward(model, data)
    M = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    scale = np.sqrt(np.diag(M))
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    if not values[0] > SINGULAR:
        along = vectors[:, 0]
        joints = model.dof_jntid[np.abs(along) > 0.5 * np.abs(along).max()]
        names = ", ".join(str(model.joint(j).name or j) for j in dict.fromkeys(joints.tolist()))
        raise DraxError(
            f"the inertia of {name} is singular, because joints move bodies alike ({names}): leave "
            'one of them out, or give them armature="0.01".'
        )
    if not np.isfinite(data.qacc).all():
        raise DraxError(f"{name} has no finite acceleration at x_init: give another x_init.")


def require_traceable(
    name: str, forward: Callable[[Array, Array], Any], model: mujoco.MjModel
) -> None:
    """Raise a DraxError for a model that MJX takes, but fails in when it is to step it."""
    x, u = jnp.zeros(model.nq + model.nv + model.na), jnp.zeros(model.nu)
    try:
        jax.eval_shape(forward, x, u)
    except Exception as error:  # of any kind, deep inside MJX
        raise DraxError(
            f"MJX fails in a step of {name} ({reason(error)}): leave out sensors, tendons and "
            "equality constraints, by which it may fail, until it does not."
        ) from error


def initial_state(model: mujoco.MjModel, name: str, x_init: ArrayLike | None) -> np.ndarray:
    """x_0 (nx,) as given, or the first keyframe, or the default pose at rest."""
    if x_init is not None:
        x0 = np.array(vector("x_init", x_init), float)  # a copy: it will be scaled
    elif model.nkey:
        x0 = np.concatenate([model.key_qpos[0], model.key_qvel[0], model.key_act[0]])
    else:
        x0 = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
    nx = model.nq + model.nv + model.na
    if not np.isfinite(x0).all():
        raise DraxError(f"the first keyframe of {name} is {shown(x0.tolist())}: give x_init.")
    if x0.shape != (nx,):
        raise DraxError(
            f"x_init has {x0.shape[0]} numbers; {name} has {nx}: qpos ({model.nq}), "
            f"qvel ({model.nv}), act ({model.na}). Give {nx}."
        )
    for q, _ in Joints.of(model).quaternions:
        if abs(np.linalg.norm(x0[q : q + 4]) - 1.0) > 1e-3:
            raise DraxError(
                f"x_init holds the quaternion {x0[q : q + 4].tolist()} at {q}: "
                "scale it to length 1."
            )
    mujoco.mj_normalizeQuat(model, x0[: model.nq])
    return x0


def _reach(model: mujoco.MjModel) -> np.ndarray:
    """Half-widths (nx,) of the scatter of states."""
    positions = np.ones(model.nq)
    positions[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] = np.pi
    positions[Joints.of(model).is_quaternion] = 0.3
    return np.concatenate([positions, np.full(model.nv, 5.0), np.ones(model.na)])


def _scatter(
    dynamics: MjxDynamics,
    bounds: Box,
    x_init: np.ndarray,
    x: tuple[ArrayLike, ArrayLike] | None,
    u: tuple[ArrayLike, ArrayLike] | None,
) -> Box:
    """The box that initial knots are drawn from."""
    model = dynamics.mj_model
    if dynamics.kinked and u is None:  # about the controls that hold x_init
        from mjx_drax.modelling.guesses import controls, middle

        ends = np.asarray(bounds.u_lower, float), np.asarray(bounds.u_upper, float)
        width = np.where(np.isfinite(ends[1] - ends[0]), (ends[1] - ends[0]) / 2, 1.0)
        hold = controls(model, np.stack([x_init, x_init]), dynamics.dt, middle(bounds))[0]
        hold = np.clip(hold, *ends)
        u = hold - width, hold + width
    return scatter_box(bounds, jnp.asarray(x_init), jnp.asarray(_reach(model)), x, u)


def bounded_joints(model: mujoco.MjModel, x_init: np.ndarray) -> np.ndarray:
    """Joints whose range becomes a bound on knots, (njnt,).

    Those are hinges and slides that an actuator drives and that start inside their range. What
    rests on its limit, or starts beyond it, needs the limit's force: it stays in the dynamics.
    """
    kinds = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    single = np.isin(model.jnt_type, [int(kind) for kind in kinds]) & (model.jnt_limited != 0)
    start = x_init[model.jnt_qposadr]
    lower, upper = free_ranges(model)
    return single & driven(model) & (start > lower) & (start < upper)


def _bounds(
    model: mujoco.MjModel,
    bounded: np.ndarray,
    dynamics: MjxDynamics,
    x_bounds: tuple[ArrayLike, ArrayLike] | None,
    u_bounds: tuple[ArrayLike, ArrayLike] | None,
) -> Any:
    """The ranges of the model's joints and controls, intersected with the user's."""
    x_lower, x_upper = np.full(dynamics.nx, -np.inf), np.full(dynamics.nx, np.inf)
    where = model.jnt_qposadr[bounded]
    x_lower[where], x_upper[where] = (end[bounded] for end in free_ranges(model))
    u_lower, u_upper = np.full(model.nu, -np.inf), np.full(model.nu, np.inf)
    limited = model.actuator_ctrllimited.astype(bool)
    u_lower[limited], u_upper[limited] = model.actuator_ctrlrange[limited].T
    given = box(dynamics.nx, model.nu, x_bounds, u_bounds)
    turning = np.flatnonzero(Joints.of(model).is_quaternion)
    ends = np.asarray(given.x_lower), np.asarray(given.x_upper)
    if any(np.isfinite(end[..., turning]).any() for end in ends):
        raise DraxError(
            f"x_bounds are finite at entries {turning.tolist()}, which are quaternions: leave them "
            "infinite, and bound orientations by an inequality."
        )
    return box(
        dynamics.nx,
        model.nu,
        (np.maximum(x_lower, given.x_lower), np.minimum(x_upper, given.x_upper)),
        (np.maximum(u_lower, given.u_lower), np.minimum(u_upper, given.u_upper)),
    )
