"""What several tests of this room look at."""

import pytest

from mjx_drax import Langevin, Solution, solve, tasks


@pytest.fixture(scope="session")
def cartpole() -> Solution:
    """A solution from a model, recorded."""
    problem = tasks.load("cartpole_swingup").make(horizon=0.2)
    return solve(problem, chains=2, solver=Langevin(iterations=3, tail=1), record=1)
