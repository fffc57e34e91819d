"""Trajectories for MuJoCo models by equality-constrained Langevin diffusion.

>>> problem = mjx_drax.from_mjcf("robot.xml", running_cost=..., terminal_cost=..., horizon=2.0)
>>> solution = mjx_drax.solve(problem, chains=256, seed=0)
>>> mjx_drax.render(solution, "out.mp4")

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjx_drax import guesses as guesses
    from mjx_drax.background import Background as Background
    from mjx_drax.batch import BatchSolution as BatchSolution
    from mjx_drax.batch import solve_batch as solve_batch
    from mjx_drax.bounds import LogBarrier as LogBarrier
    from mjx_drax.bounds import Projection as Projection
    from mjx_drax.bounds import Reflection as Reflection
    from mjx_drax.browser import save_html as save_html
    from mjx_drax.derivatives import Autodiff as Autodiff
    from mjx_drax.derivatives import Smoothed as Smoothed
    from mjx_drax.errors import DraxError as DraxError
    from mjx_drax.export import export_keyframes as export_keyframes
    from mjx_drax.export import save_csv as save_csv
    from mjx_drax.export import save_dataset as save_dataset
    from mjx_drax.film import render_diffusion as render_diffusion
    from mjx_drax.ghosts import render_timelapse as render_timelapse
    from mjx_drax.langevin import Langevin as Langevin
    from mjx_drax.mjcf import from_mjcf as from_mjcf
    from mjx_drax.mpc import MPC as MPC
    from mjx_drax.plant import Plant as Plant
    from mjx_drax.plant import Push as Push
    from mjx_drax.precondition import Diagonal as Diagonal
    from mjx_drax.precondition import GaussNewton as GaussNewton
    from mjx_drax.precondition import Identity as Identity
    from mjx_drax.problem import Problem as Problem
    from mjx_drax.problem import Trajectory as Trajectory
    from mjx_drax.problem import from_function as from_function
    from mjx_drax.program import from_program as from_program
    from mjx_drax.program import minimize as minimize
    from mjx_drax.quasi_newton import LBFGS as LBFGS
    from mjx_drax.rendering import render as render
    from mjx_drax.restarts import Restarts as Restarts
    from mjx_drax.schedules import Constant as Constant
    from mjx_drax.schedules import Geometric as Geometric
    from mjx_drax.solution import Solution as Solution
    from mjx_drax.solution import solve as solve
    from mjx_drax.terms import Terms as Terms

__version__ = "0.1.0"

_HOME = {
    "BatchSolution": "batch",
    "solve_batch": "batch",
    "Background": "background",
    "MPC": "mpc",
    "Plant": "plant",
    "Push": "plant",
    "LogBarrier": "bounds",
    "DraxError": "errors",
    "export_keyframes": "export",
    "save_csv": "export",
    "save_dataset": "export",
    "save_html": "browser",
    "Langevin": "langevin",
    "from_mjcf": "mjcf",
    "GaussNewton": "precondition",
    "Diagonal": "precondition",
    "Identity": "precondition",
    "LBFGS": "quasi_newton",
    "Projection": "bounds",
    "Reflection": "bounds",
    "Autodiff": "derivatives",
    "Smoothed": "derivatives",
    "from_program": "program",
    "minimize": "program",
    "Problem": "problem",
    "Trajectory": "problem",
    "from_function": "problem",
    "render": "rendering",
    "render_diffusion": "film",
    "render_timelapse": "ghosts",
    "Restarts": "restarts",
    "Constant": "schedules",
    "Geometric": "schedules",
    "Solution": "solution",
    "solve": "solution",
    "Terms": "terms",
}

__all__ = sorted([*_HOME, "guesses"])

if not (Path(__file__).parent / "tasks").is_dir():  # a checkout: tasks and models lie beside us
    __path__.append(str(Path(__file__).parents[1]))


def __getattr__(name: str) -> Any:
    if name == "guesses":
        return import_module("mjx_drax.guesses")
    if name not in _HOME:
        raise AttributeError(f"module 'mjx_drax' has no attribute {name!r}")
    value = getattr(import_module(f"mjx_drax.{_HOME[name]}"), name)
    globals()[name] = value  # in place of the submodule that may carry the same name
    return value
