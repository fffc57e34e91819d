"""Which pairs of geoms may touch, and which of them a plan has contacts of."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.physics._mjx import geom_pairs
from mjx_drax.physics.engine import mujoco

_DISABLE = mujoco.mjtDisableBit

Pair = tuple[int, int]
Contacts = bool | int | Sequence[tuple[str | int, str | int]]
"""True: the nearest of all; False: none; a number: how many; else pairs of patterns or of geoms."""


def geom_name(model: mujoco.MjModel, g: int) -> str:
    """A geom's name, or its number and body."""
    geom = model.geom(g)
    body = int(geom.bodyid[0])
    return str(geom.name or f"geom {g} of body {model.body(body).name or body}")


def of_hulls(model: mujoco.MjModel, pair: Sequence[int]) -> bool:
    """Whether two geoms touch as convex hulls: a mesh with a mesh or a box."""
    mesh, box = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_BOX
    kinds = set(model.geom_type[list(pair)].tolist())
    return mesh in kinds and kinds <= {mesh, box}


def contact_pairs(model: mujoco.MjModel) -> Iterator[Pair]:
    """All pairs of geoms between which MuJoCo may make a contact; the lower type comes first."""
    if not model.opt.disableflags & (_DISABLE.mjDSBL_CONTACT | _DISABLE.mjDSBL_CONSTRAINT):
        yield from (pair[:2] for pair in numbered_pairs(model))


def numbered_pairs(model: Any) -> Iterator[tuple[int, int, int]]:
    """All pairs that MJX looks at and MuJoCo too, each with the number of its <pair>, or -1.

    The model is MuJoCo's or MJX's.
    """
    for a, b, i in geom_pairs(model):
        if i >= 0 or not _both_stay(model, a, b):
            yield int(a), int(b), int(i)


def _both_stay(model: Any, a: int, b: int) -> bool:
    """Whether no joint moves either geom: MuJoCo lets none of the world's touch a mocap body's."""
    bodies = model.body_weldid[model.geom_bodyid[[a, b]]]
    return not model.body_dofnum[bodies].any()


def touching(model: mujoco.MjModel, contacts: Contacts) -> set[Pair]:
    """The pairs of geoms that a plan with these `contacts` has contacts of."""
    return set(contact_pairs(model)) - left_out(model, contacts)


def left_out(model: mujoco.MjModel, contacts: Contacts) -> set[Pair]:
    """The pairs of geoms that may touch and of which a plan with these `contacts` has none.

    Raises:
        DraxError: contacts is none of `Contacts`, no geom or body fits a pattern, or no two fitting
            geoms may touch.
    """
    if isinstance(contacts, bool | int | np.integer) and contacts >= 0:
        return set() if contacts else set(contact_pairs(model))
    if isinstance(contacts, str) or not isinstance(contacts, Sequence):
        raise DraxError(_wrong(contacts))
    every, kept = set(contact_pairs(model)), set()
    for entry in contacts:
        if isinstance(entry, str) or not isinstance(entry, Sequence) or len(entry) != 2:
            raise DraxError(_wrong(entry))
        one, other = (_geoms(model, pattern) for pattern in entry)
        found = {(a, b) for a, b in every if (a in one and b in other) or (b in one and a in other)}
        if not found:
            raise DraxError(
                f"contacts has {shown(tuple(entry))}, and MuJoCo makes no contact between them: "
                "contype and conaffinity, an exclude, or their bodies keep them from it. Leave it "
                "out, or name others."
            )
        kept |= found
    return every - kept


def _wrong(given: object) -> str:
    return (
        f"contacts is {shown(given)}: give True, False or a whole number, or pairs of names of "
        'geoms or bodies, such as [("foot_*", "floor")].'
    )


def _geoms(model: mujoco.MjModel, pattern: str | int) -> set[int]:
    """The geoms that a pattern names, and those of the bodies that it names."""
    if isinstance(pattern, int | np.integer) and 0 <= pattern < model.ngeom:
        return {int(pattern)}
    if not isinstance(pattern, str):
        raise DraxError(_wrong(pattern))
    own = [model.geom(g).name for g in range(model.ngeom)]
    of_body = [model.body(int(b)).name for b in model.geom_bodyid]
    found = {
        g
        for g in range(model.ngeom)
        for name in (own[g], of_body[g])
        if name and fnmatch.fnmatchcase(name, pattern)
    }
    if not found:
        names = [name for name in dict.fromkeys([*own, *of_body]) if name]
        near = difflib.get_close_matches(pattern.strip("*?"), names, 3, 0.3) or names[:5]
        raise DraxError(
            f"contacts names {pattern!r}, which is no geom, and no body with geoms: the nearest "
            f"names are {', '.join(map(repr, near)) or 'none, because none has one'}."
        )
    return found
