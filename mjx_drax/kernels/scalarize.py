"""Functions of one knot, unrolled into scalar arithmetic that compiles to a few fused loops.

The step of a small robot is some hundred multiplications, written by MJX as thousands of tiny array
operations: slices, gathers, products of 3x3 matrices. Under `vmap` over knots and chains each of
them moves memory. `scalarized(f)` traces f once and evaluates its jaxpr with every array held as a
numpy array of scalars, each a known number or a traced scalar. What moves numbers about (reshape,
gather, concatenate, ...) then happens here, at trace time; what computes is bound scalar by scalar,

    0 x = 0,   0 / x = 0,   x - x = 0,   x + 0 = x,   1 x = x,   x + (-y) = x - y,   -(-x) = x,

with known numbers folded and equal operations shared. The result is elementwise code, which fuses.

The first three identities hold for finite x only: where x is infinite or NaN, the scalarized
function returns the 0, not NaN; and x + 0 keeps the sign of x = -0. All others are exact; what is
left of a difference to f is rounding, because sums are taken in another order.

A function with an operation that has no rule here, or with too many of them, is evaluated as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import reduce, wraps
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr

LIMIT = 8_000
"""Scalar operations of a function, above which it is left as it is: XLA would compile for longer
than it takes for the array operations."""

Function = TypeVar("Function", bound=Callable[..., Any])

Scalar = Any
"""A known number (np.generic) or a traced scalar of shape ()."""


class Unsupported(Exception):
    """A function that cannot, or should not, be scalarized."""


def scalarized(
    function: Callable[..., Any], limit: int = LIMIT, outermost: bool = False
) -> Callable[..., Any]:
    """The same function of pytrees of arrays, in scalar arithmetic where that is possible.

    With more than `limit` operations (each entry of a traced array that is read counts as one) it
    stays as it is. Arrays that the function closes over and that are not traced are known numbers,
    whose zeros and ones are used. Arguments are not. Functions with their own derivative rule
    (custom_jvp, custom_vjp) are not opened, because the result may be differentiated:
    differentiate first. If it is `outermost`, which nobody differentiates, GPUs compute it for all
    rows of a batch by one kernel.
    """

    @wraps(function)
    def in_scalars(*arguments: Any) -> Any:
        closed, flat, tree = _traced(function, arguments)
        try:
            outputs = (_in_kernel if outermost and _on_gpu() else _in_loops)(limit, closed, flat)
        except (Unsupported, TypeError):  # types: as in `pruned`
            outputs = _in_arrays(closed, flat)
        return jax.tree.unflatten(tree, outputs)

    return in_scalars


def _in_arrays(closed: ClosedJaxpr, flat: Sequence[Any]) -> list[Any]:
    return jaxpr_as_fun(closed)(*flat)


def _in_loops(limit: int, closed: ClosedJaxpr, flat: Sequence[Any]) -> list[Any]:
    """In operations that XLA fuses."""
    return [_joined(v) for v in _Evaluation(limit).outputs(closed, closed.consts, flat)]


def _on_gpu() -> bool:
    return jax.default_backend() == "gpu"


def _in_kernel(limit: int, closed: ClosedJaxpr, flat: Sequence[Any]) -> list[Any]:
    """In operations that one kernel applies to all rows of a batch.

    It writes each number once, and none that is known, as most entries of large Jacobians are: its
    compilation takes long where it writes many.
    """
    numbers = [*closed.consts, *flat]
    traced = [isinstance(number, jax.core.Tracer) for number in numbers]
    inputs = [number for number, is_traced in zip(numbers, traced, strict=True) if is_traced]

    found: dict[Any, Scalar] = {}  # distinct entries of the outputs
    keys: list[Any] = []  # of all entries

    def in_scalars(*entries: Scalar) -> list[Scalar]:
        left, values = iter(entries), list(numbers)
        for i, number in enumerate(numbers):
            if traced[i]:
                values[i] = _array([next(left) for _ in range(number.size)], number.shape)
        consts, arguments = values[: len(closed.consts)], values[len(closed.consts) :]
        outputs = _Evaluation(limit).outputs(closed, consts, arguments)
        scalars = [scalar for output in outputs for scalar in _flat(output)]
        keys.extend(map(_key, scalars))
        found.update(zip(keys, scalars, strict=True))
        return [scalar for scalar in found.values() if not isinstance(scalar, np.generic)]

    dtype, entries = np.dtype(np.float32), sum(number.size for number in inputs)
    avals: list[Any] = [*(number.aval for number in inputs), *closed.out_avals]
    if not inputs or any(a.dtype != dtype for a in avals) or entries > limit:
        return _in_loops(limit, closed, flat)
    program = jax.make_jaxpr(in_scalars)(*[jax.ShapeDtypeStruct((), dtype)] * entries)
    plain = all(equation.primitive.name in _IN_KERNELS for equation in program.eqns)
    if not (plain and program.out_avals):
        return _in_loops(limit, closed, flat)
    from mjx_drax.kernels.rows import by_rows  # only here: importing Pallas takes a second

    shapes = [aval.shape for aval in closed.out_avals]
    sizes = [math.prod(shape) for shape in shapes]
    known = {key: scalar for key, scalar in found.items() if isinstance(scalar, np.generic)}
    places = {key: i for i, key in enumerate([*(k for k in found if k not in known), *known])}
    distinct = lax.concatenate([by_rows(program)(*inputs), np.array([*known.values()], dtype)], 0)
    parts = lax.split(distinct[np.array([places[key] for key in keys])], sizes)
    return [lax.reshape(part, shape) for part, shape in zip(parts, shapes, strict=True)]


def pruned(function: Function) -> Function:
    """The same function of pytrees of arrays, without the operations that its result does not need.

    XLA drops these, but only after JAX has differentiated and lowered them; and a step of physics
    computes much that a cost does not read.
    """

    @wraps(function)
    def lean(*arguments: Any) -> Any:
        closed, flat, tree = _traced(function, arguments)
        try:
            return jax.tree.unflatten(tree, jaxpr_as_fun(closed)(*flat))
        except TypeError:  # constants that jax kept from another precision
            return function(*arguments)

    return cast(Function, lean)


def _traced(
    function: Callable[..., Any], arguments: tuple[Any, ...]
) -> tuple[ClosedJaxpr, list[Any], Any]:
    """What the function computes and its result needs, its inputs, and the result's structure."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    jaxpr, _ = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    tree = jax.tree.structure(shapes)
    return closed.replace(jaxpr=jaxpr), jax.tree.leaves(arguments), tree


class _Evaluation:
    """One pass over a jaxpr: the scalars computed so far, and how many operations they took.

    A value is a numpy array: numeric if all of its entries are known, else of objects. What came in
    as a JAX array stays one until it is read.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self.limit, self.operations = limit, 0
        self.memo: dict[Any, Scalar] = {}
        self.alive: list[Any] = []  # ids are keys of `memo`: what they name must not be freed
        self.negated: dict[int, Scalar] = {}  # id of -x: x
        self.entries: dict[int, np.ndarray] = {}  # id of an array: its scalars

    def outputs(
        self, closed: ClosedJaxpr, consts: Sequence[Any], arguments: Sequence[Any]
    ) -> list[np.ndarray]:
        """The entries of the jaxpr's outputs."""
        needed = [True] * len(closed.jaxpr.outvars)
        return [self.split(value) for value in self.run(closed.jaxpr, consts, arguments, needed)]

    def run(
        self, jaxpr: Jaxpr, consts: Sequence[Any], arguments: Sequence[Any], needed: Sequence[bool]
    ) -> list[Any]:
        """Values of the outputs that are needed, None for the others."""
        known: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: Any) -> Any:
            return np.asarray(atom.val) if isinstance(atom, Literal) else known[atom]

        for equation, wanted in _live(jaxpr, needed):
            inputs = [read(atom) for atom in equation.invars]
            results = self.evaluate(equation, inputs, wanted)
            for variable, value in zip(equation.outvars, results, strict=True):
                known[variable] = value
        return [read(a) if n else None for a, n in zip(jaxpr.outvars, needed, strict=True)]

    def evaluate(
        self, equation: JaxprEqn, inputs: list[Any], wanted: Sequence[bool]
    ) -> Sequence[Any]:
        """One equation's outputs."""
        name, params = equation.primitive.name, equation.params
        if equation.effects:
            raise Unsupported(f"{name} has effects")
        if name in _CALLS:
            inner = params["jaxpr"]
            inner, consts = (inner.jaxpr, inner.consts) if hasattr(inner, "consts") else (inner, ())
            return self.run(inner, consts, inputs, wanted)
        values = [self.split(value) for value in inputs]
        if name in _CONTROL:
            return _CONTROL[name](self, values, params)
        if name in _STRUCTURE:
            moved = _STRUCTURE[name](values, params)
            return [_tidy(v, out.aval) for v, out in zip(moved, equation.outvars, strict=True)]
        aval: Any = equation.outvars[0].aval
        shape, dtype = aval.shape, aval.dtype
        if all(value.dtype != object for value in values):
            if name in _NUMPY:
                return [np.broadcast_to(_known(name, values, params), shape).astype(dtype)]
            if name not in _UNROLLED or not all(value.size for value in values):
                avals: list[Any] = [variable.aval for variable in equation.outvars]
                if not all(_is_numeric(a.dtype) for a in avals):
                    raise Unsupported("keys")
                with jax.ensure_compile_time_eval():
                    out = equation.primitive.bind(*map(jax.numpy.asarray, values), **params)
                several = equation.primitive.multiple_results
                return [np.asarray(o) for o in (out if several else [out])]
        if name in _ELEMENTWISE:
            columns = [_flat(np.broadcast_to(_boxed(value), shape)) for value in values]
            scalars = [
                self.apply(equation.primitive, operands, params)
                for operands in zip(*columns, strict=True)
            ]
            return [_tidy(_array(scalars, shape), aval)]
        if name in _UNROLLED:
            out = _UNROLLED[name](self, [_boxed(value) for value in values], params)
            return [_tidy(out, aval)]
        raise Unsupported(f"{name} of traced scalars")

    def split(self, value: Any) -> np.ndarray:
        """The entries of an array; those of a traced one are its slices."""
        if isinstance(value, np.ndarray):
            return value
        if not isinstance(value, jax.core.Tracer):
            if isinstance(value, jax.Array) and not _is_numeric(value.dtype):
                raise Unsupported("keys")
            return np.asarray(value)
        if id(value) not in self.entries:
            if not _is_numeric(value.dtype):
                raise Unsupported("keys")
            self.count(value.size)
            scalars: list[Scalar] = [value]
            if value.shape:
                flat = lax.reshape(value, (value.size,))
                scalars = [
                    lax.squeeze(lax.slice(flat, [i], [i + 1]), [0]) for i in range(flat.size)
                ]
            self.alive.append(value)
            self.entries[id(value)] = _tidy(_array(scalars, value.shape), value)
        return self.entries[id(value)]

    def count(self, operations: int) -> None:
        """Add to the number of operations, which has a limit."""
        self.operations += operations
        if self.operations > self.limit:
            raise Unsupported(f"more than {self.limit} scalar operations")

    def apply(
        self, primitive: Any, operands: Sequence[Scalar], params: dict[str, Any] | None = None
    ) -> Scalar:
        """An elementwise primitive of scalars: simplified, remembered, or bound."""
        name = primitive.name
        params = _PARAMS.get(name, {}) if params is None else params
        simpler = self.simplified(name, operands, params)
        if simpler is not None:
            return simpler
        if name in _NUMPY and all(isinstance(o, np.generic) for o in operands):
            return _known(name, operands, params)
        names = [_key(operand) for operand in operands]
        if name in ("add", "mul", "add_any", "max", "min"):
            names.sort()
        key = (name, tuple(names), tuple((k, str(v)) for k, v in params.items()))
        if key not in self.memo:
            self.count(1)
            self.alive.extend(operands)
            self.memo[key] = out = primitive.bind(*operands, **params)
            if name == "neg":
                self.negated[id(out)] = operands[0]
        return self.memo[key]

    def simplified(self, name: str, operands: Sequence[Scalar], params: dict[str, Any]) -> Scalar:
        """What the operation comes to by one of the identities of this module, or None."""
        first, last = operands[0], operands[-1]
        if name == "mul":
            for a, b in ((first, last), (last, first)):
                if _is(a, 0) or _is(b, 1):
                    return a
                if _is(b, -1) and not isinstance(a, np.generic):
                    return self.neg(a)
        elif name in ("add", "add_any"):
            for a, b in ((first, last), (last, first)):
                if _is(b, 0):
                    return a
                if id(b) in self.negated:
                    return self.sub(a, self.negated[id(b)])
        elif name == "sub":
            if _is(last, 0):
                return first
            if first is last:
                return np.zeros((), first.dtype)[()]
            if _is(first, 0):
                return self.neg(last)
            if id(last) in self.negated:
                return self.add(first, self.negated[id(last)])
        elif name == "div":
            if _is(first, 0) or _is(last, 1):
                return first
        elif name == "neg":
            return self.negated.get(id(first))
        elif name == "select_n":
            cases = operands[1:]
            if isinstance(first, np.generic):
                return cases[int(first)]
            if all(_key(case) == _key(cases[0]) for case in cases):
                return cases[0]
        elif name in ("and", "or") and first.dtype == bool:
            absorbing = name == "or"
            for a, b in ((first, last), (last, first)):
                if isinstance(a, np.generic):
                    return a if bool(a) == absorbing else b
        elif name in ("copy", "copy_p") or (
            name == "convert_element_type" and first.dtype == params["new_dtype"]
        ):
            return first
        return None

    def add(self, a: Scalar, b: Scalar) -> Scalar:
        """a + b."""
        return self.apply(lax.add_p, (a, b))

    def sub(self, a: Scalar, b: Scalar) -> Scalar:
        """a - b."""
        return self.apply(lax.sub_p, (a, b))

    def mul(self, a: Scalar, b: Scalar) -> Scalar:
        """a b."""
        return self.apply(lax.mul_p, (a, b))

    def div(self, a: Scalar, b: Scalar) -> Scalar:
        """a / b."""
        return self.apply(lax.div_p, (a, b))

    def neg(self, a: Scalar) -> Scalar:
        """-a."""
        return self.apply(lax.neg_p, (a,))

    def dot(self, a: Iterable[Scalar], b: Iterable[Scalar], dtype: Any) -> Scalar:
        """a'b; 0 if they are empty."""
        zero = np.zeros((), dtype)[()]
        return reduce(self.add, (self.mul(*pair) for pair in zip(a, b, strict=True)), zero)


def _live(jaxpr: Jaxpr, needed: Sequence[bool]) -> list[tuple[JaxprEqn, list[bool]]]:
    """The equations that the needed outputs depend on, and which of their outputs these read."""
    wanted = {v for v, n in zip(jaxpr.outvars, needed, strict=True) if n and _is_variable(v)}
    live = []
    for equation in reversed(jaxpr.eqns):
        flags = [v in wanted for v in equation.outvars]
        if any(flags) or equation.effects:
            live.append((equation, flags))
            wanted.update(v for v in equation.invars if _is_variable(v))
    return live[::-1]


def _is_variable(atom: Any) -> bool:
    return not isinstance(atom, Literal)


# Arrays of scalars


def _array(scalars: Sequence[Scalar], shape: tuple[int, ...]) -> np.ndarray:
    """An array of objects; assigned one by one, because numpy would look into a traced scalar."""
    out = np.empty(len(scalars), object)
    for i, scalar in enumerate(scalars):
        out[i] = scalar
    return out.reshape(shape)


def _flat(value: np.ndarray) -> list[Scalar]:
    """The entries in row-major order, known ones as numpy scalars."""
    return list(value.reshape(-1))


def _boxed(value: np.ndarray) -> np.ndarray:
    """The same array with entries as objects; `astype(object)` would forget their dtype."""
    return value if value.dtype == object else _array(_flat(value), value.shape)


def _tidy(value: np.ndarray, aval: Any) -> np.ndarray:
    """The array as a numeric one, if all of its entries are known."""
    if value.dtype == object and all(isinstance(s, np.generic) for s in value.reshape(-1)):
        return np.array(_flat(value), aval.dtype).reshape(value.shape)
    return value


def _joined(value: np.ndarray) -> Any:
    """The JAX array with these entries."""
    if value.dtype != object:
        return jax.numpy.asarray(value)
    scalars = _flat(value)
    if value.ndim == 0:
        return scalars[0]
    return lax.reshape(lax.concatenate([lax.broadcast(s, (1,)) for s in scalars], 0), value.shape)


def _is_numeric(dtype: Any) -> bool:
    """Whether numpy knows the dtype, which it does not of random keys and of float0."""
    return jax.dtypes.issubdtype(dtype, np.number) or dtype == np.bool_


def _is(scalar: Scalar, number: int) -> bool:
    return isinstance(scalar, np.generic) and scalar.dtype != bool and bool(scalar == number)


def _key(scalar: Scalar) -> tuple[Any, ...]:
    """What two equal scalars have in common."""
    if isinstance(scalar, np.generic):
        return (0, str(scalar.dtype), scalar.tobytes())
    return (1, "", id(scalar))


# Elementwise operations, and numpy's names for them


def _quotient(a: Any, b: Any) -> Any:
    """a / b, toward zero for integers."""
    exact = np.issubdtype(np.result_type(a), np.integer)
    return np.trunc(np.divide(a, b)) if exact else np.divide(a, b)


_NUMPY: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "acos": np.arccos,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "asin": np.arcsin,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "ceil": np.ceil,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "convert_element_type": lambda x: x,
    "copy": lambda x: x,
    "copy_p": lambda x: x,
    "cos": np.cos,
    "div": _quotient,
    "eq": np.equal,
    "exp": np.exp,
    "floor": np.floor,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "log": np.log,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "rem": np.fmod,
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
    "sign": np.sign,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "square": np.square,
    "sub": np.subtract,
    "tan": np.tan,
    "tanh": np.tanh,
    "xor": np.bitwise_xor,
}
_ELEMENTWISE = {
    *_NUMPY,
    *("acosh", "asinh", "atanh", "cbrt", "cosh", "erf", "erf_inv", "exp2", "expm1", "integer_pow"),
    *("log1p", "logistic", "nextafter", "one_minus_square", "pow", "reduce_precision", "round"),
    *("rsqrt", "sinh"),
}
_IN_KERNELS = _ELEMENTWISE - {
    *("copy", "copy_p", "erf", "one_minus_square", "reduce_precision", "round")
}
"""Those that Pallas lowers for GPUs."""


# The parameters that lax gives to the operations which are bound here: versions of JAX differ
_PARAMS: dict[str, dict[str, Any]] = {
    equation.primitive.name: equation.params
    for equation in jax.make_jaxpr(
        lambda x: [x + x, x - x, x * x, x / x, -x, lax.sqrt(x), lax.max(x, x), lax.min(x, x)]
    )(np.float32(1.0)).eqns
}


def _known(name: str, operands: Sequence[Any], params: dict[str, Any]) -> Any:
    """An operation of known numbers; a scalar keeps its dtype."""
    with np.errstate(all="ignore"):
        out = _NUMPY[name](*operands)
    dtype = params.get("new_dtype", out.dtype if out.dtype == bool else operands[-1].dtype)
    return np.asarray(out).astype(dtype)[()]


# Operations that move numbers about, for numeric arrays and for arrays of objects alike

_Rule = Callable[[list[np.ndarray], dict[str, Any]], Sequence[np.ndarray]]


def _alike(values: Sequence[np.ndarray]) -> list[np.ndarray]:
    """All of them arrays of objects, if one is."""
    return [_boxed(v) for v in values] if any(v.dtype == object for v in values) else list(values)


def _broadcast_in_dim(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    shape, dimensions = params["shape"], params["broadcast_dimensions"]
    aligned = np.ones(len(shape), int)
    aligned[list(dimensions)] = values[0].shape
    return [np.broadcast_to(values[0].reshape(aligned), shape)]


def _slice(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    strides = params["strides"] or (1,) * values[0].ndim
    ends = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [values[0][tuple(slice(*e) for e in ends)]]


def _pad(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    value, fill = _alike(values)
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


def _split(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    return np.split(values[0], np.cumsum(params["sizes"])[:-1], params["axis"])


def _numbers(value: np.ndarray) -> np.ndarray:
    """Known integers, which say where numbers go."""
    if not all(isinstance(entry, np.generic) for entry in _flat(value)):
        raise Unsupported("an index that is not known")
    return value.astype(int)


def _starts(indices: Sequence[np.ndarray], shape: Sequence[int], sizes: Sequence[int]) -> list[int]:
    """Starts of a dynamic slice, moved inside the array as JAX does."""
    where = zip(indices, shape, sizes, strict=True)
    return [int(np.clip(_numbers(i), 0, n - size)) for i, n, size in where]


def _dynamic_slice(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    sizes = params["slice_sizes"]
    starts = _starts(values[1:], values[0].shape, sizes)
    return [values[0][tuple(slice(s, s + n) for s, n in zip(starts, sizes, strict=True))]]


def _dynamic_update_slice(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    operand, update = _alike(values[:2])
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
) -> tuple[list[np.ndarray], np.ndarray]:
    """Where the windows of a gather or scatter lie in an operand of this shape.

    Returns:
        coordinates for each dimension of the operand, (*batch, *sizes), moved inside the operand
        as a whole; and whether a window lay inside by itself, (*batch,).
    """
    indices = _numbers(indices)
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


def _gather(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
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
    values: list[np.ndarray], params: dict[str, Any], combine: Callable[[Scalar, Scalar], Scalar]
) -> np.ndarray:
    """The operand, with combine(entry, update) at the indices."""
    (operand, updates), indices = _alike([values[0], values[2]]), values[1]
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
    for at, update, use in zip(where, _flat(updates), used.reshape(-1), strict=True):
        if use:
            out[at] = combine(out[at], update)
    return out


def _identity(values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    return values


_STRUCTURE: dict[str, _Rule] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda v, p: [np.concatenate(_alike(v), p["dimension"])],
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
    "stack": lambda v, p: [np.stack(_alike(v), p["axis"])],
    "tile": lambda v, p: [np.tile(v[0], p["reps"])],
    "transpose": lambda v, p: [np.transpose(v[0], p["permutation"])],
}


# Sums, products and factorizations, unrolled


def _dot_general(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> np.ndarray:
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]

    def rows(value: np.ndarray, batch: Sequence[int], contract: Sequence[int]) -> Any:
        """The array as (batch, free, contracted), and the sizes of its batch and free axes."""
        free = [d for d in range(value.ndim) if d not in batch and d not in contract]
        sizes = [[value.shape[d] for d in axes] for axes in (batch, free, contract)]
        shape = [math.prod(s) for s in sizes]
        return np.transpose(value, (*batch, *free, *contract)).reshape(shape), sizes[0], sizes[1]

    a, batch, free_a = rows(values[0], batch_a, contract_a)
    b, _, free_b = rows(values[1], batch_b, contract_b)
    dtype = params["preferred_element_type"] or _dtype(values)
    if any(_dtype([v]) != dtype for v in values if v.size):
        raise Unsupported("a product that changes dtype")
    out = [ev.dot(p, q, dtype) for A, B in zip(a, b, strict=True) for p in A for q in B]
    return _array(out, (*batch, *free_a, *free_b))


def _dtype(values: Sequence[np.ndarray]) -> Any:
    """The dtype of the first entry."""
    return next((v.reshape(-1)[0].dtype for v in values if v.size), np.dtype(float))


def _fold(primitive: Any) -> Callable[..., np.ndarray]:
    """A reduction over some axes."""

    def rule(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> np.ndarray:
        axes = params["axes"]
        last = np.moveaxis(values[0], axes, range(-len(axes), 0))
        shape = last.shape[: last.ndim - len(axes)]
        rows = last.reshape(math.prod(shape), -1)
        return _array([reduce(lambda a, b: ev.apply(primitive, (a, b)), r) for r in rows], shape)

    return rule


def _cumulate(primitive: Any) -> Callable[..., np.ndarray]:
    """Partial reductions along an axis."""

    def rule(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> np.ndarray:
        first = np.moveaxis(values[0], params["axis"], 0)
        lines = first.reshape(len(first), -1)[:: -1 if params["reverse"] else 1].copy()
        for i in range(1, len(lines)):
            pairs = zip(lines[i - 1], lines[i], strict=True)
            lines[i] = _array([ev.apply(primitive, pair) for pair in pairs], lines[i].shape)
        lines = lines[:: -1 if params["reverse"] else 1]
        return np.moveaxis(lines.reshape(first.shape), 0, params["axis"])

    return rule


def _each_matrix(rule: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """A rule for matrices, over their leading axes."""

    def batched(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> np.ndarray:
        batch = values[0].shape[:-2]
        flat = [v.reshape(-1, *v.shape[-2:]) for v in values]
        out = [rule(ev, matrices, params) for matrices in zip(*flat, strict=True)]
        shape = (*batch, *values[-1].shape[-2:])
        return _array([s for matrix in out for s in _flat(matrix)], shape)

    return batched


def _cholesky(ev: _Evaluation, values: Sequence[np.ndarray], params: dict[str, Any]) -> np.ndarray:
    (A,) = values
    dtype = _dtype(values)
    L = _boxed(np.zeros(A.shape, dtype))
    for i in range(len(A)):
        for j in range(i + 1):
            rest = ev.sub(A[i, j], ev.dot(L[i, :j], L[j, :j], dtype))
            L[i, j] = ev.apply(lax.sqrt_p, (rest,)) if i == j else ev.div(rest, L[j, j])
    return L


def _triangular_solve(
    ev: _Evaluation, values: Sequence[np.ndarray], params: dict[str, Any]
) -> np.ndarray:
    A, B = values
    left, lower = params["left_side"], params["lower"]
    if params["conjugate_a"] and np.issubdtype(_dtype(values), np.complexfloating):
        raise Unsupported("complex numbers")
    if params["transpose_a"] == left:  # otherwise A X = B already, or X A' = B, that is A X' = B'
        A, lower = A.T, not lower
    X = (B if left else B.T).copy()
    order = range(len(A)) if lower else range(len(A))[::-1]
    for c in range(X.shape[1]):
        for n, i in enumerate(order):
            done = list(order[:n])
            rest = ev.sub(X[i, c], ev.dot(A[i, done], X[done, c], _dtype(values)))
            X[i, c] = rest if params["unit_diagonal"] else ev.div(rest, A[i, i])
    return X if left else X.T


_UNROLLED: dict[str, Callable[..., np.ndarray]] = {
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
    "scatter-add": lambda ev, v, p: _scattered(v, p, ev.add),
    "scatter-mul": lambda ev, v, p: _scattered(v, p, ev.mul),
    "triangular_solve": _each_matrix(_triangular_solve),
}


# Loops and branches that do not depend on traced numbers


def _closed(ev: _Evaluation, closed: ClosedJaxpr, arguments: Sequence[Any]) -> list[Any]:
    jaxpr = closed.jaxpr
    return ev.run(jaxpr, closed.consts, arguments, [True] * len(jaxpr.outvars))


def _scan(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> list[np.ndarray]:
    n, carried = _counts(params)
    length = params["length"]
    fixed, carry, over = values[:n], values[n : n + carried], values[n + carried :]
    rows: list[Any] = [None] * length
    for i in range(length)[:: -1 if params["reverse"] else 1]:
        out = _closed(ev, params["jaxpr"], [*fixed, *carry, *(v[i] for v in over)])
        carry, rows[i] = out[:carried], [ev.split(v) for v in out[carried:]]
    avals = params["jaxpr"].out_avals[carried:]
    if not rows and avals:
        raise Unsupported("a scan of no steps")
    stacked = [
        _tidy(np.stack(_alike(column)), aval)
        for column, aval in zip(zip(*rows, strict=True), avals, strict=True)
    ]
    return [*carry, *stacked]


def _counts(params: dict[str, Any]) -> tuple[int, int]:
    """How many of a scan's operands are fixed, and how many are carried."""
    if "ft_in" in params:  # since jax 0.11
        fixed, carry, _ = params["ft_in"].unpack()
        return len(fixed), len(carry)
    return params["num_consts"], params["num_carry"]


def _while(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> list[Any]:
    a, b = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_body, carry = values[:a], values[a : a + b], list(values[a + b :])
    while True:
        (go,) = map(ev.split, _closed(ev, params["cond_jaxpr"], [*of_test, *carry]))
        if not _numbers(go):
            return carry
        ev.count(1)  # a loop of known numbers ends as well
        carry = _closed(ev, params["body_jaxpr"], [*of_body, *carry])


def _cond(ev: _Evaluation, values: list[np.ndarray], params: dict[str, Any]) -> list[Any]:
    branches = params["branches"]
    which = int(np.clip(_numbers(values[0]), 0, len(branches) - 1))
    return _closed(ev, branches[which], values[1:])


_CONTROL = {"scan": _scan, "while": _while, "cond": _cond}
_CALLS = {"jit", "pjit", "closed_call", "checkpoint", "remat", "remat2"}
