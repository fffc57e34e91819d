"""Arithmetic of scalars, known or traced, that does nothing twice and nothing that is not needed.

A scalar is a known number (np.generic) or a traced one of shape (). Known numbers are folded, equal
operations are shared, and

    0 x = 0,   0 / x = 0,   x - x = 0,   x + 0 = x,   1 x = x,   x + (-y) = x - y,   -(-x) = x.

An array of scalars is a numpy array: of numbers if all of its entries are known, else of objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partialmethod, reduce
from typing import Any

import jax
import numpy as np
from jax import lax

Scalar = Any


class Unsupported(Exception):
    """A function that cannot, or should not, be scalarized."""


class Arithmetic:
    """Operations of scalars: those computed so far, and how many."""

    def __init__(self, limit: int) -> None:
        self.limit, self.operations = limit, 0
        self.computed: dict[Any, Scalar] = {}  # of the operation and its operands
        self.alive: list[Any] = []  # ids are keys of `computed`: what they name must not be freed
        self.negated: dict[int, Scalar] = {}  # id of -x: x

    def count(self, operations: int) -> None:
        """Add to the number of operations, which has a limit."""
        self.operations += operations
        if self.operations > self.limit:
            raise Unsupported(f"more than {self.limit} scalar operations")

    def apply(
        self, primitive: Any, operands: Sequence[Scalar], params: dict[str, Any] | None = None
    ) -> Scalar:
        """An elementwise primitive of scalars: simplified, looked up, or computed."""
        name = primitive.name
        params = PARAMS.get(name, {}) if params is None else params
        simpler = self.simplified(name, operands, params)
        if simpler is not None:
            return simpler
        if all(is_known(operand) for operand in operands):
            if name in NUMPY:
                return apply_to_known(name, operands, params)
            return bound_to_known(primitive, operands, params)[0][()]
        names = [key_of(operand) for operand in operands]
        if name in ("add", "mul", "add_any", "max", "min"):
            names.sort()
        key = (name, tuple(names), tuple((k, str(v)) for k, v in params.items()))
        if key not in self.computed:
            self.count(1)
            self.alive.extend(operands)
            self.computed[key] = out = primitive.bind(*operands, **params)
            if name == "neg":
                self.negated[id(out)] = operands[0]
        return self.computed[key]

    def simplified(self, name: str, operands: Sequence[Scalar], params: dict[str, Any]) -> Scalar:
        """What the operation comes to by one of the identities of this module, or None."""
        first, last = operands[0], operands[-1]
        both_orders = ((first, last), (last, first))
        if name == "mul":
            for a, b in both_orders:
                if equals(a, 0) or equals(b, 1):
                    return a
                if equals(b, -1) and not is_known(a):
                    return self.neg(a)
        elif name in ("add", "add_any"):
            for a, b in both_orders:
                if equals(b, 0):
                    return a
                if id(b) in self.negated:
                    return self.sub(a, self.negated[id(b)])
        elif name == "sub":
            if equals(last, 0):
                return first
            if first is last:
                return np.zeros((), first.dtype)[()]
            if equals(first, 0):
                return self.neg(last)
            if id(last) in self.negated:
                return self.add(first, self.negated[id(last)])
        elif name == "div":
            if equals(first, 0) or equals(last, 1):
                return first
        elif name == "neg":
            return self.negated.get(id(first))
        elif name == "select_n":
            cases = operands[1:]
            if is_known(first):
                return cases[int(first)]
            if all(key_of(case) == key_of(cases[0]) for case in cases):
                return cases[0]
        elif name in ("and", "or") and first.dtype == bool:
            for a, b in both_orders:
                if is_known(a):
                    return a if bool(a) == (name == "or") else b
        elif name in ("copy", "copy_p") or (
            name == "convert_element_type" and first.dtype == params["new_dtype"]
        ):
            return first
        return None

    def of(self, primitive: Any, *operands: Scalar) -> Scalar:
        """An elementwise primitive of these operands."""
        return self.apply(primitive, operands)

    add, sub = partialmethod(of, lax.add_p), partialmethod(of, lax.sub_p)
    mul, div = partialmethod(of, lax.mul_p), partialmethod(of, lax.div_p)
    neg, sqrt = partialmethod(of, lax.neg_p), partialmethod(of, lax.sqrt_p)

    def dot(self, a: Iterable[Scalar], b: Iterable[Scalar], dtype: Any) -> Scalar:
        """a'b; 0 if they are empty."""
        zero = np.zeros((), dtype)[()]
        return reduce(self.add, (self.mul(*pair) for pair in zip(a, b, strict=True)), zero)


def is_known(scalar: Scalar) -> bool:
    """Whether it is a number, not traced."""
    return isinstance(scalar, np.generic)


def equals(scalar: Scalar, number: int) -> bool:
    """Whether it is known to be this number."""
    return is_known(scalar) and scalar.dtype != bool and bool(scalar == number)


def key_of(scalar: Scalar) -> tuple[Any, ...]:
    """What two equal scalars have in common."""
    if is_known(scalar):
        return (0, str(scalar.dtype), scalar.tobytes())
    return (1, "", id(scalar))


def is_numeric(dtype: Any) -> bool:
    """Whether numpy knows the dtype, which it does not of random keys and of float0."""
    return jax.dtypes.issubdtype(dtype, np.number) or dtype == np.bool_


# Arrays of scalars


def array_of(scalars: Sequence[Scalar], shape: Sequence[int]) -> np.ndarray:
    """An array of objects; assigned one by one, because numpy would look into a traced scalar."""
    out = np.empty(len(scalars), object)
    for i, scalar in enumerate(scalars):
        out[i] = scalar
    return out.reshape(shape)


def entries_of(value: np.ndarray) -> list[Scalar]:
    """The entries in row-major order, known ones as numpy scalars."""
    return list(value.reshape(-1))


def as_objects(value: np.ndarray) -> np.ndarray:
    """The same array with entries as objects; `astype(object)` would forget their dtype."""
    return value if value.dtype == object else array_of(entries_of(value), value.shape)


def all_alike(values: Sequence[np.ndarray]) -> list[np.ndarray]:
    """All of them arrays of objects, if one is."""
    mixed = any(value.dtype == object for value in values)
    return [as_objects(value) for value in values] if mixed else list(values)


def as_numbers(value: np.ndarray, dtype: Any) -> np.ndarray:
    """The array as a numeric one, if all of its entries are known."""
    if value.dtype == object and all(map(is_known, entries_of(value))):
        return np.array(entries_of(value), dtype).reshape(value.shape)
    return value


def dtype_of(values: Sequence[np.ndarray]) -> Any:
    """The dtype of the first entry."""
    return next((v.reshape(-1)[0].dtype for v in values if v.size), np.dtype(float))


# Elementwise operations, and numpy's functions for them


def _quotient(a: Any, b: Any) -> Any:
    """a / b, toward zero for integers."""
    whole = np.issubdtype(np.result_type(a), np.integer)
    return np.trunc(np.divide(a, b)) if whole else np.divide(a, b)


_SAME_NAME = "abs ceil cos exp floor log sign sin sqrt square tan tanh"
_OTHER_NAME = (
    "acos=arccos add=add add_any=add and=bitwise_and asin=arcsin atan=arctan atan2=arctan2 "
    "eq=equal ge=greater_equal gt=greater is_finite=isfinite le=less_equal lt=less max=maximum "
    "min=minimum mul=multiply ne=not_equal neg=negative not=invert or=bitwise_or rem=fmod "
    "sub=subtract xor=bitwise_xor"
)
NUMPY: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in _SAME_NAME.split()},
    **{a: getattr(np, b) for a, b in (pair.split("=") for pair in _OTHER_NAME.split())},
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "convert_element_type": lambda x: x,
    "copy": lambda x: x,
    "copy_p": lambda x: x,
    "div": _quotient,
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
}
"""Functions of known numbers, by the names of JAX."""

ELEMENTWISE = {
    *NUMPY,
    *("acosh", "asinh", "atanh", "cbrt", "cosh", "erf", "erf_inv", "exp2", "expm1", "integer_pow"),
    *("log1p", "logistic", "nextafter", "one_minus_square", "pow", "reduce_precision", "round"),
    *("rsqrt", "sinh"),
}
IN_KERNELS = ELEMENTWISE - {
    *("copy", "copy_p", "erf", "one_minus_square", "reduce_precision", "round")
}
"""Those that Pallas lowers for GPUs."""


# The parameters that lax gives to the operations of `Arithmetic`: versions of JAX differ
PARAMS: dict[str, dict[str, Any]] = {
    equation.primitive.name: equation.params
    for equation in jax.make_jaxpr(
        lambda x: [x + x, x - x, x * x, x / x, -x, lax.sqrt(x), lax.max(x, x), lax.min(x, x)]
    )(np.float32(1.0)).eqns
}


def apply_to_known(name: str, operands: Sequence[Any], params: dict[str, Any]) -> Any:
    """An operation of known numbers; a scalar keeps its dtype."""
    with np.errstate(all="ignore"):
        out = NUMPY[name](*operands)
    dtype = params.get("new_dtype", out.dtype if out.dtype == bool else operands[-1].dtype)
    return np.asarray(out).astype(dtype)[()]


def bound_to_known(
    primitive: Any, operands: Sequence[Any], params: dict[str, Any]
) -> list[np.ndarray]:
    """The outputs of a primitive that numpy has no function for: JAX computes them now.

    Left to a kernel, an operation of numbers alone would not compile for a GPU.
    """
    with jax.ensure_compile_time_eval():
        out = primitive.bind(*map(jax.numpy.asarray, operands), **params)
    return [np.asarray(o) for o in (out if primitive.multiple_results else [out])]
