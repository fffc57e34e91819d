"""Random forests: what they ask, and that they are solved."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.studies.convergence.optimal_control import straight
from mjx_drax.studies.forests import HEADER, forest, row


def depths(problem, x):
    """How deep states (K, nx) lie in each tree [m^2], (K, trees); negative outside."""
    u = jnp.zeros(problem.dynamics.nu)
    return np.array([problem.constraint.inequality(each, u) for each in jnp.asarray(x)])


@pytest.mark.parametrize("number", range(6))
def test_start_and_end_are_free_and_the_guess_is_not(number):
    problem, end = forest(number)
    assert depths(problem, [problem.x_init, end]).max() < 0
    assert depths(problem, straight(problem, end).x).max() > 0
    assert np.abs(problem.terminal_constraint.equality(jnp.asarray(end))).max() == 0


def test_a_number_names_one_forest():
    same, other = (depths(forest(n)[0], jnp.zeros((1, 4))) for n in (2, 4))
    np.testing.assert_array_equal(depths(forest(2)[0], jnp.zeros((1, 4))), same)
    assert same.shape != other.shape or (same != other).any()


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 3])
def test_the_polish_alone_and_solve_find_optima(number):
    text, found = row(number, chains=4)
    assert text.count("|") == HEADER.splitlines()[0].count("|")
    assert found["polish"]
    assert found["solve"]
