"""Chains, or problems, spread over the devices of this host; each works on its own share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from mjx_drax.errors import DraxError

SPLIT = P("share")


def mesh_for(count: int, devices: int | None) -> Mesh | None:
    """The devices that `count` chains are spread over, or None where one is enough.

    Args:
        count: chains, or problems.
        devices: how many to use; None: as many as there are that divide the count.

    Raises:
        DraxError: more devices than there are, or a number that does not divide the count.
    """
    present = jax.local_devices()
    if devices is None:
        devices = max(n for n in range(1, len(present) + 1) if count % n == 0)
    if (
        not isinstance(devices, int | np.integer)
        or isinstance(devices, bool)
        or not 1 <= devices <= len(present)
    ):
        raise DraxError(
            f"devices is {devices!r}: give a whole number from 1 to {len(present)}, which is how "
            f"many {present[0].platform} devices there are."
        )
    if count % devices:
        raise DraxError(
            f"{count} chains or problems cannot be spread evenly over {devices} devices: give a "
            "multiple."
        )
    return Mesh(np.array(present[:devices]), ("share",)) if devices > 1 else None


def spread(function: Callable[..., Any], mesh: Mesh | None, *specs: Any) -> Callable[..., Any]:
    """The function of arrays that are split (`SPLIT`) or whole (P()) on every device of a mesh.

    Its results are split. Nothing is exchanged between devices, so kernels of our own need no rule
    of how to partition them.
    """
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=SPLIT, check_vma=False)
