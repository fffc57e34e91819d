"""The first way that succeeds, in a loop and all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.first_success import all_at_once, first_success, one_by_one


@pytest.mark.parametrize("way", [first_success, one_by_one, all_at_once])
def test_it_is_the_first(way):
    def attempt(least, a, b):
        return a >= least, {"sum": a + b, "row": jnp.stack([a, b])}

    a, b = jnp.array([1.0, 3.0, 2.0]), jnp.array([10.0, 20.0, 30.0])

    def of_row(least, needed):
        return way(lambda *each: attempt(least, *each), (a, b), needed)

    least, needed = jnp.array([0.0, 2.0, 4.0, 0.0]), jnp.array([True, True, True, False])
    ok, found, index = jax.jit(jax.vmap(of_row))(least, needed)
    np.testing.assert_array_equal(ok, [True, True, False, False])
    np.testing.assert_array_equal(index[:3], [0, 1, 2])
    np.testing.assert_array_equal(found["sum"][:3], [11.0, 23.0, 32.0])
    np.testing.assert_array_equal(found["row"][:3], [[1, 10], [3, 20], [2, 30]])
