"""The default solver: descend first, then heat and cool again what has failed.

The first attempt of every chain is a noise-free flow. It solves a problem that is not a trap, and
it measures what a trap's annealing needs to know: the scale of costs of answers. Each further
attempt works for the chains that are not done: infeasible, or far more expensive than the best.
All places in the batch start again from new random knots, are heated to a temperature of that
scale, and are cooled slowly; or they descend slowly, if on this problem that brings more
(`attempts`). What they find goes to the chains that are not done, the best to the worst of them,
and every chain keeps the best that it got. On GPUs, which have room for more rows than a few dozen
chains fill, an attempt has several places for each chain.

Schedules are multiples of scales that are measured, so no setting depends on the units of a cost:

    cost     a share of the median cost of the initial knots, of which a heavy terminal weight does
             not count in full (`sizes`), for mu, delta and rho; ten times as much after an attempt
             that leaves more than half of the chains infeasible
    noise    the square root of the best cost so far, for sigma

Costs are measured from their floor (`sizes`), so constants that are added to them change nothing.
Where a Gauss-Newton flow is polished, states and controls are measured by their box (`scaled`).

Where f has kinks (contacts, limits, dry friction), `Rollouts` follow each attempt, with random
shooting, and noise seldom helps: there attempts are heated, in turns with others, only as long as
none has made a chain done.
A touch a moment later may cost much more, so all descents can end before the same narrow wall.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from mjx_drax.base.errors import (
    DraxError,
    require_not_negative,
    require_positive,
    require_whole,
    shown,
)
from mjx_drax.kernels.batching import on_gpu
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.schedules import Geometric, Scale
from mjx_drax.polish.interior_point import Polish
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.problem import Problem
from mjx_drax.search.checks import check_flow

DONE_SHARE, DONE_SHARE_KINKED = 0.95, 0.9
"""Default share of chains to be done; attempts are long where f has kinks."""

WITHIN, WITHIN_KINKED = 0.1, 1.0
"""Default excess over the best cost up to which a chain is done."""


ROOM, MOST_PLACES, TRIES = 1024, 4096, 4
"""Places of the first attempt at most, if there are not more chains: on a GPU fewer are hardly
faster. Places of later attempts, and for each chain, by default: four times as many places take
half the time that four attempts would."""

TOLERANCE = {4: 1e-4, 8: 1e-8}
"""Of the polish, by the bytes of a number."""


@dataclass(frozen=True)
class Rollouts:
    """After an attempt, plans are replaced by rollouts of their controls, and improved from there.

    Where contacts switch, linear models of f are wrong, and steps that trust them leave defects. A
    rollout has none. So each chain takes its rollout, and then every few iterations of the polish,
    or of the tail without one, are rolled out with their feedback: what is feasible and cheaper is
    kept. Where it is not, shares of the change are rolled out, down to a twentieth, and the chain
    is damped more if none of them helps.

    No derivative tells that a push would help where nothing touches. So after a third of the
    rounds, or when they change nothing more, random shooting (`shooting`) improves the controls of
    chains that still miss the goal or break a constraint; without a goal, of all of them, and at
    once where all are feasible. The other rounds start from there.

    Attributes:
        first: rollouts right after the attempt: one without feedback, the others with it.
        rounds: largest number of rounds that follow; 0 with first=0: no rollouts.
        iterations: in each round; the first and the last of a polish take no step.
        samples: random changes of a chain's controls in a generation of random shooting; 0: none.
        generations: the most; a chain has fewer if ten have brought it nothing.
    """

    first: int = 2
    rounds: int = 30
    iterations: int = 6
    samples: int = 32
    generations: int = 100

    @property
    def asked(self) -> bool:
        """Whether there are any."""
        return self.first + self.rounds > 0

    @property
    def shoot_at(self) -> int:
        """After how many rollouts and rounds random shooting comes; -1 for never."""
        return self.first + self.rounds // 3 if self.samples * self.generations else -1

    @property
    def total(self) -> int:
        """Number of rollouts and rounds, and random shooting."""
        return self.first + self.rounds + (self.shoot_at >= 0)


@dataclass(frozen=True)
class Restarts:
    """Descend, then heat what failed; every chain keeps the best of its attempts.

    A setting that is None depends on the problem; `for_problem` says how, and a solution's `solver`
    has what was used.

    Attributes:
        flow: the settings of an attempt, its schedules in scales that are measured.
        descent: noise-free iterations of the first attempt, which measures the scales. None: the
            first attempt is like the others, and the schedules are in the flow's own scale.
        attempts: largest number of attempts, the first included.
        within: a chain is done if it is feasible, reaches the goal where it was replayed, and
            exceeds the best chain's cost by at most this share. None: 0.1; 1 where f has kinks.
        done_share: share of chains to be done; then no further attempt is made, but to look for
            better optima where several are known (`Decisions`). None: 0.95, and 0.9 where f has
            kinks. Above 1 all attempts are made, by all chains, to their ends and (if
            `heated`) with noise: that takes longer, and finds better optima where all chains of the
            first attempt lead to the same ones.
        heated: whether attempts after the first may be heated, or all descend like the first. None:
            they may; where f has kinks it stays None, and a single problem's are heated in turns
            with others until a chain is done.
        rollouts: what follows an attempt. None: `Rollouts()` where f has kinks, or controls can be
            beyond what `Dynamics.useful_controls` says, and an attempt ends with as many iterations
            as a round has, else nothing.
        polish: what follows the noise, instead of the flow's tail. It brings defects to 0, so the
            flow's penalty goes half its way only: softer dynamics lead to better basins. None:
            `Polish()` with the tolerance of the precision, unless derivatives are sampled or the
            metric is not `polished`, as `GaussNewton` is.
        tries: places for each chain in an attempt at a single problem without a guess; the best of
            what they find is kept. The first attempt, which many problems do not go beyond, has at
            most 1,024 places, or one for each chain. None: 4 on GPUs, or as many as make 4,096
            places; 1 on CPUs, and where rollouts follow.
    """

    flow: Langevin = field(
        default_factory=lambda: Langevin(
            iterations=150,
            tail=60,
            noise=Geometric(6.0, 1.5e-3),
            penalty=Geometric(40.0, 4e3),
            damping=Geometric(0.3, 0.1, 0.03),
            barrier_weight=Geometric(0.1, 1e-3, 1e-5),
        )
    )
    descent: int | None = 100
    attempts: int = 5
    within: float | None = None
    done_share: float | None = None
    heated: bool | None = None
    rollouts: Rollouts | None = None
    polish: Polish | None = None
    tries: int | None = None

    @property
    def after(self) -> int:
        """Iterations after those with noise: of the polish, or of the flow's tail without one."""
        polish = self.polish
        return polish.iterations if polish and polish.iterations else self.flow.tail

    @property
    def iterations(self) -> int:
        """Largest number of iterations that a solve does, without those between rollouts."""
        return self.noise_ends[-1] + self.after

    @property
    def noise_ends(self) -> list[int]:
        """After how many iterations the noise of each attempt ends."""
        flow = self.flow
        first = flow.iterations if self.descent is None else self.descent
        return [first + i * (flow.iterations + self.after) for i in range(self.attempts)]

    def places(self, chains: int, attempt: int) -> int:
        """Of an attempt at a single problem."""
        assert self.tries is not None
        return chains * (self.tries if attempt else max(min(self.tries, ROOM // chains), 1))

    def first(self, cost_scale: float) -> Langevin:
        """The settings of the first attempt, for a scale of costs."""
        if self.descent is None:
            return self.flow
        return replace(self.flow, iterations=self.descent, scale=scale_of(cost_scale, 0.0))

    def for_problem(self, problem: Problem, chains: int) -> Restarts:
        """The same settings, with a value for each that is None."""
        kinked, polish = problem.dynamics.kinked, self.polish or self._polish_for(problem)
        # Where forces are at the ends of their ranges, f has no slope that leads on
        blind = kinked or problem.saturates
        rolled_out = blind and replace(self, polish=polish).after >= Rollouts.iterations
        values: dict[str, Any] = {
            "within": WITHIN_KINKED if kinked else WITHIN,
            "done_share": DONE_SHARE_KINKED if kinked else DONE_SHARE,
            "heated": None if kinked else True,
            "rollouts": Rollouts() if rolled_out else Rollouts(first=0, rounds=0),
            "tries": 1 if rolled_out or not on_gpu() else min(max(MOST_PLACES // chains, 1), TRIES),
            "polish": polish,
        }
        return replace(self, **{n: v for n, v in values.items() if getattr(self, n) is None})

    def _polish_for(self, problem: Problem) -> Polish:
        """The default polish; none if derivatives are sampled or the metric is not `polished`."""
        metric = self.flow.preconditioner
        if metric.polished and isinstance(metric.derivatives, Autodiff):
            return Polish(TOLERANCE[problem.x_init.dtype.itemsize])
        return Polish(iterations=0)

    def with_iterations(self, iterations: int) -> Restarts:
        """Other numbers of iterations, in proportion to those with noise."""
        share = iterations / max(self.flow.iterations, 1)
        flow = replace(self.flow, iterations=iterations, tail=round(share * self.flow.tail))
        descent = None if self.descent is None else round(share * self.descent)
        return replace(self, flow=flow, descent=descent)

    def check(self, problem: Problem) -> None:
        """Complain about settings that cannot work.

        Raises:
            DraxError: naming the setting, its value and the fix.
        """
        if not isinstance(self.flow, Langevin):
            raise DraxError(f"flow is {shown(self.flow)}: give a Langevin.")
        check_flow(self.flow, problem)
        if self.descent is not None:
            require_whole("descent", self.descent, 0)
        require_whole("attempts", self.attempts)
        if self.tries is not None:
            require_whole("tries", self.tries)
        if self.within is not None:
            require_not_negative("within", self.within)
        if self.done_share is not None:
            require_not_negative("done_share", self.done_share)
        if not isinstance(self.heated, bool | None):
            raise DraxError(f"heated is {shown(self.heated)}: give True, False or None.")
        if not isinstance(self.polish, Polish | None):
            raise DraxError(f"polish is {shown(self.polish)}: give Polish() or None.")
        if self.polish is not None:
            require_positive("polish.tolerance", self.polish.tolerance, "a number, such as 1e-4")
            require_whole("polish.iterations", self.polish.iterations, 0)
            require_whole("polish.patience", self.polish.patience)
        if not isinstance(self.rollouts, Rollouts | None):
            raise DraxError(f"rollouts is {shown(self.rollouts)}: give Rollouts() or None.")
        for name in vars(self.rollouts) if self.rollouts else ():
            least = 1 if name == "iterations" else 0
            require_whole(f"rollouts.{name}", getattr(self.rollouts, name), least)


def as_restarts(solver: Langevin | Restarts | None) -> Restarts:
    """The solver, of which a `Langevin` is one attempt with its schedules in their own scale.

    Raises:
        DraxError: it is neither.
    """
    if solver is None:
        return Restarts()
    if isinstance(solver, Langevin):
        return Restarts(solver, descent=None, attempts=1, tries=1, polish=Polish(iterations=0))
    if not isinstance(solver, Restarts):
        raise DraxError(f"solver is {shown(solver)}: give a Langevin or a Restarts.")
    return solver


def settled(
    problem: Problem,
    chains: int,
    seed: int,
    solver: Langevin | Restarts | None,
    tolerance: float | None = None,
    max_iterations: int | None = None,
    max_seconds: float | None = None,
) -> Restarts:
    """The settings of a solve, checked, with a value for each that depends on the problem.

    Args:
        problem: what is solved.
        chains, seed, solver: as in `solve`.
        tolerance, max_iterations: of the polish; None: as the solver and the problem have it.
        max_seconds: as in `solve`; it is just checked.

    Raises:
        DraxError: a number of chains, of seconds, seed or setting that cannot work.
    """
    require_whole("chains", chains)
    require_whole("seed", seed, 0)
    if seed >= 2**32:
        raise DraxError(f"seed is {seed!r}: give a whole number from 0 to 2**32 - 1.")
    if max_seconds is not None:
        require_positive("max_seconds", max_seconds)
    settings = as_restarts(solver)
    settings.check(problem)
    settings = _polished(settings, problem, tolerance, max_iterations).for_problem(problem, chains)
    rollouts = settings.rollouts
    if rollouts and rollouts.asked and rollouts.iterations > settings.after:
        raise DraxError(
            f"rollouts.iterations is {rollouts.iterations}, more than the {settings.after} that "
            "follow the noise: give at most so many, or more iterations of the polish or the tail."
        )
    metric, polish = settings.flow.preconditioner, settings.polish
    if polish is not None and polish.iterations and metric.derivatives is None:
        raise DraxError(
            f"the polish needs derivatives, and preconditioner is {type(metric).__name__}, which "
            "asks for none: use GaussNewton(), or leave tolerance, max_iterations and polish out."
        )
    return settings


def _polished(
    settings: Restarts, problem: Problem, tolerance: float | None, iterations: int | None
) -> Restarts:
    """The settings with another tolerance and number of iterations of the polish, if given."""
    given: dict[str, Any] = {}
    if tolerance is not None:
        example = "1e-6; tolerances, plural, is for violations of replays"
        require_positive("tolerance", tolerance, f"a number, such as {example}")
        numbers = np.finfo(problem.x_init.dtype)
        if tolerance < numbers.eps:
            fix = "precision=64, or " if numbers.bits == 32 else ""
            raise DraxError(
                f"tolerance is {tolerance:g}, less than what float{numbers.bits} can tell apart, "
                f"{numbers.eps:.2g}: give {fix}a larger one."
            )
        given["tolerance"] = float(tolerance)
    if iterations is not None:
        require_whole("max_iterations", iterations)
        given |= {"iterations": int(iterations), "patience": 1}
    if not given:
        return settings
    polish = settings.polish
    if polish is not None and not polish.iterations:
        name = "tolerance" if tolerance is not None else "max_iterations"
        value = shown(tolerance if tolerance is not None else iterations)
        raise DraxError(
            f"{name} is {value}, which is for the polish, and this solver has none (a Langevin "
            f"never has): leave {name} out, or give a Restarts with a polish."
        )
    usual = Polish(TOLERANCE[problem.x_init.dtype.itemsize])
    return replace(settings, polish=replace(polish or usual, **given))


def scale_of(cost: float, noise: float) -> Scale:
    """Scales as numbers of one type, so that other values do not recompile."""
    number = jnp.result_type(float).type
    return Scale(number(cost), number(noise))
