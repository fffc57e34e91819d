"""The default solver: descend first, then heat and cool again what has failed.

The first attempt of every chain is a noise-free flow. It solves a problem that is not a trap, and
it measures what a trap's annealing needs to know: the scale of costs of answers. Each further
attempt works on the chains that are not done: infeasible, or far more expensive than the best.
They start again from new random knots, are heated to a temperature of that scale, and are cooled
slowly. Chains that are done leave their places in the batch to those that are not, so an attempt
makes several tries for each, and every chain keeps the best that was found for it.

Where f has kinks (contacts, limits, dry friction), noise was never seen to help, so all attempts
descend; each is then led on along replays of its controls (`_Search._mended`).

Schedules are multiples of units that are measured, so no setting depends on the units of a cost:

    cost     a share of the median cost of the initial knots, for mu, delta and rho; ten times as
             much after an attempt in which not one chain became feasible
    noise    the square root of the best cost so far, for sigma
"""

from __future__ import annotations

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

from mjx_drax.base.errors import DraxError, require_not_negative, require_whole, shown
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.kernels.compilation import compiled
from mjx_drax.method.langevin import (
    DAMPING,
    EASE,
    FEASIBLE,
    TIGHTEN,
    Info,
    Langevin,
    Scale,
    State,
    advance_and_evaluate,
    ranking,
    undiagnosed,
)
from mjx_drax.method.schedules import Geometric
from mjx_drax.problem.checks import require_functions
from mjx_drax.problem.problem import Problem, Trajectory, functions_of, numbers
from mjx_drax.search.checkpoint import Checkpoint, digest, facts
from mjx_drax.search.devices import gathered, mesh_for, spread
from mjx_drax.search.recording import LIMIT, Recorder, knot_defects

CHUNK = 20
"""Iterations between two reports, records of the history, and chances to interrupt; a hundredth
of an attempt's where that is more."""

UNIT = 1 / 300
"""The unit of cost, as a share of the median cost of the initial knots."""

MORE = 10.0
"""Factor on the unit of cost after an attempt in which not one chain became feasible."""

REPLAYS, MENDINGS, STEPS = 2, 30, 2
"""Where f has kinks: replays after an attempt, rounds of more, iterations of the tail in each."""

ENOUGH = 0.1
"""Largest share of chains to be done where f has kinks; attempts are long there."""

NEGLIGIBLE = 0.03
"""Differences of cost below so many units do not count."""

Progress = Callable[[int, int, Info], None]


@dataclass(frozen=True)
class Restarts:
    """Descend, then heat what failed; every chain keeps the best of its attempts.

    Attributes:
        flow: the settings of an attempt, its schedules in units that are measured.
        descent: noise-free iterations of the first attempt, which measures the units. None: the
            first attempt is like the others, and the schedules are in the flow's own units.
        attempts: largest number of attempts, the first included.
        within: a chain is done if it is feasible and its cost exceeds the best chain's by at most
            this share.
        enough: share of chains to be done; then no further attempt is made.
    """

    flow: Langevin = field(
        default_factory=lambda: Langevin(
            iterations=150,
            tail=60,
            noise=Geometric(6.0, 1.5e-3),
            penalty=Geometric(40.0, 4e3),
            damping=Geometric(0.3, 0.1, 0.03),
            barrier_weight=Geometric(0.1, 1e-3, 1e-5),
        )
    )
    descent: int | None = 100
    attempts: int = 5
    within: float = 1.0
    enough: float = 0.95

    @property
    def iterations(self) -> int:
        """Largest number of iterations that a solve does."""
        return self.noise_ends[-1] + self.flow.tail

    @property
    def noise_ends(self) -> list[int]:
        """After how many iterations the noise of each attempt ends."""
        flow = self.flow
        first = flow.iterations if self.descent is None else self.descent
        return [first + i * (flow.iterations + flow.tail) for i in range(self.attempts)]

    def first(self, unit: float) -> Langevin:
        """The settings of the first attempt, for a unit of cost."""
        if self.descent is None:
            return self.flow
        return replace(self.flow, iterations=self.descent, scale=_scale(unit, 0.0))

    def check(self, problem: Problem) -> None:
        """Complain about settings that cannot work.

        Raises:
            DraxError: naming the setting, its value and the fix.
        """
        if not isinstance(self.flow, Langevin):
            raise DraxError(f"flow is {shown(self.flow)}: give a Langevin.")
        self.flow.check(problem)
        if self.descent is not None:
            require_whole("descent", self.descent, 0)
        require_whole("attempts", self.attempts)
        for name in ("within", "enough"):
            require_not_negative(name, getattr(self, name))


def with_iterations(solver: Langevin | Restarts, iterations: int) -> Langevin | Restarts:
    """The same settings with other numbers of iterations, in proportion to those with noise."""
    share = iterations / max(solver.flow.iterations, 1)
    flow = replace(solver.flow, iterations=iterations, tail=round(share * solver.flow.tail))
    if isinstance(solver, Langevin):
        return flow
    descent = None if solver.descent is None else round(share * solver.descent)
    return replace(solver, flow=flow, descent=descent)


@register_dataclass
@dataclass(frozen=True)
class Attempt:
    """Where chains stand after an attempt, and since which iteration each was feasible, or -1."""

    state: State
    info: Info
    converged_at: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """Of the knots, (chains,)."""
        return np.asarray(self.info.cost)

    @property
    def feasible(self) -> np.ndarray:
        """Whether max|h| < `FEASIBLE`, (chains,)."""
        return np.asarray(self.info.max_defect) < FEASIBLE


@register_dataclass
@dataclass(frozen=True)
class Stand:
    """Where a search stands: all that the rest of it depends on.

    Attributes:
        attempt: the one that is under way, from 0.
        unit: of cost.
        owners: for which chain each place in the batch works, (chains,).
        kept: the best of the attempts before; None in the first.
        at: where this attempt's chains are.
        damping: of each chain while replays lead it on, (chains,).
        records, began: as in `Run`.
        step: how many of the attempt's iterations are done.
        mended: how many replays, and rounds of them, have led its chains on since.
    """

    attempt: int
    unit: float
    owners: np.ndarray
    kept: Attempt | None
    at: Attempt
    damping: np.ndarray
    records: tuple[tuple[int, Info], ...]
    began: tuple[tuple[int, int], ...] = ()
    step: int = 0
    mended: int = 0

    @property
    def done(self) -> int:
        """Iterations of the whole search, at the last report."""
        return self.records[-1][0]


@dataclass(frozen=True)
class Run(Attempt):
    """Where the chains of a solve ended, before any replay.

    `records` holds what every place in the batch was at, which in later attempts are other tries
    of fewer chains. `began` holds for every attempt after how many iterations it began, and after
    how many its noise ended (the same, if it had none).
    """

    records: list[tuple[int, Info]]
    began: list[tuple[int, int]]
    compile_time: float
    solve_time: float


def run(
    problem: Problem,
    chains: int,
    seed: int,
    solver: Langevin | Restarts,
    guess: Trajectory | None = None,
    progress: Progress | None = None,
    recorder: Recorder | None = None,
    devices: int = 1,
    checkpoint: Checkpoint | None = None,
) -> Run:
    """The iterations of `solve`, for problems that need no replay; the same arguments."""
    require_functions(progress=progress)
    solver = as_restarts(problem, chains, seed, solver)
    mesh = mesh_for(chains, devices)
    search = _Search(problem, chains, seed, guess, progress, recorder, mesh, checkpoint)
    return search.run(solver)


def as_restarts(problem: Problem, chains: int, seed: int, solver: Langevin | Restarts) -> Restarts:
    """The solver, of which a `Langevin` is one attempt with its schedules as they stand.

    Raises:
        DraxError: a number of chains, seed or setting that cannot work.
    """
    require_whole("chains", chains)
    require_whole("seed", seed, 0)
    if seed >= 2**32:
        raise DraxError(f"seed is {seed!r}: give a whole number from 0 to 2**32 - 1.")
    if not isinstance(solver, Langevin | Restarts):
        raise DraxError(f"solver is {shown(solver)}: give a Langevin or a Restarts.")
    solver.check(problem)
    if isinstance(solver, Langevin):
        return Restarts(solver, descent=None, attempts=1)
    return solver


class _Search:
    """The attempts of one solve."""

    stand: Stand
    clock: float
    launch: tuple[Langevin, bool, Callable[..., Any]] | None = None

    def __init__(
        self,
        problem: Problem,
        chains: int,
        seed: int,
        guess: Trajectory | None,
        progress: Progress | None,
        recorder: Recorder | None,
        mesh: Mesh | None,
        checkpoint: Checkpoint | None,
    ) -> None:
        self.problem, self.chains, self.seed, self.mesh = problem, chains, seed, mesh
        self.guess, self.progress, self.recorder = guess, progress, recorder
        self.checkpoint = checkpoint

    def run(self, solver: Restarts) -> Run:
        clock = time.perf_counter()
        flow = solver.flow
        if solver.descent is not None:
            flow = replace(flow, scale=_scale(1.0, 1.0))  # not yet known, but of that type
        if self.checkpoint is not None:
            self._require(self.checkpoint, solver, flow)
        state, info = self._start(flow, 0)
        _require_finite(flow, self.problem, state, info)
        unit, everyone = unit_of(np.asarray(info.cost)), np.arange(self.chains)
        at, damping = Attempt(state, info, np.full(self.chains, -1)), np.ones(self.chains)
        self.stand = Stand(0, unit, everyone, None, at, damping, ((0, info),))
        first = solver.first(unit)
        before, answered = self._resumed(first)
        if not answered:
            if solver.attempts > 1:
                _gather((state, info), (state, info), everyone)
            if self.recorder is not None:
                knot_defects(self.problem, state.trajectory)
            first.sigma(0)
        compile_time = time.perf_counter() - clock

        self.clock = time.perf_counter() - before
        kept, ended = self.stand.kept, False
        try:
            while True:
                flow = self._flow(solver, self.stand.unit, self.stand.kept)
                complete = self._attempt(flow, solver.iterations)
                kept = self._best()
                ended = complete and not self._next(solver, kept)
                if ended or not complete:
                    break
        except KeyboardInterrupt:  # between two attempts
            if kept is None:
                raise
        if not answered:
            self._save(ended, now=True)
        if jax.process_count() > 1:  # of a state that is split, the others hold a part
            kept = self._whole(kept)
        records, began = list(self.stand.records), list(self.stand.began)
        times = compile_time, time.perf_counter() - self.clock
        return Run(kept.state, kept.info, kept.converged_at, records, began, *times)

    def _next(self, solver: Restarts, kept: Attempt) -> bool:
        """Begin another attempt; False if none is to be made."""
        stand, enough = self.stand, solver.enough
        if self.problem.dynamics.kinked:
            enough = min(enough, ENOUGH)
        left = np.flatnonzero(~finished(kept.cost, kept.feasible, solver.within, stand.unit))
        attempt, unit = stand.attempt + 1, stand.unit
        if attempt == solver.attempts or len(left) <= (1.0 - enough) * self.chains:
            return False
        if not kept.feasible.any():
            unit = MORE * unit  # the knots' cost says too little: penalize defects more
        owners, kept = np.resize(left, self.chains), self._whole(kept)
        state, info = self._start(self._flow(solver, unit, kept), attempt)
        at, damping = Attempt(state, info, np.full(self.chains, -1)), np.ones(self.chains)
        history = stand.records, stand.began
        self.stand = Stand(attempt, unit, owners, kept, at, damping, *history)
        return True

    def _best(self) -> Attempt:
        """The best of all attempts, this one included."""
        stand = self.stand
        if stand.kept is None:
            return stand.at
        return _best(stand.kept, self._whole(stand.at), stand.owners)

    def _whole(self, attempt: Attempt) -> Attempt:
        """The attempt with its states on one device."""
        return replace(attempt, state=gathered(attempt.state, self.mesh))

    def _flow(self, solver: Restarts, unit: float, kept: Attempt | None) -> Langevin:
        """The settings of an attempt after those that led to `kept`."""
        if kept is None or self.problem.dynamics.kinked:
            return solver.first(unit)
        if solver.descent is None:
            return solver.flow
        temperature = level(kept.cost, kept.feasible, unit)
        return replace(solver.flow, scale=_scale(unit, np.sqrt(temperature)))

    def _require(self, checkpoint: Checkpoint, solver: Restarts, flow: Langevin) -> None:
        """Complain now about a checkpoint of another question, or one that cannot be written."""
        problem, recorder = self.problem, self.recorder
        known = facts(problem, self.chains, self.seed, solver)
        record = None if recorder is None else recorder.every
        checkpoint.require({"call": "solve", **known, "record": record})

        shape, dtype = (self.chains, problem.horizon), problem.x_init.dtype
        nx, nu = problem.dynamics.nx, problem.dynamics.nu

        def start() -> tuple[State, Info]:
            x, u = (jnp.zeros((*shape, n), dtype) for n in (nx, nu))
            state = _init(flow, problem, Trajectory(x, u), jax.random.key(0))
            return state, undiagnosed(state)

        def size(tree: Any) -> int:
            return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))

        state, info = jax.eval_shape(start)
        reports, recording = solver.attempts * (100 + MENDINGS), 0
        if recorder is not None:
            reports += solver.iterations // recorder.every
            recording = min(
                LIMIT, reports * self.chains * (nx + 2) * problem.horizon * dtype.itemsize
            )
        checkpoint.require_room(2 * size(state) + reports * size(info) + recording)

    def _resumed(self, flow: Langevin) -> tuple[float, bool]:
        """Stand where the checkpoint was written; how long solving took so far, and if it ended."""
        checkpoint, stand = self.checkpoint, self.stand
        if checkpoint is None:
            return 0.0, False
        state, tail = stand.at.state, int(flow.tail) > 0
        checkpoint.require({"initial knots": digest(state.trajectory)})
        program = _advance.lower(state, flow, self.problem, 0, 0, tail)
        checkpoint.require({"functions": digest(program.as_text())})
        if checkpoint.found is None:
            return 0.0, False
        later = int(checkpoint.found["stand.attempt"]) > 0
        self.stand = replace(stand, kept=stand.at if later else None)
        saved = checkpoint.restored(self._saved(0.0, False))
        iterations, infos = saved["iterations"].tolist(), saved["infos"]
        records = [
            (n, jax.tree.map(lambda rows, i=i: rows[i], infos)) for i, n in enumerate(iterations)
        ]
        began = tuple((int(a), int(b)) for a, b in saved["began"])
        self.stand = replace(saved["stand"], records=tuple(records), began=began)
        if self.recorder is not None:
            self.recorder.restore(saved["recorder"])
        if not saved["ended"]:
            jax.block_until_ready(self._advanced(flow, state, 0, 0, tail))  # just compiles
        return saved["solve_time"], saved["ended"]

    def _saved(self, solve_time: float, ended: bool) -> dict[str, Any]:
        """What a checkpoint holds."""
        stand, recorder = self.stand, self.recorder
        iterations, infos = zip(*stand.records, strict=True)
        return {
            "stand": replace(stand, records=(), began=()),
            "iterations": np.array(iterations),
            "infos": jax.tree.map(lambda *rows: np.stack(rows), *infos),
            "began": np.array(stand.began, int),
            "recorder": None if recorder is None else recorder.saved(),
            "solve_time": solve_time,
            "ended": ended,
        }

    def _save(self, ended: bool = False, now: bool = False) -> None:
        """Write a checkpoint, if one is asked for and it is time to."""
        if self.checkpoint is not None:
            solve_time = time.perf_counter() - self.clock
            self.checkpoint.save(lambda: self._saved(solve_time, ended), now)

    def _start(self, flow: Langevin, attempt: int) -> tuple[State, Info]:
        """New initial knots and random numbers for every place in the batch."""
        key = jax.random.key(self.seed)
        key_knots, key_noise = jax.random.split(jax.random.fold_in(key, attempt))
        knots = initial_knots(self.problem, self.chains, self.guess, key_knots)
        saved = self.checkpoint is not None and self.checkpoint.found is not None
        if attempt == 0 and not saved:  # f of models, which compiles for long, if they fail
            of_model = hasattr(self.problem.dynamics, "mj_model")
            _require_sound(flow, self.problem, knots, with_f=not of_model)
        state = _init(flow, self.problem, knots, key_noise)
        if attempt == 0 and saved:
            return state, undiagnosed(state)  # it will be replaced; an answer needs no compiling
        _, info = self._advanced(flow, state, 0, 0, int(flow.tail) > 0)
        return jax.block_until_ready((state, info))

    def _mended(self, flow: Langevin, expected: int) -> bool:
        """Lead the attempt's chains on along replays where f has kinks; False if interrupted.

        Where contacts switch, linear models of f are wrong, and steps that trust them leave
        defects. A replay has none. So each chain takes its replay, and then every two steps of the
        tail are replayed with their feedback: what is feasible and cheaper is kept, and chains for
        which it is not are damped more.
        """
        begun, kinked = self.stand.mended > 0, self.problem.dynamics.kinked
        if not kinked or flow.tail < STEPS or (self.stand.at.feasible.all() and not begun):
            return True
        try:
            self.stand = replace(self.stand, at=self._whole(self.stand.at))
            while self.stand.mended < REPLAYS + MENDINGS:
                self._mend(flow, expected)
        except KeyboardInterrupt:
            return False
        return True

    def _mend(self, flow: Langevin, expected: int) -> None:
        """A replay without feedback, then one with it, then rounds of steps and replays."""
        stand, everyone = self.stand, np.arange(self.chains)
        kept, damping, mended = stand.at, stand.damping, stand.mended + 1
        if stand.mended < REPLAYS:
            replayed = self._replayed(flow, kept, float(stand.mended), stand.done)
            self.stand = replace(stand, at=_best(kept, replayed, everyone), mended=mended)
            return
        done = stand.done + STEPS
        found = self._stepped(flow, kept, damping, done)
        found = _best(found, self._replayed(flow, found, 1.0, done), everyone)
        improved = _improved(kept, found)
        kept = _best(kept, found, everyone)
        damping = np.clip(damping * np.where(improved, EASE, TIGHTEN), *DAMPING)
        if not improved.any() and (damping == DAMPING[1]).all():
            mended = REPLAYS + MENDINGS  # more would change nothing
        self._report(flow, replace(stand, at=kept, damping=damping, mended=mended), done, expected)

    def _stepped(self, flow: Langevin, kept: Attempt, damping: np.ndarray, done: int) -> Attempt:
        """The attempt after the last `STEPS` of the tail's iterations, once more."""
        total = flow.iterations + flow.tail
        state = replace(kept.state, damping=jnp.asarray(damping, kept.state.damping.dtype))
        state, info = self._advanced(flow, state, total - STEPS, total)
        return self._whole(Attempt(state, info, np.full(self.chains, done)))

    def _report(self, flow: Langevin, stand: Stand, done: int, expected: int) -> None:
        """Stand there, after `done` iterations of the search: record it, keep it and tell."""
        at = stand.at
        self.stand = replace(stand, records=(*stand.records, (done, at.info)))
        self._snap(flow)
        self._save()
        if self.progress is not None:
            self.progress(done, max(expected, done), at.info)

    def _snap(self, flow: Langevin) -> None:
        """Record knots too, if asked for."""
        if self.recorder is not None:
            stand, at = self.stand, self.stand.at
            knots = gathered(at.state.trajectory, self.mesh)
            self.recorder.take(self.problem, flow, stand.step, stand.done, knots, at.info)

    def _replayed(self, flow: Langevin, kept: Attempt, with_feedback: float, done: int) -> Attempt:
        """Every chain's knots replaced by a replay of its controls."""
        problem, knots = self.problem, kept.state.trajectory
        gains, dtype = with_feedback * np.asarray(kept.state.gains), knots.x.dtype
        states, controls = problem.replay(problem.with_start(knots), knots.u, gains)
        replayed = Trajectory(jnp.asarray(states[:, 1:], dtype), jnp.asarray(controls, dtype))
        state = _moved_to(flow, problem, kept.state, replayed)
        state, info = self._advanced(flow, state, 0, 0)  # compiled already; just evaluates
        return self._whole(Attempt(state, info, np.full(self.chains, done)))

    def _attempt(self, flow: Langevin, expected: int) -> bool:
        """What is left of an attempt; False if it is interrupted."""
        stand = self.stand
        if len(stand.began) == stand.attempt:
            noisy = int(flow.iterations) if flow.sigma(0) > 0.0 else 0
            if self.recorder is not None:
                self.recorder.begin(stand.owners)
            self.stand = replace(stand, began=(*stand.began, (stand.done, stand.done + noisy)))
            self._snap(flow)
        return self._flowed(flow, expected) and self._mended(flow, expected)

    def _flowed(self, flow: Langevin, expected: int) -> bool:
        """What is left of the iterations of an attempt; False if they are interrupted."""
        total, tail = flow.iterations + flow.tail, int(flow.tail) > 0
        before = self.stand.done - self.stand.step
        try:
            while self.stand.step < total:
                stand, at = self.stand, self.stand.at
                stop = min(stand.step + self._stride(total), total)
                ahead = self._advanced(flow, at.state, stand.step, stop, tail)
                state, info = jax.block_until_ready(ahead)
                if before == 0 and (np.asarray(gathered(state.died_at, self.mesh)) == 0).all():
                    knots = gathered(at.state.trajectory, self.mesh)
                    _require_sound(flow, self.problem, knots)
                feasible = np.asarray(info.max_defect) < FEASIBLE
                since = np.where(at.converged_at < 0, before + stop, at.converged_at)
                at = Attempt(state, info, np.where(feasible, since, -1))
                self._report(flow, replace(stand, at=at, step=stop), before + stop, expected)
        except KeyboardInterrupt:  # the chains as they were at the last report
            return False
        return True

    def _advanced(
        self, flow: Langevin, state: State, start: int, stop: int, tail: bool = True
    ) -> tuple[State, Info]:
        """Iterations start..stop-1 on all devices, where the states then stay."""
        if self.launch is None or self.launch[0] is not flow or self.launch[1] != tail:
            program = spread(partial(_advance, tail=tail), self.mesh, flow, self.problem)
            self.launch = flow, tail, program
        state, info = self.launch[2](state, start, stop, compiles=start == stop == 0)
        return state, gathered(info, self.mesh)

    def _stride(self, total: int) -> int:
        """Iterations up to the next report, for an attempt of so many."""
        usual = max(CHUNK, total // 100)
        return usual if self.recorder is None else min(usual, self.recorder.every)


@partial(compiled, static_argnames="tail")
def _advance(
    state: State,
    flow: Langevin,
    problem: Problem,
    start: ArrayLike,
    stop: ArrayLike,
    tail: bool,
) -> tuple[State, Info]:
    """`advance_and_evaluate`, of chains first."""
    return advance_and_evaluate(flow, problem, state, start, stop, tail)


_moved_to = jax.jit(Langevin.moved_to)


_init = jax.jit(Langevin.init)


def _scale(cost: float, noise: float) -> Scale:
    """Units as numbers of one type, so that other values do not recompile."""
    return Scale(np.float32(cost), np.float32(noise))


def _median(costs: np.ndarray) -> float:
    """Median of the absolute values of finite costs."""
    finite = np.abs(costs[np.isfinite(costs)])
    return float(np.median(finite)) if finite.size else 0.0


def unit_of(costs: np.ndarray) -> float:
    """The unit of cost, from the costs of initial knots (chains,)."""
    return UNIT * _median(costs) or 1.0


def level(costs: np.ndarray, feasible: np.ndarray, unit: float) -> float:
    """The scale of the costs of answers: the best so far, or what all have if none is feasible."""
    scale = abs(costs[feasible].min()) if feasible.any() else _median(costs)
    return max(float(scale), NEGLIGIBLE * unit)


def finished(costs: np.ndarray, feasible: np.ndarray, within: float, unit: ArrayLike) -> np.ndarray:
    """Which chains are done, (..., chains), for one problem or several with units (...,)."""
    costs = np.where(feasible, costs, np.inf)
    best = costs.min(axis=-1, keepdims=True)
    known = np.isfinite(best)
    margin = np.maximum(within * np.abs(best), NEGLIGIBLE * np.expand_dims(unit, -1))
    return np.where(known, costs <= best + np.where(known, margin, 0.0), feasible)


def _improved(kept: Attempt, found: Attempt) -> np.ndarray:
    """Which chains became feasible, or cheaper by more than a thousandth, (chains,)."""
    before, after = (np.asarray(a.info.cost, float) for a in (kept, found))
    cheaper = after < before - 1e-3 * np.abs(before)
    return found.feasible & (cheaper | ~kept.feasible)


def _best(kept: Attempt, found: Attempt, owners: np.ndarray) -> Attempt:
    """For every chain the best of what it has and of what was found for it.

    owners (chains,) says for which chain each place in the batch has worked. Feasible beats
    infeasible, then the cheaper or the less infeasible wins.
    """
    chains = len(owners)

    def both(values: Callable[[Attempt], ArrayLike]) -> np.ndarray:
        return np.concatenate([np.asarray(values(kept)), np.asarray(values(found))])

    infeasible, value = ranking(both(lambda a: a.cost), both(lambda a: a.info.max_defect))
    of = np.concatenate([np.arange(chains), owners])
    order = np.lexsort((value, infeasible, of))
    source = order[np.unique(of[order], return_index=True)[1]]
    state, info = _gather((kept.state, kept.info), (found.state, found.info), source)
    return Attempt(state, info, both(lambda a: a.converged_at)[source])


@jax.jit
def _gather(kept: Any, found: Any, source: Array) -> Any:
    """Rows `source` (chains,) of two batches, one after the other."""
    chains = len(source)

    def rows(a: Array, b: Array) -> Array:
        mine = (source < chains).reshape(-1, *[1] * (a.ndim - 1))
        return jnp.where(mine, a[source % chains], b[source % chains])

    return jax.tree.map(rows, kept, found)


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
        if array.shape not in ((K, size), (chains, K, size)):
            raise DraxError(
                f"guess.{label} has shape {array.shape}: give ({K}, {size}), or "
                f"({chains}, {K}, {size}) with one for each chain."
            )
        if not np.isfinite(array).all():
            raise DraxError(f"guess.{label} holds NaN or infinite values: give finite knots.")
        knots.append(jnp.asarray(np.broadcast_to(array, (chains, K, size))))
    return Trajectory(problem.dynamics.valid(knots[0]), knots[1])


_draw = jax.jit(jax.vmap(Problem.draw, in_axes=(None, 0)))


def _require_finite(flow: Langevin, problem: Problem, state: State, info: Info) -> None:
    """Complain if no chain could possibly start."""
    for label, values in (("cost", info.cost), ("dynamics", info.max_defect)):
        if not np.isfinite(values).any():
            _require_sound(flow, problem, state.trajectory)
            raise DraxError(
                f"the {label} of {problem.name} is {float(values[0])} at the initial knots of "
                f"every chain ({len(values)} tried): make it finite there (no 0/0, no log or sqrt "
                "of negative numbers), or narrow the scatter of the initial knots."
            )


def _require_sound(
    flow: Langevin, problem: Problem, knots: Trajectory, with_f: bool = True
) -> None:
    """Complain about a function that is finite, with its derivatives, for no chain's knots.

    Those of a stage are tried at x_init, where every chain stays, and its first control; those of
    the end at its last state.

    Raises:
        DraxError: naming the function, where it fails and the fix.
    """
    flow = replace(flow, scale=Scale())  # of one type, measured or not
    finite = _soundness(flow, problem, knots, flow.forward(problem), with_f)
    for label, *_ in functions_of(problem):
        for what, good in zip(
            ("value", "derivative", "second derivative"), finite.get(label, []), strict=False
        ):
            if not np.asarray(good).any():
                at = "the initial points"
                if problem.dynamics.nx:
                    at = "the last initial state" if label.startswith("terminal") else "x_init"
                raise DraxError(
                    f"the {what} of {label} is not finite at {at} for any of {len(good)} chains: "
                    "change it (no 0/0, no log or sqrt of 0; sqrt(y + 1e-6) has a derivative), or "
                    "move x_init or the scatter of initial knots."
                )


@partial(jax.jit, static_argnames=("exact", "with_f"))
def _soundness(
    flow: Langevin, problem: Problem, knots: Trajectory, exact: bool, with_f: bool
) -> dict[str, list[Array]]:
    """Whether functions, first and second derivatives are finite, (chains,) each.

    Derivatives are taken in one direction that moves every number.
    """
    inside = jax.vmap(partial(flow.bounds.interior, problem.bounds))(replace(knots, slack=None))
    u = inside.u[:, 0]
    start = jnp.broadcast_to(problem.x_init, (len(u), problem.dynamics.nx))
    found = {}
    for label, function, arguments, _ in functions_of(problem):
        if function == problem.dynamics.step and not with_f:
            continue
        at_end = len(arguments) == 1
        z = jnp.concatenate([inside.x[:, -1] if at_end else start, u], axis=1)
        order = (2 if label.endswith("cost") else 1) if exact else 0
        orders = jax.vmap(_with_slopes(_of_knot(problem, function, at_end), order))(z)
        found[label] = [jnp.isfinite(each).reshape(len(u), -1).all(axis=1) for each in orders]
    return found


def _of_knot(
    problem: Problem, function: Callable[..., Any], at_end: bool
) -> Callable[[Array], Array]:
    """A function of a problem as one of z = [x, u]."""
    dynamics = problem.dynamics

    def value(z: Array) -> Array:
        x, u = jnp.split(z, [dynamics.nx])
        if function == dynamics.step:
            return dynamics.step(x, u)
        if at_end:
            return jnp.asarray(function(dynamics.observe(x, jnp.zeros_like(u))), float)
        return jnp.asarray(function(dynamics.observe(x, u), u), float)

    return value


def _with_slopes(
    function: Callable[[Array], Array], order: int
) -> Callable[[Array], tuple[Array, ...]]:
    """The function and its derivatives along (1, ..., 1), up to an order."""
    if order == 0:
        return lambda z: (function(z),)
    lower = _with_slopes(function, order - 1)

    def slopes(z: Array) -> tuple[Array, ...]:
        values, changes = jax.jvp(lower, (z,), (jnp.ones_like(z),))
        return *values, changes[-1]

    return slopes
