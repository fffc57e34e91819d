"""What `print` and notebooks show of a solution."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import BALL, arm, made_up, point, robot

from mjx_drax import (
    DraxError,
    Restarts,
    Solution,
    from_mjcf,
    from_program,
    minimize,
    solve_batch,
)
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.family import Family
from mjx_drax.solution import report
from mjx_drax.solution.names import difference_names
from mjx_drax.solution.replay import plan_violations
from mjx_drax.solution.report import lines
from mjx_drax.solution.violations import DYNAMICS, GOAL, KINDS, Violation

ONCE = Restarts(descent=5, attempts=1)


def test_print_is_the_report_and_repr_one_line():
    solution = made_up(robot())
    text = str(solution)
    assert text.splitlines()[0] == ("chains         2: 2 feasible; 100.0% succeed when replayed")
    assert text.splitlines()[-1] == solution.verdict == "CERTIFIED, not known to be optimal"
    assert f"engine         {solution.engine}" in text
    assert repr(solution) == (
        "<Solution of arm: 2 chains, CERTIFIED, not known to be optimal, cost 0 when replayed>"
    )
    assert f"{[solution]}" == f"[{solution!r}]"
    (optimum,) = solution.optima
    assert repr(optimum) == "<Optimum: cost 0, 100% of chains, residual nan, not optimal>"


def test_a_notebook_shows_the_report_as_a_table_and_no_markup_of_others():
    solution = made_up(point(name="a<b>&c"))
    good = solution._repr_html_()
    assert "<b>" not in good
    assert good.index("CERTIFIED") < good.index("<table>")
    for line in str(solution).splitlines()[:-1]:
        assert line[:15].strip() in good
    bad = replace(solution, max_defect=np.ones(2, np.float32))
    assert "NOT CERTIFIED: no plan is feasible" in str(bad).splitlines()[-1]
    colors = [text.split("color:")[1][:7] for text in (good, bad._repr_html_())]
    assert colors[0] != colors[1]


def test_an_infeasible_plan_says_which_bound_it_lies_on():
    made = made_up(point(u_bounds=([-1.0, -2.0], [1.0, 2.0])))
    u = made.trajectories.u.copy()
    far = replace(made, max_defect=np.ones(2, np.float32))
    for value, said in ((1.5, ""), (1.995, ", and u1 is on a bound at 4 of 10 knots")):
        u[:, 3:7, 1] = value
        advice = str(replace(far, trajectories=replace(made.trajectories, u=u))).splitlines()[-1]
        assert f"{said}. Try more iterations, or a longer horizon." in advice
        assert ("on a bound" in advice) == bool(said)
    u[:, :, 1] = value
    advice = str(replace(far, trajectories=replace(made.trajectories, u=u))).splitlines()[-1]
    assert "10 of 10 knots. Try wider bounds, a longer horizon, or more iterations." in advice


def test_constraints_that_cannot_hold_together_are_named():
    def apart(x, u):
        return jnp.array([0.1 + x[0], 0.2 - x[0], x[1] - 5.0])

    problem = point(inequality=apart, terminal_equality=lambda x: x[1:] - 1.0)
    made = made_up(problem, chains=4)
    off = plan_violations(Family.of_one(problem), made.plans.astype(float), made.trajectories.u)
    worst = np.array([0.2, 0.205, 0.195, 1.0], np.float32)
    bad = replace(made, max_defect=worst, plan=off)
    advice = str(bad).splitlines()[-1]
    assert "the best breaks terminal equality [0] by 1.0e+00" in advice
    assert (
        "; it also breaks inequality [1] by 2.0e-01 (tolerated: 1.0e-03) at knot 0, 0 s" in advice
    )
    assert "; it also breaks inequality [0] by 1.0e-01" in advice
    assert "inequality [2]" not in advice
    assert "So do 3 of 4 chains, as if what is asked had no solution: loosen it, or" in advice
    assert "iterations" not in advice
    few = str(replace(bad, max_defect=worst * [1, 2, 3, 4])).splitlines()[-1]
    assert few.endswith("at knot 0, 0 s. Try more iterations, or a longer horizon.")


def test_a_cost_without_a_lower_bound_is_told():
    made = made_up(robot())
    first = {**made.history, "cost": np.array([[20.0, -30.0], [5.0, 5.0]])}
    for cost, residual, told in ((-1e8, 1.0, True), (-1e8, 1e-6, False), (-1e6, 1.0, False)):
        costs, residuals = np.full(2, cost, np.float32), np.full(2, residual, np.float32)
        found = replace(made, cost=costs, residual=residuals, history=first)
        assert ("the cost fell from about 30 to -1e+08, as if it had no" in str(found)) == told
    diverged = replace(found, cost=np.full(2, -np.inf), max_defect=np.ones(2, np.float32))
    assert "to -inf, as if it had no lower bound" in str(diverged).splitlines()[-1]


def test_a_step_of_the_engine_that_leaves_a_certified_plan_is_told(monkeypatch):
    solution = made_up(robot())
    for size, told in ((0.08, True), (0.0008, False)):
        found = [Violation(DYNAMICS, 0.0, 1e-3, 0, 1), Violation(DYNAMICS, size, 1e-3, 1, 3)]
        monkeypatch.setattr(report, "of_engine", lambda *of, found=found: found)
        said = f"at knot 3, {solution.times[3]:.3g} s, a step of MuJoCo ends 8.0e-02 off in"
        assert (said in str(solution)) == told
        assert ("(1.0e-03 tolerated)." in str(solution)) == told
    lost = replace(solution, max_defect=np.ones(2, np.float32))
    assert "a step of MuJoCo" not in str(lost)


def test_where_all_chains_diverged_more_iterations_are_no_advice():
    made = replace(made_up(point()), max_defect=np.ones(2, np.float32))
    lost = str(replace(made, died_at=np.array([7, 3]))).splitlines()[-1]
    assert "from iteration 3 on. Give bounds, or an x_scatter and a u_scatter" in lost
    assert "Try more iterations" in str(replace(made, died_at=np.array([7, -1])))


def test_an_infeasible_plan_of_free_duration_is_to_take_longer():
    free = {"horizon": (0.5, 1.0), "knots": 10, "dt": None}
    made = made_up(point(f=lambda x, u, knot: x + knot.dt * u, **free))
    advice = str(replace(made, max_defect=np.ones(2, np.float32))).splitlines()[-1]
    assert advice.endswith("or longer durations.")


def test_worst_names_entry_and_knot_of_plan_and_replay():
    problem = point(
        inequality=lambda x, u: jnp.stack([x[0] - 1.0, 2.0 * u[1] - 0.1]),
        u_bounds=(-1.0, 1.0),
        goal=lambda x: True,
    )
    made = made_up(problem)
    x, u = made.trajectories.x.copy(), made.trajectories.u.copy()
    x[1, 3, 1] = 0.5  # of x_4: the steps from knots 3 and 4 are broken
    u[1, 6, 1] = 0.25
    made = replace(made, trajectories=replace(made.trajectories, x=x, u=u))
    replayed = np.zeros((2, 10, 2))
    replayed[1, 7, 0] = 1.5
    made = replace(made, open_loop=replace(made.open_loop, controls=replayed))
    plan, replay = made.worst(chain=1).split("replay open loop of chain 1")
    heading, _, *rows = plan.splitlines()
    assert heading == (
        "plan of chain 1, feasible as JAX computes f (max|h| 0.0e+00), not as the replaying engine "
        "does: 2 of 6 entries above what is tolerated"
    )
    assert [row.split() for row in rows] == [
        ["dynamics", "x1", "3", "0.3", "5.0e-01", "1.7e-04", "broken"],  # a twelfth of the box ± 1
        ["inequality", "[1]", "6", "0.6", "4.0e-01", "1.0e-03", "broken"],
    ]
    heading, _, row = replay.splitlines()
    assert heading.startswith(", which reaches the goal")
    assert heading.endswith(": 1 of 4 entries above what is tolerated")
    assert row.split()[:6] == ["control", "bounds", "u0", "7", "0.7", "5.0e-01"]
    assert len(made.worst(chain=1, count=1).splitlines()) == 6
    assert len(made.worst(chain=0).splitlines()) == 2  # nothing is violated
    infeasible = replace(made, max_defect=np.ones(2, np.float32)).worst(chain=1)
    assert infeasible.splitlines()[0] == "plan of chain 1: 2 of 6 entries above what is tolerated"


def test_rotations_of_a_free_joint_have_names():
    names = difference_names(robot(arm(BALL)).dynamics)
    assert names[:4] == ["qpos_elbow", "qpos_hip_rx", "qpos_hip_ry", "qpos_hip_rz"]
    assert names[4:] == ["qvel_elbow", "qvel_hip_wx", "qvel_hip_wy", "qvel_hip_wz"]


def test_worst_refuses_what_is_no_chain_and_a_lost_problem(tmp_path):
    made = made_up(point())
    for arguments, words in (({"chain": 2}, "chain is 2"), ({"count": 0}, "count is 0")):
        with pytest.raises(DraxError, match=words):
            made.worst(**arguments)
    with pytest.raises(DraxError, match="load"):
        Solution.load(made.save(tmp_path)).worst()


@pytest.mark.slow
def test_a_minimum_is_shown_with_its_cost_and_what_it_breaks():
    program = from_program(2, cost=lambda z: z @ z, equality=lambda z: z[:1] - 1.0, name="square")
    found = minimize(program, chains=2, solver=Restarts(descent=20, attempts=1))
    text = str(found)
    cost = f"cost {found.cost[found.best_chain]:.5g}"
    assert f"best           {cost}, max|h| " in text
    assert repr(found) == f"<Minimum of square: 2 chains, {text.splitlines()[-1]}, {cost}>"
    off = replace(found, x=found.x + 1.0, max_defect=np.ones(2))
    assert str(off).splitlines()[-1].startswith("infeasible: breaks equality [0] by 1.0e+00")
    assert "infeasible" in off._repr_html_()


@pytest.mark.slow
def test_a_batch_is_shown_by_its_counts_and_by_what_failed():
    problem = point()
    starts = jnp.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    found = solve_batch(lambda x: replace(problem, x_init=x), starts, chains=2, solver=ONCE)
    assert f"{found!r}".startswith("<BatchSolution of point: 3 of 3 problems CERTIFIED")
    assert str(found).startswith("problems       3 of 2 chains each: ")
    lost = replace(found, chain_defect=np.array([[0, 0], [1, 1], [0, 0]], np.float32))
    assert "not certified  problems 1; where(i)" in str(lost)
    assert "2 of 3 problems CERTIFIED" in lost._repr_html_()
    none = replace(found, chain_defect=np.ones((3, 2), np.float32))
    assert "0 of 3 problems CERTIFIED" in str(none)


def test_the_advice_where_all_chains_miss_the_goal_at_the_same_cost():
    problem = point(goal=lambda x: False)
    made = made_up(problem, 4)
    same = replace(made.certify(), cost=np.array([2.0, 2.001, 2.0, 5.0], np.float32))
    assert "miss the goal, 3 of 4 at the same cost" in str(same).splitlines()[-1]
    others = replace(same, cost=np.array([2.0, 3.0, 4.0, 5.0], np.float32))
    assert "miss the goal or break constraints" in str(others).splitlines()[-1]


def test_the_advice_where_there_is_no_goal_and_replays_leave_the_plan():
    made = made_up(point(goal=None))
    off = replace(made.trajectories, x=made.trajectories.x + 0.5)
    judged = replace(made, trajectories=off).certify()
    told = str(replace(judged, max_defect=made.max_defect)).splitlines()[-1]
    assert "replays leave the plan" in told
    assert "tolerances.tracking" in told
    assert "goal or break" not in told


def test_the_advice_where_the_plan_lacks_a_contact(monkeypatch):
    made = made_up(robot(goal=lambda data: False))
    solution = replace(made.certify(), max_defect=made.max_defect)
    told = (2, "'floor' touches 'shin'")
    monkeypatch.setattr(type(solution.problem.dynamics), "left_out", lambda self, states: told)
    assert "at knot 2, 0.04 s, 'floor' touches 'shin', and the plan" in str(solution)


@pytest.mark.parametrize("rates", [{}, {"rates": 1}], ids=["plain", "extended"])
def test_the_advice_where_a_joint_meets_its_stop_between_two_knots(rates):
    """Its motor throws it back at 0.98 m, 5 cm before its stop or 1 cm behind it."""
    for end, met in ((1.03, False), (0.97, True)):
        text = f"""<mujoco><option timestep="0.005"/><worldbody><body>
          <joint name="slide" type="slide" axis="1 0 0" range="-9 {end}"/>
          <geom size=".1" mass="1"/></body></worldbody>
          <actuator><motor joint="slide"/></actuator></mujoco>"""
        x = np.array([[0.9, 8.0], *([0.86 - 0.4 * k, -8.0] for k in range(4))], np.float32)
        u = np.array([[-320.0], [0.0], [0.0], [0.0]], np.float32)
        problem = from_mjcf(
            text, horizon=0.2, dt=0.05, x_init=x[0], running_residual=lambda data, u: u, **rates
        )
        made = made_up(problem, 1)
        rest = problem.dynamics.nx - 2
        knots = np.concatenate([x[1:], np.zeros((4, rest), np.float32)], axis=1)
        if rest:
            knots[:, 2:] = u
        plan = replace(made, trajectories=Trajectory(knots[None], u[None])).certify()
        told = str(replace(plan, max_defect=made.max_defect)).splitlines()[-1]
        assert ("between knots a joint meets its stop" in told) == met
        assert ("at knot 0, 0 s, a step of MuJoCo ends" in told) == met
        assert (told == "CERTIFIED, not known to be optimal") != met


def test_one_motion_of_one_chain_or_of_several():
    made = made_up(point(), 2)
    assert "2 certified chains make the same motion, at costs from 0 to 0" in str(made)
    lost = replace(made, max_defect=np.array([0.0, 1.0], np.float32))
    assert "one: no other chain is certified" in str(lost)
    dear = replace(made.open_loop, cost=np.array([1.0, 1.2], np.float32))
    unlike = replace(made, open_loop=dear, feedback=dear)
    assert "2 certified chains make similar motions, at costs from 1 to 1.2" in str(unlike)


FLOOR = '<geom type="plane" size="1 1 0.1" pos="0 0 -1"/>'


@pytest.mark.parametrize("stops", [False, True])
def test_advice_tells_of_stops_that_joints_may_not_lean_on(stops, tmp_path):
    """And they are what they were when the solution is loaded."""
    problem = robot(arm(FLOOR), goal=lambda data: False, stops=stops)
    made = made_up(problem)
    missed = made.open_loop.violations
    missed.size[:, KINDS.index(GOAL)], missed.allowed[:, KINDS.index(GOAL)] = 1.0, 0.0
    lost = replace(made.open_loop, success=np.zeros(2, bool))
    told = lines(replace(made, open_loop=lost, feedback=lost))[-1]
    assert "miss the goal" in told
    assert ("stops=True" in told) is not stops
    made.save(tmp_path)
    assert Solution.load(tmp_path).problem.dynamics.stops == ([0] if stops else [])
