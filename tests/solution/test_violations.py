"""What a replay breaks: how much, which entry, at which knot; what is tolerated, in any units."""

import json
import warnings
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import made_up, point, replays
from jax.tree_util import Partial

from mjx_drax import (
    DraxError,
    Langevin,
    Solution,
    Tolerances,
    Trajectory,
    from_function,
    from_mjcf,
    minimize,
    solve,
    solve_batch,
)
from mjx_drax.problem.problem import Problem
from mjx_drax.search.family import Family
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.solution.program import from_program
from mjx_drax.solution.replay import followed, open_loop_is_better
from mjx_drax.solution.report import lines
from mjx_drax.solution.violations import (
    KINDS,
    Violation,
    driven_extents,
    most_broken,
    warn_of_controls_at_the_end,
    warn_of_loose_ends,
    warn_of_rounding,
    worst_knots,
)
from mjx_drax.view import plotting
from mjx_drax.view.video import outcome_lines

K, DT = 10, 0.2
OTHERS = [(1.0, 1.0), (1e3, 1.0), (1.0, 1e-6)]
UNITS = [(1e-3, 1e4), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in OTHERS)]
"""Units of length and of the values of a constraint."""


def mass(length=1.0, **rest) -> Problem:
    """A mass that a force moves along a line; x = (place, speed), in a unit of length."""
    given = {
        "x_init": [0.0, 0.0],
        "nu": 1,
        "dt": DT,
        "horizon": K * DT,
        "running_cost": lambda x, u: u @ u,
        "x_scatter": (-length, length),
        "u_scatter": (-length, length),
        "name": "mass",
    }
    return from_function(lambda x, u: x + DT * jnp.array([x[1], u[0]]), **{**given, **rest})


def motion(length=1.0):
    """Forces (K, 1) that speed up and slow down, and the states x_0..x_K that they lead to."""
    u = length * np.repeat([1.0, -1.0], K // 2)[:, None]
    x = [np.zeros(2)]
    for force in u[:, 0]:
        x.append(x[-1] + DT * np.array([x[-1][1], force]))
    return np.array(x), u


def replayed(problem, plan, u, tolerances=None):
    gains = np.zeros((1, K, 1, 2))
    return replays(problem, Trajectory(plan[None, 1:], u[None]), gains, tolerances)


def violation(found, kind):
    return found.violations.data(0).get(kind)


X, U = motion()


def bounds_of_knot_4(x):
    upper = np.full((K, 2), 9.0)
    upper[3, 1] = x[4, 1] - 0.3  # rows are x_1..x_K
    return np.full((K, 2), -9.0), upper


# Largest at the last stage, whose state is x_{K-1}, and at the end
CASES = {
    "state_bounds": ({"x_bounds": bounds_of_knot_4(X)}, 0.3, 1, 4),
    "equality": ({"equality": lambda x, u: jnp.array([0.0, x[0]])}, X[K - 1, 0], 1, K - 1),
    "inequality": (
        {"inequality": lambda x, u: jnp.array([-1.0, x[1] - 0.6, u[0] - 5.0])},
        X[5, 1] - 0.6,
        1,
        5,
    ),
    "terminal_equality": ({"terminal_equality": lambda x: x - X[K] + 0.2}, 0.2, None, K),
    "terminal_inequality": ({"terminal_inequality": lambda x: x[:1] - 0.5}, X[K, 0] - 0.5, 0, K),
    "goal": ({"goal": lambda x: x[0] > 99}, 1.0, -1, K),
}


@pytest.mark.parametrize("kind", CASES)
def test_a_replay_that_breaks_what_was_asked_is_no_success(kind):
    parts, size, entry, knot = CASES[kind]
    found = replayed(mass(**parts), X, U)
    assert found.max_deviation[0] < 1e-6  # it is as planned, and yet
    assert not found.success[0]
    told = violation(found, kind)
    assert told["size"] == pytest.approx(size, rel=1e-5)
    assert told["knot"] == knot
    assert entry is None or told["entry"] == entry
    assert told["size"] > told["allowed"]
    others = [v for v in found.violations.of(0) if v.kind != kind]
    assert not any(v.broken for v in others)
    assert found.violations.worst(0).kind == kind


@pytest.mark.parametrize("kind", [kind for kind in CASES if kind != "goal"])
def test_a_tolerance_of_ones_own_is_in_ones_own_units(kind):
    parts, size, *_ = CASES[kind]
    problem = mass(**parts)
    assert replayed(problem, X, U, Tolerances(**{kind: 1.01 * size})).success[0]
    assert not replayed(problem, X, U, Tolerances(**{kind: 0.99 * size})).success[0]
    entries = {"state_bounds": 2, "equality": 2, "inequality": 3, "terminal_equality": 2}
    each = np.full(entries.get(kind, 1), 1.01 * size)
    assert replayed(problem, X, U, Tolerances(**{kind: each})).success[0]


def test_without_a_violation_all_is_kept():
    problem = mass(
        x_bounds=(-9, 9),
        u_bounds=(-1, 1),
        equality=lambda x, u: jnp.array([u[0] ** 2 - 1.0]),
        inequality=lambda x, u: x - 3.0,
        terminal_equality=lambda x: x - X[K],
    )
    found = replayed(problem, X, U)
    assert found.success[0]
    told = found.violations.data(0)
    assert set(told) == set(KINDS) - {"goal", "dynamics", "terminal_inequality"}
    assert all(v["size"] <= 1e-5 for v in told.values())


@pytest.mark.parametrize(("length", "unit"), UNITS)
@pytest.mark.parametrize("over", [0.9, 1.1])
def test_units_do_not_change_a_verdict(length, unit, over):
    """A wall that the replay passes by a share of what is tolerated."""
    states, u = motion(length)
    share, extent = Tolerances().relative, X[:, 0].max()
    wall = X[K - 1, 0] - over * share * extent
    for part, at in (("inequality", "inequality"), ("equality", "equality")):
        function = Partial(past, jnp.array([length, unit, wall]))
        found = replayed(mass(length, **{part: function}), states, u)
        told = violation(found, at)
        if part == "inequality":
            assert told["size"] == pytest.approx(over * share * extent * unit, rel=1e-3)
            assert found.success[0] == (over < 1)
        # To move the place by its extent changes the constraint by the extent in its unit
        assert told["allowed"] == pytest.approx(share * extent * unit, rel=1e-3)
    box = np.array([length * (X[K, 0] - over * share * extent), np.inf])
    found = replayed(mass(length, x_bounds=(-np.inf, box)), states, u)
    assert violation(found, "state_bounds")["allowed"] == pytest.approx(share * extent * length)
    assert found.success[0] == (over < 1)


def past(units, x, u):
    length, unit, wall = units
    return jnp.array([unit * (x[0] / length - wall)])


def test_a_box_tolerates_a_share_of_its_width_unless_it_is_far_wider_than_the_motion():
    for low, width in ((-1.0, 1.9), (-1e6, 10 * X[:, 0].max())):
        found = replayed(mass(x_bounds=([low, -np.inf], [0.9, np.inf])), X, U)
        allowed = violation(found, "state_bounds")["allowed"]
        assert allowed == pytest.approx(width * Tolerances().relative)


@pytest.mark.parametrize("length", [1.0, 0.01, 1e-5, 1e3])
def test_without_a_goal_a_replay_tracks_its_plan_in_the_size_of_the_motion(length):
    """As in a plan of 1 cm, of which 9 mm are far too much."""
    states, u = motion(length)
    problem = mass(length)
    for off, success in ((0.9, False), (0.02, False), (1e-4, True)):
        plan = states.copy()
        plan[-1, 0] += off * length
        found = replayed(problem, plan, u)
        assert found.success[0] == success
        told = violation(found, "tracking")
        assert (told["entry"], told["knot"]) == (0, K)
        assert told["size"] == pytest.approx(off * length, rel=1e-2)
    wanted = Tolerances(tracking=[0.95 * length, 1e-3 * length])
    plan = states + np.array([0.9 * length, 0.0]) * (np.arange(K + 1) == K)[:, None]
    assert replayed(problem, plan, u, wanted).success[0]


def test_a_coordinate_that_stands_still_has_the_scale_of_the_scatter():
    still = np.zeros((K + 1, 2))
    still[-1, 0] = 1e-5
    found = replayed(mass(100.0), still, np.zeros((K, 1)))
    assert found.success[0]
    still[-1, 0] = 1.0
    assert not replayed(mass(100.0), still, np.zeros((K, 1))).success[0]


def test_a_replay_that_diverges_breaks_what_it_can():
    problem = mass(x_bounds=(-9, 9), inequality=lambda x, u: x - 5.0)
    found = replayed(problem, X, np.full((K, 1), np.nan))
    assert not found.success[0]
    assert violation(found, "inequality")["size"] == np.inf
    assert found.outcome(problem, 0) == "diverges"


@pytest.mark.parametrize(
    ("tolerances", "words"),
    [
        (lambda: Tolerances(relative=-1), "relative of the tolerances is -1"),
        (lambda: Tolerances(equality="tight"), "tolerance of equality is 'tight'"),
        (lambda: Tolerances(state_bounds=-1e-3), "tolerance of state bounds is -0.001"),
        (lambda: Tolerances(tracking=[[1.0]]), "tolerance of tracking"),
        (lambda: solve(mass(), 1, tolerances=1e-3), "tolerances are 0.001: give mjx_drax.Toler"),
        (
            lambda: solve(mass(), 1, tolerances=Tolerances(control_bounds=[1.0, 2.0])),
            "tolerances of control bounds are 2 numbers: give 1, or one for all",
        ),
    ],
)
def test_tolerances_that_are_refused(tolerances, words):
    with pytest.raises(DraxError, match=words):
        tolerances()


# Plans, statuses and files.


def infeasible(problem, **changes):
    """A solution of two chains, of which the first breaks something; by how much is given."""
    return replace(made_up(problem), max_defect=np.array([0.5, 0.0], np.float32), **changes)


def test_an_infeasible_plan_says_where_it_breaks_the_dynamics(tmp_path):
    made = infeasible(point())  # stands still
    x = made.trajectories.x.copy()
    x[0, 6:, 1] = 0.5  # from x_7 on: the step from x_6 leads elsewhere
    made = replace(made, trajectories=Trajectory(x, made.trajectories.u))
    where = made.where(0)
    assert (where.kind, where.entry, where.knot) == ("dynamics", 1, 6)
    assert where.size == pytest.approx(0.5)
    assert where.told(made.problem) == (
        "breaks the dynamics in x1 by 5.0e-01 (tolerated: 1.7e-04) at knot 6, 0.6 s"
    )
    assert made.where(1) is None
    assert made.status == ["infeasible", "feasible"]
    none = replace(made, max_defect=np.ones(2, np.float32))
    assert "breaks the dynamics in x" in lines(none)[-1]
    again = Solution.load(none.save(tmp_path))  # without f nobody can tell where
    assert again.where(0)[1:] == (1.0, 1e-3, -1, -1)
    assert again.where(0).told(again.problem).startswith("breaks the dynamics by 1.0e+00")


@pytest.mark.slow
def test_an_infeasible_plan_says_which_constraint_it_breaks():
    problem = point(inequality=lambda x, u: jnp.array([x[0] - 1.0, u[0] - 0.1]))
    guess = Trajectory(np.zeros((K, 2)), np.where(np.arange(K) == 4, 0.8, 0.0)[:, None] * [1, 0])
    still = Langevin(iterations=1, tail=0, step_size=0.0)
    found = solve(problem, chains=1, solver=still, guess=guess)
    where = found.where(0)
    assert (where.kind, where.entry, where.knot) == ("inequality", 1, 4)
    assert "Try more iterations" in str(found)
    guess = replace(guess, u=0.0 * guess.u)
    outside = point(inequality=lambda x, u: 1.0 - x[:1])
    at_start = solve(outside, chains=1, solver=still, guess=guess)
    assert "at knot 0, 0 s, where the state is x_init. Move x_init" in str(at_start)
    assert where.size == pytest.approx(0.7, rel=1e-3)
    program = from_program(2, cost=lambda x: x @ x, inequality=lambda x: x[:1] - 3.0)
    end = minimize(program, chains=1, solver=still, guess=[5.0, 0.0])
    assert end.status == ["infeasible"]
    assert (end.where(0).kind, end.where(0).size) == ("inequality", pytest.approx(2.0))
    assert not end.optimal


def test_a_constraint_that_a_replay_breaks_is_told_everywhere(tmp_path):
    problem = mass(inequality=lambda x, u: jnp.array([-1.0, x[1] - 0.6]), goal=lambda x: True)
    found = replayed(problem, X, U)
    made = replace(made_up(problem, 1), open_loop=found, feedback=found)
    broken = "breaks inequality [1] by 4.0e-01 (tolerated: 5.0e-03) at knot 5, 1 s"
    assert not made.certified
    assert made.outcome("with feedback") == broken
    assert f"with feedback  {broken}, cost 10" in lines(made)
    assert "NOT CERTIFIED: feasible chains miss the goal or break" in lines(made)[-1]
    assert broken in " ".join(outcome_lines(made))
    assert broken in " ".join(plotting.title_of(made).split())
    made.save(tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    kept = told["certificate"]["feedback"]["violations"]
    assert kept["goal"] == {"size": 0.0, "allowed": 0.0, "entry": -1, "knot": -1}
    assert kept["inequality"] == pytest.approx(
        {"size": 0.4, "allowed": 5e-3, "entry": 1, "knot": 5}, rel=1e-3
    )
    assert (told["certified"], told["optimal"], told["residual"]) == (False, False, None)
    reaches_not = replace(problem, goal=lambda x: False)
    assert replayed(reaches_not, X, U).outcome(problem, 0) == f"misses the goal and {broken}"


@pytest.mark.parametrize(("saved", "best"), [(0.0, 1), (8e-4, 1), (2e-3, 0)])
def test_an_optimal_chain_is_best_among_those_that_cost_as_much(saved, best):
    made = replace(made_up(point(), 2), residual=np.array([np.nan, 1e-6]))
    cheaper = replace(made.open_loop, cost=np.array([1.0 - saved, 1.0]))
    made = replace(made, open_loop=cheaper, feedback=cheaper)
    assert made.certified_chains.all()
    assert made.best_chain == best


def test_optimal_is_certified_with_a_small_residual():
    made = replace(made_up(point(), 4), residual=np.array([1e-6, 1e-2, np.nan, 1e-6]))
    failed = replace(made.open_loop, success=np.arange(4) < 3)
    made = replace(made, open_loop=failed, feedback=failed)
    assert made.optimal_chains.tolist() == [True, False, False, False]
    assert made.status == ["optimal", "feasible", "feasible", "feasible"]
    assert made.optimal
    assert made.verdict == "CERTIFIED and optimal"
    assert made.optimality == "residual 1.0e-06, below 0.0001"
    assert made.polished == ["converged", "unfinished", "none", "converged"]
    close = replace(made, residual=np.full(4, 9.96e-5))
    assert close.optimality == "residual 9.960e-05, below 0.0001"
    others = replace(made, residual=np.full(4, 1e-2))
    assert not others.optimal
    assert others.verdict == "CERTIFIED, not known to be optimal"
    unfinished = "residual 1.0e-02, above 0.0001: the polish is unfinished (max_iterations)"
    assert others.optimality == unfinished
    stopped = replace(others, interrupted=True)
    assert stopped.optimality == "residual 1.0e-02, above 0.0001: the polish was interrupted"
    others = replace(others, stalled=np.array([True, True, False, False]))
    stalled = "residual 1.0e-02, above 0.0001: the polish stalled; precision=64 may get further"
    assert others.optimality == stalled
    assert others.polished == ["stalled", "stalled", "unfinished", "unfinished"]
    ended = replace(made, interrupted=True, max_defect=np.array([0.0, 1.0, 0.0, 1.0]))
    ended = replace(ended, died_at=np.array([-1, -1, -1, 3]))
    assert ended.status == ["optimal", "interrupted", "feasible", "diverged"]


def test_the_replay_that_succeeds_and_is_cheaper_speaks_for_a_chain():
    made = made_up(point(), 5)
    states = made.open_loop.states
    one = replace(
        made.open_loop,
        states=states + 1.0,
        cost=np.array([2.0, 1.0, 9.0, 1.0, np.nan]),
        success=np.array([True, True, True, False, False]),
    )
    other = replace(one, cost=np.array([1.0, 2.0, 1.0, 2.0, 1.0]), states=states + 2.0)
    other = replace(other, success=np.array([True, True, False, True, False]))
    made = replace(made, open_loop=one, feedback=other, cost=np.arange(5.0))
    assert open_loop_is_better(one, other).tolist() == [False, True, True, False, False]
    assert made.replay_cost.tolist() == [1.0, 1.0, 9.0, 2.0, 1.0]
    assert made.best_chain == 0  # certified, and the cheapest as replayed
    assert made.replay_mode == "with feedback"
    assert (made.replayed[0] == states[0] + 2.0).all()
    assert made.optima[0].cost == 1.0


@pytest.mark.slow
def test_tolerances_come_back_and_can_be_changed(tmp_path):
    problem = point(inequality=lambda x, u: u - 0.4)
    solver = Langevin(iterations=10, tail=20)
    loose = Tolerances(inequality=5.0, tracking=[1.0, 1.0])
    found = solve(problem, chains=2, solver=solver, tolerances=loose)
    again = Solution.load(found.save(tmp_path), problem)
    assert again.tolerances == loose
    np.testing.assert_array_equal(again.feedback.violations.size, found.feedback.violations.size)
    strict = again.certify(Tolerances(inequality=0.0, relative=0.0))
    assert strict.tolerances.inequality == 0.0
    assert strict.feedback.success.sum() <= found.feedback.success.sum()


@pytest.mark.slow
def test_each_problem_of_a_batch_is_judged_by_its_own_constraint():
    def limited(limit):
        return mass(
            terminal_residual=lambda x: 10 * (x - jnp.array([0.5, 0.0])),
            inequality=Partial(lambda limit, x, u: u - limit, limit),
        )

    limits = np.array([2.0, 0.7, 1e-3])  # with the last one it cannot get there: it stays
    base = limited(jnp.asarray(1.0))

    def make(limit):
        inequality = Partial(base.constraint.inequality.func, limit)
        return replace(base, constraint=replace(base.constraint, inequality=inequality))

    found = solve_batch(make, limits, chains=2, solver=Langevin(iterations=20, tail=40))
    place = KINDS.index("inequality")
    sizes = found.open_loop.violations.size[:, place]
    expected = np.maximum(found.open_loop.controls[..., 0] - limits[:, None], 0).max(axis=1)
    np.testing.assert_allclose(sizes, expected, atol=1e-6)
    assert found.status == ["feasible" if f else "infeasible" for f in found.feasible]
    away = replace(found, x=found.x.copy(), chain_defect=np.ones_like(found.chain_defect))
    away.x[0, 4:, 0] += 7.0
    where = away.where(0)
    assert (where.kind, where.entry, where.knot) == ("dynamics", 0, 3)
    assert where.size == pytest.approx(7.0, rel=1e-3)
    assert found.feasible[0]
    assert found.where(0) is None
    assert np.isnan(found.residual).all()
    assert not found.optimal.any()
    strict = replace(found, chain_residual=np.zeros_like(found.chain_residual))
    np.testing.assert_array_equal(strict.optimal, found.certified)


def test_a_plan_that_its_replay_does_not_follow_is_not_called_optimal():
    x = np.linspace(0.0, [[1.0, 0.0]] * 4 + [[0.0, 0.0], [100.0, 1.0]], 5, axis=1)  # (6, 5, 2)
    off, cost = np.array([0.0, 2.0, 2.0, 0.05, 2e-8, 0.5]), np.array([1, 1, 1, 1e-9, 1e-25, 1])
    replayed = np.array([1.0, 1.02, 50.0, 1e-7, 4e-15, 50.0])
    found = solve(point(), chains=2, progress=False)
    states = x.copy()
    states[:5, -1, 0] += off[:5]
    states[5, 2, 1] += off[5]  # half of what this coordinate moves, little of what the other does
    ran = replace(found.feedback, states=states, cost=replayed, success=np.ones(6, bool))
    ran = replace(ran, controls=np.zeros((6, 4, 2)))
    kept = followed(found.problem, x, cost, ran, ran)
    # the third reaches its goal another way, the fifth rests
    np.testing.assert_array_equal(kept, [True, True, False, True, True, False])
    assert found.optimal
    assert found.followed.all()
    other = replace(found.feedback, states=found.plans + 9.0, cost=found.feedback.cost + 1.0)
    other = replace(found, feedback=other, open_loop=other)
    assert other.certified
    assert not other.optimal
    assert other.verdict == "CERTIFIED, not known to be optimal"
    assert other.optimality.endswith("of a plan that the replay does not follow")


@pytest.mark.parametrize(
    ("place", "tolerated", "warned"),
    [
        (1e-4, None, False),
        (0.1, None, False),
        (0.1, 0.09, True),
        (1e-4, 1e-6, False),
        (0, 1, False),
    ],
    ids=["short", "far", "far-but-tolerated", "short-but-strict", "stays"],
)
def test_an_end_that_asks_less_than_is_tolerated_is_warned_of(place, tolerated, warned):
    at_rest = mass(terminal_equality=lambda x: x - jnp.array([place, 0.0]))
    x, u = motion(2.5 * place)
    wild = np.stack([1e4 * x, x]), np.stack([1e4 * u, u])  # a plan that is not certified, and one
    given = Family.of_one(at_rest), *wild, Tolerances(terminal_equality=tolerated), 1
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_loose_ends(*given)
    told = [f"off the terminal equality [0] by {place:.1e}" in str(w.message) for w in found]
    assert told == [True] * warned


@pytest.mark.parametrize(
    ("far", "moves", "start", "warned"),
    [
        (1e-6, 2e-7, None, True),
        (1e-5, 2e-6, None, False),
        (1e-5, 2e-6, ([0.0, -1.0], [0.0, 1.0]), False),
        (1e-5, 0.5, None, False),
        (0.5, 0.5, None, False),
        (0.0, 0.0, None, False),
    ],
    ids=[
        "beyond-what-is-told-apart",
        "fine-axis",
        "chosen-start",
        "ends-near-its-start",
        "far",
        "stays",
    ],
)
def test_an_entry_that_asks_less_than_the_box_lets_it_is_warned_of(far, moves, start, warned):
    def step(x, u):
        return x + 0.1 * u

    target = jnp.array([1.0, far])
    gantry = from_function(
        step, x_init=[0.0, 0.0], nu=2, horizon=1.0, dt=0.1, running_cost=lambda x, u: u @ u,
        terminal_equality=lambda x: x - target, x_init_bounds=start,
    )  # fmt: skip
    x = np.linspace(0.0, [1.0, moves], 11)[None]
    u = np.diff(x, axis=1) / 0.1
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_loose_ends(Family.of_one(gantry), x, u, Tolerances(), 0)
    told = [f"terminal equality [1] by {far:.1e}" in str(w.message) for w in found]
    assert told == [True] * warned


def test_what_moves_by_itself_is_judged_by_what_controls_change():
    """A mass that drifts by 1000 and is to be 1 further; and one at rest, moved by 1."""
    drifts = mass(x_init=[0.0, 1000.0 / (K * DT)], terminal_equality=lambda x: x[:1] - 1001.0)
    x, u = motion(1.0 / motion()[0][-1, 0])
    drift = np.outer(DT * np.arange(K + 1), [1000.0 / (K * DT), 0.0])
    drift[:, 1] = 1000.0 / (K * DT)
    moving = replayed(drifts, x + drift, u).violations
    still = replayed(mass(terminal_equality=lambda x: x[:1] - 1.0), x, u).violations
    at = KINDS.index("terminal_equality")
    assert moving.allowed[0, at] == pytest.approx(still.allowed[0, at], rel=1e-2)
    assert moving.allowed[0, at] < 0.01


def test_where_the_start_is_chosen_it_is_no_coasting():
    """A mass that is thrown, and then left alone; its velocity is what is chosen."""
    thrown = mass(terminal_equality=lambda x: x[:1] - 5.0, x_init_bounds=([0, -9], [0, 9]))
    x = np.outer(DT * np.arange(K + 1), [5.0 / (K * DT), 0.0])
    x[:, 1] = 5.0 / (K * DT)
    nx = thrown.dynamics.nx
    plan = np.concatenate([x, np.repeat([[x[0, 1]]], K + 1, axis=0)], axis=1)[None, :, :nx]
    of_x, *_ = driven_extents(Family.of_one(thrown), np.zeros(1, int), plan, np.zeros((1, K, 1)))
    assert of_x[0, 0] == pytest.approx(5.0)


def test_a_row_is_not_kept_if_it_is_off_by_a_tenth_of_all_that_it_ever_is():
    """As a stiff contact: it changes by thousands where a knot moves, and asks for 12 or less."""
    stiff = mass(inequality=lambda x, u: 20.0 * jnp.tanh(1e3 * (x[:1] - 0.5)) - 12.0)
    x, u = motion(1.0 / motion()[0][-1, 0])
    found = replayed(stiff, x, u).violations
    at = KINDS.index("inequality")
    assert found.size[0, at] == pytest.approx(8.0, abs=0.1)
    assert found.allowed[0, at] <= 3.3  # of 32


def test_where_float32_knows_states_too_coarsely_is_told():
    x, u = motion()
    far = x + np.array([1e5, 0.0])
    for there, told in ((x, []), (far, ["x0 is up to 1e+05, which float32 knows to 1.2e-02"])):
        problem = mass(x_init=there[0], x_scatter=(there[0] - 1.0, there[0] + 1.0))
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            warn_of_rounding(Family.of_one(problem), there[None], u[None], Tolerances(), 0)
        assert [str(w.message).partition(",")[0] for w in found] == [
            words.partition(",")[0] for words in told
        ]


def test_of_violations_without_a_tolerance_the_largest_is_told():
    sizes, allowed = np.array([[0.0], [0.5], [2.0]]), np.zeros((3, 1))
    assert next(worst_knots("state_bounds", sizes, allowed, 0)).size in (0.5, 2.0)


def test_the_worst_of_a_plan_is_relative_to_what_plans_may_break():
    of_dynamics = Violation("dynamics", 0.6, 0.2, 0, 3)  # three times what is allowed
    broken = Violation("inequality", 0.5, 0.4, 1, 2)  # less, and 500 times what a plan may
    bounds = Violation("state_bounds", 9.0, 1.0, 0, 0)
    two = mass(inequality=lambda x, u: jnp.zeros(2))
    worst = most_broken(two, [bounds, broken], of_dynamics)
    assert worst == broken._replace(allowed=FEASIBLE)
    assert most_broken(two, [bounds], of_dynamics) is of_dynamics
    assert most_broken(two, []) is None


SERVO = """<mujoco><option timestep="0.01"/><worldbody>
  <body><joint name="j" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0" mass="1"/></body></worldbody>
  <actuator><position joint="j" kp="40" ctrlrange="-2 2"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"goal": lambda data: abs(data.actuator_force[0]) < 1.5}, ["the goal is asked with"]),
        ({"goal": lambda data: abs(data.actuator_force[0]) < 99.0}, []),
        ({"goal": lambda data: abs(data.qpos[0]) < 1.5}, []),
        ({"terminal_inequality": lambda data: data.actuator_force - 1.5}, ["terminal constraints"]),
        ({"terminal_inequality": lambda data: data.qpos - 1.5}, []),
    ],
)
def test_what_reads_forces_at_the_end_is_warned_of(asked, told):
    problem = from_mjcf(SERVO, horizon=0.1, running_residual=lambda data, u: u, **asked)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_controls_at_the_end(problem, np.array([0.02, 0.0]), np.array([-0.05]), 0.1)
    assert [str(w.message)[: len(start)] for w, start in zip(found, told, strict=True)] == told
