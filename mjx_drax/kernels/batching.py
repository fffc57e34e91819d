"""Many rows at once: any number of vmaps as one batch, and one GPU kernel for a batch.

A row is what a function computes by itself, such as one chain or one knot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap


def on_gpu() -> bool:
    """Whether programs run on a GPU by default."""
    return jax.default_backend() == "gpu"


def of_one_precision(arrays: Sequence[Any]) -> bool:
    """Whether all arrays are of float32, or all of float64: what kernels work on."""
    return {array.dtype for array in arrays} in ({np.dtype("f4")}, {np.dtype("f8")})


def merged_vmaps(
    one: Callable[..., Any],
    all_rows: Callable[..., Any],
    has_rows: tuple[bool, ...] | None = None,
) -> Callable[..., Any]:
    """The function `one`, whose vmap over any number of axes is one call of `all_rows`.

    Args:
        one: a function of pytrees of arrays, for one row.
        all_rows: all_rows(has_rows, *arguments), the same for many rows: those arrays (leaves of
            the arguments, in their order) that has_rows names lead with the axis of rows, the
            others are common to all rows. Every array of the result leads with the axis of rows.
        has_rows: which arrays the function takes with an axis of rows; None: it takes one row.
    """

    def plain(*arguments: Any) -> Any:
        return one(*arguments) if has_rows is None else all_rows(has_rows, *arguments)

    function = custom_vmap(plain)

    @function.def_vmap
    def with_another_axis(size: int, mapped: Sequence[Any], *arguments: Any) -> tuple[Any, Any]:
        """The mapped axis makes more rows: (size, rows, ...) becomes (size * rows, ...)."""
        arrays, tree = jax.tree.flatten(arguments)
        if not any(jax.tree.leaves(tuple(mapped))):  # as in derivatives, of what is not varied
            out = plain(*arguments)
            return out, jax.tree.map(lambda _: False, out)
        before = has_rows or (False,) * len(arrays)
        flags = list(zip(arrays, before, jax.tree.leaves(tuple(mapped)), strict=True))
        rows = next((a.shape[new] for a, old, new in flags if old), 1)

        def merged(a: Array, old: bool, new: bool) -> Array:
            if not (old or new):
                return a
            entries = a.shape[old + new :]
            a = a.reshape(size if new else 1, rows if old else 1, *entries)
            return jnp.broadcast_to(a, (size, rows, *entries)).reshape(size * rows, *entries)

        after = tuple(old or new for _, old, new in flags)
        more = merged_vmaps(one, all_rows, after)
        out = more(*jax.tree.unflatten(tree, [merged(*each) for each in flags]))
        if has_rows is not None:
            out = jax.tree.map(lambda a: a.reshape(size, rows, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def repeated(has_rows: Sequence[bool], arguments: Any) -> Any:
    """The arguments of `all_rows`, what is common to all rows repeated for each of them."""
    arrays, tree = jax.tree.flatten(arguments)
    flags = list(zip(arrays, has_rows, strict=True))
    rows = next(len(a) for a, own in flags if own)
    every = [a if own else jnp.broadcast_to(a, (rows, *jnp.shape(a))) for a, own in flags]
    return jax.tree.unflatten(tree, every)


def padded(array: Array, threads: int) -> Array:
    """An array (..., rows) with zeros after its rows, up to a multiple of `threads`."""
    return jnp.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, -array.shape[-1] % threads)])


def thread_for_each_row(
    body: Callable[..., None],
    threads: int,
    shape: tuple[int, ...],
    arrays: Sequence[Array],
    common: Sequence[Array] = (),
    interpret: bool = False,
) -> Array:
    """One GPU kernel for all rows; rows are the last axis, so that threads read neighbours.

    Args:
        body: body(*arrays, *common, out), which reads and writes references of `threads` rows.
        threads: rows that a block of threads works on, a multiple of 32.
        shape: of the result of one row.
        arrays: of shapes (..., rows), `padded`.
        common: arrays that all rows read.
        interpret: run it without a GPU.

    What the body writes is (*shape, rows).
    """
    from jax.experimental import pallas as pl  # only here: it takes a second
    from jax.experimental.pallas.triton import CompilerParams

    rows = arrays[0].shape[-1]

    def block(shape: Sequence[int]) -> pl.BlockSpec:
        return pl.BlockSpec((*shape, threads), lambda i: (*[0] * len(shape), i))

    def whole(shape: Sequence[int]) -> pl.BlockSpec:
        return pl.BlockSpec(tuple(shape), lambda i: (0,) * len(shape))

    return pl.pallas_call(
        body,
        grid=(rows // threads,),
        in_specs=[*(block(a.shape[:-1]) for a in arrays), *(whole(a.shape) for a in common)],
        out_specs=block(shape),
        out_shape=jax.ShapeDtypeStruct((*shape, rows), arrays[0].dtype),
        compiler_params=CompilerParams(num_warps=threads // 32, num_stages=1),
        interpret=interpret,
    )(*arrays, *common)


def block_for_each_row(
    body: Callable[..., None],
    shapes: dict[str, tuple[int, ...]],
    arrays: Sequence[Array],
    warps: int,
    interpret: bool = False,
) -> dict[str, Array]:
    """One GPU kernel for all rows, with a block of threads for each; rows are the first axis.

    Args:
        body: body(*arrays, *results), which reads and writes references of one row, (1, ...).
        shapes: of the results, (rows, ...), by the names under which they are returned.
        arrays: of shapes (rows, ...); entries of rows are powers of two.
        warps: how many groups of 32 threads work on a row.
        interpret: run it without a GPU.
    """
    from jax.experimental import pallas as pl  # only here: it takes a second
    from jax.experimental.pallas.triton import CompilerParams

    def of_row(shape: tuple[int, ...]) -> pl.BlockSpec:
        return pl.BlockSpec((1, *shape[1:]), lambda i: (i, *[0] * (len(shape) - 1)))

    out = pl.pallas_call(
        body,
        grid=(arrays[0].shape[0],),
        in_specs=[of_row(a.shape) for a in arrays],
        out_specs=[of_row(s) for s in shapes.values()],
        out_shape=[jax.ShapeDtypeStruct(s, arrays[0].dtype) for s in shapes.values()],
        compiler_params=CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
    )(*arrays)
    return dict(zip(shapes, out, strict=True))
