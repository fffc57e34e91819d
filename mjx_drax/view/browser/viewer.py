"""A solution to look at while a program runs: in the browser, or in MuJoCo's own viewer.

`show` serves a page with a bar of time; plan, replay, poses, path and contact forces are shown
and hidden there. `Live` shows the knots of a solve while it runs. `show_natively` needs a display.
"""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_drax.base.errors import DraxError, require_whole
from mjx_drax.physics.c_engine.states import finite, interpolated, set_state
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.search.iterate import ranking
from mjx_drax.search.recording import Recorder
from mjx_drax.view.browser.page import POSES
from mjx_drax.view.browser.scene import (
    Copies,
    ReplayScene,
    add_copies,
    add_world,
    motion_of,
    require_viewer,
    server_at,
    shapes_of,
)
from mjx_drax.view.diffusion import Colors
from mjx_drax.view.drawing import knot_at
from mjx_drax.view.scene import set_pose
from mjx_drax.view.video import outcome_lines

if TYPE_CHECKING:
    import viser

    from mjx_drax.method.descent import Info
    from mjx_drax.problem.problem import Problem
    from mjx_drax.problem.trajectory import Trajectory
    from mjx_drax.solution.solution import Solution

PORT = 8080
"""Where the page is, unless another port is asked for."""

_FRAME = 1.0 / 30.0  # [s]
_KNOTS, _OPACITY = 16, 0.6  # of the robots that show a solve while it runs
_PLAN = (0.12, 0.44, 0.70, 0.3)
_SPACE, _ARROWS = 32, {262: 1, 263: -1}  # keys, as GLFW counts them


def show(
    solution: Solution,
    *,
    port: int = PORT,
    told: Callable[[str], object] = print,
    until: threading.Event | None = None,
) -> None:
    """Serve a page that shows the best chain of a solution, until Ctrl-C.

    Args:
        solution: from `solve`, of a problem from MJCF.
        port: of this machine; 0 takes any that is free.
        told: called with a line that says where the page is.
        until: set by another thread, it ends the page.

    Raises:
        DraxError: viser is not installed, the problem has no model, or the port is in use.
    """
    require_viewer(solution.problem)
    with server_at(checked_port(port)) as server:
        told(f"open {_address(server)} in a browser; Ctrl-C ends it")
        _play(server, solution, until or threading.Event())


def _address(server: viser.ViserServer) -> str:
    return f"http://127.0.0.1:{server.get_port()}"


def checked_port(port: int) -> int:
    """The port, if it can be one."""
    require_whole("port", port, 0)
    if port > 65535:
        raise DraxError(f"port is {port}: give a number from 1 to 65535, or 0 for any.")
    return int(port)


def _play(server: viser.ViserServer, solution: Solution, until: threading.Event) -> None:
    """Show the solution, and go on with time while the page says so."""
    server.scene.reset()
    server.gui.reset()
    scene = ReplayScene(server, solution, POSES)
    *lines, _ = outcome_lines(solution)  # without the time
    server.gui.add_markdown("  \n".join(lines))
    times, begin, end = scene.times, float(scene.times[0]), float(scene.times[-1])
    step = max((end - begin) / 1000.0, 1e-6)
    bar: Any = server.gui.add_slider("time [s]", begin, max(end, begin + step), step, begin)
    playing = server.gui.add_checkbox("play", True)
    speed = server.gui.add_slider("speed", 0.05, 2.0, 0.05, 1.0)

    def toggle(name: str, part: Any) -> None:
        box = server.gui.add_checkbox(name, part.visible)

        @box.on_update
        def _(_: object) -> None:
            part.visible = box.value

    for name, part in scene.parts.items():
        toggle(name, part)
    shown = -1
    while not until.wait(_FRAME):
        if playing.value:
            now = bar.value + _FRAME * speed.value
            bar.value = now if now <= end else begin
        knot = knot_at(times, bar.value)
        if knot != shown:
            with server.atomic():
                scene.show(knot)
            shown = knot


class Live(Recorder):
    """A recorder that shows the knots of one chain in a browser while the solve runs.

    `solve(problem, record=live)`; see `live_page`. The robot stands at some knots, in blue where
    they obey the dynamics and in orange where they do not. Another chain is shown as soon as that
    one is infeasible and the other is not.
    """

    def __init__(self, server: viser.ViserServer, problem: Problem, every: int) -> None:
        super().__init__(every)
        model = mujoco_model(problem.dynamics)
        assert model is not None  # as `require_viewer` checked
        self._model, self._server, self._name = model, server, problem.name
        start = np.asarray(problem.x_init, float)[None, : model.nq]
        self._shapes = shapes_of(model, start, server)
        add_world(server.scene, self._shapes, model)
        self._text = server.gui.add_markdown(f"{problem.name}: compiling ...")
        self._copies: list[Copies] = []
        self._chain = 0

    def take(self, problem: Problem, sigma: float, done: int, z: Trajectory, info: Info) -> None:
        """A snapshot, as `Recorder.take`; it is shown if it is finite."""
        super().take(problem, sigma, done, z, info)
        shot = self.attempts[-1].snapshots[-1]
        infeasible, value = ranking(shot.cost, shot.max_defect)
        if self._chain >= len(infeasible) or infeasible[self._chain]:  # attempts differ in places
            self._chain = int(np.lexsort((value, infeasible))[0])
        chain, count = self._chain, min(_KNOTS, problem.horizon)
        knots = np.linspace(0, problem.horizon - 1, count).round().astype(int)
        states = shot.x[chain, knots].astype(float)
        if not np.isfinite(states).all():
            return
        if not self._copies:
            self._colors = Colors.of(shot.defects[chain])
        colors = np.rint(255.0 * self._colors(shot.defects[chain, knots])[:, :3]).astype(np.uint8)
        motion = motion_of(self._model, states)
        with self._server.atomic():
            if not self._copies:
                self._copies = add_copies(self._server.scene, self._shapes, motion, _OPACITY)
            for copies in self._copies:
                copies.move(motion, colors)
            self._text.content = "  \n".join(
                (
                    f"{self._name}: iteration {done}, noise {sigma:.2g}",
                    f"{np.mean(~infeasible):.0%} of {len(infeasible)} chains are feasible",
                    f"chain {chain}: cost {shot.cost[chain]:.4g}, "
                    f"max|h| {shot.max_defect[chain]:.1e}",
                )
            )

    def play(self, solution: Solution, until: threading.Event | None = None) -> None:
        """Show the answer on the same page, until Ctrl-C or an event."""
        _play(self._server, solution, until or threading.Event())


@contextmanager
def live_page(
    problem: Problem, *, port: int = PORT, every: int = 5, told: Callable[[str], object] = print
) -> Iterator[Live]:
    """A context: a page that shows a solve while it runs.

    `with live_page(problem) as live: solve(problem, record=live)`.

    Args:
        problem: from MJCF.
        port: of this machine; 0 takes any that is free.
        every: iterations between two pictures.
        told: called with a line that says where the page is.

    Raises:
        DraxError: as `show`.
    """
    require_viewer(problem)
    with server_at(checked_port(port)) as server:
        live = Live(server, problem, every)
        told(f"open {_address(server)} in a browser")
        yield live


def show_natively(solution: Solution, until: threading.Event | None = None) -> None:
    """Play the best chain's replay in MuJoCo's own viewer, until its window is closed.

    The plan is drawn over it, translucent, and contact forces as arrows. The space bar stops time,
    the arrow keys go to the knot before and after.

    Raises:
        DraxError: there is no display, or the problem has no model.
    """
    states, controls = solution.replayed
    model = mujoco_model(solution.problem.dynamics, states[0])
    if model is None:
        raise DraxError(f"{solution.problem.name} has no MuJoCo model to show: see plot.png.")
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if platform.system() == "Linux" and not shown:
        raise DraxError("MuJoCo's viewer needs a display, and DISPLAY is not set: leave --native.")
    import mujoco.viewer as native

    states = finite(states)
    plan = solution.plans[solution.best_chain][:, : model.nq].astype(float)
    times = solution.times_of(solution.best_chain)
    size, data, planned = model.nq + model.nv + model.na, mujoco.MjData(model), mujoco.MjData(model)
    keys: list[int] = []
    playing, now = True, float(times[0])
    with native.launch_passive(model, data, key_callback=keys.append) as window:
        window.opt.flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE] = 1
        while window.is_running() and not (until is not None and until.is_set()):
            for key in keys[:]:
                knot = knot_at(times, now)
                playing = not playing if key == _SPACE else playing and key not in _ARROWS
                now = float(times[np.clip(knot + _ARROWS.get(key, 0), 0, len(states) - 1)])
            keys.clear()
            knot = knot_at(times[: len(states)], now)
            with window.lock():
                set_state(model, data, states[knot, :size])
                data.ctrl[:] = controls[min(knot, len(controls) - 1), : model.nu]
                mujoco.mj_forward(model, data)
                set_pose(model, planned, interpolated(model, plan, times, now))
                window.user_scn.ngeom = 0
                moving = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
                option, pull = mujoco.MjvOption(), mujoco.MjvPerturb()
                mujoco.mjv_addGeoms(model, planned, option, pull, moving, window.user_scn)
                for geom in window.user_scn.geoms[: window.user_scn.ngeom]:
                    geom.rgba[:] = _PLAN
            window.sync()
            time.sleep(_FRAME)
            if playing:
                now = now + _FRAME if now < times[len(states) - 1] else float(times[0])
