"""Programs of scalars (see `scalarize`) at every row of a batch as one GPU kernel.

XLA computes every entry of a small matrix by itself, with all that it depends on: what the 20
entries of a Jacobian share is computed, and compiled, 20 times. Here the thread of a row computes
it once, in registers, and writes all entries.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from mjx_drax.kernels.batching import merged_vmaps, padded, thread_for_each_row

THREADS = 64
"""Rows that a block of threads works on: two warps."""


def vmapped_as_kernel(program: ClosedJaxpr) -> Callable[..., Array]:
    """A program of scalars as a function of arrays of them, whose vmap is a kernel on GPUs.

    It takes the arrays whose entries, in their order, are the program's inputs, and gives the
    program's outputs as one vector.
    """

    def one(*inputs: Array) -> Array:
        entries = [entry for array in inputs for entry in jnp.ravel(array)]
        return jnp.stack(jaxpr_as_fun(program)(*entries))

    def all_rows(has_rows: tuple[bool, ...], *inputs: Array) -> Array:
        plain = jax.vmap(one, [0 if own else None for own in has_rows])
        kernel = partial(at_all_rows, program, has_rows)
        return lax.platform_dependent(*inputs, cuda=kernel, default=plain)

    return merged_vmaps(one, all_rows)


def at_all_rows(
    program: ClosedJaxpr, has_rows: Sequence[bool], *inputs: Array, interpret: bool = False
) -> Array:
    """The outputs of a program of scalars at every row, (rows, outputs), by one kernel.

    Args:
        program: of the entries of all inputs in their order.
        has_rows: which inputs lead with the axis of rows; at least one does.
        inputs: arrays of one type.
        interpret: run it without a GPU.
    """
    own = [jnp.reshape(a, (len(a), -1)) for a, b in zip(inputs, has_rows, strict=True) if b]
    common = [jnp.ravel(a) for a, b in zip(inputs, has_rows, strict=True) if not b]
    rows, dtype = len(own[0]), own[0].dtype
    packed = padded(jnp.concatenate(own, axis=1).T, THREADS)
    shared = jnp.concatenate([*common, jnp.zeros(1, dtype)])  # never empty

    def body(own_ref: Any, shared_ref: Any, out_ref: Any) -> None:
        numbers, axes, i, j = [], [], 0, 0
        for array, b in zip(inputs, has_rows, strict=True):
            for _ in range(array.size // rows if b else array.size):
                numbers.append(own_ref[i, :] if b else shared_ref[j])
                axes.append(0 if b else None)
                i, j = i + b, j + (not b)
        values = jax.vmap(jaxpr_as_fun(program), axes, axis_size=THREADS)(*numbers)
        for k, value in enumerate(values):
            out_ref[k, :] = value

    shape = (len(program.out_avals),)
    out = thread_for_each_row(body, THREADS, shape, [packed], [shared], interpret)
    return out[:, :rows].T
