"""Functions of one knot, unrolled into scalar arithmetic that compiles to a few fused loops.

The step of a small robot is some hundred multiplications, written by MJX as thousands of tiny array
operations: slices, gathers, products of 3x3 matrices. Under `vmap` over knots and chains each of
them moves memory. `scalarized(f)` traces f once and evaluates its jaxpr with every array held as a
numpy array of scalars, each a known number or a traced scalar. What moves numbers about (reshape,
gather, concatenate, ...) then happens here, at trace time; what computes is simplified and done
scalar by scalar (`arithmetic`). The result is elementwise code, which fuses.

Of the simplifications 0 x = 0, 0 / x = 0 and x - x = 0 hold for finite x only: where x is infinite
or NaN, the scalarized function returns the 0, not NaN; and x + 0 keeps the sign of x = -0. What is
left of a difference to f is rounding, because sums are taken in another order.

A function with an operation that has no rule here, with too many of them, or with a long loop is
evaluated as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from mjx_drax.kernels.batching import of_one_precision, on_gpu
from mjx_drax.kernels.pruning import needed_program, without_unused, without_unused_inputs
from mjx_drax.kernels.scalars.arithmetic import (
    ELEMENTWISE,
    IN_KERNELS,
    NUMPY,
    Arithmetic,
    Scalar,
    Unsupported,
    all_alike,
    apply_to_known,
    array_of,
    as_numbers,
    as_objects,
    bound_to_known,
    entries_of,
    is_known,
    is_numeric,
    key_of,
)
from mjx_drax.kernels.scalars.kernel import vmapped_as_kernel
from mjx_drax.kernels.scalars.rules import MOVES, UNROLLED, known_integers

LIMIT = 8_000
"""Scalar operations of a function, above which it is left as it is: XLA would compile for longer
than it takes for the array operations."""

CPU_LIMIT = 16_000
"""The same of kernels on CPUs, where time to compile only grows with their number. Jacobians of a
quadrotor, 8 chains: 12,200 operations take 22 ms and compile in 11 s, arrays 130 ms and 17 s. Of an
arm: 20,100 operations take 24 ms and compile in 32 s, arrays 37 ms and 15 s."""

LONGEST_LOOP = 5
"""Steps of a loop, above which a function is left as it is: ten physics steps of a cart-pole in a
row compiled for 96 s, as a loop of scalarized steps for 30 s."""


def scalarized(
    function: Callable[..., Any],
    limit: int | None = None,
    outermost: bool = False,
    otherwise: Callable[..., Any] | None = None,
) -> Callable[..., Any]:
    """The same function of pytrees of arrays, in scalar arithmetic where that is possible.

    With more than `limit` operations (each entry of a traced array that is read counts as one; by
    default LIMIT or CPU_LIMIT) it stays as it is, or is `otherwise`, if given, which computes the
    same. Arrays that the function closes over and that are not traced are known numbers, whose
    zeros and ones are used. Arguments are not. Functions with their own derivative rule
    (custom_jvp, custom_vjp) are not opened, because the result may be differentiated: differentiate
    first. If it is `outermost`, which nobody differentiates, one kernel computes it for all rows of
    a batch.
    """

    @wraps(function)
    def in_scalars(*arguments: Any) -> Any:
        program, inputs, tree = needed_program(function, arguments)
        evaluate = as_kernel if outermost else in_operations
        most = CPU_LIMIT if outermost and not on_gpu() else LIMIT
        try:
            outputs = evaluate(most if limit is None else limit, program, inputs)
        except (Unsupported, TypeError):  # types: as in `pruned`
            if otherwise is not None:
                return otherwise(*arguments)
            outputs = unchanged(program, inputs)
        return jax.tree.unflatten(tree, outputs)

    return in_scalars


def unchanged(program: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    """The outputs of the program as it is."""
    return jaxpr_as_fun(program)(*inputs)


def in_operations(limit: int, program: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    """Its outputs by scalar operations, which XLA fuses."""
    return [_joined(v) for v in _Evaluation(limit).outputs(program, program.consts, inputs)]


def as_kernel(limit: int, program: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    """Its outputs by scalar operations that one kernel does for all rows of a batch.

    It reads only what it uses: not the integers of a model, which are known. It writes each number
    once, and none that is known, as most entries of large Jacobians are: its compilation takes long
    where it writes many.
    """
    numbers = [*program.consts, *inputs]
    jaxpr = program.jaxpr
    atoms = [*jaxpr.outvars, *(v for e in jaxpr.eqns for v in e.invars)]
    needed = {v for v in atoms if not isinstance(v, Literal)}
    places = zip([*jaxpr.constvars, *jaxpr.invars], numbers, strict=True)
    traced = [v in needed and isinstance(number, jax.core.Tracer) for v, number in places]
    given = [number for number, is_traced in zip(numbers, traced, strict=True) if is_traced]
    if sum(number.size for number in given) > limit:
        return in_operations(limit, program, inputs)

    found: dict[Any, Scalar] = {}  # distinct entries of the outputs
    keys: list[Any] = []  # of all entries

    def in_scalars(*entries: Scalar) -> list[Scalar]:
        left, values = iter(entries), list(numbers)
        for i, number in enumerate(numbers):
            if traced[i]:
                each = array_of([next(left) for _ in range(number.size)], number.shape)
                values[i] = as_numbers(each, number.dtype)
        consts, arguments = values[: len(program.consts)], values[len(program.consts) :]
        outputs = _Evaluation(limit).outputs(program, consts, arguments)
        scalars = [scalar for output in outputs for scalar in entries_of(output)]
        keys.extend(map(key_of, scalars))
        found.update(zip(keys, scalars, strict=True))
        return [scalar for scalar in found.values() if not is_known(scalar)]

    if not all(is_numeric(number.dtype) for number in given):
        raise Unsupported("keys")
    entries = [jax.ShapeDtypeStruct((), a.dtype) for a in given for _ in range(a.size)]
    scalars, used = without_unused_inputs(jax.make_jaxpr(in_scalars)(*entries))
    plain = all(equation.primitive.name in IN_KERNELS for equation in scalars.eqns)
    avals: list[Any] = [*scalars.in_avals, *program.out_avals]
    if not (any(used) and scalars.out_avals and plain and of_one_precision(avals)):
        return in_operations(limit, program, inputs)
    ends = np.cumsum([number.size for number in given])[:-1]
    of_each = zip(given, map(np.flatnonzero, np.split(used, ends)), strict=True)
    read = [jnp.ravel(array)[which] for array, which in of_each if which.size]
    dtype = avals[0].dtype

    shapes = [aval.shape for aval in program.out_avals]
    sizes = [math.prod(shape) for shape in shapes]
    known = {key: scalar for key, scalar in found.items() if is_known(scalar)}
    order = {key: i for i, key in enumerate([*(k for k in found if k not in known), *known])}
    written = vmapped_as_kernel(scalars)(*read)
    distinct = lax.concatenate([written, np.array([*known.values()], dtype)], 0)
    parts = lax.split(distinct[np.array([order[key] for key in keys])], sizes)
    return [lax.reshape(part, shape) for part, shape in zip(parts, shapes, strict=True)]


def _joined(value: np.ndarray) -> Any:
    """The JAX array with these entries."""
    if value.dtype != object:
        return jax.numpy.asarray(value)
    scalars = entries_of(value)
    if value.ndim == 0:
        return scalars[0]
    return lax.reshape(lax.concatenate([lax.broadcast(s, (1,)) for s in scalars], 0), value.shape)


class _Evaluation(Arithmetic):
    """One pass over a jaxpr. What came in as a JAX array stays one until it is read."""

    def __init__(self, limit: int) -> None:
        super().__init__(limit)
        self.arrays: dict[int, np.ndarray] = {}  # id of a traced array: its scalars

    def outputs(
        self, program: ClosedJaxpr, consts: Sequence[Any], arguments: Sequence[Any]
    ) -> list[np.ndarray]:
        """The entries of the program's outputs."""
        return [self.split(value) for value in self.run(program.jaxpr, consts, arguments)]

    def run(self, jaxpr: Jaxpr, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
        """Values of the outputs."""
        known: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: Any) -> Any:
            return np.asarray(atom.val) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            results = self.evaluate(equation, [read(atom) for atom in equation.invars])
            known.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def run_closed(self, program: ClosedJaxpr, arguments: Sequence[Any]) -> list[Any]:
        """`run` with the program's own constants."""
        return self.run(program.jaxpr, program.consts, arguments)

    def evaluate(self, equation: JaxprEqn, inputs: list[Any]) -> Sequence[Any]:
        """One equation's outputs."""
        name, params = equation.primitive.name, equation.params
        if equation.effects:
            raise Unsupported(f"{name} has effects")
        if name in _CALLS:
            inner = params["jaxpr"]
            inner, consts = (inner.jaxpr, inner.consts) if hasattr(inner, "consts") else (inner, ())
            return self.run(inner, consts, inputs)
        values = [self.split(value) for value in inputs]
        avals: list[Any] = [variable.aval for variable in equation.outvars]
        if name in _CONTROL:
            return _CONTROL[name](self, values, params)
        if name in MOVES:
            moved = MOVES[name](values, params)
            return [as_numbers(v, aval.dtype) for v, aval in zip(moved, avals, strict=True)]
        shape, dtype = avals[0].shape, avals[0].dtype
        if all(value.dtype != object for value in values):
            if name in NUMPY:
                out = apply_to_known(name, values, params)
                return [np.broadcast_to(out, shape).astype(dtype)]
            if name not in UNROLLED or not all(value.size for value in values):
                if not all(is_numeric(aval.dtype) for aval in avals):
                    raise Unsupported("keys")
                return bound_to_known(equation.primitive, values, params)
        if name in ELEMENTWISE:
            columns = [entries_of(np.broadcast_to(as_objects(value), shape)) for value in values]
            scalars = [
                self.apply(equation.primitive, operands, params)
                for operands in zip(*columns, strict=True)
            ]
            return [as_numbers(array_of(scalars, shape), dtype)]
        if name in UNROLLED:
            out = UNROLLED[name](self, [as_objects(value) for value in values], params)
            return [as_numbers(out, dtype)]
        raise Unsupported(f"{name} of traced scalars")

    def split(self, value: Any) -> np.ndarray:
        """The entries of an array; those of a traced one are its slices."""
        if isinstance(value, np.ndarray):
            return value
        traced = isinstance(value, jax.core.Tracer)
        if (traced or isinstance(value, jax.Array)) and not is_numeric(value.dtype):
            raise Unsupported("keys")
        if not traced:
            return np.asarray(value)
        if id(value) not in self.arrays:
            self.count(value.size)
            scalars: list[Scalar] = [value]
            if value.shape:
                flat = lax.reshape(value, (value.size,))
                scalars = [
                    lax.squeeze(lax.slice(flat, [i], [i + 1]), [0]) for i in range(flat.size)
                ]
            self.alive.append(value)
            entries = array_of(scalars, value.shape)
            self.arrays[id(value)] = as_numbers(entries, value.dtype)
        return self.arrays[id(value)]

    # Loops and branches that do not depend on traced numbers

    def scan(self, values: list[np.ndarray], params: dict[str, Any]) -> list[Any]:
        """All steps of a scan, one after the other."""
        n, carried = _counts(params)
        length = params["length"]
        if length > LONGEST_LOOP:
            raise Unsupported("a long loop")
        fixed, carry, over = values[:n], values[n : n + carried], values[n + carried :]
        rows: list[Any] = [None] * length
        for i in range(length)[:: -1 if params["reverse"] else 1]:
            out = self.run_closed(params["jaxpr"], [*fixed, *carry, *(v[i] for v in over)])
            carry, rows[i] = out[:carried], [self.split(v) for v in out[carried:]]
        avals = params["jaxpr"].out_avals[carried:]
        if not rows and avals:
            raise Unsupported("a scan of no steps")
        columns = zip(zip(*rows, strict=True), avals, strict=True)
        return [*carry, *(as_numbers(np.stack(all_alike(c)), aval.dtype) for c, aval in columns)]

    def loop(self, values: list[np.ndarray], params: dict[str, Any]) -> list[Any]:
        """A while loop, whose condition must be known."""
        a, b = params["cond_nconsts"], params["body_nconsts"]
        of_test, of_body, carry = values[:a], values[a : a + b], list(values[a + b :])
        test, body = map(without_unused, (params["cond_jaxpr"], params["body_jaxpr"]))
        while True:
            (go,) = map(self.split, self.run_closed(test, [*of_test, *carry]))
            if not known_integers(go):
                return carry
            self.count(1)  # a loop of known numbers ends as well
            carry = self.run_closed(body, [*of_body, *carry])

    def branch(self, values: list[np.ndarray], params: dict[str, Any]) -> list[Any]:
        """The branch of a conditional that is taken, which must be known."""
        branches = params["branches"]
        which = int(np.clip(known_integers(values[0]), 0, len(branches) - 1))
        return self.run_closed(branches[which], values[1:])


def _counts(params: dict[str, Any]) -> tuple[int, int]:
    """How many of a scan's operands are fixed, and how many are carried."""
    if "ft_in" in params:  # since jax 0.11
        fixed, carry, _ = params["ft_in"].unpack()
        return len(fixed), len(carry)
    return params["num_consts"], params["num_carry"]


_CONTROL = {"scan": _Evaluation.scan, "while": _Evaluation.loop, "cond": _Evaluation.branch}
_CALLS = {"jit", "pjit", "closed_call", "checkpoint", "remat", "remat2"}
