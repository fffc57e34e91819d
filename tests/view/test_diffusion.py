"""Recordings of solves, the film of a diffusion, the time-lapse, and files of films."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from jax import Array
from matplotlib.axes import Axes
from PIL import Image

from mjx_drax.base.errors import DraxError
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.schedules import Constant
from mjx_drax.problem.build import from_function
from mjx_drax.problem.trajectory import Knot
from mjx_drax.search import recording
from mjx_drax.search.recording import Recorder, Recording, Snapshot, Tries
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.solve import solve
from mjx_drax.tasks import load
from mjx_drax.view import diffusion, frames, renderer, scene, video
from mjx_drax.view.diffusion import render_diffusion
from mjx_drax.view.timelapse import render_timelapse

SHORT = Langevin(iterations=6, tail=4, noise=Constant(0.1))


@pytest.fixture(scope="module")
def trapped() -> Solution:
    """A function that brings a drawing."""
    return solve(load("bug_trap").make(horizon=1.0), chains=3, solver=SHORT, record=2)


def _snapshot(iteration: int, cost: list[float], max_defect: list[float]) -> Snapshot:
    places = len(cost)
    x = np.full((places, 4, 2), float(iteration)) + np.arange(places)[:, None, None]
    arrays = np.zeros((places, 4)), np.array(cost), np.array(max_defect)
    return Snapshot(iteration, 0.0, x, *arrays)


@pytest.mark.slow
def test_recording_does_not_change_the_answer(trapped: Solution) -> None:
    plain = solve(load("bug_trap").make(horizon=1.0), chains=3, solver=SHORT)
    np.testing.assert_array_equal(plain.trajectories.x, trapped.trajectories.x)
    np.testing.assert_array_equal(plain.gains, trapped.gains)
    assert plain.recording is None


def test_a_path_begins_scattered_and_ends_at_the_answer(trapped: Solution) -> None:
    assert trapped.recording is not None
    for chain in range(3):
        path = trapped.recording.history_of(chain)
        np.testing.assert_array_equal(path.iteration, [0, 2, 4, 6, 8, 10])
        np.testing.assert_array_equal(path.x[-1], trapped.trajectories.x[chain])
        np.testing.assert_allclose(path.max_defect, path.defects.max(axis=1), rtol=1e-6)
        np.testing.assert_allclose(path.sigma, [0.1, 0.1, 0.1, 0.0, 0.0, 0.0], rtol=1e-6)
        assert path.max_defect[-1] == trapped.max_defect[chain]
        assert np.abs(path.x[0] - path.x[-1]).max() > 0.1


def test_a_path_follows_the_best_try_of_each_attempt_up_to_the_answer() -> None:
    first = Tries([_snapshot(0, [9, 9, 9], [5, 5, 5])], owners=np.arange(3))
    first.snapshots.append(_snapshot(10, [1.0, 5.0, 0.1], [1e-6, 1e-6, 0.5]))
    second = Tries([_snapshot(10, [9, 9, 9], [5, 5, 5])], owners=np.array([1, 2, 2]))
    second.snapshots.append(_snapshot(20, [6.0, 4.0, 3.0], [1e-6, 1e-6, 1e-6]))
    attempts = Recording([first, second])
    assert list(attempts.history_of(0).iteration) == [0, 10]  # the second did not work for it
    assert list(attempts.history_of(1).iteration) == [0, 10]  # the second was worse
    path = attempts.history_of(2)  # two tries, and the last place's is the cheaper
    assert list(path.attempt) == [0, 0, 1, 1]
    assert list(path.cost) == pytest.approx([9.0, 0.1, 9.0, 3.0])
    assert list(path.x[:, 0, 0]) == [2.0, 12.0, 12.0, 22.0]


def test_memory_is_bounded(trapped: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    assert trapped.recording is not None
    size = trapped.recording.attempts[0].snapshots[0].size
    monkeypatch.setattr(recording, "LIMIT", 8 * size)
    solver = Langevin(iterations=30, tail=11, noise=Constant(0.1))
    many = solve(load("bug_trap").make(horizon=1.0), chains=3, solver=solver, record=1)
    assert many.recording is not None
    shots = many.recording.attempts[0].snapshots
    assert sum(shot.size for shot in shots) <= 8 * size
    assert len(shots) > 3
    assert (shots[0].iteration, shots[-1].iteration) == (0, 41)


def test_what_cannot_be_recorded() -> None:
    for every in (0, 1.5, -1):
        with pytest.raises(DraxError, match="record is"):
            Recorder(every)  # type: ignore[arg-type]


def test_a_recorder_records_one_solve() -> None:
    used = Recorder(1)
    used.begin()
    with pytest.raises(DraxError, match="make another one"):
        solve(load("pendulum").make(), chains=1, record=used)


def test_a_chain_of_which_nothing_was_recorded() -> None:
    tries = Tries([_snapshot(0, [0.0, 1.0], [0.0, 0.0])], owners=np.array([0, -1]))
    with pytest.raises(DraxError, match="nothing of chain 1"):
        Recording([tries]).history_of(1)


def test_the_film_of_a_free_duration_shows_the_time_of_its_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drift(x: Array, u: Array, knot: Knot) -> Array:
        return x + knot.dt * u

    problem = from_function(
        drift,
        x_init=[0.0],
        nu=1,
        horizon=(0.5, 4.0),
        knots=5,
        running_cost=lambda x, u: u @ u,
    )
    solution = solve(problem, chains=1, solver=SHORT, record=2)
    seen = []

    def remember(times: np.ndarray, *_: object) -> np.ndarray:
        seen.append(times)
        return times

    monkeypatch.setattr(diffusion, "frame_times", remember)
    render_diffusion(
        solution,
        tmp_path / "film.webp",
        seconds=0.2,
        fps=5,
        size=(160, 120),
        draw=lambda axes, x: axes.plot(x[:, 0], x[:, 1]),
    )
    np.testing.assert_array_equal(seen[0], solution.times)
    assert abs(solution.times[-1] - problem.times[-1]) > 1e-3


@pytest.mark.parametrize("painted", [False, True])
@pytest.mark.slow
def test_film_of_a_model(
    cartpole: Solution, painted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if painted:
        monkeypatch.setattr(renderer, "gl_context", lambda: None)
    path = render_diffusion(
        cartpole, tmp_path / "new" / "film.webp", seconds=0.5, fps=8, size=(240, 180), poses=4
    )
    with Image.open(path) as image:
        assert image.size == (240, 180)
        # The scattered knots, their way, the end; then two tenths of a second, and it is held.
        shown = []
        for i in range(image.n_frames):  # type: ignore[attr-defined]
            image.seek(i)
            shown.append(np.asarray(image.convert("RGB"), int))
    robots = shown[0][:130]
    difference = [np.abs(frame - shown[0]).mean() for frame in shown]
    assert difference[-1] > 2.0
    assert (robots[..., 0] > robots[..., 2] + 90).sum() > 50  # poses that break the dynamics
    assert [item.name for item in path.parent.iterdir()] == ["film.webp"]


def test_film_of_a_function(trapped: Solution, tmp_path: Path) -> None:
    draw = load("bug_trap").draw
    path = render_diffusion(
        trapped, tmp_path / "film.mp4", seconds=0.4, fps=5, size=(300, 200), draw=draw
    )
    assert path.stat().st_size > 2000


def test_paths_are_where_the_task_draws_them() -> None:
    def draw(axes: Axes, states: np.ndarray) -> None:
        axes.plot([0, 1], [0, 1])
        axes.plot(10 * states[:, 1], states[:, 0])

    states = np.random.default_rng(0).normal(size=(3, 4, 2))
    points = diffusion.traced(draw, states)
    np.testing.assert_array_equal(points, states[..., ::-1] * [10, 1])
    with pytest.raises(DraxError, match="one vertex for each state"):
        diffusion.traced(lambda axes, states: None, states)


def test_colors_go_from_feasible_to_the_worst() -> None:
    colors = diffusion.Colors(10.0)
    shades = colors([1e-9, 1e-3, 10.0, 99.0, np.nan])
    np.testing.assert_array_equal(shades[0], shades[1])
    np.testing.assert_array_equal(shades[2:], shades[[2, 2, 2]])
    assert shades[0, 2] > 0.8 > 0.2 > shades[2, 2]  # blue and not


def test_film_time_is_spent_where_knots_move() -> None:
    x = np.zeros((21, 3, 1))
    x[:, :, 0] = np.array([1.0, 2.0, 4.0]) * 0.3 ** np.arange(21)[:, None]
    path = recording.ChainHistory(
        iteration=np.arange(21),
        sigma=np.zeros(21),
        cost=np.ones(21),
        max_defect=x.max(axis=(1, 2)),
        attempt=np.zeros(21, int),
        x=x,
        defects=x[..., 0],
    )
    at = diffusion.frame_moments(path, 4.0, 25.0)
    assert (at[0], at[-1]) == (0.0, 20.0)
    assert (np.diff(at) >= 0.0).all()
    assert np.median(at) < 5.0


def test_a_film_of_one_snapshot_stands_still() -> None:
    at = diffusion.frame_moments(_timeline([0], [0]), 4.0, 25.0)
    assert len(at) > 100
    assert not at.any()


def _timeline(iteration: list[int], attempt: list[int]) -> recording.ChainHistory:
    count = len(iteration)
    numbers = np.ones(count)
    return recording.ChainHistory(
        iteration=np.array(iteration),
        sigma=numbers,
        cost=numbers,
        max_defect=numbers,
        attempt=np.array(attempt),
        x=np.ones((count, 2, 1)),
        defects=np.ones((count, 2)),
    )


def test_other_chains_are_shown_at_the_same_time() -> None:
    one = _timeline([0, 2, 4, 4, 6], [0, 0, 0, 1, 1])
    early, late = _timeline([0, 4], [0, 0]), _timeline([0, 4, 4, 8, 8, 12], [0, 0, 1, 1, 2, 2])
    assert diffusion.same_moment(one, late, 0.5) == (0, 1, 0.25)
    assert diffusion.same_moment(one, late, 2.0) == (1, 1, 0.0)  # its first attempt ends as well
    assert diffusion.same_moment(one, late, 3.0) == (2, 3, 0.0)  # the second begins
    assert diffusion.same_moment(one, late, 3.5) == (2, 3, 0.25)
    assert diffusion.same_moment(one, late, 4.0) == (5, 5, 0.0)  # its answer
    assert diffusion.same_moment(one, early, 3.5) == (1, 1, 0.0)


def test_what_cannot_be_filmed(trapped: Solution, cartpole: Solution, tmp_path: Path) -> None:
    target = tmp_path / "film.mp4"
    bare = solve(load("bug_trap").make(horizon=1.0), chains=3, solver=SHORT)
    with pytest.raises(DraxError, match="record=1"):
        render_diffusion(bare, target)
    with pytest.raises(DraxError, match="pass draw="):
        render_diffusion(trapped, target)
    for name, value in {"seconds": 0, "poses": -1, "chains": 0, "fps": 0, "speed": -1}.items():
        with pytest.raises(DraxError, match=name):
            render_diffusion(cartpole, target, **{name: value})  # type: ignore[arg-type]
    with pytest.raises(DraxError, match="no camera 'side'"):
        render_diffusion(cartpole, target, camera="side")
    with pytest.raises(DraxError, match=r"\.gif"):
        render_diffusion(cartpole, tmp_path / "film.avi")
    assert not list(tmp_path.iterdir())


def test_timelapse(cartpole: Solution, tmp_path: Path) -> None:
    pictures = {}
    for count in (1, 2, 6):
        path = render_timelapse(cartpole, tmp_path / f"{count}.png", count=count, size=(160, 120))
        with Image.open(path) as image:
            assert image.size == (160, 120)
            pictures[count] = np.asarray(image.convert("RGB"), int)
    assert 0 < np.abs(pictures[2] - pictures[1]).mean() < np.abs(pictures[6] - pictures[1]).mean()


def test_a_task_without_a_model_draws_its_timelapse(trapped: Solution, tmp_path: Path) -> None:
    drawn = []
    picture = {"size": (160, 120), "draw": lambda axes, states: drawn.append(states)}
    with Image.open(render_timelapse(trapped, tmp_path / "a.png", **picture)) as image:
        assert image.size == (160, 120)
    assert len(drawn[0]) == trapped.problem.horizon + 1


def test_what_has_no_timelapse(cartpole: Solution, trapped: Solution, tmp_path: Path) -> None:
    with pytest.raises(DraxError, match="no model"):
        render_timelapse(trapped, tmp_path / "a.png")
    with pytest.raises(DraxError, match="count"):
        render_timelapse(cartpole, tmp_path / "a.png", count=0)
    with pytest.raises(DraxError, match=r"\.png"):
        render_timelapse(cartpole, tmp_path / "a.jpg")


def test_bodies_that_travel() -> None:
    names = {"cartpole": None, "quadrotor": "quadrotor", "car_bug_trap": "car"}
    for name, body in names.items():
        path = Path(__file__).parents[2] / "models" / f"{name}.xml"
        model = mujoco.MjModel.from_xml_path(str(path))
        index = scene.travelling_body(model)
        assert (None if index is None else model.body(index).name) == body
        if index is not None:
            start = scene.body_positions(model, index, np.tile(model.qpos0, (2, 3, 1)))
            assert start.shape == (2, 3, 3)


def _frames(count: int) -> Iterator[np.ndarray]:
    for i in range(count):
        frame = np.full((20, 30, 3), 200, np.uint8)
        frame[:, i : i + 5] = (180, 40, 20)
        yield frame


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animations_loop_in_time(suffix: str, tmp_path: Path) -> None:
    path = frames.write(tmp_path / f"a{suffix}", (f for f in _frames(12)), 24.0)
    with Image.open(path) as image:
        assert image.n_frames == 12  # type: ignore[attr-defined]
        assert image.info["loop"] == 0
        lasted = 0
        for i in range(12):
            image.seek(i)
            image.load()
            lasted += image.info["duration"]
            red = np.asarray(image.convert("RGB"), int)[10]
            assert red[i + 2, 0] > red[i + 2, 1] + 80
    assert lasted == 500


def test_slow_motion_and_the_free_camera() -> None:
    times = np.array([0.0, 1.0])
    assert len(video.frame_times(times, 10.0, 0.5)) == 21 + 5
    with pytest.raises(DraxError, match="speed"):
        video.frame_times(times, 10.0, 0.0)
    path = Path(__file__).parents[2] / "models" / "cartpole.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    poses = np.array([[0.2, 0.0], [0.4, 3.0]])  # far from the posts
    near = scene.camera_for(model, poses, scene.FREE, 1.3)
    far = scene.camera_for(model, np.array([[-1.8, 0.0], [1.8, 3.0]]), scene.FREE, 1.3)
    assert near.azimuth == pytest.approx(90.0)  # as the camera "main" looks
    assert 0.1 < near.lookat[0] < 0.5
    assert far.distance > 1.5 * near.distance
    assert scene.camera_for(model, poses, "main", 1.3).fixedcamid == 0


def test_what_a_solve_could_not_film_is_refused_before_it() -> None:
    problem = SimpleNamespace(dynamics=SimpleNamespace(), name="thing")
    with pytest.raises(DraxError, match="thing has no model"):
        video.check(problem)  # type: ignore[arg-type]
