"""Chains, or problems, spread over processes and their devices; each works on its own share.

Several processes, maybe on several hosts, are what `jax.distributed.initialize` makes of them. All
run the same program with the same arguments. Arrays are sharded by rows over a mesh of all devices,
and stay where they are while their rows are worked on; what the rest of a solve needs of them is
gathered in every process.

Chains exchange nothing and each has its own random key, so answers need not depend on the shares.
For XLA to round alike too, every device runs the program of a single device on its share: programs
that `jax.shard_map` makes of the same functions are simplified in another order, and end the
process (jax 0.11) where an array holds no numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from mjx_drax.base.errors import DraxError

Tree = TypeVar("Tree")


def mesh_for(count: int, devices: int = 1) -> Mesh | None:
    """The devices, of all processes, that `count` chains are spread over, or None for one.

    Args:
        count: chains, or problems, of all processes.
        devices: how many to use, of each process.

    Raises:
        DraxError: more devices than there are, or a number that does not divide the share; or
            chains that cannot be shared among the processes.
    """
    processes = jax.process_count()
    if count % processes:
        raise DraxError(
            f"{count} cannot be spread evenly over {processes} processes: give a multiple."
        )
    if processes > 1:  # synchronize now: the first time they wait for half a minute at most
        multihost_utils.process_allgather(np.zeros(1))
    if count % sharing(devices):
        raise DraxError(
            f"{count // processes} chains cannot be spread evenly over {devices} devices: make "
            f"chains a multiple of {devices}."
        )
    if processes * devices == 1:
        return None
    used = [[d for d in jax.devices() if d.process_index == i][:devices] for i in range(processes)]
    return Mesh(np.array(used).ravel(), ("share",))


def sharing(devices: int) -> int:
    """How many devices of all processes share the work, if so many of each are there.

    Raises:
        DraxError: they are not.
    """
    present = jax.local_devices()
    whole = isinstance(devices, int | np.integer) and not isinstance(devices, bool)
    if not (whole and 1 <= devices <= len(present)):
        raise DraxError(
            f"devices is {devices!r}: give a whole number from 1 to {len(present)}, which is how "
            f"many {present[0].platform} devices there are."
        )
    return jax.process_count() * int(devices)


def split_over(program: Callable[..., Any], mesh: Mesh | None, *whole: Any) -> Callable[..., Any]:
    """program(rows, *whole, *numbers) as a function (rows, *numbers) of all rows.

    Every device works on its share of the rows, all at the same time. A GPU's program with loops
    holds up the thread that starts it, so each device has a thread.

    Args:
        program: of a tree of arrays with as many rows each, which the devices can share evenly; it
            gives a tree of arrays with a row for each of these, in their order.
        mesh: the devices, or None for one.
        whole: trees that every device gets a copy of.

    Returns:
        a function whose results are split over the mesh, as its rows may be already. In a
        launch that `compiles`, devices take turns if the first one's program serves the others.
    """
    if mesh is None:
        return lambda rows, *numbers, compiles=False: program(rows, *whole, *numbers)
    copies = {device: jax.device_put(whole, device) for device in mesh.local_devices}

    def launch(rows: Any, *numbers: Any, compiles: bool = False) -> Any:
        in_turn = compiles and _cached()
        wide = jnp.result_type(float) == jnp.float64

        def work(device: jax.Device) -> Any:
            with jax.enable_x64(wide):  # threads do not inherit it
                mine = jax.tree.map(lambda leaf: _share(leaf, mesh, device), rows)
                if len(jax.tree.leaves(rows)[0]) > mesh.size:
                    return program(mine, *copies[device], *numbers)
                # A row alone twice: XLA's program for one row rounds otherwise
                twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), mine)
                found = program(twice, *copies[device], *numbers)
                return jax.tree.map(lambda leaf: leaf[:1], found)

        with ThreadPoolExecutor(1 if in_turn else len(copies)) as pool:
            return jax.tree.map(lambda *shares: _joined(shares, mesh), *pool.map(work, copies))

    return launch


def _cached() -> bool:
    """Whether devices find in JAX's persistent cache what another one compiled: GPUs do."""
    known = jax.config.values
    kept = known["jax_compilation_cache_dir"] and known["jax_enable_compilation_cache"]
    return bool(kept) and jax.default_backend() == "gpu"  # on CPUs its keys hold the device


def gathered(tree: Tree, mesh: Mesh | None) -> Tree:
    """The arrays that are split over a mesh, whole on the first device of this process."""
    return tree if mesh is None else jax.tree.map(partial(_gathered, mesh), tree)


def on_host(tree: Any, mesh: Mesh | None) -> Any:
    """The arrays of a tree in numpy, whole; they are fetched together."""
    return jax.device_get(gathered(tree, mesh))


def _share(leaf: Any, mesh: Mesh, device: jax.Device) -> Array:
    """What that device works on, there."""
    if _is_split(leaf, mesh):
        return next(shard.data for shard in leaf.addressable_shards if shard.device == device)
    count, index = len(leaf) // mesh.size, list(mesh.devices.flat).index(device)
    return jax.device_put(leaf[index * count : (index + 1) * count], device)


def _is_split(leaf: Any, mesh: Mesh) -> bool:
    """Whether the rows of an array are spread over the mesh already."""
    return isinstance(leaf, Array) and leaf.sharding.is_equivalent_to(_by_rows(mesh), leaf.ndim)


def _by_rows(mesh: Mesh) -> NamedSharding:
    """Rows split over the mesh, in its order."""
    return NamedSharding(mesh, P("share"))


def _joined(shares: tuple[Array, ...], mesh: Mesh) -> Array:
    """One array, from the shares of this process' devices in the order of the mesh."""
    rows, *shape = shares[0].shape
    whole = rows * mesh.size, *shape
    return jax.make_array_from_single_device_arrays(whole, _by_rows(mesh), shares)


def _gathered(mesh: Mesh, leaf: Array) -> Array:
    """All rows of an array, on the first device of this process."""
    if not _is_split(leaf, mesh):
        return leaf
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        data = _gathered(mesh, jax.random.key_data(leaf))
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    if not leaf.is_fully_addressable:
        return jnp.asarray(multihost_utils.process_allgather(leaf, tiled=True))
    # Shares are copied one by one: `device_put` of the whole goes through the host's memory
    first, *_ = devices = mesh.local_devices
    shares = [_share(leaf, mesh, device) for device in devices]
    return jnp.concatenate(jax.device_put(shares, first))
