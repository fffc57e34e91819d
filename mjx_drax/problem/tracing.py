"""What is asked of the functions that users give, found by tracing them: nothing is compiled.

A cost is called with arrays that have shapes and no values. That shows what it returns, and what it
computes: its jaxpr. If two traces differ, the function reads something besides its arguments that
changes (a counter, random numbers, the time). If its value depends on its arguments and the tangent
of its value does not, its derivative is zero everywhere, and no solver can follow it. Of an entry
that an array does not have, JAX would take another one.

A function that reads a global which changes later cannot be told from one that reads a constant:
what was read stays until the next solve looks again (`search.identity`).
"""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters.partial_eval import dce_jaxpr
from jax.tree_util import Partial

from mjx_drax.base.digests import plain_array
from mjx_drax.base.errors import DraxError, reason, shown

Arguments = tuple[Any, ...]


def require_functions(**given: Any) -> None:
    """Complain about what is neither a function nor None."""
    for label, function in given.items():
        if function is not None and (not callable(function) or isinstance(function, type)):
            raise DraxError(f"{label} is {shown(function)}: give a function, or leave it out.")


def require_shape(
    label: str, function: Callable[..., Any], arguments: Arguments, shape: tuple[int, ...] | None
) -> None:
    """Trace a function abstractly; complain if it fails or returns another shape."""
    seen = traced(label, function, arguments).shape
    if shape is None and 0 in seen:
        raise DraxError(
            f"{label} returned shape {seen}, no numbers at all: return at least one, or leave it "
            "out; a slice beyond the end of an array is empty."
        )
    if shape is not None and seen != shape:
        expected = "a scalar" if shape == () else f"shape {shape}"
        hint = " (a vector cost goes in as a residual)" if shape == () else ""
        raise DraxError(f"{label} returned shape {seen}, but must return {expected}{hint}.")


def traced(label: str, function: Callable[..., Any], arguments: Arguments) -> jax.ShapeDtypeStruct:
    """Shape and dtype of what a function returns, which must be one array of floats.

    Raises:
        DraxError: it fails, returns something else, or something else each time.
    """

    def one_array(*values: Any) -> Any:
        out = function(*values)
        dtype = getattr(out, "dtype", None) if hasattr(out, "shape") else np.result_type(float)
        if dtype is None or not (hasattr(out, "shape") or isinstance(out, float)):
            way = (_missing(function) if out is None else "") or "Return one array of floats"
            raise DraxError(f"{label} returned {_described(out)}. {way}.")
        if not jnp.issubdtype(dtype, jnp.floating):
            raise DraxError(
                f"{label} returned an array of {dtype}: it must return one array of floats; "
                "use numbers with a point, or astype(float)."
            )
        return out

    first, second = (_jaxpr(label, function, one_array, arguments) for _ in range(2))
    if _fingerprint(first) != _fingerprint(second):
        raise DraxError(
            f"{label} computed something else when it was called again: it depends on a global, on "
            "random numbers or on the time. Make it a function of its arguments alone."
        )
    for index, shape in _out_of_range(first):
        raise DraxError(
            f"{label} reads [{index}] of an array of shape {shape}, which has no such entry, so "
            "JAX would take another one. Change the index, or clip it: entries count from 0."
        )
    return first.out_avals[0]


def _jaxpr(
    label: str, function: Callable[..., Any], one_array: Callable[..., Any], arguments: Arguments
) -> ClosedJaxpr:
    """What `one_array` computes, which calls the user's function."""
    try:
        return jax.make_jaxpr(lambda *values: one_array(*values))(*arguments)  # a new one: no cache
    except DraxError:
        raise
    except Exception as error:
        count = f"{len(arguments)} argument{'s' * (len(arguments) > 1)}"
        count += " and knot=" * bool(_knot_of(function))
        if isinstance(error, _OF_TRACED):
            way = f"Make it a JAX function of its {count}: jax.numpy, and no Python branches"
            way += " on values"
        else:
            given = " and ".join(map(_kind, arguments))
            missing = _missing(function) if "NoneType" in str(error) else ""
            known = _names(function, arguments) if isinstance(error, KeyError) else ""
            way = missing or f"Change it: {known}it is called with {count}, {given}"
        said = f"{plain(error)}{_place(error)}"
        raise DraxError(f"{label} failed when it was traced: {said}. {way}.") from error


def _place(error: Exception) -> str:
    """The last line of a user's own code that an error went through; nothing if there is none."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.is_file() and not any(path.is_relative_to(folder) for folder in _OF_OTHERS):
            return f" ({path.name}, line {frame.lineno})"
    return ""


_OF_OTHERS = (
    *(Path(str(module.__file__)).parent for module in (jax, np)),
    Path(__file__).parents[1],
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")),
)
"""Folders of code that is not a user's."""

_OF_TRACED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.UnexpectedTracerError,
)
"""Errors of functions that ask for what only values have."""

_ASKED_BY = {"data": "data=", "parameters": "parameters=", "rate": "rates=1", "jerk": "rates=2"}
"""What of a knot is None unless an argument asks for it."""


def _missing(function: Any) -> str:
    """What a function may have read of its knot that is None; nothing if it takes no knot."""
    knot = _knot_of(function)
    while isinstance(function, partial):  # ours have the user's function as an argument
        ours = isinstance(function, Partial) and function.args
        function = function.args[0] if ours else function.func
    code = getattr(function, "__code__", None)
    if knot is None and "knot" not in getattr(code, "co_varnames", ()):
        return ""
    named = getattr(code, "co_names", ())
    read = [name for name in _ASKED_BY if name in named] or _ASKED_BY
    none = [name for name in read if getattr(knot, name, None) is None]
    asked = " or ".join(f"{_ASKED_BY[name]} for knot.{name}" for name in none)
    return asked and f"Give {asked}: else it is None"


def _names(function: Any, arguments: Arguments) -> str:
    """The names of parameters and data that a function could read; nothing if there are none."""
    knots = [_knot_of(function), *(getattr(given, "knot", None) for given in arguments)]
    known = {}
    for part, knot in product(("parameters", "data"), knots):
        has = getattr(knot, part, None)
        if isinstance(has, dict) and has:
            known[part] = f"knot.{part} has {', '.join(map(repr, has))}"
    return "".join(f"{names}, and " for names in known.values())


def _knot_of(function: Any) -> Any:
    return getattr(function, "keywords", {}).get("knot")


def _kind(argument: Any) -> str:
    argument = getattr(argument, "seen", argument)  # of a knot that is given beside it
    shape = getattr(argument, "shape", None)
    if shape is not None:
        return f"an array of shape {shape}"
    name = type(argument).__name__
    return f"an {name}" if name[0] in "AEIOU" else f"a {name}"


def _out_of_range(closed: ClosedJaxpr) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Reads that are the same for all arguments, of what an array does not have, and its shape.

    One number as an index, if the array has it, is read by another operation than these.
    """
    jaxpr = closed.jaxpr
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("jit", "pjit"):
            yield from _out_of_range(equation.params["jaxpr"])
        if equation.primitive.name == "dynamic_slice":
            array, *starts = equation.invars
            read = range(len(starts))
        elif equation.primitive.name == "gather" and _promised(equation):
            array, *starts = equation.invars
            read = equation.params["dimension_numbers"].start_index_map
        else:
            continue
        indices, used = dce_jaxpr(jaxpr.replace(outvars=starts), [True] * len(starts))
        if any(used):
            continue
        found = jax.core.eval_jaxpr(indices, closed.consts)
        columns = found if len(found) == len(read) else np.moveaxis(np.asarray(found[0]), -1, 0)
        shape, sizes = array.aval.shape, equation.params["slice_sizes"]
        for axis, column in zip(read, columns, strict=True):
            size, length, starts = sizes[axis], shape[axis], np.ravel(column)
            for start in starts[(starts < 0) | (starts > length - size)]:
                first = int(start) - length * int(start < 0)
                yield f"{first}:{first + size}" if size > 1 else str(first), shape


def _promised(equation: Any) -> bool:
    """Whether the user has not said what to take in place of entries that are missing."""
    return equation.params["mode"] == jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS


def plain(error: Exception) -> str:
    """The reason, for the commonest errors without the terms of JAX."""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return "`if`, `while`, `and`, `or` or `not` on a value; use jnp.where"
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return "a numpy function got a traced value; use the one of jax.numpy"
    if isinstance(error, jax.errors.UnexpectedTracerError):
        return "it kept a traced value in a global and used it again; remove that"
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return "float(), int() or a shape made of a value; use jax.numpy on arrays"
    text = reason(error).replace("jax.", "").replace("DynamicJaxprTracer", "Tracer")
    return text.replace("Tracer", "traced value").rstrip(".")


def _described(out: Any) -> str:
    """What a function returned, without what JAX writes about traced values."""
    if hasattr(out, "shape"):
        return f"an array of {out.dtype}"
    if isinstance(out, bool | int | complex | str | bytes | type(None)):
        return shown(out)
    return f"a {type(out).__name__}"


def _fingerprint(closed: ClosedJaxpr) -> list[Any]:
    """What a jaxpr computes, so that two of the same function are equal."""
    return [*map(_bytes, closed.consts), *_operations(closed.jaxpr)]


def _operations(jaxpr: Jaxpr) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        known = [_bytes(v.val) for v in equation.invars if isinstance(v, Literal)]
        yield str(equation.primitive), known, [str(v.aval) for v in equation.outvars]
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda p: isinstance(p, ClosedJaxpr | Jaxpr)
        ):
            if isinstance(inner, ClosedJaxpr):
                yield from _fingerprint(inner)
            elif isinstance(inner, Jaxpr):
                yield from _operations(inner)
    yield [_bytes(v.val) for v in jaxpr.outvars if isinstance(v, Literal)]


def _bytes(value: Any) -> Any:
    return None if isinstance(value, jax.core.Tracer) else plain_array(value).tobytes()


def require_derivatives(
    label: str,
    function: Callable[..., Any],
    arguments: Arguments,
    forward: bool = True,
    twice: bool = False,
    reverse: bool = False,
) -> None:
    """Complain about a function that has no derivatives, or none but zeros.

    It is a function of pytrees of arrays, which `traced` accepts. It is differentiated in forward
    mode, if asked for `twice` so, and in reverse mode.
    """
    leaves, tree = jax.tree.flatten(arguments)
    moves = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
    values, fixed = (
        [a for a, m in zip(leaves, moves, strict=True) if m is k] for k in (True, False)
    )

    def slopes(values: list[Any], fixed: list[Any], tangents: list[Any]) -> tuple[Any, Any]:
        """The value, and its change along tangents; other modes are tried besides."""

        def of_values(*values: Any) -> Any:
            parts = {True: iter(values), False: iter(fixed)}
            return function(*jax.tree.unflatten(tree, [next(parts[m]) for m in moves]))

        def change(*values: Any) -> Any:
            return jax.jvp(of_values, values, tuple(tangents))[1]

        if twice:
            jax.jvp(change, tuple(values), tuple(tangents))
        if reverse:
            value, back = jax.vjp(of_values, *values)
            slope = back(jnp.ones_like(value))
        if forward:
            return of_values(*values), change(*values)
        return value, [g * t for g, t in zip(slope, tangents, strict=True)]

    try:
        jaxpr = jax.make_jaxpr(slopes)(values, fixed, values).jaxpr
    except Exception as error:
        words = plain(error)
        if "custom_vjp" in str(error) or "custom_lin" in str(error):
            words = "it has a custom_vjp, which serves reverse mode only; make that a custom_jvp"
        raise DraxError(
            f"{label} cannot be differentiated: {words}. Use operations that have derivatives, or "
            "sample it: preconditioner=GaussNewton(derivatives=Smoothed())."
        ) from error
    outputs = [i == 0 for i in range(len(jaxpr.outvars))]
    read = dce_jaxpr(jaxpr, outputs)[1][: len(values)]
    followed = dce_jaxpr(jaxpr, [not o for o in outputs])[1][len(leaves) :]
    if any(read) and not any(followed):
        raise DraxError(
            f"the derivative of {label} is zero everywhere, so nothing can be improved by it: it "
            "rounds, compares or counts. Make it smooth, or sample it: "
            "preconditioner=GaussNewton(derivatives=Smoothed())."
        )
