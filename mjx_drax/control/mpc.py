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

    rates         are counted from the controls that the policy gave last; feedback between plans
                  keeps the bounds of controls, not those of rates
    parameters    every plan chooses its own (`MPC.parameters`)
    duration      ends no later than at the first plan, so that less is left of it from plan to
                  plan, but no plan is shorter than its lower bound: in the end the policy holds
                  what the problem asks of the end. Controls are given by time along the plan, and
                  `every` counts its steps

A goal at the end of a horizon that recedes may never be reached: tomorrow is as good. So the
terminal cost also runs along the horizon, with the weight `hold`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from jax.typing import ArrayLike

from mjx_drax.base.errors import (
    DraxError,
    is_number,
    require_not_negative,
    require_whole,
    shown,
)
from mjx_drax.base.numbers import numbers, vector
from mjx_drax.base.pytrees import packed, register_dataclass, unpacked
from mjx_drax.control.open_quantities import (
    Applied,
    at_present,
    is_constrained,
    require_plannable,
    step_of,
)
from mjx_drax.control.shift import shifted
from mjx_drax.kernels.compilation import compiled, keep_programs, rarely_collected
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.method.descent import Info
from mjx_drax.method.langevin import Langevin, State
from mjx_drax.polish.interior_point import Polish, Progress, begin_inside
from mjx_drax.problem.cost import Cost, as_partial, at_knot
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem, checked
from mjx_drax.problem.trajectory import Knot
from mjx_drax.search.chains import Chains
from mjx_drax.search.engine import Search
from mjx_drax.search.family import Family
from mjx_drax.search.identity import identity, look_again
from mjx_drax.search.iterate import (
    FEASIBLE,
    Question,
    chain_keys,
    evaluate,
    loop,
    partition,
)
from mjx_drax.search.restarts import Restarts, settled
from mjx_drax.search.warm import resumed

CHEAPER = 0.9
"""Another chain is applied if its cost is below that of the one applied by this factor."""

ENDLESS = 10**6
"""Iterations of the polish, of which none is the last one."""

BEYOND = 0.1
"""How far outside of its bounds a measured state may be, as a share of their width, or of that of
the box of initial knots if it is less."""

HEATED, CYCLE = 30, 50
"""Iterations of an explorer with noise, and of all, before it starts again."""


@register_dataclass
@dataclass(frozen=True)
class Plan:
    """The best chain's plan.

    Attributes:
        x: states x_0..x_K, (K + 1, nx), with the further ones that the problem has.
        u: controls, (K, nu).
        gains: feedback K_k, (K, nu, ndx).
        cost, max_defect: of the plan, scalars.
        finite: whether it may be used.
        switched: whether another chain than the last plan's was the best.
        dt: time between its knots [s].
        time: of x_0 [s]; set on the host.
    """

    x: Any
    u: Any
    gains: Any
    cost: Any
    max_defect: Any
    finite: Any
    switched: Any
    dt: Any
    time: float = 0.0


@register_dataclass
@dataclass(frozen=True)
class Carried:
    """What stays on the device between plans.

    Attributes:
        state: of all chains; the explorers are the last ones.
        best: which chain is applied, always a keeper.
        lost: whether its plan broke the dynamics.
        spare: the worst keeper, which may be given other knots.
        age: iterations since an explorer last started, (chains,); 0 for keepers.
        key: for the explorers' noise.
    """

    state: State
    best: Array
    lost: Array
    spare: Array
    age: Array
    key: Array


class Now(NamedTuple):
    """What is new when a plan is made.

    Attributes:
        x: the state that was measured, (nx,) with the further ones.
        t: its time [s].
        by: knots by which the last plan is moved forward.
        iterations: of every chain.
        noise: unit of the explorers' noise, the root of the last plan's cost.
        passed: time since the policy began [s].
        before: the control that was applied last (nu,), and whether there is one; None without
            rates.
    """

    x: Any
    t: Any
    by: Any
    iterations: Any
    noise: Any
    passed: Any
    before: Any


@dataclass
class Statistics:
    """What a policy did since it was reset.

    Attributes:
        latencies: time that each plan took [s].
        costs, max_defects: of the plans.
        failed: plans that were not finite; the last good one stayed in use.
        switches: plans that changed to another chain.
        unmeasured: states given that were not finite; the planned control was applied.
    """

    latencies: list[float] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    max_defects: list[float] = field(default_factory=list)
    failed: int = 0
    switches: int = 0
    unmeasured: int = 0

    @property
    def plans(self) -> int:
        """How many plans were made."""
        return len(self.latencies)


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
        """Nothing is compiled yet.

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
            self.solver = settled(self.problem, chains, seed, solver)
        metric = self.solver.flow.preconditioner
        if not metric.has_gains:
            raise DraxError(
                f"preconditioner is {type(metric).__name__}, which brings no feedback gains: give "
                "GaussNewton(), or a metric with has_gains = True."
            )
        polish = self.solver.polish
        self._polish: Polish | None = None
        if polish is not None and polish.iterations and is_constrained(problem):
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
        self._lower, self._upper = (
            np.asarray(end, float) for end in (problem.bounds.u_lower, problem.bounds.u_upper)
        )

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
        problem = self.problem.with_x_init(self._inside(x)).at_time(t)
        self._begin(t)
        clock = time.perf_counter()
        search = Search(Family.of_one(problem), self.chains, self.seed, self.solver)
        found = search.run()
        if search.stage.place < len(search.stage.todo):
            raise KeyboardInterrupt
        self._flow = found.flow
        self._heated = replace(
            self._flow, iterations=HEATED, tail=CYCLE - HEATED, noise=self.solver.flow.noise
        )
        settings = self._flow, self._heated, self._polish, search.family.problem
        leaves, structure = jax.tree.flatten(settings)
        self._settings = jax.device_put(leaves)
        carried = _first(found.chains, self.explorers, self.seed, self._polish)
        self._plan = None
        self.planner = _planner(structure, self.explorers)
        self._like = _plan_like(carried.state)
        with rarely_collected():
            self._apply(carried, self._state(x), t, 0.0)  # compiles
        self.first_solve = time.perf_counter() - clock
        self._start = self._carried, self.latest
        self.statistics = Statistics()
        return self.latest

    def rewind(self, t: float = 0.0) -> Plan:
        """Go back to the plan that the last `reset` made, at time t [s], without solving again."""
        if self._start is None:
            raise DraxError("there is nothing to go back to: call policy.reset(x) first.")
        _require_time(t)
        self._carried, plan = self._start
        self._begin(t)
        self._plan, self._time = replace(plan, time=t), t
        self.statistics = Statistics()
        return self._plan

    def plan(self, x: ArrayLike, t: float) -> Plan:
        """A plan from the state x (nx,) at time t [s], starting from the one in use.

        What is not finite is not used: the plan stays, and `statistics.failed` counts it.

        Raises:
            DraxError: there is no plan yet, x is no vector (nx,), or t is not finite.
        """
        self.latest  # noqa: B018 complains if there is none
        x = self._state(x)
        _require_time(t)
        by = max(0.0, (t - self._time) / float(self.problem.dynamics.dt))
        clock = time.perf_counter()
        with self.problem.arithmetic():
            plan = self._apply(self._carried, x, t, by)
        statistics = self.statistics
        statistics.latencies.append(time.perf_counter() - clock)
        statistics.failed += not plan.finite
        if plan.finite:
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
        u = np.asarray(plan.u[k], float)
        if np.isfinite(x).all():
            further = np.asarray(plan.x[k, len(x) :], float)
            planned = self._between(plan.x[k], plan.x[k + 1], s - k)[: len(x)]
            own, applied = further, self._applied
            if applied is not None and applied.any:  # rates are counted from what was applied
                v = applied.before(plan.time + k * step, step)
                own = np.append(further[: len(further) - len(v)], v)
            off = dynamics.host_difference(np.append(x, own), np.append(planned, further))
            u = u + plan.gains[k] @ off
        else:
            self.statistics.unmeasured += 1
        u = np.clip(u, self._lower, self._upper)
        if self._applied is not None:
            self._applied.add(u, t, min(t, plan.time) - 2 * step)
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
        _require_time(t)
        steps = (t - self.latest.time) / self._step
        return steps > self.every - 1e-6

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
        cost = 1.0 if self._plan is None else float(abs(self._plan.cost))
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


def _first(found: Chains, explorers: int, seed: int, polish: Polish | None) -> Carried:
    """The chains of a solve, the best ones as keepers; the explorers at all ages.

    The polish of explorers begins when they become keepers.
    """
    chains = len(found.cost)
    count = chains - explorers
    age = np.zeros(chains, np.int32)
    age[count:] = np.arange(explorers) * CYCLE // max(explorers, 1)
    state = _rows(found.state, found.order()[0])
    if polish is None:
        state = replace(state, polish=())
    return Carried(
        _begun_anew(state, jnp.arange(chains) >= count),
        jnp.int32(0),
        jnp.array(False),
        jnp.int32(count - 1),
        jnp.asarray(age),
        jax.random.key(seed),
    )


def _rows(state: State, which: ArrayLike) -> State:
    """Some of the chains."""
    which = jnp.asarray(which)
    return jax.tree.map(lambda a: a[which], state)


@lru_cache
def _planner(structure: Any, explorers: int) -> compiled:
    """The program that plans with settings of this structure (flow, heated flow, polish, problem).

    A call gives their leaves, so that no plan waits while settings and problem are flattened and
    their structure is compared; what is `Now` in one vector; and the problem's data of the knots
    from now on. The plan comes back in one vector, too.
    """

    def plan(
        leaves: list[Any], carried: Carried, packet: Array, data: Any
    ) -> tuple[Carried, Array]:
        flow, heated, polish, problem = jax.tree.unflatten(structure, leaves)
        now: Now = unpacked(packet, _now_like(problem))
        heated = replace(heated, scale=replace(heated.scale, noise=now.noise))
        present = at_present(problem, now.passed, now.before)
        present = replace(present, x_init=now.x, t_init=now.t, data=data)
        after, plan = _plan(
            flow, heated, polish, present, carried, now.by, now.iterations, explorers
        )
        return after, packed(plan, packet.dtype)

    def key(leaves: list[Any], carried: Carried, packet: Array, data: Any) -> str | None:
        shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf), leaf.dtype) for leaf in leaves]
        settings = jax.tree.unflatten(structure, shapes)
        known = identity((settings, carried, packet, data), settings[-1])
        return known and f"{explorers} explore; {known}"

    return compiled(full_precision(plan), graph=True, key=key)


def _now_like(problem: Problem) -> Now:
    """Zeros of the shapes and types of what a plan of that problem starts from."""
    dynamics, number = problem.dynamics, np.zeros((), problem.x_init.dtype)
    rates = isinstance(dynamics, Extended) and dynamics.order
    return Now(
        x=np.zeros(dynamics.nx, number.dtype),
        t=number,
        by=number,
        iterations=np.zeros((), np.int32),
        noise=number,
        passed=number,
        before=(np.zeros(dynamics.nu, number.dtype), np.zeros((), bool)) if rates else None,
    )


def _plan_like(state: State) -> Plan:
    """Zeros of the shapes and types of a plan, for chains in that state."""
    knots, (K, nu, ndx) = state.trajectory, state.gains.shape[1:]
    number = np.zeros((), knots.u.dtype)
    no = np.zeros((), bool)
    return Plan(
        x=np.zeros((K + 1, knots.x.shape[-1]), number.dtype),
        u=np.zeros((K, nu), number.dtype),
        gains=np.zeros((K, nu, ndx), number.dtype),
        cost=number,
        max_defect=number,
        finite=no,
        switched=no,
        dt=number,
        time=0.0,
    )


def _plan(
    flow: Langevin,
    heated: Langevin,
    polish: Polish | None,
    problem: Problem,
    carried: Carried,
    by: Array,
    iterations: Array,
    explorers: int,
) -> tuple[Carried, Plan]:
    """Shift by `by` knots, iterate from x_init, and choose: one plan, all on the device."""
    chains, best, age, key = len(carried.age), carried.best, carried.age, carried.key
    exploring = jnp.arange(chains) >= chains - explorers
    state = jax.vmap(partial(shifted, flow, problem, by))(carried.state)
    if explorers:
        key, fresh = jax.random.split(key)
        state = _restarted(heated, problem, state, best, exploring & (age == 0), fresh)
    state = _led_back(flow, problem, state, carried)
    state = _iterated(flow, heated, polish, problem, state, age, iterations, explorers)
    age = jnp.where(exploring & (age + iterations < CYCLE), age + iterations, 0)
    info = evaluate(problem, state.trajectory)
    alive = state.alive & jnp.isfinite(info.cost) & jnp.isfinite(info.max_defect)
    cost = jnp.where(alive & (info.max_defect < FEASIBLE), info.cost, jnp.inf)
    chosen = _chosen(info, cost, alive, best)
    states = problem.with_start(state.trajectory)[chosen]
    plan = Plan(
        x=states,
        u=state.trajectory.u[chosen],
        gains=state.gains[chosen],
        cost=info.cost[chosen],
        max_defect=info.max_defect[chosen],
        finite=alive[chosen],
        switched=chosen != best,
        dt=step_of(problem, states),
    )
    # An explorer that is applied becomes a keeper, and so does whatever replaces the dead
    worst = jnp.argmax(jnp.where(exploring, -jnp.inf, cost))
    places, found = jnp.arange(chains), exploring[chosen]
    source = jnp.where(alive | exploring, places, chosen)
    source = jnp.where(found & (places == worst), chosen, source)
    best = jnp.where(found, worst, chosen)
    mine = (places == best) | exploring
    spare = jnp.argmax(jnp.where(mine, -jnp.inf, jnp.where(alive, cost, jnp.inf)))
    lost = ~(info.max_defect[chosen] < FEASIBLE)
    return Carried(_rows(state, source), best, lost, spare, age, key), plan


def _chosen(info: Info, cost: Array, alive: Array, best: Array) -> Array:
    """The chain to apply: of the feasible ones the cheapest, else the one with least max|h|.

    The one that was applied last has an advantage, so that plans do not alternate.
    """
    mine = jnp.arange(len(cost)) == best
    cost = jnp.where(mine, cost - (1.0 - CHEAPER) * jnp.abs(info.cost), cost)
    defect = jnp.where(mine, CHEAPER, 1.0) * jnp.where(alive, info.max_defect, jnp.inf)
    return jnp.argmin(jnp.where(jnp.isfinite(cost).any(), cost, defect))


def _led_back(flow: Langevin, problem: Problem, state: State, carried: Carried) -> State:
    """The spare keeper's knots replaced by a rollout of the applied plan, if that was lost.

    After a push the knots are far from any motion, and few iterations do not bring them back. The
    controls with their feedback, followed from x, give a motion to start from. It takes as many
    steps as there are knots, one after the other: several times as long as an iteration.
    """
    best, spare = carried.best, carried.spare

    def rolled() -> State:
        knots, gains = jax.tree.map(lambda a: a[best], (state.trajectory, state.gains))
        several = jax.tree.map(lambda a: a[None], (knots, gains))  # kernels are for batches
        x, u = jax.tree.map(lambda a: a[0], jax.vmap(problem.rolled_out)(*several))
        x, u = jnp.where(jnp.isfinite(x), x, knots.x), jnp.where(jnp.isfinite(u), u, 0.0)
        inside = flow.inside(problem, replace(knots, x=x, u=u))
        new = jax.tree.map(lambda a, b: a.at[spare].set(b), state.trajectory, inside)
        which = jnp.arange(len(state.alive)) == spare
        damping = jnp.where(which, 1.0, state.damping)
        return _begun_anew(replace(state, trajectory=new, damping=damping), which)

    led: State = jax.lax.cond(carried.lost & (spare != best), rolled, lambda: state)
    return led


def _restarted(
    heated: Langevin, problem: Problem, state: State, best: Array, which: Array, key: Array
) -> State:
    """The chains (chains,) that are to start again do so from the best one's knots."""
    knots = jax.tree.map(lambda a: jnp.broadcast_to(a[best], a.shape), state.trajectory)
    keys = chain_keys(key, len(which))
    started = jax.vmap(partial(heated.init, problem))(replace(knots, slack=None), keys)
    return _where(which, replace(started, polish=state.polish), state)


def _where(which: Array, new: State, old: State) -> State:
    """The new state for some chains (chains,), the old one for the others."""

    def chosen(a: Array, b: Array) -> Array:
        return jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(chosen, new, old)


def _begun_anew(state: State, which: Array) -> State:
    """Some chains (chains,) have other knots than their polish has known."""
    if not isinstance(state.polish, Progress):
        return state
    return replace(state, polish=replace(state.polish, stalled=state.polish.stalled | which))


def _iterated(
    flow: Langevin,
    heated: Langevin,
    polish: Polish | None,
    problem: Problem,
    state: State,
    age: Array,
    iterations: Array,
    explorers: int,
) -> State:
    """So many iterations of every chain: of the polish, else of the tail; of an explorer's flow.

    Explorers are the last chains, and go on from their `age` (chains,).
    """
    keepers = len(age) - explorers
    if polish is None:  # one loop for all: where f has contacts, each takes long to compile
        return _flow_iterated(flow, heated, problem, state, age, iterations, explorers)
    kept, others = (
        jax.tree.map(lambda a, part=part: a[part], state)
        for part in (slice(keepers), slice(keepers, None))
    )
    kept = jax.vmap(partial(_resumed, flow, problem))(kept)
    question = Question(replace(flow, iterations=0), problem, np.int32(0), polish)
    shared, own = partition(question, None)
    kept = loop((kept, own), shared, 0, iterations, diagnose=False)[0]
    if not explorers:
        return kept
    others = _flow_iterated(flow, heated, problem, others, age[keepers:], iterations, explorers)
    whole: State = jax.tree.map(lambda *parts: jnp.concatenate(parts), kept, others)
    return whole


def _flow_iterated(
    flow: Langevin,
    heated: Langevin,
    problem: Problem,
    state: State,
    age: Array,
    iterations: Array,
    explorers: int,
) -> State:
    """So many iterations of keepers in the tail, and of explorers in their own schedules."""
    exploring = jnp.arange(len(age)) >= len(age) - explorers

    def own(old: Array, new: Array) -> Array:
        which = exploring.reshape(-1, *[1] * jnp.ndim(old))
        return jnp.where(which, jnp.asarray(new), jnp.asarray(old))

    start = jnp.where(exploring, age, jnp.int32(flow.iterations + flow.tail) - iterations)
    question = Question(jax.tree.map(own, flow, heated), problem, start)
    sizes = [len(jax.tree.leaves(part)) for part in question]
    differs = (True,) * sizes[0] + (False,) * sizes[1] + (True,)
    shared, rows = partition(question, differs)
    both = explorers > 0
    return loop((state, rows), shared, 0, iterations, noise=both, diagnose=False, mixed=both)[0]


def _resumed(flow: Langevin, problem: Problem, state: State) -> State:
    """A chain as a warm start of the polish; one that was blocked is led off its bounds.

    Steps of an interior point method are short where knots are at their bounds and have to leave
    them.
    """
    old, rho = state.polish, flow.weights(1.0).barrier
    inside = replace(state, trajectory=flow.inside(problem, state.trajectory))
    fresh = begin_inside(problem, inside, rho)
    fresh = replace(fresh, polish=replace(fresh.polish, stiffness=old.stiffness))
    warm = resumed(problem, state)
    return jax.tree.map(lambda a, b: jnp.where(old.blocked, a, b), fresh, warm)
