"""Any smooth problem as a nonlinear program for IPOPT, with exact derivatives by JAX.

    min  phi(x_K) + sum_k l(x_k, u_k)    over x_1..x_K, u_0..u_{K-1}, all in one vector z
    s.t. f(x_k, u_k) - x_{k+1} = 0,  h = 0,  g <= 0,  bounds on x and u

Where x_0 is free, z also has `Trajectory.start` (n0,), which x_0 is linear in. The program of
`problem`, in numbers of states: a quaternion counts as four. Jacobian and Hessian of
the Lagrangian are given by blocks, one for each stage. Use it under `jax_enable_x64`; in float32
IPOPT does not get to its tolerance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Knot, Trajectory
from mjx_drax.studies.other_methods.ipopt import require_casadi

OPTIONS = {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 500}
"""IPOPT's; all others are its defaults."""


@dataclass(frozen=True)
class Answer:
    """What IPOPT says: knots, iterations, cost, largest |constraint|, and its status in words."""

    knots: Trajectory
    iterations: int
    cost: float
    max_defect: float
    status: str

    @property
    def solved(self) -> bool:
        """Whether IPOPT's tolerance was reached."""
        return self.status == "Solve_Succeeded"


def solve(problem: Problem, guess: Trajectory) -> Answer:
    """IPOPT, if casadi is installed, from initial knots, x (K, nx) and u (K, nu)."""
    require_casadi()
    import casadi

    program = Program(problem)
    z0 = program.flat(guess)
    lower, upper = (program.flat(side) for side in problem.bounds.sides(guess))
    values = _callback("values", program.values, program.sizes["x"], [1, program.rows])
    x, p = casadi.MX.sym("x", program.size), casadi.MX.sym("p", 0)
    cost, constraints = values(x, p)
    parts = {
        "grad_f": _callback(
            "grad_f",
            lambda z: (program.values(z)[0], program.gradient(z)),
            program.sizes["x"],
            [1, program.size],
        ),
        "jac_g": _callback(
            "jac_g",
            lambda z: (program.values(z)[1], program.jacobian(z)),
            program.sizes["x"],
            [program.rows, program.jacobian_pattern.casadi((program.rows, program.size))],
        ),
        "hess_lag": _callback(
            "hess_lag",
            lambda z, weight, forces: (program.hessian(z, weight, forces),),
            program.sizes["lagrangian"],
            [program.hessian_pattern.casadi((program.size, program.size))],
        ),
    }
    nlp = {"x": x, "p": p, "f": cost, "g": constraints}
    solver = casadi.nlpsol(
        "ipopt", "ipopt", nlp, parts | {"print_time": False, "no_nlp_grad": True, "ipopt": OPTIONS}
    )
    low = np.where(program.is_equality, 0.0, -np.inf)
    found = solver(x0=z0, lbx=lower, ubx=upper, lbg=low, ubg=0.0)
    stats = solver.stats()
    z = found["x"].full().ravel()
    cost, h = program.values(z)
    return Answer(
        program.knots(z),
        int(stats["iter_count"]),
        float(cost),
        float(np.abs(np.maximum(h, np.where(program.is_equality, h, 0.0))).max(initial=0.0)),
        str(stats["return_status"]),
    )


def _callback(
    name: str, function: Callable[..., Any], inputs: list[Any], outputs: list[Any]
) -> Any:
    """A CasADi function of (z, p, ...) that calls `function` without p.

    Args:
        function: takes and returns numpy arrays; of a sparse matrix, its nonzero entries.
        inputs: the sizes of its arguments.
        outputs: sizes, or sparsity patterns.
    """
    import casadi

    def pattern(size: Any) -> Any:
        return casadi.Sparsity.dense(size, 1) if isinstance(size, int) else size

    class Call(casadi.Callback):
        """Numbers in, numbers out."""

        def __init__(self) -> None:
            casadi.Callback.__init__(self)
            self.construct(name)

        def get_n_in(self) -> int:
            return len(inputs)

        def get_n_out(self) -> int:
            return len(outputs)

        def get_sparsity_in(self, i: int) -> Any:
            return pattern(inputs[i])

        def get_sparsity_out(self, i: int) -> Any:
            return pattern(outputs[i])

        def eval(self, given: Any) -> Any:
            z, _, *rest = (entry.full().ravel() for entry in given)
            made = zip(outputs, function(z, *rest), strict=True)
            return [casadi.DM(pattern(size), np.ravel(out)) for size, out in made]

    return Call()


class Pattern:
    """Where the entries of a sparse matrix are, when they come with repetitions.

    Args:
        rows: of each entry, any shape.
        columns: the same shape.
        keep: entries that count; the others are dropped.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, keep: np.ndarray) -> None:
        self.keep = keep.ravel()
        pairs = np.stack([columns.ravel(), rows.ravel()])[:, self.keep]
        (self.columns, self.rows), self.place = np.unique(pairs, axis=1, return_inverse=True)
        self.place = self.place.ravel()

    def summed(self, entries: np.ndarray) -> np.ndarray:
        """The entries column by column; those at the same place are added."""
        return np.bincount(self.place, entries.ravel()[self.keep], len(self.rows))

    def casadi(self, shape: tuple[int, int]) -> Any:
        """The same as CasADi writes it."""
        import casadi

        return casadi.Sparsity.triplet(*shape, self.rows.tolist(), self.columns.tolist())


class Program:
    """The functions of the nonlinear program, in numpy arrays of float64.

    Attributes:
        size: numbers in z = [x_1, .., x_K, u_0, .., u_{K-1}, start].
        rows: of all constraints: defects, those of the stages, those of the end.
        is_equality: which of them are equalities, (rows,).
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        K, nx, nu = problem.horizon, problem.dynamics.nx, problem.dynamics.nu
        stage, end = problem.constraint, problem.terminal_constraint
        self.size = K * (nx + nu) + len(problem.free)
        self.rows = K * (nx + stage.rows) + end.rows
        self.sizes = {"x": [self.size, 0], "lagrangian": [self.size, 0, 1, self.rows]}
        of_stage = np.arange(stage.rows) < stage.equalities
        of_end = np.arange(end.rows) < end.equalities
        self.is_equality = np.concatenate([np.ones(K * nx, bool), np.tile(of_stage, K), of_end])
        # Columns of (x_k, u_k) in z; -1 for what is given of x_0. An entry of `start` may move
        # several entries of x_0: these share its column, in which `Pattern` adds them up.
        states = np.arange(-nx, (K - 1) * nx).reshape(K, nx)
        states[0] = -1
        entry = np.asarray(problem.dynamics.tangent(jnp.arange(nx)))
        for i, places in enumerate(problem.free):
            states[0, entry[list(places)]] = K * (nx + nu) + i
        controls = K * nx + np.arange(K * nu).reshape(K, nu)
        self.columns = np.concatenate([states, controls], axis=1)
        self.last = np.arange((K - 1) * nx, K * nx)

    # One vector, and knots

    def flat(self, knots: Trajectory) -> np.ndarray:
        """z of knots."""
        start = () if knots.start is None else knots.start
        return np.concatenate([np.ravel(knots.x), np.ravel(knots.u), start]).astype(float)

    def knots(self, z: Any) -> Trajectory:
        """Knots of z."""
        K, nx, nu = self.problem.horizon, self.problem.dynamics.nx, self.problem.dynamics.nu
        x, u = z[: K * nx].reshape(K, nx), z[K * nx : K * (nx + nu)].reshape(K, nu)
        return Trajectory(x, u, start=z[K * (nx + nu) :] if self.problem.free else None)

    # Functions

    def values(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost, scalar, and constraints, (rows,)."""
        cost, constraints = cost_and_constraints(self._numbers, self.knots(z))
        return np.asarray(cost), np.asarray(constraints)

    def gradient(self, z: np.ndarray) -> np.ndarray:
        """Of the cost, (size,)."""
        stage, end = jax.device_get(_gradient(self._numbers, self.knots(z)))
        columns = np.concatenate([self.columns.ravel(), self.last])
        free = columns >= 0
        slopes = np.concatenate([stage.ravel(), end])[free]
        return np.bincount(columns[free], slopes, self.size)

    def jacobian(self, z: np.ndarray) -> np.ndarray:
        """Entries of the constraints' Jacobian, in the order of `jacobian_pattern`."""
        stage, end = jax.device_get(_jacobian(self._numbers, self.knots(z)))
        minus = -np.ones(self.problem.horizon * self.problem.dynamics.nx)
        return self.jacobian_pattern.summed(np.concatenate([stage.ravel(), minus, end.ravel()]))

    def hessian(self, z: np.ndarray, weight: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Upper entries of the Hessian of weight cost + forces' constraints."""
        stage, end = jax.device_get(
            _hessian(self._numbers, self.knots(z), jnp.asarray(weight[0]), self._split(forces))
        )
        return self.hessian_pattern.summed(np.concatenate([stage.ravel(), end.ravel()]))

    @cached_property
    def jacobian_pattern(self) -> Pattern:
        """Defects and constraints of a stage by (x_k, u_k), -1 for x_{k+1}, and those of x_K."""
        K, nx = self.problem.horizon, self.problem.dynamics.nx
        m, end = self.problem.constraint.rows, self.problem.terminal_constraint.rows
        defects = np.arange(K * nx)
        constraints = K * nx + np.arange(K * m).reshape(K, m)
        own = np.concatenate([defects.reshape(K, nx), constraints], axis=1)
        last = K * (nx + m) + np.arange(end)
        pairs = [
            np.broadcast_arrays(own[:, :, None], self.columns[:, None, :]),
            [defects, defects],
            np.broadcast_arrays(last[:, None], self.last[None, :]),
        ]
        return _pattern(pairs)

    @cached_property
    def hessian_pattern(self) -> Pattern:
        """Blocks of (x_k, u_k), and that of x_K; the upper triangle."""
        pairs = [
            np.broadcast_arrays(self.columns[:, :, None], self.columns[:, None, :]),
            np.broadcast_arrays(self.last[:, None], self.last[None, :]),
        ]
        return _pattern(pairs, upper=True)

    @cached_property
    def _numbers(self) -> Problem:
        """The problem without what compiled functions do not read."""
        return replace(self.problem, goal=None, guess=None)

    def _split(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multipliers of each stage (K, nx + m) and of the end."""
        K, nx, m = self.problem.horizon, self.problem.dynamics.nx, self.problem.constraint.rows
        defects, stage, end = np.split(forces, [K * nx, K * (nx + m)])
        return np.concatenate([defects.reshape(K, nx), stage.reshape(K, m)], axis=1), end


def _pattern(pairs: Any, upper: bool = False) -> Pattern:
    rows, columns = (np.concatenate([np.ravel(p[i]) for p in pairs]) for i in (0, 1))
    keep = (rows >= 0) & (columns >= 0)
    return Pattern(rows, columns, keep & (rows <= columns) if upper else keep)


def _stages(problem: Problem, knots: Trajectory) -> tuple[Array, Knot]:
    """(x_k, u_k) of every stage, (K, nx + nu), and its knot."""
    x, u, at = problem.stages(knots)
    return jnp.concatenate([x, u], axis=1), at


def _cost(problem: Problem, y: Array, knot: Knot) -> Array:
    x, u = jnp.split(y, [problem.dynamics.nx])
    return problem.running_cost(x, u, knot)


def _constraints(problem: Problem, y: Array, knot: Knot) -> Array:
    """f(x_k, u_k) and the constraints of a stage, (nx + m,)."""
    x, u = jnp.split(y, [problem.dynamics.nx])
    f = problem.dynamics.at(knot).step
    return jnp.concatenate([f(x, u), problem.running_constraint(x, u, knot)])


@jax.jit
def cost_and_constraints(problem: Problem, knots: Trajectory) -> tuple[Array, Array]:
    """Cost, scalar, and constraints, (rows,), in the order of `Program`."""
    found = jax.vmap(partial(_constraints, problem))(*_stages(problem, knots))
    nx = problem.dynamics.nx
    defects = found[:, :nx] - knots.x
    end = problem.end_constraint(knots.x[-1])
    rows = jnp.concatenate([defects.ravel(), found[:, nx:].ravel(), end])
    return problem.cost(knots), rows


@jax.jit
def _gradient(problem: Problem, knots: Trajectory) -> tuple[Array, Array]:
    stage = jax.vmap(jax.grad(partial(_cost, problem)))(*_stages(problem, knots))
    return stage, jax.grad(problem.terminal_cost)(knots.x[-1])


@jax.jit
def _jacobian(problem: Problem, knots: Trajectory) -> tuple[Array, Array]:
    stage = jax.vmap(jax.jacfwd(partial(_constraints, problem)))(*_stages(problem, knots))
    return stage, jax.jacfwd(problem.end_constraint)(knots.x[-1])


@jax.jit
def _hessian(
    problem: Problem, knots: Trajectory, weight: Array, forces: tuple[Array, Array]
) -> tuple[Array, Array]:
    def stage(y: Array, knot: Knot, force: Array) -> Array:
        return weight * _cost(problem, y, knot) + force @ _constraints(problem, y, knot)

    def end(x: Array) -> Array:
        return weight * problem.terminal_cost(x) + forces[1] @ problem.end_constraint(x)

    blocks = jax.vmap(jax.hessian(stage))(*_stages(problem, knots), jnp.asarray(forces[0]))
    return blocks, jax.hessian(end)(knots.x[-1])
