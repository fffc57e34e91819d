"""One chain for each of many initial states of a problem, all in one compiled program."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import jax
from jax import Array

from mjx_drax.method.descent import Info, diagnosed
from mjx_drax.method.langevin import Langevin, State
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory


def solve_each(
    solver: Langevin, problem: Problem, starts: Array, keys: Array
) -> tuple[Trajectory, Info, float, float]:
    """One chain from each x_init in `starts` (N, nx), with its own random key (N,).

    Returns:
        knots (N, K, ...) and diagnostics (N,) at the end; the time of compilation and of a first
        run, which loads and allocates [s]; that of a second run, with drawing initial knots [s].
    """
    total, tail = int(solver.iterations) + int(solver.tail), int(solver.tail) > 0
    clock = time.perf_counter()
    compiled = _solve_each.lower(solver, problem, starts, keys, total, tail).compile()
    jax.block_until_ready(compiled(solver, problem, starts, keys))
    compile_time = time.perf_counter() - clock
    clock = time.perf_counter()
    trajectory, info = jax.block_until_ready(compiled(solver, problem, starts, keys))
    return trajectory, info, compile_time, time.perf_counter() - clock


@partial(jax.jit, static_argnames=("total", "tail"))
def _solve_each(
    solver: Langevin, problem: Problem, starts: Array, keys: Array, total: int, tail: bool
) -> tuple[Trajectory, Info]:
    """Knots and diagnostics at the end.

    The number of iterations is static: a GPU then need not ask after each whether it was the last.
    """

    def one(x_init: Array, key: Array) -> tuple[Trajectory, Info]:
        own = replace(problem, x_init=x_init)
        key_knots, key_noise = jax.random.split(key)
        state = solver.init(own, own.draw(key_knots), jax.random.fold_in(key_noise, 0))

        def step(i: Array, state: State) -> State:
            return solver.step(own, state, i, tail)[0]

        knots = jax.lax.fori_loop(0, total, step, state).trajectory
        return knots, diagnosed(own, knots, own.values(knots))

    return jax.vmap(one)(starts, keys)
