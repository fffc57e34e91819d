"""Contacts of convex polytopes: how deep they are, and what memory they take."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mjx_drax.physics.contacts import polytopes
from mjx_drax.physics.contacts.hull import polytope

pytestmark = pytest.mark.slow


def hull(count, seed):
    """A polytope of corners on an ellipsoid, 0.1 to 0.2 m large, about 0."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points *= [0.1, 0.08, 0.05] / np.linalg.norm(points, axis=1, keepdims=True)
    return jax.tree.map(jnp.asarray, polytope(points))


def test_contacts_of_hulls_are_as_deep_as_the_hulls_overlap():
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        one, other = hull(40, 1), hull(30, 2)
        centres, turns, depths = [], [], []
        for _ in range(20):
            turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            turn[:, 0] *= np.linalg.det(turn)
            pairs = (np.asarray(one.vert) @ turn.T)[:, None] - np.asarray(other.vert)
            planes = ConvexHull(pairs.reshape(-1, 3)).equations
            way = rng.normal(size=3)
            # They touch where -centre is on the hull of all differences of their corners
            share = 1.0 / (planes[:, :3] @ way / planes[:, 3]).max()
            centres.append((share - 0.002 / np.linalg.norm(way)) * way)
            turns.append(turn)
            depths.append(-(planes[:, 3] - planes[:, :3] @ centres[-1]).max())

        def contacts(centre, turn):
            return polytopes.of_hulls(polytopes.moved(one, centre, turn), other)

        found = jax.jit(jax.vmap(contacts))(jnp.asarray(centres), jnp.asarray(turns))
        dist, _, normal = map(np.asarray, found)
    assert np.allclose(np.linalg.norm(normal, axis=1), 1.0)
    assert np.allclose(-dist.min(axis=1), depths, rtol=1e-2)
    assert np.median(-dist.min(axis=1) - depths) < 1e-9


def test_derivatives_of_contacts_take_little_memory():
    one, other = hull(300, 1), hull(300, 2)

    def depth(centre):
        placed = polytopes.moved(one, centre, jnp.eye(3))
        return polytopes.of_hulls(placed, other)[0]

    program = jax.jit(jax.jacfwd(depth)).lower(jnp.zeros(3)).compile()
    assert program.memory_analysis().temp_size_in_bytes < 5e6  # edges by edges it is gigabytes
