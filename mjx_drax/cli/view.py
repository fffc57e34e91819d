"""Show a result that `mjx-drax solve` wrote, in a browser: time, plan, replay and contact forces.

The page is served from this machine until Ctrl-C, and needs pip install "mjx-drax[view]". A problem
without a model is shown by the pictures and films in the folder. To watch a solve while it runs:
mjx-drax solve TASK --live.
"""

from __future__ import annotations

import argparse

from mjx_drax.cli import pictures
from mjx_drax.cli.common import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder, and how to show it."""
    parser.add_argument("folder", metavar="DIR", help="such as out/cartpole_swingup")
    parser.add_argument(
        "--port", type=int, default=8080, metavar="N", help="of the page; default 8080"
    )
    parser.add_argument(
        "--native",
        action="store_true",
        help="MuJoCo's own viewer instead of a browser; it needs a display. The space bar stops "
        "time, arrow keys go from knot to knot",
    )


def run(options: argparse.Namespace) -> int:
    """Show the result until Ctrl-C, or until the window is closed."""
    from mjx_drax.physics.dynamics import mujoco_model
    from mjx_drax.solution.solution import Solution
    from mjx_drax.view.browser.pictures import show_pictures
    from mjx_drax.view.browser.viewer import show, show_natively

    solution = Solution.load(options.folder)
    if options.native:
        show_natively(solution)
    elif mujoco_model(solution.problem.dynamics) is None:
        show_pictures(solution, pictures.in_folder(options.folder), port=options.port, told=say)
    else:
        show(solution, port=options.port, told=say)
    return 0
