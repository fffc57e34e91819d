"""Programs of scalars (see `scalarize`) at every row of a batch as one kernel.

XLA computes every entry of a small matrix by itself, with all that it depends on: what the 20
entries of a Jacobian share is computed, and compiled, 20 times. Here a row computes it once and
writes all entries: on a GPU in a thread of its own, on a CPU in a loop over rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from mjx_drax.kernels.batching import merged_vmaps, on_gpu, padded, thread_for_each_row

THREADS = 64
"""Rows that a block of threads works on: two warps."""

PART = 1_000
"""Operations of a program that a CPU's compiler gets at once. 8,000 of a quadrotor's compiled for
19 s and took 68 ms for 800 rows; 11,000, at most 1,000 at once, compiled for 28 s and took 12."""


def vmapped_as_kernel(program: ClosedJaxpr) -> Callable[..., Array]:
    """A program of scalars as a function of arrays of them, whose vmap is a kernel.

    It takes the arrays whose entries, in their order, are the program's inputs, and gives the
    program's outputs as one vector.
    """

    def by_entries(*inputs: Array) -> Array:
        entries = [entry for array in inputs for entry in jnp.ravel(array)]
        return jnp.stack(jaxpr_as_fun(program)(*entries))

    @jax.custom_jvp
    def in_parts(*inputs: Array) -> Array:
        return by_windows(program, [True] * len(inputs), *(a[None] for a in inputs))[0]

    in_parts.defjvp(partial(jax.jvp, by_entries))
    one = in_parts if len(program.eqns) > PART and not on_gpu() else by_entries

    def all_rows(has_rows: tuple[bool, ...], *inputs: Array) -> Array:
        if not on_gpu():
            return by_windows(program, has_rows, *inputs)
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


def by_windows(program: ClosedJaxpr, has_rows: Sequence[bool], *inputs: Array) -> Array:
    """`at_all_rows` for CPUs, (rows, outputs), one loop over all rows for each part of the program.

    XLA has no operation "compute these numbers for every row". But its reduction of windows takes
    a program of scalars, and compiles it as it stands: with one entry a window, that program's
    arguments are the initial values, here the numbers that are common to all rows, and the entries.
    """
    jaxpr, rows = program.jaxpr, next(len(a) for a, b in zip(inputs, has_rows, strict=True) if b)
    common: dict[Any, Any] = dict(zip(jaxpr.constvars, program.consts, strict=True))
    own: dict[Any, Any] = {}
    places = iter(jaxpr.invars)
    for array, is_own in zip(inputs, has_rows, strict=True):
        numbers = array.reshape(rows, -1).T if is_own else jnp.ravel(array)
        known = own if is_own else common
        known.update({place: number for number, place in zip(numbers, places, strict=False)})
    for part in _parts(jaxpr, PART):
        own.update(part.at_all_rows(rows, own, common))
    columns = [own[v] if v in own else jnp.full(rows, common[v]) for v in jaxpr.outvars]
    return jnp.stack(columns, axis=1)


@dataclass(frozen=True)
class _Part:
    """Some operations of a program of scalars, in their order.

    Attributes:
        operations: what it does.
        reads: numbers that it needs, which come before it.
        writes: its own numbers that come to use after it.
    """

    operations: list[JaxprEqn]
    reads: list[Any]
    writes: list[Any]

    def at_all_rows(
        self, rows: int, own: dict[Any, Any], common: dict[Any, Any]
    ) -> dict[Any, Array]:
        """What it writes, (rows,) each, from numbers of rows (rows,) and common ones ()."""
        of_row = [v for v in self.reads if v in own]
        of_all = [v for v in self.reads if v not in own]
        every = of_row, of_all, self.writes
        operands, starts, places = [], [], []
        for dtype in dict.fromkeys(v.aval.dtype for group in every for v in group):
            alike = ([v for v in group if v.aval.dtype == dtype] for group in every)
            for place in zip_longest(*alike):  # a window's entry, initial value and result
                a, b, _ = place
                operands.append(jnp.zeros(rows, dtype) if a is None else own[a])
                starts.append(jnp.zeros((), dtype) if b is None else jnp.asarray(common[b]))
                places.append(place)

        def computed(initial: Sequence[Any], entries: Sequence[Any]) -> tuple[Any, ...]:
            values: dict[Any, Any] = {}
            for (a, b, _), start, entry in zip(places, initial, entries, strict=True):
                values |= {a: entry, b: start}
            for operation in self.operations:
                inputs = [v.val if isinstance(v, Literal) else values[v] for v in operation.invars]
                out = operation.primitive.bind(*inputs, **operation.params)
                several = operation.primitive.multiple_results
                values.update(zip(operation.outvars, out if several else [out], strict=True))
            results = zip(places, initial, strict=True)
            return tuple(start if c is None else values[c] for (*_, c), start in results)

        found = lax.reduce_window(tuple(operands), tuple(starts), computed, (1,), (1,), "VALID")
        return {c: column for (*_, c), column in zip(places, found, strict=True) if c is not None}


def _parts(jaxpr: Jaxpr, size: int) -> Iterator[_Part]:
    """The program, cut after every `size` operations."""
    last = {v: n for n, e in enumerate(jaxpr.eqns) for v in _variables(e.invars)}
    last.update({v: len(jaxpr.eqns) for v in _variables(jaxpr.outvars)})
    for start in range(0, len(jaxpr.eqns), size):
        operations = jaxpr.eqns[start : start + size]
        end = start + len(operations)
        inside = {v: None for e in operations for v in e.outvars}
        used = dict.fromkeys(v for e in operations for v in _variables(e.invars))
        reads = [v for v in used if v not in inside]
        yield _Part(operations, reads, [v for v in inside if last.get(v, -1) >= end])


def _variables(atoms: Sequence[Any]) -> list[Any]:
    return [atom for atom in atoms if not isinstance(atom, Literal)]
