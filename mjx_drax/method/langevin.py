"""Equality-constrained Langevin diffusion over state and control knots.

One iteration of a chain (Kurtz and Burdick, with the metric M of `precondition`):

    X      <- X + alpha d + sigma sqrt(2 alpha) n,    d = -M^{-1} grad L_mu,  n ~ N(0, M^{-1})
    lambda <- lambda + alpha r,                       r = mu (h + J d)  (Identity: 2 mu h)

While sigma > 0 knots leave the dynamics and wander between basins; the multipliers pull them back
onto h = 0 as sigma falls. The noise-free tail then takes the step size that lowers the augmented
Lagrangian most, from a short geometric ladder evaluated in one batch: with Gauss-Newton that is
sequential quadratic programming, and it is what brings max|h| to rounding level. In the tail each
chain adapts its damping as Levenberg and Marquardt do, less after a full step and more after a
short one, and bounds get multipliers of their own (`bounds`).

`init`, `step` and `advance` work on all chains at once. Chains never exchange numbers: a chain
that turns non-finite is frozen where it last was finite and marked as diverged.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from mjx_drax.base.errors import DraxError, require_part, require_whole, shown
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.kernels.linalg import exact
from mjx_drax.kernels.scalarize import pruned
from mjx_drax.method.bounds import LogBarrier, Sides
from mjx_drax.method.metrics import (
    Bounds,
    Diagonal,
    Direction,
    GaussNewton,
    Identity,
    Levels,
    Multipliers,
    at_rest,
    augmented_lagrangian,
    displaced,
)
from mjx_drax.method.quasi_newton import LBFGS
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.problem.checks import require_derivatives
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.problem import Problem, Stagewise, Trajectory, Values, functions_of, numbers

FEASIBLE = 1e-3
"""Largest defect max|h| that counts as feasible."""

EASE, TIGHTEN, SHORT = 1 / 3, 4.0, 0.2
"""Factors of a chain's damping after a full step, and after one shorter than `SHORT`."""

DAMPING = 1e-3, 1e3
"""Range of a chain's factor on the damping."""

SLACK = 1e-2
"""Smallest slack that an inequality starts with."""


@register_dataclass
@dataclass(frozen=True)
class State:
    """What every chain carries; all arrays lead with the chain axis.

    Attributes:
        trajectory: knots, (chains, K, nx) and (chains, K, nu).
        multipliers: lambda, of dynamics (chains, K, ndx) and constraints, and those of bounds.
        damping: factor on delta that the tail adapts, (chains,).
        gains: time-varying LQR feedback of the last factorization, (chains, K, nu, ndx).
        memory: what the metric carries from one iteration to the next; () for most.
        key: random key of each chain, (chains,).
        alive: False from the moment a chain would have turned non-finite, (chains,).
        died_at: iteration at which it did, or -1, (chains,).
    """

    trajectory: Trajectory
    multipliers: Multipliers
    damping: Array
    gains: Array
    memory: Any
    key: Array
    alive: Array
    died_at: Array


@register_dataclass
@dataclass(frozen=True)
class Info:
    """Diagnostics of every chain: cost, max|h| and bound violation, (chains,) each.

    h holds the dynamics' defects and all constraints; inequalities count where positive.
    """

    cost: Array
    max_defect: Array
    max_violation: Array


@register_dataclass
@dataclass(frozen=True)
class Scale:
    """Units that the schedules are multiples of.

    Attributes:
        cost: of mu, delta and rho, which all are costs.
        noise: of sigma, the square root of a cost: sigma^2 is a temperature.
    """

    cost: ArrayLike = 1.0
    noise: ArrayLike = 1.0


@register_dataclass
@dataclass(frozen=True)
class Langevin:
    """The solver: its settings, which are traced, and its interchangeable parts.

    Attributes:
        iterations: iterations with noise.
        tail: noise-free iterations after them.
        step_size: alpha while noise is on.
        noise: schedule of sigma.
        penalty: schedule of mu.
        damping: schedule of delta, added to the diagonal of the cost's Hessian.
        barrier_weight: schedule of rho.
        scale: units of the four schedules; `Restarts` measures them.
        preconditioner: the metric M.
        bounds: how bounds are kept.
        adjusted: Metropolis-adjusted noisy steps (static; with `Identity` only): a chain without
            constraints then samples exp(-c / sigma^2) exactly, whatever the step size.
    """

    iterations: int = 100
    tail: int = 60
    step_size: ArrayLike = 0.3
    noise: Geometric | Constant = Geometric(0.3, 0.01)
    penalty: Geometric | Constant = Geometric(100.0, 1000.0, 1e4)
    damping: Geometric | Constant = Geometric(0.1, 0.1, 0.03)
    barrier_weight: Geometric | Constant = Geometric(0.1, 0.01, 1e-4)
    scale: Scale = field(default_factory=Scale)
    preconditioner: GaussNewton | Diagonal | Identity | LBFGS = field(default_factory=GaussNewton)
    bounds: Bounds = field(default_factory=LogBarrier)
    adjusted: bool = field(default=False, metadata=Static)

    @property
    def flow(self) -> Langevin:
        """The settings of an attempt, as `Restarts` has them: these."""
        return self

    @property
    def noise_ends(self) -> list[int]:
        """After how many iterations the noise ends."""
        return [int(self.iterations)]

    def check(self, problem: Problem) -> None:
        """Complain about settings that cannot work.

        Raises:
            DraxError: naming the setting, its value and the fix.
        """
        for name in ("iterations", "tail"):
            require_whole(name, getattr(self, name), 0)
        if self.iterations + self.tail < 1:
            raise DraxError("iterations + tail is 0: give at least 1.")
        for name in ("noise", "penalty", "damping", "barrier_weight"):
            schedule = getattr(self, name)
            if not callable(schedule) or isinstance(schedule, type):
                number = shown(schedule) if np.isscalar(schedule) else "0.1"
                raise DraxError(
                    f"{name} is {shown(schedule)}: give a schedule, Constant({number})."
                )
        require_part("preconditioner", self.preconditioner, "direction", "GaussNewton()")
        require_part("bounds", self.bounds, "confine", "LogBarrier()")
        if getattr(self.preconditioner, "derivatives", None) is not None:
            by = self.preconditioner.derivatives  # type: ignore[union-attr]
            require_part("preconditioner.derivatives", by, "jacobian", "Autodiff()")
        _check_numbers(self)
        self._check_adjusted(problem)
        self._check_derivatives(problem)

    def forward(self, problem: Problem) -> bool:
        """Whether a problem's functions are differentiated exactly, in forward mode.

        `Identity` and `LBFGS` differentiate in reverse, but feedback gains come after any flow; a
        Metropolis step heeds values, so its costs may have jumps.
        """
        by = getattr(self.preconditioner, "derivatives", None)
        exact = by is None or isinstance(by, Autodiff)
        reverse = isinstance(self.preconditioner, Identity | LBFGS)
        return exact and not self.adjusted and (not reverse or problem.dynamics.nx > 0)

    def _check_derivatives(self, problem: Problem) -> None:
        """Complain about functions of the problem that cannot be differentiated as they will be."""
        by = getattr(self.preconditioner, "derivatives", None)
        if self.adjusted or not (by is None or isinstance(by, Autodiff)):
            return
        dynamics, forward = problem.dynamics, self.forward(problem)
        reverse = isinstance(self.preconditioner, Identity | LBFGS)
        for label, function, arguments, _ in functions_of(problem):
            if function == dynamics.step and (
                dynamics.derivatives is not None or hasattr(dynamics, "mj_model")
            ):
                continue
            twice = forward and label.endswith("cost")
            require_derivatives(label, function, arguments, forward, twice, reverse)

    def _check_adjusted(self, problem: Problem) -> None:
        """The part of `check` that `init` repeats, where counts may be traced."""
        constrained = problem.constraint.inequalities + problem.terminal_constraint.inequalities
        if self.adjusted and (constrained or not isinstance(self.preconditioner, Identity)):
            raise DraxError(
                f"adjusted=True with {type(self.preconditioner).__name__} and {constrained} "
                "inequalities: Metropolis adjustment needs Identity() and no inequalities."
            )
        if self.adjusted and problem.dynamics.nx != problem.dynamics.ndx:
            raise DraxError(
                f"adjusted=True, but states of {problem.name} hold quaternions: Metropolis "
                "adjustment needs a vector space."
            )

    def sigma(self, iteration: int) -> float:
        """The noise that an iteration, from 0, adds; 0 in the tail."""
        if iteration >= self.iterations:
            return 0.0
        return float(_levels(self, iteration / max(self.iterations - 1, 1)).noise)

    def levels(self, t: ArrayLike) -> Levels:
        """The schedules' values at progress t in [0, 2]."""
        t = jnp.asarray(t)
        cost, noise = jnp.asarray(self.scale.cost), jnp.asarray(self.scale.noise)
        return Levels(
            noise * self.noise(t),
            cost * self.penalty(t),
            cost * self.damping(t),
            cost * self.barrier_weight(t),
        )

    def init(self, problem: Problem, trajectory: Trajectory, key: Array) -> State:
        """The first state of a batch of chains that start at the given knots.

        Args:
            problem: the problem.
            trajectory: initial knots, (chains, K, nx) and (chains, K, nu).
            key: one random key; chain c uses fold_in(key, c), so that results do not depend on how
                chains are split over calls or devices.
        """
        self._check_adjusted(problem)
        chains, dynamics = trajectory.x.shape[0], problem.dynamics
        K, nu, ndx = problem.horizon, dynamics.nu, dynamics.ndx
        inside = self._inside(problem, trajectory)
        m, m_end = (
            c.equalities + c.inequalities for c in (problem.constraint, problem.terminal_constraint)
        )
        return State(
            trajectory=inside,
            multipliers=Multipliers(
                jnp.zeros((chains, K, ndx)),
                Stagewise(jnp.zeros((chains, K, m)), jnp.zeros((chains, m_end))),
                self._central(problem, inside, self.levels(0.0)),
            ),
            damping=jnp.ones(chains),
            gains=jnp.zeros((chains, K, nu, ndx)),
            memory=jax.vmap(self.preconditioner.memory, in_axes=(None, 0))(problem, inside),
            key=jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(chains)),
            alive=jnp.ones(chains, bool),
            died_at=jnp.full(chains, -1, int),  # not weakly typed: a second type compiles again
        )

    def moved_to(self, problem: Problem, state: State, trajectory: Trajectory) -> State:
        """The chains with other knots (chains, K, ...), and slacks that go with them."""
        return replace(state, trajectory=self._inside(problem, trajectory))

    def _inside(self, problem: Problem, trajectory: Trajectory) -> Trajectory:
        """Knots (chains, K, ...) with their slack variables, inside the bounds."""

        def inside(knots: Trajectory) -> Trajectory:
            return self.bounds.interior(problem.bounds, _with_slack(problem, knots))

        return jax.vmap(inside)(trajectory)

    def step(
        self, problem: Problem, state: State, iteration: ArrayLike, tail: bool = True
    ) -> State:
        """One iteration of every chain; the schedules are read at `iteration`.

        A caller that knows that there is no tail says so with tail=False (static): the choice
        between noise and line search, which a GPU waits for, is then left out.
        """
        return self.stepped(problem, state, iteration, tail)[0]

    def stepped(
        self,
        problem: Problem,
        state: State,
        iteration: ArrayLike,
        tail: bool = True,
        moves: Array | None = None,
    ) -> tuple[State, Info]:
        """`step`, and diagnostics where it ends, from its line search; zeros from other steps.

        Where `moves` (a traced truth value) is False, the search stands still: the state stays what
        it is, and is diagnosed. Given so, both take one copy of f in a compiled program.
        """
        iteration = jnp.asarray(iteration)
        noisy = iteration < self.iterations
        if moves is not None:
            noisy = noisy & moves
        t = jnp.where(
            noisy,
            iteration / jnp.maximum(self.iterations - 1, 1),
            1.0 + (iteration - self.iterations + 1) / jnp.maximum(self.tail, 1),
        )
        levels = self.levels(t)

        def direction(
            trajectory: Trajectory,
            multipliers: Multipliers,
            damping: Array,
            key: Array,
            memory: Any,
        ) -> Direction:
            return self.preconditioner.direction(
                problem,
                self.bounds,
                trajectory,
                multipliers,
                replace(levels, damping=damping * levels.damping),
                jax.random.fold_in(key, iteration),
                memory,
            )

        present = state.multipliers
        if not tail:  # bounds have multipliers of their own in the tail only
            present = replace(present, bounds=None)

        def directed(state: State) -> Direction:
            return jax.vmap(direction)(
                state.trajectory, present, state.damping, state.key, state.memory
            )

        if moves is None:
            directions = directed(state)
        else:
            directions = jax.lax.cond(moves, directed, partial(_still, problem), state)

        def diffuse(state: State) -> tuple[Trajectory, Array, Info]:
            def move(
                old: Trajectory, multipliers: Multipliers, to: Direction, key: Array
            ) -> Trajectory:
                scale = levels.noise * jnp.sqrt(2.0 * self.step_size)
                change = jax.tree.map(
                    lambda d, n: self.step_size * d + scale * n, to.drift, to.noise
                )
                if not self.adjusted:
                    return self._moved(problem, old, change)
                new = jax.tree.map(jnp.add, old, change)
                back = direction(new, multipliers, jnp.ones(()), key, ()).drift
                ratio = self._log_acceptance(problem, old, new, multipliers, to.drift, back, levels)
                u = jax.random.uniform(jax.random.fold_in(jax.random.fold_in(key, iteration), 1))
                inside = problem.bounds.violation(new) == 0.0
                accepted = (jnp.log(u) < ratio) & inside
                return jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)

            moved = jax.vmap(move)(state.trajectory, state.multipliers, directions, state.key)
            size = jnp.broadcast_to(jnp.asarray(self.step_size), state.alive.shape)
            return moved, size, undiagnosed(state)

        def descend(state: State) -> tuple[Trajectory, Array, Info]:
            def search(
                old: Trajectory, multipliers: Multipliers, to: Direction
            ) -> tuple[Trajectory, Array, Info]:
                def attempt(size: Array) -> tuple[Array, tuple[Trajectory, Array, Info]]:
                    change = jax.tree.map(lambda d: size * d, to.drift)
                    new = self._moved(problem, old, change)
                    values = problem.values(new)
                    merit = augmented_lagrangian(
                        problem, self.bounds, new, multipliers, levels, values
                    )
                    return merit, (new, size, _diagnosed(problem, new, values))

                sizes = jnp.asarray(self.preconditioner.ladder, old.x.dtype)
                merits, candidates = jax.vmap(attempt)(sizes)
                gains = jnp.sum(merits - merits[-1], axis=1)  # the last one stands still
                worst = jnp.finfo(gains.dtype).max  # which it does if nothing else is finite
                gains = jnp.where(sizes > 0.0, gains, worst)
                best = jnp.argmin(jnp.where(jnp.isfinite(gains), gains, jnp.inf))
                return jax.tree.map(lambda z: z[best], candidates)

            return jax.vmap(search)(state.trajectory, state.multipliers, directions)

        if tail:
            trajectory, size, info = jax.lax.cond(noisy, diffuse, descend, state)
        else:
            trajectory, size, info = diffuse(state)
        rate_size = jnp.ones_like(size) if self.preconditioner.multipliers_step_alone else size
        multipliers = jax.tree.map(
            lambda m, rate: m + _per_chain(rate_size, m) * rate,
            replace(state.multipliers, bounds=None),
            directions.multipliers,
        )
        new = replace(
            state,
            trajectory=trajectory,
            multipliers=replace(multipliers, bounds=state.multipliers.bounds),
            gains=directions.gains,
            memory=directions.memory,
        )
        if tail:
            new = self._adapted(problem, state, new, size, levels, noisy)
        return _keep_finite(state, new, iteration, moves), info

    def _adapted(
        self,
        problem: Problem,
        old: State,
        new: State,
        size: Array,
        levels: Levels,
        noisy: Array,
    ) -> State:
        """`new` with the damping and the bounds' multipliers that a tail's iteration leaves."""
        factor = jnp.where(size >= 1.0, EASE, jnp.where(size < SHORT, TIGHTEN, 1.0))
        damping = jnp.clip(factor * old.damping, *DAMPING)
        follow = jax.vmap(self.bounds.follow, in_axes=(None, 0, 0, 0, None, 0))
        of_bounds: Any = old.multipliers.bounds
        knots: tuple[Trajectory, Trajectory] = (old.trajectory, new.trajectory)
        followed = follow(problem.bounds, *knots, of_bounds, levels.barrier, size)
        central = self._central(problem, new.trajectory, levels)
        of_bounds = jax.tree.map(partial(jnp.where, noisy), central, followed)
        return replace(
            new,
            multipliers=replace(new.multipliers, bounds=of_bounds),
            damping=jnp.where(noisy, old.damping, damping),
        )

    def _central(self, problem: Problem, trajectory: Trajectory, levels: Levels) -> Sides:
        """The bounds' multipliers of every chain, on the central path."""
        multipliers = jax.vmap(self.bounds.multipliers, in_axes=(None, 0, None))
        return multipliers(problem.bounds, trajectory, levels.barrier)

    def _log_acceptance(
        self,
        problem: Problem,
        old: Trajectory,
        new: Trajectory,
        multipliers: Multipliers,
        ahead: Trajectory,
        back: Trajectory,
        levels: Levels,
    ) -> Array:
        """log of the Metropolis-Hastings ratio for the density exp(-L_mu / sigma^2), scalar.

        The proposal is z' ~ N(z + alpha d(z), 2 alpha sigma^2 I).
        """
        variance = 2.0 * jnp.asarray(self.step_size) * levels.noise**2

        def merit(z: Trajectory) -> Array:
            return augmented_lagrangian(problem, self.bounds, z, multipliers, levels)

        def log_proposal(z: Trajectory, to: Trajectory, drift: Trajectory) -> Array:
            off = jax.tree.map(lambda a, b, d: b - a - self.step_size * d, z, to, drift)
            return -sum(jnp.sum(jnp.square(a)) for a in jax.tree.leaves(off)) / (2.0 * variance)

        energy = jnp.sum(merit(new) - merit(old)) / levels.noise**2
        return -energy + log_proposal(new, old, back) - log_proposal(old, new, ahead)

    def _moved(self, problem: Problem, old: Trajectory, change: Trajectory) -> Trajectory:
        """The knots `old` moved along a tangent `change`, kept inside the bounds."""
        return self.bounds.confine(problem.bounds, old, displaced(problem, old, change))


_levels = jax.jit(Langevin.levels)


_POSITIVE, _COUNTS = {"floor", "fraction", "radius"}, {"pairs", "inner"}


def _check_numbers(part: Any, prefix: str = "") -> None:
    """Complain about a setting that is no number, or one that makes no sense.

    Raises:
        DraxError: naming the setting, its value and the fix.
    """
    for setting in fields(part):
        value, name = getattr(part, setting.name), prefix + setting.name
        if is_dataclass(value):
            _check_numbers(value, f"{name}.")
        elif setting.name in _COUNTS:
            require_whole(name, value)
        elif value is not None and not callable(value):
            try:
                number = numbers(value)
            except (TypeError, ValueError):
                number = np.array(np.nan)
            positive = setting.name in _POSITIVE
            good = number.shape == () and np.isfinite(number)
            if not good or number < 0 or (positive and number == 0):
                least = "greater than 0" if positive else "of at least 0"
                raise DraxError(f"{name} is {shown(value)}: give a finite number {least}.")
            if setting.name == "fraction" and number >= 1:
                raise DraxError(f"{name} is {shown(value)}: give a share below 1, such as 0.9.")


def _with_slack(problem: Problem, trajectory: Trajectory) -> Trajectory:
    """The knots with slack variables that satisfy g + s = 0 where g <= 0, if there are any g."""
    stage, terminal = problem.constraint, problem.terminal_constraint
    if stage.inequalities + terminal.inequalities == 0:
        return trajectory
    g = problem.constraints(trajectory)
    slack = Stagewise(
        jnp.maximum(-g.stage[:, stage.equalities :], SLACK),
        jnp.maximum(-g.terminal[terminal.equalities :], SLACK),
    )
    return replace(trajectory, slack=slack)


def _per_chain(values: Array, like: Array) -> Array:
    """One value for each chain (chains,), shaped to broadcast against (chains, ...)."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


def _still(problem: Problem, state: State) -> Direction:
    """The direction of chains that stay where they are."""
    drift = jax.vmap(partial(at_rest, problem))(state.trajectory)
    rate = jax.tree.map(jnp.zeros_like, replace(state.multipliers, bounds=None))
    return Direction(drift, drift, rate, state.gains, state.memory)


def _keep_finite(old: State, new: State, iteration: Array, moves: Array | None = None) -> State:
    """The new state, where chains that would turn non-finite, or do not move, stay as they were."""
    names = ("trajectory", "multipliers", "damping", "gains", "memory")
    before, after = ({name: getattr(state, name) for name in names} for state in (old, new))
    pairs = zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True)
    moved = [a for a, b in pairs if a is not b]
    # 0, or NaN where an entry is not finite: one pass over each array, and no array of truth values
    finite = sum(jnp.sum(0.0 * a, axis=tuple(range(1, a.ndim))) for a in moved) == 0.0
    finite = finite if moves is None else finite | ~moves
    alive = old.alive & finite
    new_ones = alive if moves is None else alive & moves
    kept = jax.tree.map(lambda a, b: jnp.where(_per_chain(new_ones, a), a, b), after, before)
    died_at = jnp.where(old.alive & ~finite, iteration, old.died_at)
    return replace(new, alive=alive, died_at=died_at, **kept)


def ranking(cost: ArrayLike, max_defect: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Sort keys of chains (...,), best first: infeasible, then cost, or max|h| if infeasible."""
    defect = np.nan_to_num(np.asarray(max_defect), nan=np.inf)
    infeasible = defect >= FEASIBLE
    return infeasible, np.where(infeasible, defect, np.asarray(cost))


@jax.jit
@exact
def evaluate(problem: Problem, trajectory: Trajectory) -> Info:
    """Cost, max|h| and bound violation of a batch of trajectories."""
    return jax.vmap(lambda z: _diagnosed(problem, z, problem.values(z)))(trajectory)


def _diagnosed(problem: Problem, trajectory: Trajectory, values: Values) -> Info:
    """Cost, max|h| and bound violation of one trajectory, scalars."""
    return Info(values.cost, problem.worst(values), problem.bounds.violation(trajectory))


def undiagnosed(state: State) -> Info:
    """Zeros in the place of diagnostics, (chains,) each."""
    zeros = jnp.zeros(state.alive.shape)
    return Info(zeros, zeros, zeros)


@jax.jit
@exact
def worth(problem: Problem, trajectory: Trajectory) -> tuple[Array, Array]:
    """Cost and bound violation of a batch of trajectories: `evaluate` without compiling f."""
    return jax.vmap(lambda z: (problem.cost(z), problem.bounds.violation(z)))(trajectory)


@partial(jax.jit, static_argnames="tail")
@exact
def advance(
    solver: Langevin,
    problem: Problem,
    state: State,
    start: ArrayLike,
    stop: ArrayLike,
    tail: bool = True,
) -> State:
    """Iterations start..stop-1 of every chain; `tail` as in `Langevin.step`.

    Both ends are traced: any number of iterations runs the same compiled loop, and none at all
    (start = stop) just compiles it.
    """

    @pruned  # jit does it to all but the bodies of loops
    def step(i: Array, state: State) -> State:
        return solver.step(problem, state, i, tail)

    return jax.lax.fori_loop(start, stop, step, state)


@partial(jax.jit, static_argnames="tail")
@exact
def advance_and_evaluate(
    solver: Langevin,
    problem: Problem,
    state: State,
    start: ArrayLike,
    stop: ArrayLike,
    tail: bool = True,
) -> tuple[State, Info]:
    """`advance` and `evaluate`; where f has kinks in one loop, which takes one round more.

    Programs of contact models compile for as long as they are, and most of their length is f.
    """
    if not (tail and problem.dynamics.kinked):
        state = advance(solver, problem, state, start, stop, tail)
        return state, evaluate(problem, state.trajectory)

    @pruned
    def step(i: Array, carry: tuple[State, Info]) -> tuple[State, Info]:
        return solver.stepped(problem, carry[0], i, moves=i < stop)

    return jax.lax.fori_loop(start, jnp.asarray(stop) + 1, step, (state, undiagnosed(state)))


@jax.jit
@exact
def feedback_gains(solver: Langevin, problem: Problem, state: State) -> Array:
    """Time-varying LQR gains (chains, K, nu, ndx) for a solver whose metric brings none."""

    def gains(trajectory: Trajectory, multipliers: Multipliers, key: Array) -> Array:
        levels = solver.levels(2.0)
        to = GaussNewton().direction(problem, solver.bounds, trajectory, multipliers, levels, key)
        return to.gains

    return jax.vmap(gains)(state.trajectory, state.multipliers, state.key)
