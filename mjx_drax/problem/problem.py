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
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from mjx_drax.base.errors import (
    DraxError,
    reason,
    require_positive,
    require_whole,
    shown,
)
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.kernels.linalg import transposed_product
from mjx_drax.kernels.scalarize import pruned
from mjx_drax.problem.checks import require_functions, require_shape, traced
from mjx_drax.problem.differentiators import Differentiator, positive_part
from mjx_drax.problem.dynamics import Dynamics, FunctionDynamics, as_partial

MOST = 1_000_000
"""Most knots of a horizon, and most numbers in a control; more is a mistake of units."""

CLOSE = 0.03
"""Least factor on the scatter of initial knots of chains that start nearer to x_init."""


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
class Values:
    """What the functions of a problem are at a trajectory.

    Attributes:
        costs: l(x_k, u_k) and phi(x_K), (K + 1,).
        defects: h_k, (K, ndx).
        constraints: [equality; inequality], without slack variables.
    """

    costs: Array
    defects: Array
    constraints: Stagewise

    @property
    def cost(self) -> Array:
        """phi(x_K) + sum_k l(x_k, u_k), scalar."""
        return _total(self.costs)


def _total(costs: Array) -> Array:
    """The sum of l(x_k, u_k) and phi(x_K), (K + 1,)."""
    return jnp.sum(costs[:-1]) + costs[-1]


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
                return jnp.asarray(scalar(*at(dz)), float)  # also a plain number

            slope, _ = by.jacobian(lambda dz: value(dz)[None], size, key)
            gradient = gradient + slope[0]
            hessian = hessian + positive_part(by.hessian(value, size))
        if self.residual is not None:
            residual = self.residual
            jacobian, r = by.jacobian(lambda dz: jnp.ravel(residual(*at(dz))), size, key)
            gradient = gradient + transposed_product(jacobian, r)
            hessian = hessian + transposed_product(jacobian, jacobian)
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
        near: whether every second chain starts nearer to x_init than the scatter; where f has kinks
            or states hold quaternions all do anyway.
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
    near: bool = field(default=False, metadata=Static)

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

    def costs(self, trajectory: Trajectory) -> Array:
        """l(x_k, u_k) and phi(x_K), (K + 1,)."""
        running = jax.vmap(self.running_cost)(self.stages(trajectory), trajectory.u)
        return jnp.append(running, self.terminal_cost(trajectory.x[-1]))

    def cost(self, trajectory: Trajectory) -> Array:
        """phi(x_K) + sum_k l(x_k, u_k), scalar."""
        return _total(self.costs(trajectory))

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

    def values(self, trajectory: Trajectory) -> Values:
        """All of them at once."""
        return Values(
            self.costs(trajectory), self.defects(trajectory), self.constraints(trajectory)
        )

    def max_defect(self, trajectory: Trajectory) -> Array:
        """max|h| over dynamics and constraints (inequalities count where positive), scalar."""
        return self.worst(self.values(trajectory))

    def worst(self, values: Values) -> Array:
        """max|h| of values that are known, scalar."""
        defect = jnp.abs(values.defects).max(initial=0.0)
        stage = self.constraint.violation(values.constraints.stage)
        end = self.terminal_constraint.violation(values.constraints.terminal)
        return jnp.maximum(defect, jnp.maximum(stage, end))

    def draw(self, key: Array) -> Trajectory:
        """Random initial knots for one chain; they need not be feasible.

        They are drawn from the scatter box. Where f has kinks, bodies overlap far from x_init and
        forces lose all measure; what floats freely may tumble at any speed. There the box is shrunk
        towards x_init and the middle of the controls, for each chain by another factor from `CLOSE`
        to 1, uniform in its logarithm. With `near` it is for every second chain: strong motors in
        light arms need that, while motions that lead far away are found from afar.
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
        all_near = dynamics.kinked or dynamics.nx != dynamics.ndx
        if self.near or all_near:
            power = jax.random.uniform(jax.random.fold_in(key, 2))
            share = CLOSE ** (power if all_near else jnp.maximum(2.0 * power - 1.0, 0.0))
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
                f"goal failed at x = {shown(x.tolist())}: {reason(error)}. Make it a function of "
                "the state of a function problem, or of the mujoco.MjData of a model."
            ) from error
        if reached.size != 1 or reached.dtype.kind not in "biuf":
            raise DraxError(
                f"goal returned shape {reached.shape}, {shown(reached)}: it must return one truth "
                "value."
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
        require_positive(label, value, "a positive number of seconds")
    share = float(horizon) / float(dt)
    if share <= 0.5:
        raise DraxError(
            f"horizon is {horizon} s, shorter than one control step: give at least {dt:g} s."
        )
    if share >= MOST:
        raise DraxError(
            f"horizon is {horizon} s, which is {share:.3g} control steps of {dt:g} s: give less "
            f"than {MOST:,} steps."
        )
    return round(share)


def _pair(label: str, ends: Any) -> tuple[ArrayLike, ArrayLike]:
    """(lower, upper) as given, or infinite for None."""
    if ends is None:
        return -np.inf, np.inf
    try:
        lower, upper = ends
    except (TypeError, ValueError) as error:
        raise DraxError(
            f"bounds of {label} are {shown(ends)}: give a pair (lower, upper)."
        ) from error
    return lower, upper


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
            array = numbers(value)
            if np.isnan(array).any():
                raise ValueError("NaN is no bound")
            return jnp.asarray(np.broadcast_to(array, (*array.shape[:-1], size)))
        except (TypeError, ValueError) as error:
            raise DraxError(
                f"{label} is {shown(value)}: give numbers of shape ({size},), or one for all; -inf "
                "and inf leave it free."
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
        out = traced(f"{label}{name}", function, arguments)
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
        DraxError: sizes, bounds, functions or numbers that do not fit, named one by one; a function
            that computes something else when it is traced again.
    """
    require_functions(
        f=f,
        running_cost=running_cost,
        terminal_cost=terminal_cost,
        running_residual=running_residual,
        terminal_residual=terminal_residual,
        equality=equality,
        inequality=inequality,
        terminal_equality=terminal_equality,
        terminal_inequality=terminal_inequality,
        goal=goal,
        guess=guess,
    )
    if f is None:
        raise DraxError("f is None: give the dynamics, a function f(x, u) -> x_next.")
    require_whole("nu", nu)
    if nu > MOST:
        raise DraxError(f"nu is {nu}, the size of a control: give at most {MOST:,}.")
    require_name(name)
    K = knots(horizon, dt)
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
            horizon=K,
        )
    )


def require_name(name: object) -> None:
    """Complain about a name that is no text.

    Raises:
        DraxError: naming its value.
    """
    if not isinstance(name, str) or not name:
        raise DraxError(f"name is {shown(name)}: give a text.")


def numbers(value: ArrayLike) -> np.ndarray:
    """Real numbers as float64.

    Raises:
        TypeError, ValueError: they are none, or lists of different lengths.
    """
    array = np.asarray(value)
    if array.dtype.kind in "USc":  # strings would be parsed, imaginary parts dropped
        raise TypeError(f"{array.dtype} holds no real numbers")
    try:
        return np.asarray(array, float)
    except OverflowError as error:  # of Python's own whole numbers
        raise ValueError(str(error)) from error


def vector(label: str, value: ArrayLike) -> Array:
    """A finite float vector (n,), or a DraxError that says what was given."""
    if isinstance(value, jax.core.Tracer):
        raise DraxError(
            f"{label} is traced, so its numbers cannot be checked: use "
            f"dataclasses.replace(problem, {label}=...) inside of JAX functions."
        )
    try:
        array = numbers(value)
    except (TypeError, ValueError) as error:
        raise DraxError(f"{label} is {shown(value)}: give a vector of numbers.") from error
    with np.errstate(over="ignore"):  # a number that float32 cannot hold becomes infinite
        out = jnp.asarray(array)
    if array.ndim != 1 or not np.isfinite(out).all():
        raise DraxError(f"{label} is {shown(value)}: give a vector of finite numbers.")
    return out


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

    @jax.jit
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
    if not isinstance(problem, Problem):
        raise DraxError(
            f"the problem is {shown(problem)}: give one from from_mjcf or from_function."
        )
    dynamics, name = problem.dynamics, problem.name
    nx, nu = dynamics.nx, dynamics.nu
    if nu < 1:
        raise DraxError(f"{name} has {nu} controls: a problem needs at least one; add an actuator.")
    require_whole("the number of knots, horizon,", problem.horizon)
    start = np.asarray(problem.x_init)
    if start.dtype.kind != "f" or not np.isfinite(start).all():
        raise DraxError(f"x_init is {shown(start)}: give a vector of finite floats.")
    if start.shape != (nx,):
        raise DraxError(
            f"x_init has shape {start.shape}: give {nx} numbers, the states of the dynamics."
        )
    _check_bounds(problem, start)
    costs = (problem.running, problem.terminal)
    if all(part is None for cost in costs for part in (cost.scalar, cost.residual)):
        raise DraxError(f"{name} has no cost: give a running or a terminal one.")
    for label, function, arguments, shape in functions_of(problem):
        if function != dynamics.step or not hasattr(dynamics, "mj_model"):  # MJX's takes a second
            require_shape(label, function, arguments, shape)
    _check_guess(problem)
    problem.reached(np.asarray(problem.x_init, float))
    return problem


def _check_bounds(problem: Problem, start: np.ndarray) -> None:
    """The part of `checked` for bounds, the box of initial knots, and x_init (nx,) in them."""
    dynamics, bounds, scatter = problem.dynamics, problem.bounds, problem.scatter
    for label, size, ends in (
        ("x", dynamics.nx, (bounds.x_lower, bounds.x_upper)),
        ("u", dynamics.nu, (bounds.u_lower, bounds.u_upper)),
        ("scatter of x", dynamics.nx, (scatter.x_lower, scatter.x_upper)),
        ("scatter of u", dynamics.nu, (scatter.u_lower, scatter.u_upper)),
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
        outside = np.maximum(low - start, start - high).max(initial=0.0)
        if outside > 1e-6:
            raise DraxError(
                f"x_init = {shown(start.tolist())} lies outside the bounds of x by {outside:.3g}: "
                "move it inside, or widen the bounds."
            )


def functions_of(
    problem: Problem,
) -> list[tuple[str, Callable[..., Any], tuple[Any, ...], tuple[int, ...] | None]]:
    """The functions of a problem: label, function, what it is called with, and shape if known.

    What it is called with has shapes and no values.
    """
    dynamics, dtype = problem.dynamics, problem.x_init.dtype
    x, u = (jax.ShapeDtypeStruct((size,), dtype) for size in (dynamics.nx, dynamics.nu))
    found: list[Any] = [("the dynamics f(x, u)", dynamics.step, (x, u), (dynamics.nx,))]
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
