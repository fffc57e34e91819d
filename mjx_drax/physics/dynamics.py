"""Dynamics of a MuJoCo model: x_{k+1} = f(x_k, u_k) is one or more steps of MJX.

    x = [qpos (nq), qvel (nv), act (na)],    a tangent vector = [dq (nv), dv (nv), da (na)]

Planning differentiates MJX, in the precision of JAX. A result is certified by MuJoCo's C engine, in
float64, which steps the `mujoco.MjModel` that the MJX model was made of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from jax.typing import ArrayLike

from mjx_drax.base.errors import DraxError
from mjx_drax.base.pytrees import HostOnly
from mjx_drax.kernels.batching import on_gpu
from mjx_drax.kernels.scalars.scalarize import scalarized
from mjx_drax.physics import step as one_step
from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.c_engine.model_numbers import set_numbers
from mjx_drax.physics.c_engine.states import converged, differences, integrate, set_state
from mjx_drax.physics.c_engine.stepper import Spare, Stepper
from mjx_drax.physics.contacts.collision import left_out
from mjx_drax.physics.contacts.pairs import Contacts, contact_pairs, geom_name
from mjx_drax.physics.contacts.pairs import left_out as pairs_left_out
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import Joints
from mjx_drax.physics.mjx_model import (
    constraint_rows,
    has_constraints,
    kept_contacts,
    put_model,
    with_subtree_masses,
)
from mjx_drax.physics.observed import Observed
from mjx_drax.physics.saturation import Ends, finite_ends, unlimited, useful_controls
from mjx_drax.physics.source import Source, binary, model_name
from mjx_drax.problem.differentiators import Autodiff, Differentiator, InScalars
from mjx_drax.problem.dynamics import Dynamics, Unlimited
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.rollout import replay_by
from mjx_drax.problem.trajectory import Knot

STEP_LIMIT = 1_000
"""Scalar operations of f, above which it stays in the array operations of MJX, or is a loop; on
GPUs also of each physics step of that loop. Its derivatives may take several times as many, and
compilers need minutes for tens of thousands: at 1,070 a satellite's did not end within 400 s on a
CPU."""

KNOWN_SIZE = 4_096
"""Numbers in an array of a model, above which compiled functions know none of them."""

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
    def of(cls, model: mjx.Model, free: frozenset[str] = frozenset()) -> Structure:
        """The structure of a model; nothing is known of arrays that are traced or `free`."""
        leaves = jax.tree_util.tree_leaves_with_path(model)
        names = (str(path[-1]).lstrip(".") for path, _ in leaves)
        return cls(
            tuple(
                None if name in free else _known(path, leaf)
                for name, (path, leaf) in zip(names, leaves, strict=True)
            )
        )

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
        free_step: whether the timestep is that of the knot, over `substeps`.
        numbers: numbers(model, parameters) -> {field: array}, of the model, from the parameters of
            the knot; or None.
        free: fields of the model that `numbers` gives, of which `structure` knows nothing.
        time: of the knot that `at` has bound this to [s]; None if it has not.
    """

    model: mjx.Model
    dt: float
    mj_model: mujoco.MjModel = field(metadata=HostOnly)
    substeps: int
    derivatives: Differentiator | None = None
    origin: str | Path | Source | None = field(default=None, metadata=HostOnly)
    structure: Structure = field(init=False)
    free_step: bool = False
    numbers: Callable[[mjx.Model, Any], Any] | None = None
    free: tuple[str, ...] = ()
    time: Array | None = field(default=None, init=False)
    checked = True
    twice = False

    def __post_init__(self) -> None:
        """A model that replaces another one, as by `dataclasses.replace`, has its own structure."""
        object.__setattr__(self, "structure", Structure.of(self.model, frozenset(self.free)))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {model_name(self.mj_model)}>"

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

    def at(self, knot: Knot) -> Self:
        """The same at one knot: costs read its time."""
        new, model = copy(self), self.model  # not `replace`: it would look for the structure anew
        if self.free_step:
            model = model.replace(opt=model.opt.replace(timestep=knot.dt / self.substeps))
        if self.numbers is not None:
            model = model.replace(**self.numbers(model, knot.parameters))
            if "body_mass" in self.free:
                model = with_subtree_masses(model)
        object.__setattr__(new, "time", knot.time)
        object.__setattr__(new, "model", model)
        return new

    def steered(
        self, free_step: bool, numbers: Callable[[mjx.Model, Any], Any] | None, names: Iterable[str]
    ) -> MjxDynamics:
        """The same, with the step or the numbers of the fields `names` given by the knot."""
        return replace(self, free_step=free_step, numbers=numbers, free=tuple(sorted(names)))

    def observe(self, x: Array, u: Array) -> Observed:
        """`mjx.Data` at the knot, all computed: what a cost does not read costs nothing."""
        data, readings = _observe(self.model, self.structure, x, u, self.time)
        return Observed.of(self.model, data, readings)

    @property
    def kinked(self) -> bool:  # type: ignore[override]
        """Whether contacts, limits or dry friction act in f."""
        return has_constraints(self.model)

    @property
    def constraint_rows(self) -> int:  # type: ignore[override]
        """Rows that a step solves constraint forces for, active or not."""
        return constraint_rows(self.model)

    @property
    def state_damping(self) -> float:  # type: ignore[override]
        """Damping of states beside that of controls; see `KINKED_STATE_DAMPING`."""
        return KINKED_STATE_DAMPING if self.kinked else 1.0

    @property
    def stops(self) -> list[int]:
        """The joints whose limits act in the dynamics of the plan."""
        found: list[int] = np.flatnonzero(self.model.jnt_limited).tolist()
        return found

    @property
    def contacts(self) -> Contacts:
        """Whether the plan has contacts, or how many of each friction dimension it keeps.

        Where pairs are left out: the pairs of geoms, by their numbers, that it has contacts of.
        """
        if int(self.model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
            return False
        without = left_out(self.model)
        if without:
            every = contact_pairs(self.mj_model)
            return [pair for pair in every if (min(pair), max(pair)) not in without]
        points = kept_contacts(self.model)
        return True if points is None else points

    def useful_controls(self, x: Array) -> tuple[Array, Array] | None:
        """Those at which forces reach their ranges.

        None where contacts, limits or dry friction act: there chains start about the controls that
        hold x_init.
        """
        return None if self.kinked else useful_controls(self.model, x)

    def unlimited(self) -> Unlimited[MjxDynamics] | None:
        """The same with `saturation.unlimited` actuators; the C engine keeps the model as it is.

        None where parameters change the model: the ends may be among what they change.
        """
        if self.numbers is not None:
            return None
        at_once, all_along = (finite_ends(self.model, time) for time in (0.0, float(self.dt)))
        if at_once is None or all_along is None:
            return None
        return Unlimited(
            replace(self, model=unlimited(self.model, at_once)),
            useful=partial(useful_controls, self.model),
            at_once=Partial(Ends.passed, at_once),
            all_along=Partial(Ends.passed, all_along),
            rows=2 * len(at_once.actuators),
            held=partial(
                jax.tree.map(lambda a: np.asarray(a, float), at_once).held, self.mj_model.nq
            ),
        )

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

            # With the static arrays of `exact`: JAX knows those of this model in float32
            pairs = zip(jax.tree.leaves(self.model), jax.tree.leaves(exact), strict=True)
            leaves = [unrounded(*pair) for pair in pairs]
            return replace(self, model=jax.tree.unflatten(jax.tree.structure(exact), leaves))

    def fingerprint(self) -> bytes:
        """The model of the C engine."""
        return binary(self.mj_model)

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        knots: Knot | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """States and controls under u_k + K_k (x_k - plan_k) in the C engine; see `Dynamics`.

        With feedback all chains take the same knot before any takes the next; see `Stepper`.
        """
        if not gains.any():
            K = u.shape[1]
            with Stepper(self.mj_model, self.substeps, plan[:, 0], self._spare, K) as stepper:
                states, applied = stepper.run(np.clip(u, *limits))
            return np.concatenate([plan[:, :1], states], axis=1), applied
        with self.stepper(plan[:, 0]) as stepper:
            return replay_by(
                lambda k, x, u: stepper(u), self.host_difference, plan, u, gains, limits
            )

    def between_knots(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """States (K, substeps - 1, nx) of the C engine after all but the last step of each knot.

        From states (K, nx) under controls (K, nu).
        """
        more = self.substeps - 1
        with Stepper(self.mj_model, 1, x, knots=more) as stepper:
            return stepper.run(np.repeat(u[:, None], more, axis=1))[0]

    def stepper(self, x: np.ndarray) -> Stepper:
        """The C engine with states (chains, nx) that advance together."""
        return Stepper(self.mj_model, self.substeps, x, self._spare)

    @cached_property
    def _spare(self) -> Spare:
        """What steppers leave for the next."""
        return Spare()

    def configured(
        self, stepper: Any, dt: np.ndarray, parameters: Mapping[str, Any] | None
    ) -> None:
        """Give every chain of a stepper its time between knots [s] and parameters; None: as are."""
        steps = dt / self.substeps if self.free_step else None
        own: dict[str, np.ndarray] = {}
        if self.numbers is not None and parameters is not None:
            with jax.enable_x64(True):
                found = jax.vmap(self._numbers)(dict(parameters))
                own = {name: np.asarray(values, float) for name, values in found.items()}
        stepper.configure(steps, own)

    @cached_property
    def _numbers(self) -> Callable[[dict[str, Any]], dict[str, Array]]:
        """`numbers` of parameters in float64, compiled; to be called where it is enabled."""
        assert self.numbers is not None
        with jax.enable_x64(True):
            model = jax.tree.map(jnp.asarray, self.in_float64().model)
        return jax.jit(partial(self.numbers, model))

    def of_parameters(self, parameters: Mapping[str, Any]) -> MjxDynamics:
        """The same with the numbers of parameters in the C engine's model, for use on the host."""
        if self.numbers is None:
            return self
        with jax.enable_x64(True):
            found = self._numbers(dict(parameters))
        model = copy(self.mj_model)
        set_numbers(model, found)
        return replace(self, mj_model=model)

    def host_difference(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """x - y in tangent space by the C engine, (..., ndx), for states (..., nx)."""
        if self.nx == self.ndx:
            return np.asarray(x - y)
        rows = (a.reshape(-1, self.nx) for a in np.broadcast_arrays(x, y))
        off = differences(self.joints, *rows)
        return off.reshape(*np.broadcast_shapes(x.shape, y.shape)[:-1], self.ndx)

    def host_integrate(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """x + dx by the C engine, (nx,)."""
        return integrate(self.mj_model, x, dx)

    def observe_replayed(self, x: np.ndarray, time: float) -> mujoco.MjData:
        """`mujoco.MjData` at a state (nx,), after mj_forward: what goals of replays receive."""
        return self.observer()(x, time)

    def left_out(self, states: np.ndarray) -> tuple[int, str] | None:
        """The first of states (n, nx) with a contact that the plan has not, and its geoms."""
        without = pairs_left_out(self.mj_model, self.contacts)
        observe = self.observer()
        for i, x in enumerate(states if without else []):
            contact = observe(x, 0.0).contact
            for pair in contact.geom[contact.efc_address >= 0].tolist():
                if without & {tuple(pair), tuple(pair[::-1])}:
                    a, b = (geom_name(self.mj_model, g) for g in pair)
                    return i, f"{a!r} touches {b!r}"
        return None

    @cached_property
    def _sound(self) -> mujoco.MjModel:
        """The C engine's model, whose contact solver converges; to copy one may take long."""
        return converged(self.mj_model)

    def observer(self) -> Callable[[np.ndarray, float], mujoco.MjData]:
        """`observe_replayed` for many states, in one MjData, which takes long to make."""
        model = self._sound
        data = mujoco.MjData(model)

        def observe(x: np.ndarray, time: float) -> mujoco.MjData:
            mujoco.mj_resetData(model, data)
            data.time = time
            set_state(model, data, x)
            mujoco.mj_forward(model, data)
            return data

        return observe


_TRACED = ("dt", "derivatives", "time")
_STATIC = ("substeps", "structure", "free_step", "numbers", "free")


def _flatten(dynamics: MjxDynamics) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """The model's arrays are children themselves, found once.

    MJX flattens a model in Python, which takes a millisecond or two, at every call of a compiled
    function.
    """
    model, found = dynamics.model, dynamics.__dict__.get("_arrays")
    if found is None or found[0] is not model:  # `at` puts another model into a copy
        found = model, *jax.tree.flatten(model, is_leaf=lambda leaf: leaf is None)
        object.__setattr__(dynamics, "_arrays", found)
    _, arrays, tree = found
    traced, static = (tuple(getattr(dynamics, n) for n in names) for names in (_TRACED, _STATIC))
    return (*arrays, *traced), (*static, tree)


def _unflatten(static: tuple[Any, ...], children: Iterable[Any]) -> MjxDynamics:
    """The dynamics with the structure they had, which traced numbers could not give."""
    *others, tree = static
    *arrays, dt, derivatives, time = children
    dynamics = object.__new__(MjxDynamics)
    model = jax.tree.unflatten(tree, arrays)
    values = dict(zip((*_TRACED, *_STATIC), (dt, derivatives, time, *others), strict=True))
    values |= {"model": model, "_arrays": (model, arrays, tree), "mj_model": None, "origin": None}
    for name, value in values.items():
        object.__setattr__(dynamics, name, value)
    return dynamics


def _flatten_with_keys(dynamics: MjxDynamics) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    children, static = _flatten(dynamics)
    paths = jax.tree_util.tree_leaves_with_path(dynamics.model, is_leaf=lambda leaf: leaf is None)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in paths]
    keys = [jax.tree_util.GetAttrKey(name) for name in (*names, *_TRACED)]
    return list(zip(keys, children, strict=True)), static


jax.tree_util.register_pytree_with_keys(MjxDynamics, _flatten_with_keys, _unflatten, _flatten)


def mujoco_model(dynamics: Dynamics, x: np.ndarray | None = None) -> mujoco.MjModel | None:
    """The MuJoCo model that dynamics come from; None if they come from a function.

    With a state x (nx,): the model as its parameters make it, where numbers of it are left open.

    Here and in `mjx_dynamics` it is asked whether dynamics are MuJoCo's. Not for compiled
    functions, where the model is not known.
    """
    if x is not None and isinstance(dynamics, Extended):
        dynamics = dynamics.inner_at(x)
    own = mjx_dynamics(dynamics)
    return None if own is None else own.mj_model


def mjx_dynamics(dynamics: Dynamics) -> MjxDynamics | None:
    """The dynamics of a model, or those inside of `Extended`; None if they come from a function."""
    inner = dynamics.inner if isinstance(dynamics, Extended) else dynamics
    return inner if isinstance(inner, MjxDynamics) else None


def _observe(
    model: mjx.Model, structure: Structure, x: Array, u: Array, time: ArrayLike | None
) -> tuple[mjx.Data, tuple[Array, ...]]:
    return one_step.forward(structure.fixed_in(model), x, u, time)


def _step(model: mjx.Model, structure: Structure, substeps: int, x: Array, u: Array) -> Array:
    def every(one: Callable[..., Array], model: mjx.Model, x: Array, u: Array) -> Array:
        return jax.lax.scan(lambda x, _: (one(model, x, u), None), x, length=substeps)[0]

    if has_constraints(model):  # their forces come from a loop, which stays one of arrays
        return every(one_step.step, structure.fixed_in(model), x, u)

    def one(model: mjx.Model, x: Array, u: Array, by_operations: bool = False) -> Array:
        return one_step.step(structure.fixed_in(model), x, u, by_operations)

    body = partial(one, by_operations=True)
    # Where all steps are too much, the loop stays one, if possible of scalar arithmetic
    if on_gpu():  # where kernels inside of a loop made iterations 6 to 25 times as long
        lean = scalarized(body, STEP_LIMIT, otherwise=one)
    else:
        in_kernel = scalarized(body, outermost=True, otherwise=one)
        lean = one_step.with_jacobian(in_kernel, partial(_jacobian, one), one)
    whole = scalarized(partial(every, body), STEP_LIMIT, otherwise=partial(every, lean))
    return whole(model, x, u)


def _jacobian(
    one: Callable[..., Array], model: mjx.Model, x: Array, u: Array
) -> tuple[Array, Array]:
    """A physics step and its Jacobian, in scalar arithmetic where that is possible."""
    joints, ndx = Joints.of(model), 2 * model.nv + model.na

    def moved(dz: Array) -> Array:
        return one(model, joints.integrate(x, dz[:ndx]), u + dz[ndx:])

    by, size = InScalars(Autodiff()), ndx + model.nu
    J, value = by.jacobian(moved, size, jax.random.key(0))  # which draws nothing
    return value, J


# One trace of each, shared by all that differentiate it
_observe = jax.jit(_observe, static_argnums=1)
_step = jax.jit(_step, static_argnums=(1, 2))
