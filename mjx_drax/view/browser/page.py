"""A replay in the browser: one HTML file with everything in it, which opens from disk.

viser records the scene, see `scene`. The page has a bar to move along time, and a scene
tree, in which these parts are shown and hidden:

    world    what does not move
    replay   the best chain, as its engine replayed it
    plan     the plan at the same time, in blue; hidden at first where the replay keeps to it
    poses    some knots of the plan at once, translucent
    path     of the geom that travels farthest, in the replay
    forces   at contacts, in the replay
"""

from __future__ import annotations

import html
import os
from pathlib import Path

import numpy as np

from mjx_drax.base.errors import require_whole
from mjx_drax.base.files import complete, file_path
from mjx_drax.solution.solution import Solution, require_solution
from mjx_drax.view.browser.scene import ReplayScene, require_viewer, server_at
from mjx_drax.view.video import outcome_lines

POSES = 8
"""So many knots of the plan are shown at once."""

_BANNER = """\
<title>{name}</title>
<style>
#drax {{ position: fixed; left: 12px; bottom: 54px; z-index: 10; pointer-events: none;
  padding: 8px 12px; border-radius: 6px; color: #f0f3f7; background: {background};
  font: 13px/1.5 system-ui, sans-serif; white-space: pre }}
</style>"""


def save_html(solution: Solution, path: str | os.PathLike[str], poses: int = POSES) -> Path:
    """Write the best chain's replay as one HTML file that any browser opens; returns its path.

    A replay that turns non-finite is shown up to there.

    Args:
        solution: from `solve`, of a problem from MJCF.
        path: where to, ending in .html.
        poses: number of knots of the plan that are shown at once, as translucent robots.

    Raises:
        DraxError: viser is not installed, the problem has no model, a number of poses below 0, or
            a path that cannot be written.
    """
    require_solution(solution)
    require_viewer(solution.problem)
    require_whole("poses", poses, 0)
    with complete(path, (".html", ".htm")) as partial:
        partial.write_text(_page(solution, _recorded(solution, int(poses))), encoding="utf-8")
    return file_path(path)


def _page(solution: Solution, recording: str) -> str:
    """The recording with a title and a few lines about the solution."""
    *lines, _ = outcome_lines(solution)  # without the time
    lines.append("plan, poses and path: see the scene tree, below at the right")
    head = _BANNER.format(
        name=html.escape(f"{solution.problem.name}, replayed"),
        background="#0e1219d0" if solution.certified else "#961414e0",
    )
    text = html.escape("\n".join(lines))
    before, after = recording.replace("<title>Viser</title>", "", 1).split("</head>", 1)
    start, end = after.rsplit("</body>", 1)
    return f'{before}{head}</head>{start}<div id="drax">{text}</div></body>{end}'


def _recorded(solution: Solution, poses: int) -> str:
    """The scene at all knots as viser's HTML."""
    with server_at() as server:
        scene = ReplayScene(server, solution, poses)
        recorder = server.get_scene_serializer()
        steps = np.diff(scene.times)
        for k, step in enumerate(steps, start=1):
            recorder.insert_sleep(float(step))
            scene.show(k)
        recorder.insert_sleep(float(steps[-1]) if len(steps) else 0.0)
        return recorder.as_html()
