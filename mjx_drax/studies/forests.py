"""Ways through random forests, from a line that leads through their trees.

    python -m mjx_drax.studies.forests [FIRST] [END] [--chains N]

Ten discs, less those that cover the start (0, 0) or the end (4, 4); their middles are drawn from
U(0.6, 3.4)^2, their radii from U(0.15, 0.5) [m]. In forests of even numbers a point mass comes to
rest at the end, x'' = u, with |u| <= 2 m/s^2 in 5 s; in those of odd numbers a unicycle drives
there, with at most 1.5 m/s and 1.5 rad/s in 8 s. The cost is the integral of |u|^2.

A row for each forest: IPOPT and the polish alone, both from the straight line, in float64, to a
tolerance of 1e-8 in at most 500 iterations; and N chains of `solve`, with default settings.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.problem.build import from_function
from mjx_drax.problem.problem import Problem
from mjx_drax.solution.solve import solve
from mjx_drax.studies.convergence.optimal_control import straight
from mjx_drax.studies.convergence.suite import ours
from mjx_drax.studies.other_methods import ipopt_jax
from mjx_drax.studies.other_methods.ipopt import has_casadi

END = 4.0
"""Both coordinates of the end [m]."""

HEADER = (
    "| forest | IPOPT iterations | its cost | its status | polish | its cost | its status "
    "| chains that are optimal | best cost | median |\n" + "|---" * 10 + "|"
)


def forest(number: int) -> tuple[Problem, list[float]]:
    """The problem of a forest, and the state that the straight line ends at."""
    random = np.random.default_rng(100 + number)
    middles, radii = random.uniform(0.6, 3.4, (10, 2)), random.uniform(0.15, 0.5, 10)
    free = [np.linalg.norm(middles - end, axis=1) > radii + 0.15 for end in (0.0, END)]
    kept = free[0] & free[1]
    middles, radii = middles[kept], radii[kept]
    dt, name = 0.1, f"forest_{number}"

    def inside(x: Array, u: Array) -> Array:
        return jnp.square(radii) - jnp.sum((x[:2] - middles) ** 2, axis=1)

    def effort(x: Array, u: Array) -> Array:
        return jnp.sqrt(2 * dt) * u

    def mass(x: Array, u: Array) -> Array:
        return x + dt * jnp.concatenate([x[2:] + 0.5 * dt * u, u])

    def unicycle(x: Array, u: Array) -> Array:
        return x + dt * jnp.array([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])

    step, nx, fixed, horizon, most = (
        (unicycle, 3, 2, 8.0, 1.5) if number % 2 else (mass, 4, 4, 5.0, 2.0)
    )
    end = [END, END, 0.0, 0.0][:nx]
    problem = from_function(
        step,
        x_init=[0.0] * nx,
        nu=2,
        dt=dt,
        horizon=horizon,
        running_residual=effort,
        inequality=inside,
        terminal_equality=lambda x: (x - jnp.array(end))[:fixed],
        u_bounds=(-most, most),
        name=name,
    )
    return problem, end


def row(number: int, chains: int) -> tuple[str, dict[str, bool]]:
    """The row of a forest, in Markdown, and which of the three ways found an optimum."""
    cells, found = [f"{number}"], {}
    with jax.enable_x64(True):
        problem, end = forest(number)
        guess = straight(problem, end)
        if has_casadi():
            answer = ipopt_jax.solve(problem, guess)
            cells += [f"{answer.iterations}", f"{answer.cost:.6g}", answer.status]
            found["IPOPT"] = answer.solved
        else:
            cells += ["-"] * 3
        iterations, _, cost, status = ours(problem, guess)
        cells += [f"{iterations}", f"{cost:.6g}", status]
        found["polish"] = status == "optimal"
    solution = solve(forest(number)[0], chains=chains, progress=False)
    costs = solution.replay_cost[solution.success]
    best, median = (costs.min(), np.median(costs)) if len(costs) else (np.inf, np.inf)
    cells += [f"{solution.optimal_chains.mean():.0%}", f"{best:.6g}", f"{median:.6g}"]
    found["solve"] = bool(solution.optimal)
    return f"| {' | '.join(cells)} |", found


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and how many forests each way solved."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("end", type=int, nargs="?", default=24)
    parser.add_argument("--chains", type=int, default=16, metavar="N")
    options = parser.parse_args(arguments)
    print(HEADER, flush=True)
    solved: dict[str, int] = {}
    for number in range(options.first, options.end):
        text, found = row(number, options.chains)
        print(text, flush=True)
        for way, good in found.items():
            solved[way] = solved.get(way, 0) + good
        jax.clear_caches()
    count = options.end - options.first
    print("\n" + ", ".join(f"{way}: {good} of {count}" for way, good in solved.items()))


if __name__ == "__main__":
    main()
