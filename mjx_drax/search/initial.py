"""Where chains start: knots that are drawn, or a guess."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory


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
