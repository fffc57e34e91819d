"""Nonlinear programs that are not trajectories, by the same flow.

    min c(x)   s.t.   h(x) = 0,   g(x) <= 0,   x_lower <= x <= x_upper

is an optimal control problem with one knot and no state: x is its control, h and g are its stage
constraints. Everything else (the metrics, bounds, schedules, chains) is shared with trajectories.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, require_whole, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.kernels.compilation import keep_programs, said_plainly
from mjx_drax.method.langevin import Langevin
from mjx_drax.problem.build import from_function
from mjx_drax.problem.problem import Problem, checked
from mjx_drax.problem.tracing import require_functions
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.devices import mesh_for
from mjx_drax.search.engine import Progress, Search
from mjx_drax.search.family import Family
from mjx_drax.search.fitting import Answer, in_a_fitting_box
from mjx_drax.search.identity import look_again
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.restarts import Restarts, settled
from mjx_drax.search.units import to_units
from mjx_drax.solution.log import history_of, table
from mjx_drax.solution.progress import reporting
from mjx_drax.solution.replay import plan_violations
from mjx_drax.solution.report import INTERRUPTED, counts, endless, html
from mjx_drax.solution.results import endings, optimality, stalled_of, statuses, tolerance_of
from mjx_drax.solution.violations import Violation, most_broken, warn_of_box


def from_program(
    size: int,
    *,
    cost: Callable[[Array], Array] | None = None,
    residual: Callable[[Array], Array] | None = None,
    equality: Callable[[Array], Array] | None = None,
    inequality: Callable[[Array], Array] | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    scatter: tuple[ArrayLike, ArrayLike] | None = None,
    name: str = "program",
) -> Problem:
    """A nonlinear program in x (size,), as a problem that `minimize` solves.

    Args:
        size: n, number of variables.
        cost: c(x), a scalar.
        residual: r(x) (m,): adds 1/2 |r|^2 to the cost.
        equality: h(x) (m,), held at 0.
        inequality: g(x) (m,), held <= 0 through slack variables g + s = 0, s >= 0.
        bounds: (lower, upper), scalars or (n,).
        scatter: box that initial points are drawn from; by default the bounds, or +-1.
        name: used in messages.

    Raises:
        DraxError: functions, sizes or bounds that do not fit.
    """
    require_functions(cost=cost, residual=residual, equality=equality, inequality=inequality)
    require_whole("size", size)

    def of_control(function: Callable[[Array], Array] | None) -> Callable[..., Any] | None:
        return None if function is None else lambda x, u: function(u)

    return from_function(
        lambda x, u: x,
        x_init=np.zeros(0),
        nu=size,
        dt=1.0,
        horizon=1.0,
        running_cost=of_control(cost),
        running_residual=of_control(residual),
        equality=of_control(equality),
        inequality=of_control(inequality),
        u_bounds=bounds,
        u_scatter=scatter,
        name=name,
    )


@dataclass(frozen=True, repr=False)
class Minimum:
    """Where the chains of a nonlinear program ended. Arrays are numpy's.

    Attributes:
        program: what was solved.
        x: (chains, n).
        equality: multipliers of h, (chains, m).
        inequality: multipliers of g, (chains, mg).
        cost: c(x), (chains,).
        max_defect: largest |h| or positive g, (chains,).
        residual: of the optimality conditions, scaled; NaN if not known, (chains,).
        stalled: whether the polish of a chain found no step any more, (chains,).
        tolerance: below which a residual is that of an optimum.
        died_at: iteration at which a chain turned non-finite and was frozen, else -1, (chains,).
        interrupted: whether the solve was ended before its time.
        history: of all chains by iteration; see `Solution`.

    `print(minimum)` shows how many chains are optimal, and the best one.
    """

    program: Problem
    x: np.ndarray
    equality: np.ndarray
    inequality: np.ndarray
    cost: np.ndarray
    max_defect: np.ndarray
    residual: np.ndarray
    stalled: np.ndarray
    tolerance: float
    died_at: np.ndarray
    interrupted: bool
    history: dict[str, np.ndarray]

    def __repr__(self) -> str:
        return f"<Minimum of {self.program.name}: {len(self.cost)} chains, {self._verdict}>"

    def __str__(self) -> str:
        return "\n".join(self._report())

    def _repr_html_(self) -> str:
        return html(self._report(), self.optimal)

    @property
    def _verdict(self) -> str:
        """What is known of the best chain, with its cost."""
        return f"{self.status[self.best_chain]}, cost {self.cost[self.best_chain]:.5g}"

    def _report(self) -> list[str]:
        best, where = self.best_chain, self.where(self.best_chain)
        broken = "" if where is None else f": {where.told(self.program)}"
        converged = self.residual[best] < self.tolerance
        fall = endless(self.history["cost"][0], self.cost, converged)
        return [
            *([INTERRUPTED] if self.interrupted else []),
            f"chains         {len(self.cost)}: {counts(self.status)}",
            f"best           cost {self.cost[best]:.5g}, max|h| {self.max_defect[best]:.1e}",
            f"optimality     {optimality(self, best)}",
            *([f"               {fall}"] if fall else []),
            f"x              {shown([float(f'{x:.6g}') for x in self.best], 160)}",
            f"{self.status[best]}{broken}",
        ]

    def log(self) -> str:
        """The history as a table, a line for each report; see `Solution.log`."""
        return table(self.history, self.tolerance)

    @cached_property
    def feasible(self) -> np.ndarray:
        """Whether the largest |h| or positive g is below 1e-3, and the cost finite, (chains,)."""
        return (self.max_defect < FEASIBLE) & np.isfinite(self.cost)

    @cached_property
    def optimal_chains(self) -> np.ndarray:
        """Whether a chain is feasible and its residual below the tolerance, (chains,)."""
        return self.feasible & (self.residual < self.tolerance)

    @property
    def optimal(self) -> bool:
        """Whether the best chain is."""
        return bool(self.optimal_chains[self.best_chain])

    @cached_property
    def status(self) -> list[str]:
        """`optimal`, `feasible`, `infeasible`, `diverged` or `interrupted`, for every chain."""
        return statuses(self.feasible, self.optimal_chains, self.died_at >= 0, self.interrupted)

    @cached_property
    def polished(self) -> list[str]:
        """How the polish of every chain ended; see `Solution.polished`."""
        return endings(self.residual, self.tolerance, self.stalled)

    def where(self, chain: int) -> Violation | None:
        """The constraint that an infeasible chain breaks most; None for a feasible one."""
        if self.feasible[chain]:
            return None
        states, u = np.zeros((1, 2, 0)), self.x[chain, None, None]
        found = plan_violations(Family.of_one(self.program), states, u).of(0)
        return most_broken(self.program, found)

    @cached_property
    def best_chain(self) -> int:
        """The cheapest feasible chain, else the least infeasible one."""
        if self.feasible.any():
            return int(np.argmin(np.where(self.feasible, self.cost, np.inf)))
        return int(np.argmin(np.nan_to_num(self.max_defect, nan=np.inf)))

    @property
    def best(self) -> np.ndarray:
        """x of the best chain, (n,)."""
        return self.x[self.best_chain]


def minimize(
    program: Problem,
    chains: int = 64,
    seed: int = 0,
    solver: Langevin | Restarts | None = None,
    guess: ArrayLike | None = None,
    progress: Progress | bool | None = None,
    tolerance: float | None = None,
    max_iterations: int | None = None,
    precision: int | None = None,
) -> Minimum:
    """Solve a program from `from_program`; `guess` (n,) or (chains, n) replaces random points.

    The other arguments are those of `solve`.

    Raises:
        DraxError: sizes that misfit; functions that cannot be differentiated, or are finite, with
            their derivatives, at no initial point.

    Warns:
        DraxWarning: bounds are far wider than the answer, so the program was solved again from
            points that fit it (`search.fitting`).
    """
    program = checked(program)
    if program.dynamics.nx or program.horizon != 1:
        raise DraxError(f"{program.name} is a trajectory problem: use mjx_drax.solve.")
    keep_programs()
    look_again(program)
    program = program.in_precision(precision)
    with program.arithmetic():
        given = None if guess is None else _knots(guess, chains, program.dynamics.nu)
        settings = settled(program, chains, seed, solver, tolerance, max_iterations)

        def solved(program: Problem) -> Answer[Minimum]:
            own, mesh = Family.of_one(program), mesh_for(chains)
            search = Search(own, chains, seed, settings, mesh=mesh, guess=given)
            report = reporting(progress, program.name)
            with report as search.progress, said_plainly(f"the solve of {program.name}"):
                found = search.run()
            program, state, info = search.family.problem, found.chains.state, found.chains.info
            _, forces = to_units(program, state.trajectory, state.multipliers, back=True)
            multipliers = np.asarray(forces.constraints.stage[:, 0])
            rows = program.constraint.equalities
            minimum = Minimum(
                program=program,
                x=np.asarray(state.trajectory.u[:, 0]),
                equality=multipliers[:, :rows],
                inequality=multipliers[:, rows:],
                cost=np.asarray(info.cost),
                max_defect=np.asarray(info.max_defect),
                residual=np.asarray(info.residual),
                stalled=stalled_of(state),
                tolerance=tolerance_of(settings),
                died_at=np.asarray(state.died_at),
                interrupted=found.interrupted,
                history=history_of(found),
            )
            best, u = minimum.best_chain, state.trajectory.u
            cost = float(minimum.cost[best]) if minimum.feasible[best] else np.inf
            nothing = np.zeros((2, 0))
            knots = Trajectory(jnp.zeros((1, 0), u.dtype), u[best])
            return Answer(minimum, program, nothing, knots, cost, found.interrupted)

        return in_a_fitting_box(program, solved, warn_of_box, tolerance_of(settings))


def _knots(guess: ArrayLike, chains: int, size: int) -> Trajectory:
    """Initial points (size,) or (chains, size) as knots."""
    try:
        given = numbers(guess)
    except (TypeError, ValueError) as error:
        raise DraxError(f"guess is {shown(guess)}: give numbers, ({size},).") from error
    if given.shape not in ((size,), (chains, size)):
        raise DraxError(
            f"guess has shape {given.shape}: give ({size},), or ({chains}, {size}) with one "
            "for each chain."
        )
    u = jnp.asarray(given)[..., None, :]
    return Trajectory(jnp.zeros((*u.shape[:-1], 0)), u)
