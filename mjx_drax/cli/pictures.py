"""The pictures and films that `solve` writes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjx_drax.solution.solution import Solution

NAMES = (
    "plot.png",
    "multipliers.png",
    "phase.png",
    "optima.png",
    "video.mp4",
    "plan.mp4",
    "comparison.mp4",
    "timelapse.png",
    "film.mp4",
)
"""All that there may be."""

LOOK = ("camera", "size", "fps", "speed", "caption")
"""What a user may say about videos and films."""


def add_look(parser: argparse.ArgumentParser) -> None:
    """An option for each of `LOOK`; None where nothing is said."""
    add = parser.add_argument
    add(
        "--camera",
        metavar="NAME",
        help="a camera of the model; free: one that shows the whole motion; follow: one that goes "
        "with the robot; default follow where it travels far, else free",
    )
    add("--size", type=_size, metavar="WIDTHxHEIGHT", help="of videos and films [pixels]")
    add("--fps", type=float, metavar="N", help="frames per second; default 30")
    add("--speed", type=float, metavar="S", help="of the motion; 0.5 is slow motion")
    add(
        "--no-caption",
        dest="caption",
        action="store_false",
        default=None,
        help="no text under videos and films",
    )


def _size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT as (width, height)."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r}: give WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def look_of(options: argparse.Namespace) -> dict[str, Any]:
    """What the user says of `LOOK`."""
    given = {name: getattr(options, name) for name in LOOK}
    return {name: value for name, value in given.items() if value is not None}


def without_caption(look: dict[str, Any]) -> dict[str, Any]:
    """What `look_of` gives, for functions that write no caption."""
    return {name: value for name, value in look.items() if name != "caption"}


def in_folder(folder: str) -> list[Path]:
    """Those of `NAMES` that lie in a folder, videos first."""
    videos_first = sorted(NAMES, key=lambda name: not name.endswith(".mp4"))
    paths = [Path(folder).expanduser() / name for name in videos_first]
    return [path for path in paths if path.exists()]


def film_path(asked: str, folder: Path) -> Path:
    """Where a film goes, "" being the usual place; refuses a place that cannot be written."""
    from mjx_drax.base.files import require_room
    from mjx_drax.view.frames import video_path as checked

    film = checked(asked or folder / "film.mp4")
    require_room(film)
    return film


def write_plots(solution: Solution, folder: Path, draw: Any) -> list[str]:
    """Plots of a solution; returns the files' names."""
    from mjx_drax.view.phase_plots import has_phases, plot_multipliers, plot_phase
    from mjx_drax.view.plotting import plot_optima, plot_solution

    plot_solution(solution, folder / "plot.png", draw=draw)
    plot_multipliers(solution, folder / "multipliers.png")
    written = ["plot.png", "multipliers.png"]
    if has_phases(solution.problem.dynamics):
        plot_phase(solution, folder / "phase.png")
        written.append("phase.png")
    if len(solution.optima) > 1:
        plot_optima(solution, folder / "optima.png", draw=draw)
        written.append("optima.png")
    return written


def write_video(solution: Solution, folder: Path, draw: Any, look: dict[str, Any]) -> list[str]:
    """The motion as a video, the plan too if it failed, and a picture; returns the files' names."""
    from mjx_drax.physics.dynamics import mujoco_model
    from mjx_drax.view.timelapse import render_timelapse
    from mjx_drax.view.video import render

    model = mujoco_model(solution.problem.dynamics)
    if model is None and draw is None:
        return []
    render(solution, folder / "video.mp4", draw=draw, **look)
    written = ["video.mp4"]
    if not solution.certified:
        render(solution, folder / "plan.mp4", draw=draw, plan=True, **look)
        written.append("plan.mp4")
    still = {name: look[name] for name in ("camera", "size") if name in look}
    render_timelapse(solution, folder / "timelapse.png", draw=draw, **still)
    return [*written, "timelapse.png"]
