"""One search for one problem or for thousands: attempts, each in chunks of problems.

An attempt draws initial knots for every chain of a chunk's problems, runs the flow, follows it with
rollouts if the settings say so, and keeps the best of every chain. Each problem has its own scales,
random numbers and attempts, so its answer does not depend on which others are solved beside it.
`solve` and `minimize` have one problem and one chunk. `solve_batch` packs the problems that are not
done into chunks of one size, which one compilation serves and which fit into memory. A large chunk
thins out: the last chains that move go on in a program for few problems, as later attempts do. GPUs
round them there as they do in the chunk; CPUs may not.
"""

from __future__ import annotations

import math
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

from mjx_drax.base.digests import digest
from mjx_drax.kernels.compilation import rarely_collected, while_compiling
from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import Langevin, State
from mjx_drax.method.schedules import Scale
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search import rounds
from mjx_drax.search.attempts import (
    stricter,
    temperature,
)
from mjx_drax.search.chains import (
    Chains,
    Stage,
    best_of,
    finished,
    gather,
    improved,
    put_back,
    slim,
    taken,
    unset,
)
from mjx_drax.search.checkpoint import Checkpoint, facts
from mjx_drax.search.checks import require_alive, require_finite, require_sound
from mjx_drax.search.decisions import Decisions
from mjx_drax.search.devices import gathered, on_host, split_over
from mjx_drax.search.family import Family
from mjx_drax.search.initial import initial_knots, knots_by_row, problem_keys
from mjx_drax.search.iterate import (
    FEASIBLE,
    Question,
    begin,
    iterate,
    noise_at,
)
from mjx_drax.search.recording import LIMIT, Recorder, knot_defects
from mjx_drax.search.replayer import Replayer
from mjx_drax.search.restarts import Restarts, Rollouts, scale_of
from mjx_drax.search.settings import to_data
from mjx_drax.search.sizes import Sizes, median, scale_and_floor, sizes_of
from mjx_drax.search.units import to_units, units_of
from mjx_drax.search.warm import Warm, warmed

REPORT_EVERY = 20
"""Iterations between two reports, records of the history, and chances to interrupt; a hundredth
of an attempt's where that is more."""

MANY, FEWER = 2048, 8
"""A batch of at least MANY chains has a second program, for a FEWER-th of its problems: what still
moves when most are done goes on there, and so do later attempts at few problems."""

FAR, COOLER, MOST_COOLINGS = 10.0, 0.25, 4
"""If noise raises max|h| of most chains above FAR times that of the initial knots, or above FAR^2,
the attempt and those after it start with COOLER times the noise; at most MOST_COOLINGS times."""

Progress = Callable[[int, int, Info], None]


@dataclass(frozen=True)
class Found:
    """What a search came to, before any replay.

    Attributes:
        chains: the best of every chain, (N * chains,) rows.
        records, began: as in `Stage`; later attempts' records are of other tries for fewer chains.
        flow: the settings of the first attempt, in the first problem's scales.
        interrupted: whether it was ended before its time.
        compile_time, solve_time: [s].
    """

    chains: Chains
    records: list[tuple[int, Info]]
    began: list[tuple[int, int]]
    flow: Langevin
    interrupted: bool
    compile_time: float
    solve_time: float


@dataclass
class Search:
    """The attempts of one call.

    Attributes:
        family: the problems; once it runs, with the units of their constraints.
        chains: of each problem.
        seed: of all random numbers.
        settings: with a value for everything.
        size: problems in a chunk.
        mesh: the devices, or None for one.
        guess: initial knots of a single problem, or the answer of another one to start from. What
            is better in it than what is found is kept.
        checkpoint: where to write.
        recorder: of a single problem's knots.
        progress: called with (iterations done, of how many, diagnostics) for a single problem.
        chunk_done: called with (problems done, of how many) after every chunk.
        seconds: after which this call of a single problem's search is interrupted, at a report.
    """

    family: Family
    chains: int
    seed: int
    settings: Restarts
    size: int = 1
    mesh: Mesh | None = None
    guess: Trajectory | Warm | None = None
    checkpoint: Checkpoint | None = None
    recorder: Recorder | None = None
    progress: Progress | None = None
    chunk_done: Callable[[int, int], None] | None = None
    seconds: float = math.inf

    stage: Stage = field(init=False)
    flow: Langevin = field(init=False)
    question: tuple[Question, Question] = field(init=False)
    launch: Callable[..., Any] = field(init=False)
    started: float = field(init=False, default=0.0)
    clock: float = field(init=False, default=0.0)
    compiling: float = field(init=False, default=0.0)

    def run(self) -> Found:
        """All attempts; Ctrl-C keeps what there is."""
        clock = time.perf_counter()
        if self.checkpoint is not None:
            self._require(self.checkpoint)
        self._begin_search()
        first = self.flow
        before, ended = self._resume()
        answered = ended
        if not answered:
            self._compile_the_rest()
        self.compiling = time.perf_counter() - clock

        self.started = time.perf_counter()
        self.clock = self.started - before
        try:
            while not ended:
                if self.stage.place < len(self.stage.todo):
                    if not self.stage.begun:
                        self._begin_chunk()
                    if not self._iterate() or not self._roll_out():
                        break
                    self._next_chunk()
                if self.stage.place == len(self.stage.todo):
                    ended = not self._next_attempt()
        except KeyboardInterrupt:  # between two chunks
            answered |= self.stage.begun and not self.family.alone  # one may be half kept
        if not answered:
            self._save(ended, now=True)
        if self.stage.begun and self.stage.rollouts == 0:  # else rollouts have judged
            self.stage = replace(self.stage, now=self._judged(self.stage.now))
        found = self._merged() if self.stage.begun else self.stage.kept
        assert found is not None
        if self.guess is not None:
            guessed = self._guessed()
            _, better = self._no_worse(found, guessed)
            if ended and better.any():
                guessed = self._polished(guessed)
            found, _ = self._no_worse(found, guessed)
        stage, solve_time = self.stage, time.perf_counter() - self.clock
        records, began = list(stage.records), list(stage.began)
        return Found(found, records, began, first, not ended, self.compiling, solve_time)

    # Attempts and chunks

    @property
    def decisions(self) -> Decisions:
        """What is decided of its chains."""
        return Decisions(self.settings, self.chains, self.family.alone, self.mesh)

    @property
    def few(self) -> int:
        """Problems of the second program; 0: there is none."""
        polished = self.decisions.polish is not None
        many = self.size * self.chains >= MANY and self.mesh is None and polished
        return self.size // FEWER if many and not self.family.alone else 0

    def places(self, attempt: int) -> int:
        """Of a problem in that attempt."""
        one_each = not self.family.alone or self.guess is not None
        return self.chains if one_each else self.settings.places(self.chains, attempt)

    @property
    def width(self) -> int:
        """Problems in a chunk of this attempt."""
        return self.few if self.few and 2 * len(self.stage.todo) <= self.size else self.size

    @property
    def indices(self) -> np.ndarray:
        """Problems of the chunk, (width,); the last chunk is filled up with problems again."""
        stage, width = self.stage, self.width
        return np.resize(stage.todo[stage.place : stage.place + width], width)

    @rarely_collected()
    def _begin_search(self) -> None:
        """Initial knots of the first chunk, tried before anything long compiles."""
        family, everyone = self.family, np.arange(self.family.count)
        places, scale = self.places(0), np.ones(family.count)
        rows = self.size * places
        indices = np.resize(everyone, self.size)
        knots, keys = self._drawn(0, indices)
        saved = self.checkpoint is not None and self.checkpoint.found is not None
        mine = knots if family.alone else jax.tree.map(lambda a: a[:places], knots)
        if self.settings.descent is not None:
            self.family = family = family.in_units(units_of(family.at(0), mine))
        if isinstance(self.guess, Warm):
            own = to_units(family.problem, self.guess.knots, self.guess.multipliers)
            self.guess = replace(self.guess, knots=own[0], multipliers=own[1])
        one = family.at(0)
        if not saved:
            flow = self.settings.first(1.0)
            with_f = not family.problem.dynamics.checked
            require_sound(flow, one, mine, with_f, family.alone)
        self._settle(0, False, indices, scale)
        state = self._begun(0, knots, keys)
        zeros: Any = np.zeros(rows, knots.u.dtype)
        info = Info.of(zeros)
        if not saved:  # else it will be replaced; an answer needs no compiling
            info = self._compile(state)
            require_finite(self.flow, one, state.trajectory, info.cost, info.max_defect)
        now = Chains.of(state, info, np.full(rows, -1))
        kept = None if family.alone else unset(now, family.count * self.chains)
        self.stage = Stage(
            attempt=0,
            heated=False,
            finishing=0,
            cost_scale=scale,
            floor=np.zeros(family.count),
            todo=everyone,
            place=0,
            begun=True,
            kept=kept,
            least=np.full(family.count, np.inf),
            now=now,
            before=now.sound_cost,
            damping=np.ones(rows),
            step=0,
            ends=(np.zeros(0),) * 2,
            work=np.ones(2, int),
            rollouts=0,
            records=((0, self._best(now)),),
        )
        self._measure()

    def _compile(self, state: State) -> Info:
        """Compile what iterates and, beside it, more of what is needed; the states' diagnostics."""
        wide = jnp.result_type(float) == jnp.float64
        device = jax.config.values["jax_default_device"]

        def here(work: Callable[[State], object]) -> None:
            with jax.enable_x64(wide), jax.default_device(device):  # threads do not inherit them
                work(state)

        more: list[Callable[[State], object]] = []
        if self._measured and self.mesh is None:
            more.append(self._sizes)
        if self.few:
            more.append(self._compile_second)
        with while_compiling(*(partial(here, work) for work in more)):
            _, info = self._iterated(state, 0, 0)
        return info

    def _compile_second(self, state: State) -> None:
        """Compile the program for few problems, and what begins and ends with it."""
        knots, keys = self._drawn(0, np.arange(self.few))
        rows, (shared, own) = np.arange(len(keys)), self.question
        begin(taken(own, rows), shared, replace(knots, slack=None), keys)
        nothing = Info.of(np.zeros(len(state.alive)))
        self._go_on(state, nothing, rows, 0, 0)

    def _compile_more(self, kept: Chains) -> None:
        """Compile for the places of later attempts, once one is made and if they are more."""
        clock = time.perf_counter()
        later, info = self._iterated(self._begun(1, *self._drawn(1, self.indices)), 0, 0)
        both = (kept.state, kept.info), (gathered(later, self.mesh), info)
        jax.block_until_ready(gather(*both, np.arange(self.chains)))
        seconds = time.perf_counter() - clock
        self.compiling, self.clock = self.compiling + seconds, self.clock + seconds

    def _begun(self, attempt: int, knots: Trajectory, keys: Array) -> State:
        """The first state of every row of an attempt."""
        shared, own = self.question
        state = begin(own, shared, replace(knots, slack=None), keys)
        if attempt == 0 and isinstance(self.guess, Warm):
            state = warmed(own, shared, state, self.guess)
        return state

    def _no_worse(self, found: Chains, guessed: Chains) -> tuple[Chains, np.ndarray]:
        """The better of answer and guess for each chain, and where the guess won."""
        inside = np.asarray(guessed.info.max_violation) == 0.0
        better = improved(found, guessed, self.stage.floor[:1]) & inside
        source = np.arange(self.chains) + self.chains * better
        state, info = gather((found.state, found.info), (guessed.state, guessed.info), source)
        return Chains.of(state, info, np.where(better, 0, found.feasible_since)), better

    def _guessed(self) -> Chains:
        """The guess itself, of every chain."""
        knots, keys = self._drawn(0, self.indices)
        state = self._begun(0, knots, keys)  # which may have moved them off their bounds
        state = replace(state, trajectory=replace(knots, slack=state.trajectory.slack))
        state, info = self._iterated(state, 0, 0)
        return self._judged(Chains.of(state, info, np.zeros(self.chains, int)))

    def _polished(self, guessed: Chains) -> Chains:
        """A guess after a polish of its own, which no attempt has made of it as it is."""
        if self.decisions.polish is None or isinstance(self.guess, Warm):
            return guessed
        noisy = self.flow.iterations  # after which a chain would be rolled out
        state, info = self._iterated(guessed.state, noisy + 1, noisy + self.settings.after)
        now = self._judged(Chains.of(state, info, guessed.feasible_since))
        return finished(guessed, now, self.stage.floor[0])

    def _judged(self, chains: Chains) -> Chains:
        """The chains, on one device; feasible ones that miss the goal are marked.

        By plans: to replay them takes longer.
        """
        whole = self._whole(chains)
        if self.family.problem.goal is None:
            return whole
        return replace(whole, missed=self._replayer.short(whole))

    def _begin_chunk(self) -> None:
        """New initial knots and random numbers for every row."""
        stage, indices = self.stage, self.indices
        self._settle(stage.attempt, stage.heated, indices, stage.cost_scale)
        if stage.attempt == 1 and self.places(1) > self.places(0):
            assert stage.kept is not None
            self._compile_more(stage.kept)
        knots, keys = self._drawn(stage.attempt, indices)
        state = self._begun(stage.attempt, knots, keys)
        _, info = self._iterated(state, 0, 0)
        rows = len(indices) * self.places(stage.attempt)
        now = Chains.of(state, info, np.full(rows, -1))
        self.stage = replace(
            stage,
            begun=True,
            now=now,
            before=now.sound_cost,
            damping=np.ones(rows),
            step=0,
            rollouts=0,
        )
        if stage.attempt == 0:
            self._measure()

    def _measure(self) -> None:
        """The scale and the floor of costs of the chunk's problems, from their initial knots."""
        stage, indices = self.stage, self.indices
        if not self._measured:
            return
        sizes = jax.tree.map(np.asarray, self._sizes(stage.now.state))
        of_problem = jax.tree.map(lambda a: a.reshape(len(indices), -1), sizes)
        scale, floor = stage.cost_scale.copy(), stage.floor.copy()
        polished = self.decisions.polish is not None
        scale[indices], floor[indices] = scale_and_floor(of_problem, polished)
        self.stage = replace(stage, cost_scale=scale, floor=floor)
        self._settle(0, False, indices, scale)

    @property
    def _measured(self) -> bool:
        """Whether costs are compared, or the schedules are in scales that are measured."""
        return self.settings.descent is not None or self.settings.attempts > 1

    def _sizes(self, state: State) -> Sizes:
        """Of every row."""
        shared, own = self.question
        knots = gathered(state.trajectory, self.mesh)
        return sizes_of(own, shared, replace(knots, slack=None))

    def _next_chunk(self) -> None:
        """Keep the best of the chunk, and go on to the next one."""
        stage, kept = self.stage, self._merged()
        ends, work = list(stage.ends), stage.work.copy()
        if self.family.alone:
            kind = int(stage.heated)
            ends[kind] = np.append(ends[kind], stage.now.sound_cost)
            work[kind] += stage.step * len(stage.now.missed)
        place = min(stage.place + self.width, len(stage.todo))
        self.stage = replace(
            stage, kept=kept, ends=(ends[0], ends[1]), work=work, place=place, begun=False
        )
        if not self.family.alone:
            self._save()
            if self.chunk_done is not None:
                N, todo = self.family.count, len(stage.todo)
                self.chunk_done(N - todo + place, N)

    def _next_attempt(self) -> bool:
        """Go on to another attempt, or finish; False if nothing more is to be done."""
        stage, decisions, family = self.stage, self.decisions, self.family
        kept = stage.kept
        assert kept is not None
        if stage.finishing:
            assert decisions.polish is not None
            return stage.finishing < decisions.polish.patience and self._begin_to_finish()
        todo, heated = decisions.next_attempt(stage, self.places(0))
        if stage.attempt + 1 == self.settings.attempts or not len(todo):
            return self._begin_to_finish()
        scale = stricter(stage.cost_scale, kept.feasible.reshape(family.count, self.chains))
        self.stage = replace(
            stage, attempt=stage.attempt + 1, heated=heated, cost_scale=scale, todo=todo, place=0
        )
        return True

    def _begin_to_finish(self) -> bool:
        """Continue the polish of kept chains that were stopped early; False if there are none."""
        stage, kept = self.stage, self.stage.kept
        if not self.decisions.ends_early:
            return False
        assert kept is not None
        unfinished = self.decisions.unfinished(stage, kept)
        if not unfinished.any():
            return False
        done = int(np.asarray(kept.state.polish.iterations)[unfinished].min())
        again = self._again
        now = kept if len(again) == self.chains else kept.at(again)
        self.stage = replace(
            stage,
            finishing=stage.finishing + 1,
            begun=True,
            place=0,
            now=now,
            before=now.sound_cost,
            # the first only moves knots inside their bounds
            step=self.flow.iterations + max(done % (self.settings.after - 1), 1),
            began=(*stage.began, (stage.done, stage.done)),
        )
        if self.recorder is not None:
            self.recorder.begin(continues=True)
            self.recorder.belong(again, now.missed)
        self._record()
        return True

    @property
    def _again(self) -> np.ndarray:
        """Which chain each place of the first attempt's has, where all go on, (places,)."""
        return np.resize(np.arange(self.chains), self.places(0))

    def _merged(self) -> Chains:
        """The best of all attempts, this one included."""
        stage, kept, now = self.stage, self.stage.kept, self._whole(self.stage.now)
        if stage.finishing:
            assert kept is not None
            return finished(kept, now, stage.floor[0])
        owners = self.decisions.owners(stage, self.indices, now)
        if self.recorder is not None:
            self.recorder.belong(owners.ravel(), now.missed)
        if kept is None:
            return now if owners.size == self.chains else now.at(np.flatnonzero(owners >= 0))
        if self.family.alone:
            now = self.decisions.not_for_done_chains(stage, now, owners.ravel())
            return best_of(kept, now, owners.ravel())
        fresh = min(self.width, len(stage.todo) - stage.place)
        of_problem = np.arange(self.chains)
        rows = (self.indices[:fresh, None] * self.chains + of_problem).ravel()
        first = np.arange(fresh)[:, None] * self.chains
        mine, found = (
            jax.tree.map(lambda a, n=n: np.asarray(a)[n], chains)
            for chains, n in ((kept, rows), (slim(now), slice(len(rows))))
        )
        best = best_of(mine, found, (owners[:fresh] + first).ravel())
        jax.tree.map(lambda a, new: a.__setitem__(rows, new), kept, best)
        return kept

    def _best(self, now: Chains) -> Info:
        """Of the places as many as there are chains."""
        if len(now.missed) == self.chains:
            return now.info
        best = np.sort(now.order()[0, : self.chains])
        info: Info = jax.tree.map(lambda a: np.asarray(a)[best], now.info)
        return info

    def _whole(self, chains: Chains) -> Chains:
        """The chains with their states on one device."""
        return replace(chains, state=gathered(chains.state, self.mesh))

    def _drawn(self, attempt: int, indices: np.ndarray) -> tuple[Trajectory, Array]:
        """Initial knots (rows, K, ...) and random keys of an attempt on some problems."""
        key = jax.random.fold_in(jax.random.key(self.seed), attempt)
        if self.family.alone:
            key_knots, key_noise = jax.random.split(key)
            first: Trajectory | None = None
            if not isinstance(self.guess, Warm):
                first = self.guess
            elif attempt == 0:
                first = self.guess.knots
            knots = initial_knots(self.family.problem, self.places(attempt), first, key_knots)
            return knots, key_noise
        keys = problem_keys(key, indices)
        guess = self.family.problem.guess
        shared, own = self.family.question(self.settings.flow, Scale(1.0, 1.0), indices, 1)
        return knots_by_row(own.problem, shared.problem, keys, self.chains, guess)

    def _settle(
        self, attempt: int, heated: bool, indices: np.ndarray, cost_scale: np.ndarray
    ) -> None:
        """The flow and the question of an attempt on some problems."""
        settings, flow, cost = self.settings, self.settings.flow, cost_scale[indices]
        noise = np.zeros(len(indices))
        if settings.descent is None:
            cost, noise = (np.broadcast_to(s, len(indices)) for s in vars(flow.scale).values())
        elif heated:
            kept = self.stage.kept
            assert kept is not None
            shape = self.family.count, self.chains
            costs = kept.cost.reshape(shape) - self.stage.floor[:, None]
            feasible, least = kept.feasible.reshape(shape), self.stage.least[:, None]
            costs = np.concatenate([costs, least], axis=1)[indices]
            feasible = np.concatenate([feasible, np.isfinite(least)], axis=1)[indices]
            noise = np.sqrt(temperature(costs, feasible, cost))
            noise *= COOLER**self.stage.coolings
        elif attempt == 0 or not settings.heated:
            flow = replace(flow, iterations=settings.descent)
        if attempt == 0 and isinstance(self.guess, Warm) and settings.after:
            flow = replace(flow, iterations=0)
        if self.family.alone:
            if settings.descent is not None:
                flow = replace(flow, scale=scale_of(cost[0], noise[0]))
            self.flow = flow
        else:
            self.flow = replace(flow, scale=scale_of(1.0, 1.0))
        scale = Scale(cost, noise)
        shared, own = self.family.question(
            self.flow, scale, indices, self.chains, self.decisions.polish
        )
        # once: to send its dozens of numbers with every launch takes longer than an iteration
        self.question = jax.device_put(shared), own
        program = partial(iterate if self.mesh is None else iterate.traced, tail=settings.after > 0)
        self.launch = split_over(program, self.mesh, self.question[0])

    # Iterations

    def _iterated(self, state: State, start: int, stop: int) -> tuple[State, Info]:
        """Iterations start..stop-1 on all devices, where the states stay; diagnostics in numpy."""
        rows = state, self.question[1]
        state, info = self.launch(rows, start, stop, compiles=start == stop == 0)
        return state, on_host(info, self.mesh)

    def _iterate(self) -> bool:
        """What is left of the iterations of an attempt; False if they are interrupted."""
        stage, flow = self.stage, self.flow
        if stage.rollouts > 0:  # resumed after its iterations, which may have ended early
            return True
        if self.family.alone and len(stage.began) == stage.attempt + stage.coolings:
            noisy = int(flow.iterations) if noise_at(flow, 0) > 0.0 else 0
            if self.recorder is not None:
                self.recorder.begin()
            self.stage = replace(stage, began=(*stage.began, (stage.done, stage.done + noisy)))
            self._record()
        total = flow.iterations + self.settings.after
        before = self.stage.done - self.stage.step if self.family.alone else 0
        try:
            while self.stage.step < total and self._waits():
                stage, now = self.stage, self.stage.now
                stop = self._next_report(total)
                state, info = self._iterated(now.state, stage.step, stop)
                if self._thins_out:
                    moving = np.flatnonzero(self.decisions.moving(state))
                    if len(moving) <= self.few * self.chains:
                        state, info = self._go_on(state, info, moving, stop, total)
                        stop = total
                if stage.attempt == stage.place == stage.step == 0:
                    died_at = on_host(state.died_at, self.mesh)
                    if (died_at == 0).all():
                        knots = gathered(now.state.trajectory, self.mesh)
                        require_sound(flow, self.family.at(0), knots)
                feasible = info.max_defect < FEASIBLE
                since = np.where(now.feasible_since < 0, before + stop, now.feasible_since)
                asked = stage.step % self._usual_report(total) == 0
                costs = now.sound_cost if asked else stage.before
                now = Chains.of(state, info, np.where(feasible, since, -1))
                self._report(replace(stage, now=now, before=costs, step=stop), before + stop)
                if self._too_hot:
                    self.stage = replace(self.stage, coolings=self.stage.coolings + 1)
                    self._begin_chunk()
                    return self._iterate()
                if not on_host(state.alive, self.mesh).any():
                    self._require_some(now)
                    break
        except KeyboardInterrupt:  # the chains as they were at the last report
            return False
        return True

    @property
    def _too_hot(self) -> bool:
        """Whether noise has thrown most chains of a single problem far away, and could be less."""
        stage = self.stage
        noisy = stage.heated and self.settings.descent is not None
        if not (noisy and self.family.alone and stage.step <= self.flow.iterations):
            return False
        first, now = (np.asarray(info.max_defect) for info in (stage.records[0][1], stage.now.info))
        far = FAR * max(float(median(first)), FAR)
        return stage.coolings < MOST_COOLINGS and bool((~(now < far)).mean() > 0.5)

    def _require_some(self, now: Chains) -> None:
        """Complain where all chains of a first attempt died, and none of them is an answer."""
        if self.family.alone and self.stage.attempt == 0 and not now.feasible.any():
            knots = gathered(now.state.trajectory, self.mesh)
            died_at = on_host(now.state.died_at, self.mesh)
            require_alive(self.flow, self.family.at(0), replace(knots, slack=None), died_at)

    def _waits(self) -> bool:
        """Whether to go on with an attempt; see `Decisions.waits`.

        It depends on the chains alone, and is asked at the usual reports only, so solves that are
        resumed or recorded end where others do. A batch is not asked: answers would depend on what
        else is in it.
        """
        stage, noisy = self.stage, self.flow.iterations
        usual = self._usual_report(noisy + self.settings.after)
        polished = self.decisions.polish is not None and stage.step > noisy
        if not (polished and self.family.alone and stage.step % usual == 0):
            return True
        return self.decisions.waits(stage, self.indices, usual, self.places(stage.attempt + 1))

    def _usual_report(self, total: int) -> int:
        """Iterations between two reports of an attempt of so many."""
        return max(REPORT_EVERY, total // 100)

    def _next_report(self, total: int) -> int:
        """After which of an attempt's iterations the next report is, or the next look at a batch.

        Nobody is told of a batch before a chunk is done: a look is for what has left its place.
        """
        step, every = self.stage.step, self._usual_report(total)
        if not self.family.alone:
            first = self.flow.iterations + every
            return min(max(step + every, first), total) if self._thins_out else total
        if self.recorder is not None:
            every = min(every, self.recorder.every)
        return min(step - step % every + every, total)

    @property
    def _thins_out(self) -> bool:
        """Whether what still moves when most are done goes on in the second program."""
        return 0 < self.few < self.width

    def _go_on(
        self, state: State, info: Info, rows: np.ndarray, start: int, stop: int
    ) -> tuple[State, Info]:
        """Iterations start..stop-1 of those rows alone, in the second program, if there are any."""
        if not len(rows):
            return state, info
        places = np.full(self.few * self.chains, len(state.alive))  # beyond the end: a copy, unused
        places[: len(rows)] = rows
        mine = taken((state, self.question[1]), places)
        moved, found = self.launch(mine, start, stop)

        def updated(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            both = np.array(old)
            both[rows] = new[: len(rows)]
            return both

        return put_back(state, moved, places), jax.tree.map(updated, info, on_host(found, None))

    # Rollouts

    @property
    def _replayer(self) -> Replayer:
        """What replays the chunk's chains."""
        indices, places = self.indices, len(self.stage.now.missed) // self.width
        floor = np.repeat(self.stage.floor[indices], places)

        def diagnosed(state: State) -> tuple[State, Info]:
            state, info = self._iterated(state, 0, 0)  # compiled already
            return gathered(state, self.mesh), info

        return Replayer(self.family, indices, self.question, floor, diagnosed)

    def _roll_out(self) -> bool:
        """The rollouts that follow an attempt; False if they are interrupted. See `Rollouts`.

        Without any, plans tell which chains miss the goal.
        """
        rollouts, stage = self.settings.rollouts, self.stage
        assert rollouts is not None
        if not rollouts.asked:
            if self.family.problem.goal is not None:
                now, least = self._judged(stage.now), stage.least
                if self.family.alone:
                    costs = np.where(now.feasible, now.cost, np.inf) - stage.floor[0]
                    least = np.minimum(least, costs.min())
                self.stage = replace(stage, now=replace(stage.now, missed=now.missed), least=least)
            return True
        now, fresh = self._whole(stage.now), True
        if self.guess is not None and stage.attempt == stage.rollouts == 0:
            # The attempt may have lost contacts of the guess: rollouts then start from the guess
            everyone = np.arange(len(now.missed))
            guessed = self._replayer.rolled_out(self._guessed(), everyone, 0.0, stage.done)
            now, better = self._no_worse(now, guessed)
            fresh = not better.any()
        try:
            begun = rounds.begun(replace(stage, now=now), rollouts, self._replayer, fresh)
            if begun.rollouts == rollouts.total:
                return True
            self.stage = begun
            while self.stage.rollouts < rollouts.total:
                if self.stage.rollouts < rollouts.first:
                    self.stage = rounds.rolled_out(self.stage, self._replayer)
                elif self.stage.rollouts == rollouts.shoot_at:
                    self._shoot(rollouts)
                else:
                    done = self.stage.done + rollouts.iterations
                    again = partial(self._again_with, iterations=rollouts.iterations)
                    after = rounds.after_round(self.stage, rollouts, self._replayer, again)
                    self._report(after, done)
        except KeyboardInterrupt:
            return False
        return True

    def _shoot(self, rollouts: Rollouts) -> None:
        """Random shooting; what it has found is kept where it is interrupted."""

        def tell(stage: Stage) -> None:
            self._tell(stage, stage.done)

        self.stage, ended = rounds.shot(self.stage, rollouts, self._replayer, self.seed, tell)
        if not ended:
            raise KeyboardInterrupt

    def _again_with(self, damping: np.ndarray, iterations: int) -> tuple[State, Info]:
        """States and diagnostics after the last iterations of an attempt again, damped so (rows,).

        The states are on one device.
        """
        state, end = self.stage.now.state, self.flow.iterations + self.settings.after
        damped = replace(state, damping=jnp.asarray(damping, state.damping.dtype))
        state, info = self._iterated(damped, end - iterations, end)
        return gathered(state, self.mesh), info

    # Reports, recordings, checkpoints

    def _report(self, stage: Stage, done: int) -> None:
        """Go on to that stage, after `done` iterations: record it, keep it and tell."""
        if self.family.alone:
            stage = replace(stage, records=(*stage.records, (done, self._best(stage.now))))
        self.stage = stage
        self._record()
        self._save()
        self._tell(stage, done)

    def _tell(self, stage: Stage, done: int) -> None:
        """Tell how far it is; after `seconds` raise KeyboardInterrupt: what there is stays."""
        if self.progress is not None:
            begun = done - stage.step + self.flow.iterations + self.settings.after
            self.progress(done, max(begun, done), stage.now.info)
        if time.perf_counter() - self.started > self.seconds:
            raise KeyboardInterrupt

    def _record(self) -> None:
        """Record knots too, if asked for."""
        if self.recorder is not None:
            stage, now = self.stage, self.stage.now
            knots = gathered(now.state.trajectory, self.mesh)
            sigma = noise_at(self.flow, stage.step)
            self.recorder.take(self.family.problem, sigma, stage.done, knots, now.info)

    def _compile_the_rest(self) -> None:
        """What would else be compiled while the clock runs."""
        now, settings = self.stage.now, self.settings
        if settings.attempts > 1 and self.family.alone:
            chains = np.arange(self.chains)
            kept = now if len(now.missed) == self.chains else now.at(chains)
            if len(self._again) > self.chains:
                kept.at(self._again)
            gather((kept.state, kept.info), (now.state, now.info), chains)
        if self.recorder is not None:
            knot_defects(self.family.problem, now.state.trajectory)
        if self.family.alone:
            noise_at(self.flow, 0)

    def _require(self, checkpoint: Checkpoint) -> None:
        """Complain now about a checkpoint of another question, or one that cannot be written."""
        family, recorder, settings = self.family, self.recorder, self.settings
        known = facts(family.problem, self.chains, self.seed, to_data(settings))
        if family.alone:
            what = {"call": "solve", "record": None if recorder is None else recorder.every}
        else:
            what = {"call": "solve_batch", "problems": family.count, "chunk": self.size}
        checkpoint.require({**what, **known})
        problem, rows = family.problem, self.size * self.places(settings.attempts - 1)
        nx, nu, dtype = problem.dynamics.nx, problem.dynamics.nu, problem.x_init.dtype
        ones = Scale(np.ones(self.size), np.ones(self.size))
        none = np.zeros(self.size, int)
        shared, own = family.question(settings.flow, ones, none, self.chains, self.decisions.polish)

        def state() -> State:
            x, u = (jnp.zeros((rows, problem.horizon, n), dtype) for n in (nx, nu))
            return begin(own, shared, family.at(0).started(Trajectory(x, u)), jax.random.key(0))

        def size(tree: Any) -> int:
            return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))

        whole, kept = jax.eval_shape(state), family.count * self.chains / rows
        more = settings.rollouts.rounds if settings.rollouts else 0
        reports = settings.attempts * (100 + more) if family.alone else 1
        recording = 0
        if recorder is not None:
            reports += settings.iterations // recorder.every
            snapshots = reports * rows * (nx + 2) * problem.horizon * dtype.itemsize
            recording = min(LIMIT, snapshots)
        checkpoint.require_room(
            int((1 + kept) * size(whole)) + reports * 3 * rows * dtype.itemsize + recording
        )

    def _resume(self) -> tuple[float, bool]:
        """Go on from a checkpoint; how long solving took so far, and whether it ended."""
        checkpoint, stage = self.checkpoint, self.stage
        if checkpoint is None:
            return 0.0, False
        state, tail = stage.now.state, self.settings.after > 0
        checkpoint.require({"initial knots": digest(state.trajectory)})
        shared, own = self.question
        functions = iterate.identity((state, own), shared, start=0, stop=0, tail=tail)
        checkpoint.require({"functions": digest(functions)})
        if checkpoint.found is None:
            return 0.0, False
        if self.family.alone and "stage.kept.feasible_since" in checkpoint.found:
            self.stage = replace(stage, kept=stage.now)
        saved = checkpoint.restored(self._saved(0.0, False))
        iterations, infos = saved["iterations"].tolist(), saved["infos"]
        records = [
            (n, jax.tree.map(lambda rows, i=i: rows[i], infos)) for i, n in enumerate(iterations)
        ]
        began = tuple((int(a), int(b)) for a, b in saved["began"])
        self.stage = stage = replace(saved["stage"], records=tuple(records), began=began)
        if self.recorder is not None:
            self.recorder.restore(saved["recorder"])
        if not saved["ended"]:
            self._settle(stage.attempt, stage.heated, self.indices, stage.cost_scale)
            rows = len(stage.now.missed)
            if self.family.alone or rows == len(state.alive):
                self._compile(state)
            if self.family.alone and rows > len(state.alive):
                self._iterated(stage.now.state, 0, 0)
        return saved["solve_time"], saved["ended"]

    def _saved(self, solve_time: float, ended: bool) -> dict[str, Any]:
        """What a checkpoint holds."""
        stage, recorder = self.stage, self.recorder
        iterations, infos = zip(*stage.records, strict=True)
        return {
            "stage": replace(stage, records=(), began=()),
            "iterations": np.array(iterations),
            "infos": jax.tree.map(lambda *rows: np.stack(rows), *infos),
            "began": np.array(stage.began, int),
            "recorder": None if recorder is None else recorder.saved(),
            "solve_time": solve_time,
            "ended": ended,
        }

    def _save(self, ended: bool = False, now: bool = False) -> None:
        """Write a checkpoint, if one is asked for and it is time to."""
        if self.checkpoint is not None:
            solve_time = time.perf_counter() - self.clock
            self.checkpoint.save(lambda: self._saved(solve_time, ended), now)
