"""The optimal control problem, and the knot points that answer it.

    min  phi(x_K) + sum_k l(x_k, u_k)    s.t.  x_{k+1} = f(x_k, u_k),  x_0 = x_init,
                                               x_lower <= x_k <= x_upper,  u_lower <= u_k <= u_upper

(equation 1 of the paper, with bounds). k runs over 0..K-1 for controls and 1..K for the states that
are solved for. There is no hidden factor dt: a running cost is summed over knots as it stands.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, DraxWarning, reason, require_whole, shown
from mjx_drax.base.numbers import vector
from mjx_drax.base.pytrees import HostOnly, Static, register_dataclass, with_host_fields
from mjx_drax.kernels.pruning import pruned
from mjx_drax.problem.cost import Constraint, Cost
from mjx_drax.problem.data import later, require_length, require_rows
from mjx_drax.problem.data import rows as data_rows
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.rollout import follow, in_double
from mjx_drax.problem.tracing import require_shape
from mjx_drax.problem.trajectory import Box, Knot, Stagewise, Trajectory, Values

FUNCTIONS = ("dynamics", "running", "terminal", "constraint", "terminal_constraint")
"""Attributes of a problem that hold functions."""

STEP = "the dynamics f(x, u)"
"""What messages call f."""

INWARD = 0.05
"""How far inside of the useful controls the search brings those back that have left them, as a
share of the way between their ends."""

STATES = 1_000
"""States of the scatter box in which `Problem.saturates` looks."""

CLOSE = 0.03
"""Least factor on the scatter of initial knots of chains that start nearer to x_init."""

PARTS = 12.0
"""States are measured in this fraction of their box, so that units do not matter."""

ROUNDINGS = 1e4
"""Defects are measured in no less than so many roundings of states: knots are no more exact."""


@register_dataclass
@dataclass(frozen=True)
class Problem:
    """An optimal control problem, as a pytree.

    Functions, sizes and the horizon are static; every number (x_init, bounds, model parameters,
    bound arguments of the costs) is traced.

    Attributes:
        dynamics: x_{k+1} = f(x_k, u_k).
        running: l, called with (dynamics.observe(x, u), u).
        terminal: phi, called with (dynamics.observe(x, 0),).
        constraint: equality and inequality on (dynamics.observe(x, u), u) at every stage.
        terminal_constraint: the same on (dynamics.observe(x, 0),) at x_K.
        x_init: x_0, (nx,); or what its free coordinates are counted from.
        bounds: the box that every knot must keep to.
        scatter: the box that initial knots are drawn from, uniformly.
        horizon: K, number of control knots.
        near: share of the chains that start nearer to x_init than the scatter.
        free: the coordinates of x_0, in tangent space, that each entry of `Trajectory.start` moves.
        data: numbers for every knot, arrays (K + 1, ...); or None.
        t_init: time of x_0 [s].
        goal: what a replay must reach: a test of dynamics.observe_replayed(x_K), or None.
        guess: draws the initial knots of one chain from a key, instead of `scatter`; or None.
        data_at: the function of time that `data` comes from, if any.
        name: what files and tables call it.

    The last four are read on the host only: another one does not recompile. Functions with a
    parameter `knot` receive a `Knot`; `at` binds all functions to one.
    """

    dynamics: Dynamics
    running: Cost
    terminal: Cost
    constraint: Constraint
    terminal_constraint: Constraint
    x_init: Array
    bounds: Box
    scatter: Box
    horizon: int = field(metadata=Static)
    near: float = field(default=0.0, metadata=Static)
    free: tuple[tuple[int, ...], ...] = field(default=(), metadata=Static)
    data: Any = None
    t_init: Any = 0.0
    goal: Callable[[Any], Any] | None = field(default=None, metadata=HostOnly)
    guess: Callable[[Array], Trajectory] | None = field(default=None, metadata=HostOnly)
    data_at: Callable[[Any], Any] | None = field(default=None, metadata=HostOnly)
    name: str = field(default="problem", metadata=HostOnly)

    def __repr__(self) -> str:
        f = self.dynamics
        sizes = f"nx={f.nx}, nu={f.nu}, horizon={self.horizon}"
        return f"<Problem {self.name}: {type(f).__name__}, {sizes}>"

    @property
    def times(self) -> np.ndarray:
        """Times of x_0..x_K, (K + 1,) [s]."""
        start = np.zeros((self.horizon + 1, self.dynamics.nx))
        start[:] = np.asarray(self.x_init)
        return self.dynamics.times(start, float(self.t_init))

    @property
    def knots(self) -> Knot:
        """Time, number and data of knots 0..K."""
        k, dt = jnp.arange(self.horizon + 1), jnp.asarray(self.dynamics.dt, self.x_init.dtype)
        first = jnp.round(self.t_init / dt).astype(k.dtype)
        steps, start = jnp.broadcast_to(dt, k.shape), jnp.tile(self.x_init, (len(k), 1))
        return Knot(self.t_init + dt * k, first + k, steps, self.data, start, stage=k)

    def at(self, knot: Knot) -> Problem:
        """The problem with all functions of a stage, or of the end, bound to one knot."""
        return replace(self, **{name: getattr(self, name).at(knot) for name in FUNCTIONS})

    @property
    def end(self) -> Problem:
        """The problem at its last knot."""
        return self.at(self.knots.at(-1))

    def seen(self, x: Array, u: Array | None = None) -> tuple[Any, ...]:
        """What functions of a stage are called with, and those of the end if there is no u."""
        if u is None:
            return (self.dynamics.observe(x, jnp.zeros(self.dynamics.nu)),)
        return self.dynamics.observe(x, u), u

    @property
    def precision(self) -> int:
        """Bits of its numbers: 32 or 64."""
        return 8 * int(self.x_init.dtype.itemsize)

    def arithmetic(self) -> AbstractContextManager[Any]:
        """A context in which JAX keeps the problem's precision, whatever it is set to."""
        return jax.enable_x64(self.precision == 64)

    # Of all that `observe` computes, these four keep what their readers read

    @pruned
    def running_cost(self, x: Array, u: Array, knot: Knot | None = None) -> Array:
        """l(x, u) at a knot, by default the first, scalar."""
        here = self.at(self.knots.at(0) if knot is None else knot)
        return here.running(*here.seen(x, u))

    @pruned
    def terminal_cost(self, x: Array) -> Array:
        """phi(x), scalar."""
        return self.end.terminal(*self.end.seen(x))

    @pruned
    def running_constraint(self, x: Array, u: Array, knot: Knot | None = None) -> Array:
        """Constraints at a stage, by default the first, [equality; inequality], (m,)."""
        here = self.at(self.knots.at(0) if knot is None else knot)
        return here.constraint(*here.seen(x, u))

    @pruned
    def end_constraint(self, x: Array) -> Array:
        """Constraints at the end, [equality; inequality], (m_end,)."""
        return self.end.terminal_constraint(*self.end.seen(x))

    @property
    def start_map(self) -> Array | None:
        """E (ndx, n0) of 0 and 1: x_0 = x_init + E `Trajectory.start`; None if x_0 is fixed."""
        if not self.free:
            return None
        E = np.zeros((self.dynamics.ndx, len(self.free)))
        for i, places in enumerate(self.free):
            E[list(places), i] = 1.0
        return jnp.asarray(E, self.x_init.dtype)

    def start_from(self, x: Array) -> Array | None:
        """`Trajectory.start` (n0,) of a motion that begins at x (nx,); None if x_0 is fixed."""
        E = self.start_map
        if E is None:
            return None
        return (E / jnp.sum(E, axis=0)).T @ self.dynamics.difference(x, self.x_init)

    def first(self, trajectory: Trajectory) -> Array:
        """x_0, (..., nx)."""
        leading = trajectory.x.shape[:-2]
        x = jnp.broadcast_to(self.x_init, (*leading, self.dynamics.nx))
        if trajectory.start is None:
            return x
        E = self.start_map
        assert E is not None  # for the type checker
        change = jnp.asarray(trajectory.start) @ E.T
        move = self.dynamics.integrate
        for _ in leading:
            move = jax.vmap(move)
        return move(x, change)

    def with_start(self, trajectory: Trajectory) -> Array:
        """x_0..x_K, (..., K + 1, nx): the states with x_0 in front."""
        x = jnp.asarray(trajectory.x)
        return jnp.concatenate([self.first(trajectory)[..., None, :], x], axis=-2)

    def stages(self, trajectory: Trajectory) -> tuple[Array, Array, Knot]:
        """x_0..x_{K-1} (K, nx), the controls (K, nu) that act on them, and their knots."""
        return self.with_start(trajectory)[:-1], trajectory.u, self.knots.at(slice(-1))

    def costs(self, trajectory: Trajectory) -> Array:
        """l(x_k, u_k) and phi(x_K), (K + 1,)."""
        running = jax.vmap(self.running_cost)(*self.stages(trajectory))
        return jnp.append(running, self.terminal_cost(trajectory.x[-1]))

    def cost(self, trajectory: Trajectory) -> Array:
        """phi(x_K) + sum_k l(x_k, u_k), scalar."""
        costs = self.costs(trajectory)
        return jnp.sum(costs[:-1]) + costs[-1]

    def defects(self, trajectory: Trajectory) -> Array:
        """h_k = f(x_k, u_k) - x_{k+1} in the tangent space at x_{k+1}, (K, ndx)."""

        def defect(x: Array, u: Array, knot: Knot, x_next: Array) -> Array:
            return self.dynamics.difference(self.dynamics.at(knot).step(x, u), x_next)

        return jax.vmap(defect)(*self.stages(trajectory), trajectory.x)

    def constraints(self, trajectory: Trajectory) -> Stagewise:
        """Values [equality; inequality] at the stages (K, m) and at the end (m_end,).

        In the units of the constraints, if they have any.
        """
        stages = jax.vmap(self.running_constraint)(*self.stages(trajectory))
        end = self.end_constraint(trajectory.x[-1])
        return Stagewise(self.constraint.in_units(stages), self.terminal_constraint.in_units(end))

    def inequalities(self, trajectory: Trajectory) -> Stagewise | None:
        """g at the stages (K, mg) and at the end (mg_end,); None if the problem has no g."""
        stage, end = self.constraint, self.terminal_constraint
        if stage.inequalities + end.inequalities == 0:
            return None
        values = self.constraints(trajectory)
        return Stagewise(values.stage[:, stage.equalities :], values.terminal[end.equalities :])

    def with_slack(self, values: Stagewise, slack: Stagewise | None) -> Stagewise:
        """The equality constraints [equality; inequality + slack], if there are slacks."""
        if slack is None:
            return values
        return Stagewise(
            self.constraint.with_slack(values.stage, slack.stage),
            self.terminal_constraint.with_slack(values.terminal, slack.terminal),
        )

    def values(self, trajectory: Trajectory) -> Values:
        """All of them at once."""
        return Values(
            self.costs(trajectory), self.defects(trajectory), self.constraints(trajectory)
        )

    def max_defect(self, trajectory: Trajectory) -> Array:
        """max|h| over dynamics and constraints, scalar: see `worst`."""
        return self.worst(self.values(trajectory), trajectory.x)

    def worst(self, values: Values, x: Array) -> Array:
        """max|h| of values that are known, at states x (K, nx), scalar.

        Defects of the dynamics are measured in `defect_unit`, constraints in their units;
        inequalities count where positive.
        """
        defect = jnp.abs(values.defects / self.defect_unit(x)).max(initial=0.0)
        return jnp.maximum(defect, self.worst_constraint(values.constraints))

    def worst_constraint(self, values: Stagewise) -> Array:
        """The largest violation of constraints that have these values, scalar."""
        stage = self.constraint.violation(values.stage)
        return jnp.maximum(stage, self.terminal_constraint.violation(values.terminal))

    @property
    def widths(self) -> tuple[Array, Array]:
        """Widths of the box of initial knots, (ndx,) and (nu,); 0 where they are infinite."""
        box, tangent = self.scatter, self.dynamics.tangent

        def of(ends: Array) -> Array:
            finite = jnp.where(jnp.isfinite(ends), jnp.abs(ends), 0.0)
            return finite if finite.ndim == 1 else finite.max(axis=0)

        return of(tangent(box.x_upper - box.x_lower)), of(box.u_upper - box.u_lower)

    @property
    def plan_bounds(self) -> Box:
        """The bounds of plans: `Box.opened_at` x_init in float32. In float64 no room is needed."""
        done = self.bounds.roomy is not None or self.precision == 64
        return self.bounds if done else self.bounds.opened_at(self.x_init)

    def prepared(self) -> Problem:
        """The problem with what its bounds are to plans, for loops.

        XLA moves it out of a loop, but not out of the loop's branches.
        """
        box = self.plan_bounds
        return replace(self, bounds=replace(box, roomy=box.with_room()))

    @property
    def defect_scale(self) -> Array:
        """What states are measured in, (ndx,): a twelfth of their box; 1 where it has no width."""
        width = self.widths[0]
        return jnp.where(width > 0.0, width / PARTS, 1.0)

    def defect_unit(self, x: Array | np.ndarray) -> Array:
        """What defects at states x (K, nx) are measured in, (ndx,).

        That is `defect_scale`, or `ROUNDINGS` of the largest states where these are so far out of
        their box, as a position in metres on an orbit whose box nobody has given.
        """
        largest = self.dynamics.tangent(jnp.abs(x).max(axis=0, initial=0.0))
        rounding = jnp.finfo(self.x_init.dtype).eps * largest
        return jnp.maximum(self.defect_scale, ROUNDINGS * rounding)

    def no_change(self, trajectory: Trajectory) -> Trajectory:
        """The displacement of nothing: zeros in tangent space, (K, ndx) and (K, nu)."""
        zeros = jax.tree.map(jnp.zeros_like, trajectory)
        return replace(zeros, x=self.dynamics.tangent(zeros.x))

    def displaced(self, trajectory: Trajectory, change: Trajectory) -> Trajectory:
        """X + change: the knots moved along a tangent `change`, and slacks with it."""
        x = jax.vmap(self.dynamics.integrate)(trajectory.x, change.x)
        own, by = ((z.u, z.slack, z.start) for z in (trajectory, change))
        return Trajectory(x, *jax.tree.map(jnp.add, own, by))

    def draw(self, key: Array) -> Trajectory:
        """Random initial knots for one chain; they need not be feasible.

        They are drawn from the scatter box. For a share `near` of the chains the box is shrunk
        towards x_init and the middle of the controls, for each by another factor from `CLOSE` to 1,
        uniform in its logarithm: far from x_init bodies overlap, forces become huge, and what
        floats freely may tumble at any speed. Chains that start far away find motions that go far.
        Controls stay within the useful ones of the state before; see `Dynamics.useful_controls`.
        """
        if self.guess is not None:
            knots = self.guess(key)
            x, u = (jnp.asarray(part, self.x_init.dtype) for part in (knots.x, knots.u))
            return self.started(replace(knots, x=x, u=u))
        key_x, key_u = jax.random.split(key)
        box, dynamics = self.scatter, self.dynamics
        x = jax.random.uniform(key_x, (self.horizon, dynamics.nx))
        u = jax.random.uniform(key_u, (self.horizon, dynamics.nu))
        x = box.x_lower + x * (box.x_upper - box.x_lower)
        if self.near > 0.0:
            power = jax.random.uniform(jax.random.fold_in(key, 2))
            share = CLOSE ** jnp.maximum((power - (1.0 - self.near)) / self.near, 0.0)
            x = self.x_init + share * (x - self.x_init)
        x = dynamics.valid(x)
        ends = dynamics.useful_controls(jnp.concatenate([self.x_init[None], x[:-1]]))
        low, high = box.u_lower, box.u_upper
        if ends is not None:
            low, high = (jnp.clip(end, box.u_lower, box.u_upper) for end in ends)
        u = low + u * (high - low)
        if self.near > 0.0:
            middle = 0.5 * (low + high)
            u = middle + share * (u - middle)
        knots = Trajectory(x, u)
        lower, upper = box.start_lower, box.start_upper
        if lower is not None and upper is not None:
            share = jax.random.uniform(jax.random.fold_in(key, 3), lower.shape)
            knots = replace(knots, start=lower + share * (upper - lower))
        return dynamics.consistent(knots)

    @property
    def saturates(self) -> bool:
        """Whether bounds hold controls that are not useful; see `Dynamics.useful_controls`."""
        return self.holds_beyond(self.dynamics.useful_controls)

    def holds_beyond(self, useful: Callable[[Array], tuple[Array, Array] | None]) -> bool:
        """Whether bounds hold controls beyond useful ones, in one of `STATES` states at least.

        Compiled only where these have ends.
        """
        if jax.eval_shape(useful, self.x_init) is None:
            return False
        box, bounds = self.scatter, self.bounds
        low, high = np.min(np.atleast_2d(box.x_lower), 0), np.max(np.atleast_2d(box.x_upper), 0)
        share = np.random.default_rng(0).random((STATES, len(low)))
        x = jnp.asarray(low + share * (high - low), self.x_init.dtype)
        first, last = jax.jit(lambda x: useful(self.dynamics.valid(x)))(x)
        lower = np.min(np.atleast_2d(bounds.u_lower), 0)
        upper = np.max(np.atleast_2d(bounds.u_upper), 0)
        return bool(((first > lower) | (last < upper)).any())

    def with_useful_controls(self, knots: Trajectory) -> Trajectory:
        """The knots, with u_k clipped to the useful controls of x_k, less `INWARD` at each end.

        Controls for which that is outside of the bounds stay; see `Dynamics.useful_controls`.
        """
        ends = self.dynamics.useful_controls(self.stages(knots)[0])
        if ends is None:
            return knots
        width = ends[1] - ends[0]
        inward = jnp.where(jnp.isfinite(width), INWARD * width, 0.0)
        u, bounds = jnp.clip(knots.u, ends[0] + inward, ends[1] - inward), self.plan_bounds
        inside = (u > bounds.u_lower) & (u < bounds.u_upper)
        return replace(knots, u=jnp.where(inside, u, knots.u))

    def started(self, knots: Trajectory) -> Trajectory:
        """Given knots as states of the dynamics, with the x_0 next to x_init where it is free.

        Further states of the dynamics may be missing. Those that stay as they are, such as the step
        of a free duration, are in x_0 what they are in x_1.
        """
        short = self.dynamics.nx - knots.x.shape[-1]
        pad = [(0, 0)] * (knots.x.ndim - 1)
        knots = replace(knots, x=self.dynamics.valid(jnp.pad(knots.x, [*pad, (0, short)])))
        if self.free and knots.start is None:
            away = jnp.zeros((*knots.x.shape[:-2], len(self.free)), knots.x.dtype)
            given = self.dynamics.given_nx
            own = self.dynamics.ndx - (self.dynamics.nx - given)
            for i, places in enumerate(self.free):
                column = given + max(places) - own
                if not short and column >= given:
                    first = knots.x[..., 0, column] - self.x_init[column]
                    away = away.at[..., i].set(first)
            start = jnp.clip(away, self.bounds.start_lower, self.bounds.start_upper)
            knots = replace(knots, start=start)
        return self.dynamics.consistent(knots) if short else knots

    def rolled_out(self, knots: Trajectory, gains: Array) -> tuple[Array, Array]:
        """x_1..x_K (K, nx) and controls (K, nu) that f makes of one chain's plan under feedback.

        The controls u_k + K_k (x_k - planned x_k), gains K (K, nu, ndx), within their bounds.
        """
        dynamics, box = self.dynamics, self.bounds

        def advance(x: Array, u: Array, knot: Knot) -> Array:
            return dynamics.at(knot).step(x, u)

        lower, upper = (jnp.broadcast_to(end, knots.u.shape) for end in (box.u_lower, box.u_upper))
        given = self.with_start(knots), knots.u, gains, (lower, upper), self.knots.at(slice(-1))
        x, u = follow(advance, dynamics.difference, *given)
        return x[1:], u

    def replay(
        self, plan: ArrayLike, u: ArrayLike, gains: ArrayLike, knots: Knot | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`Dynamics.replay` within the control bounds, from numbers of any precision.

        Args:
            plan: planned states x_0..x_K, (chains, K + 1, nx).
            u: planned controls, (chains, K, nu).
            gains: feedback K_k, (chains, K, nu, ndx); zeros replay open loop.
            knots: of the stages of every chain, if they differ, with an axis of chains in front.
        """
        limits = np.asarray(self.bounds.u_lower, float), np.asarray(self.bounds.u_upper, float)
        plan, u, gains = (np.asarray(given, float) for given in (plan, u, gains))
        with self.arithmetic():
            knots = _stages(self) if knots is None else knots
            return self.dynamics.replay(plan, u, gains, limits, knots)

    def engine_defects(self, plan: np.ndarray, u: np.ndarray) -> np.ndarray:
        """|f(x_k, u_k) - x_{k+1}| of plans, (..., K, ndx), by what replays: a step from each x_k.

        Args:
            plan: x_0..x_K, (..., K + 1, nx).
            u: controls, (..., K, nu).

        Raises:
            DraxError: the problem was loaded without f.
        """
        dynamics, given = self.dynamics, np.asarray(u, float).reshape(-1, 1, self.dynamics.nu)
        steps = np.stack([plan[..., :-1, :], plan[..., 1:, :]], axis=-2).astype(float)
        steps = steps.reshape(len(given), 2, dynamics.nx)
        free, gains = np.array(np.inf), np.zeros((len(given), 1, dynamics.nu, dynamics.ndx))
        with self.arithmetic():
            which = np.tile(np.arange(self.horizon), len(given) // self.horizon)
            # In numpy, as JAX would compile a program for every number of rows
            knots = jax.tree.map(lambda a: np.asarray(a)[which, None], _stages(self))
            ran, _ = dynamics.replay(steps, given, gains, (-free, free), knots)
        off = np.abs(dynamics.host_difference(ran[:, 1], steps[:, 1]))
        return np.nan_to_num(off, nan=np.inf).reshape(*u.shape[:-1], dynamics.ndx)

    def reached(self, x: np.ndarray, time: float | None = None) -> bool | None:
        """Whether a replay that ends at x (nx,) reaches the goal; None without a goal.

        Args:
            x: where it ends.
            time: when [s]; None: at the end of the horizon.

        Raises:
            DraxError: the goal fails, or returns more than one truth value.
        """
        if self.goal is None:
            return None
        time = float(self.times[-1]) if time is None else time
        return self._met(self.dynamics.observer(), x, time)

    def all_reached(self, x: np.ndarray, times: Sequence[float]) -> np.ndarray:
        """`reached` of many ends x (n, nx) at their times, (n,); those not finite do not.

        Warns:
            DraxWarning: it fails for some, which then do not reach it: all is computed by now.
        """
        observe, found = self.dynamics.observer(), np.zeros(len(x), bool)
        failed: DraxError | None = None
        for i, (end, time) in enumerate(zip(x, times, strict=True)):
            try:
                found[i] = self._met(observe, end, time)
            except DraxError as error:
                failed = error
        if failed is not None:
            words = f"{failed} No motion counts as there where it fails."
            warnings.warn(words, DraxWarning, stacklevel=2)
        return found

    def _met(self, observe: Callable[[np.ndarray, float], Any], x: np.ndarray, time: float) -> bool:
        assert self.goal is not None
        if not np.isfinite(x).all():
            return False
        try:
            reached = np.asarray(self.goal(observe(x, time)))
        except Exception as error:
            raise DraxError(
                f"goal failed at x = {shown(x.tolist())}: {reason(error)}. Make it a function of "
                "the state of a function problem, or of the mujoco.MjData of a model, alone."
            ) from error
        if reached.size != 1 or reached.dtype.kind != "b":
            raise DraxError(
                f"goal returned shape {reached.shape}, {shown(reached)}: it must return one truth "
                "value, as abs(x[0] - 3.0) < 0.05 is."
            )
        return bool(reached.item())

    def in_float64(self) -> Problem:
        """The same problem in float64, as `solve(..., precision=64)` makes it.

        Numbers that were rounded to float32 stay so, except for those of a MuJoCo model. Functions
        are copied, since JAX keeps the precision in which it first saw their constant arrays; those
        of a `Dynamics` of your own are not. A problem that is built under `jax_enable_x64` has
        no such limits.
        """
        with jax.enable_x64(True):
            own = replace(self, **{name: getattr(self, name).in_float64() for name in FUNCTIONS})
            numbers = jax.tree.map(lambda leaf: jnp.asarray(in_double(leaf)), own)
        return with_host_fields(numbers, own)

    def in_precision(self, bits: int | None) -> Problem:
        """The same problem with numbers of 32 or 64 bits; None: those that it has.

        Raises:
            DraxError: other bits, or 32 for a problem that is in float64.
        """
        if bits is not None and (isinstance(bits, bool) or bits not in (32, 64)):
            raise DraxError(
                f"precision is {shown(bits)}: give 64 or 32, the bits of a number, or leave it out."
            )
        if bits is None or bits == self.precision:
            return self
        if bits == 32:
            raise DraxError(
                f"precision is 32, and {self.name} is in float64: leave precision out, or make the "
                "problem without jax_enable_x64."
            )
        return self.in_float64()

    def with_data(self, data: Any) -> Problem:
        """The same problem with other data for its knots: arrays, or a function of time [s].

        Of the same shapes, they do not recompile.

        Raises:
            DraxError: they do not fit.
        """
        if self.dynamics.phases:
            require_rows(data)
        with self.arithmetic():
            found = data_rows(data, self.times)
            moved = replace(self, data=found, data_at=data if callable(data) else None)
            traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(found))
            return moved if traced else checked(moved)

    def at_time(self, t_init: float) -> Problem:
        """The same problem with x_0 at another time [s].

        Data that came from a function are taken from it anew; arrays move by whole knots, and stay
        at their last row behind their end.
        """
        by = (t_init - float(self.t_init)) / float(self.dynamics.dt)
        with self.arithmetic():
            moved = replace(self, t_init=jnp.asarray(t_init, self.x_init.dtype))
            if self.data is None:
                return moved
            if self.data_at is not None:
                return replace(moved, data=data_rows(self.data_at, moved.times))
            return replace(moved, data=later(self.data, round(by)))

    def with_x_init(self, x_init: ArrayLike) -> Problem:
        """The same problem from another initial state (nx,); bounds of a free x_0 move along.

        Raises:
            DraxError: it does not fit.
        """
        with self.arithmetic():
            traced = isinstance(x_init, jax.core.Tracer)  # by what makes many problems
            x = jnp.asarray(x_init, self.x_init.dtype) if traced else vector("x_init", x_init)
            if x.shape == (self.dynamics.given_nx,):
                x = jnp.concatenate([x, self.x_init[len(x) :]])
            moved = replace(self, x_init=x)
            return moved if traced else checked(moved)


def require_problem(problem: object) -> None:
    """Complain about what is no problem."""
    if not isinstance(problem, Problem):
        raise DraxError(
            f"the problem is {shown(problem)}: give one from from_mjcf or from_function."
        )


def checked(problem: Problem) -> Problem:
    """The problem, if sizes, bounds and functions fit together; traced abstractly, not compiled."""
    require_problem(problem)
    dynamics, name = problem.dynamics, problem.name
    nx, nu = dynamics.nx, dynamics.nu
    if nu < 1:
        raise DraxError(f"{name} has {nu} controls: a problem needs at least one; add an actuator.")
    require_whole("the number of knots, horizon,", problem.horizon)
    start = np.asarray(problem.x_init)
    if start.dtype.kind != "f" or not np.isfinite(start).all():
        raise DraxError(f"x_init is {shown(start)}: give a vector of finite floats.")
    if start.shape != (nx,):
        fix = f"give {nx} numbers, the states of the dynamics."
        if start.shape == (dynamics.given_nx,):
            fix = "call with_x_init, which keeps the other states, those of what is left open."
        raise DraxError(f"x_init has shape {start.shape}: {fix}")
    _check_bounds(problem, start)
    for path, rows in jax.tree_util.tree_leaves_with_path(problem.data):
        require_length("data" + jax.tree_util.keystr(path), rows, problem.horizon + 1)
    costs = (problem.running, problem.terminal)
    if all(part is None for cost in costs for part in (cost.scalar, cost.residual)):
        raise DraxError(
            f"{name} has no cost: give a running or a terminal one; where any "
            "motion will do, running_cost=lambda x, u: 1e-6 * (u @ u)."
        )
    with problem.arithmetic():
        for label, function, arguments, shape in functions_of(problem):
            if label != STEP or not dynamics.checked:  # tracing MJX takes a second
                require_shape(label, function, arguments, shape)
        _check_guess(problem)
    problem.reached(np.asarray(problem.x_init, float))
    return problem


def _check_bounds(problem: Problem, start: np.ndarray) -> None:
    """The part of `checked` for bounds, the box of initial knots, and x_init (nx,) in them."""
    dynamics, bounds, scatter = problem.dynamics, problem.bounds, problem.scatter
    u = "u" if dynamics.nx else "x"  # of a program
    for label, size, ends in (
        ("x", dynamics.nx, (bounds.x_lower, bounds.x_upper)),
        (u, dynamics.nu, (bounds.u_lower, bounds.u_upper)),
        ("scatter of x", dynamics.nx, (scatter.x_lower, scatter.x_upper)),
        (f"scatter of {u}", dynamics.nu, (scatter.u_lower, scatter.u_upper)),
    ):
        for end in ends:
            if np.shape(end) not in ((size,), (problem.horizon, size)):
                raise DraxError(
                    f"bounds of {label} have shape {np.shape(end)}: give numbers of shape "
                    f"({size},), or ({problem.horizon}, {size}) for each knot."
                )
        lower, upper = np.broadcast_arrays(*map(np.asarray, ends))
        for wrong, words in (
            (np.isnan(lower) | np.isnan(upper), "hold NaN"),
            (lower > upper, "cross"),
            ((lower == np.inf) | (upper == -np.inf), "leave nothing in between"),
        ):
            if wrong.any():
                at = tuple(int(i) for i in np.argwhere(wrong)[0])
                raise DraxError(
                    f"bounds of {label} {words} at element {at[-1]}: lower {float(lower[at])}, "
                    f"upper {float(upper[at])}. Give lower <= upper, -inf and inf if free."
                )
    if bounds.x_lower.ndim == bounds.x_upper.ndim == 1:
        low, high = np.asarray(bounds.x_lower), np.asarray(bounds.x_upper)
        outside = np.maximum(low - start, start - high)
        if (outside > 1e-6).any():
            most = int(outside.argmax())
            raise DraxError(
                f"x_init = {shown(start.tolist())} lies outside the bounds of x by "
                f"{outside[most]:.3g} at element {most}: move it inside, or widen the bounds."
            )


def functions_of(
    problem: Problem, knot: Knot | None = None
) -> list[tuple[str, Callable[..., Any], tuple[Any, ...], tuple[int, ...] | None]]:
    """The functions of a problem: label, function, what it is called with, and shape if known.

    What it is called with has shapes and no values. All are bound to one knot, by default the
    first.
    """
    problem = problem.at(problem.knots.at(0) if knot is None else knot)
    dynamics, dtype = problem.dynamics, problem.x_init.dtype
    x, u = (jax.ShapeDtypeStruct((size,), dtype) for size in (dynamics.nx, dynamics.nu))
    found: list[Any] = [(STEP, dynamics.step, (x, u), (dynamics.nx,))]
    seen = jax.eval_shape(dynamics.observe, x, u)
    for when, cost, constraint, arguments in (
        ("running", problem.running, problem.constraint, (seen, u)),
        ("terminal", problem.terminal, problem.terminal_constraint, (seen,)),
    ):
        before = "" if when == "running" else "terminal_"
        of_cost = f"{when}_" if dynamics.nx else ""  # a program has but one
        found += [
            (f"{of_cost}cost", cost.scalar, arguments, ()),
            (f"{of_cost}residual", cost.residual, arguments, None),
            (f"{before}equality", constraint.equality, arguments, None),
            (f"{before}inequality", constraint.inequality, arguments, None),
        ]
    return [entry for entry in found if entry[1] is not None]


@jax.jit
def _stages(problem: Problem) -> Knot:
    """The knots of the stages, in one call: on a GPU each operation by itself costs as much."""
    return problem.knots.at(slice(-1))


def _check_guess(problem: Problem) -> None:
    """The part of `checked` for the function that draws initial knots."""
    if problem.guess is None:
        return
    K, nx, nu = problem.horizon, problem.dynamics.nx, problem.dynamics.nu
    wanted = f"a Trajectory with x ({K}, {nx}) and u ({K}, {nu})"
    try:
        knots = jax.eval_shape(problem.guess, jax.random.key(0))
    except Exception as error:
        raise DraxError(
            f"guess failed when it was traced: {reason(error)}. Make it a JAX function of a random "
            f"key that returns {wanted}."
        ) from error
    if not isinstance(knots, Trajectory):
        raise DraxError(f"guess returned a {type(knots).__name__}: return {wanted}.")
    shapes = [getattr(part, "shape", None) for part in (knots.x, knots.u)]
    if shapes != [(K, nx), (K, nu)]:
        raise DraxError(
            f"guess returned x of shape {shapes[0]} and u of shape {shapes[1]}: return {wanted}."
        )
