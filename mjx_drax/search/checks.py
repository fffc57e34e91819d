"""What is asked before a solve: whether settings and functions can work.

Settings are looked at; functions are traced, and tried at the initial knots, with derivatives.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, DraxWarning, require_part, require_whole, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.kernels.pruning import pruned
from mjx_drax.method.bounds import Bounds
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.metrics import Identity, Metric
from mjx_drax.method.schedules import Scale
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.problem import STEP, Problem, functions_of
from mjx_drax.problem.tracing import require_derivatives
from mjx_drax.problem.trajectory import Box, Knot, Trajectory
from mjx_drax.search.iterate import FEASIBLE

_POSITIVE, _COUNTS = {"floor", "fraction", "radius"}, {"pairs", "inner"}

FAR = 1e6
"""So many times as far as initial knots reach only what runs away gets."""


def check_flow(flow: Langevin, problem: Problem) -> None:
    """Complain about settings of a flow that cannot work.

    Raises:
        DraxError: naming the setting, its value and the fix.
    """
    for name in ("iterations", "tail"):
        require_whole(name, getattr(flow, name), 0)
    if flow.iterations + flow.tail < 1:
        raise DraxError("iterations + tail is 0: give at least 1.")
    for name in ("noise", "penalty", "damping", "barrier_weight"):
        schedule = getattr(flow, name)
        if not callable(schedule) or isinstance(schedule, type):
            number = shown(schedule) if np.isscalar(schedule) else "0.1"
            raise DraxError(f"{name} is {shown(schedule)}: give a schedule, Constant({number}).")
        _require_registered(name, schedule)
    _check_part("preconditioner", flow.preconditioner, Metric, "direction", "GaussNewton()")
    _check_part("bounds", flow.bounds, Bounds, "confine", "LogBarrier()")
    by = flow.preconditioner.derivatives
    if by is not None:
        require_part("preconditioner.derivatives", by, "jacobian", "Autodiff()")
        _require_registered("preconditioner.derivatives", by)
    _check_numbers(flow)
    _check_adjusted(flow, problem)
    _check_derivatives(flow, problem)


def _check_part(name: str, part: Any, base: type, method: str, example: str) -> None:
    """Complain about a part that is none, or a user's own that is not made as ours are."""
    require_part(name, part, method, example)
    if not isinstance(part, base):
        wanted = f"mjx_drax.{base.__name__}"
        raise DraxError(f"{name} is {shown(part)}: make its class inherit {wanted}.")
    _require_registered(name, part)


def _require_registered(name: str, part: Any) -> None:
    """Complain about a part that a compiled function could not take, or a file not hold."""
    if not is_dataclass(part) or jax.tree_util.all_leaves([part]):
        raise DraxError(
            f"{name} is {shown(part)}, no registered dataclass: make its class one, with "
            "@mjx_drax.register_dataclass and @dataclass(frozen=True)."
        )


def _check_numbers(part: Any, prefix: str = "") -> None:
    """Complain about a setting of ours that is no number, or one that makes no sense."""
    ours = type(part).__module__.startswith("mjx_drax.")
    for setting in fields(part):
        value, name = getattr(part, setting.name), prefix + setting.name
        if is_dataclass(value):
            _check_numbers(value, f"{name}.")
        elif not ours:  # what numbers of a user's own part mean is not known here
            continue
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


def _check_adjusted(flow: Langevin, problem: Problem) -> None:
    constrained = problem.constraint.inequalities + problem.terminal_constraint.inequalities
    if flow.adjusted and (constrained or not isinstance(flow.preconditioner, Identity)):
        raise DraxError(
            f"adjusted=True with {type(flow.preconditioner).__name__} and {constrained} "
            "inequalities: Metropolis adjustment needs Identity() and no inequalities."
        )
    if flow.adjusted and problem.dynamics.nx != problem.dynamics.ndx:
        raise DraxError(
            f"adjusted=True, but states of {problem.name} hold quaternions: Metropolis "
            "adjustment needs a vector space."
        )


def _in_reverse(flow: Langevin) -> bool:
    """Whether the metric differentiates L_mu in reverse mode."""
    return flow.preconditioner.derivatives is None


def _exactly(flow: Langevin) -> bool:
    """Whether functions are differentiated, not sampled."""
    return _in_reverse(flow) or isinstance(flow.preconditioner.derivatives, Autodiff)


def _in_forward(flow: Langevin, problem: Problem) -> bool:
    """Whether a problem's functions are differentiated exactly, in forward mode.

    Feedback gains are, after a flow in reverse mode too; a Metropolis step heeds values, so its
    costs may have jumps.
    """
    gains = problem.dynamics.nx > 0
    return _exactly(flow) and not flow.adjusted and (not _in_reverse(flow) or gains)


def _check_derivatives(flow: Langevin, problem: Problem) -> None:
    """Complain about functions of the problem that cannot be differentiated as they will be."""
    if flow.adjusted or not _exactly(flow):
        return
    dynamics, forward, reverse = problem.dynamics, _in_forward(flow, problem), _in_reverse(flow)
    for label, function, arguments, _ in functions_of(problem):
        if label == STEP and dynamics.checked:
            continue
        twice = forward and label.endswith("cost")
        require_derivatives(label, function, arguments, forward, twice, reverse)


def require_finite(
    flow: Langevin, problem: Problem, knots: Trajectory, cost: Array, max_defect: Array
) -> None:
    """Complain if no chain could possibly start; cost and max|h| are (chains,)."""
    for label, values in (("cost", cost), ("dynamics", max_defect)):
        if not np.isfinite(values).any():
            require_sound(flow, problem, knots)
            raise DraxError(
                f"the {label} of {problem.name} is {float(values[0])} at the initial knots of "
                f"every chain ({len(values)} tried): make it finite there (no 0/0, no log or sqrt "
                "of negative numbers), or narrow the scatter of the initial knots."
            )


def require_sound(
    flow: Langevin,
    problem: Problem,
    knots: Trajectory,
    with_f: bool = True,
    alone: bool = False,
) -> None:
    """Complain about a function that is finite, with its derivatives, for no chain's knots.

    Those of a stage are tried at x_init, where every chain stays, and its first control; those of
    the end at its last state.

    Args:
        flow, problem: as solved.
        knots: initial ones of every chain, (chains, K, ...).
        with_f: whether f is tried.
        alone: whether it is the only problem that is solved.

    Raises:
        DraxError: naming the function, where it fails and the fix.

    Warns:
        DraxWarning: alone, it has an x_init that breaks a constraint, whatever the controls are.
    """
    flow = replace(flow, scale=Scale())  # of one type, measured or not
    stages, end = _starts(flow, problem, knots)
    finite, constraints = _finite(problem, stages, end, _in_forward(flow, problem), with_f)
    for label, what, good in _by_function(problem, finite):
        if not good.any():
            at, move = "the initial points", "the scatter of initial points"
            if problem.dynamics.nx:
                at = "the last initial state" if label.startswith("terminal") else "x_init"
                move = "x_init or the scatter of initial knots"
            if (label, what) in _finite_in_float64(flow, problem, knots, with_f):
                raise DraxError(
                    f"the {what} of {label} is not finite at {at} in float32, whose numbers end "
                    "at 3e38, but in float64: give precision=64, or measure in other units, so "
                    "that powers of large numbers stay below that."
                )
            raise DraxError(
                f"the {what} of {label} is not finite at {at} for any of {len(good)} chains: "
                "change it (no 0/0, no log or sqrt of 0; sqrt(y + 1e-6) has a derivative), or "
                f"move {move}."
            )
    if alone and problem.start_map is None:
        u = np.asarray(stages)[:, 0, problem.dynamics.nx :]
        at_start = {n: a for n, a in constraints.items() if not n.startswith("terminal")}
        _warn_of_start(u, {name: np.asarray(a)[:, 0] for name, a in at_start.items()})


def _finite_in_float64(
    flow: Langevin, problem: Problem, knots: Trajectory, with_f: bool
) -> set[tuple[str, str]]:
    """What of which functions is finite for a chain's knots in float64; nothing if that fails."""
    if problem.precision == 64:
        return set()
    try:
        double = problem.in_float64()
        with double.arithmetic():
            wide = jax.tree.map(lambda a: jnp.asarray(a, float), knots)
            starts = _starts(flow, double, wide)
            finite, _ = _finite(double, *starts, _in_forward(flow, double), with_f)
            return {(f, what) for f, what, good in _by_function(double, finite) if good.any()}
    except Exception:  # a user's functions may be made for float32
        return set()


def _warn_of_start(u: np.ndarray, constraints: dict[str, np.ndarray]) -> None:
    """Warn of constraints (chains, m) at x_init that are broken alike by all controls (chains, nu).

    Where chains share a control, it may be what breaks them.
    """
    if not np.ptp(u, axis=0).all():
        return
    for name, values in constraints.items():
        by = np.abs(values[0]) if name == "equality" else values[0]
        broken = (by > FEASIBLE) & (values == values[0]).all(axis=0)
        if broken.any():
            row = int(broken.argmax())
            warnings.warn(
                f"x_init breaks {name} [{row}] by {by[row]:.3g}, whatever the controls are, so no "
                "plan is feasible: move x_init, or let the constraint hold later only (`between`).",
                DraxWarning,
                stacklevel=2,
            )


@jax.jit
def _starts(flow: Langevin, problem: Problem, knots: Trajectory) -> tuple[Array, Array]:
    """x_init and last states, each beside the first control, (chains, 1, nx + nu)."""
    interior = partial(flow.bounds.interior, problem.plan_bounds)
    inside = jax.vmap(interior)(replace(knots, slack=None))
    u = inside.u[:, :1]
    start = jnp.broadcast_to(problem.x_init, (*u.shape[:2], problem.dynamics.nx))
    last = inside.x[:, -1:]
    return jnp.concatenate([start, u], axis=-1), jnp.concatenate([last, u], axis=-1)


def require_alive(flow: Langevin, problem: Problem, knots: Trajectory, died_at: np.ndarray) -> None:
    """Complain about a function that is not finite, or has no finite derivative, where chains died.

    Args:
        flow, problem: as solved.
        knots: the last finite ones of every chain, (chains, K, ...).
        died_at: iteration at which each turned non-finite, (chains,).

    Raises:
        DraxError: naming the function, the knot and the fix, if there is one for every chain.
    """
    stages = jnp.concatenate([problem.with_start(knots)[:, :-1], knots.u], axis=-1)
    end = jnp.concatenate([knots.x[:, -1:], knots.u[:, -1:]], axis=-1)
    finite, _ = _finite(problem, stages, end, _in_forward(flow, problem))
    for label, what, good in _by_function(problem, finite):
        if not good.all(axis=1).any():
            k = int(np.argmin(good[0]))
            at = "the last state" if label.startswith("terminal") else f"knot {k}"
            grown = ""
            fix = (
                "change it (no 0/0, no log or sqrt of what may be 0 or negative; sqrt(y + 1e-6) "
                "has a derivative), or bound the states and controls to where it is finite"
            )
            largest = float(jnp.abs(end if label.startswith("terminal") else stages).max())
            if largest > FAR * float(_largest(problem.scatter)):
                grown = f", where states or controls have grown to {largest:.1g}"
                fix = (
                    "the cost may have no least value, or f may not stay finite. Bound states and "
                    "controls"
                )
            raise DraxError(
                f"the {what} of {label} is not finite at {at}, of all {len(good)} chains after "
                f"at most {int(died_at.max()) + 1} iterations{grown}: {fix}."
            )


def _largest(box: Box) -> Array:
    """The largest of all ends that are finite; 1 if that is less."""
    ends = (jnp.where(jnp.isfinite(end), jnp.abs(end), 0.0) for end in jax.tree.leaves(box))
    return jnp.max(jnp.stack([jnp.ones(()), *(end.max(initial=0.0) for end in ends)]))


def _by_function(
    problem: Problem, finite: dict[str, list[Array]]
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Label, what of it, and whether that is finite, of all that `_finite` has tried."""
    names = "value", "derivative", "second derivative"
    for label, *_ in functions_of(problem):
        for what, good in zip(names, finite.get(label, []), strict=False):
            yield label, what, np.asarray(good)


@partial(jax.jit, static_argnames=("exact", "with_f"))
def _finite(
    problem: Problem, stages: Array, end: Array, exact: bool, with_f: bool = True
) -> tuple[dict[str, list[Array]], dict[str, Array]]:
    """Whether functions, first and second derivatives are finite at z = [x, u], (chains, n) each.

    Derivatives are taken in one direction that moves every number. Also the values of constraints,
    (chains, n, m).

    Args:
        problem: whose functions.
        stages, end: z of functions of a stage, and of the end, (chains, n, nx + nu).
        exact: whether derivatives are tried.
        with_f: whether f is tried.
    """
    found, constraints = {}, {}
    knots = problem.knots
    for label, _, arguments, _ in functions_of(problem):
        if label == STEP and not with_f:
            continue
        at_end = len(arguments) == 1
        order = (2 if label.endswith("cost") else 1) if exact else 0
        z = end if at_end else stages
        which = slice(-1, None) if at_end else slice(z.shape[1])
        one = partial(_slopes_at, problem, label, order)
        orders = jax.vmap(jax.vmap(one), in_axes=(0, None))(z, knots.at(which))
        found[label] = [
            jnp.isfinite(each).reshape(*each.shape[:2], -1).all(axis=-1) for each in orders
        ]
        if label.endswith("equality"):
            constraints[label] = orders[0].reshape(*orders[0].shape[:2], -1)
    return found, constraints


def _slopes_at(problem: Problem, label: str, order: int, z: Array, knot: Knot) -> tuple[Array, ...]:
    """A function of a problem at z = [x, u] and a knot, and its derivatives along (1, ..., 1)."""
    here = problem.at(knot)
    _, function, arguments, _ = next(f for f in functions_of(problem, knot) if f[0] == label)

    def value(z: Array) -> Array:
        x, u = jnp.split(z, [here.dynamics.nx])
        if label == STEP:
            return here.dynamics.step(x, u)
        seen = here.seen(x, u) if len(arguments) == 2 else here.seen(x)
        return jnp.asarray(function(*seen), float)

    return _with_slopes(pruned(value), order)(z)


def _with_slopes(
    function: Callable[[Array], Array], order: int
) -> Callable[[Array], tuple[Array, ...]]:
    """The function and its derivatives along (1, ..., 1), up to an order."""
    if order == 0:
        return lambda z: (function(z),)
    lower = _with_slopes(function, order - 1)

    def slopes(z: Array) -> tuple[Array, ...]:
        values, changes = jax.jvp(lower, (z,), (jnp.ones_like(z),))
        return *values, changes[-1]

    return slopes
