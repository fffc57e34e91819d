"""The optimal control problem, and the knot points that answer it.

    min  phi(x_K) + sum_k l(x_k, u_k)    s.t.  x_{k+1} = f(x_k, u_k),  x_0 = x_init,
                                               x_lower <= x_k <= x_upper,  u_lower <= u_k <= u_upper

(equation 1 of the paper, with bounds). k runs over 0..K-1 for controls and 1..K for the states that
are solved for. There is no hidden factor dt: a running cost is summed over knots as it stands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial, register_dataclass
from numpy.typing import ArrayLike

from mjx_drax.derivatives import Differentiator, positive_part
from mjx_drax.dynamics import Dynamics, FunctionDynamics, Static, as_partial
from mjx_drax.errors import DraxError
from mjx_drax.scalar import pruned

CLOSE = 0.03
"""Smallest factor on the scatter of initial knots where f has kinks or states quaternions."""


@register_dataclass
@dataclass(frozen=True)
class Stagewise:
    """Numbers that go with constraints: for the stages (..., K, m) and for the end (..., m_end)."""

    stage: Array
    terminal: Array


@register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """Knot points: states x_1..x_K (..., K, nx) and controls u_0..u_{K-1} (..., K, nu).

    What a chain carries also has the slack variables s >= 0 of inequalities; a trajectory that a
    user gives does not.
    """

    x: Array
    u: Array
    slack: Stagewise | None = None


@register_dataclass
@dataclass(frozen=True)
class Box:
    """Ends of states, (nx,) or (K, nx), and of controls, (nu,) or (K, nu); infinite if free."""

    x_lower: Array
    x_upper: Array
    u_lower: Array
    u_upper: Array

    def sides(self, trajectory: Trajectory) -> tuple[Trajectory, Trajectory]:
        """The lower and the upper end for every knot of a trajectory, as two trajectories."""
        x, u = trajectory.x, trajectory.u
        zeros = jax.tree.map(jnp.zeros_like, trajectory.slack)
        infinite = jax.tree.map(lambda s: jnp.full_like(s, jnp.inf), trajectory.slack)

        def side(of_x: Array, of_u: Array, of_slack: Stagewise | None) -> Trajectory:
            return Trajectory(
                jnp.broadcast_to(of_x, x.shape), jnp.broadcast_to(of_u, u.shape), of_slack
            )

        lower = side(self.x_lower, self.u_lower, zeros)
        upper = side(self.x_upper, self.u_upper, infinite)
        return lower, upper

    def violation(self, trajectory: Trajectory) -> Array:
        """Largest distance by which any knot leaves the box, 0 if none does, scalar."""
        lower, upper = self.sides(trajectory)
        out = jax.tree.map(
            lambda z, a, b: jnp.maximum((a - z).max(initial=0.0), (z - b).max(initial=0.0)),
            trajectory,
            lower,
            upper,
        )
        return jnp.maximum(out.x, out.u)


@register_dataclass
@dataclass(frozen=True)
class Cost:
    """scalar(...) + 1/2 |residual(...)|^2, either part optional.

    A residual is the better way to give a cost: its Gauss-Newton Hessian J'J is positive
    semidefinite by construction and needs first derivatives only.
    """

    scalar: Partial | None
    residual: Partial | None

    def __call__(self, *arguments: Any) -> Array:
        """The cost, a scalar."""
        total = jnp.zeros(())
        if self.scalar is not None:
            total = total + self.scalar(*arguments)
        if self.residual is not None:
            total = total + 0.5 * jnp.sum(jnp.square(self.residual(*arguments)))
        return total

    def expand(
        self, at: Callable[[Array], tuple[Any, ...]], size: int, by: Differentiator, key: Array
    ) -> tuple[Array, Array]:
        """Gradient (n,) and positive semidefinite Hessian (n, n) in local coordinates.

        `at(dz)` gives the cost's arguments a displacement dz (n,) away from the knot. The residual
        contributes J'r and J'J; the scalar its gradient, and its Hessian with negative eigenvalues
        set to zero.
        """
        gradient, hessian = jnp.zeros(size), jnp.zeros((size, size))
        if self.scalar is not None:
            scalar = self.scalar

            def value(dz: Array) -> Array:
                return scalar(*at(dz))

            slope, _ = by.jacobian(lambda dz: value(dz)[None], size, key)
            gradient = gradient + slope[0]
            hessian = hessian + positive_part(by.hessian(value, size))
        if self.residual is not None:
            residual = self.residual
            jacobian, r = by.jacobian(lambda dz: jnp.ravel(residual(*at(dz))), size, key)
            gradient = gradient + jacobian.T @ r
            hessian = hessian + jacobian.T @ jacobian
        return gradient, hessian


@register_dataclass
@dataclass(frozen=True)
class Constraint:
    """equality(...) = 0 and inequality(...) <= 0, either part optional; rows in that order."""

    equality: Partial | None
    inequality: Partial | None
    equalities: int = field(metadata=Static)
    inequalities: int = field(metadata=Static)

    def __call__(self, *arguments: Any) -> Array:
        """Both parts in one vector, (equalities + inequalities,)."""
        parts = [p for p in (self.equality, self.inequality) if p is not None]
        return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(p(*arguments)) for p in parts)])

    def with_slack(self, values: Array, slack: Array) -> Array:
        """The equality constraints [equality; inequality + slack], for values (..., m)."""
        inequality = values[..., self.equalities :] + slack
        return jnp.concatenate([values[..., : self.equalities], inequality], axis=-1)

    def violation(self, values: Array) -> Array:
        """Largest |equality| or positive inequality, scalar; 0 without constraints."""
        equality = jnp.abs(values[..., : self.equalities]).max(initial=0.0)
        return jnp.maximum(equality, values[..., self.equalities :].max(initial=0.0))


@dataclass(frozen=True)
class Aside:
    """What a problem carries for use outside of compiled computations.

    All compare equal: another goal or name does not recompile.
    """

    goal: Callable[[Any], Any] | None
    guess: Callable[[Array], Trajectory] | None
    name: str

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Aside)

    def __hash__(self) -> int:
        return hash(Aside)


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
        x_init: x_0, (nx,).
        bounds: the box that every knot must keep to.
        scatter: the box that initial knots are drawn from, uniformly.
        aside: goal, guess and name, which no compiled computation reads.
        horizon: K, number of control knots.
    """

    dynamics: Dynamics
    running: Cost
    terminal: Cost
    constraint: Constraint
    terminal_constraint: Constraint
    x_init: Array
    bounds: Box
    scatter: Box
    aside: Aside = field(metadata=Static)
    horizon: int = field(metadata=Static)

    @property
    def goal(self) -> Callable[[Any], Any] | None:
        """What a replay must reach: a test of dynamics.observe_replayed(x_K), or None."""
        return self.aside.goal

    @property
    def guess(self) -> Callable[[Array], Trajectory] | None:
        """Draws the initial knots of one chain from a key, instead of `scatter`; or None."""
        return self.aside.guess

    @property
    def name(self) -> str:
        """What files and tables call it."""
        return self.aside.name

    @property
    def times(self) -> np.ndarray:
        """Times of x_0..x_K, (K + 1,) [s]."""
        return float(self.dynamics.dt) * np.arange(self.horizon + 1)

    # Of all that `observe` computes, these four keep what their readers read

    @pruned
    def running_cost(self, x: Array, u: Array) -> Array:
        """l(x, u), scalar."""
        return self.running(self.dynamics.observe(x, u), u)

    @pruned
    def terminal_cost(self, x: Array) -> Array:
        """phi(x), scalar."""
        return self.terminal(self.dynamics.observe(x, jnp.zeros(self.dynamics.nu)))

    @pruned
    def running_constraint(self, x: Array, u: Array) -> Array:
        """Constraints at a stage, [equality; inequality], (m,)."""
        return self.constraint(self.dynamics.observe(x, u), u)

    @pruned
    def end_constraint(self, x: Array) -> Array:
        """Constraints at the end, [equality; inequality], (m_end,)."""
        return self.terminal_constraint(self.dynamics.observe(x, jnp.zeros(self.dynamics.nu)))

    def with_start(self, trajectory: Trajectory) -> Array:
        """x_0..x_K, (..., K + 1, nx): the states with x_init in front."""
        x = jnp.asarray(trajectory.x)
        start = jnp.broadcast_to(self.x_init, (*x.shape[:-2], 1, x.shape[-1]))
        return jnp.concatenate([start, x], axis=-2)

    def stages(self, trajectory: Trajectory) -> Array:
        """x_0..x_{K-1} (K, nx): the states that the controls act on."""
        return self.with_start(trajectory)[:-1]

    def cost(self, trajectory: Trajectory) -> Array:
        """phi(x_K) + sum_k l(x_k, u_k), scalar."""
        running = jax.vmap(self.running_cost)(self.stages(trajectory), trajectory.u)
        return jnp.sum(running) + self.terminal_cost(trajectory.x[-1])

    def defects(self, trajectory: Trajectory) -> Array:
        """h_k = f(x_k, u_k) - x_{k+1} in the tangent space at x_{k+1}, (K, ndx)."""

        def defect(x: Array, u: Array, x_next: Array) -> Array:
            return self.dynamics.difference(self.dynamics.step(x, u), x_next)

        return jax.vmap(defect)(self.stages(trajectory), trajectory.u, trajectory.x)

    def constraints(self, trajectory: Trajectory) -> Stagewise:
        """Values [equality; inequality] at the stages (K, m) and at the end (m_end,)."""
        stages = jax.vmap(self.running_constraint)(self.stages(trajectory), trajectory.u)
        return Stagewise(stages, self.end_constraint(trajectory.x[-1]))

    def with_slack(self, values: Stagewise, slack: Stagewise) -> Stagewise:
        """The equality constraints [equality; inequality + slack]."""
        return Stagewise(
            self.constraint.with_slack(values.stage, slack.stage),
            self.terminal_constraint.with_slack(values.terminal, slack.terminal),
        )

    def max_defect(self, trajectory: Trajectory) -> Array:
        """max|h| over dynamics and constraints (inequalities count where positive), scalar."""
        values = self.constraints(trajectory)
        defect = jnp.abs(self.defects(trajectory)).max(initial=0.0)
        stage = self.constraint.violation(values.stage)
        return jnp.maximum(
            defect, jnp.maximum(stage, self.terminal_constraint.violation(values.terminal))
        )

    def draw(self, key: Array) -> Trajectory:
        """Random initial knots for one chain; they need not be feasible.

        They are drawn from the scatter box. Where f has kinks, bodies overlap far from x_init and
        forces lose all measure; what floats freely may tumble at any speed. There the box is shrunk
        towards x_init and the middle of the controls, for each chain by another factor from `CLOSE`
        to 1, uniform in its logarithm.
        """
        if self.guess is not None:
            knots = self.guess(key)
            return replace(knots, x=self.dynamics.valid(jnp.asarray(knots.x)))
        key_x, key_u = jax.random.split(key)
        box, dynamics = self.scatter, self.dynamics
        x = jax.random.uniform(key_x, (self.horizon, dynamics.nx))
        u = jax.random.uniform(key_u, (self.horizon, dynamics.nu))
        x = box.x_lower + x * (box.x_upper - box.x_lower)
        u = box.u_lower + u * (box.u_upper - box.u_lower)
        if dynamics.kinked or dynamics.nx != dynamics.ndx:
            share = CLOSE ** jax.random.uniform(jax.random.fold_in(key, 2))
            middle = 0.5 * (box.u_lower + box.u_upper)
            x, u = self.x_init + share * (x - self.x_init), middle + share * (u - middle)
        return Trajectory(dynamics.valid(x), u)

    def replay(
        self, plan: ArrayLike, u: ArrayLike, gains: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """`Dynamics.replay` within the control bounds, from numbers of any precision.

        Args:
            plan: planned states x_0..x_K, (chains, K + 1, nx).
            u: planned controls, (chains, K, nu).
            gains: feedback K_k, (chains, K, nu, ndx); zeros replay open loop.
        """
        limits = np.asarray(self.bounds.u_lower, float), np.asarray(self.bounds.u_upper, float)
        plan, u, gains = (np.asarray(given, float) for given in (plan, u, gains))
        return self.dynamics.replay(plan, u, gains, limits)

    def reached(self, x: np.ndarray) -> bool | None:
        """Whether a replay that ends at x (nx,) reaches the goal; None without a goal.

        Raises:
            DraxError: the goal fails, or returns more than one truth value.
        """
        if self.goal is None:
            return None
        try:
            reached = np.asarray(self.goal(self.dynamics.observe_replayed(x)))
        except Exception as error:
            raise DraxError(
                f"goal failed at x = {x.tolist()}: {type(error).__name__}: {error}. It gets the "
                "state of a function problem, or the mujoco.MjData of a model."
            ) from error
        if reached.size != 1 or reached.dtype.kind not in "biuf":
            raise DraxError(
                f"goal returned shape {reached.shape}, {reached!r}: it must return one truth value."
            )
        return bool(reached.item() == reached.item() and reached.item())  # NaN is not reached

    def with_x_init(self, x_init: ArrayLike) -> Problem:
        """The same problem from another initial state (nx,)."""
        return checked(replace(self, x_init=vector("x_init", x_init)))


def knots(horizon: float, dt: float) -> int:
    """K = horizon / dt, rounded: the number of control knots in a horizon [s] at a step dt [s].

    Raises:
        DraxError: dt or the horizon is not a positive number, or the horizon is shorter than dt.
    """
    for label, value in (("dt", dt), ("horizon", horizon)):
        if not (isinstance(value, float | int | np.number) and np.isfinite(value) and value > 0):
            raise DraxError(f"{label} is {value!r}: give a positive number of seconds.")
    count = round(horizon / dt)
    if count < 1:
        raise DraxError(
            f"horizon is {horizon} s, shorter than one control step: give at least {dt:g} s."
        )
    return count


def _pair(label: str, ends: Any) -> tuple[ArrayLike, ArrayLike]:
    """(lower, upper) as given, or infinite for None."""
    if ends is None:
        return -np.inf, np.inf
    if not isinstance(ends, tuple | list | np.ndarray) or len(ends) != 2:
        raise DraxError(f"bounds of {label} are {ends!r}: give a pair (lower, upper).")
    return ends[0], ends[1]


def box(
    nx: int,
    nu: int,
    x: tuple[ArrayLike, ArrayLike] | None = None,
    u: tuple[ArrayLike, ArrayLike] | None = None,
) -> Box:
    """A box from (lower, upper) pairs, scalars or arrays that broadcast to (nx,) and (nu,).

    A side that is None is free.
    """

    def end(value: ArrayLike, size: int, label: str) -> Array:
        try:
            array = np.asarray(value, float)
            return jnp.asarray(np.broadcast_to(array, (*array.shape[:-1], size)))
        except (TypeError, ValueError) as error:
            raise DraxError(
                f"{label} is {value!r}: give numbers of shape ({size},), or one for all."
            ) from error

    (xl, xu), (ul, uu) = _pair("x", x), _pair("u", u)
    return Box(
        end(xl, nx, "lower end of x"),
        end(xu, nx, "upper end of x"),
        end(ul, nu, "lower end of u"),
        end(uu, nu, "upper end of u"),
    )


def cost_of(cost: Callable[..., Any] | None, residual: Callable[..., Any] | None) -> Cost:
    """A Cost from the functions that a user gives; either or both may be None."""
    return Cost(
        None if cost is None else as_partial(cost),
        None if residual is None else as_partial(residual),
    )


def constraint_of(
    equality: Callable[..., Any] | None,
    inequality: Callable[..., Any] | None,
    arguments: tuple[Any, ...],
    label: str = "",
) -> Constraint:
    """A Constraint from the functions that a user gives; their sizes are traced abstractly."""
    sizes = []
    for name, function in (("equality", equality), ("inequality", inequality)):
        if function is None:
            sizes.append(0)
            continue
        out = _traced(f"{label}{name}", function, arguments)
        sizes.append(int(np.prod(out.shape)))
    parts = [None if f is None else as_partial(f) for f in (equality, inequality)]
    return Constraint(parts[0], parts[1], sizes[0], sizes[1])


def constraints_of(
    dynamics: Dynamics,
    equality: Callable[..., Any] | None,
    inequality: Callable[..., Any] | None,
    terminal_equality: Callable[..., Any] | None,
    terminal_inequality: Callable[..., Any] | None,
) -> tuple[Constraint, Constraint]:
    """The constraints of the stages and of the end."""
    x, u = jnp.zeros(dynamics.nx), jnp.zeros(dynamics.nu)
    seen = jax.eval_shape(dynamics.observe, x, u)
    return (
        constraint_of(equality, inequality, (seen, u)),
        constraint_of(terminal_equality, terminal_inequality, (seen,), "terminal_"),
    )


def from_function(
    f: Callable[[Array, Array], Array],
    *,
    x_init: ArrayLike,
    nu: int,
    dt: float,
    horizon: float,
    running_cost: Callable[..., Any] | None = None,
    terminal_cost: Callable[..., Any] | None = None,
    running_residual: Callable[..., Any] | None = None,
    terminal_residual: Callable[..., Any] | None = None,
    equality: Callable[..., Any] | None = None,
    inequality: Callable[..., Any] | None = None,
    terminal_equality: Callable[..., Any] | None = None,
    terminal_inequality: Callable[..., Any] | None = None,
    x_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    u_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    x_scatter: tuple[ArrayLike, ArrayLike] | None = None,
    u_scatter: tuple[ArrayLike, ArrayLike] | None = None,
    goal: Callable[[Any], Any] | None = None,
    guess: Callable[[Array], Trajectory] | None = None,
    name: str = "problem",
) -> Problem:
    """A problem whose dynamics are a JAX function f(x (nx,), u (nu,)) -> x_next (nx,).

    Args:
        f: the dynamics. Parameters that should stay changeable without recompiling are bound with
            `jax.tree_util.Partial`; the same holds for the costs.
        x_init: x_0, (nx,).
        nu: size of a control.
        dt: control step [s].
        horizon: duration [s]; K = horizon / dt knots, rounded.
        running_cost: l(x, u), a scalar, summed over the knots as it stands.
        terminal_cost: phi(x), a scalar.
        running_residual: r(x, u) (n,): adds 1/2 |r|^2 to the running cost.
        terminal_residual: r(x) (n,): adds 1/2 |r|^2 to the terminal cost.
        equality: c(x, u) (m,), held at 0 at every stage k = 0..K-1.
        inequality: g(x, u) (m,), held <= 0 at every stage.
        terminal_equality: c(x) (m,), held at 0 at x_K.
        terminal_inequality: g(x) (m,), held <= 0 at x_K.
        x_bounds: (lower, upper) on every x_k, k >= 1.
        u_bounds: (lower, upper) on every u_k.
        x_scatter: box from which initial states are drawn; by default the bounds, and within
            +-1 of x_init where those are infinite.
        u_scatter: the same for controls; within +-1 of 0 where the bounds are infinite.
        goal: goal(x_K) -> bool, what a replay must reach.
        guess: guess(key) -> Trajectory, instead of the scatter boxes.
        name: used in files and tables.

    Raises:
        DraxError: sizes, bounds, functions or numbers that do not fit, named one by one.
    """
    x_init = vector("x_init", x_init)
    nx = x_init.shape[0]
    bounds = box(nx, nu, x_bounds, u_bounds)
    dynamics = FunctionDynamics(as_partial(f), dt, nx, nu)
    constraint, terminal_constraint = constraints_of(
        dynamics, equality, inequality, terminal_equality, terminal_inequality
    )
    return checked(
        Problem(
            dynamics=dynamics,
            running=cost_of(running_cost, running_residual),
            terminal=cost_of(terminal_cost, terminal_residual),
            constraint=constraint,
            terminal_constraint=terminal_constraint,
            x_init=x_init,
            bounds=bounds,
            scatter=scatter_box(bounds, x_init, jnp.ones(nx), x_scatter, u_scatter),
            aside=Aside(goal, guess, name),
            horizon=knots(horizon, dt),
        )
    )


def vector(label: str, value: ArrayLike) -> Array:
    """A finite float vector (n,), or a DraxError that says what was given."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise DraxError(f"{label} is {value!r}: give a vector of numbers.") from error
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise DraxError(f"{label} is {value!r}: give a vector of finite numbers.")
    return jnp.asarray(array)


def scatter_box(
    bounds: Box,
    x_init: Array,
    reach: Array,
    x: tuple[ArrayLike, ArrayLike] | None,
    u: tuple[ArrayLike, ArrayLike] | None,
) -> Box:
    """The box for initial knots: what is asked for, else the bounds, else x_init +- reach (nx,)."""
    nx, nu = x_init.shape[0], bounds.u_lower.shape[-1]
    given = box(nx, nu, x, u)

    def ends(
        asked: tuple[Array, Array], bound: tuple[Array, Array], middle: Array, reach: Array
    ) -> tuple[Array, Array]:
        low, high = (jnp.where(jnp.isfinite(a), a, b) for a, b in zip(asked, bound, strict=True))
        # Where an end is free: next to the other one, or about the middle if both are.
        middle = jnp.clip(middle, low + reach, high - reach)
        return (
            jnp.where(jnp.isfinite(low), low, middle - reach),
            jnp.where(jnp.isfinite(high), high, middle + reach),
        )

    x_ends = ends((given.x_lower, given.x_upper), (bounds.x_lower, bounds.x_upper), x_init, reach)
    u_ends = ends(
        (given.u_lower, given.u_upper),
        (bounds.u_lower, bounds.u_upper),
        jnp.zeros(nu),
        jnp.ones(nu),
    )
    return Box(x_ends[0], x_ends[1], u_ends[0], u_ends[1])


def checked(problem: Problem) -> Problem:
    """The problem, if sizes, bounds and functions fit together; traced abstractly, not compiled.

    Raises:
        DraxError: naming the cause, the value seen and the fix.
    """
    dynamics, bounds = problem.dynamics, problem.bounds
    nx, nu = dynamics.nx, dynamics.nu
    if nu < 1:
        raise DraxError(f"{problem.name} has {nu} controls: a problem needs at least one actuator.")
    if problem.x_init.shape != (nx,):
        raise DraxError(
            f"x_init has shape {problem.x_init.shape}, the dynamics have states of shape ({nx},)."
        )
    for label, lower, upper in (
        ("x", bounds.x_lower, bounds.x_upper),
        ("u", bounds.u_lower, bounds.u_upper),
        ("scatter of x", problem.scatter.x_lower, problem.scatter.x_upper),
        ("scatter of u", problem.scatter.u_lower, problem.scatter.u_upper),
    ):
        size = nx if label.endswith("x") else nu
        for end in (lower, upper):
            if end.shape not in ((size,), (problem.horizon, size)):
                raise DraxError(
                    f"bounds of {label} have shape {end.shape}: give numbers of shape ({size},), "
                    f"or ({problem.horizon}, {size}) for each knot."
                )
        crossed = np.argwhere(~(np.asarray(lower) <= np.asarray(upper)))
        if crossed.size:
            i = tuple(int(j) for j in crossed[0])
            raise DraxError(
                f"bounds of {label} cross at element {i[-1]}: lower {float(lower[i])}, "
                f"upper {float(upper[i])}. Give lower <= upper."
            )
    below, above = bounds.x_lower - problem.x_init, problem.x_init - bounds.x_upper
    outside = float(jnp.maximum(below, above).max(initial=0.0))
    if bounds.x_lower.ndim == bounds.x_upper.ndim == 1 and outside > 1e-6:
        raise DraxError(
            f"x_init = {np.asarray(problem.x_init).tolist()} lies outside the bounds of x by "
            f"{outside:.3g}: move it inside, or widen the bounds."
        )
    if all(
        part is None
        for cost in (problem.running, problem.terminal)
        for part in (cost.scalar, cost.residual)
    ):
        raise DraxError(f"{problem.name} has no cost: give a running or a terminal one.")
    u = jax.ShapeDtypeStruct((nu,), problem.x_init.dtype)
    x = jax.ShapeDtypeStruct((nx,), problem.x_init.dtype)
    _check_shape("the dynamics f(x, u)", dynamics.step, (x, u), (nx,))
    observed = jax.eval_shape(dynamics.observe, x, u)
    for label, part, arguments in (
        ("running_cost", problem.running.scalar, (observed, u)),
        ("terminal_cost", problem.terminal.scalar, (observed,)),
    ):
        if part is not None:
            _check_shape(label, part, arguments, ())
    for label, part, arguments in (
        ("running_residual", problem.running.residual, (observed, u)),
        ("terminal_residual", problem.terminal.residual, (observed,)),
    ):
        if part is not None:
            _check_shape(label, part, arguments, None)
    problem.reached(np.asarray(problem.x_init, float))
    return problem


def _check_shape(
    label: str,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    shape: tuple[int, ...] | None,
) -> None:
    """Trace a user's function abstractly; complain if it fails or returns another shape."""
    seen = _traced(label, function, arguments).shape
    if shape is not None and seen != shape:
        expected = "a scalar" if shape == () else f"shape {shape}"
        hint = " (a vector cost goes in as a residual)" if shape == () else ""
        raise DraxError(f"{label} returned shape {seen}, but must return {expected}{hint}.")


def _traced(label: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Shape and dtype of what a user's function returns, which must be one array of floats."""
    try:
        out = jax.eval_shape(function, *arguments)
    except DraxError:
        raise
    except Exception as error:
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise DraxError(
            f"{label} failed when it was traced: {type(error).__name__}: {reason}. It must be a "
            "JAX function of its arguments (jax.numpy, no Python branches on values)."
        ) from error
    if getattr(out, "shape", None) is None or not jnp.issubdtype(out.dtype, jnp.floating):
        raise DraxError(f"{label} returned {out}: it must return one array of floats.")
    return out
