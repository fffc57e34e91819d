"""What costs see of a knot: `mjx.Data`, whose parts can be read by name as in `mujoco.MjData`.

    data.site("tip").xpos    data.body("torso").xquat    data.sensor("touch").data

A function of these works in a cost and in a goal alike, because names and shapes are MuJoCo's: a
matrix is (9,), and what a joint, a sensor or an actuator has is a vector, also where it is one
number. An element may also be given by its number. In `data.sensordata` what MJX does not compute
is NaN, and so is `data.qfrc_fluid`.
"""

from dataclasses import dataclass, fields
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.physics._mjx import internal, mjx
from mjx_drax.physics.joints import BALL, FREE
from mjx_drax.physics.mjx_model import NOT_COMPUTED
from mjx_drax.physics.step import kinds_of_sensors

_OWN = {
    "body": ("xpos", "xquat", "xmat", "xipos", "ximat", "cvel", "subtree_com"),
    "geom": ("geom_xpos", "geom_xmat"),
    "site": ("site_xpos", "site_xmat"),
    "camera": ("cam_xpos", "cam_xmat"),
    "joint": (
        *("qpos", "qvel", "qacc", "qacc_smooth", "xanchor", "xaxis"),
        *("qfrc_actuator", "qfrc_bias", "qfrc_smooth", "qfrc_constraint"),
    ),
    "actuator": ("ctrl", "actuator_force", "actuator_length", "actuator_velocity"),
    "tendon": ("ten_length", "ten_velocity"),
    "sensor": ("sensordata",),
}
"""The arrays of `mjx.Data` that hold something of each kind of element. Left out are those that
MuJoCo computes only for sensors, and those that hold something else in a step of this package."""

_ELSEWHERE = {
    "subtree_linvel": "a sensor subtreelinvel",
    "subtree_angmom": "a sensor subtreeangmom",
    "cacc": "a sensor accelerometer or framelinacc",
    "cfrc_int": "a sensor force or torque",
    "cfrc_ext": "a sensor touch or contact",
    "contact": "a sensor touch or contact",
    "ncon": "a sensor touch or contact",
}
"""Arrays that MJX leaves 0, or fills as MuJoCo does not, and what has such numbers instead."""

_PREFIXES = ("geom_", "site_", "cam_", "actuator_", "ten_", "sensor")
_NAME_ADDRESSES = {"joint": "jnt", "camera": "cam"}
_WIDTHS = {FREE: (7, 6), BALL: (4, 3)}  # in qpos and in qvel


@dataclass(frozen=True)
class Names:
    """The names of a model's elements, and where their numbers are. Static: it can be hashed.

    Attributes:
        of: of each kind in the order of `_OWN`: the names of its elements, "" where it has none.
        sensors: (first, one after the last) entry in sensordata, of each sensor.
        readings: of each sensor, which of `Observed.readings` has it.
        positions, velocities: the same in qpos and qvel, of each joint.
        unknown: sensors that MJX does not compute.
    """

    of: tuple[tuple[str, ...], ...]
    sensors: tuple[tuple[int, int], ...]
    readings: tuple[int, ...]
    positions: tuple[tuple[int, int], ...]
    velocities: tuple[tuple[int, int], ...]
    unknown: tuple[int, ...]

    @classmethod
    def in_model(cls, model: mjx.Model) -> "Names":
        """The names in a model, which are static in it."""
        text = model.names

        def listed(kind: str) -> tuple[str, ...]:
            starts = getattr(model, f"name_{_NAME_ADDRESSES.get(kind, kind)}adr")
            return tuple(text[at : text.index(b"\0", at)].decode() for at in map(int, starts))

        def spans(starts: Any, widths: Any) -> tuple[tuple[int, int], ...]:
            return tuple((int(a), int(a) + int(n)) for a, n in zip(starts, widths, strict=True))

        widths = [_WIDTHS.get(int(kind), (1, 1)) for kind in model.jnt_type]
        return cls(
            tuple(map(listed, _OWN)),
            spans(model.sensor_adr, model.sensor_dim),
            tuple(map(kinds_of_sensors(model).index, model.sensor_type.tolist())),
            spans(model.jnt_qposadr, [q for q, _ in widths]),
            spans(model.jnt_dofadr, [v for _, v in widths]),
            tuple(np.flatnonzero(model.sensor_intprm[:, 0] == NOT_COMPUTED).tolist()),
        )

    def index(self, kind: str, name: object) -> int:
        """Number of an element.

        Raises:
            DraxError: there is none of that name or number; lists those that there are.
        """
        names = self.of[list(_OWN).index(kind)]
        if isinstance(name, str) and name and name in names:
            return names.index(name)
        if isinstance(name, int | np.integer) and 0 <= name < len(names):
            return int(name)
        known = ", ".join(repr(n) for n in names if n) or "no named one"
        raise DraxError(f"the model has no {kind} {shown(name)}: there is {known}.")


class Element:
    """One element of a model at a knot: its arrays by the names that `mujoco.MjData` has for them.

    `data.site("tip")` has xpos (3,) and xmat (9,); `dir()` of an element lists what it has.
    """

    def __init__(self, data: "Observed", kind: str, name: str | int) -> None:
        self._data, self._kind = data, kind
        self.id = data.names.index(kind, name)
        self.name = data.names.of[list(_OWN).index(kind)][self.id]
        self._arrays = {_attribute(array): array for array in _OWN[kind]}

    def __dir__(self) -> list[str]:
        return sorted(["id", "name", *self._arrays])

    def __getattr__(self, attribute: str) -> Array:
        if attribute.startswith("_"):  # before there is one, as when it is copied
            raise AttributeError(attribute)
        if attribute not in self._arrays:
            raise AttributeError(
                f"a {self._kind} has no {attribute!r}: it has {', '.join(self._arrays)}."
            )
        array = self._arrays[attribute]
        holder = self._data if array in _FIELDS else internal(self._data)
        return self._part(array, getattr(holder, array))

    def _part(self, name: str, values: Array) -> Array:
        """This element's part of an array (..., elements or entries, ...)."""
        names, i = self._data.names, self.id
        if name == "qpos":
            return values[..., slice(*names.positions[i])]
        if name == "sensordata":
            if i in names.unknown:
                raise not_computed(self.name)
            return self._data.readings[names.readings[i]][..., slice(*names.sensors[i])]
        if name.startswith("q"):
            return values[..., slice(*names.velocities[i])]
        if self._kind in ("actuator", "tendon"):
            return values[..., i : i + 1]
        if name.endswith("mat"):
            own = values[..., i, :, :]
            return jnp.reshape(own, (*own.shape[:-2], 9))
        return values[..., i, :]


def not_computed(sensor: str) -> DraxError:
    """The error of a cost that reads such a sensor."""
    return DraxError(
        f"sensor {sensor!r} is of a kind that MJX does not compute: use positions, velocities and "
        "forces of bodies, sites and joints instead."
    )


def _attribute(array: str) -> str:
    """What an element calls its part of an array of `mjx.Data`."""
    for prefix in _PREFIXES:
        array = array.removeprefix(prefix)
    return array


class Observed(mjx.Data):
    """`mjx.Data` that knows the names of its model, as `mujoco.MjData` does.

    Attributes:
        readings: `sensordata` with the sensors of one type alone, for each type, so that a cost
            that reads one of them does not need the others.
    """

    # Annotations of this module are types, not texts: mjx asks which of them hold arrays
    names: Names
    readings: tuple[Array, ...]

    @classmethod
    def of(cls, model: mjx.Model, data: mjx.Data, readings: tuple[Array, ...]) -> "Observed":
        """The data with the names of its model."""
        arrays = {field.name: getattr(data, field.name) for field in fields(data)}
        arrays["qfrc_passive"] = arrays["qfrc_passive"] + arrays["qfrc_applied"]  # see `step`
        arrays["qfrc_applied"] = jnp.zeros_like(arrays["qfrc_applied"])
        arrays["qfrc_fluid"] = jnp.full_like(arrays["qfrc_fluid"], jnp.nan)
        names = Names.in_model(model)
        for i in names.unknown:  # to MJX they are 0
            entries = slice(*names.sensors[i])
            arrays["sensordata"] = arrays["sensordata"].at[entries].set(jnp.nan)
        return cls(**arrays, names=names, readings=readings)

    def __getattr__(self, name: str) -> Any:
        """What MJX keeps in a part of its own."""
        if name in _ELSEWHERE:
            raise DraxError(f"data.{name} is not computed in a plan: use {_ELSEWHERE[name]}.")
        if name.startswith("_") or not hasattr(internal(self), name):
            raise AttributeError(f"mjx.Data has no {name!r}.")
        return getattr(internal(self), name)

    def body(self, name: str | int) -> Element:
        """A body: xpos (3,), xquat (4,), xmat (9,), xipos, ximat, cvel (6,), subtree_com (3,)."""
        return Element(self, "body", name)

    def geom(self, name: str | int) -> Element:
        """A geom: xpos (3,), xmat (9,)."""
        return Element(self, "geom", name)

    def site(self, name: str | int) -> Element:
        """A site: xpos (3,), xmat (9,)."""
        return Element(self, "site", name)

    def camera(self, name: str | int) -> Element:
        """A camera: xpos (3,), xmat (9,)."""
        return Element(self, "camera", name)

    def joint(self, name: str | int) -> Element:
        """A joint: qpos (1,), (4,) or (7,), qvel (1,), (3,) or (6,), qacc, xanchor, xaxis (3,)."""
        return Element(self, "joint", name)

    def actuator(self, name: str | int) -> Element:
        """An actuator: ctrl, force, length and velocity, (1,) each."""
        return Element(self, "actuator", name)

    def tendon(self, name: str | int) -> Element:
        """A tendon: length and velocity, (1,) each."""
        return Element(self, "tendon", name)

    def sensor(self, name: str | int) -> Element:
        """A sensor: data, with as many numbers as the sensor has."""
        return Element(self, "sensor", name)


_FIELDS = {field.name for field in fields(mjx.Data)}
