"""Rules of operations on arrays of scalars: what moves entries about, and what unrolls.

Arrays are those of `arithmetic`. Operations that only move entries (reshape, gather,
concatenate, ...) happen here and now, to arrays of numbers and of objects alike; sums, products and
factorizations become operations of their entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import numpy as np
from jax import lax

from mjx_drax.kernels import small_matrices
from mjx_drax.kernels.scalars.arithmetic import (
    Arithmetic,
    Scalar,
    Unsupported,
    all_alike,
    array_of,
    dtype_of,
    entries_of,
    is_known,
)

Arrays = list[np.ndarray]
Params = dict[str, Any]

# Operations that move numbers about, for numeric arrays and for arrays of objects alike


def _broadcast_in_dim(values: Arrays, params: Params) -> Arrays:
    shape, dimensions = params["shape"], params["broadcast_dimensions"]
    aligned = np.ones(len(shape), int)
    aligned[list(dimensions)] = values[0].shape
    return [np.broadcast_to(values[0].reshape(aligned), shape)]


def _slice(values: Arrays, params: Params) -> Arrays:
    strides = params["strides"] or (1,) * values[0].ndim
    ends = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [values[0][tuple(slice(*e) for e in ends)]]


def _pad(values: Arrays, params: Params) -> Arrays:
    value, fill = all_alike(values)
    for axis, (low, high, between) in enumerate(params["padding_config"]):
        value = np.moveaxis(value, axis, 0)
        size = max(0, len(value) + between * (len(value) - 1))
        out = np.repeat(fill.reshape(1), math.prod((low + size + high, *value.shape[1:])))
        out = out.reshape(low + size + high, *value.shape[1:])
        for i, row in enumerate(value):
            at = low + i * (between + 1)
            if 0 <= at < len(out):
                out[at] = row
        value = np.moveaxis(out, 0, axis)
    return [value]


def _split(values: Arrays, params: Params) -> Arrays:
    return np.split(values[0], np.cumsum(params["sizes"])[:-1], params["axis"])


def known_integers(value: np.ndarray) -> np.ndarray:
    """Known integers, which say where numbers go."""
    if not all(is_known(entry) for entry in entries_of(value)):
        raise Unsupported("an index that is not known")
    return value.astype(int)


def _starts(indices: Sequence[np.ndarray], shape: Sequence[int], sizes: Sequence[int]) -> list[int]:
    """Starts of a dynamic slice, moved inside the array as JAX does."""
    where = zip(indices, shape, sizes, strict=True)
    return [int(np.clip(known_integers(i), 0, n - size)) for i, n, size in where]


def _dynamic_slice(values: Arrays, params: Params) -> Arrays:
    sizes = params["slice_sizes"]
    starts = _starts(values[1:], values[0].shape, sizes)
    return [values[0][tuple(slice(s, s + n) for s, n in zip(starts, sizes, strict=True))]]


def _dynamic_update_slice(values: Arrays, params: Params) -> Arrays:
    operand, update = all_alike(values[:2])
    starts = _starts(values[2:], operand.shape, update.shape)
    out = operand.copy()
    out[tuple(slice(s, s + n) for s, n in zip(starts, update.shape, strict=True))] = update
    return [out]


def _windows(
    indices: np.ndarray,
    shape: Sequence[int],
    sizes: Sequence[int],
    index_map: Sequence[int],
    batching: Sequence[tuple[int, int]],
) -> tuple[Arrays, np.ndarray]:
    """Where the windows of a gather or scatter lie in an operand of this shape.

    Returns:
        coordinates for each dimension of the operand, (*batch, *sizes), moved inside the operand
        as a whole; and whether a window lay inside by itself, (*batch,).
    """
    indices = known_integers(indices)
    batch = indices.shape[:-1]
    starts = [np.zeros(batch, int) for _ in shape]
    for k, d in enumerate(index_map):
        starts[d] = indices[..., k]
    for d, axis in batching:
        starts[d] = np.broadcast_to(np.indices(batch)[axis], batch)
    inside, coordinates = np.ones(batch, bool), []
    for d, (start, n, size) in enumerate(zip(starts, shape, sizes, strict=True)):
        inside &= (start >= 0) & (start <= n - size)
        offset = np.arange(size).reshape([-1 if e == d else 1 for e in range(len(shape))])
        moved = np.clip(start, 0, n - size).reshape(*batch, *(1 for _ in shape))
        coordinates.append(np.broadcast_to(moved + offset, (*batch, *sizes)))
    return coordinates, inside


def _gather(values: Arrays, params: Params) -> Arrays:
    operand, indices = values
    numbers, sizes, mode = params["dimension_numbers"], params["slice_sizes"], params["mode"]
    batching = list(
        zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)
    )
    coordinates, inside = _windows(indices, operand.shape, sizes, numbers.start_index_map, batching)
    if mode == lax.GatherScatterMode.FILL_OR_DROP and not inside.all():
        raise Unsupported("a gather that fills")
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    out = operand[tuple(coordinates)]
    out = out.reshape(*inside.shape, *(n for d, n in enumerate(sizes) if d not in dropped))
    return [np.moveaxis(out, range(inside.ndim, out.ndim), numbers.offset_dims)]


def _scattered(
    values: Arrays, params: Params, combine: Callable[[Scalar, Scalar], Scalar]
) -> np.ndarray:
    """The operand, with combine(entry, update) at the indices."""
    (operand, updates), indices = all_alike([values[0], values[2]]), values[1]
    numbers, mode = params["dimension_numbers"], params["mode"]
    window, batch = numbers.update_window_dims, np.shape(indices)[:-1]
    updates = np.moveaxis(updates, window, range(len(batch), updates.ndim))
    dropped = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    kept = iter(updates.shape[len(batch) :])
    sizes = [1 if d in dropped else next(kept) for d in range(operand.ndim)]
    batching = list(
        zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True)
    )
    coordinates, inside = _windows(
        indices, operand.shape, sizes, numbers.scatter_dims_to_operand_dims, batching
    )
    used = np.broadcast_to(
        (inside | (mode == lax.GatherScatterMode.CLIP)).reshape(*batch, *(1 for _ in sizes)),
        (*batch, *sizes),
    )
    out = operand.copy()
    where = zip(*(c.reshape(-1) for c in coordinates), strict=True) if out.ndim else iter([()])
    for at, update, use in zip(where, entries_of(updates), used.reshape(-1), strict=True):
        if use:
            out[at] = combine(out[at], update)
    return out


def _identity(values: Arrays, params: Params) -> Arrays:
    return values


MOVES: dict[str, Callable[[Arrays, Params], Arrays]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda v, p: [np.concatenate(all_alike(v), p["dimension"])],
    "device_put": _identity,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "expand_dims": lambda v, p: [np.expand_dims(v[0], p["dimensions"])],
    "gather": _gather,
    "optimization_barrier": _identity,
    "pad": _pad,
    "reshape": lambda v, p: [v[0].reshape(p["new_sizes"])],
    "rev": lambda v, p: [np.flip(v[0], p["dimensions"])],
    "scatter": lambda v, p: [_scattered(v, p, lambda _, update: update)],
    "slice": _slice,
    "split": _split,
    "squeeze": lambda v, p: [np.squeeze(v[0], tuple(p["dimensions"]))],
    "stack": lambda v, p: [np.stack(all_alike(v), p["axis"])],
    "tile": lambda v, p: [np.tile(v[0], p["reps"])],
    "transpose": lambda v, p: [np.transpose(v[0], p["permutation"])],
}


# Sums, products and factorizations, unrolled


def _dot_general(ops: Arithmetic, values: Arrays, params: Params) -> np.ndarray:
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]

    def rows(value: np.ndarray, batch: Sequence[int], contract: Sequence[int]) -> Any:
        """The array as (batch, free, contracted), and the sizes of its batch and free axes."""
        free = [d for d in range(value.ndim) if d not in batch and d not in contract]
        sizes = [[value.shape[d] for d in axes] for axes in (batch, free, contract)]
        shape = [math.prod(s) for s in sizes]
        return np.transpose(value, (*batch, *free, *contract)).reshape(shape), sizes[0], sizes[1]

    a, batch, free_a = rows(values[0], batch_a, contract_a)
    b, _, free_b = rows(values[1], batch_b, contract_b)
    dtype = params["preferred_element_type"] or dtype_of(values)
    if any(dtype_of([v]) != dtype for v in values if v.size):
        raise Unsupported("a product that changes dtype")
    out = [ops.dot(p, q, dtype) for A, B in zip(a, b, strict=True) for p in A for q in B]
    return array_of(out, (*batch, *free_a, *free_b))


def _fold(primitive: Any) -> Callable[..., np.ndarray]:
    """A reduction over some axes."""

    def rule(ops: Arithmetic, values: Arrays, params: Params) -> np.ndarray:
        axes = params["axes"]
        last = np.moveaxis(values[0], axes, range(-len(axes), 0))
        shape = last.shape[: last.ndim - len(axes)]
        rows = last.reshape(math.prod(shape), -1)
        return array_of([reduce(lambda a, b: ops.apply(primitive, (a, b)), r) for r in rows], shape)

    return rule


def _cumulate(primitive: Any) -> Callable[..., np.ndarray]:
    """Partial reductions along an axis."""

    def rule(ops: Arithmetic, values: Arrays, params: Params) -> np.ndarray:
        first = np.moveaxis(values[0], params["axis"], 0)
        lines = first.reshape(len(first), -1)[:: -1 if params["reverse"] else 1].copy()
        for i in range(1, len(lines)):
            pairs = zip(lines[i - 1], lines[i], strict=True)
            lines[i] = array_of([ops.apply(primitive, pair) for pair in pairs], lines[i].shape)
        lines = lines[:: -1 if params["reverse"] else 1]
        return np.moveaxis(lines.reshape(first.shape), 0, params["axis"])

    return rule


def _each_matrix(rule: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """A rule for matrices, over their leading axes."""

    def batched(ops: Arithmetic, values: Arrays, params: Params) -> np.ndarray:
        batch = values[0].shape[:-2]
        flat = [v.reshape(-1, *v.shape[-2:]) for v in values]
        out = [rule(ops, matrices, params) for matrices in zip(*flat, strict=True)]
        shape = (*batch, *values[-1].shape[-2:])
        return array_of([s for matrix in out for s in entries_of(matrix)], shape)

    return batched


def _minus_dot(ops: Arithmetic, dtype: Any) -> Callable[..., Scalar]:
    """total - a'b, the product summed first."""
    return lambda total, a, b: ops.sub(total, ops.dot(a, b, dtype))


def _cholesky(ops: Arithmetic, values: Sequence[np.ndarray], params: Params) -> np.ndarray:
    (A,), dtype = values, dtype_of(values)
    zero = np.zeros((), dtype)[()]
    rows = small_matrices.cholesky(list(map(list, A)), ops.sqrt, ops.div, _minus_dot(ops, dtype))
    padded = [entry for row in rows for entry in (*row, *[zero] * (len(A) - len(row)))]
    return array_of(padded, A.shape)


def _triangular_solve(ops: Arithmetic, values: Sequence[np.ndarray], params: Params) -> np.ndarray:
    (A, B), dtype = values, dtype_of(values)
    left, lower = params["left_side"], params["lower"]
    if params["conjugate_a"] and np.issubdtype(dtype, np.complexfloating):
        raise Unsupported("complex numbers")
    if params["transpose_a"] == left:  # otherwise A X = B already, or X A' = B, that is A X' = B'
        A, lower = A.T, not lower
    X = (B if left else B.T).copy()
    order = slice(None, None, 1 if lower else -1)  # upper is lower with all axes reversed
    rows = list(map(list, A[order, order]))
    divide = (lambda x, _: x) if params["unit_diagonal"] else ops.div
    for column in X.T:
        b = list(column[order])
        solved = small_matrices.solve_lower(rows, b, divide, _minus_dot(ops, dtype))
        column[order] = array_of(solved, column.shape)
    return X if left else X.T


UNROLLED: dict[str, Callable[..., np.ndarray]] = {
    "cholesky": _each_matrix(_cholesky),
    "cummax": _cumulate(lax.max_p),
    "cummin": _cumulate(lax.min_p),
    "cumprod": _cumulate(lax.mul_p),
    "cumsum": _cumulate(lax.add_p),
    "dot_general": _dot_general,
    "reduce_and": _fold(lax.and_p),
    "reduce_max": _fold(lax.max_p),
    "reduce_min": _fold(lax.min_p),
    "reduce_or": _fold(lax.or_p),
    "reduce_prod": _fold(lax.mul_p),
    "reduce_sum": _fold(lax.add_p),
    "scatter-add": lambda ops, v, p: _scattered(v, p, ops.add),
    "scatter-mul": lambda ops, v, p: _scattered(v, p, ops.mul),
    "triangular_solve": _each_matrix(_triangular_solve),
}
