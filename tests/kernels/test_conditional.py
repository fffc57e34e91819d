"""Choices inside compiled programs, against `jnp.where` and numpy; and what is not computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.conditional import all_finite, where_needed


def squares(x):
    """Outputs of several shapes and types."""
    return {"square": x**2, "more": (jnp.sum(x), x > 0.0, jnp.argmax(x))}


@pytest.mark.parametrize("mapped", [False, True])
def test_it_is_the_function_where_needed_and_zeros_elsewhere(mapped):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)), jnp.float32)
    needed = jnp.array([True, False, False, True])

    def chosen(needed, x):
        return where_needed(needed, lambda: squares(x))

    def plain(needed, x):
        return jax.tree.map(lambda a: jnp.where(needed, a, jnp.zeros_like(a)), squares(x))

    one = jax.jit(jax.vmap(chosen)) if mapped else jax.jit(chosen)
    pairs = [(needed, x)] if mapped else list(zip(needed, x, strict=True))
    for pair in pairs:
        found, wanted = one(*pair), (jax.vmap(plain) if mapped else plain)(*pair)
        assert jax.tree.structure(found) == jax.tree.structure(wanted)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=1e-6)


def test_it_is_computed_only_where_needed_and_traced_once():
    computed, traced = [], []

    def noted(x):
        traced.append(x)
        jax.debug.callback(lambda _: computed.append(1), x)
        return 2.0 * x

    program = jax.jit(lambda needed, x: where_needed(needed, lambda: noted(x)))
    assert (float(program(False, 3.0)), len(computed)) == (0.0, 0)
    assert (float(program(True, 3.0)), len(traced)) == (6.0, 1)
    jax.effects_barrier()
    assert len(computed) == 1


@pytest.mark.parametrize("bad", [None, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0), (1, 5)])
def test_one_entry_that_is_not_finite_is_seen_in_its_row_alone(bad, place):
    rng = np.random.default_rng(0)
    first = rng.normal(size=(3, 4)).astype(np.float32)
    first[1] = np.finfo(np.float32).max  # finite, but the sum of them is not
    second = rng.normal(size=(3, 2, 3)).astype(np.float32)
    which, entry = place
    if bad is not None:
        (first, second.reshape(3, -1))[which][2, entry] = bad
    found = jax.jit(jax.vmap(lambda a, b: all_finite([a, b])))(first, second)
    np.testing.assert_array_equal(found, [True, True, bad is None])
    assert bool(all_finite([jnp.asarray(first), jnp.asarray(second)])) == (bad is None)
