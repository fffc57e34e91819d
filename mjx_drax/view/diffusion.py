"""The film of a diffusion: scattered knots become a motion, which is then played.

The robot is shown at some knots of one chain, each colored by log10 max|h_k|, by how far it breaks
the dynamics; below are the chain's cost, max|h| and noise sigma over the iterations. Between two
snapshots knots move along the tangent vector that leads from one to the other. The film is slow
while knots move and defects fall, and fast while little happens.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from mjx_drax.base.errors import DraxError, require_positive, require_whole
from mjx_drax.physics.c_engine.states import between, finite, interpolated, moved
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.recording import ChainHistory
from mjx_drax.solution.solution import Solution, require_solution
from mjx_drax.view.drawing import Canvas, Draw, knot_at
from mjx_drax.view.frames import (
    Frame,
    caption_height,
    captioned,
    even_size,
    video_path,
    write,
)
from mjx_drax.view.geoms import Floats
from mjx_drax.view.renderer import open_renderer
from mjx_drax.view.scene import FREE, Scene, body_positions, camera_for, travelling_body
from mjx_drax.view.video import check, frame_times, outcome_lines

COLORS = ("#56B4E9", "#E8D44D", "#F0902A", "#C8400A")
"""Colors of defects, from feasible to the worst: blue to orange, safe for colour-blind readers."""

_SECONDS, _MORE_SECONDS = 7.0, 2.0  # [s] that one attempt takes, and each further one
_FIRST, _LAST = 0.6, 0.8  # [s] the scattered knots, and the last iteration, stay this long
_EVEN = 0.25  # share of the film's time that is spread evenly over the iterations
_SMALLEST = 1e-9  # smaller max|h| is drawn as this, on a logarithmic axis
_TEXT, _PAPER, _LINE, _FRAME = "#e8ebf0", "#0e1219", "#56B4E9", "#5a6270"
_PARTS, _COUNT = 300, (6, 24)  # geoms of all poses, and range of their number, by default
_STRIP = 0.24  # share of the height that the curves take
_CLEAR, _FAINT = 0.62, 0.13  # opacity of poses before the motion is played, and while it is
_FEWER = 3  # while it is played, every third pose is left
_OTHER = 0.45  # opacity of other chains' paths


def render_diffusion(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    seconds: float | None = None,
    poses: int | None = None,
    chains: int = 6,
    fps: float = 30.0,
    size: tuple[int, int] = (800, 600),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Draw | None = None,
    caption: bool = True,
) -> Path:
    """Films how the best chain's knots became its motion, then that motion as it was replayed.

    Where attempts failed before, the best one for that chain of each is shown, one after the other.
    Where a body moves in the plane or in space, and for problems without a model, paths of other
    chains are shown too. Poses are translucent copies of the robot.

    Args:
      solution: from `solve(..., record=1)`.
      path: where to, ending in .mp4, .gif or .webp; its folder is made if need be.
      seconds: that the diffusion takes in the film [s]; by default 7, and 2 for each further
        attempt.
      poses: number of knots at which the robot is shown; by default 24, or fewer if it has many
        parts, which take long to draw without a GPU.
      chains: number of chains whose paths are shown, those of distinct optima first.
      fps, size, speed, caption: as in `render`.
      camera: as in `render`; None sees all that is shown.
      draw: draw(axes, states (k + 1, nx)) draws the motion x_0..x_k on matplotlib axes, one line of
        it with a vertex for each state; needed for problems without a model.

    Raises:
      DraxError: nothing was recorded, a setting that cannot be used, or neither model nor `draw`.
    """
    require_solution(solution)
    recording, problem = solution.recording, solution.problem
    if recording is None:
        raise DraxError(
            f"this solution of {problem.name} holds no recording: call solve(..., record=1), or "
            "mjx-drax solve --film FILE."
        )
    check(problem, fps=fps, size=size, camera=camera, speed=speed, draw=draw)
    if seconds is not None:
        require_positive("seconds", seconds)
    if poses is not None:
        require_whole("poses", poses)
    require_whole("chains", chains)
    video_path(path)
    shown = [recording.history_of(chain) for chain in _chains(solution, chains)]
    if seconds is None:
        seconds = _SECONDS + _MORE_SECONDS * (len(np.unique(shown[0].attempt)) - 1)
    width, height = even_size(size)
    lines = outcome_lines(solution, brief=True)
    model = mujoco_model(problem.dynamics, solution.replayed[0][0])
    moments = frame_moments(shown[0], seconds, fps)
    told = [_caption(solution, shown[0], at) if caption else [] for at in moments]
    lines = lines if caption else []
    below = 2 * round(_STRIP * height / 2)
    text = caption_height([*told, lines], height - below, width)
    states = finite(solution.replayed[0])
    times = solution.times[: len(states)]
    film = Film(
        shown=shown,
        colors=Colors.of(shown[0].defects[0]),
        moments=moments,
        states=states,
        times=times,
        frame_times=frame_times(times, fps, speed),
        size=(width, height - below - text),
    )
    captions = [(its, 0.0, at) for its, at in zip(told, film.moments, strict=True)]
    captions += [(lines, time, film.moments[-1]) for time in film.frame_times]

    def frames() -> Generator[Frame, None, None]:
        if model is not None:
            pictures = _robot_pictures(film, model, poses, FREE if camera is None else camera)
        else:
            assert draw is not None  # as checked
            pictures = _task_pictures(film, draw, np.asarray(problem.x_init, float))
        strip = CurveStrip(shown[0], film.colors, below, width)
        for picture, (its, time, at) in zip(pictures, captions, strict=True):
            yield np.concatenate([captioned(picture, its, time, text), strip.frame(at)])

    return write(path, frames(), fps)


def _chains(solution: Solution, count: int) -> list[int]:
    """The best chain, one of every other optimum, and further ones: the cheapest first."""
    optima = [optimum.chain for optimum in solution.optima]
    cheap = np.argsort(np.where(solution.feasible, solution.cost, np.inf), kind="stable")
    order = [solution.best_chain, *optima, *(int(chain) for chain in cheap)]
    return list(dict.fromkeys(order))[:count]


def frame_moments(history: ChainHistory, seconds: float, fps: float) -> Floats:
    """Where each frame is among the snapshots: 2.5 is half way between the third and the fourth."""
    logs = np.log10(np.maximum(history.defects, FEASIBLE))
    fall = np.abs(np.diff(logs, axis=0)).mean(axis=1)
    scale = np.std(history.x, axis=(0, 1)) + 1e-9
    motion = (np.abs(np.diff(history.x, axis=0)).mean(axis=1) / scale).mean(axis=1)
    same = np.diff(history.attempt) == 0
    pace = np.where(same, fall / max(fall[same].sum(), 1e-9), 0.0)
    pace += np.where(same, motion / max(motion[same].sum(), 1e-9), 0.0)
    pace = _EVEN / max(len(pace), 1) + (1.0 - _EVEN) * pace / max(pace.sum(), 1e-9)
    reached = np.concatenate([[0.0], np.cumsum(pace)])
    moving = np.linspace(0.0, reached[-1], max(2, round(seconds * fps)))
    at = np.interp(moving, reached, np.arange(len(reached)))
    first, last = (round(hold * fps) for hold in (_FIRST, _LAST))
    at = np.concatenate([np.zeros(first), at, np.full(last, len(reached) - 1.0)])
    jump = np.flatnonzero(~same)  # between two attempts nothing moves: show the one or the other
    inside = np.isin(np.floor(at), jump)
    return np.where(inside, np.round(at), at)


def _neighbours(at: float, count: int) -> tuple[int, int, float]:
    """The snapshots before and after a moment among so many, and the share of the second."""
    before = min(int(at), count - 1)
    return before, min(before + 1, count - 1), at - before


def same_moment(best: ChainHistory, other: ChainHistory, at: float) -> tuple[int, int, float]:
    """The neighbours of another chain when the best one is at a moment.

    That is at the same iteration of the same attempt, or where the other one ended before; when the
    best one is at its end, so is the other.
    """
    i, j, share = _neighbours(at, len(best.iteration))
    if i == len(best.iteration) - 1:
        end = len(other.iteration) - 1
        return end, end, 0.0
    iteration = (1.0 - share) * best.iteration[i] + share * best.iteration[j]
    past = (other.iteration <= iteration) & (other.attempt <= best.attempt[i])
    last = int(np.flatnonzero(past)[-1])
    following = min(last + 1, len(other.iteration) - 1)
    gap = other.iteration[following] - other.iteration[last]
    if gap == 0 or other.attempt[following] != other.attempt[last]:
        return last, last, 0.0
    return last, following, float((iteration - other.iteration[last]) / gap)


def _caption(solution: Solution, history: ChainHistory, at: float) -> list[str]:
    """What is known at a moment: the numbers of the iteration that was reached last."""
    i = int(at)
    several = len(np.unique(history.attempt)) > 1
    sigma = f"{history.sigma[i]:.2g}" if history.sigma[i] > 0.0 else "0 (no noise)"
    return [
        solution.problem.name,
        f"iteration {history.iteration[i]}" + f", attempt {history.attempt[i] + 1}" * several,
        f"cost {history.cost[i]:.3g}   max|h| {history.max_defect[i]:.2g}",
        f"sigma {sigma}",
    ]


@dataclass(frozen=True)
class Colors:
    """Colors of defects, from feasible to the worst that were seen, on a logarithmic scale."""

    worst: float

    @staticmethod
    def of(first: Floats) -> Colors:
        """The scale for a chain: up to the next power of ten above its first defects (K,)."""
        worst = np.max(first[np.isfinite(first)], initial=10.0 * FEASIBLE)
        return Colors(float(10.0 ** np.ceil(np.log10(worst) - 0.3)))

    def __call__(self, defects: npt.ArrayLike) -> Floats:
        """RGBA (..., 4) of defects (...,)."""
        low, high = np.log10([FEASIBLE, self.worst])
        logs = np.log10(np.maximum(np.nan_to_num(defects, nan=self.worst), FEASIBLE))
        share = np.clip((logs - low) / (high - low), 0.0, 1.0)
        return np.asarray(LinearSegmentedColormap.from_list("defects", COLORS)(share))


def _blend(defects: Floats, before: int, after: int, share: float) -> Floats:
    """Defects (K,) between two of the snapshots (snapshots, K), on a logarithmic scale."""
    logs = np.log(np.maximum(defects[[before, after]], 1e-30))
    return np.exp((1.0 - share) * logs[0] + share * logs[1])


# Pictures above


@dataclass(frozen=True)
class Film:
    """What is filmed.

    Attributes:
        shown: the chains, the best one first.
        colors: of their defects.
        moments: for each frame before the motion is played, where it is among the best chain's
            snapshots.
        states, times: the replay (T, nx) at (T,) [s], up to where it turns non-finite.
        frame_times: of the frames that play it [s].
        size: (width, height) of the picture above the curves [pixels].
    """

    shown: Sequence[ChainHistory]
    colors: Colors
    moments: Floats
    states: Floats
    times: Floats
    frame_times: Floats
    size: tuple[int, int]

    def lines(self, points: Sequence[Floats], at: float) -> Iterator[tuple[Floats, Floats]]:
        """Each chain's line through its knots at a moment, (K, d), and its colors (K - 1, 4).

        For each chain, points (snapshots, K, d) say where its knots are in the picture.
        """
        best = self.shown[0]
        for chain, its_points in zip(self.shown[: len(points)], points, strict=True):
            i, j, share = same_moment(best, chain, at)
            colors = self.colors(_blend(chain.defects, i, j, share)[1:])
            colors[:, 3] = 1.0 if chain is best else _OTHER
            yield (1.0 - share) * its_points[i] + share * its_points[j], colors


def _robot_pictures(
    film: Film, model: mujoco.MjModel, poses: int | None, camera: str | int
) -> Iterator[Frame]:
    """The robot at some knots, and the paths of a body that travels."""
    best, nq, qpos = film.shown[0], model.nq, film.states[:, : model.nq]
    parts = int(np.count_nonzero(model.body_weldid[model.geom_bodyid] != 0))
    count = int(np.clip(_PARTS // max(parts, 1), *_COUNT)) if poses is None else poses
    horizon, body = best.x.shape[1], travelling_body(model)
    knots = np.linspace(0, horizon - 1, min(count, horizon)).round().astype(int)
    points: list[Floats] = []
    if body is not None:
        points = [body_positions(model, body, chain.x[..., :nq]) for chain in film.shown]
    seen = np.concatenate([qpos, best.x[0, knots, :nq].astype(float)])
    width, height = film.size
    scene = Scene(model, camera_for(model, seen, camera, width / height))

    def add(at: float, some: npt.NDArray[np.int64], opacity: float) -> None:
        for rank, (line, colors) in enumerate(film.lines(points, at)):
            scene.add_line(line, colors, 3.0 if rank == 0 else 1.2)
        before, after, share = _neighbours(at, len(best.x))
        colors = film.colors(_blend(best.defects, before, after, share))
        for k in some:
            one, other = best.x[[before, after], k, :nq].astype(float)
            pose = moved(model, one, between(model, one, other), share)
            scene.add_robot(pose, opacity, colors[k, :3])

    with open_renderer(model, height, width) as renderer:
        for at in film.moments:
            scene.begin(None)
            add(at, knots, _CLEAR)
            yield renderer.render(scene.content)
        for time in film.frame_times:
            scene.begin(interpolated(model, qpos, film.times, time))
            add(film.moments[-1], knots[::_FEWER], _FAINT)
            yield renderer.render(scene.content)


def _task_pictures(film: Film, draw: Draw, x_init: Floats) -> Iterator[Frame]:
    """The chains' paths on what a task draws."""
    points = [traced(draw, chain.x.astype(float)) for chain in film.shown]
    width, height = film.size
    canvas = Canvas(height, width, layout="constrained")
    axes = canvas.figure.add_subplot()
    artists = [
        LineCollection([], linewidths=2.6 if i == 0 else 1.0, zorder=5 if i == 0 else 4)
        for i in range(len(film.shown))
    ]

    def drawn(states: Floats) -> Any:
        axes.clear()
        draw(axes, states)
        for artist in artists:
            axes.add_collection(artist)
            artist.set_animated(True)
        canvas.agg.draw()
        return canvas.agg.copy_from_bbox(canvas.figure.bbox)

    def with_paths(background: Any, at: float, opacity: float) -> Frame:
        canvas.agg.restore_region(background)
        lines = zip(artists, film.lines(points, at), strict=True)
        for artist, (line, colors) in reversed(list(lines)):  # the best chain on top
            colors[:, 3] *= opacity
            artist.set_segments(list(np.stack([line[:-1], line[1:]], axis=1)))
            artist.set_color(list(map(tuple, colors)))
            axes.draw_artist(artist)
        return canvas.pixels()

    background, shown = drawn(x_init[None]), -1
    for at in film.moments:
        yield with_paths(background, at, 1.0)
    for time in film.frame_times:
        knot = knot_at(film.times, time)
        if knot != shown:
            background, shown = drawn(film.states[: knot + 1]), knot
        yield with_paths(background, film.moments[-1], 0.35)


def traced(draw: Draw, states: Floats) -> Floats:
    """Where `draw` puts states (..., nx) on its axes, (..., 2): the line with a vertex for each."""
    axes, flat = Figure().add_subplot(), states.reshape(-1, states.shape[-1])
    draw(axes, flat)
    lines = [np.asarray(line.get_xydata()) for line in axes.lines]
    found = [points for points in lines if len(points) == len(flat)]
    if not found:
        raise DraxError(
            "draw(axes, states) must plot the motion as a line with one vertex for each state, so "
            f"that the film can color it: its lines have {[len(p) for p in lines]} vertices for "
            f"{len(flat)} states."
        )
    return found[0].reshape(*states.shape[:-1], 2)


# Curves below


class CurveStrip:
    """Curves of a chain over the iterations, with a marker that moves."""

    def __init__(self, history: ChainHistory, colors: Colors, height: int, width: int) -> None:
        dpi = width / 7.0  # sets the size of letters
        canvas = Canvas(height, width, dpi, layout="constrained", facecolor=_PAPER)
        first = np.diff(history.attempt, prepend=history.attempt[0]) > 0
        starts = history.iteration[first]
        last = np.append(first[1:], False)  # left out of curves, which break there
        curves = [("cost", history.cost), ("max|h|", np.maximum(history.max_defect, _SMALLEST))]
        if history.sigma.any():
            curves.append(("noise sigma", np.where(history.sigma > 0, history.sigma, np.nan)))
        panels = np.atleast_1d(canvas.figure.subplots(1, len(curves)))
        self._iterations = history.iteration.astype(float)
        for axes, (title, values) in zip(panels, curves, strict=True):
            _curve(axes, self._iterations, np.where(last, np.nan, values), title)
            for start in starts:
                axes.axvline(start, color=_FRAME, lw=0.8, ls=":")
        _color_axis(panels[1], colors)
        canvas.agg.draw()
        self._picture = canvas.pixels()
        self._boxes, self._spots = [], []
        for axes, (_, values) in zip(panels, curves, strict=True):
            box = axes.get_window_extent()
            self._boxes.append((height - box.y1, height - box.y0))
            spots = axes.transData.transform(np.column_stack([self._iterations, values]))
            self._spots.append(np.column_stack([spots[:, 0], height - spots[:, 1]]))
        self._radius = max(2.5, width / 200)

    def frame(self, at: float) -> Frame:
        """The curves with markers at a moment among the snapshots."""
        image = Image.fromarray(self._picture)
        pen = ImageDraw.Draw(image)
        i, j, share = _neighbours(at, len(self._iterations))
        for (top, bottom), spots in zip(self._boxes, self._spots, strict=True):
            x, y = (1.0 - share) * spots[i] + share * spots[j]
            if not np.isfinite(x):
                continue
            pen.line([(x, top), (x, bottom)], fill=(150, 156, 166), width=1)
            if np.isfinite(y):
                r = self._radius
                pen.ellipse([x - r, y - r, x + r, y + r], fill=_TEXT, outline=_PAPER)
        return np.asarray(image)


def _curve(axes: Axes, iterations: Floats, values: Floats, title: str) -> None:
    """One panel of the strip, on a logarithmic axis where all values allow it."""
    values = np.where(np.isfinite(values), values, np.nan)
    axes.set_facecolor(_PAPER)
    axes.plot(iterations, values, color=_LINE, lw=1.6)
    if np.min(values[np.isfinite(values)], initial=np.inf) > 0.0:
        axes.set_yscale("log")
    axes.set_xlim(0.0, max(1.0, iterations[-1]))
    axes.set_title(title, color=_TEXT, fontsize=9, loc="left", pad=3, parse_math=False)
    axes.set_xlabel("iteration", color=_TEXT, fontsize=8, labelpad=1)
    axes.tick_params(colors=_TEXT, labelsize=7, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_FRAME)


def _color_axis(axes: Axes, colors: Colors) -> None:
    """The colors of defects, along the axis of max|h|."""
    low, high = axes.get_ylim()
    edges = np.geomspace(low, max(high, colors.worst), 256)
    axes.set_ylim(low, edges[-1])
    left, right = axes.get_xlim()
    across = np.array([left, left + 0.035 * (right - left)])
    shades = colors(np.sqrt(edges[1:] * edges[:-1]))[:, None, :]
    axes.pcolormesh(across, edges, shades, zorder=3)
