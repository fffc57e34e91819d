"""What several tests of this room look at."""

import pytest

from mjx_drax import Langevin, Restarts, Solution, solve, tasks


@pytest.fixture(scope="session")
def cartpole() -> Solution:
    """A solution from a model, recorded."""
    problem = tasks.load("cartpole_swingup").make(horizon=0.2)
    return solve(problem, chains=2, solver=Langevin(iterations=3, tail=1), record=1)


@pytest.fixture(scope="session")
def pendulum() -> Solution:
    """A solution of a function."""
    settings = Restarts(Langevin(iterations=30, tail=20), descent=30, attempts=1)
    return solve(tasks.load("pendulum").make(horizon=1.0), chains=8, solver=settings)
