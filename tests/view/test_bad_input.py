"""Bad paths, sizes, cameras and motions of pictures and films give one clear error."""

import numpy as np
import pytest
from builders import INF, NAN, At, assert_complains, cases, made_up, parts, point

from mjx_drax import (
    render,
    render_comparison,
    render_diffusion,
    render_timelapse,
    save_html,
)
from mjx_drax.view.phase_plots import plot_phase
from mjx_drax.view.plotting import plot_optima, plot_solution
from mjx_drax.view.video import render_frames


def frames(**arguments):
    """Pictures of the robot, small ones."""
    model = parts()["robot"].dynamics.mj_model
    return render_frames(
        model, **{"qpos": np.zeros((2, 1)), "times": [0, 1], "size": (16, 16), **arguments}
    )


def film(at, **arguments):
    """A film of the robot, a small one."""
    return render(at.answer, at.folder / "a.gif", **{"size": (16, 16), "fps": 1, **arguments})


# fmt: off
PICTURES = [
    ("film-suffix", lambda at: render(at.answer, at.folder / "film.avi"),
     "film.avi", ".mp4", "rename"),
    ("film-none", lambda at: render(at.answer, None), "path is None"),
    ("film-of-a-problem", lambda at: render(at.robot, at.folder / "a.mp4"),
     "the solution is <Problem", "Solution.load"),
    ("comparison-of-none", lambda at: render_comparison(None, at.folder / "a.mp4"),
     "the solution is None"),
    ("timelapse-of-none", lambda at: render_timelapse(None, at.folder / "a.png"),
     "the solution is None"),
    ("diffusion-of-none", lambda at: render_diffusion(None, at.folder / "a.mp4"),
     "the solution is None"),
    ("page-of-none", lambda at: save_html(None, at.folder / "a.html"), "the solution is None"),
    ("plot-of-none", lambda at: plot_solution(None, at.folder / "a.png"), "the solution is None"),
    ("film-folder",
     lambda at: ((at.folder / "a.mp4").mkdir(), render(at.answer, at.folder / "a.mp4")),
     "folder"),
    ("film-under-file", lambda at: render(at.answer, at.file("f") / "a.mp4"),
     "cannot write", "Choose another place"),
    ("fps-nan", lambda at: film(at, fps=NAN), "fps is nan"),
    ("fps-0", lambda at: film(at, fps=0), "fps is 0"),
    ("fps-text", lambda at: film(at, fps="fast"), "fps is 'fast'"),
    ("speed-negative", lambda at: film(at, speed=-1.0), "speed is -1.0"),
    ("speed-infinite", lambda at: film(at, speed=INF), "speed is inf"),
    ("size-0", lambda at: film(at, size=(0, 0)), "size is (0, 0)", "(width, height)"),
    ("size-one", lambda at: film(at, size=(480,)), "size is (480,)"),
    ("size-number", lambda at: film(at, size=480), "size is 480"),
    ("size-text", lambda at: film(at, size="640x480"), "size is '640x480'"),
    ("size-nan", lambda at: film(at, size=(NAN, 480)), "size is (nan, 480)"),
    ("size-huge", lambda at: film(at, size=(480, 10**9)), "size is (480, 1000000000)", "8192"),
    ("camera-name", lambda at: film(at, camera="side"), "no camera 'side'", "'free'"),
    ("camera-number", lambda at: film(at, camera=7), "no camera 7"),
    ("camera-half", lambda at: film(at, camera=0.5), "no camera 0.5"),
    ("film-no-model", lambda at: render(at.point_answer, at.folder / "a.gif"),
     "no model", "pass draw="),
    ("motion-nan", lambda at: frames(qpos=[[0.0], [NAN]]), "qpos", "finite"),
    ("motion-shape", lambda at: frames(qpos=np.zeros((2, 3))), "(2, 3)"),
    ("motion-times", lambda at: frames(times=[1, 0]), "times"),
    ("overlay", lambda at: frames(overlay="hello"), "overlay is 'hello'", "list"),
    ("diffusion-unrecorded", lambda at: render_diffusion(at.answer, at.folder / "a.gif"),
     "no recording", "record=1"),
    ("timelapse-count", lambda at: render_timelapse(at.answer, at.folder / "a.png", count=0),
     "count is 0"),
    ("timelapse-suffix", lambda at: render_timelapse(at.answer, at.folder / "a.jpg"),
     "a.jpg", ".png"),
    ("timelapse-no-model", lambda at: render_timelapse(at.point_answer, at.folder / "a.png"),
     "point has no model"),
    ("plot-suffix", lambda at: plot_solution(at.answer, at.folder / "a.svg"),
     "a.svg", ".png", "rename"),
    ("plot-under-file", lambda at: plot_solution(at.answer, at.file("f") / "a.png"),
     "cannot write"),
    ("plot-no-optima", lambda at: plot_optima(at.uncertified, at.folder / "a.png"),
     "no optima", "See"),
    ("phase-function",
     lambda at: plot_phase(made_up(point(x_init=[0.0] * 3, nu=3)), at.folder / "a.png"),
     "point"),
    ("html-function", lambda at: save_html(at.point_answer, at.folder / "a.html"),
     "no MuJoCo model", "see"),
    ("html-poses", lambda at: save_html(at.answer, at.folder / "a.html", poses=-1),
     "poses is -1"),
    ("html-poses-half", lambda at: save_html(at.answer, at.folder / "a.html", poses=1.5),
     "poses is 1.5"),
    ("html-suffix", lambda at: save_html(at.answer, at.folder / "a.pdf"),
     "a.pdf", ".html", "rename"),
]
# fmt: on


@pytest.mark.parametrize(("call", "words"), cases(picture=PICTURES))
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)
