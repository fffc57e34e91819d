"""The picture of a solution, for functions and models, whatever became of the chains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

from mjx_drax import plotting
from mjx_drax.errors import DraxError
from mjx_drax.langevin import Langevin
from mjx_drax.plotting import plot_solution
from mjx_drax.restarts import Restarts
from mjx_drax.solution import WITH_FEEDBACK, Solution, solve
from mjx_drax.tasks import load


@pytest.fixture(scope="module")
def pendulum() -> Solution:
    settings = Restarts(Langevin(iterations=30, tail=20), descent=30, attempts=1)
    return solve(load("pendulum").make(), chains=8, solver=settings)


@pytest.fixture(scope="module")
def cartpole() -> Solution:
    problem = load("cartpole_swingup").make(horizon=0.2)
    return solve(problem, chains=2, solver=Langevin(iterations=3, tail=1))


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


def test_draw_adds_a_panel_of_the_replayed_motion(pendulum: Solution, tmp_path: Path) -> None:
    seen = []

    def draw(axes: Axes, states: np.ndarray) -> None:
        seen.append(states)
        axes.plot(*states.T)

    plot_solution(pendulum, tmp_path / "pendulum.png", draw=draw)
    np.testing.assert_array_equal(seen, [pendulum.replayed[0]])


def test_model_names_joints_and_actuators(cartpole: Solution, tmp_path: Path) -> None:
    assert _size(plot_solution(cartpole, tmp_path / "cartpole.png")) == (1200, 1290)
    positions, velocities, controls = plotting._motion(cartpole)
    assert positions.labels == ["slider [m]", "pole [rad]"]
    assert velocities.labels == ["slider [m/s]", "pole [rad/s]"]
    assert controls.labels == ["force"]
    np.testing.assert_array_equal(velocities.plan[1:], cartpole.best.x[:, 2:])
    np.testing.assert_array_equal(positions.replay, cartpole.replayed[0][:, :2])
    np.testing.assert_allclose(positions.upper[0], [1.8, np.inf], rtol=1e-6)
    np.testing.assert_array_equal(controls.lower, -np.ones((10, 1)))


def test_more_curves_than_colors_are_split() -> None:
    labels = [f"x[{i}]" for i in range(14)]
    values = np.arange(14.0) * np.ones((3, 1))
    parts = plotting.Curves("states", labels, values, values, values, values).parts()
    assert len(parts) == 3
    for part in parts:
        assert len(part.labels) <= len(plotting.CURVES)
        assert part.labels == [f"x[{i:.0f}]" for i in part.plan[0]]
    assert sorted(label for part in parts for label in part.labels) == sorted(labels)


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
    assert "NOT CERTIFIED" in plotting._title(bad)
    assert _size(plot_solution(bad, tmp_path / "bad.png")) == (1200, 1290)


def test_title_tells_what_the_replays_did(pendulum: Solution) -> None:
    lines = plotting._title(pendulum).split("\n")
    chain = pendulum.best_chain
    assert f"cost {pendulum.cost[chain]:.4g}" in lines[1]
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
