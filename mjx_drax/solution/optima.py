"""Which motions belong to the same local optimum: several answers, not only the best.

Only certified chains count: feasible, and a replay of theirs succeeds. How far apart two of them
are is the root mean square, over the K knots and the ndx coordinates, of the scaled difference of
their states,

    d(a, b)^2 = 1 / (K ndx) sum_{k,j} ((x_k^a - x_k^b)_j / s_j)^2,

in tangent space. s_j is the standard deviation of coordinate j over all knots of all certified
chains, so units cancel, and where all chains found the same motion, s_j is the extent of that
motion and not the chains' scatter. Controls do not count: they follow from the states, and of all
that a chain holds they converge last.

An optimum is a certified chain that has no cheaper certified chain within the tolerance; every
other one belongs to the optimum of the nearest cheaper chain, down the slope of the cost (quick
shift, A. Vedaldi and S. Soatto 2008, with the cost in place of a density). To need no
(chains, chains) matrix, chains are taken in order of cost and compared with *landmarks* only:

    nearest landmark farther than tolerance      a new optimum, and its first landmark
    farther than tolerance / 2                   joins the landmark's optimum, and is a landmark too
    nearer                                       joins the landmark's optimum

That takes O(chains x landmarks) time and O(chains) memory beside the states. Why not simpler:
plain leader clustering (no second line) cuts one valley into several optima as soon as chains are
spread along it because they have not converged: 3 to 5 for the cart-pole's two, which are mirror
images. Single linkage finds the two, but a few chains on the ridge between two optima bridge them;
here each of these chains goes down its own side.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.search.iterate import FEASIBLE

TOLERANCE = 0.25
"""Motions are the same if they differ, in the root mean square, by less than a quarter of the
states' standard deviation. In `bug_trap` and `deep_trap`, run until they converged, the 16 and 14
optima are 0.37 apart or more, and chains of one optimum 2e-5 or less."""

LANDMARKS = 512
"""So many are kept, for bounded time; beyond that, chains near none are in no optimum."""


def cluster(
    dynamics: Dynamics,
    states: ArrayLike,
    tolerance: float = TOLERANCE,
    still: ArrayLike = FEASIBLE,
) -> np.ndarray:
    """Which optimum each motion belongs to, (n,): 0, 1, ... in order of appearance, -1 for none.

    Args:
        states: x_1..x_K of every motion, cheapest first, (n, K, nx).
        tolerance: distance d within which motions are the same.
        still: least standard deviation s of a coordinate; what moves by less does not tell motions
            apart. One number or (ndx,).
    """
    motions = jnp.asarray(states)
    scale = _spread(dynamics, motions, jnp.asarray(still))
    nearest, group = np.full(len(motions), np.inf), np.full(len(motions), -1)
    found = 0
    for _ in range(LANDMARKS):
        far = np.flatnonzero(nearest > tolerance / 2)
        if not far.size:
            break
        landmark = far[0]  # all cheaper chains are settled
        if nearest[landmark] > tolerance:
            group[landmark], found = found, found + 1
        distance = np.asarray(_distances(dynamics, motions, motions[landmark], scale))
        closer = distance < nearest
        closer[landmark] = True
        closer[:landmark] = False
        nearest[closer], group[closer] = distance[closer], group[landmark]
    return np.where(nearest <= tolerance, group, -1)


@jax.jit
def _spread(dynamics: Dynamics, motions: Array, still: Array) -> Array:
    """s (ndx,): standard deviation of each coordinate over motions and knots, (n, K, nx)."""
    states = motions.reshape(-1, motions.shape[-1])
    offsets = jax.vmap(dynamics.difference, (0, None))(states, states[0])
    return jnp.maximum(offsets.std(axis=0), still)


@jax.jit
def _distances(dynamics: Dynamics, motions: Array, landmark: Array, scale: Array) -> Array:
    """d of every motion (n, K, nx) from one (K, nx), (n,)."""
    difference = jax.vmap(jax.vmap(dynamics.difference), (0, None))
    return jnp.sqrt(jnp.square(difference(motions, landmark) / scale).mean(axis=(1, 2)))
