"""Where chains start: knots that are drawn, or a guess."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.iterate import chain_keys, joined


def initial_knots(
    problem: Problem, chains: int, guess: Trajectory | None, key: Array
) -> Trajectory:
    """Initial knots for every chain: drawn, or the guess broadcast to all of them."""
    if guess is None:
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(chains))
        if problem.guess is not None:  # not compiled: problems with other guesses compare equal
            return jax.vmap(problem.draw)(keys)
        return _draw(problem, keys)
    K, nx, nu = problem.horizon, problem.dynamics.nx, problem.dynamics.nu
    if not isinstance(guess, Trajectory):
        raise DraxError(f"guess is {shown(guess)}: give a Trajectory(x, u), or see guesses.")
    knots = []
    for label, value, size in (("x", guess.x, nx), ("u", guess.u, nu)):
        try:
            with np.errstate(over="ignore"):  # what float32 cannot hold is refused as infinite
                array = np.asarray(numbers(value), problem.x_init.dtype)
        except (TypeError, ValueError) as error:
            raise DraxError(
                f"guess.{label} is {shown(value)}: give numbers of shape ({K}, {size})."
            ) from error
        short = problem.dynamics.given_nx if label == "x" else size
        if array.shape[-1:] == (short,):
            size = short
        if array.shape not in ((K, size), (chains, K, size)):
            raise DraxError(
                f"guess.{label} has shape {array.shape}: give ({K}, {size}), or "
                f"({chains}, {K}, {size}) with one for each chain"
                f"{', x_1 to x_K without x_init' if label == 'x' else ''}."
            )
        if not np.isfinite(array).all():
            raise DraxError(f"guess.{label} holds NaN or infinite values: give finite knots.")
        knots.append(jnp.asarray(np.broadcast_to(array, (chains, K, size))))
    start = _start(problem, guess.start, chains)
    return problem.started(Trajectory(knots[0], knots[1], start=start))


@partial(jax.jit, static_argnames=("chains", "guess"))
def knots_by_row(
    own: Problem, shared: Problem, keys: Array, chains: int, guess: Any
) -> tuple[Trajectory, Array]:
    """Initial knots of every chain of every problem, and their keys, in one axis of rows."""

    def of_problem(own: Problem, key: Array) -> tuple[Trajectory, Array]:
        problem = replace(joined(shared, own), guess=guess)
        knots = initial_knots(problem, chains, None, jax.random.fold_in(key, 0))
        return knots, chain_keys(jax.random.fold_in(key, 1), chains)

    both = jax.vmap(of_problem)(own, keys)
    rows: tuple[Trajectory, Array] = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), both)
    return rows


@jax.jit
def problem_keys(key: Array, indices: Array) -> Array:
    """The key of each problem, whatever is solved beside it."""
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, indices)


def _start(problem: Problem, given: Any, chains: int) -> Array | None:
    """`Trajectory.start` of a guess for every chain, (chains, n0); None if it has none."""
    n0 = len(problem.free)
    if given is None or not n0:  # as of the answer to a problem whose x_0 was free
        return None
    try:
        start = np.asarray(numbers(given), problem.x_init.dtype)
    except (TypeError, ValueError) as error:
        raise DraxError(
            f"guess.start is {shown(given)}: give numbers of shape ({n0},), or leave it out."
        ) from error
    if start.shape not in ((n0,), (chains, n0)) or not np.isfinite(start).all():
        raise DraxError(
            f"guess.start is {shown(given)}, of shape {start.shape}: give {n0} finite numbers, or "
            f"({chains}, {n0}), or leave it out."
        )
    return jnp.asarray(np.broadcast_to(start, (chains, n0)))


_draw = jax.jit(jax.vmap(Problem.draw, in_axes=(None, 0)))
