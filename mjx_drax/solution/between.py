"""Do inequalities hold between knots, too? Replays of models are asked at each physics step.

Plans and certificates keep constraints at knots. A step of the C engine is a fraction of the time
between two, so a replay shows what happens there. The knot before and the one after are both asked
about a state between them, with their own times, data and controls: what only one of them forbids,
as a constraint of chosen times does, is not counted. After the last stage it is the one before.
"""

from __future__ import annotations

import numpy as np

from mjx_drax.physics.dynamics import mjx_dynamics
from mjx_drax.search.family import Family
from mjx_drax.solution.results import Results
from mjx_drax.solution.violations import INEQUALITY, Violation, driven_extents, inequalities


def broken_between_knots(solution: Results, chain: int) -> Violation | None:
    """The inequality that a chain's better replay breaks most between knots; None if none.

    Its knot is the one before. Where a problem has further states, such as rates or parameters, and
    for functions, nothing is known of the time between knots.
    """
    problem = solution.problem
    dynamics = mjx_dynamics(problem.dynamics)
    if dynamics is None or dynamics is not problem.dynamics or dynamics.substeps == 1:
        return None
    if not problem.constraint.inequalities or problem.horizon < 2:
        return None
    ran = solution.replays_in(solution.mode_of(chain))
    states, u = ran.states[chain], ran.controls[chain]
    between = dynamics.between_knots(states[:-1], u).swapaxes(0, 1)
    # Stage k is asked about the time after its own knot, then about the time before it, and the
    # stage before the last about the time after the last
    after = np.repeat(states[None], len(between), axis=0)
    before, at_end = after.copy(), after.copy()
    after[:, :-1], before[:, 1:-1], at_end[:, -3] = between, between[:, :-1], between[:, -1]

    def of_both(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the two stages that are asked about the time after knot k say, (n, K, entries)."""
        by_first, by_next, by_last = np.split(found, 3)
        return by_first, np.concatenate([by_next[:, 1:], by_last[:, -2:-1]], axis=1)

    sizes, tolerated = _at_stages(solution, chain, np.concatenate([after, before, at_end]), u)
    size, allowed = np.minimum(*of_both(sizes)), np.maximum(*of_both(tolerated))
    if not (size > allowed).any():
        return None
    share = np.where(size > allowed, size / np.maximum(allowed, np.finfo(float).tiny), 0.0)
    at = np.unravel_index(np.argmax(share), size.shape)
    return Violation(INEQUALITY, float(size[at]), float(allowed[at]), int(at[2]), int(at[1]))


def _at_stages(
    solution: Results, chain: int, states: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`inequalities` of states (n, K + 1, nx) under the same controls (K, nu).

    As many at a time as there are chains: what judges replays is compiled for these.
    """
    chains, plan = solution.chains, solution.plans[[chain]].astype(float)
    family, controls = Family.of_one(solution.problem), np.repeat(u[None], chains, axis=0)
    planned = np.asarray(solution.trajectories.u[[chain]])
    extent = driven_extents(family, np.zeros(1, int), plan, planned)
    own = tuple(np.repeat(each, chains, axis=0) for each in extent)
    found = []
    for i in range(0, len(states), chains):
        rows = np.resize(states[i : i + chains], (chains, *states.shape[1:]))
        found.append(inequalities(family, (rows, controls), own, solution.tolerances))
    size, allowed = (np.concatenate(each)[: len(states)] for each in zip(*found, strict=True))
    return size, allowed
