"""The film of a diffusion: scattered knots condense into a motion, which is then played.

The robot is shown at some knots of one chain, each colored by log10 max|h_k|, by how far it breaks
the dynamics; below are the chain's cost, max|h| and noise sigma over the iterations. In between two
iterations knots move along the tangent vector that leads from one to the other, which is where the
flow went. Film time runs slowly while knots move and defects fall, and fast while little happens.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, require_positive, require_whole
from mjx_drax.method.langevin import FEASIBLE
from mjx_drax.physics._mujoco import mujoco
from mjx_drax.physics.states import between, finite, interpolated, moved
from mjx_drax.search.recording import Path
from mjx_drax.view import video as movie
from mjx_drax.view.rendering import FREE, check, frame_times, open_drawer, outcome_lines, view_of
from mjx_drax.view.timelapse import Stage, places, travelling_body
from mjx_drax.view.video import Frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mjx_drax.solution.solution import Solution

    Draw = Callable[[Axes, np.ndarray], None]

Floats = npt.NDArray[np.floating[Any]]

COLORS = ("#56B4E9", "#E8D44D", "#F0902A", "#C8400A")
"""Colors of defects, from feasible to the worst: blue to orange, safe for colour-blind readers."""

_SECONDS, _MORE_SECONDS = 7.0, 2.0  # [s] that one try takes, and each further one
_FIRST, _LAST = 0.6, 0.8  # [s] the scattered knots, and the last iteration, stay this long
_EVEN = 0.25  # share of film time that is spread evenly over the iterations
_EXACT = 1e-9  # smaller max|h| is drawn as this, on a logarithmic axis
_INK, _PAPER, _LINE = "#e8ebf0", "#0e1219", "#56B4E9"
_PARTS, _COUNT = 300, (6, 24)  # geoms of all ghosts, and range of their number, by default
_STRIP = 0.24  # share of the height that the curves take
_GHOST, _FAINT = 0.62, 0.13  # opacity of ghosts, while knots condense and while the motion plays
_FEWER = 3  # while it plays, only every so many are left


def render_diffusion(
    solution: Solution,
    path: str | os.PathLike[str],
    *,
    seconds: float | None = None,
    ghosts: int | None = None,
    chains: int = 6,
    fps: float = 30.0,
    size: tuple[int, int] = (600, 800),
    camera: str | int | None = None,
    speed: float = 1.0,
    draw: Draw | None = None,
) -> FilePath:
    """Films how the best chain's knots became its motion, then that motion as it was replayed.

    Where attempts failed before, the best of the tries for that chain are shown one after the
    other. Where a body moves in the plane or in space, and for problems without a model, paths of
    other chains are shown too.

    Args:
      solution: from `solve(..., record=1)`.
      path: where to, ending in .mp4, .gif or .webp; its folder is made if need be.
      seconds: that the diffusion takes in the film [s]; by default 7, and 2 for each further try.
      ghosts: number of knots at which the robot is shown; by default 24, or fewer if it has many
        parts, which take long to draw without a GPU.
      chains: number of chains whose paths are shown, those of distinct optima first.
      fps: frames per second.
      size: (height, width) [pixels].
      camera: a camera of the model, see `render_frames`; None frames all that is shown.
      speed: of the motion; 0.5 is slow motion.
      draw: draw(axes, states (k + 1, nx)) draws the motion x_0..x_k on matplotlib axes, one line of
        it with a vertex for each state; needed for problems without a model.

    Raises:
      DraxError: nothing was recorded, a setting that cannot be used, or neither model nor `draw`.
    """
    recording = solution.recording
    if recording is None:
        raise DraxError(
            f"this solution of {solution.problem.name} holds no recording: call "
            "solve(..., record=1), or mjx-drax solve --film FILE."
        )
    check(solution.problem, fps=fps, size=size, camera=camera, speed=speed, draw=draw)
    if seconds is not None:
        require_positive("seconds", seconds)
    if ghosts is not None:
        require_whole("ghosts", ghosts)
    require_whole("chains", chains)
    shown = [recording.path(chain) for chain in _chains(solution, chains)]
    if seconds is None:
        seconds = _SECONDS + _MORE_SECONDS * (len(np.unique(shown[0].attempt)) - 1)
    movie.film_path(path)
    height, width = movie.even(size)
    below = 2 * round(_STRIP * height / 2)
    states = finite(solution.replayed[0])
    instants = frame_times(solution.problem.times[: len(states)], fps, speed)
    lines = outcome_lines(solution)
    colors = Colors.of(shown[0])
    picture: Picture
    model = getattr(solution.problem.dynamics, "mj_model", None)
    if model is not None:
        picture = Ghosts(model, solution, shown, states, colors, ghosts, camera)
    else:
        assert draw is not None  # as checked
        left = movie.text_box(lines, height - below, width)[1][2] / width
        picture = Drawing(draw, solution, shown, states, colors, left)

    def frames() -> Generator[Frame, None, None]:
        strip = Strip(shown[0], colors, below, width)
        with picture.opened(height - below, width) as (knots, motion):
            for at in _positions(shown[0], seconds, fps):
                frame = movie.captioned(knots(at), _caption(solution, shown[0], at), 0.0)
                yield np.concatenate([frame, strip.frame(at)])
            end = strip.frame(len(shown[0].iteration) - 1.0)
            for time in instants:
                frame = movie.captioned(motion(time), lines, time)
                yield np.concatenate([frame, end])

    return movie.write(path, frames(), fps, size)


def _chains(solution: Solution, count: int) -> list[int]:
    """The best chain, one of every other optimum, and further ones: the cheapest first."""
    ways = [optimum.chain for optimum in solution.optima]
    cheap = np.argsort(np.where(solution.feasible, solution.cost, np.inf), kind="stable")
    order = [solution.best_chain, *ways, *(int(chain) for chain in cheap)]
    return list(dict.fromkeys(order))[:count]


def _positions(path: Path, seconds: float, fps: float) -> Floats:
    """Where each frame is among the snapshots: 2.5 is half way between the third and the fourth."""
    logs = np.log10(np.maximum(path.defects, FEASIBLE))
    fall = np.abs(np.diff(logs, axis=0)).mean(axis=1)
    scale = np.std(path.x, axis=(0, 1)) + 1e-9
    motion = (np.abs(np.diff(path.x, axis=0)).mean(axis=1) / scale).mean(axis=1)
    same = np.diff(path.attempt) == 0
    pace = np.where(same, fall / max(fall[same].sum(), 1e-9), 0.0)
    pace += np.where(same, motion / max(motion[same].sum(), 1e-9), 0.0)
    pace = _EVEN / len(pace) + (1.0 - _EVEN) * pace / max(pace.sum(), 1e-9)
    reached = np.concatenate([[0.0], np.cumsum(pace)])
    moving = np.linspace(0.0, reached[-1], max(2, round(seconds * fps)))
    at = np.interp(moving, reached, np.arange(len(reached)))
    first, last = (round(hold * fps) for hold in (_FIRST, _LAST))
    at = np.concatenate([np.zeros(first), at, np.full(last, len(reached) - 1.0)])
    jump = np.flatnonzero(~same)  # between two attempts nothing moves: show the one or the other
    inside = np.isin(np.floor(at), jump)
    return np.where(inside, np.round(at), at)


def _parts(at: float, count: int) -> tuple[int, int, float]:
    """The snapshots before and after a position among so many, and the share of the second."""
    before = min(int(at), count - 1)
    return before, min(before + 1, count - 1), at - before


def _caption(solution: Solution, path: Path, at: float) -> list[str]:
    """What is known at a position: the iteration that was last reached."""
    i = int(at)
    several = len(np.unique(path.attempt)) > 1
    sigma = f"{path.sigma[i]:.2g}" if path.sigma[i] > 0.0 else "0 (no noise)"
    return [
        solution.problem.name,
        f"iteration {path.iteration[i]}" + f", attempt {path.attempt[i] + 1}" * several,
        f"cost {path.cost[i]:.3g}   max|h| {path.max_defect[i]:.2g}",
        f"sigma {sigma}",
    ]


@dataclass(frozen=True)
class Colors:
    """Colors of defects, from feasible to the worst that were seen, on a logarithmic scale."""

    worst: float

    @staticmethod
    def of(path: Path) -> Colors:
        """The scale for a chain: up to the next power of ten above its first defects."""
        first = path.defects[0]
        worst = np.max(first[np.isfinite(first)], initial=10.0 * FEASIBLE)
        return Colors(float(10.0 ** np.ceil(np.log10(worst) - 0.3)))

    def __call__(self, defects: npt.ArrayLike) -> Floats:
        """RGBA (..., 4) of defects (...,)."""
        from matplotlib.colors import LinearSegmentedColormap

        logs = np.log10(np.maximum(np.nan_to_num(defects, nan=self.worst), FEASIBLE))
        share = (logs - np.log10(FEASIBLE)) / (np.log10(self.worst) - np.log10(FEASIBLE))
        return np.asarray(
            LinearSegmentedColormap.from_list("defects", COLORS)(np.clip(share, 0.0, 1.0))
        )


def _blend(defects: Floats, before: int, after: int, share: float) -> Floats:
    """Defects (K,) between two snapshots, (snapshots, K), on a logarithmic scale."""
    logs = np.log(np.maximum(defects[[before, after]], 1e-30))
    return np.exp((1.0 - share) * logs[0] + share * logs[1])


class Picture(Protocol):
    """Draws the upper part of the film."""

    def opened(self, height: int, width: int) -> Any:
        """A context with two functions: knots(position) -> frame and motion(time) -> frame."""


class Ghosts:
    """The robot at some knots, with MuJoCo; and the paths of bodies that travel."""

    def __init__(
        self,
        model: mujoco.MjModel,
        solution: Solution,
        shown: Sequence[Path],
        states: Floats,
        colors: Colors,
        ghosts: int | None,
        camera: str | int | None,
    ) -> None:
        self.model, self.path, self.colors = model, shown[0], colors
        self.camera = FREE if camera is None else camera
        self.qpos, self.times = states[:, : model.nq], solution.problem.times[: len(states)]
        horizon = self.path.x.shape[1]
        parts = int(np.count_nonzero(model.body_weldid[model.geom_bodyid] != 0))
        count = int(np.clip(_PARTS // max(parts, 1), *_COUNT) if ghosts is None else ghosts)
        self.knots = np.linspace(0, horizon - 1, min(count, horizon)).round().astype(int)
        scattered = self.path.x[0, self.knots, : model.nq].astype(float)
        self.seen = np.concatenate([self.qpos, scattered])
        body = travelling_body(model)
        self.shown = [] if body is None else list(shown)
        self.places = [places(model, body, p.x[:, :, : model.nq]) for p in self.shown if body]

    @contextmanager
    def opened(
        self, height: int, width: int
    ) -> Iterator[tuple[Callable[[float], Frame], Callable[[float], Frame]]]:
        """See `Picture`."""
        stage = Stage(self.model, view_of(self.model, self.seen, self.camera, width / height))
        with open_drawer(self.model, height, width) as drawer:

            def knots(at: float) -> Frame:
                stage.begin(None)
                self._add(stage, at, self.knots, _GHOST)
                return drawer.render(stage.scene)

            def motion(time: float) -> Frame:
                stage.begin(interpolated(self.model, self.qpos, self.times, time))
                self._add(stage, len(self.path.x) - 1.0, self.knots[::_FEWER], _FAINT)
                return drawer.render(stage.scene)

            yield knots, motion

    def _add(self, stage: Stage, at: float, knots: npt.ArrayLike, opacity: float) -> None:
        """Paths and ghosts at a position among the snapshots."""
        path, nq = self.path, self.model.nq
        before, after, share = _parts(at, len(path.x))
        for rank, (other, points) in enumerate(zip(self.shown, self.places, strict=True)):
            i, j, part = _moment(path, other, at)
            line = (1.0 - part) * points[i] + part * points[j]
            colors = self.colors(_blend(other.defects, i, j, part)[1:])
            colors[:, 3] = 1.0 if rank == 0 else 0.45
            stage.add_line(line, colors, 3.0 if rank == 0 else 1.2)
        colors = self.colors(_blend(path.defects, before, after, share))
        for k in np.asarray(knots):
            one, other_pose = (path.x[i, k, :nq].astype(float) for i in (before, after))
            pose = moved(self.model, one, between(self.model, one, other_pose), share)
            stage.add_ghost(pose, opacity, colors[k, :3])


def _moment(path: Path, other: Path, at: float) -> tuple[int, int, float]:
    """Where another chain is when one is at a position; at the one's end, at its own.

    That is at the same iteration of the same attempt, or where its attempts ended before.
    """
    i, j, share = _parts(at, len(path.iteration))
    if i == len(path.iteration) - 1:
        end = len(other.iteration) - 1
        return end, end, 0.0
    iteration = (1.0 - share) * path.iteration[i] + share * path.iteration[j]
    past = (other.iteration <= iteration) & (other.attempt <= path.attempt[i])
    last = int(np.flatnonzero(past)[-1])
    following = min(last + 1, len(other.iteration) - 1)
    gap = other.iteration[following] - other.iteration[last]
    if gap == 0 or other.attempt[following] != other.attempt[last]:
        return last, last, 0.0
    return last, following, float((iteration - other.iteration[last]) / gap)


class Drawing:
    """The chains' paths on what a task's draw function shows."""

    def __init__(
        self,
        draw: Draw,
        solution: Solution,
        shown: Sequence[Path],
        states: Floats,
        colors: Colors,
        left: float,
    ) -> None:
        self.left = left  # share of the width that is left to the caption
        self.draw, self.states, self.shown, self.colors = draw, states, shown, colors
        self.start = np.asarray(solution.problem.x_init, float)
        self.times = solution.problem.times[: len(states)]
        self.points = [_traced(draw, path.x.astype(float)) for path in shown]

    @contextmanager
    def opened(
        self, height: int, width: int
    ) -> Iterator[tuple[Callable[[float], Frame], Callable[[float], Frame]]]:
        """See `Picture`."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        dpi = height / 5.0
        layout = ConstrainedLayoutEngine(rect=(self.left, 0.0, 1.0 - self.left, 1.0))
        figure = Figure(((width + 0.5) / dpi, (height + 0.5) / dpi), dpi, layout=layout)
        canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
        path, drawn = self.shown[0], -1
        ways = [
            LineCollection([], linewidths=2.6 if i == 0 else 1.0, zorder=5 if i == 0 else 4)
            for i in range(len(self.shown))
        ]

        def prepare(states: Floats) -> Any:
            axes.clear()
            self.draw(axes, states)
            for way in ways:
                axes.add_collection(way)
                way.set_animated(True)
            canvas.draw()
            return canvas.copy_from_bbox(figure.bbox)

        def finish(background: Any, at: float, opacity: float) -> Frame:
            canvas.restore_region(background)
            for rank, (other, points, way) in reversed(
                list(enumerate(zip(self.shown, self.points, ways, strict=True)))
            ):
                i, j, share = _moment(path, other, at)
                line = (1.0 - share) * points[i] + share * points[j]
                colors = self.colors(_blend(other.defects, i, j, share)[1:])
                colors[:, 3] = opacity * (1.0 if rank == 0 else 0.45)
                way.set_segments(list(np.stack([line[:-1], line[1:]], axis=1)))
                way.set_color(list(map(tuple, colors)))
                axes.draw_artist(way)
            return np.array(canvas.buffer_rgba())[..., :3]

        background = prepare(self.start[None])

        def knots(at: float) -> Frame:
            return finish(background, at, 1.0)

        def motion(time: float) -> Frame:
            nonlocal background, drawn
            knot = int(np.searchsorted(self.times, time + 1e-9, side="right")) - 1
            if knot != drawn:
                background, drawn = prepare(self.states[: knot + 1]), knot
            return finish(background, len(path.x) - 1.0, 0.35)

        yield knots, motion


def _traced(draw: Draw, states: Floats) -> Floats:
    """Where `draw` puts states (..., nx) on its axes, (..., 2): the line with a vertex for each."""
    from matplotlib.figure import Figure

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


class Strip:
    """Curves of a chain over the iterations, below the picture, with a marker that moves."""

    def __init__(self, path: Path, colors: Colors, height: int, width: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        dpi = width / 7.0  # sets the size of letters
        figure = Figure(
            ((width + 0.5) / dpi, (height + 0.5) / dpi), dpi, layout="constrained", facecolor=_PAPER
        )
        first = np.diff(path.attempt, prepend=path.attempt[0]) > 0
        starts = path.iteration[first]
        last = np.append(first[1:], False)  # left out of curves, which break there
        curves = [("cost", path.cost), ("max|h|", np.maximum(path.max_defect, _EXACT))]
        if path.sigma.any():
            curves.append(("noise sigma", np.where(path.sigma > 0, path.sigma, np.nan)))
        panels = np.atleast_1d(figure.subplots(1, len(curves)))
        self._iterations = path.iteration.astype(float)
        for axes, (title, values) in zip(panels, curves, strict=True):
            _curve(axes, self._iterations, np.where(last, np.nan, values), title)
            for start in starts:
                axes.axvline(start, color="#5a6270", lw=0.8, ls=":")
        _scale(panels[1], colors)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        self._picture = np.array(canvas.buffer_rgba())[..., :3]
        self._boxes, self._spots = [], []
        for axes, (_, values) in zip(panels, curves, strict=True):
            box = axes.get_window_extent()
            self._boxes.append((height - box.y1, height - box.y0))
            spots = axes.transData.transform(np.column_stack([self._iterations, values]))
            self._spots.append(np.column_stack([spots[:, 0], height - spots[:, 1]]))
        self._radius = max(2.5, width / 200)

    def frame(self, at: float) -> Frame:
        """The strip with markers at a position among the snapshots."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(self._picture)
        pen = ImageDraw.Draw(image)
        i, j, share = _parts(at, len(self._iterations))
        for (top, bottom), spots in zip(self._boxes, self._spots, strict=True):
            x, y = (1.0 - share) * spots[i] + share * spots[j]
            if not np.isfinite(x):
                continue
            pen.line([(x, top), (x, bottom)], fill=(150, 156, 166), width=1)
            if np.isfinite(y):
                r = self._radius
                pen.ellipse([x - r, y - r, x + r, y + r], fill=_INK, outline=_PAPER)
        return np.asarray(image)


def _curve(axes: Axes, iterations: Floats, values: Floats, title: str) -> None:
    """One panel of the strip, on a logarithmic axis where all values allow it."""
    values = np.where(np.isfinite(values), values, np.nan)
    axes.set_facecolor(_PAPER)
    axes.plot(iterations, values, color=_LINE, lw=1.6)
    if np.min(values[np.isfinite(values)], initial=np.inf) > 0.0:
        axes.set_yscale("log")
    axes.set_xlim(0.0, max(1.0, iterations[-1]))
    axes.set_title(title, color=_INK, fontsize=9, loc="left", pad=3, parse_math=False)
    axes.set_xlabel("iteration", color=_INK, fontsize=8, labelpad=1)
    axes.tick_params(colors=_INK, labelsize=7, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#5a6270")


def _scale(axes: Axes, colors: Colors) -> None:
    """The colors of defects, along the axis of max|h|."""
    low, high = axes.get_ylim()
    edges = np.geomspace(low, max(high, colors.worst), 256)
    axes.set_ylim(low, edges[-1])
    left, right = axes.get_xlim()
    across = np.array([left, left + 0.035 * (right - left)])
    shades = colors(np.sqrt(edges[1:] * edges[:-1]))[:, None, :]
    axes.pcolormesh(across, edges, shades, zorder=3)
