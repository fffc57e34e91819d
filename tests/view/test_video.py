"""Frames and videos, with OpenGL where the machine has it and with numpy everywhere."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

from mjx_drax.base.errors import DraxError
from mjx_drax.physics.c_engine.states import interpolated
from mjx_drax.solution.solution import Solution
from mjx_drax.view import renderer, video
from mjx_drax.view.frames import DARK, caption_height
from mjx_drax.view.scene import Scene, camera_for

ROOT = Path(__file__).resolve().parents[2]
HEIGHT, WIDTH = 120, 160


def _model(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROOT / "models" / f"{name}.xml"))


def _has_opengl() -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return renderer.gl_context() is not None


def _amber(frame: np.ndarray) -> np.ndarray:
    """Where (height, width) the pixels have the color of the moving links' ends."""
    red, green, blue = (frame[..., i].astype(int) for i in range(3))
    return (red > 90) & (red > green + 25) & (green > blue + 10)


def _decoded(path: Path, height: int, width: int) -> np.ndarray:
    """Frames (N, height, width, 3) of a film; mediapy's reader fails with this ffmpeg."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(path)]
    pixels = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run([*command, *pixels], capture_output=True, check=True).stdout
    return np.frombuffer(decoded, np.uint8).reshape(-1, height, width, 3)


def _distance(one: np.ndarray, other: np.ndarray) -> int:
    """Largest difference of two frames, in 0..255."""
    return int(np.abs(one.astype(int) - other).max())


def _draw_angle(axes: Axes, states: np.ndarray) -> None:
    axes.plot(np.sin(states[:, 0]), np.cos(states[:, 0]), "o-")
    axes.set(xlim=(-2, 2), ylim=(-2, 2), aspect="equal")


def _judged(solution: Solution, feasible: bool, open_loop: bool, feedback: bool) -> Solution:
    """The solution, as if this had come of all its chains and their replays."""
    chains = solution.chains
    return replace(
        solution,
        max_defect=np.full(chains, 1e-6 if feasible else 0.1),
        open_loop=replace(solution.open_loop, success=np.full(chains, open_loop)),
        feedback=replace(solution.feedback, success=np.full(chains, feedback)),
    )


@pytest.fixture(autouse=True)
def _fresh_choice() -> Iterator[None]:
    renderer.gl_context.cache_clear()
    yield
    renderer.gl_context.cache_clear()


@pytest.fixture(params=["opengl", "software"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "software":
        monkeypatch.setattr(renderer, "gl_context", lambda: None)
    elif not _has_opengl():
        pytest.skip("no OpenGL on this machine")
    return str(request.param)


def test_frames_have_the_asked_shape(backend: str) -> None:
    frames = video.render_frames(
        _model("pendulum"), [[0.0], [1.0]], [0.0, 0.5], fps=10, size=(WIDTH, HEIGHT)
    )
    assert frames.shape == (6 + 5, HEIGHT, WIDTH, 3)  # six instants, then half a second held
    assert frames.dtype == np.uint8
    assert np.any(frames[0] != frames[5])
    for held in frames[6:]:
        np.testing.assert_array_equal(held, frames[5])


def test_what_is_translucent_is_seen_in_front_of_nothing(backend: str) -> None:
    ball = '<body pos="{} 0 0"><joint/><geom size="0.2" rgba="1 0 0 {}"/></body>'
    xml = "<mujoco><worldbody>{}</worldbody></mujoco>"
    seen = [
        video.render_frames(
            mujoco.MjModel.from_xml_string(xml.format(ball.format(0, alpha) + ball.format(1, 1))),
            [[0.0, 0.0]], [0.0], fps=1, size=(WIDTH, HEIGHT),
        )[0].astype(float)
        for alpha in (0.0, 0.5, 1.0)
    ]  # fmt: skip
    clear, half, solid = seen
    there = np.abs(solid - clear).max(axis=2) > 40
    assert there.sum() > 50
    share = ((clear - half) / np.maximum(clear - solid, 1.0))[there][:, 1]  # of green, the sky's
    assert share.min() > 0.4
    assert np.median(share) < 0.85  # OpenGL draws its front and its back: 1 - 0.5^2


@pytest.mark.parametrize(
    ("name", "right", "up"),
    [
        ("pendulum", [np.pi / 2], [np.pi]),
        ("acrobot", [np.pi / 2, 0.0], [np.pi, 0.0]),
        ("cartpole", [0.0, np.pi / 2], [0.0, np.pi]),
    ],
)
def test_the_robot_is_where_its_angle_says(
    name: str, right: list[float], up: list[float], backend: str
) -> None:
    down = [0.0] * len(up)
    poses = np.array([down, right, up, [-angle for angle in right]])
    frames = video.render_frames(_model(name), poses, range(4), fps=1, size=(WIDTH, HEIGHT))
    middles = [np.argwhere(_amber(frame)).mean(axis=0) for frame in frames[:4]]
    (down_y, down_x), (right_y, right_x), (up_y, up_x), (_, left_x) = middles
    assert left_x + 5 < down_x < right_x - 5
    assert up_y + 5 < right_y < down_y - 5
    assert abs(up_x - down_x) < 3


@pytest.mark.parametrize(
    ("name", "poses"),
    [
        ("pendulum", [[angle] for angle in np.linspace(-np.pi, np.pi, 9)]),
        ("acrobot", [[angle, 0.0] for angle in np.linspace(-np.pi, np.pi, 9)]),
        ("cartpole", [[x, a] for x in (-1.8, 1.8) for a in (0.0, np.pi / 2, np.pi, -np.pi / 2)]),
    ],
)
@pytest.mark.parametrize("camera", ["main", None])
def test_every_pose_is_seen(
    name: str, poses: list[list[float]], camera: str | None, backend: str
) -> None:
    look = {"fps": 1, "size": (WIDTH, HEIGHT), "camera": camera}
    frames = video.render_frames(_model(name), poses, range(len(poses)), **look)
    for frame in frames:
        seen = _amber(frame)
        assert np.any(seen)
        border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
        assert not np.any(border)


def test_by_default_the_motion_fills_the_frame(backend: str) -> None:
    poses = [[0.0, 0.0], [0.2, np.pi / 2], [0.0, np.pi]]
    share = []
    for camera in ("main", None):
        look = {"fps": 1, "size": (WIDTH, HEIGHT), "camera": camera}
        frames = video.render_frames(_model("cartpole"), poses, range(3), **look)
        rows = np.argwhere([_amber(frame) for frame in frames])[:, 1]
        share.append(np.ptp(rows) / HEIGHT)
    assert share[0] < 0.4
    assert 0.75 < share[1] < 0.95


def test_obstacles_beside_the_motion_are_in_the_frame(backend: str) -> None:
    def seen(place: float) -> np.ndarray:
        """Rows and columns of the red box in a film of a ball that goes 1 m to the right."""
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><worldbody><light pos="0 0 9"/>
            <geom type="box" pos="{place} 0 0" size=".1 .1 .1" rgba="1 0 0 1"/>
            <body><joint type="slide" axis="1 0 0"/><geom size=".1" rgba="0 0 1 1"/></body>
            <camera name="main" pos="0 -5 0" xyaxes="1 0 0 0 0 1"/></worldbody></mujoco>"""
        )
        frame = video.render_frames(model, [[0.0], [1.0]], [0, 1], fps=1, size=(WIDTH, HEIGHT))[0]
        red, green, blue = frame.astype(int).transpose(2, 0, 1)
        assert np.count_nonzero(blue > green + 60) > 80  # the ball, never tiny
        return np.argwhere(red > green + blue + 60)

    columns = seen(-0.25)[:, 1]  # left of the ball
    assert 0 < columns.min() < columns.max() < WIDTH / 3
    assert not seen(-5.0).size


@pytest.mark.parametrize(("way", "follows"), [(2.0, False), (4.0, True)])
def test_the_camera_goes_with_a_robot_that_travels_far(way: float, follows: bool) -> None:
    """The car, with what belongs to it, is 0.8 m long."""
    model = _model("car_bug_trap")
    qpos = np.array([[x, -2.0, 0.0] for x in np.linspace(-way, way, 5)])
    seen = camera_for(model, qpos, None, 4 / 3)
    kinds = mujoco.mjtCamera.mjCAMERA_FREE, mujoco.mjtCamera.mjCAMERA_TRACKING
    assert seen.type == kinds[follows]


@pytest.mark.parametrize(("actuators", "follows"), [("hit", False), ("fly", True)])
def test_the_camera_does_not_go_with_a_ball_that_is_hit(actuators: str, follows: bool) -> None:
    """What no actuator drives is no robot; a site's actuator drives the body that it is on."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>
        <body><joint name="bat"/><geom size=".1"/></body>
        <body pos="0 0 1"><freejoint/><geom size=".1"/><site name="rotor"/></body>
        </worldbody><actuator><motor {"joint='bat'" if actuators == "hit" else "site='rotor'"}/>
        </actuator></mujoco>"""
    )
    qpos = np.array([[0.0, x, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0] for x in np.linspace(0.0, 9.0, 5)])
    kinds = mujoco.mjtCamera.mjCAMERA_FREE, mujoco.mjtCamera.mjCAMERA_TRACKING
    assert camera_for(model, qpos, None, 4 / 3).type == kinds[follows]


@pytest.mark.parametrize(
    ("lights", "strengths"),
    [("", [0.5]), ("<light/>", [0.3]), ("<light/><light type='directional'/>", [0.7])],
)
def test_every_floor_has_a_directional_light(lights: str, strengths: list[float]) -> None:
    """0.7 is MuJoCo's own default: a model's directional light is not touched."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{lights}</worldbody></mujoco>")
    scene = Scene(model, mujoco.MjvCamera())
    scene.begin(None)
    shining = [
        light for light in scene.content.lights[: scene.content.nlight] if not light.headlight
    ]
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
    found = [light.diffuse[0] for light in shining if light.type == directional]
    np.testing.assert_allclose(found, strengths)


@pytest.mark.parametrize("name", ["pendulum", "acrobot", "cartpole"])
def test_software_rendering_agrees_with_opengl(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not _has_opengl():
        pytest.skip("no OpenGL on this machine")
    model = _model(name)
    poses = np.linspace(0.0, 2.5, 4)[:, None] * np.ones(model.nq)
    poses[:, 0] = np.minimum(poses[:, 0], 1.8) if name == "cartpole" else poses[:, 0]
    opengl = video.render_frames(model, poses, range(4), fps=1)
    monkeypatch.setattr(renderer, "gl_context", lambda: None)
    without = video.render_frames(model, poses, range(4), fps=1)
    for one, other in zip(_amber(opengl), _amber(without), strict=True):
        assert np.sum(one & other) > 0.7 * np.sum(one | other)
    assert np.abs(opengl.astype(int) - without).mean() < 20


def test_video_is_one_that_browsers_play(tmp_path: Path, backend: str) -> None:
    import imageio_ffmpeg

    path = tmp_path / "new" / "swing.mp4"
    written = video.render_motion(
        _model("pendulum"),
        [[0.0], [2.0]],
        [0.0, 1.0],
        path,
        overlay=("max|h| 1e-6", "{time}"),
        fps=20,
        size=(WIDTH - 1, HEIGHT - 1),
    )
    assert written == path
    assert [item.name for item in path.parent.iterdir()] == ["swing.mp4"]
    assert len(_decoded(path, HEIGHT, WIDTH)) == 21 + 10
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(path)]
    probe = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    assert "h264" in probe
    assert "yuv420p" in probe
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # the index first: plays at once


def test_film_of_a_model_shows_the_replay(cartpole: Solution, tmp_path: Path) -> None:
    far = cartpole.feedback.states.copy()  # neither planned nor reached open loop
    far[:, :, 0] = np.linspace(-1.5, 1.5, far.shape[1])
    solution = _judged(cartpole, feasible=True, open_loop=False, feedback=True)
    solution = replace(solution, feedback=replace(solution.feedback, states=far))
    path = video.render(solution, tmp_path / "film.mp4", fps=20, size=(2 * WIDTH, 2 * HEIGHT))
    frames = _decoded(path, 2 * HEIGHT, 2 * WIDTH)
    assert len(frames) == 5 + 10
    left, right = (np.argwhere(_amber(frames[i]))[:, 1].mean() for i in (0, -1))
    assert left < 0.8 * WIDTH < 1.2 * WIDTH < right


def test_film_of_a_function_draws_the_replay_so_far(pendulum: Solution, tmp_path: Path) -> None:
    seen: list[np.ndarray] = []

    def draw(axes: Axes, states: np.ndarray) -> None:
        seen.append(states)
        _draw_angle(axes, states)

    path = video.render(pendulum, tmp_path / "film.mp4", fps=20, size=(320, 239), draw=draw)
    frames = _decoded(path, 240, 320)
    assert len(frames) == 21 + 10
    assert [len(states) for states in seen] == list(range(1, 12))  # each knot once
    np.testing.assert_array_equal(seen[-1], pendulum.replayed[0])
    assert _distance(frames[0], frames[20]) > 100
    assert np.abs(frames[20].astype(int) - frames[-1]).mean() < 1


def test_plan_and_replay_side_by_side_with_a_caption_or_without(
    cartpole: Solution, tmp_path: Path
) -> None:
    path, good = tmp_path / "both.mp4", _judged(cartpole, True, True, True)
    films = []
    for caption in (True, False):
        video.render_comparison(good, path, fps=20, size=(2 * WIDTH, HEIGHT), caption=caption)
        films.append(_decoded(path, HEIGHT, 2 * WIDTH))
    told, plain = films
    assert len(told) == len(plain) == 5 + 10
    assert np.abs(told[0, -2:].astype(int) - DARK).max() < 20
    assert np.abs(plain[0, -2:, :150].astype(int) - DARK).max() > 40  # the floor
    assert np.abs(plain[0, :, 159:161].astype(int) - DARK).max() < 40  # what is between
    for side in (plain[0, :, :150], plain[0, :, 170:]):
        assert _amber(side).any()


def test_film_of_a_replay_that_blows_up_stops_there(cartpole: Solution, tmp_path: Path) -> None:
    blown = cartpole.feedback.states.copy()
    blown[:, 6:] = np.nan
    solution = _judged(cartpole, feasible=True, open_loop=False, feedback=False)
    solution = replace(solution, feedback=replace(solution.feedback, states=blown))
    path = video.render(solution, tmp_path / "film.mp4", fps=20, size=(WIDTH, HEIGHT))
    assert len(_decoded(path, HEIGHT, WIDTH)) == 3 + 10


@pytest.mark.parametrize(
    ("feasible", "open_loop", "feedback", "warning", "mode"),
    [
        (True, True, True, None, "open loop: reaches the goal"),
        (True, False, True, None, "with feedback: reaches the goal"),
        (True, False, False, "no replay succeeds", "with feedback: misses the goal"),
        (False, True, True, "the plan is infeasible", "open loop: reaches the goal"),
    ],
)
def test_overlay_says_what_is_certified(
    cartpole: Solution,
    pendulum: Solution,
    feasible: bool,
    open_loop: bool,
    feedback: bool,
    warning: str | None,
    mode: str,
) -> None:
    for solution, engine in ((cartpole, "MuJoCo C replay"), (pendulum, "float64 rollout")):
        judged = _judged(solution, feasible, open_loop, feedback)
        lines = video.outcome_lines(judged)
        assert lines[0] == judged.problem.name
        assert (f"NOT CERTIFIED: {warning}" == lines[1]) == (not judged.certified)
        defect = "1e-06" if feasible else "0.1"
        assert f"cost {judged.replay_cost[judged.best_chain]:.3g}   max|h| {defect}" in lines
        residual = judged.residual[judged.best_chain]  # a bare Langevin made the cart-pole's
        known = f"residual {residual:.1e}, below 0.0001"
        assert ("residual not known" if solution is cartpole else known) in lines
        assert "bound violation 0" in lines
        assert f"{lines[-3]} {lines[-2]}".startswith(f"{engine}, {mode}, ")
        name, time, cost, verdict, told = video.outcome_lines(judged, brief=True)
        assert (name, time) == (lines[0], lines[-1])
        assert cost == f"cost {judged.replay_cost[judged.best_chain]:.3g}"
        assert told == mode
        if judged.certified:
            assert verdict == ("certified" if solution is cartpole else "certified and optimal")
        else:
            assert verdict == f"NOT CERTIFIED: {warning}"
        assert lines[-1] == "t = {time}"


def test_the_plan_of_any_chain_can_be_filmed(pendulum: Solution, tmp_path: Path) -> None:
    x = pendulum.trajectories.x.copy()
    x[1, 2:] += 1.0
    failed = replace(
        pendulum,
        trajectories=replace(pendulum.trajectories, x=x),
        max_defect=np.array([1e-6, *np.ones(len(x) - 1)]),
    )
    seen: list[np.ndarray] = []

    def draw(axes: Axes, states: np.ndarray) -> None:
        seen.append(states)

    path = tmp_path / "plan.mp4"
    video.render(failed, path, fps=2, size=(320, 240), draw=draw, chain=1, plan=True)
    np.testing.assert_allclose(seen[-1], failed.plans[1], rtol=1e-6)
    video.render(failed, path, fps=2, size=(320, 240), draw=draw, chain=1)
    replayed = failed.replays_in(failed.mode_of(1)).states[1]
    np.testing.assert_array_equal(seen[-1], replayed)
    lines = video.outcome_lines(failed, 1, plan=True)
    assert lines[1] == "NOT CERTIFIED: the plan is infeasible"
    assert "PLAN of chain 1, not a replay:" in lines
    assert "breaks the dynamics in angle [rad]" in " ".join(lines)
    assert "at knot 2," in " ".join(lines)
    assert "keeps to the dynamics" in video.outcome_lines(failed, 0, plan=True)
    told = video.outcome_lines(failed, 1, plan=True, brief=True)[-1]
    assert told.startswith("PLAN of chain 1, not a replay: breaks the dynamics in angle [rad]")
    with pytest.raises(DraxError, match=f"chain is 99: give a number below {len(x)}"):
        video.render(failed, path, draw=draw, chain=99)


def test_a_film_of_the_gallery_is_made_from_a_saved_answer(
    pendulum: Solution, tmp_path: Path
) -> None:
    film = runpy.run_path(str(ROOT / "docs" / "make_films.py"))["film"]
    _judged(pendulum, True, True, True).save(tmp_path / "good")
    path = film(tmp_path / "good", tmp_path)
    assert path == tmp_path / "pendulum.webp"
    with Image.open(path) as found:
        assert found.size == (480, 360)
        assert found.info["loop"] == 0
        seconds = 0.0
        for index in range(found.n_frames):
            found.seek(index)
            found.load()
            seconds += found.info["duration"] / 1000
    assert seconds == pytest.approx(3.55, abs=0.01)  # slow motion, and the end held
    _judged(pendulum, False, True, True).save(tmp_path / "bad")
    with pytest.raises(DraxError, match="not certified: solve pendulum"):
        film(tmp_path / "bad", tmp_path)


def test_captions_are_under_the_picture_and_can_be_left_out() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
    )
    qpos = np.tile(model.qpos0, (3, 1))
    qpos[:, 0] = [0.0, 1.0, 2.0]  # far, beside its size: the camera goes with it
    look = {"times": np.arange(3.0), "fps": 1, "size": (160, 120)}
    plain = video.render_frames(model, qpos, **look)
    told = video.render_frames(model, qpos, overlay=["a", "t = {time}"], **look)
    assert plain.shape == told.shape == (3, 120, 160, 3)
    assert plain[0, 0, 0, 2] > 150  # sky
    assert (told[0, -1, 0] == [20, 25, 33]).all()
    np.testing.assert_allclose(plain[0].astype(int), plain[2].astype(int), atol=40)
    free = video.render_frames(model, qpos, camera="free", **look).astype(int)
    assert np.abs(free[0] - free[2]).max() > 40
    arrow = video.render_frames(
        model, qpos, arrows=lambda time: [(np.zeros(3), np.array([0.3, 0, 0.3]))], **look
    )
    assert (arrow[0, ..., 0].astype(int) - arrow[0, ..., 2] > 60).any()  # red


def test_uncertified_films_look_different(pendulum: Solution, tmp_path: Path) -> None:
    first = []
    for success in (True, False):
        judged = _judged(pendulum, True, success, success)
        # The same motion, so that only the words differ.
        judged = replace(judged, open_loop=replace(judged.feedback))
        path = tmp_path / f"{success}.mp4"
        video.render(judged, path, fps=2, size=(320, 240), draw=_draw_angle)
        first.append(_decoded(path, 240, 320)[0])
    good, bad = (frame[-60:].astype(int) for frame in first)  # the caption
    assert np.sum(bad[..., 0] > bad[..., 1] + 60) > 2000  # red
    assert np.sum(good[..., 0] > good[..., 1] + 60) == 0


def test_a_function_without_draw_has_no_film(pendulum: Solution, tmp_path: Path) -> None:
    with pytest.raises(DraxError, match=r"pendulum has no model to film: pass draw="):
        video.render(pendulum, tmp_path / "film.mp4")
    with pytest.raises(DraxError, match="fps"):
        video.render(pendulum, tmp_path / "film.mp4", draw=_draw_angle, fps=0)
    with pytest.raises(DraxError, match="size"):
        video.render(pendulum, tmp_path / "film.mp4", draw=_draw_angle, size=(0, 0))
    assert not list(tmp_path.iterdir())


def test_overlay_is_drawn_and_tells_the_time(backend: str) -> None:
    model, poses, times = _model("pendulum"), [[0.0], [0.0]], [0.0, 1.0]
    plain = video.render_frames(model, poses, times, fps=2)
    told = ("cost 1.0", "t = {time}")
    lines = video.render_frames(model, poses, times, fps=2, overlay=told)
    below = caption_height([told], *plain.shape[1:3])
    assert 20 < below < 60
    assert np.any(lines[0, -below:] != lines[1, -below:])
    pictures = lines[:2, :-below].astype(int)  # free of the text; renderers round differently
    np.testing.assert_allclose(pictures[0], pictures[1], atol=2)
    np.testing.assert_array_equal(plain[0], plain[1])


def test_wide_overlay_shrinks_to_fit(backend: str) -> None:
    lines = ("replayed in MuJoCo C: max|h| 1.0e-06, bound violation 0, reaches the goal",)
    frames = video.render_frames(_model("pendulum"), [[0.0]], [0.0], fps=2, overlay=lines)
    strip = frames[0, -caption_height([lines], *frames.shape[1:3]) :]
    assert np.all(strip[:, -8:] == strip[0, -1])
    assert np.any(strip != strip[0, -1])


def test_a_model_without_cameras_is_framed(backend: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><light pos="0 0 9"/><geom type="plane" size="0 0 1"/>
        <body pos="0 0 5"><freejoint/><geom type="box" size=".3 .2 .1" rgba=".9 .5 .1 1"/></body>
        </worldbody></mujoco>"""
    )
    poses = [[0.0, 0, 5, 1, 0, 0, 0], [3.0, 0, 6, 0, 1, 0, 0]]
    for frame in video.render_frames(model, poses, [0.0, 1.0], fps=4, size=(WIDTH, HEIGHT)):
        seen = np.argwhere(_amber(frame))
        assert len(seen) > 20
        assert np.all(seen.min(axis=0) > 0)
        assert np.all(seen.max(axis=0) < (HEIGHT - 1, WIDTH - 1))


def test_interpolation_follows_geodesics() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint type="ball"/><geom size="1"/></body></worldbody>
        </mujoco>"""
    )
    quarter = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
    poses, times = np.array([[1.0, 0.0, 0.0, 0.0], quarter]), np.array([0.0, 2.0])
    middle = interpolated(model, poses, times, 1.0)
    np.testing.assert_allclose(middle, [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)], atol=1e-12)
    np.testing.assert_array_equal(interpolated(model, poses, times, 2.0), quarter)


def test_bad_input_is_refused_before_drawing(tmp_path: Path) -> None:
    model = _model("pendulum")
    good = ([[0.0], [1.0]], [0.0, 1.0])
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(DraxError, match=r"no camera .side..*main"):
        video.render_frames(model, *good, camera="side")
    with pytest.raises(DraxError, match=r"no camera 3.*main"):
        video.render_frames(model, *good, camera=3)
    with pytest.raises(DraxError, match=r"\(T, 1\)"):
        video.render_frames(model, [[0.0, 0.0]], [0.0])
    with pytest.raises(DraxError, match=r"times must have the shape"):
        video.render_frames(model, good[0], [0.0])
    with pytest.raises(DraxError, match=r"must not decrease"):
        video.render_frames(model, good[0], [1.0, 0.0])
    with pytest.raises(DraxError, match=r"finite; row 1"):
        video.render_frames(model, [[0.0], [np.nan]], good[1])
    with pytest.raises(DraxError, match=r"fps"):
        video.render_frames(model, *good, fps=0)
    with pytest.raises(DraxError, match=r"size"):
        video.render_frames(model, *good, size=(0, 640))
    with pytest.raises(DraxError, match=r"\.mp4"):
        video.render_motion(model, *good, tmp_path / "video.avi")
    with pytest.raises(DraxError, match=r"cannot write"):
        video.render_motion(model, *good, file / "video.mp4")
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_without_opengl_one_warning_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    for name in ("egl", "osmesa", "cgl", "glfw"):
        monkeypatch.setitem(sys.modules, f"mujoco.{name}", None)  # cannot be imported
    motion = (_model("pendulum"), [[0.0]], [0.0])
    with pytest.warns(RuntimeWarning, match="apt-get install.*libegl1") as caught:
        twice = [video.render_frames(*motion, fps=2, size=(WIDTH, HEIGHT)) for _ in range(2)]
    assert len(caught) == 1
    assert twice[0].shape == (2, HEIGHT, WIDTH, 3)


def _run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    dropped = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")
    environment = {k: v for k, v in os.environ.items() if k not in dropped}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", code]
    environment |= variables
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_importing_changes_nothing() -> None:
    result = _run(
        "import os, sys; before = dict(os.environ)\n"
        "import mjx_drax.physics.dynamics; there = set(sys.modules)\n"  # mujoco.mjx imports PIL
        "import mjx_drax.view.video\n"
        "assert dict(os.environ) == before\n"
        "assert not {'OpenGL', 'mujoco.egl', 'mediapy'} & set(sys.modules)\n"
        "assert not {'PIL', 'matplotlib'} & (set(sys.modules) - there)\n"
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_drawing_leaves_the_environment_alone() -> None:
    result = _run(
        "import os; before = dict(os.environ)\n"
        "import mujoco\nfrom mjx_drax.view.video import render_frames\n"
        f"model = mujoco.MjModel.from_xml_path({str(ROOT / 'models' / 'pendulum.xml')!r})\n"
        "render_frames(model, [[0.0]], [0.0], fps=2, size=(64, 48))\n"
        "assert dict(os.environ) == before\n"
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_missing_libraries_of_a_chosen_backend_are_named(tmp_path: Path) -> None:
    # With MUJOCO_GL=egl and no libEGL, `import mujoco` fails as this stand-in does.
    complaint = "'NoneType' object has no attribute 'eglQueryString'"
    (tmp_path / "mujoco.py").write_text(f"raise AttributeError({complaint!r})")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import mjx_drax.view.video"
    result = _run(code, MUJOCO_GL="egl")
    assert result.returncode != 0
    last = result.stderr.splitlines()[-1]
    assert "MUJOCO_GL=egl is set" in last
    assert "unset MUJOCO_GL" in last
    assert "libegl1" in last
