"""Cost.expand: gradients, and Hessians that are positive semidefinite whatever the cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.problem.cost import Cost, as_partial, cost_of
from mjx_drax.problem.differentiators import Autodiff

N = 4
Z = np.linspace(-1.0, 1.5, N)


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def random_matrix(rows, seed=0):
    return np.random.default_rng(seed).normal(size=(rows, N))


def residual(z):
    return jnp.sin(random_matrix(6) @ z) + z[0] * z[1]


def saddle(z):
    return 0.5 * z @ (np.diag([3.0, -2.0, 1.0, -0.5])) @ z + z[0]


def bowl(z):
    root = random_matrix(N, seed=1)
    return 0.5 * z @ root.T @ root @ z + jnp.sum(z)


def expand(cost):
    return cost.expand(lambda dz: (Z + dz,), N, Autodiff(), jax.random.key(0))


def test_residual_gives_jr_and_jj():
    J, r = jax.jacobian(residual)(Z), residual(Z)
    gradient, hessian = expand(cost_of(None, residual))
    np.testing.assert_allclose(gradient, J.T @ r, atol=1e-12)
    np.testing.assert_allclose(hessian, J.T @ J, atol=1e-12)
    np.testing.assert_allclose(gradient, jax.grad(cost_of(None, residual))(Z), atol=1e-12)


def test_convex_scalar_gives_its_gradient_and_hessian():
    root = random_matrix(N, seed=1)
    gradient, hessian = expand(cost_of(bowl, None))
    np.testing.assert_allclose(gradient, root.T @ root @ Z + 1, atol=1e-12)
    np.testing.assert_allclose(hessian, root.T @ root, atol=1e-12)


def test_nonconvex_scalar_gives_the_positive_part_of_its_hessian():
    gradient, hessian = expand(cost_of(saddle, None))
    np.testing.assert_allclose(gradient, [3.0, -2.0, 1.0, -0.5] * Z + [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(hessian, np.diag([3.0, 0.0, 1.0, 0.0]), atol=1e-12)


def test_positive_part_in_rotated_axes():
    rotation = np.linalg.qr(random_matrix(N))[0]
    _, hessian = expand(cost_of(lambda z: saddle(rotation @ z), None))
    np.testing.assert_allclose(
        hessian, rotation.T @ np.diag([3.0, 0.0, 1.0, 0.0]) @ rotation, atol=1e-12
    )


def test_both_parts_add_up():
    both, parts = cost_of(saddle, residual), (cost_of(saddle, None), cost_of(None, residual))
    for seen, *summands in zip(expand(both), *map(expand, parts), strict=True):
        np.testing.assert_allclose(seen, sum(summands), atol=1e-12)
    assert both(Z) == pytest.approx(saddle(Z) + 0.5 * np.sum(residual(Z) ** 2))


def test_no_part_costs_nothing():
    cost = Cost(None, None)
    assert cost(Z) == 0
    assert not np.any(expand(cost)[0])
    assert not np.any(expand(cost)[1])


def test_a_residual_may_have_any_shape():
    def square(z):
        return residual(z).reshape(2, 3)

    for seen, wanted in zip(
        expand(cost_of(None, square)), expand(cost_of(None, residual)), strict=True
    ):
        np.testing.assert_array_equal(seen, wanted)
    assert cost_of(None, square)(Z) == pytest.approx(float(cost_of(None, residual)(Z)))


def test_parameters_of_a_partial_are_leaves():
    cost = Cost(as_partial(jax.tree_util.Partial(lambda w, z: w * bowl(z), 2.0)), None)
    assert jax.tree.leaves(cost) == [2.0]
    doubled = jax.tree.map(lambda w: 2 * w, cost)
    np.testing.assert_allclose(expand(doubled)[1], 2 * expand(cost)[1], rtol=1e-12)
