"""Many problems at once: problems x chains is the batch axis of one compiled solve.

`solve_batch` runs `Restarts` on every problem of a family, all in step. Each problem keeps its own
units, random numbers and attempts, so its answer does not depend on which others are solved beside
it. Problems that are done leave the batch; the rest is packed into chunks of one size, which one
compilation serves and which fit into memory.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh
from jax.typing import ArrayLike

from mjx_drax.base.errors import DraxError, reason, require_whole, shown
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.kernels.compilation import compiled
from mjx_drax.method.langevin import (
    FEASIBLE,
    Info,
    Langevin,
    Scale,
    advance,
    evaluate,
    ranking,
    worth,
)
from mjx_drax.problem.checks import plain, require_functions
from mjx_drax.problem.problem import Problem, Trajectory, checked
from mjx_drax.search.checkpoint import Checkpoint, digest, facts
from mjx_drax.search.devices import gathered, mesh_for, spread
from mjx_drax.search.restarts import (
    MORE,
    Restarts,
    as_restarts,
    finished,
    initial_knots,
    level,
    unit_of,
)
from mjx_drax.solution.solution import OPEN_LOOP, WITH_FEEDBACK, Replays, judged

SHARE = 0.5
"""Share of the memory that is free which a chunk may take."""

COPIES = 40
"""Numbers that a knot needs, as a multiple of (ndx + nu)^2: derivatives, factors, step sizes. XLA
plans with 7 to 8 for the cart-pole and the acrobot on a CPU; the rest is for what was not tried."""


@register_dataclass
@dataclass(frozen=True)
class Family:
    """Problems that differ in some of their numbers.

    Attributes:
        problem: all of them; leaves that differ have a leading axis (N, ...).
        differs: which leaves, in the order of `jax.tree.leaves`.
        count: N.
    """

    problem: Problem
    differs: tuple[bool, ...] = field(metadata=Static)
    count: int = field(metadata=Static)

    @classmethod
    def of(cls, make: Callable[[Any], Problem], values: Any) -> Family:
        """The problems make(value) for values stacked along the first axis of every leaf.

        Raises:
            DraxError: leaves of `values` without a common first axis, or a misfit in the first
                problem.
        """
        if not callable(make):
            raise DraxError(f"make is {shown(make)}: give a function of a value, to a Problem.")
        try:
            values = jax.tree.map(jnp.asarray, values)
        except (TypeError, ValueError) as error:
            raise DraxError(
                f"values are {shown(values)}: give arrays of numbers, one entry for each problem."
            ) from error
        counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(values)}
        if len(counts) != 1 or not min(counts) or min(counts)[0] < 1:
            raise DraxError(
                f"values have first axes {sorted(counts)}: stack one entry for each problem along "
                "the first axis of every array."
            )
        count = min(counts)[0]

        def nth(i: int) -> Problem:
            try:
                return make(jax.tree.map(lambda leaf: leaf[i], values))
            except DraxError:
                raise
            except Exception as error:
                raise DraxError(
                    f"make failed for value {i}: {reason(error)}. Make it a function of one value "
                    "that returns a Problem."
                ) from error

        first, last = checked(nth(0)), nth(count - 1)
        leaves, others = jax.tree.leaves(first), jax.tree.leaves(last)
        if len(leaves) != len(others):
            raise DraxError("make gives problems of different structure: vary numbers only.")
        differs = tuple(a is not b for a, b in zip(leaves, others, strict=True))
        if not any(differs):
            raise DraxError(
                "make gives the same problem for every value: let it change some number."
            )
        tree: list[Any] = []

        @jax.jit
        @jax.vmap
        def differing(value: Any) -> list[Array]:
            try:
                found, structure = jax.tree.flatten(make(value))
            except Exception as error:  # numbers were no trouble, above
                ours = isinstance(error, DraxError)
                words = "what it builds takes numbers, not traced values" if ours else plain(error)
                raise DraxError(
                    f"make failed when it was traced: {words}. Make it a JAX function, "
                    "such as lambda x: dataclasses.replace(problem, x_init=x)."
                ) from error
            tree.append(structure)
            return [jnp.asarray(a) for a, d in zip(found, differs, strict=True) if d]

        stacked = iter(differing(values))
        merged = [next(stacked) if d else a for a, d in zip(leaves, differs, strict=True)]
        family = cls(jax.tree.unflatten(tree[0], merged), differs, count)
        if family.varies("dynamics") and hasattr(first.dynamics, "mj_model"):
            raise DraxError(
                f"make changes the dynamics of {first.name}, and the C engine would "
                "replay another: solve for each model by itself."
            )
        family._check()
        return family

    def _check(self) -> None:
        """Complain about numbers of single problems that no solve could use."""
        leaves = zip(jax.tree.leaves(self.problem), self.differs, strict=True)
        numbers = [np.asarray(leaf) for leaf, differs in leaves if differs]
        nan = np.any([np.isnan(n).reshape(self.count, -1).any(1) for n in numbers], axis=0)
        faults = np.asarray(self.over(_faults)(self.problem))
        for wrong, words in (
            (nan, "holds NaN: give numbers"),
            (faults[:, 0], "starts at infinity: give a finite x_init"),
            (faults[:, 1], "has bounds that cross: give lower <= upper"),
            (faults[:, 2], "starts outside the bounds of x: move its x_init, or widen the bounds"),
        ):
            if wrong.any():
                raise DraxError(
                    f"problem {int(np.argmax(wrong))} of {self.count} ({int(wrong.sum())} such) "
                    f"{words}."
                )

    def _changed(self, change: Callable[[Any], Any]) -> Problem:
        """The problem with another value for each leaf that differs."""
        leaves, tree = jax.tree.flatten(self.problem)
        new = [change(a) if d else a for a, d in zip(leaves, self.differs, strict=True)]
        return jax.tree.unflatten(tree, new)

    def each(self, differs: Any, shared: Any) -> Any:
        """A problem that holds one of two things, according to whether a leaf differs."""
        tree = jax.tree.structure(self.problem)
        return jax.tree.unflatten(tree, [differs if d else shared for d in self.differs])

    def varies(self, *names: str) -> bool:
        """Whether any number in those attributes of the problem differs."""
        differs = self.each(True, False)
        return any(any(jax.tree.leaves(getattr(differs, name))) for name in names)

    def at(self, i: int) -> Problem:
        """One of the problems."""
        return self._changed(lambda leaf: leaf[i])

    def some(self, indices: np.ndarray) -> Family:
        """Those problems, in that order."""
        return replace(self, problem=self._changed(lambda leaf: leaf[indices]), count=len(indices))

    def over(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """function(problem, ...) over all problems, and over the first axis of what follows."""
        axes = self.each(0, None)

        def mapped(problem: Problem, *arguments: Any) -> Any:
            return jax.vmap(function, in_axes=(axes, *[0] * len(arguments)))(problem, *arguments)

        return mapped


def _faults(problem: Problem) -> Array:
    """Whether x_init is not finite, bounds cross, and x_init is outside of them, (3,)."""
    box, x = problem.bounds, problem.x_init

    def above(lower: Array, upper: Array) -> Array:
        return (lower - upper > 1e-6).any()

    crossed = above(box.x_lower, box.x_upper) | above(box.u_lower, box.u_upper)
    outside = above(box.x_lower, x) | above(x, box.x_upper)
    alike = box.x_lower.ndim == box.x_upper.ndim == 1  # bounds of single knots do not hold for x_0
    return jnp.stack([~jnp.isfinite(x).all(), crossed, outside & alike])


@dataclass(frozen=True)
class BatchSolution:
    """The best chain of every problem, certified.

    Attributes:
        family: the problems; `family.at(i)` is one of them.
        x: states x_0..x_K, (N, K + 1, nx).
        u: controls, (N, K, nu).
        gains: feedback (N, K, nu, ndx).
        chain_cost, chain_defect: cost and max|h| of all chains, (N, chains).
        best: which chain is in x and u, (N,).
        open_loop, feedback: replays of the best chains, over problems.
        compile_time, solve_time, replay_time: [s].
    """

    family: Family
    x: np.ndarray
    u: np.ndarray
    gains: np.ndarray
    chain_cost: np.ndarray
    chain_defect: np.ndarray
    best: np.ndarray
    open_loop: Replays
    feedback: Replays
    compile_time: float
    solve_time: float
    replay_time: float

    @property
    def cost(self) -> np.ndarray:
        """Of the best chains, (N,)."""
        return np.take_along_axis(self.chain_cost, self.best[:, None], 1)[:, 0]

    @property
    def max_defect(self) -> np.ndarray:
        """max|h| of the best chains, (N,)."""
        return np.take_along_axis(self.chain_defect, self.best[:, None], 1)[:, 0]

    @property
    def feasible(self) -> np.ndarray:
        """Whether max|h| < `FEASIBLE`, (N,)."""
        return self.max_defect < FEASIBLE

    @property
    def certified(self) -> np.ndarray:
        """Whether the plan is feasible and one of its replays succeeds, (N,)."""
        return self.feasible & (self.open_loop.success | self.feedback.success)

    @property
    def replay_modes(self) -> list[str]:
        """How each is to be replayed: open loop where that succeeds."""
        return [OPEN_LOOP if ok else WITH_FEEDBACK for ok in self.open_loop.success]


def solve_batch(
    make: Callable[[Any], Problem],
    values: Any,
    chains: int = 16,
    seed: int = 0,
    solver: Langevin | Restarts | None = None,
    chunk: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    devices: int = 1,
    checkpoint: str | os.PathLike[str] | None = None,
) -> BatchSolution:
    """Solve the problems make(value), for thousands of values.

        solve_batch(lambda x: dataclasses.replace(problem, x_init=x), states)

    Args:
        make: gives a problem for one value; it is traced, so it may change any number of a problem
            (initial state, bounds, bound arguments of a cost or of a function's dynamics).
        values: arrays, or a pytree of them, with one entry for each problem along the first axis.
        chains: for each problem.
        seed: of all random numbers; problem i gets the same ones whatever is solved beside it.
        solver: `Restarts()` by default.
        chunk: problems that are solved at a time; None: as many as half of the free memory holds.
        progress: called with (problems done, of how many) after every chunk.
        devices: how many of this process to spread a chunk over, evenly; see `solve`.
        checkpoint: a file to write every half minute, after a chunk, and to go on from where it is
            there, as in `solve`.

    Where f has kinks (contacts), chains are not led on along replays as `solve` does.

    Raises:
        DraxError: as `solve`; values without a common first axis; a problem with NaN, crossed
            bounds or an x_init outside of them, by its number; a model that varies, which the C
            engine would not replay.
    """
    if chunk is not None:
        require_whole("chunk", chunk)
    require_whole("chains", chains)
    require_functions(progress=progress)
    family = Family.of(make, values)
    first = family.at(0)
    solver = as_restarts(first, chains, seed, Restarts() if solver is None else solver)
    file = None if checkpoint is None else Checkpoint(checkpoint)
    size = chunk or (file and file.answered("chunk")) or fitting(first, chains)
    size = -(-min(size, family.count) // jax.process_count()) * jax.process_count()
    search = _Search(family, chains, seed, solver, size, mesh_for(size, devices))
    search.run(progress, file)
    return search.solution()


def fitting(problem: Problem, chains: int) -> int:
    """How many problems may be solved at a time, for the memory that is free now."""
    device = jax.local_devices()[0]
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        free = stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    else:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    width = problem.dynamics.ndx + problem.dynamics.nu
    each = COPIES * chains * problem.horizon * width**2 * problem.x_init.dtype.itemsize
    return max(1, int(SHARE * free // each))


STATE = ("attempt", "start", "todo", "unit", "x", "u", "gains", "cost", "defect", "solve_time")
"""Attributes of a search that change while it runs."""


class _Search:
    """The attempts of a batch; what is kept of every chain is on the host."""

    def __init__(
        self,
        family: Family,
        chains: int,
        seed: int,
        solver: Restarts,
        size: int,
        mesh: Mesh | None,
    ) -> None:
        self.family, self.chains, self.seed = family, chains, seed
        self.solver, self.size, self.mesh = solver, size, mesh
        self.compile_time = self.solve_time = 0.0
        problem, shape = family.problem, (family.count, chains)
        K, dynamics = problem.horizon, problem.dynamics
        dtype = problem.x_init.dtype
        self.x = np.zeros((*shape, K, dynamics.nx), dtype)
        self.u = np.zeros((*shape, K, dynamics.nu), dtype)
        self.gains = np.zeros((*shape, K, dynamics.nu, dynamics.ndx), dtype)
        self.cost, self.defect = np.full(shape, np.inf), np.full(shape, np.inf)
        self.unit = np.ones(family.count)
        self.attempt, self.start, self.todo = 0, 0, np.arange(family.count)

    def finished(self, indices: np.ndarray) -> np.ndarray:
        """Which chains of those problems are done, (len(indices), chains)."""
        feasible = self.defect[indices] < FEASIBLE
        return finished(self.cost[indices], feasible, self.solver.within, self.unit[indices])

    def run(
        self, progress: Callable[[int, int], None] | None, checkpoint: Checkpoint | None
    ) -> None:
        """All attempts; Ctrl-C keeps what there is."""
        if checkpoint is not None:
            self._resume(checkpoint)
        clock, everyone = time.perf_counter() - self.solve_time, np.arange(self.family.count)
        try:
            while self.attempt < self.solver.attempts:
                while self.start < len(self.todo):
                    part = self.todo[self.start : self.start + self.size]
                    self._chunk(np.resize(part, self.size), len(part))
                    self.start += len(part)
                    self.solve_time = time.perf_counter() - clock - self.compile_time
                    if checkpoint is not None:
                        checkpoint.save(self._saved)
                    if progress is not None:
                        progress(len(everyone) - len(self.todo) + self.start, len(everyone))
                self.todo = everyone[self.finished(everyone).mean(axis=1) < self.solver.enough]
                self.unit[(self.defect >= FEASIBLE).all(axis=1)] *= MORE
                self.attempt, self.start = self.attempt + 1, 0
        except KeyboardInterrupt:  # maybe while something was kept: no checkpoint of that
            if not (self.attempt or self.start):
                raise
        else:
            if checkpoint is not None and self.compile_time:
                checkpoint.save(self._saved, now=True)

    def _resume(self, checkpoint: Checkpoint) -> None:
        """Go on from the checkpoint, if there is one; complain if it is of another question."""
        family = self.family
        known = facts(family.problem, self.chains, self.seed, self.solver)
        sizes = {"problems": family.count, "chunk": self.size}
        checkpoint.require({"call": "solve_batch", **sizes, **known})
        checkpoint.require_room(sum(np.asarray(part).nbytes for part in self._saved().values()))
        flow, some, scales, knots, keys = self._begun(np.arange(self.size))
        tail = int(flow.tail) > 0
        program = _flowed.lower(flow, some, scales, knots, keys, 0, tail)
        functions = digest(program.as_text())
        checkpoint.require({"initial knots": digest(knots), "functions": functions})
        if checkpoint.found is not None:
            for name, value in checkpoint.restored(self._saved()).items():
                setattr(self, name, value)

    def _saved(self) -> dict[str, Any]:
        """What a checkpoint holds: all that the rest of the search depends on."""
        return {name: getattr(self, name) for name in STATE}

    def _chunk(self, indices: np.ndarray, count: int) -> None:
        """One attempt on some problems; those after the first `count` fill up the chunk."""
        clock = time.perf_counter()
        flow, some, *rows = self._begun(indices)
        total, tail = int(flow.iterations + flow.tail), int(flow.tail) > 0

        def share(
            rows: Any, flow: Langevin, some: Family, iterations: int
        ) -> tuple[Trajectory, Array, Info]:
            where, *rest = rows
            return _flowed(flow, some.some(where), *rest, iterations, tail)

        launch = spread(share, self.mesh, flow, some)

        def flowed(iterations: int, compiles: bool = False) -> tuple[Trajectory, Array, Info]:
            found = launch((np.arange(self.size), *rows), iterations, compiles=compiles)
            return gathered(found, self.mesh)

        if not self.compile_time:
            jax.block_until_ready(flowed(0, compiles=True))
            self.compile_time = time.perf_counter() - clock
        found = flowed(total)
        self._keep(indices[:count], *jax.tree.map(lambda a: np.asarray(a)[:count], found))

    def _begun(self, indices: np.ndarray) -> tuple[Langevin, Family, Scale, Trajectory, Array]:
        """Settings, problems, units, initial knots and keys of an attempt on some problems."""
        solver, some = self.solver, self.family.some(indices)
        key = jax.random.fold_in(jax.random.key(self.seed), self.attempt)
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.asarray(indices))
        knots = some.over(partial(_drawn, self.chains))(some.problem, keys)
        if solver.descent is None:
            flow, scale = solver.flow, solver.flow.scale
            cost, noise = (np.broadcast_to(s, len(indices)) for s in (scale.cost, scale.noise))
        elif self.attempt == 0:
            flow = solver.first(1.0)
            costs = np.asarray(_worth(some, knots)[0])
            self.unit[indices] = [unit_of(row) for row in costs]
            cost, noise = self.unit[indices], np.zeros(len(indices))
        else:
            flow = replace(solver.flow, scale=solver.first(1.0).scale)  # of that type: no compiling
            cost = self.unit[indices]
            feasible = self.defect[indices] < FEASIBLE
            rows = zip(self.cost[indices], feasible, cost, strict=True)
            noise = np.sqrt([level(*row) for row in rows])
        scales = Scale(jnp.asarray(cost, knots.x.dtype), jnp.asarray(noise, knots.x.dtype))
        return flow, some, scales, knots, keys

    def _keep(self, indices: np.ndarray, knots: Trajectory, gains: np.ndarray, info: Info) -> None:
        """Every chain takes the best of what it has and of what was found for it.

        Chains that are done leave their places in the batch to those that are not, as in
        `restarts`: each place works for one chain that was not done.
        """
        done = self.finished(indices)
        owners = np.stack(
            [np.resize(np.flatnonzero(~row) if not row.all() else [0], len(row)) for row in done]
        )
        found_cost, found_defect = (
            np.nan_to_num(a, nan=np.inf) for a in (info.cost, info.max_defect)
        )
        for place, chain in enumerate(owners.T):
            cost, defect = found_cost[:, place], found_defect[:, place]
            infeasible, value = ranking(cost, defect)
            was, before = ranking(self.cost[indices, chain], self.defect[indices, chain])
            better = np.where(infeasible == was, value < before, was)
            rows, to = indices[better], chain[better]
            self.cost[rows, to], self.defect[rows, to] = cost[better], defect[better]
            self.x[rows, to], self.u[rows, to] = knots.x[better, place], knots.u[better, place]
            self.gains[rows, to] = gains[better, place]

    def solution(self) -> BatchSolution:
        """The best chain of every problem, replayed."""
        clock = time.perf_counter()
        infeasible, value = ranking(self.cost, self.defect)
        order = np.lexsort((value, infeasible), axis=1)
        rows, best = np.arange(self.family.count), order[:, 0]
        x, u, gains = (array[rows, best] for array in (self.x, self.u, self.gains))
        start = np.broadcast_to(self.family.problem.x_init, (len(rows), x.shape[-1]))
        plan = np.concatenate([start[:, None], x], axis=1)
        open_loop, feedback = (
            _replayed(self.family, plan, u, share * gains) for share in (0.0, 1.0)
        )
        return BatchSolution(
            family=self.family,
            x=plan,
            u=u,
            gains=gains,
            chain_cost=self.cost,
            chain_defect=self.defect,
            best=best,
            open_loop=open_loop,
            feedback=feedback,
            compile_time=self.compile_time,
            solve_time=self.solve_time,
            replay_time=time.perf_counter() - clock,
        )


def _drawn(chains: int, problem: Problem, key: Array) -> Trajectory:
    """Initial knots of every chain of one problem."""
    return initial_knots(problem, chains, None, jax.random.fold_in(key, 0))


@jax.jit
def _worth(family: Family, knots: Trajectory) -> tuple[Array, Array]:
    """Cost and bound violation of every chain of every problem, (N, chains)."""
    return family.over(worth)(family.problem, knots)


@partial(compiled, static_argnames="tail")
def _flowed(
    flow: Langevin,
    family: Family,
    scales: Scale,
    knots: Trajectory,
    keys: Array,
    total: ArrayLike,
    tail: bool,
) -> tuple[Trajectory, Array, Info]:
    """All iterations of an attempt: knots, gains and diagnostics, (N, chains, ...)."""

    def one(
        problem: Problem, scale: Scale, knots: Trajectory, key: Array
    ) -> tuple[Trajectory, Array, Info]:
        solver = replace(flow, scale=scale)
        state = solver.init(problem, knots, jax.random.fold_in(key, 1))
        state = advance(solver, problem, state, 0, total, tail)
        found = replace(state.trajectory, slack=None)
        return found, state.gains, evaluate(problem, state.trajectory)

    return family.over(one)(family.problem, scales, knots, keys)


def _replayed(family: Family, plan: np.ndarray, u: np.ndarray, gains: np.ndarray) -> Replays:
    """The best chain of every problem, applied from its x_0."""
    first = family.at(0)
    if family.varies("dynamics", "bounds"):
        each = [
            family.at(i).replay(*(a[i : i + 1] for a in (plan, u, gains))) for i in range(len(u))
        ]
        ran = np.concatenate([run[0] for run in each]), np.concatenate([run[1] for run in each])
    else:
        ran = first.replay(plan, u, gains)

    def worth_of(knots: Trajectory) -> tuple[Array, Array]:
        cost, outside = _worth(family, jax.tree.map(lambda a: a[:, None], knots))
        return cost[:, 0], outside[:, 0]

    return judged(first, plan, ran, worth_of)
