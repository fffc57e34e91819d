"""A solution for a person, in a few lines: `print(solution)`, in a notebook and in the shell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from html import escape

import jax
import numpy as np

from mjx_drax.base.errors import DraxError
from mjx_drax.kernels.compilation import compiled
from mjx_drax.physics.dynamics import mjx_dynamics
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory
from mjx_drax.search.identity import identity
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.units import with_units
from mjx_drax.solution.between import broken_between_knots
from mjx_drax.solution.names import control_names, difference_names, state_names
from mjx_drax.solution.replay import OPEN_LOOP, WITH_FEEDBACK
from mjx_drax.solution.results import STALLED, UNFINISHED, Optimum, Results
from mjx_drax.solution.violations import (
    GOAL,
    TRACKING,
    Violation,
    entry_name,
    with_plan_tolerance,
    words,
)
from mjx_drax.solution.worst import of_engine

OPTIMA = 5
"""So many distinct optima are printed."""

LOOK = (
    "look at it     solution.worst() lists what it breaks, and mjx_drax.render(solution, "
    '"plan.mp4", plan=True) films what was planned'
)
"""Where to look if nothing is certified."""

INTERRUPTED = "interrupted    the solve was ended before its time; this is the best until then"

ALIKE = 0.01
"""Costs that differ by less than this share are the same."""

ALIKE_BROKEN = 0.1
"""Chains whose largest violations differ by no more than this share end alike."""

ON_BOUND = 0.01
"""Share of its range within which an entry is on an end of it."""

BOTTOMLESS = 1e6
"""A best cost so many times as far below zero as those of initial knots are from it has no end."""

LABEL = 15
"""Characters of a line that name what it is about."""

_GOOD, _BAD = "#1a7f37", "#cf222e"
_CELL = "text-align:left;vertical-align:top;white-space:pre-wrap;font-family:monospace"


def lines(solution: Results) -> list[str]:
    """Chains, the best one, the three parts of its certificate, distinct optima, times, verdict."""
    best = solution.best_chain
    found = counts(solution.status)
    if set(solution.polished) & {STALLED, UNFINISHED}:
        found += f" (polish: {counts(solution.polished)})"
    rate = f"{solution.success_rate:.1%} succeed when replayed"
    times = f"compile {solution.compile_time:.1f} s, solve {solution.solve_time:.1f} s"
    hints = (_fall(solution), _off_the_engine(solution)) if solution.certified else ()
    unseen = [_between_knots(solution), _unplanned_contact(solution)] if solution.certified else []
    return [
        *([INTERRUPTED] if solution.interrupted else []),
        f"chains         {solution.chains}: {found}; {rate}",
        f"best           cost {solution.replay_cost[best]:.5g} when replayed "
        f"{solution.replay_mode}; plan: {solution.cost[best]:.5g}, max|h| "
        f"{solution.max_defect[best]:.1e}",
        *(f"{mode:14} {_replay(solution, mode)}" for mode in (OPEN_LOOP, WITH_FEEDBACK)),
        f"constraints    {constraints(solution)}",
        *(f"               {said}" for said in unseen if said),
        f"optimality     {solution.optimality}",
        *(f"               {hint}" for hint in hints if hint),
        *optima_lines(solution),
        f"engine         {solution.certificate.engine}",
        f"time           {times}",
        *([] if solution.certified else [LOOK]),
        solution.verdict if solution.certified else f"{solution.verdict}: {_advice(solution)}",
    ]


def counts(names: list[str]) -> str:
    """How many there are of each name."""
    return ", ".join(f"{names.count(name)} {name}" for name in sorted(set(names)))


def in_a_line(solution: Results) -> str:
    """Problem, chains, verdict and cost: what a list of solutions shows of each."""
    cost = solution.replay_cost[solution.best_chain]
    return (
        f"<Solution of {solution.problem.name}: {solution.chains} chains, {solution.verdict}, "
        f"cost {cost:.5g} when replayed>"
    )


def html(lines: Sequence[str], good: bool) -> str:
    """Lines as a notebook shows them: a table, the last line, which is the verdict, above it."""
    rows: list[tuple[str, list[str]]] = []
    for line in lines[:-1]:
        label, text = line[:LABEL].strip(), line[LABEL:]
        if label or not rows:
            rows.append((label, []))
        rows[-1][1].append(text)
    color = _GOOD if good else _BAD
    cells = "".join(
        f'<tr><th style="{_CELL}">{escape(label)}</th>'
        f'<td style="{_CELL}">{escape(chr(10).join(texts))}</td></tr>'
        for label, texts in rows
    )
    return f'<div><b style="color:{color}">{escape(lines[-1])}</b><table>{cells}</table></div>'


def _replay(solution: Results, mode: str) -> str:
    """What one of the best chain's replays came to."""
    cost = solution.replays_in(mode).cost[solution.best_chain]
    return f"{solution.outcome(mode)}, cost {cost:.5g}"


def constraints(solution: Results) -> str:
    """The largest violation of each kind on the best chain's better replay."""
    violations = solution.replays_in(solution.replay_mode).violations.of(solution.best_chain)
    told = [
        f"{words(v.kind)} none"
        if v.size == v.allowed == 0.0  # as where the largest is at a knot that asks nothing
        else f"{words(v.kind)} {v.size:.1e} (tolerated: {v.allowed:.1e})"
        for v in violations
        if v.kind not in (GOAL, TRACKING)
    ]
    return "largest violations: " + ", ".join(told) if told else "the problem has none"


def optima_lines(solution: Results) -> list[str]:
    """The cheapest of the distinct motions as a table; nothing if no chain is certified.

    They are called optima if all of them are. Each row says what differs most from the first.
    """
    found = solution.optima
    label = "optima" if all(optimum.optimal for optimum in found) else "motions"
    if len(found) < 2:
        return [f"{label:14} {_only(solution)}"] if found else []
    columns = f"rank {'cost':>9}  chains  {'replays':9}  residual  differs from the first"
    table = [f"{label:14} {columns}"]
    for rank, optimum in enumerate(found[:OPTIMA], 1):
        replays = optimum.certificate.open_loop, optimum.certificate.feedback
        both = all(replay["success"] for replay in replays)
        which = "both" if both else OPEN_LOOP if replays[0]["success"] else "feedback"
        residual = f"{optimum.residual:.1e}" if math.isfinite(optimum.residual) else "-"
        apart = _apart(solution, found[0], optimum) if rank > 1 else ""
        row = f"{rank:19} {optimum.cost:9.5g}  {optimum.share:6.1%}  {which:9}  {residual:8}"
        table.append(f"{row}  {apart}".rstrip())
    if len(found) > OPTIMA:
        table.append(f"{'':14} and {len(found) - OPTIMA} more")
    return table


def _apart(solution: Results, first: Optimum, other: Optimum) -> str:
    """Which coordinate of a plan differs most from the first's, by the range it has in both.

    A range is at least what a feasible plan may be off: a ball that flies straight has one of
    rounding's size to its side.
    """
    problem, dynamics = solution.problem, solution.problem.dynamics
    with problem.arithmetic():
        least = FEASIBLE * np.asarray(problem.defect_scale)
    here, there = (np.asarray(optimum.trajectory.x) for optimum in (first, other))
    off = dynamics.host_difference(there, here)
    both = dynamics.host_difference(np.concatenate([here, there]), here[:1])
    widths = np.maximum(np.ptp(both, axis=0), least)
    k, i = np.unravel_index(np.argmax(np.abs(off) / widths), off.shape)
    return f"{difference_names(dynamics)[i]} by {off[k, i]:+.3g} at knot {k + 1}"


def _only(solution: Results) -> str:
    """What there is to say where all certified chains make one motion."""
    costs = solution.replay_cost[solution.certified_chains]
    if len(costs) == 1:
        return "one: no other chain is certified"
    same = np.ptp(costs) <= ALIKE * abs(costs.min())
    motion = "the same motion" if same else "similar motions"
    return (
        f"one: {len(costs)} certified chains make {motion}, at costs from {costs.min():.5g} to "
        f"{costs.max():.5g}"
    )


def _fall(solution: Results) -> str:
    converged = solution.residual[solution.best_chain] < solution.tolerance
    return endless(solution.history["cost"][0], solution.cost, converged)


def _between_knots(solution: Results) -> str:
    """What there is to say where a replay breaks an inequality between two knots."""
    broken = broken_between_knots(solution, solution.best_chain)
    if broken is None:
        return ""
    knot = broken.knot
    return (
        f"between knots {knot} and {knot + 1}, after {solution.times[knot]:.3g} s, inequality "
        f"[{broken.entry}] is broken by {broken.size:.1e} (tolerated: {broken.allowed:.1e}): plans "
        "keep constraints at knots alone. Give a smaller dt, or keep more distance"
    )


def _unplanned_contact(solution: Results) -> str:
    """What there is to say where a replay has a contact that costs and constraints do not see."""
    found = solution.problem.dynamics.left_out(solution.replayed[0])
    if found is None:
        return ""
    knot, contact = found
    return (
        f"when replayed {contact} at knot {knot}, {solution.times[knot]:.2f} s: the plan has no "
        "contacts of these two, and costs and constraints that read forces or accelerations do not "
        "see them. Add the pair to contacts= if any does"
    )


def _off_the_engine(solution: Results) -> str:
    """What there is to say where a step of MuJoCo leaves a certified plan: feasible by JAX's f."""
    where = _leaves(solution, solution.problem)
    if where is None:
        return ""
    return f"of f as JAX has it: {_told_of_step(solution, where)}.{_stops(solution)}"


def _told_of_step(solution: Results, where: Violation) -> str:
    kind, size, allowed, entry, knot = where
    return (
        f"at knot {knot}, {solution.times[knot]:.3g} s, a step of MuJoCo ends {size:.1e} off in "
        f"{entry_name(solution.problem, kind, entry)} ({allowed:.1e} tolerated)"
    )


def _leaves(solution: Results, problem: Problem) -> Violation | None:
    """Where a step of MuJoCo leaves the best plan most; None where it does not, or for functions.

    The problem may have another model than that of the solution.
    """
    if mjx_dynamics(problem.dynamics) is None:
        return None
    found = of_engine(replace(solution, problem=problem), solution.best_chain)
    return max((v for v in found if v.broken), key=lambda v: v.ratio, default=None)


def _met_stop(solution: Results) -> bool:
    """Whether a step of MuJoCo would not leave the best plan if joints had no stops."""
    whole, inner = solution.problem.dynamics, mjx_dynamics(solution.problem.dynamics)
    assert inner is not None  # for the type checker
    model = copy(inner.mj_model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    inner = replace(inner, mj_model=model)
    endless = replace(whole, inner=inner) if isinstance(whole, Extended) else inner
    return _leaves(solution, replace(solution.problem, dynamics=endless)) is None


def _stops(solution: Results) -> str:
    """What to try where joints have stops that the plan knows nothing of."""
    model = mjx_dynamics(solution.problem.dynamics)
    if model is None or len(model.stops) >= model.mj_model.jnt_limited.sum():
        return ""
    return " With stops=True, joints may lean on their stops."


def endless(initial: np.ndarray, cost: np.ndarray, converged: bool) -> str:
    """What there is to say where the cost seems to have no lower bound; else nothing.

    Args:
        initial, cost: of initial knots and of chains in the end, (chains,).
        converged: whether the best chain has.
    """
    first = np.abs(initial)
    least = np.where(np.isnan(cost), np.inf, cost).min()
    largest = first[np.isfinite(first)].max(initial=0.0)
    if converged or largest == 0.0 or not least < -BOTTOMLESS * largest:
        return ""
    return (
        f"the cost fell from about {largest:.2g} to {least:.2g}, as if it had no lower bound: "
        "bound what it rewards, or add a term that grows with it"
    )


def _most_bounded(solution: Results) -> tuple[str, float]:
    """Which entry of the best plan is at an end of its range most often, and at a share of knots.

    Nothing is said of less than a tenth.
    """
    dynamics, box = solution.problem.dynamics, solution.problem.bounds
    knots, chain, found = solution.trajectories, solution.best_chain, []
    for names, z, lower, upper in (
        (control_names(dynamics), knots.u[chain], box.u_lower, box.u_upper),
        (state_names(dynamics), knots.x[chain], box.x_lower, box.x_upper),
    ):
        low, high = (np.broadcast_to(side, z.shape) for side in (lower, upper))
        boxed = np.isfinite(low) & np.isfinite(high) & (low < high)
        margin = ON_BOUND * np.where(boxed, high - low, 0.0)
        on = boxed & ((z <= low + margin) | (z >= high - margin))
        found += list(zip(on.sum(axis=0).tolist(), names, strict=True))
    times, name = max(found, key=lambda entry: entry[0])
    K = solution.problem.horizon
    said = f", and {name} is on a bound at {times} of {K} knots" if times >= 0.1 * K else ""
    return said, times / K


def _broken_besides(solution: Results, where: Violation) -> str:
    """Which other constraints the best plan breaks by a tenth as much or more, at most two."""
    problem, chain = solution.problem, solution.best_chain
    if problem.constraint.rows + problem.terminal_constraint.rows < 2:
        return ""
    try:
        with problem.arithmetic():
            knots = jax.tree.map(lambda a: a[chain], solution.trajectories)
            values = _constraints(with_units(problem, None), knots)
    except DraxError:  # its functions are not there
        return ""
    found = []
    for stem, part, rows in (
        ("", problem.constraint, np.asarray(values.stage)),
        ("terminal_", problem.terminal_constraint, np.asarray(values.terminal)[None]),
    ):
        for row, column in enumerate(rows.T):
            equal = row < part.equalities
            sizes = np.abs(column) if equal else np.maximum(column, 0.0)
            kind = f"{stem}{'equality' if equal else 'inequality'}"
            entry, knot = row - (not equal) * part.equalities, int(sizes.argmax())
            at = problem.horizon if stem else knot
            broken = Violation(kind, float(sizes[knot]), math.nan, entry, at)
            broken = with_plan_tolerance(problem, broken)
            if (kind, entry) != (where.kind, where.entry) and broken.ratio >= 0.1 * where.ratio:
                found.append(broken)
    most = sorted(found, key=lambda v: -v.ratio)[:2]
    return "".join(f"; it also {v.told(problem)}" for v in most)


@partial(compiled, key=lambda problem, knots: identity((problem, knots), problem))
def _constraints(problem: Problem, knots: Trajectory) -> Stagewise:
    return problem.constraints(knots)


def _advice(solution: Results) -> str:
    """What to try when no chain could be certified; the shell has the same names."""
    if solution.interrupted:
        return "the solve was interrupted. Let it go on to its end."
    if fall := _fall(solution):
        return f"{fall}."
    where = solution.where(solution.best_chain)
    if where is not None and (solution.died_at >= 0).all():
        first = solution.died_at.min()
        return (
            f"every chain would have become infinite or not a number, from iteration {first} on. "
            "Give bounds, or an x_scatter and a u_scatter, where f and the cost have values and "
            "slopes (1 / x has none at 0)."
        )
    if where is not None:
        told = f"no plan is feasible; the best {where.told(solution.problem)}"
        of_stage = where.kind in ("equality", "inequality")
        if of_stage and where.knot == 0 and not solution.problem.free:
            return (
                f"{told}, where the state is x_init. Move x_init, let the constraint hold later "
                "only (`between`), or widen the controls' bounds."
            )
        bounded, share = _most_bounded(solution)
        unfinished = solution.polished[solution.best_chain] == UNFINISHED
        more = ["more iterations"] + ["more max_iterations"] * unfinished
        free = solution.problem.dynamics.phases
        more.append("longer durations" if free else "a longer horizon")
        if share >= 0.5:  # it does all it may, and time or room is what is missing
            more = ["wider bounds", *more[::-1]]
        told += bounded + _broken_besides(solution, where)
        worst = solution.max_defect
        alike = int(np.isclose(worst, worst[solution.best_chain], rtol=ALIKE_BROKEN).sum())
        if "equality" in where.kind and len(worst) > 2 and alike > len(worst) / 2:
            ways = [*(way for way in more if "iterations" not in way), "a guess"]
            return (
                f"{told}. So do {alike} of {len(worst)} chains, as if what is asked had no "
                f"solution: loosen it, or give {' or '.join(ways)}."
            )
        return f"{told}. Try {', '.join(more[:-1])}, or {more[-1]}."
    unplanned = solution.problem.dynamics.left_out(solution.plans[solution.best_chain])
    if unplanned is not None:
        knot, contact = unplanned
        return (
            f"at knot {knot}, {solution.times[knot]:.2f} s, {contact}, and the plan is made "
            "without contacts of these two. Add the pair to contacts=, or keep them apart by an "
            "inequality."
        )
    leaves = _leaves(solution, solution.problem)
    if leaves is not None and _met_stop(solution):
        return (
            f"{_told_of_step(solution, leaves)}: between knots a joint meets its stop. Keep it "
            f"away by narrower x_bounds, or give a smaller dt.{_stops(solution)}"
        )
    violations = solution.replays_in(solution.replay_mode).violations.of(solution.best_chain)
    broken = {v.kind for v in violations if v.broken}
    costs = solution.cost[solution.feasible]
    alike = int(np.isclose(costs, np.median(costs), rtol=ALIKE).sum())
    model = mjx_dynamics(solution.problem.dynamics)
    stops = _stops(solution) if model is not None and model.kinked else ""
    if broken <= {GOAL} and len(costs) > 2 and alike > len(costs) / 2:
        return (
            f"feasible chains miss the goal, {alike} of {len(costs)} at the same cost, so more "
            "chains will hardly help. Give a longer horizon, a guess of another motion, or more "
            f"weight on the terminal cost.{stops}"
        )
    if TRACKING in broken and solution.problem.goal is None:
        return (
            "replays leave the plan, as where a motion is unstable or its knots are far apart: "
            "give a smaller dt, or a goal, if it is enough to end there; tolerances.tracking says "
            f"how far off counts.{stops}"
        )
    return (
        "feasible chains miss the goal or break constraints when replayed. Try a guess of the "
        "motion, more chains, a higher weight on the terminal cost, or a longer horizon; "
        f"tolerances say what counts as broken.{stops}"
    )
