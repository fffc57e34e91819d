"""The matrices of the quasi-Newton baselines."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import LBFGS, from_function
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.studies.lbfgs import BFGS


@pytest.fixture(scope="module")
def problem():
    return from_function(
        lambda x, u: x + 0.1 * u,
        x_init=np.zeros(2),
        nu=2,
        dt=0.1,
        horizon=0.3,
        running_residual=lambda x, u: u,
    )


@pytest.mark.parametrize("metric", [BFGS(longest=1e3), LBFGS(pairs=12)])
def test_n_pairs_of_a_quadratic_give_its_inverse(problem, metric):
    n = 12
    key = jax.random.key(0)
    root = jax.random.normal(key, (n, n))
    hessian = np.array(root @ root.T / n + np.eye(n), float)
    z = Trajectory(jnp.zeros((3, 2)), jnp.zeros((3, 2)))
    memory = metric.memory(problem, z)
    conjugate = np.linalg.cholesky(np.linalg.inv(hessian))  # s_i' H s_j = 0: n steps suffice
    for s in conjugate.T:
        y = hessian @ s
        pair = (jnp.asarray(v, jnp.float32) for v in (s, y, s @ y))
        memory = metric.with_pair(memory, *pair, jnp.asarray(True))
    gradient = np.arange(1.0, n + 1.0)
    step = metric.inverse_times(memory, jnp.asarray(gradient, jnp.float32))
    np.testing.assert_allclose(step, np.linalg.solve(hessian, gradient), rtol=2e-3, atol=2e-3)


def test_a_full_matrix_without_descent_begins_anew(problem):
    """The last pair's scale s'y / y'y is 1/2 here, so M^{-1} = I / 2; long steps are cut."""
    n, metric = 12, BFGS(longest=10.0)
    memory = metric.memory(problem, Trajectory(jnp.zeros((3, 2)), jnp.zeros((3, 2))))
    s = jnp.zeros(n).at[0].set(1.0)
    gradient = jnp.ones(n)  # s goes uphill
    lost = replace(memory, inverse=-jnp.eye(n), scale=jnp.asarray(0.5), gradient=gradient)
    memory = metric.with_pair(lost, s, -2.0 * s, jnp.asarray(1.0), jnp.asarray(False))
    np.testing.assert_allclose(metric.inverse_times(memory, gradient), 0.5 * gradient)
    np.testing.assert_allclose(jnp.linalg.norm(metric.inverse_times(memory, 1e6 * gradient)), 10.0)
