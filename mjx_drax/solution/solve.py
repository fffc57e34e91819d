"""Solve one problem, and certify the answer by replaying it."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.kernels.compilation import keep_programs, said_plainly
from mjx_drax.method.langevin import Langevin
from mjx_drax.problem.problem import Problem, checked
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.checkpoint import Checkpoint
from mjx_drax.search.devices import mesh_for
from mjx_drax.search.engine import Found, Progress, Search
from mjx_drax.search.family import Family
from mjx_drax.search.fitting import Answer, in_a_fitting_box
from mjx_drax.search.identity import look_again
from mjx_drax.search.iterate import Question, feedback_gains, partition, ranking
from mjx_drax.search.recording import Recorder
from mjx_drax.search.restarts import Restarts, settled
from mjx_drax.search.units import to_units
from mjx_drax.search.unlimited import both_of, found_in_steps, is_motion
from mjx_drax.search.warm import Warm, require_alike
from mjx_drax.solution.log import history_of
from mjx_drax.solution.progress import reporting
from mjx_drax.solution.replay import both_ways, plan_violations
from mjx_drax.solution.results import stalled_of, tolerance_of
from mjx_drax.solution.solution import Solution
from mjx_drax.solution.violations import (
    Tolerances,
    as_tolerances,
    warn_of_box,
    warn_of_controls_at_the_end,
    warn_of_loose_ends,
    warn_of_rounding,
)


def solve(
    problem: Problem,
    chains: int = 64,
    seed: int = 0,
    solver: Langevin | Restarts | None = None,
    guess: Trajectory | Solution | None = None,
    progress: Progress | bool | None = None,
    record: int | Recorder | None = None,
    devices: int = 1,
    checkpoint: str | os.PathLike[str] | None = None,
    tolerances: Tolerances | None = None,
    tolerance: float | None = None,
    max_iterations: int | None = None,
    max_seconds: float | None = None,
    precision: int | None = None,
) -> Solution:
    """Run `chains` Langevin chains and replay what they found.

    Args:
        problem: from `from_mjcf` or `from_function`.
        chains: number of chains.
        seed: of all random numbers.
        solver: `Restarts()` by default, whose settings are scaled from the problem; or one
            `Langevin` with its schedules in their own scale.
        guess: initial knots instead of random ones: one trajectory for all chains, (K, nx) and
            (K, nu), or one each, (chains, K, nx) and (chains, K, nu). They need not be feasible.
            A solution, of this problem or of one with other numbers, is a warm start: its chains
            go on from their knots, multipliers and barriers, at first without noise. Another
            horizon cuts it off, or repeats its last stage. No chain ends worse than a feasible
            guess that reaches the goal.
        progress: True shows a bar, also while it compiles, False shows nothing; by default there is
            one if standard error is a terminal or a notebook, and else a line a minute, as in the
            log of a job. A function is called instead with (iterations done, of how many,
            diagnostics) every few iterations. Ctrl-C between two reports ends the solve early and
            keeps what there is.
        record: keep the knots of all chains every so many iterations, in `solution.recording`, for
            `render_diffusion`; the answer is the same. It takes 4 (nx + 1) K bytes for each chain
            and snapshot, and at most `recording.LIMIT`, beyond which fewer snapshots are kept.
            A recorder instead of a number takes the snapshots itself, as `viewer.Live` does.
        devices: how many of this process to spread the chains over, evenly; the answer is the
            same. Each compiles the program for itself, all at once.
        checkpoint: a file to write every half minute, and to go on from where it is there, after
            the same call was killed or ended by Ctrl-C. The answer is the same, bit for bit. A
            file that belongs to a complete solve gives its answer again; it may be deleted.
        tolerances: by how much replays may break bounds and constraints; see `Tolerances`.
        tolerance: residual below which a chain is optimal and stops; by default 1e-4, and 1e-8 in
            float64. It is for the optimality of plans, and `tolerances` for violations of replays.
        max_iterations: most iterations of the polish that brings it there, in an attempt; by
            default 200, and where then no chain at the best cost has settled, up to 1,000 in the
            end. Given either, chains are polished where by default they are not.
        max_seconds: after which the solve ends as by Ctrl-C, at the next report [s]; the time to
            compile does not count.
        precision: 64: in float64, whatever JAX is set to; see `Problem.in_float64` for what that
            asks of the problem. 32: in float32. None: in the precision of the problem.

    Returns:
        the solution with its certificate; look at `solution.certified` and `solution.optimal`.

    Raises:
        DraxError: sizes that misfit, of tolerances too; functions that cannot be differentiated,
            compute something else each time, or are finite, with their derivatives, at no initial
            knot; a checkpoint that cannot be written, is damaged or belongs to another solve.

    Warns:
        DraxWarning: bounds are far wider than the motion, or it leaves the default box far behind,
            so the problem was solved again from knots that fit it (`search.fitting`); conditions
            of the end that say little.
    """
    problem = checked(problem)
    if problem.dynamics.nx == 0:
        raise DraxError(f"{problem.name} has no states to replay: use mjx_drax.minimize.")
    keep_programs()
    look_again(problem)
    problem = problem.in_precision(precision)
    with problem.arithmetic():
        tolerances = as_tolerances(tolerances)
        tolerances.of(problem)  # refuses those of another size
        settings = settled(problem, chains, seed, solver, tolerance, max_iterations, max_seconds)
        if record is not None and not isinstance(record, Recorder):
            record = Recorder(record)
        if record is not None and record.attempts:
            raise DraxError("record is a recorder that has recorded a solve: make another one.")
        given = warm_of(guess, problem, chains) if isinstance(guess, Solution) else guess

        def saved(step: int) -> Checkpoint | None:
            if checkpoint is None:
                return None
            return Checkpoint(f"{os.fspath(checkpoint)}.{step + 1}" if step else checkpoint)

        most = math.inf if max_seconds is None else max_seconds

        spent = [0.0, 0.0]  # compiling and solving
        live = record is not None and type(record) is not Recorder  # it shows one solve

        def solved(problem: Problem) -> Answer[Solution]:
            first = spent == [0.0, 0.0]
            recorder = record if first or record is None else Recorder(record.every)
            step, ended = count(), [False]  # what follows an interrupted search does not go on

            def searched(
                posed: Problem, settings: Restarts, warm: Warm | None
            ) -> tuple[Search, Found]:
                n, report = next(step), reporting(progress, problem.name)
                search = Search(
                    Family.of_one(posed),
                    chains,
                    seed,
                    settings,
                    mesh=mesh_for(chains, devices),
                    guess=given if warm is None else warm,
                    checkpoint=saved(n) if first else None,
                    recorder=None if n else recorder,
                    seconds=0.0 if ended[0] else most - spent[1],
                )
                with report as search.progress, said_plainly(f"the solve of {problem.name}"):
                    found = search.run()
                spent[:] = spent[0] + found.compile_time, spent[1] + found.solve_time
                ended[0] |= found.interrupted
                return search, found

            # No chain may end worse than its guess; and without a polish, the flow is as was asked
            polish = settings.polish
            both = both_of(problem) if polish is not None and polish.iterations else None
            if both is None or is_motion(problem, given, chains):
                search, found = searched(problem, settings, None)
                problem = search.family.problem
            else:
                problem, found = found_in_steps(problem, both, settings, searched)
            solution = _certified(problem, settings, seed, found, tolerances)
            if recorder is not None:
                solution = replace(solution, recording=recorder.recording())
            best = solution.best_chain
            return Answer(
                solution,
                solution.problem,
                solution.plans[best],
                jax.tree.map(lambda a: a[best], solution.trajectories),
                float(solution.replay_cost[best]) if solution.certified else math.inf,
                solution.interrupted or spent[1] >= most or live,
            )

        solution = in_a_fitting_box(problem, solved, warn_of_box, tolerance_of(settings))
        solution = replace(solution, compile_time=spent[0], solve_time=spent[1])
        if solution.certified:
            plans, u = solution.plans.astype(float), np.asarray(solution.trajectories.u)
            family = Family.of_one(solution.problem)
            for warn in (warn_of_loose_ends, warn_of_rounding):
                warn(family, plans, u, tolerances, solution.best_chain)
            states, controls = solution.replayed
            warn_of_controls_at_the_end(
                solution.problem, states[-1], controls[-1], float(solution.times[-1])
            )
    return solution


def warm_of(solution: Solution, problem: Problem, chains: int) -> Warm:
    """The solution's chains for a solve of the same sizes, the best first, resized to `chains`."""
    infeasible, value = ranking(solution.cost, solution.max_defect)
    order = np.lexsort((value, ~solution.certified_chains, infeasible))
    dtype, gains = problem.x_init.dtype, jnp.asarray(solution.gains)
    known = Warm(solution.trajectories, solution.multipliers, gains)
    known = jax.tree.map(lambda a: jnp.asarray(a, dtype), known)
    warm = known.rows(np.resize(order, chains)).of_length(problem.horizon)
    require_alike(problem, warm)
    return warm


def _certified(
    problem: Problem,
    settings: Restarts,
    seed: int,
    found: Found,
    tolerances: Tolerances,
) -> Solution:
    """The solution: everything on the host, every chain replayed twice."""
    state, info = found.chains.state, found.chains.info
    users = to_units(problem, state.trajectory, state.multipliers, back=True)
    trajectories, multipliers = jax.tree.map(np.asarray, users)
    gains = np.asarray(state.gains)
    if not settings.flow.preconditioner.has_gains:
        shared, own = partition(Question(settings.flow, problem), None)
        gains = np.asarray(feedback_gains(own, shared, state))
    family, plan = Family.of_one(problem), np.asarray(problem.with_start(trajectories), float)
    u = np.asarray(trajectories.u)
    open_loop, feedback, gains = both_ways(family, plan, u, gains, tolerances)
    return Solution(
        problem=problem,
        solver=settings,
        seed=seed,
        trajectories=trajectories,
        multipliers=multipliers,
        gains=gains,
        cost=np.asarray(info.cost),
        max_defect=np.asarray(info.max_defect),
        max_violation=np.asarray(info.max_violation),
        residual=np.asarray(info.residual),
        stalled=stalled_of(state),
        tolerance=tolerance_of(settings),
        feasible_since=found.chains.feasible_since,
        died_at=np.asarray(state.died_at),
        interrupted=found.interrupted,
        plan=plan_violations(family, plan, u),
        open_loop=open_loop,
        feedback=feedback,
        tolerances=tolerances,
        history=history_of(found),
        iterations=found.records[-1][0],
        compile_time=found.compile_time,
        solve_time=found.solve_time,
        engine=problem.dynamics.engine,
    )
