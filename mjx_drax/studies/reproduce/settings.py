"""Settings for the paper's two problems, and what all methods share: knots and budgets."""

from __future__ import annotations

from dataclasses import replace

import jax

from mjx_drax.method.langevin import Langevin
from mjx_drax.method.metrics import Identity
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.studies.lbfgs import LBFGS

# Preconditioned settings for one attempt, chosen by hand for each problem

PENDULUM = Langevin(
    iterations=150,
    tail=50,
    noise=Geometric(0.1, 0.01),
    penalty=Geometric(100.0, 100.0),
    damping=Geometric(1e-3, 1e-4),
    barrier_weight=Geometric(0.1, 1e-3, 1e-6),
)

TRAP = Langevin(
    iterations=300,
    tail=100,
    noise=Geometric(30.0, 0.01),
    penalty=Geometric(100.0, 1000.0),
    damping=Geometric(10.0, 0.1, 1e-3),
    barrier_weight=Geometric(0.1, 1e-3, 1e-4),
)

PENDULUM_FLOW = Langevin(
    iterations=20_000,
    tail=0,
    step_size=0.025,
    noise=Geometric(0.1, 1e-4),
    penalty=Constant(10.0),
    barrier_weight=Geometric(0.1, 1e-4),
    preconditioner=Identity(),
)
"""The paper's flow for its pendulum: mu = 10, 20,000 iterations, dlambda = mu h dt as printed."""

TRAP_FLOW = replace(
    PENDULUM_FLOW,
    step_size=1.2e-3,
    noise=Geometric(10.0, 1e-4),
    penalty=Constant(150.0),
    barrier_weight=Geometric(0.1, 1e-3),
)
"""The paper's flow for the bug trap: obstacles a thousand times stiffer allow only small steps."""

TRAP_QUASI_NEWTON = replace(
    TRAP_FLOW,
    iterations=0,
    tail=20_000,
    barrier_weight=Geometric(0.1, 0.1, 1e-3),
    preconditioner=LBFGS(),
)
"""The method of multipliers with L-BFGS and a line search."""

NO_NOISE = Geometric(0.0, 0.0)  # not Constant(0.0), which would compile everything once more


def pendulum_flows(iterations: int | None) -> dict[str, Langevin]:
    """The paper's flow, with so many iterations (20,000 by default), and the preconditioned one."""
    flow = replace(PENDULUM_FLOW, iterations=iterations or PENDULUM_FLOW.iterations)
    return {"paper's flow": flow, "preconditioned": PENDULUM}


def initial_knots(problem: Problem, chains: int) -> Trajectory:
    """The same random knots for every method, (chains, K, ...)."""
    return jax.vmap(problem.draw)(jax.random.split(jax.random.key(0), chains))


def budget_of(solver: Langevin) -> int:
    """All iterations, with noise and without."""
    return int(solver.iterations) + int(solver.tail)


def with_budget(solver: Langevin, total: int) -> Langevin:
    """The same settings with so many iterations in all, of which the tail keeps its share."""
    tail = round(total * int(solver.tail) / budget_of(solver))
    return replace(solver, iterations=total - tail, tail=tail)
