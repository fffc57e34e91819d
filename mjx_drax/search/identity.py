"""What a program of rows computes, as a text, before it is traced; see `kernels.kept`.

Of the functions that a user gave, the text is what JAX makes of them by themselves: each is traced
once, for one knot, which takes a small part of the time that the whole program would. All else in a
program is code of this package, what is static in its structures, and numbers that it is given.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive, primitives

from mjx_drax.base.digests import digest
from mjx_drax.base.structures import Unspelled, spelled
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.kernels.pruning import forget, pruned
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.rollout import untraced
from mjx_drax.search.captured import changed_in_place, not_read

_JAXS = {p for p in vars(primitives).values() if isinstance(p, Primitive)}
"""Operations whose rules are JAX's own."""

REMEMBERED = 100
"""Problems whose functions' texts are remembered."""

_found: dict[Any, str] = {}


def identity(arguments: Any, problem: Problem) -> str | None:
    """What a program computes of arguments with this problem; None if that cannot be told.

    Args:
        arguments: a tree of all of them.
        problem: with numbers of any row.
    """
    leaves, tree = jax.tree.flatten(problem)
    try:
        whole = spelled(jax.tree.structure(arguments), lambda kind: kind is Problem)
        found = _found.get(_kind(leaves, tree))
        return whole + (found or _of_functions(leaves, tree))
    except Exception:  # whatever it is, JAX says it better of the program itself
        return None


def look_again(problem: Problem) -> None:
    """Let JAX forget all programs if functions of the problem compute something else than before.

    JAX knows a function by its identity. If a global that it reads has another value now, or an
    array other numbers, the programs that were compiled still have the old ones.
    """
    leaves, tree = jax.tree.flatten(problem)
    kind = _kind(leaves, tree)
    before = _found.pop(kind, None)
    changed = changed_in_place(tree)
    if changed:
        _forget()
    try:
        now = _of_functions(leaves, tree)
    except Exception:  # as in `identity`; whether they have changed cannot be told
        _forget()
        return
    if before == now:
        not_read(tree, changed)
    elif before is not None:
        _forget()
    else:  # f may be known from another problem, by itself
        untraced.cache_clear()
    _found[kind] = now
    if len(_found) > REMEMBERED:
        del _found[next(iter(_found))]


def _forget() -> None:
    forget()
    jax.clear_caches()
    untraced.cache_clear()


def _kind(leaves: list[Any], tree: Any) -> Any:
    """A problem's functions, and the kinds of its numbers."""
    return tree, tuple(map(_shape, leaves)), jnp.result_type(float)


def _shape(leaf: Any) -> jax.ShapeDtypeStruct:
    weak = getattr(leaf, "weak_type", isinstance(leaf, int | float))
    return jax.ShapeDtypeStruct(jnp.shape(leaf), jax.dtypes.result_type(leaf), weak_type=weak)


@full_precision
def _of_functions(leaves: list[Any], tree: Any) -> str:
    """All functions of a problem, and f if it is made of functions, as programs of one knot."""
    problem: Problem = jax.tree.unflatten(tree, map(_shape, leaves))
    f, number = problem.dynamics, problem.x_init.dtype
    try:
        spelled(jax.tree.structure(f))
        own_f = False
    except Unspelled:
        own_f = True

    def anew(name: str, *arguments: Any) -> Any:
        method = getattr(Problem, name).__wrapped__  # of those, JAX remembers what it has traced
        return pruned(lambda *again: method(*again))(*arguments)

    def functions(problem: Problem, x: Array, u: Array) -> Any:
        knot = problem.knots.at(0)
        return (
            anew("running_cost", problem, x, u, knot),
            anew("terminal_cost", problem, x),
            anew("running_constraint", problem, x, u, knot),
            anew("end_constraint", problem, x),
            problem.dynamics.at(knot).step(x, u) if own_f else None,
        )

    def derived(problem: Problem, x: Array, u: Array) -> Any:
        """Their second derivatives, for several knots at once."""

        def first(*at: Array) -> Any:
            return jax.jvp(lambda *z: functions(problem, *z), at, at)

        return jax.vmap(lambda *at: jax.jvp(first, at, at))(x, u)

    def program(function: Any, *leading: int) -> Any:
        sizes = ((*leading, n) for n in (f.nx, f.nu))
        return jax.jit(function).trace(
            problem, *(jax.ShapeDtypeStruct(size, number) for size in sizes)
        )

    traced = program(functions)
    used = set(_operations(traced.jaxpr.jaxpr))
    if any(p.name.startswith("custom") or p not in _JAXS for p in used):
        traced = program(derived, 2)  # a user's own rules of derivatives and batches are in it
    if any(p.name == "linear_call" for p in used):
        raise Unspelled("a rule of transposition")
    lowered = traced.lower().as_text()
    if "callback" in lowered:
        raise Unspelled("a callback to Python")
    # Operations that derivatives alone know of, as stop_gradient, are not in what is lowered
    text = re.sub(r" at 0x[0-9a-f]+", "", str(traced.jaxpr.jaxpr))
    return "".join(map(digest, (text, lowered, traced.jaxpr.consts)))


def _operations(jaxpr: Jaxpr) -> Iterator[Primitive]:
    """All operations of a program, those inside of others included."""
    for equation in jaxpr.eqns:
        yield equation.primitive
        for part in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_program):
            if _is_program(part):
                yield from _operations(part.jaxpr if isinstance(part, ClosedJaxpr) else part)


def _is_program(part: Any) -> bool:
    return isinstance(part, Jaxpr | ClosedJaxpr)
