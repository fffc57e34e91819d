"""Many states of a model, stepped side by side by MuJoCo's C engine."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from copy import copy
from typing import Any, Self

import numpy as np

from mjx_drax.physics.c_engine.states import Floats, converged, quiet
from mjx_drax.physics.engine import Rollout, mujoco

CHAINS_PER_THREAD = 8
"""Chains that a thread replays. Threads wait for each other at every knot, which takes longer than
a few steps do: for 64 chains of a hopper on two cores, 64 threads took five times as long as one.
"""

_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""What a step of the C engine starts from: time, state, and what actuators and plugins remember."""


class Stepper:
    """States (chains, nx) that advance together, `substeps` physics steps for each knot.

    The constraint solver converges, whatever the options of the model are; see `CONVERGED`. It
    starts without a guess at each knot, so that a state depends on the one before and on the
    control alone. A state that diverges is NaN from then on.
    """

    def __init__(
        self, model: mujoco.MjModel, substeps: int, x: Floats, idle: list[mujoco.MjData]
    ) -> None:
        """Start at states (chains, nx).

        Args:
            model: what is stepped.
            substeps: steps for each knot.
            x: states (chains, nx).
            idle: data of this model that nothing uses: a thread takes its own from here, and what
                is missing is made, which takes a millisecond or two. All of it comes back.
        """
        chains, nx = x.shape
        self.substeps, self._x = substeps, slice(1, 1 + nx)
        model = converged(model)
        self._models = [model] * chains
        self._own = False
        self._threads = min(-(-chains // CHAINS_PER_THREAD), os.cpu_count() or 1)
        self._idle, self._workers = idle, [_taken(idle, model) for _ in range(self._threads)]
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
        self._idle += self._workers

    def configure(self, timesteps: Floats | None, numbers: Mapping[str, Floats]) -> None:
        """Give every chain a timestep [s] (chains,) and numbers of the model (chains, ...)."""
        if not self._own:
            self._models, self._own = [copy(model) for model in self._models], True
        for i, model in enumerate(self._models):
            if timesteps is not None:
                model.opt.timestep = self._timesteps[i] = timesteps[i]
            for name, values in numbers.items():
                getattr(model, name)[...] = values[i].reshape(getattr(model, name).shape)

    def __call__(self, u: Floats) -> tuple[Floats, Floats]:
        """The next states (chains, nx) under controls (chains, nu), and the controls applied."""
        sound, now = self._sound, self._now
        sound &= (np.abs(u) < mujoco.mjMAXVAL).all(axis=1)
        now[~sound] = self._start  # a state that can be stepped; its result is not used
        control, applied = np.where(sound[:, None], u, 0.0), np.where(sound[:, None], u, np.nan)
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
        self._now = now = self._steps[:, -1].copy()
        self._elapsed += self.substeps * self._timesteps
        sound &= (np.abs(now) < mujoco.mjMAXVAL).all(axis=1)
        # The engine resets a state that diverges, and its time: it falls behind
        sound &= now[:, 0] > self._elapsed - 0.5 * self._timesteps
        return np.where(sound[:, None], now[:, self._x], np.nan), applied


def _taken(idle: list[mujoco.MjData], model: mujoco.MjModel) -> mujoco.MjData:
    """Data of the model as it is when it is made, from the list if there is any."""
    try:
        data = idle.pop()  # which no other thread can take, too
    except IndexError:
        return mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    return data
