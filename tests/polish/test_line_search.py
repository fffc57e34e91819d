"""Which step the polish takes along a direction."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import from_function
from mjx_drax.method.model import Multipliers
from mjx_drax.polish import line_search
from mjx_drax.polish.line_search import LADDER, Ray
from mjx_drax.problem.trajectory import Stagewise, Trajectory

K, DT, ROWS = 12, 0.1, 23


def rays(seed=0):
    """Directions of a curved problem, some of which help only when they are short, or never."""

    def f(x, u):
        return x + DT * jnp.array([x[1], u[0] - jnp.sin(3.0 * x[0])])

    problem = from_function(
        f, nu=1, dt=DT, horizon=K * DT, x_init=[0.0, 0.0], running_cost=lambda x, u: x @ x + u @ u
    )
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(ROWS, K, 2)), rng.normal(size=(ROWS, K, 1))
    size = (
        10.0 ** rng.uniform(-1.0, 2.0, (ROWS, 1, 1))
        * np.where(rng.random(ROWS) < 0.2, -1, 1)[:, None, None]
    )
    away = Trajectory(jnp.asarray(-size * x), jnp.asarray(-size * u))
    none = Stagewise(jnp.zeros((K, 0)), jnp.zeros(0))
    gains = 0.1 * rng.normal(size=(ROWS, K, 1, 2))
    knots = Trajectory(jnp.asarray(x), jnp.asarray(u))
    no_rows = jax.tree.map(lambda a: jnp.zeros((ROWS, *a.shape)), none)
    rows = {
        "knots": knots,
        "h": Multipliers(jax.vmap(problem.defects)(knots), no_rows),
        "d": away,
        "reach": jnp.asarray(rng.uniform(0.5, 1.0, ROWS)),
        "closed": jnp.asarray(0.3 * rng.normal(size=(ROWS, K, 2, 2))),
        "gains": jnp.asarray(gains),
        "eta": Multipliers(jnp.asarray(rng.random((ROWS, K, 2))), no_rows),
        "funnel": jnp.asarray(rng.choice([0.0, 5.0], ROWS)),
    }
    common = {
        "problem": problem,
        "rho": jnp.zeros(()),
        "promised": (jnp.full((), -0.1), jnp.full((), -0.1)),
        "rows": Multipliers(jnp.ones(2), none),
    }
    return rows, common


def searched(way, rows, common, *more):
    """What a way to search gives for all rows."""
    return jax.jit(jax.vmap(lambda own, *more: way(Ray(**own, **common), *more)))(rows, *more)


@cache
def alone(seed=0):
    """Rays, and the steps that each of them takes by itself."""
    rows, common = rays(seed)
    return rows, common, searched(line_search._side_by_side, rows, common)


@pytest.mark.parametrize("seed", range(3))
def test_chains_that_share_their_work_take_the_steps_that_they_would_take_alone(seed):
    rows, common, (size, knots, through) = alone(seed)
    needed = jnp.asarray(np.random.default_rng(seed).random(ROWS) < 0.8)
    shared = searched(line_search.line_search, rows, common, needed)
    steps = np.asarray(size / rows["reach"])
    assert len(np.unique(steps.round(4))) >= 5  # 0, too
    assert {0.0, *np.float32(LADDER).round(4)} >= set(steps.round(4).tolist())
    np.testing.assert_allclose(shared[0], np.where(needed, size, 0.0), rtol=1e-6)
    moved = np.asarray(needed & (size > 0.0))
    np.testing.assert_array_equal(np.asarray(shared[2])[moved], np.asarray(through)[moved])
    for a, b in zip(jax.tree.leaves(shared[1]), jax.tree.leaves(knots), strict=True):
        np.testing.assert_allclose(np.asarray(a)[moved], np.asarray(b)[moved], rtol=1e-5, atol=1e-5)


def test_one_chain_alone_takes_the_same_step():
    rows, common, (size, knots, _) = alone()
    search = jax.jit(lambda own: line_search.line_search(Ray(**own, **common), jnp.ones((), bool)))
    for i in np.flatnonzero(np.asarray(size) > 0.0)[:4]:
        found = search(jax.tree.map(lambda a, i=i: a[i], rows))
        np.testing.assert_allclose(found[0], size[i], rtol=1e-6)
        np.testing.assert_allclose(found[1].x, knots.x[i], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("gpu", "constraint_rows", "shared"),
    [(False, 0, True), (True, 0, False), (True, 1_000, False), (True, 3_000, True)],
)
def test_gpus_share_the_work_where_it_is_dear(gpu, constraint_rows, shared, monkeypatch):
    rows, common, (size, *_) = alone()
    kind = type(common["problem"].dynamics)
    monkeypatch.setattr(kind, "constraint_rows", constraint_rows)
    monkeypatch.setattr(line_search, "on_gpu", lambda: gpu)
    seen, by_need = [], line_search._by_need
    monkeypatch.setattr(
        line_search, "_by_need", lambda n, *given: (seen.append(n), by_need(n, *given))[1]
    )
    found = searched(line_search.line_search, rows, common, jnp.ones(ROWS, bool))
    assert (ROWS in seen) == shared
    np.testing.assert_allclose(found[0], size, rtol=1e-6)
