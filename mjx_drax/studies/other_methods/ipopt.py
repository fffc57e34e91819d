"""Direct transcription with CasADi and IPOPT, from many random starts.

    min  phi(x_K) + sum_k l(x_k, u_k)    over x_1..x_K, u_0..u_{K-1}
    s.t. f(x_k, u_k) - x_{k+1} = 0,  bounds on x and u

the same transcription as `mjx_drax.problem`, with exact first and second derivatives in float64.
CasADi cannot read JAX functions, so the tasks that are written as functions are written here once
more; a test holds them against the originals.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import require
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

require_casadi = partial(require, "casadi", "peers", "IPOPT")
"""Complains if casadi is not installed."""

OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 3000},
}


@dataclass(frozen=True)
class Functions:
    """f(x, u), l(x, u) and phi(x) on CasADi symbols."""

    step: Callable[[Any, Any], Any]
    running: Callable[[Any, Any], Any]
    terminal: Callable[[Any], Any]


@dataclass(frozen=True)
class Start:
    """Where IPOPT ended: u (K, nu), cost, max|h|, and the time that it took [s]."""

    u: np.ndarray
    cost: float
    max_defect: float
    seconds: float


class Transcription:
    """A problem as a nonlinear program that can be solved from many guesses.

    Raises:
        DraxError: casadi is not installed, or the problem is not written for it.
    """

    def __init__(self, problem: Problem) -> None:
        require_casadi()
        import casadi

        if problem.name not in FUNCTIONS:
            raise DraxError(
                f"{problem.name} is not written for CasADi: choose one of {', '.join(FUNCTIONS)}, "
                "or add its functions to mjx_drax/studies/other_methods/ipopt.py."
            )
        functions = FUNCTIONS[problem.name](casadi)
        self.problem = problem
        K, nx, nu = problem.horizon, problem.dynamics.nx, problem.dynamics.nu
        start = casadi.SX.sym("x0", nx)
        x, u = casadi.SX.sym("x", nx, K), casadi.SX.sym("u", nu, K)
        before = casadi.horzcat(start, x[:, :-1])
        cost = functions.terminal(x[:, K - 1])
        defects = []
        for k in range(K):
            cost = cost + functions.running(before[:, k], u[:, k])
            defects.append(functions.step(before[:, k], u[:, k]) - x[:, k])
        z = casadi.vertcat(casadi.vec(x), casadi.vec(u))
        h = casadi.vertcat(*defects)
        self._evaluate = casadi.Function("evaluate", [z, start], [cost, h])
        self._solver = casadi.nlpsol(
            "ipopt", "ipopt", {"x": z, "f": cost, "g": h, "p": start}, OPTIONS
        )

    def evaluate(
        self, trajectory: Trajectory, x_init: ArrayLike | None = None
    ) -> tuple[float, np.ndarray]:
        """Cost, and defects h (K, nx), of knots (K, nx) and (K, nu)."""
        cost, h = self._evaluate(_flat(trajectory), self._start(x_init))
        return float(cost), h.full().reshape(self.problem.horizon, -1)

    def solve(self, guess: Trajectory, x_init: ArrayLike | None = None) -> Start:
        """Solve from initial knots (K, nx) and (K, nu), and from x_init instead of the problem's.

        The time is that of IPOPT alone: building and differentiating the program is done before.
        """
        lower, upper = (_flat(side) for side in self.problem.bounds.sides(guess))
        start = self._start(x_init)
        clock = time.perf_counter()
        result = self._solver(x0=_flat(guess), lbx=lower, ubx=upper, lbg=0.0, ubg=0.0, p=start)
        seconds = time.perf_counter() - clock
        cost, h = self._evaluate(result["x"], start)
        u = result["x"].full().ravel()[guess.x.size :].reshape(guess.u.shape)
        return Start(u, float(cost), float(np.abs(h.full()).max()), seconds)

    def multistart(self, starts: int, seed: int, x_init: ArrayLike | None = None) -> list[Start]:
        """Solve from random knots, drawn as the solver's chains draw theirs."""
        keys = jax.random.split(jax.random.key(seed), starts)
        return [self.solve(self.problem.draw(key), x_init) for key in keys]

    def _start(self, x_init: ArrayLike | None) -> np.ndarray:
        return np.asarray(self.problem.x_init if x_init is None else x_init, float)


def has_casadi() -> bool:
    """Whether IPOPT can be asked."""
    return find_spec("casadi") is not None


def _flat(trajectory: Trajectory) -> np.ndarray:
    """[x_1, .., x_K, u_0, .., u_{K-1}], all in one vector."""
    return np.concatenate([np.ravel(trajectory.x), np.ravel(trajectory.u)]).astype(float)


def _pendulum(casadi: Any) -> Functions:
    dt = tasks.load("pendulum").DT
    return Functions(
        lambda x, u: x + dt * casadi.vertcat(x[1], u + 9.81 * casadi.sin(x[0])),
        lambda x, u: 0.01 * dt * u**2,
        lambda x: 10.0 * x[0] ** 2 + x[1] ** 2,
    )


def _trap(casadi: Any, wall: np.ndarray) -> Functions:
    task = tasks.load("bug_trap")
    dt, goal, centres = task.DT, casadi.DM(task.GOAL), [casadi.DM(c) for c in wall]

    def step(x: Any, u: Any) -> Any:
        return x + dt * casadi.vertcat(u[0] * casadi.cos(x[2]), u[0] * casadi.sin(x[2]), u[1])

    def running(x: Any, u: Any) -> Any:
        bumps = sum(casadi.exp(-5.0 * casadi.sumsqr(x[:2] - centre)) for centre in centres)
        return dt * (casadi.sumsqr(u) + 1000.0 * bumps)

    return Functions(step, running, lambda x: 10.0 * casadi.sumsqr(x[:2] - goal))


FUNCTIONS: dict[str, Callable[[Any], Functions]] = {
    "pendulum": _pendulum,
    "bug_trap": lambda casadi: _trap(casadi, tasks.load("bug_trap").WALL),
    "deep_trap": lambda casadi: _trap(casadi, tasks.load("deep_trap").WALL),
}
"""The tasks that IPOPT can be asked to solve."""
