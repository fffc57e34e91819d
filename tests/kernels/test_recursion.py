"""The affine recursion, in sequence and in parallel, against a loop in numpy."""

import jax
import numpy as np
import pytest

from mjx_drax.kernels.recursion import affine_recursion, in_parallel, step_by_step


@pytest.mark.parametrize("way", [affine_recursion, step_by_step, in_parallel])
@pytest.mark.parametrize(("K", "n", "m"), [(1, 2, 1), (7, 3, 2), (33, 1, 1)])
def test_it_is_the_loop(way, K, n, m):
    with jax.enable_x64(True):
        rng = np.random.default_rng(K)
        F, f = rng.normal(size=(K, n, n)) / n, rng.normal(size=(K, n, m))
        x, expected = np.zeros((n, m)), []
        for k in range(K):
            x = F[k] @ x + f[k]
            expected.append(x)
        np.testing.assert_allclose(jax.jit(way)(F, f), expected, rtol=1e-12, atol=1e-12)
