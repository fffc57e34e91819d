"""Pendulums from random states, beside what dynamic programming says is possible.

    python -m mjx_drax.studies.random_states [--states N] [--chains M ...] [--seeds S]
                                             [--attempts A]

N initial states of the task `pendulum`, angle and velocity from U(-4, 4), in one `solve_batch`. Not
every state can be brought upright within the horizon. Dynamic programming finds which can: with
V_K = phi on a grid of angles and velocities, backwards in k,

    V_k(x) = min_u  l(x, u) + V_{k+1}(f(x, u)),    u on a grid, V_{k+1} interpolated linearly.

Interpolation lets V be a little too high; whether a state can be upright is judged by following the
controls that attain the minimum.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.ndimage import map_coordinates

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError, require_whole
from mjx_drax.problem.problem import Problem
from mjx_drax.search.restarts import Restarts
from mjx_drax.solution.batch import BatchSolution, solve_batch
from mjx_drax.solution.progress import reporting

ANGLES, VELOCITIES, CONTROLS = (60.0, 6001), (14.0, 1401), 41
"""Reach and number of the grid's points: some states can but turn over and over."""

HEADER = (
    "| chains | attempts | seed | feasible | residual below the tolerance | upright "
    "| of those that can | within 1.2 times dynamic programming | solve [s] | compile [s] |\n"
    + "|---" * 10
    + "|"
)


def values(
    problem: Problem, x: np.ndarray, grid_size: tuple[int, int] = (ANGLES[1], VELOCITIES[1])
) -> tuple[np.ndarray, np.ndarray]:
    """The value of states (N, 2) by dynamic programming, and whether they end upright, (N,).

    A smaller grid reaches less far in angle, with the same distance between angles.
    """
    reach = ANGLES[0] * (grid_size[0] - 1) / (ANGLES[1] - 1)
    reaches = zip((reach, VELOCITIES[0]), grid_size, strict=True)
    ends = [np.linspace(-end, end, count) for end, count in reaches]
    grid = jnp.asarray(np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 2))
    box = problem.bounds
    controls = jnp.linspace(box.u_lower[0], box.u_upper[0], CONTROLS)
    shape = tuple(len(end) for end in ends)

    def interpolated(V: Array, x: Array) -> Array:
        places = [(x[:, i] - end[0]) / (end[1] - end[0]) for i, end in enumerate(ends)]
        found: Array = map_coordinates(V.reshape(shape), places, order=1, mode="nearest")
        return found

    def after(V: Array, x: Array, u: Array) -> tuple[Array, Array]:
        given = x, jnp.full((len(x), 1), u)
        moved = jax.vmap(problem.dynamics.step)(*given)
        return jax.vmap(problem.running_cost)(*given) + interpolated(V, moved), moved

    @jax.jit
    def backwards(V: Array) -> Array:
        return jax.lax.map(lambda u: after(V, grid, u)[0], controls).min(axis=0)

    @jax.jit
    def forwards(V: Array, x: Array) -> Array:
        costs, moved = jax.lax.map(lambda u: after(V, x, u), controls)
        return moved[jnp.argmin(costs, axis=0), jnp.arange(len(x))]

    V = [jax.vmap(problem.terminal_cost)(grid)]
    with reporting(None, "dynamic programming, knots") as report:
        for k in range(problem.horizon):
            V.append(jax.block_until_ready(backwards(V[-1])))
            if report is not None:
                report(k + 1, problem.horizon)
    found, state = interpolated(V[-1], jnp.asarray(x)), jnp.asarray(x)
    for k in range(problem.horizon):
        state = forwards(V[problem.horizon - 1 - k], state)
    upright = [bool(problem.reached(end, 0.0)) for end in np.asarray(state)]
    return np.asarray(found), np.array(upright)


def line(
    found: BatchSolution,
    chains: int,
    attempts: int,
    seed: int,
    best: np.ndarray,
    can: np.ndarray,
) -> str:
    """The row of a solve, in Markdown."""
    upright = found.open_loop.success | found.feedback.success
    close = found.cost <= 1.2 * best + 1e-3
    residual = found.chain_residual.min(axis=1) < found.tolerance
    return (
        f"| {chains} | {attempts} | {seed} | {found.feasible.mean():.2%} | {residual.mean():.2%} "
        f"| {upright.mean():.1%} | {(upright & can).sum() / can.sum():.1%} | {close.mean():.1%} "
        f"| {found.solve_time:.2f} | {found.compile_time:.0f} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Solve and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--states", type=int, default=16_384, metavar="N")
    parser.add_argument("--chains", type=int, nargs="+", default=[1, 2, 4], metavar="M")
    parser.add_argument("--seeds", type=int, default=2, metavar="S")
    parser.add_argument("--attempts", type=int, default=5, metavar="A", help="at most; default 5")
    options = parser.parse_args(arguments)
    try:
        for name in ("states", "seeds", "attempts"):
            require_whole(f"--{name}", getattr(options, name))
        for chains in options.chains:
            require_whole("--chains", chains)
    except DraxError as error:
        parser.error(str(error))
    problem = tasks.load("pendulum").make()
    x = np.random.default_rng(0).uniform(-4, 4, (options.states, 2)).astype(np.float32)
    grid = f"{ANGLES[1]} x {VELOCITIES[1]} states"
    print(f"dynamic programming on {grid}, then {options.states} solves a row", file=sys.stderr)
    best, can = values(problem, x)
    print(
        f"{jax.devices()[0].device_kind}: {can.mean():.1%} of the states can be upright\n{HEADER}"
    )
    for chains in options.chains:
        for seed in range(options.seeds):
            found = solve_batch(
                lambda x: replace(problem, x_init=x),
                x,
                chains,
                seed,
                solver=Restarts(attempts=options.attempts),
            )
            print(line(found, chains, options.attempts, seed, best, can), flush=True)


if __name__ == "__main__":
    main()
