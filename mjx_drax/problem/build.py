"""Problems from functions."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, DraxWarning, require_positive, require_whole, shown
from mjx_drax.base.numbers import vector
from mjx_drax.problem.choices import Choices, extend, phases_of
from mjx_drax.problem.cost import as_partial, constraint_of, cost_of, takes_knot
from mjx_drax.problem.data import require_rows, rows
from mjx_drax.problem.dynamics import Dynamics, FunctionDynamics
from mjx_drax.problem.problem import Problem, checked
from mjx_drax.problem.tracing import require_functions
from mjx_drax.problem.trajectory import Box, Knot, Trajectory, box

MOST = 1_000_000
"""Most knots of a horizon, and most numbers in a control; more is a mistake of units."""

OFF_KNOT = 0.01
"""Share of a step by which an event may be off its knot without a word."""


def knots_in(horizon: Any, dt: float) -> int:
    """K = horizon / dt, rounded: the number of control knots in a horizon [s] at a step dt [s].

    Warns:
        DraxWarning: the horizon is no multiple of dt.
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
    K = round(share)
    if abs(share - K) > 1e-6 * K:
        warnings.warn(
            f"horizon is {horizon:g} s, no multiple of dt = {dt:g} s: the plan has {K} knots and "
            f"lasts {K * dt:g} s. Give that horizon, or another dt.",
            DraxWarning,
            stacklevel=3,
        )
    return K


def steps(horizon: Any, dt: float | None, count: Any) -> tuple[int, float]:
    """K and dt of a fixed horizon [s], from the one of them that must be given."""
    if (dt is None) == (count is None):
        raise DraxError(f"dt is {dt} and knots is {count}: give one of the two.")
    if dt is not None:
        return knots_in(horizon, dt), dt
    require_whole("knots", count)
    require_positive("horizon", horizon, "a positive number of seconds")
    return int(count), float(horizon) / int(count)


def of_phases(phases: tuple[tuple[float, float, int], ...]) -> tuple[int, float]:
    """K, and the mean step in the middle of the bounds [s]."""
    K = sum(count for *_, count in phases)
    return K, 0.5 * sum(least + most for least, most, _ in phases) / K


def from_function(
    f: Callable[..., Array] | Dynamics,
    *,
    x_init: ArrayLike,
    nu: int,
    horizon: float | tuple[float, float] | Sequence[tuple[float, float]],
    dt: float | None = None,
    knots: int | Sequence[int] | None = None,
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
    x_init_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    parameters: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    rates: int = 0,
    rate_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    u_init: ArrayLike | None = None,
    data: Any = None,
    goal: Callable[[Any], Any] | None = None,
    guess: Callable[[Array], Trajectory] | None = None,
    x_names: Sequence[str] = (),
    u_names: Sequence[str] = (),
    name: str = "problem",
) -> Problem:
    """A problem whose dynamics are a JAX function f(x (nx,), u (nu,)) -> x_next (nx,).

    f, costs, residuals and constraints may have a parameter `knot` besides; it receives the `Knot`:
    its time, its number and its data.

    Args:
        f: the dynamics. Parameters that should stay changeable without recompiling are bound with
            `jax.tree_util.Partial`; the same holds for the costs.
        x_init: x_0, (nx,).
        nu: size of a control.
        horizon: duration [s]; or (least, most) of a free one, or a list of such pairs for phases.
        dt: control step [s]; K = horizon / dt knots, rounded with a warning. Where the duration
            is free, f takes its step from `knot.dt`.
        knots: K, instead of dt; for phases the number of each.
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
        x_init_bounds: (lower, upper) of x_0, which is free where they differ; `knot.x_init`
            is what was chosen.
        parameters: {name: (lower, upper)} of numbers that are chosen once for the whole motion;
            functions read `knot.parameters[name]`.
        rates: 1 if functions read `knot.rate`, (u_k - u_{k-1}) / dt; 2 if `knot.jerk` as well.
        rate_bounds: (lower, upper) of the rate [unit of u / s].
        u_init: u_{-1}, (nu,); without it the first rate is 0.
        x_scatter: box from which initial states are drawn; by default the bounds, and within
            +-1 of x_init where those are infinite.
        u_scatter: the same for controls; within +-1 of 0 where the bounds are infinite.
        data: numbers for each knot: arrays (K + 1, ...) in any pytree, or a function of a knot's
            time [s] that returns one. Functions with a parameter `knot` read them there.
        goal: goal(x_K) -> bool, what a replay must reach.
        guess: guess(key) -> Trajectory, instead of the scatter boxes.
        x_names, u_names: names of the entries of states and controls, such as "angle [rad]", for
            tables, plots and errors; a class of dynamics has them as attributes instead.
        name: used in files and tables.

    Raises:
        DraxError: sizes, bounds, functions or numbers that do not fit, named one by one; a function
            that computes something else when it is traced again.
    """
    given = {
        "running_cost": running_cost,
        "terminal_cost": terminal_cost,
        "running_residual": running_residual,
        "terminal_residual": terminal_residual,
        "equality": equality,
        "inequality": inequality,
        "terminal_equality": terminal_equality,
        "terminal_inequality": terminal_inequality,
    }
    require_functions(**given, goal=goal, guess=guess)
    if f is None:
        raise DraxError("f is None: give the dynamics, a function f(x, u) -> x_next.")
    if nu == 0:
        raise DraxError(
            "nu is 0: give a whole number of at least 1. What is left to choose without controls, "
            "as parameters, needs one that f does not read; a cost on it keeps it at 0."
        )
    require_whole("nu", nu)
    if nu > MOST:
        raise DraxError(f"nu is {nu}, the size of a control: give at most {MOST:,}.")
    require_name(name)
    phases = phases_of(horizon, knots)
    K, dt = of_phases(phases) if phases else steps(horizon, dt, knots)
    start = vector("x_init", x_init)
    nx = start.shape[0]
    bounds = box(nx, nu, x_bounds, u_bounds)
    named = {"x_names": _names("x_names", x_names, nx), "u_names": _names("u_names", u_names, nu)}
    if isinstance(f, Dynamics):
        dynamics = f
        if phases and type(f).at is Dynamics.at:
            raise DraxError(
                f"the horizon is free, and {type(f).__name__} always takes the same step: give it "
                "a method at(knot), which returns the same system with dt = knot.dt."
            )
        if not phases and not np.isclose(dt, float(f.dt), rtol=1e-6):
            raise DraxError(
                f"knots are {dt:.6g} s apart by dt, horizon and knots, and the step of "
                f"{type(f).__name__} is {float(f.dt):.6g} s: give the same."
            )
        for label, value in named.items():
            if value:
                raise DraxError(
                    f"{label} is given, and {type(f).__name__} is a class of dynamics: set {label} "
                    "in the class."
                )
    else:
        require_functions(f=f)
        if phases and not takes_knot(f):
            raise DraxError(
                "the horizon is free, and f has no parameter knot: take the step from it, "
                "f(x, u, knot) with knot.dt."
            )
        dynamics = FunctionDynamics(as_partial(f), dt, nx, nu, **named)
    scatter = scatter_box(bounds, start, jnp.ones(nx), x_scatter, u_scatter)
    near = 1.0 if dynamics.kinked or dynamics.nx != dynamics.ndx else 0.0
    choices = Choices(x_init_bounds, parameters, phases, rates, u_init, rate_bounds)
    return assembled(
        dynamics,
        given,
        start,
        bounds,
        scatter,
        K,
        near,
        data,
        choices,
        goal=goal,
        guess=guess,
        name=name,
    )


def from_dynamics(dynamics: Dynamics, *, x_init: ArrayLike, horizon: float, **rest: Any) -> Problem:
    """A problem with dynamics of your own.

    Args:
        dynamics: an object of a class that inherits `Dynamics`.
        x_init: x_0, (nx,).
        horizon: duration [s].
        rest: the costs, constraints, bounds and other arguments of `from_function`.

    Raises:
        DraxError: as `from_function`.
    """
    if not isinstance(dynamics, Dynamics):
        raise DraxError(
            f"dynamics is {shown(dynamics)}: give an object of a class that inherits "
            "mjx_drax.Dynamics, or a function to mjx_drax.from_function."
        )
    if jax.tree_util.all_leaves([dynamics]):
        raise DraxError(
            f"{type(dynamics).__name__} is no pytree: decorate the class with "
            "@mjx_drax.register_dataclass and @dataclass(frozen=True)."
        )
    return from_function(
        dynamics, x_init=x_init, nu=dynamics.nu, dt=dynamics.dt, horizon=horizon, **rest
    )


def assembled(
    dynamics: Dynamics,
    given: dict[str, Callable[..., Any] | None],
    x_init: Array,
    bounds: Box,
    scatter: Box,
    horizon: int,
    near: float,
    data: Any,
    choices: Choices,
    **host: Any,
) -> Problem:
    """A problem from its parts, checked.

    Args:
        dynamics, x_init: f and x_0, (nx,).
        given: the user's costs, residuals and constraints, by the names of `from_function`.
        bounds, scatter: of knots, and of initial ones.
        horizon: K.
        near: share of chains that start nearer to x_init.
        data: for each knot, as a user gives it.
        choices: what is left open.
        host: goal, guess and name.
    """
    times = float(dynamics.dt) * np.arange(horizon + 1)
    found = rows(data, times)
    first = jax.tree.map(lambda a: a[0], found)
    earliest, latest = (
        _knots_of(choices.phases, end) if choices.phases else times for end in (0, 1)
    )
    for label, function in given.items():
        for node in _checking_knots(None if function is None else as_partial(function)):
            node.check_knots(label, latest)
            if getattr(node, "once", False):
                (_warn_if_skipped if choices.phases else _warn_if_between)(node, label, earliest)
    if choices.phases:
        require_rows(data)
    free: tuple[tuple[int, ...], ...] = ()
    if choices.any:
        parts = extend(choices, dynamics, given, x_init, bounds, scatter)
        dynamics, given, x_init, bounds, scatter, free = parts
    x, u, t_init = jnp.zeros(dynamics.nx), jnp.zeros(dynamics.nu), jnp.zeros(())
    zero, dt = jnp.zeros((), int), jnp.asarray(dynamics.dt, float)
    here = Knot(t_init, zero, dt, first, x_init, stage=zero)
    seen = jax.eval_shape(dynamics.at(here).observe, x, u)
    stage = given["equality"], given["inequality"]
    end = given["terminal_equality"], given["terminal_inequality"]
    return checked(
        Problem(
            dynamics=dynamics,
            running=cost_of(given["running_cost"], given["running_residual"]),
            terminal=cost_of(given["terminal_cost"], given["terminal_residual"]),
            constraint=constraint_of(*stage, (seen, u), here),
            terminal_constraint=constraint_of(*end, (seen,), here, "terminal_"),
            x_init=x_init,
            bounds=bounds,
            scatter=scatter,
            horizon=horizon,
            near=near,
            free=free,
            data=found,
            t_init=t_init,
            data_at=data if callable(data) else None,
            **host,
        )
    )


def _knots_of(phases: Sequence[tuple[float, float, int]], end: int) -> np.ndarray:
    """Times of x_0..x_K [s] if durations are the least (end 0), or the most (1)."""
    steps = [np.full(phase[2], phase[end] / phase[2]) for phase in phases]
    return np.append(0.0, np.cumsum(np.concatenate(steps)))


def _checking_knots(part: Any) -> Iterator[Any]:
    """All references and windows in a function, which complain if knots do not fit."""
    for node in jax.tree.leaves(part, is_leaf=lambda n: n is not part and _checks_knots(n)):
        if _checks_knots(node):
            yield node
            yield from _checking_knots(node)


def _checks_knots(node: Any) -> bool:
    return hasattr(node, "check_knots")


def _warn_if_between(node: Any, label: str, times: np.ndarray) -> None:
    """Warn where the time of an event is none of a knot."""
    begin, step = float(node.begin), times[1] - times[0]
    nearest = times[np.abs(times - begin).argmin()]
    if abs(nearest - begin) > OFF_KNOT * step:
        warnings.warn(
            f"{label} is asked for at {begin:g} s, between two knots, and holds at the nearest, at "
            f"{nearest:g} s. Choose a dt of which the time is a multiple.",
            DraxWarning,
            stacklevel=4,
        )


def _warn_if_skipped(node: Any, label: str, times: np.ndarray) -> None:
    """Warn where a motion as short as it may be, with knots at `times`, ends before an event."""
    try:
        node.check_knots(label, times)
    except DraxError as error:
        warnings.warn(
            f"in the shortest motion {error} There it asks nothing: give a longer least duration, "
            "or see in solution.times whether the motion lasted so long.",
            DraxWarning,
            stacklevel=4,
        )


def _names(label: str, names: Sequence[str], count: int) -> tuple[str, ...]:
    """Names of the entries of a vector, all different; () if none are given."""
    given = (names,) if isinstance(names, str) else tuple(names)
    texts = all(isinstance(name, str) and name.strip() for name in given)
    if given and not (texts and len(set(given)) == len(given) == count):
        raise DraxError(f"{label} is {shown(names)}: give {count} different text(s), or none.")
    return given


def require_name(name: object) -> None:
    """Complain about a name that is no text."""
    if not isinstance(name, str) or not name:
        raise DraxError(f"name is {shown(name)}: give a text.")


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

    x_ends = _ends((given.x_lower, given.x_upper), (bounds.x_lower, bounds.x_upper), x_init, reach)
    u_ends = _ends(
        (given.u_lower, given.u_upper),
        (bounds.u_lower, bounds.u_upper),
        jnp.zeros(nu),
        jnp.ones(nu),
    )
    return Box(x_ends[0], x_ends[1], u_ends[0], u_ends[1])


@jax.jit
def _ends(
    asked: tuple[Array, Array], bound: tuple[Array, Array], middle: Array, reach: Array
) -> tuple[Array, Array]:
    """Lower and upper ends of `scatter_box`, for states or for controls."""
    low, high = (jnp.where(jnp.isfinite(a), a, b) for a, b in zip(asked, bound, strict=True))
    # Where an end is free: next to the other one, or about the middle if both are.
    middle = jnp.clip(middle, low + reach, high - reach)
    return (
        jnp.where(jnp.isfinite(low), low, middle - reach),
        jnp.where(jnp.isfinite(high), high, middle + reach),
    )
