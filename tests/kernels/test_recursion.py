"""The affine recursion, in sequence, in parallel and as kernels, against a loop in numpy."""

import jax
import numpy as np
import pytest

from mjx_drax.kernels import riccati_threads
from mjx_drax.kernels.recursion import affine_recursion, by_tiles, in_parallel, step_by_step
from mjx_drax.kernels.riccati_threads import THREADS


def example(K, n, m):
    rng = np.random.default_rng(K)
    F, f = rng.normal(size=(K, n, n)) / n, rng.normal(size=(K, n, m))
    x, expected = np.zeros((n, m)), []
    for k in range(K):
        x = F[k] @ x + f[k]
        expected.append(x)
    return F, f, np.array(expected)


@pytest.mark.parametrize("way", [affine_recursion, step_by_step, in_parallel])
@pytest.mark.parametrize(("K", "n", "m"), [(1, 2, 1), (7, 3, 2), (33, 1, 1)])
def test_it_is_the_loop(way, K, n, m):
    with jax.enable_x64(True):
        F, f, expected = example(K, n, m)
        np.testing.assert_allclose(jax.jit(way)(F, f), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("kernel", "chains", "n", "m"),
    [
        (riccati_threads.recursion, THREADS + 3, 2, 3),
        (by_tiles, 2, 17, 3),
    ],
)
def test_kernels_agree_with_the_loop(kernel, chains, n, m):
    with jax.enable_x64(True):
        each = [example(4 + i % 2, n, m) for i in range(chains)]
        F, f, expected = (
            np.stack([part[:4] for part in parts]) for parts in zip(*each, strict=True)
        )
        assert not np.allclose(expected[0], expected[1])
        np.testing.assert_allclose(kernel(F, f, interpret=True), expected, rtol=1e-12, atol=1e-12)


def test_a_recursion_that_chains_share_is_repeated_for_each():
    with jax.enable_x64(True):
        F, f, expected = example(5, 2, 1)
        several = jax.vmap(affine_recursion, in_axes=(None, 0))(F, np.stack([f, 2 * f]))
        np.testing.assert_allclose(several, [expected, 2 * expected], rtol=1e-12, atol=1e-12)
