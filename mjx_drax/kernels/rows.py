"""Programs of scalars (see `scalar`) at every row of a batch as one GPU kernel, a thread for each.

XLA computes every entry of a small matrix by itself, with all that it depends on: what the 20
entries of a Jacobian share is computed, and compiled, 20 times. Here a thread computes it once, in
registers, and writes all entries. Rows are the fastest axis in memory, so that neighbouring threads
read and write neighbouring numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_batching import custom_vmap
from jax.experimental import pallas as pl
from jax.experimental.pallas.triton import CompilerParams
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

THREADS = 64
"""Rows that a block of threads works on: two warps."""


def by_rows(program: ClosedJaxpr, batched: tuple[bool, ...] | None = None) -> Callable[..., Array]:
    """A program of scalars as a function of arrays of them, whose `vmap` is a kernel.

    Args:
        program: of the entries of all arrays in their order.
        batched: arrays with a leading axis of rows; None: there are no rows yet.

    Returns:
        a function that gives (outputs,), or (rows, outputs).
    """

    def single(*inputs: Array) -> Array:
        entries = [entry for array in inputs for entry in jnp.ravel(array)]
        return jnp.stack(jaxpr_as_fun(program)(*entries))

    @custom_vmap
    def rows(*inputs: Array) -> Array:
        if batched is None:
            return single(*inputs)
        plain = jax.vmap(single, [0 if b else None for b in batched])
        kernel = partial(over_rows, program, batched)
        return lax.platform_dependent(*inputs, cuda=kernel, default=plain)

    @rows.def_vmap
    def more(size: int, mapped: Sequence[bool], *inputs: Array) -> tuple[Array, bool]:
        """Another mapped axis just makes more rows."""
        before = batched or (False,) * len(inputs)
        after = tuple(b or m for b, m in zip(before, mapped, strict=True))
        whole = zip(inputs, before, mapped, strict=True)
        count = next((a.shape[m] for a, b, m in whole if b), 1)
        merged = list(inputs)
        for i, (a, b, m) in enumerate(zip(inputs, before, mapped, strict=True)):
            if after[i]:
                entries = a.shape[b + m :]
                a = a.reshape(size if m else 1, count if b else 1, *entries)
                a = jnp.broadcast_to(a, (size, count, *entries))
                merged[i] = a.reshape(size * count, *entries)
        out = by_rows(program, after)(*merged)
        return (out if batched is None else out.reshape(size, count, -1)), True

    return rows


def over_rows(
    program: ClosedJaxpr, batched: Sequence[bool], *inputs: Array, interpret: bool = False
) -> Array:
    """The outputs of a program of scalars at every row, (rows, outputs), by one kernel.

    Args:
        program: of the entries of all inputs in their order.
        batched: which inputs have a leading axis of rows; at least one has.
        inputs: arrays of one type.
        interpret: run it without a GPU.
    """
    own = [jnp.reshape(a, (len(a), -1)) for a, b in zip(inputs, batched, strict=True) if b]
    common = [jnp.ravel(a) for a, b in zip(inputs, batched, strict=True) if not b]
    rows, dtype = len(own[0]), own[0].dtype
    missing = -rows % THREADS
    packed = jnp.pad(jnp.concatenate(own, axis=1).T, ((0, 0), (0, missing)))
    shared = jnp.concatenate([*common, jnp.zeros(1, dtype)])  # never empty
    outputs = len(program.out_avals)

    def body(own_ref: Any, shared_ref: Any, out_ref: Any) -> None:
        numbers, axes, i, j = [], [], 0, 0
        for array, b in zip(inputs, batched, strict=True):
            for _ in range(array.size // rows if b else array.size):
                numbers.append(own_ref[i, :] if b else shared_ref[j])
                axes.append(0 if b else None)
                i, j = i + b, j + (not b)
        values = jax.vmap(jaxpr_as_fun(program), axes, axis_size=THREADS)(*numbers)
        for k, value in enumerate(values):
            out_ref[k, :] = value

    out = pl.pallas_call(
        body,
        grid=((rows + missing) // THREADS,),
        in_specs=[
            pl.BlockSpec((len(packed), THREADS), lambda i: (0, i)),
            pl.BlockSpec(shared.shape, lambda i: (0,)),
        ],
        out_specs=pl.BlockSpec((outputs, THREADS), lambda i: (0, i)),
        out_shape=jax.ShapeDtypeStruct((outputs, rows + missing), dtype),
        compiler_params=CompilerParams(num_warps=THREADS // 32, num_stages=1),
        interpret=interpret,
    )(packed, shared)
    return out[:, :rows].T
