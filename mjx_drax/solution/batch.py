"""Many problems at once: problems x chains is the batch axis of one compiled solve.

Each problem keeps its own scales, random numbers and attempts, so its answer does not depend on
which others are solved beside it; see `search.engine`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_drax.base.errors import require_whole
from mjx_drax.kernels.compilation import keep_programs, said_plainly
from mjx_drax.method.langevin import Langevin
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.checkpoint import Checkpoint
from mjx_drax.search.devices import mesh_for, sharing
from mjx_drax.search.engine import Found, Search
from mjx_drax.search.family import Family
from mjx_drax.search.fitting import narrowed
from mjx_drax.search.identity import look_again
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.restarts import Restarts, settled
from mjx_drax.solution.progress import reporting
from mjx_drax.solution.replay import (
    OPEN_LOOP,
    WITH_FEEDBACK,
    Replays,
    both_ways,
    followed,
    largest_defect,
    open_loop_is_better,
    plan_violations,
)
from mjx_drax.solution.report import counts, html
from mjx_drax.solution.results import statuses, tolerance_of
from mjx_drax.solution.violations import (
    Tolerances,
    Violation,
    as_tolerances,
    most_broken,
    warn_of_box,
)

SHARE = 0.5
"""Share of the memory that is free which a chunk may take."""

FEW = 10
"""So many problems that are not certified are printed by number."""

COPIES = 40
"""Numbers that a knot needs, as a multiple of (ndx + nu)^2: derivatives, factors, step sizes. XLA
plans with 7 to 8 for the cart-pole and the acrobot on a CPU; the rest is for what was not tried."""


@dataclass(frozen=True, repr=False)
class BatchSolution:
    """The best chain of every problem, certified.

    Attributes:
        family: the problems; `family.at(i)` is one of them.
        x: states x_0..x_K, (N, K + 1, nx).
        u: controls, (N, K, nu).
        gains: feedback (N, K, nu, ndx).
        chain_cost, chain_defect: cost and max|h| of all chains' plans, (N, chains).
        chain_residual: of the optimality conditions of all chains, NaN if not known, (N, chains).
        tolerance: below which a residual is that of an optimum.
        best: which chain is in x and u, (N,).
        died_at: iteration at which it turned non-finite and was frozen, else -1, (N,).
        interrupted: whether the solve was ended before its time.
        tolerances: of violations of replays.
        open_loop, feedback: replays of the best chains, over problems.
        compile_time, solve_time, replay_time: [s].

    `print(batch)` shows how many problems are certified and optimal, and what they cost.
    """

    family: Family
    x: np.ndarray
    u: np.ndarray
    gains: np.ndarray
    chain_cost: np.ndarray
    chain_defect: np.ndarray
    chain_residual: np.ndarray
    tolerance: float
    best: np.ndarray
    died_at: np.ndarray
    interrupted: bool
    tolerances: Tolerances
    open_loop: Replays
    feedback: Replays
    compile_time: float
    solve_time: float
    replay_time: float

    def __repr__(self) -> str:
        return f"<BatchSolution of {self.family.problem.name}: {self._verdict}>"

    def __str__(self) -> str:
        return "\n".join(self._report())

    def _repr_html_(self) -> str:
        return html(self._report(), bool(self.certified.all()))

    @property
    def _verdict(self) -> str:
        certified, optimal = (int(which.sum()) for which in (self.certified, self.optimal))
        return f"{certified} of {len(self.best)} problems CERTIFIED, {optimal} of them optimal"

    def _report(self) -> list[str]:
        cost, costs = self.cost[self.certified], "of certified replays: there are none"
        if cost.size:
            low, middle, high = np.quantile(cost, (0, 0.5, 1))
            costs = f"{low:.5g} to {high:.5g}, median {middle:.5g}, of certified replays"
        said = [
            f"problems       {len(self.best)} of {self.chain_cost.shape[1]} chains each: "
            f"{counts(self.status)}",
            f"cost           {costs}",
            f"engine         {self.family.problem.dynamics.engine}",
            f"time           compile {self.compile_time:.1f} s, solve {self.solve_time:.1f} s, "
            f"replay {self.replay_time:.1f} s",
        ]
        missed = np.flatnonzero(~self.certified)
        if missed.size:
            more = ", ..." if missed.size > FEW else ""
            numbers = ", ".join(map(str, missed[:FEW].tolist()))
            said.append(f"not certified  problems {numbers}{more}; where(i) says what i breaks")
        return [*said, self._verdict]

    @property
    def cost(self) -> np.ndarray:
        """Of the better replays of the best chains, infinite for what was not solved, (N,)."""
        cost = np.where(self.open_loop_is_better, self.open_loop.cost, self.feedback.cost)
        return np.where(np.isfinite(self.plan_cost), cost, np.inf)

    @property
    def plan_cost(self) -> np.ndarray:
        """Of the best chains' plans, (N,)."""
        return self._of_best(self.chain_cost)

    @property
    def max_defect(self) -> np.ndarray:
        """max|h| of the best chains, (N,)."""
        return self._of_best(self.chain_defect)

    @property
    def residual(self) -> np.ndarray:
        """Of the best chains, (N,)."""
        return self._of_best(self.chain_residual)

    def _of_best(self, values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, self.best[:, None], 1)[:, 0]

    @property
    def feasible(self) -> np.ndarray:
        """Whether max|h| < `FEASIBLE`, and the cost is finite, (N,)."""
        return (self.max_defect < FEASIBLE) & np.isfinite(self.plan_cost)

    @property
    def certified(self) -> np.ndarray:
        """Whether the plan is feasible and one of its replays succeeds, (N,)."""
        return self.feasible & (self.open_loop.success | self.feedback.success)

    @property
    def optimal(self) -> np.ndarray:
        """Whether the plan is certified and followed, its residual below the tolerance, (N,)."""
        replays = self.open_loop, self.feedback
        as_planned = followed(self.family.at(0), self.x, self.plan_cost, *replays)
        return self.certified & as_planned & (self.residual < self.tolerance)

    @property
    def status(self) -> list[str]:
        """`optimal`, `feasible`, `infeasible`, `diverged` or `interrupted`, of every problem."""
        begun = (self.died_at > 0) | (not self.interrupted)  # rows that were never filled hold 0
        return statuses(self.feasible, self.optimal, (self.died_at >= 0) & begun, self.interrupted)

    def where(self, i: int) -> Violation | None:
        """What keeps problem i from being certified; None if it is.

        Of a plan that is not feasible see `Solution.where`; of a feasible one, what its better
        replay breaks most.
        """
        if self.feasible[i]:
            better = self.open_loop if self.open_loop_is_better[i] else self.feedback
            return better.violations.worst(i)
        problem, plan, u = self.family.at(i), self.x[i].astype(float), self.u[i]
        found = plan_violations(Family.of_one(problem), plan[None], u[None]).of(0)
        return most_broken(problem, found, largest_defect(problem, plan, u))

    @property
    def open_loop_is_better(self) -> np.ndarray:
        """Which replay speaks for each plan: the one that succeeds, then the cheaper; (N,)."""
        return open_loop_is_better(self.open_loop, self.feedback)

    @property
    def replay_modes(self) -> list[str]:
        """How each is to be replayed: as succeeds, then as is cheaper."""
        return [OPEN_LOOP if better else WITH_FEEDBACK for better in self.open_loop_is_better]


def solve_batch(
    make: Callable[[Any], Problem],
    values: Any,
    chains: int = 16,
    seed: int = 0,
    solver: Langevin | Restarts | None = None,
    chunk: int | None = None,
    progress: Callable[[int, int], None] | bool | None = None,
    devices: int = 1,
    checkpoint: str | os.PathLike[str] | None = None,
    tolerances: Tolerances | None = None,
    tolerance: float | None = None,
    max_iterations: int | None = None,
    precision: int | None = None,
) -> BatchSolution:
    """Solve the problems make(value), for thousands of values.

        solve_batch(problem.with_x_init, states)

    Args:
        make: gives a problem for one value; it is traced, so it may change any number of a problem
            (initial state, bounds, bound arguments of a cost or of a function's dynamics).
        values: arrays, or a pytree of them, with one entry for each problem along the first axis.
        chains: for each problem.
        seed: of all random numbers; problem i gets the same ones whatever is solved beside it.
        solver: `Restarts()` by default; a metric without gains has no feedback here.
        chunk: problems that are solved at a time; None: as many as half of the free memory holds.
            With 2,048 chains in it and more, the last ones that move go on in a smaller program,
            which compiles beside the large one.
        progress: as in `solve`; a function is called with (problems done, of how many) after every
            chunk.
        devices: how many of this process to spread a chunk over, evenly; see `solve`.
        checkpoint: a file to write every half minute, after a chunk, and to go on from where it is
            there, as in `solve`.
        tolerances: by how much replays may break bounds and constraints; see `Tolerances`.
        tolerance, max_iterations, precision: as in `solve`.

    Raises:
        DraxError: as `solve`; values without a common first axis; a problem with NaN, crossed
            bounds or an x_init outside of them, by its number; a model that varies, which the C
            engine would not replay.

    Warns:
        DraxWarning: bounds are far wider than all motions, so "optimal" and "certified" say little.
    """
    if chunk is not None:
        require_whole("chunk", chunk)
    require_whole("chains", chains)
    report = reporting(progress, "problems")
    keep_programs()
    family = Family.of(make, values)
    look_again(family.at(0))
    family = replace(family, problem=family.problem.in_precision(precision))
    with family.problem.arithmetic():
        tolerances = as_tolerances(tolerances)
        tolerances.of(family.at(0))  # refuses those of another size
        settings = settled(family.at(0), chains, seed, solver, tolerance, max_iterations)
        file = None if checkpoint is None else Checkpoint(checkpoint)
        shares = sharing(devices)
        fits = fitting(family.at(0), chains, shares)
        size = chunk or (file and file.answered("chunk")) or fits
        size = -(-min(size, family.count) // shares) * shares
        search = Search(
            family,
            chains,
            seed,
            settings,
            size=size,
            mesh=mesh_for(size, devices),
            checkpoint=file,
        )
        with report as search.chunk_done, said_plainly("the solve of problems"):
            found = search.run()
        return _certified(search.family, settings, chains, found, tolerances)


def _certified(
    family: Family,
    settings: Restarts,
    chains: int,
    found: Found,
    tolerances: Tolerances,
) -> BatchSolution:
    """The best chain of every problem, replayed."""
    clock = time.perf_counter()
    info, shape = found.chains.info, (family.count, chains)
    cost, defect = (np.reshape(a, shape) for a in (info.cost, info.max_defect))
    best = found.chains.order(family.count)[:, 0]
    state, rows = found.chains.state, np.arange(family.count) * chains + best
    x, u, gains = (
        np.asarray(a)[rows] for a in (state.trajectory.x, state.trajectory.u, state.gains)
    )
    chosen: Trajectory = jax.tree.map(lambda a: np.asarray(a)[rows], state.trajectory)
    plan = np.concatenate([family.starts(np.arange(family.count), chosen)[:, None], x], axis=1)
    open_loop, feedback, gains = both_ways(family, plan, u, gains, tolerances)
    one = family.at(0)
    moves = (plan - plan[:, :1]).reshape(-1, plan.shape[2])  # the first is 0
    wide = narrowed(one, one, moves, u.reshape(-1, u.shape[2]))
    if wide is not None:
        warn_of_box(one, wide[1])
    return BatchSolution(
        family=family,
        x=plan,
        u=u,
        gains=gains,
        chain_cost=cost,
        chain_defect=defect,
        chain_residual=np.reshape(info.residual, shape),
        tolerance=tolerance_of(settings),
        best=best,
        died_at=np.asarray(state.died_at)[rows],
        interrupted=found.interrupted,
        tolerances=tolerances,
        open_loop=open_loop,
        feedback=feedback,
        compile_time=found.compile_time,
        solve_time=found.solve_time,
        replay_time=time.perf_counter() - clock,
    )


def free_memory() -> int:
    """Bytes that this process may still take of the host's memory.

    Linux says how much programs could get, and what a container may use in all. Elsewhere half of
    the memory counts as free.
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvail"))
    except (OSError, StopIteration):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    with suppress(OSError, ValueError):  # there is no container, or it says "max"
        free = min(free, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return free


def fitting(problem: Problem, chains: int, devices: int = 1) -> int:
    """How many problems may be solved at a time, for the memory that is free now.

    GPUs have memory of their own each; devices of a CPU share it.
    """
    device = jax.local_devices()[0]
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        free = devices * (stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    else:
        free = free_memory()
    width = problem.dynamics.ndx + problem.dynamics.nu
    each = COPIES * chains * problem.horizon * width**2 * problem.x_init.dtype.itemsize
    return max(1, int(SHARE * free // each))
