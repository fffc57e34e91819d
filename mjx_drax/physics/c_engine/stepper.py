"""Many states of a model, stepped side by side by MuJoCo's C engine."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.physics.c_engine.model_numbers import scratch_of, set_numbers
from mjx_drax.physics.c_engine.states import Floats, converged, quiet
from mjx_drax.physics.engine import Rollout, mujoco

WORTH_A_THREAD = 1e-4
"""Work at a knot [s] that is worth a thread: threads wait for each other at every knot. On 16 cores
32 chains of a hopper took 0.32 ms by one thread, 0.16 by four and 0.24 by sixteen."""

CHAINS_PER_THREAD = 8
"""Chains that a thread replays before it is known how long a knot takes."""

CHUNKS = 4
"""Parts of its share that a thread takes one after the other: none waits long for the slowest."""

AT_ONCE = 2**25
"""Numbers of physics steps that are held at a time, where many knots are stepped in one call."""

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""What a step of the C engine starts from: time, state, and what actuators and plugins remember."""


@dataclass
class Spare:
    """What steppers of one model and one number of substeps leave for the next.

    Attributes:
        data: data of the C engine that nothing uses; to make one takes a millisecond or two.
        seconds: that a knot of one chain takes, the shortest seen.
        model: theirs, `converged`; a copy of one with meshes takes long.
    """

    data: list[mujoco.MjData] = field(default_factory=list)
    seconds: float = math.inf
    model: mujoco.MjModel | None = None

    def threads(self, chains: int, knots: int = 1) -> int:
        """How many threads replay so many chains, and wait after so many knots."""
        wanted = chains * knots / CHAINS_PER_THREAD
        if math.isfinite(self.seconds):
            wanted = chains * knots * self.seconds / WORTH_A_THREAD
        return min(math.ceil(wanted), chains, cores())


def cores() -> int:
    """How many CPU cores this process may use: a job's share of a cluster's node, for example."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS, Windows


class Stepper:
    """States (chains, nx) that advance together, `substeps` physics steps for each knot.

    The constraint solver converges, whatever the options of the model are; see `CONVERGED`. In a
    call it starts without a guess, so that a state depends on the one before and on the control
    alone; `run` takes all knots at once. A state that diverges is NaN from then on.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        x: Floats,
        spare: Spare | None = None,
        knots: int = 1,
    ) -> None:
        """Start at states (chains, nx).

        Args:
            model: what is stepped.
            substeps: steps for each knot.
            x: states (chains, nx).
            spare: of steppers before; this one's goes there, too.
            knots: after which threads wait for each other: 1 for calls, K for `run`.
        """
        chains, nx = x.shape
        self.substeps, self._x = substeps, slice(1, 1 + nx)
        self._spare = spare = spare or Spare()
        spare.model = model = converged(model) if spare.model is None else spare.model
        self._models = [model] * chains
        self._own = False
        self._threads = spare.threads(chains, knots)
        self._workers = [_taken(spare.data, model) for _ in range(self._threads)]
        self._start = np.empty(mujoco.mj_stateSize(model, _FULL_PHYSICS))
        mujoco.mj_getState(model, self._workers[0], self._start, _FULL_PHYSICS)
        self._now, self._sound = np.tile(self._start, (chains, 1)), np.ones(chains, bool)
        self._now[:, self._x] = x
        self._steps = np.empty((chains, substeps, len(self._start)))
        self._timesteps, self._elapsed = np.full(chains, model.opt.timestep), np.zeros(chains)
        self._open = ExitStack()

    def __enter__(self) -> Self:
        """Start the threads."""
        self._open.enter_context(quiet())
        threads = self._threads if self._threads > 1 else 0
        self._engine = self._open.enter_context(Rollout(nthread=threads))
        return self

    def __exit__(self, *_: Any) -> None:
        """End them."""
        self._open.close()
        self._spare.data += self._workers

    def configure(self, timesteps: Floats | None, numbers: Mapping[str, Floats]) -> None:
        """Give every chain a timestep [s] (chains,) and numbers of the model (chains, ...)."""
        if not self._own:
            self._models, self._own = [copy(model) for model in self._models], True
        scratch = scratch_of(self._models[0]) if numbers else None
        for i, model in enumerate(self._models):
            if timesteps is not None:
                model.opt.timestep = self._timesteps[i] = timesteps[i]
            if scratch is not None:
                try:
                    set_numbers(model, {name: of[i] for name, of in numbers.items()}, scratch)
                except DraxError:  # as of a mass of zero: other chains go on
                    self._sound[i] = False

    def __call__(self, u: Floats) -> tuple[Floats, Floats]:
        """The next states (chains, nx) under controls (chains, nu), and the controls applied."""
        sound, now = self._sound, self._now
        sound &= (np.abs(u) < mujoco.mjMAXVAL).all(axis=1)
        now[~sound] = self._start  # a state that can be stepped; its result is not used
        control, applied = np.where(sound[:, None], u, 0.0), np.where(sound[:, None], u, np.nan)
        began = time.perf_counter()
        self._engine.rollout(
            self._models,
            self._workers,
            now,
            np.repeat(control[:, None], self.substeps, axis=1),
            nstep=self.substeps,
            state=self._steps,
            chunk_size=-(-len(u) // self._threads),
            skip_checks=True,
        )
        self._took(time.perf_counter() - began, len(u))
        self._now = now = self._steps[:, -1].copy()
        self._elapsed += self.substeps * self._timesteps
        sound &= (np.abs(now) < mujoco.mjMAXVAL).all(axis=1)
        # The engine resets a state that diverges, and its time: it falls behind
        sound &= now[:, 0] > self._elapsed - 0.5 * self._timesteps
        return np.where(sound[:, None], now[:, self._x], np.nan), applied

    def run(self, u: Floats) -> tuple[Floats, Floats]:
        """The states (chains, K, nx) after each knot under controls (chains, K, nu), and these.

        From where the chains are; nothing can follow. Threads need not wait for each other between
        knots, and the constraint solver starts from the forces of the step before, which saves it
        iterations.
        """
        (chains, K, _), n = u.shape, self.substeps
        given = (np.abs(u) < mujoco.mjMAXVAL).all(axis=2)
        given[:, 0] &= self._sound & np.isfinite(self._now[:, self._x]).all(axis=1)
        given = np.logical_and.accumulate(given, axis=1)
        self._now[~given[:, 0]] = self._start
        control = np.where(given[..., None], u, 0.0)
        states = np.empty((chains, K, len(self._start)))
        few = max(1, AT_ONCE // (K * n * len(self._start)))
        for rows in (slice(i, i + few) for i in range(0, chains, few)):
            began, count = time.perf_counter(), len(control[rows])
            steps = np.empty((count, K * n, len(self._start)))
            self._engine.rollout(
                self._models[rows],
                self._workers,
                self._now[rows],
                np.repeat(control[rows], n, axis=1),
                nstep=K * n,
                state=steps,
                chunk_size=max(1, count // (CHUNKS * self._threads)),
                skip_checks=True,
            )
            self._took(time.perf_counter() - began, count * K)
            states[rows] = steps[:, n - 1 :: n]
        elapsed = (np.arange(1, K + 1) * n - 0.5) * self._timesteps[:, None]
        sound = given & (np.abs(states) < mujoco.mjMAXVAL).all(axis=2) & (states[..., 0] > elapsed)
        sound = np.logical_and.accumulate(sound, axis=1)
        before = np.concatenate([given[:, :1], given[:, 1:] & sound[:, :-1]], axis=1)
        x = np.where(sound[..., None], states[..., self._x], np.nan)
        return x, np.where(before[..., None], u, np.nan)

    def _took(self, seconds: float, knots: int) -> None:
        """Remember how long a knot of one chain takes."""
        took = seconds * self._threads / knots
        self._spare.seconds = min(self._spare.seconds, took)


def _taken(spare: list[mujoco.MjData], model: mujoco.MjModel) -> mujoco.MjData:
    """Data of the model as it is when it is made, from the list if there is any."""
    try:
        data = spare.pop()  # which no other thread can take, too
    except IndexError:
        return mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    return data
