"""How far a motion breaks what is asked of it: kind by kind, how much, which entry, at which knot.

A *kind* is the goal, tracking of the plan (where there is no goal), the bounds of states and of
controls, equality and inequality constraints at the stages and at the end, and the dynamics (of a
plan; a replay obeys them). A violation is tolerated up to a number in the user's units that
`Tolerances` gives, or else up to a share of a scale that is the problem's own, so that units do not
matter. The scales come from the *extent* E of the planned motion, in each coordinate of states and
controls the distance between its largest and its least value over the knots; or how far it is from
coasting, where controls are 0 or next to it, if that is less: a satellite that is to move by 1 m is
not to be judged by its orbit. A coordinate that hardly moves has the extent `STILL` of the box that
initial knots are scattered over.

    kind              scale
    tracking          E
    bounds            width of the box, at most `WIDE` E; E where a side is infinite
    constraints g     root mean square of the change of g, where the knot moves by +-E in all
                      coordinates at once, for random signs; to first order |E dg/dz|

So a constraint is kept, to first order, if moving the knot by the share of the motion's extent
could mend it; and not if it is off by more than the share `SPAN` of the largest |g| that there is
along the motion, or would be if its states came in another order: a stiff contact force changes by
many times a limit. A stage constraint is one of (x_k, u_k), k = 0..K-1, and x_0 is given.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, DraxWarning, require_not_negative, shown
from mjx_drax.base.numbers import numbers
from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.kernels.pruning import needed_program
from mjx_drax.physics.dynamics import mjx_dynamics
from mjx_drax.physics.engine import mujoco
from mjx_drax.problem.choices import rated_controls
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory
from mjx_drax.search.family import Family
from mjx_drax.search.fitting import NARROWER, WIDER
from mjx_drax.search.iterate import FEASIBLE, identity_of_rows, joined
from mjx_drax.solution.names import control_names, difference_names, state_names

GOAL, TRACKING, DYNAMICS = "goal", "tracking", "dynamics"
INEQUALITY = "inequality"

MEASURED = (
    TRACKING,
    "state_bounds",
    "control_bounds",
    "equality",
    INEQUALITY,
    "terminal_equality",
    "terminal_inequality",
)
"""The kinds that have a tolerance."""

KINDS = (GOAL, *MEASURED, DYNAMICS)

STILL = 1e-2
"""Least extent, as a share of the width of the scatter box; of 1 where the box has no width."""

WIDE = 10.0
"""A box that is wider than so many times the motion's extent counts as that wide."""

SPAN, LEAST = 0.1, 0.02
"""Tolerances of constraints are at most the share `SPAN` of the row's largest value, but at least
`LEAST` of what they would be without this: a row that asks for what holds anyway is always 0."""

ROUNDED = 0.1
"""Rounding of states above this share of what is tolerated is told."""

FEW = 3
"""So many entries are named."""

NOTHING, LOOSE = 1e-3, 4.0
"""What x_init lacks at the end, in multiples of what is tolerated: nothing, or little, below."""

MOVE, DIRECTIONS = 1e-2, 16
"""Share of the extent by which knots are moved to see how constraints change, and how often."""

Tolerance = float | Sequence[float] | None
Limits = tuple[tuple[Array, ...], Array, Array]
"""Tolerances of each kind in `MEASURED`, the relative one, and `STILL`."""


@dataclass(frozen=True)
class Tolerances:
    """Which violations of a replay are tolerated, for each kind of requirement.

    Attributes:
        relative: where a kind has no number of its own: share of the scale that the problem itself
            gives it, from the box that bounds it or from the size of the motion (`violations`).
        tracking: without a goal: |x_K - plan| of each coordinate of the tangent space.
        state_bounds, control_bounds: distance from the box, of each entry.
        equality, inequality, terminal_equality, terminal_inequality: |h| and positive g, each row.

    All but `relative` are in the user's units: one number, one for each entry, or None.

    Raises:
        DraxError: what is no number, or below 0.
    """

    relative: float = 5e-3
    tracking: Tolerance = None
    state_bounds: Tolerance = None
    control_bounds: Tolerance = None
    equality: Tolerance = None
    inequality: Tolerance = None
    terminal_equality: Tolerance = None
    terminal_inequality: Tolerance = None

    def __post_init__(self) -> None:
        require_not_negative("relative of the tolerances", self.relative)
        for kind in MEASURED:
            value = getattr(self, kind)
            if value is None:
                continue
            try:
                array = numbers(value)
            except (TypeError, ValueError):
                array = np.array(np.nan)
            if array.ndim > 1 or not (np.isfinite(array) & (array >= 0)).all():
                raise DraxError(
                    f"the tolerance of {words(kind)} is {shown(value)}: give a number of at least "
                    "0 in your units, one for each entry, or None."
                )
            plain = array.item() if array.ndim == 0 else tuple(array.tolist())
            object.__setattr__(self, kind, plain)

    def of(self, problem: Problem) -> tuple[np.ndarray, ...]:
        """Tolerances of all entries of each kind in `MEASURED`, NaN where they are relative.

        Raises:
            DraxError: another number of tolerances than the problem has entries.
        """
        found = []
        for kind, entries in zip(MEASURED, _sizes(problem), strict=True):
            value = getattr(self, kind)
            given = np.asarray(np.nan if value is None else value, float)
            if given.ndim and len(given) != entries:
                raise DraxError(
                    f"the tolerances of {words(kind)} are {len(given)} numbers: give {entries}, or "
                    f"one for all entries of {problem.name}."
                )
            found.append(np.broadcast_to(given, (entries,)))
        return tuple(found)


def as_tolerances(given: Tolerances | None) -> Tolerances:
    """The tolerances, if they are such; the default ones for None."""
    if given is None:
        return Tolerances()
    if not isinstance(given, Tolerances):
        raise DraxError(
            f"tolerances are {shown(given)}: give mjx_drax.Tolerances(...); tolerance, singular, "
            "is for the residual."
        )
    return given


def _sizes(problem: Problem) -> tuple[int, ...]:
    """Number of entries of each kind in `MEASURED`."""
    dynamics, stage, end = problem.dynamics, problem.constraint, problem.terminal_constraint
    return (
        dynamics.ndx,
        dynamics.nx,
        dynamics.nu,
        stage.equalities,
        stage.inequalities,
        end.equalities,
        end.inequalities,
    )


def words(kind: str) -> str:
    """A kind as a text says it."""
    return kind.replace("_", " ")


class Violation(NamedTuple):
    """One violation: in the user's units, what is tolerated there, which entry, at which knot.

    Entry and knot are -1 where there is none to name, as for a goal.
    """

    kind: str
    size: float
    allowed: float
    entry: int
    knot: int

    @property
    def broken(self) -> bool:
        """Whether it is more than is tolerated."""
        return self.size > self.allowed

    @property
    def ratio(self) -> float:
        """Its size in multiples of what is tolerated; infinite where nothing is, 0 if it is 0."""
        if not self.size:
            return 0.0
        return self.size / self.allowed if self.allowed else np.inf

    def told(self, problem: Problem) -> str:
        """What is broken, by how much, where and when, in words."""
        by = f"by {self.size:.1e} (tolerated: {self.allowed:.1e})"
        if self.kind == GOAL:
            return "misses the goal"
        if self.knot < 0:
            return f"breaks the {words(self.kind)} {by}"
        at = f" at knot {self.knot}" if problem.dynamics.nx else ""  # a program has none
        if at and not problem.dynamics.phases:  # else each chain has times of its own
            at += f", {problem.times[self.knot]:.3g} s"
        name = entry_name(problem, self.kind, self.entry)
        if self.kind == TRACKING:
            return f"ends off the plan in {name} {by}"
        if self.kind.endswith("bounds"):
            return f"leaves the bounds of {name} {by}{at}"
        if self.kind == DYNAMICS:
            return f"breaks the dynamics in {name} {by}{at}"
        return f"breaks {words(self.kind)} {name} {by}{at}"

    def data(self) -> dict[str, Any]:
        """As files hold it."""
        at = {"entry": self.entry, "knot": self.knot} if self.size else {"entry": -1, "knot": -1}
        return {"size": self.size, "allowed": self.allowed, **at}


def entry_name(problem: Problem, kind: str, entry: int) -> str:
    """The name of an entry of a state, a control, a difference of states or a constraint."""
    dynamics = problem.dynamics
    if kind == "control_bounds":
        return control_names(dynamics)[entry]
    if kind == "state_bounds":
        return state_names(dynamics)[entry]
    if kind in (TRACKING, DYNAMICS):
        return difference_names(dynamics)[entry]
    if kind == INEQUALITY and problem.constraint.further is None:
        rated = rated_controls(problem.constraint)
        row = entry - problem.constraint.inequalities + len(rated)
        if row >= 0 and rated:
            return f"[rate of {control_names(dynamics)[rated[row]]}]"
    return f"[{entry}]"


@dataclass(frozen=True)
class Violations:
    """The largest violation of each kind in `KINDS`, for every motion, (motions, kinds) each.

    Largest in multiples of what is tolerated.

    Attributes:
        size: in the user's units; a goal that is missed has 1, what is not finite infinity.
        allowed: what is tolerated there; NaN where the problem has nothing of that kind.
        entry: of the state, control, difference of states, or constraint.
        knot: k, from 0 to K.
    """

    size: np.ndarray
    allowed: np.ndarray
    entry: np.ndarray
    knot: np.ndarray

    @property
    def kept(self) -> np.ndarray:
        """Whether no kind is broken, (motions,)."""
        return np.logical_not((self.size > self.allowed).any(axis=1))

    def of(self, motion: int) -> list[Violation]:
        """Those of one motion, of the kinds that the problem has."""
        rows = zip(
            KINDS,
            *(getattr(self, f.name)[motion].tolist() for f in fields(self)),
            strict=True,
        )
        return [v for v in (Violation(*row) for row in rows) if v.allowed == v.allowed]

    def worst(self, motion: int) -> Violation | None:
        """The one that is broken most, of one motion; None if all is kept."""
        broken = [v for v in self.of(motion) if v.broken]
        return max(broken, key=lambda v: v.ratio) if broken else None

    def data(self, motion: int) -> dict[str, dict[str, Any]]:
        """Those of one motion as files hold them, by kind."""
        return {v.kind: v.data() for v in self.of(motion)}


def with_plan_tolerance(problem: Problem, violation: Violation) -> Violation:
    """A constraint's violation, with what feasible plans may: `FEASIBLE` of the row's unit."""
    at_end = violation.kind.startswith("terminal")
    constraint = problem.terminal_constraint if at_end else problem.constraint
    row = violation.entry + ("inequality" in violation.kind) * constraint.equalities
    unit = 1.0 if constraint.unit is None else float(constraint.unit[row])
    return violation._replace(allowed=FEASIBLE * unit)


def most_broken(
    problem: Problem, found: Iterable[Violation], *others: Violation
) -> Violation | None:
    """What a plan that is not feasible breaks most, relative to what feasible plans may.

    Args:
        problem: with the units of its constraints.
        found: violations of the plan, of which those of equalities and inequalities count.
        others: those of the dynamics, with what is allowed there.
    """
    broken = (with_plan_tolerance(problem, v) for v in found if "equality" in v.kind)
    return max([*others, *broken], key=lambda v: v.ratio, default=None)


def extents(problem: Problem, plan: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, ...]:
    """Range over the knots of planned states (n, nx), their differences (n, ndx), controls (n, nu).

    The plan is x_0..x_K, (n, K + 1, nx), with controls (n, K, nu).
    """
    moved = problem.dynamics.host_difference(plan, np.broadcast_to(plan[:, :1], plan.shape))
    with np.errstate(invalid="ignore"):  # of plans that are not finite
        knots_last = (np.asarray(a, float).swapaxes(1, 2).copy() for a in (plan, moved, u))
        return tuple(np.nan_to_num(np.ptp(a, axis=2), posinf=0.0) for a in knots_last)


def driven_extents(
    family: Family, which: np.ndarray, plan: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, ...]:
    """`extents` of plans of the problems `which` (n,), or how far they are from coasting.

    Where x_0 is free it is a choice, as controls are: coasting begins at x_init.
    """
    dynamics = family.problem.dynamics
    of_x, of_dx, of_u = extents(family.at(0), plan, u)
    if not dynamics.nx or not len(plan):
        return of_x, of_dx, of_u
    begin, chosen = plan[:, :1].copy(), dynamics.nx if family.problem.free else 0
    if isinstance(dynamics, Extended):  # parameters and durations stay as they are chosen
        chosen = dynamics.inner.nx + dynamics.sizes.w if dynamics.sizes.w else 0
    begin[:, 0, :chosen] = np.asarray(family.rows(which, 1).x_init)[..., :chosen]
    alike = family.alone and (begin == begin[0]).all()
    rows = slice(1) if alike else slice(None)  # all coast alike from one x_0
    without = np.zeros_like(u[rows])
    gains = np.zeros((*without.shape, dynamics.ndx))
    coasting, _ = family.replay(which[rows], begin[rows].repeat(plan.shape[1], 1), without, gains)
    coasting = np.broadcast_to(coasting, plan.shape)
    with np.errstate(invalid="ignore", over="ignore"):  # of motions that are not finite
        off = plan - coasting, family.at(0).dynamics.host_difference(plan, coasting)
        far = [np.nan_to_num(np.abs(a).max(axis=1), nan=np.inf) for a in off]
    return np.minimum(of_x, far[0]), np.minimum(of_dx, far[1]), of_u


def warn_of_loose_ends(
    family: Family, plan: np.ndarray, u: np.ndarray, tolerances: Tolerances, certified: int
) -> None:
    """Warn of constraints at the end that tolerate much of what x_init lacks.

    That is where all entries of a kind do, or where one does whose tolerance is no share of the
    motion but of the scatter box (`STILL`). A motion that chooses its start may begin at its end.

    Args:
        plan, u: all plans that were replayed, x_0..x_K (n, K + 1, nx), and their controls
            (n, K, nu): `measured` is compiled for as many.
        certified: the plan whose certificate counts.
    """
    if family.problem.terminal_constraint.rows == 0 or family.problem.free:
        return
    still = np.repeat(plan[:, :1], plan.shape[1], axis=1), u
    off = np.zeros((len(plan), family.problem.dynamics.ndx))
    extent = driven_extents(family, np.zeros(len(plan), int), plan, u)
    given = family, still, off, extent, tolerances
    ends = _evaluated(*given)[2]
    for i, kind in enumerate(MEASURED[-2:]):
        off_by, allowed = (a[certified].astype(float) for a in ends[i])
        loose = (off_by > NOTHING * allowed) & (off_by < LOOSE * allowed)
        if loose.any() and (off_by >= LOOSE * allowed).any():
            of_motion = _evaluated(*given, least=0.0)[2][i][1][certified]
            loose &= off_by >= LOOSE * of_motion
        if loose.any():
            entry = int(np.argmax(loose))
            warnings.warn(
                f"x_init is off the {words(kind)} [{entry}] by {off_by[entry]:.1e} only, and "
                f"{allowed[entry]:.1e} is tolerated, so its certificate says little: give "
                f"tolerances=Tolerances({kind}=...), or an x_scatter as wide as the motion.",
                DraxWarning,
                stacklevel=3,
            )


def warn_of_rounding(
    family: Family, plan: np.ndarray, u: np.ndarray, tolerances: Tolerances, certified: int
) -> None:
    """Warn where states are so far from 0 that their precision shows beside what is tolerated.

    Args are those of `warn_of_loose_ends`.
    """
    problem, x = family.problem, np.abs(plan[certified]).max(axis=0, initial=0.0)
    if problem.precision == 64:
        return
    width = np.asarray(scatter_widths(problem)[0])
    E = driven_extents(family, np.zeros(1, int), plan[[certified]], u[[certified]])[0][0]
    rounding = np.finfo(np.float32).eps * x
    coarse = rounding > ROUNDED * tolerances.relative * np.maximum(E, STILL * width)
    if coarse.any():
        i = int(np.argmax(coarse))
        warnings.warn(
            f"{state_names(problem.dynamics)[i]} is up to {x[i]:.2g}, which float32 knows to "
            f"{rounding[i]:.1e}, and controls move it by {E[i]:.1e}: solve with precision=64, or "
            "measure it from nearer.",
            DraxWarning,
            stacklevel=3,
        )


def warn_of_controls_at_the_end(
    problem: Problem, x: np.ndarray, u: np.ndarray, time: float
) -> None:
    """Warn where what is asked of the end reads forces, which have no control to follow there.

    Args:
        problem: of a model; of functions nothing is said.
        x, u: where the best replay ends (nx,), and its last control (nu,).
        time: when [s].
    """
    model = mjx_dynamics(problem.dynamics)
    if model is None:
        return
    instead = "Ask for positions and velocities, and bound forces by an inequality of the stages."
    if problem.goal is not None:
        data = problem.dynamics.observe_replayed(x, time)
        without = bool(problem.goal(data))
        data.ctrl[:] = u
        mujoco.mj_forward(data.model, data)
        if bool(problem.goal(data)) != without:
            warnings.warn(
                f"the goal is asked with controls of 0, as the end has none, and says {without}; "
                f"with the last controls it says {not without}. {instead}",
                DraxWarning,
                stacklevel=3,
            )
    end = problem.end
    if end.terminal_constraint.rows:
        with problem.arithmetic():
            program, _, _ = needed_program(
                lambda x, u: end.terminal_constraint(end.dynamics.observe(x, u)),
                (problem.x_init, jnp.zeros(problem.dynamics.nu)),
            )
        control = program.jaxpr.invars[-1]
        if any(control in operation.invars for operation in program.jaxpr.eqns):
            warnings.warn(
                "terminal constraints read what follows from the controls, as forces and "
                f"accelerations do; they get it for controls of 0, as the end has none. {instead}",
                DraxWarning,
                stacklevel=3,
            )


def warn_of_box(problem: Problem, which: np.ndarray, how: str | None = None) -> None:
    """Warn that the box of initial knots did not fit entries (nx + nu,) of states and controls.

    And that the problem was solved again for it, in a NARROWER box or a WIDER one, or else what
    bounds that are far too wide mean.
    """
    dynamics = problem.dynamics
    names, give = [*state_names(dynamics), *control_names(dynamics)], "x_scatter and u_scatter"
    if not dynamics.nx:  # a program
        names, give = [f"x[{i}]" for i in range(dynamics.nu)], "a scatter"
    those = [name for name, is_one in zip(names, which, strict=True) if is_one]
    more = f" and {len(those) - FEW} more" if len(those) > FEW else ""
    of = f"{', '.join(those[:FEW])}{more}"
    share = f"less than a hundredth of the room that {of} have, between bounds or by default"
    told = {
        NARROWER: f"{problem.name} was solved again, from initial knots nearer to the answer, "
        f"which uses {share}. Give narrower bounds, or {give}, to solve it once.",
        WIDER: f"{problem.name} was solved again, from initial knots as far apart as the answer's "
        f"are: {of} went far beyond the default ones, by which defects are measured. Give {give} "
        "to solve it once.",
        None: f"motions of {problem.name} use {share}, by which residuals and constraints are "
        f"measured, so optimal and certified say little. Give narrower bounds, or {give}.",
    }
    warnings.warn(told[how], DraxWarning, stacklevel=4)


def measured(
    family: Family,
    motion: tuple[np.ndarray, np.ndarray],
    off: np.ndarray,
    extent: tuple[np.ndarray, ...],
    tolerances: Tolerances,
) -> tuple[np.ndarray, Violations]:
    """Cost (n,) and violations of motions, one of each problem, or all of one problem.

    The goal, which a function on the host decides, and the dynamics count as kept.

    Args:
        motion: states x_0..x_K (n, K + 1, nx) and controls (n, K, nu).
        off: x_K - plan, (n, ndx).
        extent: of the plans, from `extents`.
    """
    cost, found, *_ = _evaluated(family, motion, off, extent, tolerances)
    size, allowed, entry, knot = found

    def framed(values: np.ndarray, filling: float) -> np.ndarray:
        """With a column for the goal in front, and one for the dynamics at the end."""
        return np.pad(values.T, ((0, 0), (1, 1)), constant_values=filling)

    size = np.nan_to_num(size.astype(float), nan=np.inf)
    allowed = allowed.astype(float)
    return cost, Violations(
        framed(size, 0.0), framed(allowed, np.nan), framed(entry, -1), framed(knot, -1)
    )


def inequalities(
    family: Family,
    motion: tuple[np.ndarray, np.ndarray],
    extent: tuple[np.ndarray, ...],
    tolerances: Tolerances,
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of violations of inequalities at all stages, and what is tolerated, (n, K, entries).

    Args are those of `measured`.
    """
    off = np.zeros((len(motion[0]), family.problem.dynamics.ndx))
    size, allowed = _evaluated(family, motion, off, extent, tolerances)[3]
    return np.asarray(size, float), np.asarray(allowed, float)


def _evaluated(
    family: Family,
    motion: tuple[np.ndarray, np.ndarray],
    off: np.ndarray,
    extent: tuple[np.ndarray, ...],
    tolerances: Tolerances,
    least: float = STILL,
) -> Any:
    """What `_measured` returns, on the host but for its last arrays; `least` instead of `STILL`."""
    with family.problem.arithmetic():
        given = _on_device(family.at(0), motion, off, extent, tolerances, least)
        *found, stages = _measured(*family.parts, *given)
        return *jax.tree.map(np.asarray, found), stages


def _on_device(problem: Problem, motion: Any, off: Any, extent: Any, *limits: Any) -> Any:
    """Arguments of `_measured` and `_by_entry`; limits are tolerances, and `STILL` or less."""
    tolerances, least = limits
    every = motion, off, extent, (tolerances.of(problem), tolerances.relative, least)
    with np.errstate(over="ignore"):  # what is beyond float32 is infinite
        return jax.tree.map(lambda a: jnp.asarray(a, problem.x_init.dtype), every)


@partial(compiled, key=identity_of_rows)
@full_precision
def _measured(
    own: Problem,
    shared: Problem,
    motion: tuple[Array, Array],
    off: Array,
    extent: tuple[Array, ...],
    limits: Limits,
) -> tuple[Array, tuple[Array, ...], list[tuple[Array, Array]], tuple[Array, Array]]:
    """Cost (n,); size, tolerance, entry and knot of the largest violation, (kinds, n) each.

    Also sizes and tolerances of all entries, (n, entries), of the last two kinds, at the end, and
    of inequalities at all stages, (n, K, entries).
    """

    def of_motion(own: Problem, motion: tuple[Array, Array], off: Array, extent: Any) -> Any:
        states, u = motion
        problem = joined(shared, own)
        start = problem.start_from(states[0])
        if not problem.free:
            problem = replace(problem, x_init=states[0])
        kinds = list(_sizes_and_tolerances(problem, motion, off, extent, limits))
        worst = [_largest(*kind) for kind in kinds]
        ends = [(size[0], allowed[0]) for size, allowed, _ in kinds[-2:]]
        cost = problem.cost(Trajectory(states[1:], u, start=start))
        stages = kinds[MEASURED.index(INEQUALITY)][:2]
        return cost, tuple(map(jnp.stack, zip(*worst, strict=True))), ends, stages

    found: Any = jax.vmap(of_motion, out_axes=(0, 1, 0, 0))(own, motion, off, extent)
    return found


def scatter_widths(problem: Problem) -> tuple[Array, Array, Array]:
    """Widths of the scatter box of states (nx,), their differences (ndx,) and controls (nu,).

    1 where it has none, or an infinite one.
    """
    box, (of_differences, of_controls) = problem.scatter, problem.widths

    def usable(width: Array) -> Array:
        return jnp.where((width > 0) & jnp.isfinite(width), width, 1.0)

    of_states = jnp.atleast_2d(box.x_upper - box.x_lower).max(axis=0)
    return usable(of_states), usable(of_differences), usable(of_controls)


def _sizes_and_tolerances(
    problem: Problem,
    motion: tuple[Array, Array],
    off: Array,
    extent: tuple[Array, ...],
    limits: Limits,
) -> Iterator[tuple[Array, Array, int]]:
    """Sizes and tolerances (knots, entries), and the first knot, of each kind in `MEASURED`."""
    given, relative, least = limits
    E = tuple(map(jnp.maximum, extent, (least * width for width in scatter_widths(problem))))
    parts = _sizes_and_scales(problem, *motion, off, E)
    for (size, scale, span, first), number in zip(parts, given, strict=True):
        allowed = relative * scale
        allowed = jnp.minimum(allowed, jnp.maximum(SPAN * span, LEAST * allowed))
        allowed = jnp.where(jnp.isnan(number), allowed, number)
        yield size, jnp.broadcast_to(allowed, size.shape), first


def _sizes_and_scales(
    problem: Problem, states: Array, u: Array, off: Array, E: tuple[Array, ...]
) -> Iterator[tuple[Array, Array, Array, int]]:
    """Sizes (knots, entries), their scales and spans, and the first knot, of kinds in `MEASURED`.

    A span is the largest value of a row, (entries,); infinite for what is no constraint.
    """
    box, K = problem.bounds, len(u)
    stage, end = problem.constraint, problem.terminal_constraint
    whole = jnp.asarray(jnp.inf)
    yield jnp.abs(off)[None], E[1], whole, K
    yield (*_outside(states[1:], box.x_lower, box.x_upper, E[0]), whole, 1)
    yield (*_outside(u, box.u_lower, box.u_upper, E[2]), whole, 0)
    none = jnp.zeros((K, 0)), jnp.zeros(0)
    values, changes, spans = none, none, none
    if stage.rows or end.rows:
        values, changes, spans = _constraints(problem, states, u, E)
    for at, (constraint, first) in enumerate(((stage, 0), (end, K))):
        value, change, span = (jnp.atleast_2d(part[at]) for part in (values, changes, spans))
        span, m = span.max(axis=0), constraint.equalities
        yield jnp.abs(value[:, :m]), change[:, :m], span[:m], first
        yield jnp.maximum(value[:, m:], 0.0), change[:, m:], span[m:], first


def _outside(z: Array, lower: Array, upper: Array, E: Array) -> tuple[Array, Array]:
    """Distances of knots (K, n) from a box, and their scales; NaN where there is no bound.

    A box of no width has the scale of an equality.
    """
    width = upper - lower
    scale = jnp.where(jnp.isfinite(width) & (width > 0.0), jnp.minimum(width, WIDE * E), E)
    free = jnp.isinf(lower) & jnp.isinf(upper)
    size = jnp.maximum(lower - z, z - upper)
    return jnp.maximum(size, 0.0), jnp.where(free, jnp.nan, scale)


def _constraints(
    problem: Problem, states: Array, u: Array, E: tuple[Array, ...]
) -> tuple[tuple[Array, Array], ...]:
    """Constraints at the stages (K, m) and at the end (m_end,), how much they change, and spans.

    A span is the largest |g| of a row at a knot, whichever of the states it may have there.
    """
    ndx, K = problem.dynamics.ndx, len(u)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (DIRECTIONS, ndx + u.shape[-1]))
    with_none = jnp.asarray(np.vstack([0.0 * signs[:1], signs]), states.dtype)
    steps = with_none * jnp.concatenate([E[1], E[2]]) * MOVE
    forth = np.arange(K + 1)
    others = 0 * forth, forth[::-1], np.roll(forth, K // 3), np.roll(forth, -K // 3)
    orders = np.stack([*[forth] * len(steps), *others])
    steps = jnp.concatenate([steps, jnp.zeros((len(others), steps.shape[1]), steps.dtype)])

    def values(step: tuple[Array, Array]) -> tuple[Array, Array]:
        (by, order), move = step, problem.dynamics.integrate
        dx, du = by[:ndx], by[ndx:]
        moved = jax.vmap(lambda x: move(x, dx))(states[order])
        knots = problem.knots.at(slice(-1))
        stages = jax.vmap(problem.running_constraint)(moved[:-1], u + du, knots)
        return stages, problem.end_constraint(moved[-1])

    # One after the other: all at once would take twenty times the memory
    found = jax.lax.map(values, (steps, jnp.asarray(orders)))

    def change(values: Array) -> Array:
        changed = values[1 : 1 + DIRECTIONS] - values[0]
        return jnp.sqrt(jnp.square(jnp.nan_to_num(changed)).mean(axis=0)) / MOVE

    def span(values: Array) -> Array:
        seen = jnp.concatenate([values[:1], values[1 + DIRECTIONS :]])
        return jnp.abs(jnp.nan_to_num(seen, nan=jnp.inf)).max(axis=0)

    return tuple(jax.tree.map(of, found) for of in (lambda a: a[0], change, span))


def _largest(size: Array, allowed: Array, first: int) -> tuple[Array, Array, Array, Array]:
    """The largest of sizes (knots, entries) in multiples of what is allowed, and where it is."""
    if size.size == 0:
        return jnp.zeros(()), jnp.full((), jnp.nan), jnp.int32(-1), jnp.int32(-1)
    ratio = jnp.where(size > 0, size / jnp.maximum(allowed, jnp.finfo(size.dtype).tiny), 0.0)
    ratio = jnp.where(jnp.isnan(size), jnp.inf, ratio)
    at = jnp.argmax(jnp.where(jnp.isnan(allowed), -1.0, ratio))
    knot, entry = jnp.divmod(at, size.shape[1])
    return size.ravel()[at], allowed.ravel()[at], entry, knot + first


def by_entry(
    problem: Problem,
    motion: tuple[np.ndarray, np.ndarray],
    off: np.ndarray,
    extent: tuple[np.ndarray, ...],
    tolerances: Tolerances,
) -> list[Violation]:
    """Violations of one motion: of each entry of each kind in `MEASURED` that of its worst knot.

    Args:
        motion: states x_0..x_K (K + 1, nx) and controls (K, nu).
        off: x_K - plan, (ndx,).
        extent: of the plan, from `extents`, without its first axis.
    """
    with problem.arithmetic():
        given = _on_device(problem, motion, off, extent, tolerances, STILL)
        found = jax.tree.map(np.asarray, _by_entry(problem, *given))
    return [
        violation
        for kind, (size, allowed, first) in zip(MEASURED, found, strict=True)
        for violation in worst_knots(kind, size, allowed, int(first))
    ]


@jax.jit
@full_precision
def _by_entry(
    problem: Problem,
    motion: tuple[Array, Array],
    off: Array,
    extent: tuple[Array, ...],
    limits: Limits,
) -> list[tuple[Array, Array, int]]:
    """Sizes and tolerances (knots, entries), and the first knot, of each kind in `MEASURED`."""
    if not problem.free:
        problem = replace(problem, x_init=motion[0][0])
    return list(_sizes_and_tolerances(problem, motion, off, extent, limits))


def worst_knots(
    kind: str, size: np.ndarray, allowed: np.ndarray, first: int
) -> Iterator[Violation]:
    """Of sizes (knots, entries) in multiples of what is allowed, the largest of each entry.

    Entries without a tolerance, as where there is no bound, are left out.
    """
    size = np.nan_to_num(size.astype(float), nan=np.inf)
    for entry in range(size.shape[1]):
        column = [
            Violation(kind, float(s), float(a), entry, first + k)
            for k, (s, a) in enumerate(zip(size[:, entry], allowed[:, entry], strict=True))
            if a == a  # NaN is not equal to itself
        ]
        if column:
            yield max(column, key=lambda v: v.ratio)
