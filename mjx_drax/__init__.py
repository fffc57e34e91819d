"""Trajectories for MuJoCo models by equality-constrained Langevin diffusion.

>>> problem = mjx_drax.from_mjcf("robot.xml", running_cost=..., terminal_cost=..., horizon=2.0)
>>> solution = mjx_drax.solve(problem, chains=256, seed=0)
>>> mjx_drax.render(solution, "out.mp4")

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mjx_drax import _checkout as _checkout

if TYPE_CHECKING:
    from mjx_drax.base.errors import DraxError as DraxError
    from mjx_drax.control.background import Background as Background
    from mjx_drax.control.mpc import MPC as MPC
    from mjx_drax.control.plant import Plant as Plant
    from mjx_drax.control.plant import Push as Push
    from mjx_drax.method.bounds import LogBarrier as LogBarrier
    from mjx_drax.method.bounds import Projection as Projection
    from mjx_drax.method.bounds import Reflection as Reflection
    from mjx_drax.method.langevin import Langevin as Langevin
    from mjx_drax.method.metrics import Diagonal as Diagonal
    from mjx_drax.method.metrics import GaussNewton as GaussNewton
    from mjx_drax.method.metrics import Identity as Identity
    from mjx_drax.method.quasi_newton import LBFGS as LBFGS
    from mjx_drax.method.schedules import Constant as Constant
    from mjx_drax.method.schedules import Geometric as Geometric
    from mjx_drax.modelling import guesses as guesses
    from mjx_drax.modelling.terms import Terms as Terms
    from mjx_drax.physics.mjcf import from_mjcf as from_mjcf
    from mjx_drax.problem.differentiators import Autodiff as Autodiff
    from mjx_drax.problem.differentiators import Smoothed as Smoothed
    from mjx_drax.problem.problem import Problem as Problem
    from mjx_drax.problem.problem import Trajectory as Trajectory
    from mjx_drax.problem.problem import from_function as from_function
    from mjx_drax.search.restarts import Restarts as Restarts
    from mjx_drax.solution.batch import BatchSolution as BatchSolution
    from mjx_drax.solution.batch import solve_batch as solve_batch
    from mjx_drax.solution.export import export_keyframes as export_keyframes
    from mjx_drax.solution.export import save_csv as save_csv
    from mjx_drax.solution.export import save_dataset as save_dataset
    from mjx_drax.solution.program import from_program as from_program
    from mjx_drax.solution.program import minimize as minimize
    from mjx_drax.solution.solution import Solution as Solution
    from mjx_drax.solution.solution import solve as solve
    from mjx_drax.view.browser import save_html as save_html
    from mjx_drax.view.film import render_diffusion as render_diffusion
    from mjx_drax.view.rendering import render as render
    from mjx_drax.view.timelapse import render_timelapse as render_timelapse

__version__ = "0.1.0"

_HOME = {
    "BatchSolution": "solution.batch",
    "solve_batch": "solution.batch",
    "Background": "control.background",
    "MPC": "control.mpc",
    "Plant": "control.plant",
    "Push": "control.plant",
    "LogBarrier": "method.bounds",
    "DraxError": "base.errors",
    "export_keyframes": "solution.export",
    "save_csv": "solution.export",
    "save_dataset": "solution.export",
    "save_html": "view.browser",
    "Langevin": "method.langevin",
    "from_mjcf": "physics.mjcf",
    "GaussNewton": "method.metrics",
    "Diagonal": "method.metrics",
    "Identity": "method.metrics",
    "LBFGS": "method.quasi_newton",
    "Projection": "method.bounds",
    "Reflection": "method.bounds",
    "Autodiff": "problem.differentiators",
    "Smoothed": "problem.differentiators",
    "from_program": "solution.program",
    "minimize": "solution.program",
    "Problem": "problem.problem",
    "Trajectory": "problem.problem",
    "from_function": "problem.problem",
    "render": "view.rendering",
    "render_diffusion": "view.film",
    "render_timelapse": "view.timelapse",
    "Restarts": "search.restarts",
    "Constant": "method.schedules",
    "Geometric": "method.schedules",
    "Solution": "solution.solution",
    "solve": "solution.solution",
    "Terms": "modelling.terms",
}

__all__ = sorted([*_HOME, "guesses"])


def __getattr__(name: str) -> Any:
    if name == "guesses":
        return import_module("mjx_drax.modelling.guesses")
    if name not in _HOME:
        raise AttributeError(f"module 'mjx_drax' has no attribute {name!r}")
    value = getattr(import_module(f"mjx_drax.{_HOME[name]}"), name)
    globals()[name] = value  # in place of the submodule that may carry the same name
    return value
