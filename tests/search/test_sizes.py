"""The scale and the floor of costs: free of constants and of units, and of heavy ends."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax import GaussNewton, Restarts, from_function
from mjx_drax.method.bounds import LogBarrier
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.model import expand
from mjx_drax.search.initial import initial_knots
from mjx_drax.search.iterate import Question, partition, start
from mjx_drax.search.scaled import without_units
from mjx_drax.search.sizes import Sizes, scale_and_floor, sizes_of

UNIT = np.array([1e3, 1.0])


def problem(weight=1.0, constant=0.0, terminal=1.0, unit=1.0):
    """A pendulum in units of 1 / unit, whose cost is weighted, with a constant at each knot."""
    unit = jnp.asarray(unit * np.ones(2))

    def f(unit, x, u):
        a, w = x / unit
        return unit * jnp.array([a + 0.1 * w, w + 0.1 * (u[0] - jnp.sin(a))])

    def cost(weight, constant, x, u):
        return constant + weight * u[0] ** 2

    def end(root, unit, x):
        return root * (x / unit - 1.0)

    return from_function(
        Partial(f, unit),
        x_init=[0.0, 0.0],
        nu=1,
        dt=0.1,
        horizon=1.0,
        running_cost=Partial(cost, jnp.asarray(weight), jnp.asarray(constant)),
        terminal_residual=Partial(end, jnp.sqrt(jnp.asarray(terminal * weight)), unit),
        x_scatter=(-3.0 * unit, 3.0 * unit),
        u_bounds=(-1.0, 1.0),
    )


def measured(polished=True, **changes):
    one = problem(**changes)
    knots = initial_knots(one, 8, None, jax.random.key(0))
    shared, own = partition(Question(Restarts().flow, one), None)
    return scale_and_floor(sizes_of(own, shared, knots), polished)


def test_a_constant_moves_the_floor_alone():
    scale, floor = measured()
    assert floor == pytest.approx(0.0, abs=1e-6)
    for constant in (-3.0, 100.0):
        other, below = measured(constant=constant)
        assert other == pytest.approx(scale, rel=1e-3)
        assert below == pytest.approx(10 * constant, abs=1e-3)


def test_the_scale_goes_with_the_cost_and_not_with_units_of_states():
    scale, _ = measured()
    assert measured(weight=1e6)[0] == pytest.approx(1e6 * scale, rel=1e-4)
    assert measured(unit=UNIT)[0] == pytest.approx(scale, rel=1e-4)


@pytest.mark.slow
def test_a_heavy_end_counts_no_more_than_controls_where_there_is_a_polish():
    heavy, heavier = (measured(terminal=w)[0] for w in (1e4, 1e6))
    assert heavier == pytest.approx(heavy, rel=1e-3)
    assert 1.0 < heavy < 20.0  # ten controls cost some 3, and count twice
    in_full = [measured(polished=False, terminal=w)[0] for w in (1e4, 1e6)]
    assert in_full[1] == pytest.approx(100 * in_full[0], rel=1e-2)


def test_costs_that_are_no_numbers_do_not_count():
    values = np.array([1.0, np.nan, np.inf])
    zero = np.zeros(3)
    assert scale_and_floor(Sizes(values, zero, zero, zero, zero), True) == (1 / 300, 0.0)
    nothing = np.full(3, np.nan)
    assert scale_and_floor(Sizes(*[nothing] * 5), True) == (1.0, 0.0)


@pytest.mark.slow
def test_the_flow_takes_the_same_step_in_any_units():
    found = []
    for unit in (np.ones(2), UNIT):
        one, flow = problem(unit=unit), Langevin()
        knots = initial_knots(one, 1, None, jax.random.key(0))
        chain = jax.tree.map(lambda a: a[0], start(flow, one, knots, jax.random.key(1)))
        assert isinstance(flow.preconditioner, GaussNewton)
        weights = flow.weights(0.5)
        present = replace(chain.multipliers, bounds=None)
        by = flow.preconditioner.derivatives
        at = chain.trajectory, present, weights, by, jax.random.key(2)
        model = expand(one, LogBarrier(), *at)
        metric = without_units(flow, one).preconditioner
        to = metric.direction(one, model, jax.random.key(3), ())
        found.append(
            (
                to.drift.x / unit,
                to.drift.u,
                to.noise.x / unit,
                to.noise.u,
                to.multipliers.dynamics * unit,
                to.gains * unit,
            )
        )
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(b, a, rtol=2e-3, atol=2e-4 * np.abs(a).max())
