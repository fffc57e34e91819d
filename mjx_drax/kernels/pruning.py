"""Functions without the operations that their results do not need."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr

Function = TypeVar("Function", bound=Callable[..., Any])


REMEMBERED = 100
"""So many traces of a function are remembered."""


class _Traces:
    """What a function computes of arguments of each shape, and the structure of its result."""

    def __init__(self) -> None:
        self.known: dict[Any, tuple[ClosedJaxpr, Any]] = {}


_every = weakref.WeakSet[_Traces]()


def forget() -> None:
    """Let pruned functions be traced anew: what they read besides their arguments may have changed.

    And let go of the traces now: while one lives, JAX takes an array's numbers of its time.
    """
    for traces in _every:
        traces.known.clear()


def pruned(function: Function) -> Function:
    """The same function of pytrees of arrays, without the operations that its result does not need.

    XLA drops these, but only after JAX has differentiated and lowered them; and a step of physics
    computes much that a cost does not read. Arguments of the same shapes are traced once, for each
    precision of products; see `forget`.
    """
    traces = _Traces()
    _every.add(traces)

    @wraps(function)
    def lean(*arguments: Any) -> Any:
        inputs, structure = jax.tree.flatten(arguments)
        precision = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
        asked = structure, precision, *map(jax.typeof, inputs)
        known = traces.known
        if asked not in known:
            if len(known) == REMEMBERED:
                known.clear()
            program, _, tree = needed_program(function, arguments)
            known[asked] = program, tree
        program, tree = known[asked]
        try:
            return jax.tree.unflatten(tree, jaxpr_as_fun(program)(*inputs))
        except TypeError:  # constants that jax kept from another precision
            return function(*arguments)

    return cast(Function, lean)


def needed_program(
    function: Callable[..., Any], arguments: tuple[Any, ...]
) -> tuple[ClosedJaxpr, list[Any], Any]:
    """What the function computes and its result needs, its inputs, and the result's structure."""
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return without_unused(program), jax.tree.leaves(arguments), jax.tree.structure(shapes)


def without_unused(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program without operations that no output needs."""
    return _pruned(program, keep_inputs=True)[0]


def without_unused_inputs(program: ClosedJaxpr) -> tuple[ClosedJaxpr, list[bool]]:
    """The same without inputs that no output needs, too; and which inputs are left."""
    return _pruned(program, keep_inputs=False)


def _pruned(program: ClosedJaxpr, keep_inputs: bool) -> tuple[ClosedJaxpr, list[bool]]:
    every = [True] * len(program.jaxpr.outvars)
    jaxpr, used = dce_jaxpr(program.jaxpr, every, instantiate=keep_inputs)
    return program.replace(jaxpr=jaxpr), used
