"""Model predictive control: the same problem again and again, from where the system now is.

A plan made at time t_0 holds x_0..x_K, u_0..u_{K-1} and the feedback gains K_k of its last
factorization. Until the next plan arrives, the control at time t = t_0 + (k + w) dt, 0 <= w < 1, is

    u = u_k + K_k (x - x_plan(t)),   clipped to the control bounds,

where x_plan(t) lies between x_k and x_{k+1}. The next plan starts from this one, s = (t - t_0) / dt
knots later: knots, slacks and all multipliers move s places forward (between two places they are
interpolated), and behind the last knot f goes on with the last control. A few iterations then bring
it back to the dynamics from the state that was measured: of the polish where the problem has
constraints or a free duration, as after `solve(guess=solution)`; else of the flow's tail. All of
this, and the choice of the best chain, is one compiled function; x, s and the number of iterations
are traced, and only the best chain's plan comes to the host.

Keepers are chains that go on like that. Explorers start from the best plan again and again, are
heated, and cooled over several plans as in a solve, while the horizon recedes under them; one that
becomes feasible and clearly cheaper takes the place of the worst keeper, and is applied.

What a problem leaves open:

    rates         are counted from the controls that the policy gave last, and kept within their
                  bounds, from those before each knot, by feedback too
    parameters    every plan chooses its own (`MPC.parameters`)
    duration      ends within its upper bound from when the policy began, so that less is left of it
                  from plan to plan, but no plan is shorter than its lower bound: in the end the
                  policy holds what the problem asks of the end. Controls are given by time along
                  the plan, and `every` counts its steps

Where actuators' forces have ends, and f no kinks, plans have forces without ends that are kept in
range (`search.unlimited`), and each control is moved to where its force is just inside.

A goal at the end of a horizon that recedes may never be reached: tomorrow is as good. So the
terminal cost also runs along the horizon, with the weight `hold`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from jax.typing import ArrayLike

from mjx_drax.base.errors import (
    DraxError,
    DraxWarning,
    is_number,
    require_not_negative,
    require_whole,
    shown,
)
from mjx_drax.base.numbers import numbers, vector
from mjx_drax.base.pytrees import packed, unpacked
from mjx_drax.control.open_quantities import (
    Applied,
    is_constrained,
    rate_ends,
    require_plannable,
)
from mjx_drax.control.planner import (
    CYCLE,
    HEATED,
    Carried,
    Now,
    Plan,
    first_carried,
    plan_like,
    planner_of,
)
from mjx_drax.kernels.compilation import keep_programs, rarely_collected
from mjx_drax.method.langevin import Langevin
from mjx_drax.polish import interior_point
from mjx_drax.polish.interior_point import Polish
from mjx_drax.problem.cost import Cost, as_partial, at_knot
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem, checked
from mjx_drax.problem.trajectory import Knot, Trajectory
from mjx_drax.search.engine import Found, Search
from mjx_drax.search.family import Family
from mjx_drax.search.identity import look_again
from mjx_drax.search.iterate import FEASIBLE
from mjx_drax.search.restarts import Restarts, settled
from mjx_drax.search.unlimited import both_of, found_in_steps, without_rollouts
from mjx_drax.search.warm import Warm

ENDLESS = 10**6
"""Iterations of the polish, of which none is the last one."""

BEYOND = 0.1
"""How far outside of its bounds a measured state may be, as a share of their width, or of that of
the box of initial knots if it is less."""

RECENT = 100_000
"""So many plans are remembered one by one: a robot may run for days."""


@dataclass
class Statistics:
    """What a policy did since it was reset.

    Attributes:
        latencies: time that each plan took [s], of the `RECENT` last ones.
        costs, max_defects: of these plans.
        plans: how many were made.
        infeasible: plans that broke the dynamics or a constraint, by max|h|.
        failed: plans that were not finite; the last good one stayed in use.
        switches: plans that changed to another chain.
        unmeasured: states given that were not finite; the planned control was applied.
    """

    latencies: deque[float] = field(default_factory=partial(deque, maxlen=RECENT))
    costs: deque[float] = field(default_factory=partial(deque, maxlen=RECENT))
    max_defects: deque[float] = field(default_factory=partial(deque, maxlen=RECENT))
    plans: int = 0
    infeasible: int = 0
    failed: int = 0
    switches: int = 0
    unmeasured: int = 0

    def __repr__(self) -> str:
        took = [1e3 * seconds for seconds in self.latencies] or [math.nan]
        half, most = np.quantile(took, [0.5, 0.99])
        times = f"median {half:.2g} ms, 99 % within {most:.2g} ms"
        return f"<Statistics of {self.plans} plans, {self.infeasible} infeasible: {times}>"


class MPC:
    """A policy u = policy(x, t) that plans as it goes.

    >>> policy = mjx_drax.MPC(problem)
    >>> policy.reset(x, t)        # a whole solve; the first call would do it
    >>> u = policy(x, t)          # (nu,), for as long as the robot runs

    Calling it plans whenever `every` control steps have passed, and applies feedback in between.
    `plan` and `control` are the two halves; `Background` runs the first in a thread.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        chains: int = 8,
        explorers: int | None = None,
        iterations: int = 2,
        every: int = 1,
        hold: float = 0.1,
        seed: int = 0,
        solver: Langevin | Restarts | None = None,
    ) -> None:
        """What plans is compiled by `reset`.

        Args:
            problem: from `from_mjcf` or `from_function`; its x_init is replaced by what is given.
                Its x_0 may not be free, numbers of its model no parameters, and it has one phase.
            chains: number of chains, explorers included.
            explorers: how many of them explore; by default half.
            iterations: of every chain for a plan.
            every: control steps between two plans.
            hold: weight [1/s] of the terminal cost along the horizon: hold dt phi(x_k) is added to
                the running cost. 0 leaves the problem as it is.
            seed: of all random numbers.
            solver: of the first solve, whose tail makes the plans; `Restarts()` by default.

        Raises:
            DraxError: a setting that cannot work, named with its value and the fix.
        """
        problem = checked(problem)
        keep_programs()
        require_whole("chains", chains)
        explorers = chains // 2 if explorers is None else explorers
        for name, count, least in (
            ("iterations", iterations, 1),
            ("every", every, 1),
            ("explorers", explorers, 0),
        ):
            require_whole(name, count, least)
        if explorers >= chains:
            raise DraxError(
                f"explorers is {explorers} of {chains} chains: leave at least one that does not."
            )
        require_not_negative("hold", hold)
        if any(end.ndim > 1 for end in jax.tree.leaves(problem.bounds)):
            raise DraxError(
                f"bounds of {problem.name} differ from knot to knot, but the horizon recedes: "
                "give the same ones for all, of shapes (nx,) and (nu,)."
            )
        require_plannable(problem)
        with problem.arithmetic():
            self.original, self.problem = problem, holding(problem, hold)
            look_again(self.problem)
            self.solver = true = settled(self.problem, chains, seed, solver)
            polish = self.solver.polish
            both = both_of(self.problem) if polish is not None and polish.iterations else None
            # where f has kinks, a polish that keeps forces in range takes too long for plans
            self._in_steps = both is not None and problem.dynamics.kinked
            both = None if self._in_steps else both
            if both is not None:
                self.problem, self.solver = both.first, without_rollouts(self.solver)
        self._held = None if both is None else both.held
        self._true = None if both is None else (both.then, true)
        metric = self.solver.flow.preconditioner
        if not metric.has_gains:
            raise DraxError(
                f"preconditioner is {type(metric).__name__}, which brings no feedback gains: give "
                "GaussNewton(), or a metric with has_gains = True."
            )
        self._polish: Polish | None = None
        if polish is not None and polish.iterations and is_constrained(self.problem):
            self._polish = replace(polish, iterations=ENDLESS)
        elif iterations > self.solver.flow.tail:
            raise DraxError(
                f"iterations is {iterations}, but the solver's tail has {self.solver.flow.tail}: "
                "give fewer, or a longer tail."
            )
        self.chains, self.explorers = chains, int(explorers)
        self.iterations, self.every, self.seed = iterations, every, seed
        self.statistics = Statistics()
        self.first_solve = 0.0
        self._plan: Plan | None = None
        self._time = self._began = 0.0
        self._applied: Applied | None = None
        self._further = np.asarray(self.problem.x_init)[problem.dynamics.given_nx :]
        self._start: tuple[Carried, Plan] | None = None
        self._carried: Carried | None = None
        self._lower, self._upper = (
            np.asarray(end, float) for end in (problem.bounds.u_lower, problem.bounds.u_upper)
        )
        self._rate_ends = rate_ends(problem)

    @property
    def latest(self) -> Plan:
        """The plan in use.

        Raises:
            DraxError: there is none yet.
        """
        if self._plan is None:
            raise DraxError("there is no plan yet: call policy.reset(x), or policy(x, t).")
        return self._plan

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """The parameters of the plan in use, by name."""
        dynamics = self.problem.dynamics
        if not isinstance(dynamics, Extended):
            return {}
        return dynamics.parameters(dynamics.extras(np.asarray(self.latest.x[0])).p)

    def reset(self, x: ArrayLike, t: float = 0.0) -> Plan:
        """Solve from x (nx,) as `solve` does, and make that the plan at time t [s].

        Everything that later plans need is compiled here too. A state that was measured a
        little beyond a bound (`BEYOND`) is solved from that bound.

        Raises:
            DraxError: x does not fit the problem, or is not finite; nor is t.
        """
        _require_time(t)
        with self.problem.arithmetic():
            return self._reset(x, t)

    def _reset(self, x: ArrayLike, t: float) -> Plan:
        look_again(self.problem)
        self._begin(t)
        clock = time.perf_counter()
        solved, found, self._floor = self._solved(self._inside(x), t)
        if not found.chains.feasible.any():
            least = np.nanmin(found.chains.info.max_defect, initial=np.inf)
            warnings.warn(
                f"no plan of the first solve is feasible: the best has max|h| = {least:.1e}. Look "
                "at what solve(problem) says, or give more chains or a longer horizon.",
                DraxWarning,
                stacklevel=3,
            )
        self._flow = found.flow
        self._heated = replace(
            self._flow, iterations=HEATED, tail=CYCLE - HEATED, noise=self.solver.flow.noise
        )
        settings = self._flow, self._heated, self._polish, solved
        leaves, structure = jax.tree.flatten(settings)
        self._settings = jax.device_put(leaves)
        carried = first_carried(found.chains, self.explorers, self.seed, self._polish)
        self._plan = None
        self.planner = planner_of(structure, self.explorers)
        self._like = plan_like(carried.state)
        with rarely_collected():
            self._apply(carried, self._state(x), t, 0.0)  # compiles
        self.first_solve = time.perf_counter() - clock
        self._start = self._taken(), self.latest
        return self.rewind(t)

    def _solved(self, x: Array, t: float) -> tuple[Problem, Found, float]:
        """The first solve: the problem in units of its constraints, what was found, and the floor.

        Where forces have no ends in plans, and nothing is found that keeps them in range, what is
        found with the true forces is the guess of another one.
        """
        floor = 0.0

        def searched(
            problem: Problem, solver: Restarts, guess: Trajectory | Warm | None = None
        ) -> tuple[Search, Found]:
            nonlocal floor
            search = Search(Family.of_one(problem), self.chains, self.seed, solver, guess=guess)
            found = search.run()
            if found.interrupted:
                raise KeyboardInterrupt
            floor = float(search.stage.floor[0])
            return search, found

        problem = self.problem.with_x_init(x).at_time(t)
        if self._in_steps:
            both = both_of(problem)
            assert both is not None  # for the type checker
            solved, found = found_in_steps(problem, both, self.solver, searched)
            # the polish of the steps had constraints of its own
            state = jax.vmap(partial(interior_point.begin, solved))(found.chains.state)
            return solved, replace(found, chains=replace(found.chains, state=state)), floor
        search, found = searched(problem, self.solver)
        if self._true is not None and not found.chains.sound.any():
            true, solver = self._true
            chains = searched(true.with_x_init(x).at_time(t), solver)[1].chains
            best = chains.order()[0, 0]
            knots = jax.tree.map(lambda a: a[best], chains.state.trajectory)
            search, found = searched(problem, self.solver, replace(knots, slack=None))
        return search.family.problem, found, floor

    def rewind(self, t: float = 0.0) -> Plan:
        """Go back to the plan that the last `reset` made, at time t [s], without solving again."""
        if self._start is None:
            raise DraxError("there is nothing to go back to: call policy.reset(x) first.")
        _require_time(t)
        carried, plan = self._start
        with self.problem.arithmetic():
            self._carried = jax.tree.map(jnp.copy, carried)  # plans overwrite it
        self._begin(t)
        self._plan, self._time = replace(plan, time=t), t
        self.statistics = Statistics()
        return self._plan

    def plan(self, x: ArrayLike, t: float) -> Plan:
        """A plan from the state x (nx,) at time t [s], starting from the one in use.

        What is not finite is not used: the plan stays, and `statistics.failed` counts it.

        Raises:
            DraxError: there is no plan yet, x is no vector (nx,), or t is not finite, or a step
                before the time of the plan in use.
        """
        x = self._state(x)
        self._require_not_before(t)
        by = max(0.0, (t - self._time) / float(self.problem.dynamics.dt))
        clock = time.perf_counter()
        with self.problem.arithmetic():
            plan = self._apply(self._taken(), x, t, by)
        statistics = self.statistics
        statistics.latencies.append(time.perf_counter() - clock)
        statistics.plans += 1
        statistics.failed += not plan.finite
        if plan.finite:
            statistics.infeasible += float(plan.max_defect) >= FEASIBLE
            statistics.switches += bool(plan.switched)
            statistics.costs.append(float(plan.cost))
            statistics.max_defects.append(float(plan.max_defect))
        return self.latest

    def control(self, x: ArrayLike, t: float) -> np.ndarray:
        """The control (nu,) at time t [s] for the state x (nx,), by the plan's feedback.

        Raises:
            DraxError: there is no plan yet, x is no vector (nx,), or t is not finite.
        """
        x = self._state(x)
        _require_time(t)
        plan, K, dynamics = self.latest, self.problem.horizon, self.problem.dynamics
        step = float(plan.dt)
        s = np.clip((t - plan.time) / step, 0.0, K)
        k = int(min(s + 1e-6, K - 1))
        u, applied = np.asarray(plan.u[k], float), self._applied
        v = np.zeros(0)
        if applied is not None and applied.any:  # rates are counted from what was applied
            v = applied.before(plan.time + k * step, step)
        if np.isfinite(x).all():
            further = np.asarray(plan.x[k, len(x) :], float)
            planned = self._between(plan.x[k], plan.x[k + 1], s - k)[: len(x)]
            own = np.append(further[: len(further) - len(v)], v)
            off = dynamics.host_difference(np.append(x, own), np.append(planned, further))
            u = u + plan.gains[k] @ off
        else:
            self.statistics.unmeasured += 1
        if len(v):
            u = np.clip(u, *(v[: len(u)] + step * end for end in self._rate_ends))
        if self._held is not None and np.isfinite(x).all():
            u = self._held(x, u)
        u = np.clip(u, self._lower, self._upper)
        if applied is not None:
            applied.add(u, t, min(t, plan.time) - 2 * step)
        return u

    def __call__(self, x: ArrayLike, t: float) -> np.ndarray:
        """The control (nu,) at time t [s] for the state x (nx,), after a new plan if one is due."""
        if self._plan is None:
            self.reset(x, t)
        elif self.due(t) and np.isfinite(self._state(x)).all():
            self.plan(x, t)
        return self.control(x, t)

    def due(self, t: float) -> bool:
        """Whether `every` steps of the plan in use have passed since it was made."""
        self._require_not_before(t)
        steps = (t - self.latest.time) / self._step
        return steps > self.every - 1e-6

    def _require_not_before(self, t: float) -> None:
        """Complain where a time is a step before the plan in use: no plan would ever be due."""
        _require_time(t)
        if t < self.latest.time - self._step:
            raise DraxError(
                f"the time t is {t:g} s, and the plan in use is of {self.latest.time:g} s: to "
                "begin anew call policy.reset(x, t), or policy.rewind(t)."
            )

    def _taken(self) -> Carried:
        """The chains, which a plan overwrites: they are gone if it does not come to its end."""
        carried, self._carried = self._carried, None
        if carried is None:
            raise DraxError(
                "the chains are lost, as the last plan was interrupted: call policy.reset(x), or "
                "policy.rewind()."
            )
        return carried

    def _apply(self, carried: Carried, x: ArrayLike, t: float, by: float) -> Plan:
        """Plan in one launch, and use it if it is finite."""
        self._time = t  # of what is carried; the plan in use is older after one that failed
        now, data = self._now(x, t, by)
        packet = packed(now, now.x.dtype, np)
        self._carried, device = self.planner(self._settings, carried, packet, data)
        plan: Plan = replace(unpacked(np.asarray(device), self._like), time=t)
        if plan.finite or self._plan is None:
            self._plan = plan
        return plan

    def _now(self, x: ArrayLike, t: float, by: float) -> tuple[Now, Any]:
        """What the next plan starts from, in the problem's precision; data of its knots."""
        dynamics, number = self.problem.dynamics, np.asarray(self.problem.x_init).dtype.type
        moved = self.problem if self.problem.data is None else self.problem.at_time(t)
        cost = 1.0
        if self._plan is not None:  # a floor that is too high makes nothing larger
            last = float(self._plan.cost)
            cost = min(abs(last), abs(last - self._floor))
        whole, before = np.append(np.asarray(x, number), self._further), None
        if self._applied is not None:
            v = self._applied.before(t, self._step).astype(number)
            before = v[: dynamics.nu], np.bool_(self._applied.any)
            whole[len(whole) - len(v) :] = v
        now = Now(
            x=whole,
            t=number(t),
            by=number(by),
            iterations=np.int32(self.iterations),
            noise=number(np.sqrt(max(cost, 1e-12))),
            floor=number(self._floor),
            passed=number(t - self._began),
            before=before,
        )
        return now, moved.data

    def _begin(self, t: float) -> None:
        """Forget what was applied; a free duration begins at time t [s]."""
        dynamics, self._began = self.problem.dynamics, t
        if isinstance(dynamics, Extended) and dynamics.order:
            self._applied = Applied(dynamics)

    @property
    def _step(self) -> float:
        """Time between the knots of the plan in use [s]."""
        return float(self.problem.dynamics.dt if self._plan is None else self._plan.dt)

    def _state(self, x: ArrayLike) -> np.ndarray:
        """A state as it was measured, (nx,) numbers that need not be finite."""
        dynamics = self.problem.dynamics
        nx = dynamics.given_nx
        try:
            state = numbers(x)
        except (TypeError, ValueError) as error:
            raise DraxError(f"the state x is {shown(x)}: give {nx} numbers.") from error
        if state.shape == (dynamics.nx,):  # as x_init is: further states are the plan's own
            state = state[:nx]
        if state.shape != (nx,):
            raise DraxError(f"the state x has shape {state.shape}: give {nx} numbers, ({nx},).")
        return state

    def _inside(self, x: ArrayLike) -> Array:
        """x moved into its bounds, unless it is no state (nx,) near them: that is to be refused."""
        state, bounds, nx = vector("x_init", x), self.problem.bounds, self.problem.dynamics.given_nx
        if len(state) != nx:
            return state
        lower, upper, box = bounds.x_lower[:nx], bounds.x_upper[:nx], self.problem.scatter
        scattered = jnp.atleast_2d(box.x_upper - box.x_lower).max(axis=0)[:nx]
        width = jnp.minimum(upper - lower, scattered)  # a bound may have one side alone
        near = jnp.maximum(lower - state, state - upper) <= BEYOND * width
        return jnp.where(near, jnp.clip(state, lower, upper), state)

    def _between(self, x: np.ndarray, y: np.ndarray, share: float) -> np.ndarray:
        """The state (nx,) a share of the way from x to y, on the host."""
        dynamics, x, y = self.problem.dynamics, np.asarray(x, float), np.asarray(y, float)
        return dynamics.host_integrate(x, share * dynamics.host_difference(y, x))


def _require_time(t: float) -> None:
    if not is_number(t):
        raise DraxError(f"the time t is {shown(t)}: give a finite number of seconds.")


def holding(problem: Problem, hold: float) -> Problem:
    """The problem with hold dt phi(x) added to its running cost; hold [1/s] is traced."""
    if hold == 0.0:
        return problem
    weight = problem.x_init.dtype.type(hold * problem.dynamics.dt)
    running, terminal = problem.running, problem.terminal
    scalar, residual = running.scalar, running.residual
    if terminal.scalar is not None:
        scalar = as_partial(Partial(_held, scalar, terminal.scalar, weight))
    if terminal.residual is not None:
        root = np.sqrt(weight)
        residual = as_partial(Partial(_held_residual, residual, terminal.residual, root))
    return replace(problem, running=Cost(scalar, residual))


def _held(
    running: Partial | None, terminal: Partial, weight: Array, seen: Any, u: Array, knot: Knot
) -> Array:
    """l + weight phi, scalar."""
    held = weight * at_knot(terminal, knot)(seen)
    return held if running is None else at_knot(running, knot)(seen, u) + held


def _held_residual(
    running: Partial | None, terminal: Partial, root: Array, seen: Any, u: Array, knot: Knot
) -> Array:
    """[r, root r_end], (n,)."""
    held = root * jnp.ravel(at_knot(terminal, knot)(seen))
    if running is None:
        return held
    return jnp.concatenate([jnp.ravel(at_knot(running, knot)(seen, u)), held])
