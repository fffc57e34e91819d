"""Quadratic programs for the Riccati recursion, and what kernels make of them beside the method."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.method.model import Linearization
from mjx_drax.method.riccati import White
from mjx_drax.studies.recursion import of_joint

K, NDX, NU = 3, 3, 2


def batch(chains, dtype, noisy=True, ndx=NDX, soft=True, K=K):
    """A different problem for every chain, penalties included; none if not `soft`."""
    rng = np.random.default_rng(0)
    n = ndx + NU
    A, B, h = (rng.normal(size=(chains, K, ndx, *m)) for m in [(ndx,), (NU,), ()])
    half = rng.normal(size=(chains, K + 1, n, n))
    H, g = half @ half.swapaxes(-1, -2) + 0.1 * np.eye(n), rng.normal(size=(chains, K + 1, n))
    cost = of_joint(H, g, ndx)
    white = White(rng.normal(size=(chains, K, NU)), rng.normal(size=(chains, K, ndx)))
    multipliers, penalties = rng.normal(size=(chains, K, ndx)), np.geomspace(10.0, 1e4, chains)
    penalties = penalties if soft else None
    arguments = (Linearization(A, B, h), cost, multipliers, penalties, white if noisy else None)
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), arguments)


def agree(seen, wanted, tolerance):
    for name in ("dx", "du", "noise_x", "noise_u", "rate", "gains"):
        a, b = seen[name], getattr(wanted, name)
        assert (a is None) == (b is None), name
        if a is not None:
            scale = np.abs(b).max()
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * scale, err_msg=name)
