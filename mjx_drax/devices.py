"""Chains, or problems, spread over processes and their devices; each works on its own share.

Several processes, maybe on several hosts, are what `jax.distributed.initialize` makes of them. All
run the same program with the same arguments. Each does the iterations of its share, and then they
exchange what they found, so that everything else goes on in each of them as in one alone.

Chains exchange nothing and each has its own random key, so answers do not depend on the shares: two
devices and four were seen to give the same, bit for bit. One device and several agree but for
rounding: where numbers are divided by one of them, XLA multiplies by its reciprocal in a program of
one device and divides in one of several. A single chain on a device rounds differently too, as its
products are of matrices and no longer of batches of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from mjx_drax.errors import DraxError

SPLIT = P("share")


def mesh_for(count: int, devices: int = 1) -> Mesh | None:
    """The devices that a process spreads its share of `count` chains over, or None for one.

    Args:
        count: chains, or problems, of all processes.
        devices: how many to use, of each process.

    Raises:
        DraxError: more devices than there are, or a number that does not divide the share; or
            chains that cannot be shared among the processes.
    """
    present, processes = jax.local_devices(), jax.process_count()
    if count % processes:
        raise DraxError(
            f"{count} cannot be spread evenly over {processes} processes: give a multiple."
        )
    if processes > 1:  # meet: the first time they wait for each other for half a minute only
        multihost_utils.process_allgather(np.zeros(1))
    count //= processes
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


def divided(work: Callable[[Any], Any], rows: Any) -> Any:
    """work(rows), each process working on its share of them and getting the results of all.

    Args:
        work: gives a tree whose leaves have a row for each that it was given, in their order.
        rows: a tree of arrays with as many rows each, which the processes can share evenly.
    """
    processes, index = jax.process_count(), jax.process_index()
    if processes == 1:
        return work(rows)

    def mine(leaf: jax.Array) -> jax.Array:
        count = len(leaf) // processes
        return leaf[index * count : (index + 1) * count]

    return jax.tree.map(_exchanged, work(jax.tree.map(mine, rows)))


def _exchanged(rows: jax.Array) -> jax.Array:
    """The rows of all processes, one after the other, on a device of this one."""
    if jnp.issubdtype(rows.dtype, jax.dtypes.prng_key):
        data = _exchanged(jax.random.key_data(rows))
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(rows))
    return jnp.asarray(multihost_utils.process_allgather(rows, tiled=True))
