"""Planning beside the robot: a thread makes plans, the newest is applied as soon as it is there.

Compiled code runs without Python's lock, so the control loop keeps its pace meanwhile.
"""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import ArrayLike

from mjx_drax.control.mpc import MPC


class Background:
    """A policy whose plans are made in a thread, each from the newest state.

    >>> with mjx_drax.Background(policy) as newest:
    ...     u = newest(x, t)  # returns at once: feedback along the newest plan

    A plan that took a while begins in the past; its feedback is applied at the present time.
    """

    def __init__(self, policy: MPC) -> None:
        """The policy must have been reset, so that there is a plan."""
        policy.latest  # noqa: B018 complains if there is none
        self.policy = policy
        self._wanted = threading.Condition()
        self._newest: tuple[np.ndarray, float] | None = None
        self._error: BaseException | None = None
        self._open, self._told = True, False
        self._thread = threading.Thread(target=self._work, daemon=True, name="mpc")

    def __enter__(self) -> Background:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait for the plan in the making, and end the thread; raise what it failed with, once."""
        with self._wanted:
            self._open = False
            self._wanted.notify()
        self._thread.join()
        if kind is None and not self._told:
            self._require_working()

    def __call__(self, x: ArrayLike, t: float) -> np.ndarray:
        """The control (nu,) at time t [s] for the state x (nx,); the thread plans from them next.

        Raises:
            DraxError: x or t is wrong, as for `MPC.control`; planning goes on.
            RuntimeError: planning failed; its cause is the error.
        """
        self._require_working()
        x = np.array(x, float)
        u = self.policy.control(x, t)
        self.policy.due(t)  # complains about a time before the plan, here and not in the thread
        if np.isfinite(x).all():
            with self._wanted:
                self._newest = x, t
                self._wanted.notify()
        return u

    def _require_working(self) -> None:
        if self._error is not None:
            self._told = True
            raise RuntimeError("the planner's thread has failed") from self._error

    def _work(self) -> None:
        while True:
            with self._wanted:
                self._wanted.wait_for(lambda: self._newest is not None or not self._open)
                if not self._open:
                    return
                newest, self._newest = self._newest, None
            assert newest is not None
            try:
                if self.policy.due(newest[1]):
                    self.policy.plan(*newest)
            except BaseException as error:  # the caller is told at its next call
                self._error = error
                return
