"""Many problems at once: each solved as it would be alone, whatever is solved beside it."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax import DraxError, Langevin, Polish, Restarts, from_function, from_mjcf, solve_batch
from mjx_drax.base.errors import DraxWarning
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search import engine
from mjx_drax.search.engine import Search
from mjx_drax.search.family import Family

DT = 0.1
SOLVER = Restarts(replace(Restarts().flow, iterations=30, tail=20), descent=20, attempts=3)


def plant(mass, x, u):
    return x + DT * jnp.array([x[1], u[0] / mass])


def miss(target, x):
    return 10.0 * (x - target)


def problem(mass=1.0, target=(0.5, 0.0)):
    return from_function(
        Partial(plant, jnp.asarray(mass)),
        x_init=[0.0, 0.0],
        nu=1,
        dt=DT,
        horizon=10 * DT,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=Partial(miss, jnp.asarray(target)),
        u_bounds=(-4.0, 4.0),
    )


BASE = problem()
STARTS = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 2)).astype(np.float32)


def from_start(x):
    return replace(BASE, x_init=x)


@pytest.fixture(scope="module")
def whole():
    return solve_batch(from_start, STARTS, chains=3, solver=SOLVER)


def test_every_problem_is_solved_from_its_own_start(whole):
    assert whole.certified.all()
    np.testing.assert_array_equal(whole.x[:, 0], STARTS)
    assert whole.open_loop.max_deviation.max() < 1e-4
    states = whole.x[:, 0]
    for k in range(10):
        step = np.concatenate([states[:, 1:], whole.u[:, k]], axis=1)
        states = states + DT * step
        np.testing.assert_allclose(states, whole.x[:, k + 1], atol=1e-4)
    # An optimum of a convex problem: from the other side of the target, the other way
    mirrored = solve_batch(
        lambda x: replace(BASE, x_init=jnp.array([1.0, 0.0]) - x), STARTS, chains=3, solver=SOLVER
    )
    np.testing.assert_allclose(mirrored.u, -whole.u, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("near", [1e-4, 0.0])
def test_answers_do_not_depend_on_how_the_batch_is_split(whole, near):
    """Bit for bit as users compile, which the slow tests do; nearly as the default tests do."""
    split = solve_batch(from_start, STARTS, chains=3, solver=SOLVER, chunk=3)
    np.testing.assert_allclose(split.u, whole.u, near, near)
    np.testing.assert_allclose(split.chain_cost, whole.chain_cost, near, near)
    alone = solve_batch(from_start, STARTS[3:4], chains=3, solver=SOLVER)
    assert abs(alone.cost[0] - whole.cost[3]) < 1e-4  # other random numbers, the same optimum


@pytest.mark.slow
def test_any_number_of_a_problem_may_differ():
    masses, targets = np.array([0.5, 1.0, 2.0]), np.array([[0.2, 0.0], [0.3, 0.1], [-0.2, 0.0]])

    def make(value):
        mass, target = value
        terminal = replace(BASE.terminal, residual=Partial(miss, target))
        dynamics = replace(BASE.dynamics, function=Partial(plant, mass))
        return replace(BASE, dynamics=dynamics, terminal=terminal)

    found = solve_batch(make, (masses, targets), chains=2, solver=SOLVER)
    assert found.certified.all()
    np.testing.assert_allclose(found.open_loop.states[:, -1], targets, atol=0.05)
    end = np.zeros(2)
    for k in range(10):
        end = end + DT * np.array([end[1], found.u[2, k, 0] / masses[2]])
    np.testing.assert_allclose(found.x[2, -1], end, atol=1e-4)


@pytest.mark.slow
def test_finished_problems_leave_the_batch():
    done = []

    def solved(solver):
        done.clear()
        solve_batch(
            from_start, STARTS, 3, solver=solver, chunk=3, progress=lambda *n: done.append(n)
        )

    # In one iteration no chain becomes feasible
    flow, none = replace(SOLVER.flow, iterations=1, tail=0), Polish(iterations=0)
    solved(replace(SOLVER, descent=1, flow=flow, polish=none))
    assert done == 3 * [(3, 5), (5, 5)]
    solved(SOLVER)
    assert done == [(3, 5), (5, 5)]


@pytest.mark.slow
def test_only_problems_that_are_not_done_are_tried_again():
    starts = np.array([[0.0, 0.0], [0.9, 9.0], [0.1, 0.0]])  # the second one hits the wall
    done = []

    def solved(values, **rest):
        return solve_batch(between_walls, values, 2, solver=SOLVER, **rest)

    found = solved(starts, chunk=1, progress=lambda *n: done.append(n))
    assert done == [(1, 3), (2, 3), (3, 3), (3, 3), (3, 3)]  # two more attempts on one of three
    np.testing.assert_array_equal(found.feasible, [True, False, True])
    others = solved(starts[[0, 0, 2]], chunk=1)
    np.testing.assert_array_equal(found.u[[0, 2]], others.u[[0, 2]])


WALLS = replace(BASE.bounds, x_lower=jnp.array([-1.0, -10.0]), x_upper=jnp.array([1.0, 10.0]))


def between_walls(x):
    return replace(BASE, x_init=x, bounds=WALLS)


@pytest.mark.slow
def test_the_last_chains_of_a_large_batch_go_on_by_themselves(monkeypatch):
    starts = np.random.default_rng(1).uniform(-0.3, 0.3, (16, 2)).astype(np.float32)
    starts[5] = 0.9, 9.0  # it hits the wall, in every attempt
    whole = solve_batch(between_walls, starts, chains=2, solver=SOLVER)
    looks, went_on, done = [], [], []
    iterated, go_on = Search._iterated, Search._go_on

    def seen(self, state, start, stop):
        moved, info = iterated(self, state, start, stop)
        looks.append((len(state.alive), stop, self.decisions.moving(moved).sum()))
        return moved, info

    def seen_going_on(self, state, info, rows, start, stop):
        moved, new = go_on(self, state, info, rows, start, stop)
        if stop > start:
            went_on.append(len(rows))
            np.testing.assert_array_equal(rows, np.flatnonzero(self.decisions.moving(state)))
            others = np.delete(np.arange(32), rows)
            np.testing.assert_array_equal(new.cost[others], info.cost[others])
            knots, before = moved.trajectory.u, state.trajectory.u
            np.testing.assert_array_equal(knots[others], before[others])
            assert (np.abs(knots - before)[rows].max(axis=(1, 2)) > 0.0).all()
            assert not self.decisions.moving(moved).any()
        return moved, new

    monkeypatch.setattr(engine, "MANY", 32)
    monkeypatch.setattr(engine, "REPORT_EVERY", 2)
    monkeypatch.setattr(Search, "_iterated", seen)
    monkeypatch.setattr(Search, "_go_on", seen_going_on)
    found = solve_batch(between_walls, starts, 2, solver=SOLVER, progress=lambda *n: done.append(n))
    assert found.feasible.tolist() == whole.feasible.tolist() == [i != 5 for i in range(16)]
    np.testing.assert_allclose(found.u[found.feasible], whole.u[found.feasible], 1e-4, 1e-4)
    assert done == [(16, 16)] * 3
    *first, second, third = [look for look in looks if look[1]]
    assert [rows for rows, *_ in first] == [32] * len(first)
    assert [still > 4 for *_, still in first] == [True] * (len(first) - 1) + [False]
    assert went_on == [first[-1][2]] != [0]
    assert second[0] == third[0] == 4  # where one problem is left


@pytest.mark.slow
@pytest.mark.parametrize("chunks", [1, 2])
def test_ctrl_c_keeps_what_there_is(whole, chunks):
    done, solved = [], np.arange(5) < 2 * chunks

    def interrupt(*numbers):
        done.append(numbers)
        if len(done) == chunks:
            raise KeyboardInterrupt

    found = solve_batch(from_start, STARTS, 3, solver=SOLVER, chunk=2, progress=interrupt)
    np.testing.assert_array_equal(found.certified, solved)
    assert found.status == ["optimal" if s else "interrupted" for s in solved]
    np.testing.assert_allclose(found.u[solved], whole.u[solved], 1e-4, 1e-4)
    np.testing.assert_allclose(found.chain_cost[solved], whole.chain_cost[solved], 1e-4, 1e-4)
    assert (found.cost[~solved] == np.inf).all()
    assert (found.max_defect[~solved] == np.inf).all()


@pytest.mark.slow
def test_ctrl_c_in_a_later_attempt_keeps_the_answers_of_the_first():
    done = []

    def interrupt(*numbers):
        done.append(numbers)
        if len(done) == 4:  # the first of three chunks, in the second attempt
            raise KeyboardInterrupt

    def solved(solver, progress=None):
        return solve_batch(from_start, STARTS, 3, solver=solver, chunk=2, progress=progress)

    solver = replace(SOLVER, done_share=2.0)
    first, kept = solved(replace(solver, attempts=1)), solved(solver, interrupt)
    assert kept.certified.all()
    assert (kept.chain_cost[:2] <= first.chain_cost[:2]).all()
    np.testing.assert_array_equal(kept.u[2:], first.u[2:])
    np.testing.assert_array_equal(kept.chain_cost[2:], first.chain_cost[2:])


PENDULUM = """
<mujoco>
  <option timestep="0.02"/>
  <worldbody>
    <body>
      <joint name="pin" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor joint="pin" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.mark.slow
def test_models_are_replayed_by_the_c_engine():
    swing = from_mjcf(PENDULUM, horizon=0.1, running_residual=lambda data, u: u)
    starts = np.array([[0.3, 0.0], [-0.3, 0.0]])
    solver = Langevin(iterations=1, tail=4)
    found = solve_batch(lambda x: replace(swing, x_init=x), starts, chains=1, solver=solver)
    np.testing.assert_allclose(found.open_loop.states[:, 0], starts, rtol=1e-6)
    np.testing.assert_allclose(found.open_loop.states, found.x, atol=1e-3)
    heavier = swing.dynamics.model.body_mass * jnp.array([[1.0], [2.0]])

    def make(mass):
        model = swing.dynamics.model.replace(body_mass=mass)
        return replace(swing, dynamics=replace(swing.dynamics, model=model))

    with pytest.raises(DraxError, match="would replay another"):
        solve_batch(make, heavier)


@pytest.mark.parametrize(
    ("values", "rest", "message"),
    [
        ((np.zeros((3, 2)), np.zeros(2)), {}, "first axis"),
        ((), {}, "first axis"),
        (np.zeros((0, 2)), {}, "first axis"),
        (STARTS, {"chains": 0}, "chains is 0"),
        (STARTS, {"chunk": -1}, "chunk is -1"),
        (STARTS, {"chunk": 0}, "chunk is 0"),
        (STARTS, {"seed": -1}, "seed is -1"),
        (np.zeros((3, 5)), {}, "x_init has shape"),
    ],
)
def test_what_misfits_is_refused(values, rest, message):
    def make(value):
        return from_start(value[0] if isinstance(value, tuple) else value)

    with pytest.raises(DraxError, match=message):
        solve_batch(make, values, **rest)


def test_goals_are_asked_at_the_times_of_their_own_problems():
    with_goal = replace(BASE, goal=lambda x: True)
    family = Family.of(lambda t: replace(with_goal, t_init=t), jnp.asarray([0.0, 1.0, 2.0]))
    asked = []

    def remember(self, x, times):
        asked.extend(times)
        return np.ones(len(x), bool)

    of = np.array([2, 0, 1, 2])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(BASE), "all_reached", remember)
        family.reached(of, np.zeros((4, 11, 2)))
    assert sorted(asked) == pytest.approx([1.0, 2.0, 3.0, 3.0])


def test_every_problem_has_its_own_goal():
    def make(t):
        near = replace(BASE, goal=lambda x, t=t: bool(abs(float(x[0]) - float(t)) < 0.1))
        return replace(near, t_init=t)

    family = Family.of(make, jnp.asarray([0.0, 1.0, 2.0]))
    ends = np.zeros((3, 11, 2))
    ends[:, -1, 0] = 1.0
    assert family.reached(np.array([0, 1, 2]), ends).tolist() == [False, True, False]
    still = Trajectory(jnp.zeros((10, 2)), jnp.zeros((10, 1)))
    with pytest.raises(DraxError, match="every problem another guess"):
        Family.of(lambda t: replace(BASE, t_init=t, guess=lambda key: still), jnp.arange(2.0))


def test_a_goal_that_fails_at_the_end_loses_nothing():
    family = Family.of_one(replace(BASE, goal=lambda x: x[7] > 0))
    with pytest.warns(DraxWarning, match="goal failed .* No motion counts as there"):
        assert not family.reached(np.zeros(2, int), np.zeros((2, 11, 2))).any()
    picky = Family.of_one(replace(BASE, goal=lambda x: bool(1.0 / x[0] > 0)))
    ends = np.broadcast_to(np.array([[0.0], [1.0]])[..., None], (2, 11, 2))
    with pytest.warns(DraxWarning, match="where it fails"), np.errstate(divide="raise"):
        assert picky.reached(np.zeros(2, int), ends).tolist() == [False, True]
