"""Numbers of a model that a problem leaves open, in the C engine.

MuJoCo's compiler derives constants from numbers of a model, and the engine takes these in their
place. MJX computes from the numbers themselves; so must a replay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.physics.c_engine.states import quiet
from mjx_drax.physics.engine import mujoco

DERIVED = (
    "dof_M0",
    "body_subtreemass",
    "body_sameframe",
    "geom_sameframe",
    "site_sameframe",
    "geom_rbound",
    "geom_aabb",
)
"""What the engine takes in place of the numbers that it follows from, as MJX does not."""

_PLACES = {"geom_size", "geom_pos", "geom_quat"}


Scratch = tuple[mujoco.MjModel, mujoco.MjData]


def scratch_of(model: mujoco.MjModel) -> Scratch:
    """What `set_numbers` works with, for any number of models that are alike."""
    changed = copy(model)
    return changed, mujoco.MjData(changed)


def set_numbers(
    model: mujoco.MjModel, numbers: Mapping[str, Any], scratch: Scratch | None = None
) -> None:
    """Change numbers of a model, by the names of its fields.

    Args:
        model: that is changed.
        numbers: of any shape with the field's entries, such as {"body_mass": (nbody,)}.
        scratch: from `scratch_of`, for many models.

    Raises:
        DraxError: the engine cannot follow them: a mass of zero, or of a body for which MuJoCo's
            compiler took a short cut.
    """
    changed, data = scratch or scratch_of(model)
    for name, values in numbers.items():
        there = getattr(changed, name)
        there[...] = np.asarray(values, float).reshape(there.shape)
    try:
        with quiet():
            mujoco.mj_setConst(changed, data)
    except mujoco.FatalError as error:
        raise DraxError(
            f"MuJoCo cannot take {' and '.join(numbers)} from model_numbers: {error}. Change the "
            'bounds of the parameters; for a body that is "simple", write simple="false" into its '
            "element, which leaves out a short cut of MuJoCo's compiler."
        ) from error
    if "geom_size" in numbers:
        _bound(changed)
    if _PLACES & set(numbers):  # boxes around several geoms of a body are as they were
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    for name in (*numbers, *DERIVED):
        getattr(model, name)[...] = getattr(changed, name)


def _bound(model: mujoco.MjModel) -> None:
    """The spheres and boxes around geoms that have sizes of their own."""
    kinds = mujoco.mjtGeom
    for g, (a, b, c) in enumerate(model.geom_size):
        around = {
            kinds.mjGEOM_SPHERE: (a, (a, a, a)),
            kinds.mjGEOM_CAPSULE: (a + b, (a, a, a + b)),
            kinds.mjGEOM_ELLIPSOID: (max(a, b, c), (a, b, c)),
            kinds.mjGEOM_CYLINDER: (math.hypot(a, b), (a, a, b)),
            kinds.mjGEOM_BOX: (math.hypot(a, b, c), (a, b, c)),
        }.get(kinds(model.geom_type[g]))
        if around is not None:
            model.geom_rbound[g], model.geom_aabb[g] = around[0], (0.0, 0.0, 0.0, *around[1])
