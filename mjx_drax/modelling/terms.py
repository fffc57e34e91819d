"""Residual terms by name: costs and constraints of common tasks from a few lines.

    r(data, u) = sqrt(w) (what is - what is wanted),    so that    1/2 |r|^2 = w/2 |is - wanted|^2

A `Term` is a function like those that a user writes, and goes where they go; `+` stacks residuals,
of terms and of plain functions. Names are looked up when a term is made. Targets, weights, margins
and sizes are traced numbers: another value does not recompile. A running residual is summed over
the knots without a factor dt: for a weight per second, give the weight times dt.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.base.numbers import numbers as real_numbers
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.modelling.distances import DISTANCES, SPHERE, Shape
from mjx_drax.modelling.hulls import HULL_DISTANCES, HULLS, MESH, hulls_of
from mjx_drax.physics import quaternion
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.joints import Joints
from mjx_drax.physics.mjx_model import unknown_sensors
from mjx_drax.physics.motors import Actuators
from mjx_drax.physics.observed import not_computed
from mjx_drax.physics.source import Given, index, load
from mjx_drax.problem.cost import as_partial, at_knot, depends_on_knot
from mjx_drax.problem.tracing import plain
from mjx_drax.problem.trajectory import Knot

Names = str | Iterable[str]


@register_dataclass
@dataclass(frozen=True, eq=False)
class Reference:
    """A target for each knot: rows (K + 1, n), or a function of time [s] that returns (n,)."""

    values: Any

    def at(self, knot: Knot) -> Array:
        """The target at one knot, (n,); the last row behind the end, the first before it."""
        if isinstance(self.values, Partial):
            return jnp.asarray(self.values(knot.time))
        row: Array = self.values[jnp.clip(knot.index, 0, len(self.values) - 1)]
        return row

    def check_knots(self, label: str, times: np.ndarray) -> None:
        """Complain about another number of rows than there are knots."""
        if not isinstance(self.values, Partial) and len(self.values) != len(times):
            raise DraxError(
                f"{label} follows a reference of {len(self.values)} rows: give {len(times)}, one "
                "for each of x_0..x_K, or a function of time."
            )


def _at(number: Any, knot: Knot) -> Any:
    return number.at(knot) if isinstance(number, Reference) else at_knot(number, knot)


@register_dataclass
@dataclass(frozen=True, eq=False)
class Term:
    """scale * function(data, u, where, *numbers): a residual r(data, u) or r(data), (n,).

    Attributes:
        function: the code, a function of a module.
        where: what it reads: addresses in `mjx.Data`.
        numbers: targets, `Reference`s and sizes, or the terms of a sum.
        scale: square roots of the weights, (n,) or ().
        sizes: nq and nv of the model that it was made for, if it reads one.
    """

    function: Callable[..., Array] = field(metadata=Static)
    where: tuple[Any, ...] = field(metadata=Static)
    numbers: tuple[Any, ...]
    scale: Array
    sizes: tuple[int, int] | None = field(default=None, metadata=Static)

    def __call__(self, data: Any, u: Array | None = None, knot: Knot | None = None) -> Array:
        """The residual (n,), at a knot with data and control u, or at the end without u.

        Raises:
            DraxError: it was made for another model.
        """
        if self.sizes is not None and self.sizes != (len(data.qpos), len(data.qvel)):
            raise DraxError(
                f"a term was made for a model with {self.sizes[0]} positions and {self.sizes[1]} "
                f"velocities, but this one has {len(data.qpos)} and {len(data.qvel)}: make it with "
                "Terms of this model."
            )
        numbers = self.numbers if knot is None else [_at(number, knot) for number in self.numbers]
        return self.scale * self.function(data, u, self.where, *numbers)

    @property
    def takes_knot(self) -> bool:
        """Whether it follows a reference, or a term of a sum does."""
        return any(isinstance(n, Reference) or depends_on_knot(n) for n in self.numbers)

    def __add__(self, other: Callable[..., Array] | int) -> Term:
        """Both residuals in one vector, this one's first; `sum` of terms works as well."""
        return sum_of(self, other)

    def __radd__(self, other: Callable[..., Array] | int) -> Term:
        """The same, the other one's first."""
        return sum_of(other, self)


def sum_of(*given: Any) -> Term:
    """The vectors of all parts in one, the first part's first; without 0, which `sum` begins with.

    Raises:
        DraxError: a part is no function.
    """
    parts = [part for part in given if not (isinstance(part, int) and part == 0)]
    if len(parts) == 1 and isinstance(parts[0], Term):
        return parts[0]
    if not all(callable(part) for part in parts):
        raise DraxError(f"{given} cannot be added: add terms, or functions that return vectors.")
    return Term(_stacked, (), tuple(map(as_partial, parts)), jnp.ones(()))


def _stacked(data: Any, u: Array | None, where: tuple[Any, ...], *parts: Any) -> Array:
    arguments = (data,) if u is None else (data, u)
    return jnp.concatenate([jnp.ravel(part(*arguments)) for part in parts])


class Terms:
    """Makes the terms of one model.

    Every method takes `weight`, w >= 0: one number, or one for each element of the residual (0
    leaves that element free). Targets of n numbers may be references as well: rows (K + 1, n), one
    for each of the knots 0..K, or a function of time [s] that returns (n,).

    Args:
        model: MJCF file, XML string, `mujoco.MjSpec` or `mujoco.MjModel`.
        actuators: as for `from_mjcf`, if the model gets them.

    Raises:
        DraxError: by every method, for a name that the model has not (listing those it has), a
            negative weight, numbers that are not finite, or of the wrong size.
    """

    def __init__(self, model: Given, actuators: Actuators | None = None) -> None:
        self.model = load(model, actuators)

    def posture(
        self, target: str | ArrayLike | Mapping[str, ArrayLike], *, weight: ArrayLike = 1.0
    ) -> Term:
        """Joint positions qpos against a target, (nv,) or as many as the named joints have.

        Hinges [rad] and slides [m] by difference; the quaternion q of a ball or free joint by the
        rotation vector of target^-1 q [rad], which jumps where the two are half a turn apart.

        Args:
            target: name of a keyframe, all of qpos (nq,), or {joint: value} with a number, a
                quaternion (4,) for a ball or a pose (7,) for a free joint.
        """
        model = self.model
        named, qpos = None, np.array(model.qpos0)
        if isinstance(target, str):
            qpos = np.array(model.key_qpos[index(model, "keyframe", target)])
        elif isinstance(target, Mapping):
            named = list(target)
            for joint, (name, value) in zip(
                self._indices("joint", named), target.items(), strict=True
            ):
                at, size = model.jnt_qposadr[joint], _QPOS[model.jnt_type[joint]]
                qpos[at : at + size] = _numbers(f"posture of {name!r}", value, size)
        else:
            qpos = _target("posture", target, model.nq)
        joints = Joints.of(model)
        for row in np.atleast_2d(_rows(qpos)):
            for q, _ in joints.quaternions:
                _unit("posture", row[q : q + 4])
        at = self._dofs(named)
        return self._term(_posture, (joints, tuple(at)), (qpos,), "posture", len(at), weight)

    def velocity(
        self, joints: Names | None = None, *, target: ArrayLike = 0.0, weight: ArrayLike = 1.0
    ) -> Term:
        """qvel [rad/s, m/s] of all joints or of the named ones, against a target of its size."""
        at = self._dofs(joints)
        wanted = _target("target of velocity", target, len(at), alike=True)
        return self._term(_read, ("qvel", tuple(at)), (wanted,), "velocity", len(at), weight)

    def control(
        self, actuators: Names | None = None, *, target: ArrayLike = 0.0, weight: ArrayLike = 1.0
    ) -> Term:
        """u of all actuators or of the named ones, against a target of its size; running only."""
        at = list(range(self.model.nu))
        if actuators is not None:
            at = self._indices("actuator", actuators)
        wanted = _target("target of control", target, len(at), alike=True)
        return self._term(_control, tuple(at), (wanted,), "control", len(at), weight)

    def sensor(self, name: str, *, target: ArrayLike = 0.0, weight: ArrayLike = 1.0) -> Term:
        """What a sensor reads, in its units, against a target of its size.

        Raises:
            DraxError: MJX does not compute the sensor.
        """
        sensor = index(self.model, "sensor", name)
        if unknown_sensors(self.model)[sensor]:
            raise not_computed(name)
        start, size = int(self.model.sensor_adr[sensor]), int(self.model.sensor_dim[sensor])
        wanted = _target(f"target of sensor {name!r}", target, size, alike=True)
        where = (sensor, tuple(range(start, start + size)))
        return self._term(_sensed, where, (wanted,), f"sensor {name!r}", size, weight)

    def site(
        self,
        name: str,
        position: ArrayLike | None = None,
        orientation: ArrayLike | None = None,
        *,
        weight: ArrayLike = 1.0,
    ) -> Term:
        """Position of a site against a target [m] (3,), then its orientation [rad] (3,), or either.

        Args:
            name: the site.
            position: in the world, (3,).
            orientation: in the world, a quaternion (4,) or a rotation matrix (3, 3). The residual
                is the rotation vector from it, in its axes, which jumps at half a turn.
            weight: one number, or (3,) or (6,).
        """
        return self._pose("site", name, position, orientation, weight)

    def body(
        self,
        name: str,
        position: ArrayLike | None = None,
        orientation: ArrayLike | None = None,
        *,
        weight: ArrayLike = 1.0,
    ) -> Term:
        """The same for the frame of a body."""
        return self._pose("body", name, position, orientation, weight)

    def upright(
        self,
        body: str,
        axis: ArrayLike = (0, 0, 1),
        up: ArrayLike = (0, 0, 1),
        *,
        weight: Any = 1.0,
    ) -> Term:
        """R axis - up (3,): an axis of a body along a direction of the world, smooth everywhere."""
        at = (index(self.model, "body", body),)
        ends = [_unit(k, _numbers(k, v, 3)) for k, v in (("axis", axis), ("up", up))]
        return self._term(_upright, at, ends, f"upright {body!r}", 3, weight)

    def centre_of_mass(
        self, position: ArrayLike, body: str | None = None, *, weight: ArrayLike = 1.0
    ) -> Term:
        """Centre of mass [m] (3,) of the model, or of a body and what it carries, to a target."""
        at = 0 if body is None else index(self.model, "body", body)
        wanted = _target("position of centre_of_mass", position, 3)
        return self._term(_read, ("subtree_com", at), (wanted,), "centre_of_mass", 3, weight)

    def clearance(self, geoms: Names, others: Names, *, margin: ArrayLike = 0.0) -> Term:
        """margin - distance [m], (n,), <= 0 where geoms keep their distance: an inequality.

        One value for each of `geoms` with each of `others`, which vary fastest. Distances
        are signed; `modelling.distances` says for which pairs they are exact (all but two kinds).
        A mesh counts as its convex hull, and has distances from all other kinds but height
        fields: `modelling.hulls`.

        Args:
            geoms: name or names.
            others: name or names.
            margin: one number, or (n,).

        Raises:
            DraxError: also for a geom with itself, and for kinds that have no distance function.
        """
        model = self.model
        sizes = np.where((model.geom_type == SPHERE)[:, None], [1.0, 0, 0], 1.0) * model.geom_size
        groups: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        firsts, seconds = (self._indices("geom", names) for names in (geoms, others))
        for a in firsts:
            for b in seconds:
                low, high = sorted((a, b), key=lambda g: int(model.geom_type[g]))
                kinds = int(model.geom_type[low]), int(model.geom_type[high])
                if a == b or kinds not in _DISTANCES:
                    raise DraxError(_no_distance(model, a, b))
                count = sum(map(len, groups.values()))
                groups.setdefault(kinds, []).append((low, high, count))
        pairs = [pair for group in groups.values() for pair in group]
        order = tuple(int(i) for i in np.argsort([place for *_, place in pairs]))
        where = tuple((kinds, *zip(*group, strict=True)) for kinds, group in groups.items())
        wanted = _numbers("margin of clearance", margin, len(pairs), alike=True)
        used = []
        for kinds, group in groups.items():
            firsts, seconds, _ = map(list, zip(*group, strict=True))
            both = zip(kinds, (firsts, seconds), strict=True)
            hulled = HULLS if MESH in kinds else ()
            used.append(tuple(hulls_of(model, g) if k in hulled else sizes[g] for k, g in both))
        return self._term(_clearance, (where, order), (wanted, *used), "clearance", len(pairs), 1.0)

    def _pose(
        self,
        kind: str,
        name: str,
        position: ArrayLike | None,
        orientation: ArrayLike | None,
        weight: ArrayLike,
    ) -> Term:
        model, label, at = self.model, f"{kind} {name!r}", index(self.model, kind, name)
        size = 3 * ((position is not None) + (orientation is not None))
        if not size:
            raise DraxError(f"{label} has no target: give a position, an orientation or both.")
        weights, parts = _weights(label, size, weight), []
        if position is not None:
            wanted = _target(f"position of {label}", position, 3)
            where = ("site_xpos" if kind == "site" else "xpos", at)
            parts.append(self._term(_read, where, (wanted,), label, 3, weights[:3]))
        if orientation is not None:
            # A site is turned by a fixed quaternion within its body, whose own is in mjx.Data.
            body, turned = at, np.array([1.0, 0.0, 0.0, 0.0])
            if kind == "site":
                body, turned = int(model.site_bodyid[at]), model.site_quat[at]
            wanted = _quaternion(f"orientation of {label}", orientation)
            parts.append(
                self._term(_orientation, (body,), (wanted, turned), label, 3, weights[-3:])
            )
        return parts[0] if len(parts) == 1 else parts[0] + parts[1]

    def _dofs(self, joints: Names | None) -> list[int]:
        """Places in qvel of all joints or of the named ones, in the order of the names."""
        if joints is None:
            return list(range(self.model.nv))
        found = self._indices("joint", joints)
        return [int(v) for joint in found for v in np.flatnonzero(self.model.dof_jntid == joint)]

    def _indices(self, kind: str, names: Names) -> list[int]:
        listed = [names] if isinstance(names, str) or not isinstance(names, Iterable) else names
        found = [index(self.model, kind, name) for name in listed]
        if not found:
            raise DraxError(f"no {kind} is named: give at least one name.")
        return found

    def _term(
        self,
        function: Callable[..., Array],
        where: tuple[Any, ...],
        numbers: Iterable[Any],
        label: str,
        size: int,
        weight: ArrayLike,
    ) -> Term:
        scale = jnp.sqrt(jnp.asarray(_weights(label, size, weight)))
        values = jax.tree.map(jnp.asarray, tuple(numbers))
        return Term(function, where, values, scale, (self.model.nq, self.model.nv))


_DISTANCES = DISTANCES | HULL_DISTANCES
_QPOS = np.array([7, 4, 1, 1])  # numbers in the position of a free, ball, slide and hinge joint


# The residuals: functions of data, control, addresses and numbers


def _read(data: Any, u: Array | None, where: tuple[Any, ...], target: Array) -> Array:
    name, at = where
    return getattr(data, name)[np.array(at)] - target


def _sensed(data: Any, u: Array | None, where: tuple[Any, ...], target: Array) -> Array:
    sensor, at = where
    if not hasattr(data, "sensor"):  # plain `mjx.Data`
        return _read(data, u, ("sensordata", at), target)
    reading: Array = data.sensor(sensor).data - target
    return reading


def _control(data: Any, u: Array | None, where: tuple[Any, ...], target: Array) -> Array:
    if u is None:
        raise DraxError("a control term was called without u: there is no control at the end. Use "
                        "it in the running cost or in the constraints of the stages.")  # fmt: skip
    return u[np.array(where)] - target


def _posture(data: Any, u: Array | None, where: tuple[Any, ...], target: Array) -> Array:
    joints, at = where
    return joints.difference(data.qpos, target)[np.array(at)]


def _orientation(
    data: Any, u: Array | None, where: tuple[Any, ...], target: Array, turned: Array
) -> Array:
    return quaternion.between(target, quaternion.multiply(data.xquat[where[0]], turned))


def _upright(data: Any, u: Array | None, where: tuple[Any, ...], axis: Array, up: Array) -> Array:
    return data.xmat[where[0]] @ axis - up


def _clearance(
    data: Any, u: Array | None, where: tuple[Any, ...], margin: Array, *sizes: Any
) -> Array:
    groups, order = where
    distances = []
    for (kinds, low, high, _), size in zip(groups, sizes, strict=True):
        shapes = [
            Shape(data.geom_xpos[at], data.geom_xmat[at], own)
            for own, at in zip(size, (np.array(low), np.array(high)), strict=True)
        ]
        distances.append(jax.vmap(_DISTANCES[kinds])(*shapes))
    return margin - jnp.concatenate(distances)[np.array(order)]


# What a user gives


def _numbers(label: str, value: Any, size: int, alike: bool = False) -> np.ndarray:
    """Finite numbers (size,); one number stands for all if there is one, or if they are alike."""
    try:
        array = real_numbers(value)
    except (TypeError, ValueError) as error:
        raise DraxError(f"{label} is {shown(value)}: give {size} number(s).") from error
    one = array.ndim == 0 and (alike or size == 1)
    if (not one and array.shape != (size,)) or not np.isfinite(array).all():
        give = f"one number, or {size}" if alike and size != 1 else f"{size} number(s)"
        raise DraxError(f"{label} is {shown(value)}: give {give}, all finite.")
    return np.broadcast_to(array, (size,))


def _target(label: str, value: Any, size: int, alike: bool = False) -> Any:
    """Finite numbers (size,), or a `Reference`: rows (K + 1, size), or a function of time [s]."""
    if callable(value):
        function = as_partial(value)
        try:
            shape = jax.eval_shape(function, jnp.zeros(())).shape
        except Exception as error:
            raise DraxError(
                f"{label} failed when it was traced: {plain(error)}. Make it a JAX function of the "
                f"time, one number, that returns {size} number(s)."
            ) from error
        if shape != (size,):
            raise DraxError(f"{label} returned shape {shape}: return {size} number(s), ({size},).")
        return Reference(function)
    if np.ndim(value) != 2:
        return _numbers(label, value, size, alike)
    return Reference(jnp.asarray(np.stack([_numbers(label, row, size) for row in value])))


def _rows(target: Any) -> np.ndarray:
    """The numbers of a target that are known."""
    if not isinstance(target, Reference):
        return np.asarray(target)
    known = not isinstance(target.values, Partial)
    return np.asarray(target.values) if known else np.zeros((0, 0))


def _unit(label: str, vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    if length < 1e-9:
        raise DraxError(f"{label} has the direction or quaternion {vector}: it must not be zero.")
    return vector / length


def _quaternion(label: str, value: Any) -> np.ndarray:
    """A unit quaternion (4,) from one of any length, or from a rotation matrix (3, 3)."""
    if np.shape(value) != (3, 3):
        return _unit(label, _numbers(f"{label} (a quaternion, or a matrix (3, 3))", value, 4))
    matrix = _numbers(label, np.ravel(value), 9).reshape(3, 3)
    if np.abs(matrix.T @ matrix - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise DraxError(
            f"{label} is {shown(matrix.tolist())}: give a rotation matrix, R'R = I, det R = 1."
        )
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, matrix.ravel())
    return quaternion


def _weights(label: str, size: int, weight: ArrayLike) -> np.ndarray:
    weights = _numbers(f"weight of {label}", weight, size, alike=True)
    if (weights < 0).any():
        raise DraxError(
            f"weight of {label} is {shown(weight)}: give numbers that are not negative."
        )
    return weights


def _no_distance(model: mujoco.MjModel, a: int, b: int) -> str:
    names = [model.geom(g).name for g in (a, b)]
    if a == b:
        return f"clearance of geom {names[0]!r} with itself: give two different geoms."
    kinds = [mujoco.mjtGeom(model.geom_type[g]).name[7:].lower() for g in (a, b)]
    return (
        f"clearance between {names[0]!r} ({kinds[0]}) and {names[1]!r} ({kinds[1]}): there is no "
        "distance function for this pair. Put spheres, capsules or boxes around one of them."
    )
