"""The answer of a solve, with the ways to keep it: save, load, replay again."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.base.errors import DraxError, require_whole, shown
from mjx_drax.method.descent import Info
from mjx_drax.problem.problem import Problem
from mjx_drax.search.family import Family
from mjx_drax.search.identity import look_again
from mjx_drax.search.iterate import Question, evaluate, partition, residuals
from mjx_drax.search.replayer import by_the_engine
from mjx_drax.search.units import to_units
from mjx_drax.solution import report, worst
from mjx_drax.solution.files.load import load
from mjx_drax.solution.files.save import save
from mjx_drax.solution.replay import both_ways, plan_violations
from mjx_drax.solution.results import Results
from mjx_drax.solution.violations import Tolerances, as_tolerances


class Solution(Results):
    """All chains of a solve, what they reached, and how they replay; see `Results`.

    `print(solution)` shows the report that `mjx-drax solve` ends with, and a notebook the same as a
    table.
    """

    def __repr__(self) -> str:
        return report.in_a_line(self)

    def __str__(self) -> str:
        return "\n".join(report.lines(self))

    def _repr_html_(self) -> str:
        return report.html(report.lines(self), self.certified)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write `result.json` and `result.npz` into a folder, for `load`; see `files.save`.

        Raises:
            DraxError: the folder cannot be written to.
        """
        return save(self, folder)

    @staticmethod
    def load(folder: str | os.PathLike[str], problem: Problem | None = None) -> Solution:
        """The solution that was saved into a folder, by `save` or by `mjx-drax solve`.

        Args:
            folder: that holds `result.json` and `result.npz`.
            problem: what was solved. Functions are not saved, so without it the problem of the
                solution has no costs, no constraints, no goal and, unless it came from MJCF, no
                dynamics; plots, films, exports and optima need none of them, but to solve or
                `certify` again does.

        Raises:
            DraxError: the files are missing, damaged or of another format, or the problem has
                other sizes, another dt or x_init. Its functions are not compared: costs and
                certificate stay as they were, until `certify`.
        """
        return load(Solution, folder, problem)

    def worst(self, chain: int | None = None, count: int = 10) -> str:
        """The largest violations of a chain's plan and of its replay, as a table to print.

        A line for each entry of the dynamics, bounds and constraints, at the knot where it is
        worst, in multiples of what is tolerated: its name, knot, time [s], size and tolerance in
        your units.

        Args:
            chain: the best one by default.
            count: at most so many lines for the plan, and for the replay.

        Raises:
            DraxError: it was loaded without its problem; there is no such chain.
        """
        require_whole("count", count)
        return worst.table(self, chain, count)

    def certify(self, tolerances: Tolerances | None = None) -> Solution:
        """The same solution judged again: by its problem's functions, and by the engine here now.

        Every chain is replayed, and what is known of its plan is computed anew. A residual that
        was larger when it was solved stays.

        Args:
            tolerances: of violations of the replays; by default those that it was solved with.

        Raises:
            DraxError: it was loaded without its problem, whose cost and goal judge replays;
                tolerances that do not fit.
        """
        problem, u = self.problem, np.asarray(self.trajectories.u)
        look_again(problem)
        chosen = self.tolerances if tolerances is None else as_tolerances(tolerances)
        family, plan = Family.of_one(problem), self.plans.astype(float)
        open_loop, feedback, gains = both_ways(family, plan, u, self.gains, chosen)
        with problem.arithmetic():
            info, residual = self._judged()
        return replace(
            self,
            cost=np.asarray(info.cost),
            max_defect=np.asarray(info.max_defect),
            max_violation=np.asarray(info.max_violation),
            residual=residual,
            plan=plan_violations(family, plan, u),
            open_loop=open_loop,
            feedback=feedback,
            gains=gains,
            tolerances=chosen,
            engine=problem.dynamics.engine,
        )

    def _judged(self) -> tuple[Info, np.ndarray]:
        """Where the plans are by the problem's functions, and their residuals (chains,)."""
        problem, known = self.problem, (self.trajectories, self.multipliers)
        knots, multipliers = to_units(problem, *jax.tree.map(jnp.asarray, known))
        shared, own = question = partition(Question(self.solver.flow, problem), None)
        of, family = np.zeros(self.chains, int), Family.of_one(problem)
        info, bare = evaluate(problem, knots), replace(knots, slack=None)
        info = by_the_engine(family, question, of, info, bare, self.plans, self.feasible)
        if multipliers.bounds is None:  # nothing was polished
            return info, self.residual
        found = np.asarray(residuals(own, shared, knots, multipliers))
        return info, np.maximum(self.residual, found)


def require_solution(solution: object) -> None:
    """Complain about what is no answer of a solve, before it is drawn or written."""
    if not isinstance(solution, Solution):
        raise DraxError(
            f"the solution is {shown(solution)}: give what solve or Solution.load has returned."
        )
