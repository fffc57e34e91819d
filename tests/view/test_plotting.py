"""The picture of a solution, for functions and models, whatever became of the chains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from builders import made_up, robot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from mjx_drax.base.errors import DraxError
from mjx_drax.method.langevin import Langevin
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.solution.names import difference_names
from mjx_drax.solution.replay import WITH_FEEDBACK
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.tasks import load
from mjx_drax.view import labels, phase_plots, plotting
from mjx_drax.view.plotting import plot_solution


def _size(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        image.load()
        assert image.format == "PNG"
        assert image.info["dpi"] == pytest.approx((150, 150), abs=0.1)
        return image.size


def test_function_problem(pendulum: Solution, tmp_path: Path) -> None:
    path = plot_solution(pendulum, tmp_path / "new" / "pendulum.png")
    assert path == tmp_path / "new" / "pendulum.png"
    assert _size(path) == (1200, 1290)  # five panels in three rows


def test_residuals_have_a_panel_where_there_was_a_polish(
    pendulum: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles = []
    monkeypatch.setattr(plotting, "label_panel", lambda axes, title, *_, **__: titles.append(title))
    plot_solution(pendulum, tmp_path / "polished.png")
    assert any(title.startswith("residual") for title in titles)
    titles.clear()
    unknown = {**pendulum.history, "residual": np.full_like(pendulum.history["cost"], np.nan)}
    plot_solution(replace(pendulum, history=unknown), tmp_path / "not.png")
    assert titles
    assert not any(title.startswith("residual") for title in titles)


def test_draw_adds_a_panel_of_the_replayed_motion(pendulum: Solution, tmp_path: Path) -> None:
    seen = []

    def draw(axes: Axes, states: np.ndarray) -> None:
        seen.append(states)
        axes.plot(*states.T)

    plot_solution(pendulum, tmp_path / "pendulum.png", draw=draw)
    np.testing.assert_array_equal(seen, [pendulum.replayed[0]])


def test_model_names_joints_and_actuators(cartpole: Solution, tmp_path: Path) -> None:
    assert _size(plot_solution(cartpole, tmp_path / "cartpole.png")) == (1200, 1290)
    positions, velocities, controls = plotting.motion_curves(cartpole)
    assert positions.labels == ["slider [m]", "pole [rad]"]
    assert velocities.labels == ["slider [m/s]", "pole [rad/s]"]
    assert controls.labels == ["force"]
    np.testing.assert_array_equal(velocities.plan[1:], cartpole.best.x[:, 2:])
    np.testing.assert_array_equal(positions.replay, cartpole.replayed[0][:, :2])
    np.testing.assert_allclose(positions.upper[0], [1.8, np.inf], rtol=1e-6)
    np.testing.assert_array_equal(controls.lower, -np.ones((10, 1)))


def test_more_curves_than_colors_are_split() -> None:
    labels = [f"x{i}" for i in range(14)]
    values = np.arange(14.0) * np.ones((3, 1))
    parts = plotting.Curves("states", labels, values, values, values, values).parts()
    assert len(parts) == 3
    for part in parts:
        assert len(part.labels) <= len(plotting.CURVES)
        assert part.labels == [f"x{i:.0f}" for i in part.plan[0]]
    assert sorted(label for part in parts for label in part.labels) == sorted(labels)


@pytest.mark.slow
def test_bounds_far_off_do_not_flatten_the_curves() -> None:
    plan, wide = np.array([[0.5], [-2.0]]), [np.full((2, 1), end) for end in (-1e3, 1e3)]
    near = [np.full((2, 1), end) for end in (-20.0, 20.0)]
    assert max(plotting._limits(plan, plan, wide)) < 1.0
    assert max(plotting._limits(plan, plan, near)) > 20.0
    assert max(plotting._limits(0.0 * plan, plan, wide)) > 1e3


def test_one_chain(tmp_path: Path) -> None:
    solver = Langevin(iterations=2, tail=0)
    one = solve(load("pendulum").make(), chains=1, solver=solver)
    assert _size(plot_solution(one, tmp_path / "one.png")) == (1200, 1290)


@pytest.mark.parametrize("kind", ["some", "all"])
@pytest.mark.filterwarnings("error")
def test_diverged_chains_and_replays(pendulum: Solution, kind: str, tmp_path: Path) -> None:
    died = np.arange(8) >= (3 if kind == "some" else 0)
    history = {
        **pendulum.history,
        "cost": np.where(died, np.nan, pendulum.history["cost"]),
        "max_defect": np.where(died, np.nan, pendulum.history["max_defect"]),
    }
    bad = replace(
        pendulum,
        died_at=np.where(died, 5, -1),
        cost=np.where(died, np.nan, pendulum.cost),
        max_defect=np.where(died, np.nan, pendulum.max_defect),
        history=history,
    )
    blown = bad.feedback.states.copy()
    blown[:, 9:] = np.nan
    lost = replace(
        bad.feedback, states=blown, success=np.zeros(8, bool), max_deviation=np.full(8, np.inf)
    )
    bad = replace(bad, open_loop=lost, feedback=lost)
    assert not bad.certified
    assert bad.outcome(WITH_FEEDBACK) == "diverges"
    assert "NOT CERTIFIED" in plotting.title_of(bad)
    assert _size(plot_solution(bad, tmp_path / "bad.png")) == (1200, 1290)


def test_title_tells_what_the_replays_did(pendulum: Solution) -> None:
    lines = plotting.title_of(pendulum).split("\n")
    chain = pendulum.best_chain
    assert f"cost {pendulum.replay_cost[chain]:.4g} (plan {pendulum.cost[chain]:.4g})" in lines[1]
    assert f"residual {pendulum.residual[chain]:.1e}, below 0.0001" in lines[1]
    unknown = replace(pendulum, residual=np.full(8, np.nan))
    assert "residual not known" in plotting.title_of(unknown)
    assert lines[0] == f"{pendulum.problem.name}: {pendulum.verdict}"
    assert f"max|h| {pendulum.max_defect[chain]:.1g}" in lines[1]
    assert f"{pendulum.success_rate:.0%} of 8 chains" in lines[1]
    for line, replay in zip(
        lines[2:], (pendulum.certificate.open_loop, pendulum.certificate.feedback), strict=True
    ):
        assert line.startswith("rollout of f, float64")
        assert ("reaches the goal" in line) == replay["success"]
        assert f"{replay['max_deviation']:.1e} off plan" in line


def test_nothing_global_changes(pendulum: Solution, tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    plot_solution(pendulum, tmp_path / "pendulum.png")
    assert dict(matplotlib.rcParams) == before


def test_paths_that_cannot_be_written(pendulum: Solution, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DraxError, match=r"\.png"):
        plot_solution(pendulum, tmp_path / "plot.pdf")
    with pytest.raises(DraxError, match="cannot write"):
        plot_solution(pendulum, tmp_path / "file" / "plot.png")


@pytest.fixture(scope="module")
def quadrotor() -> Dynamics:
    return load("quadrotor").make().dynamics


def test_quaternions_have_a_panel_of_their_own(quadrotor: Dynamics) -> None:
    groups = labels.state_groups(quadrotor)
    assert list(groups) == ["positions", "orientations", "velocities"]
    assert groups["positions"] == {0: "root x [m]", 1: "root y [m]", 2: "root z [m]"}
    assert groups["orientations"][3] == "root qw"
    assert list(groups["velocities"]) == [7, 8, 9, 10, 11, 12]
    assert groups["velocities"][12] == "root turn z [rad/s]"


def test_what_a_problem_leaves_open_is_named_and_drawn_at_the_motions_own_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = robot(horizon=(0.2, 0.8), knots=4, dt=0.1, parameters={"load": (0.5, 3.0)})
    names = ["qpos_elbow", "qvel_elbow", "load", "step"]
    made = made_up(problem)
    made.trajectories.x[:, :, 2:] = [0.7, 0.05]
    first = problem.start_from(np.float32([0.0, 0.0, 0.7, 0.05]))
    start = np.tile(np.asarray(first), (2, 1))
    found = replace(made, trajectories=replace(made.trajectories, start=start))
    groups = labels.state_groups(problem.dynamics)
    assert list(groups["left open"].values()) == ["load", "step"]
    seen = {}
    monkeypatch.setattr(
        Axes, "set_yticks", lambda self, at, ticks=(), **_: seen.update(ticks=ticks)
    )
    phase_plots.plot_multipliers(found, tmp_path / "multipliers.png")
    assert list(seen["ticks"]) == names
    np.testing.assert_allclose(found.times, np.arange(5) * 0.05, rtol=1e-6)
    step = plotting.motion_curves(found)[-2]
    assert "step" in step.labels
    np.testing.assert_allclose(step.plan[:, step.labels.index("step")], 0.05, rtol=1e-6)


def test_phase_plots_of_turns_are_in_tangent_space(quadrotor: Dynamics) -> None:
    assert labels.coordinates(quadrotor)[2:4] == [("root z", "m"), ("root turn x", "rad")]
    assert len(difference_names(quadrotor)) == 12
    angle = np.linspace(0.0, 3.0, 5)
    states = np.zeros((5, 13))
    states[:, 0], states[:, 12] = 2.0, 1.5
    states[:, 3], states[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
    positions, velocities = phase_plots.phases_of(quadrotor, states)
    np.testing.assert_allclose(positions[:, 5], angle, atol=1e-9)
    np.testing.assert_array_equal(positions[:, 0], 2.0)
    np.testing.assert_array_equal(velocities[:, 5], 1.5)


def test_phases_and_multipliers(pendulum: Solution, cartpole: Solution, tmp_path: Path) -> None:
    for solution, width in ((pendulum, 780), (cartpole, 960)):
        assert _size(phase_plots.plot_phase(solution, tmp_path / "phase.png"))[0] == width
    for solution, rows in ((pendulum, 2), (cartpole, 4)):
        size = _size(phase_plots.plot_multipliers(solution, tmp_path / "multipliers.png"))
        assert size == (1050, round(150 * (0.24 * rows + 1.7)))


def test_what_has_no_phases(tmp_path: Path) -> None:
    problem = SimpleNamespace(name="three", dynamics=SimpleNamespace(nx=3))
    three: Any = SimpleNamespace(problem=problem)
    with pytest.raises(DraxError, match="which of them are velocities"):
        phase_plots.plot_phase(three, tmp_path / "phase.png")


def test_marks_are_where_attempts_began(pendulum: Solution) -> None:
    began, ended = np.array([0, 31]), np.array([0, 44])
    marked = replace(pendulum, history={**pendulum.history, "began": began, "noise_ends": ended})
    axes = Figure().add_subplot()
    plotting.draw_defects(axes, marked)
    marks = {line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1}
    assert marks == {31, 44}
