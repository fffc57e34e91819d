"""The kernel of a program of scalars, interpreted, against vmap of the same function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.scalars.kernel import THREADS, at_all_rows, vmapped_as_kernel

RNG = np.random.default_rng(0)


def function(x, y, z):
    """Some arithmetic whose entries share most of what they are made of."""
    lean = jnp.sin(x[0] * y) + z[1] * jnp.where(x[1] > 1.0, x[1], jnp.exp(z[0]))
    return jnp.append(jnp.outer(lean, x), lean.sum() / z[1])


def of_entries(*entries):
    """`function` as a kernel takes it."""
    x, y, z = (jnp.stack(entries[i : i + 2]) for i in (0, 2, 4))
    return list(function(x, y, z))


@pytest.fixture(scope="module")
def program():
    return jax.make_jaxpr(of_entries)(*[jnp.ones(())] * 6)


@pytest.mark.parametrize("rows", [1, THREADS + 5])  # the latter: two blocks, one of them not full
@pytest.mark.parametrize("has_rows", [(False, True, False), (True, False, True), (True,) * 3])
def test_the_kernel_computes_every_row(program, rows, has_rows):
    inputs = [RNG.uniform(0.5, 2.0, (rows,) * own + (2,)).astype(np.float32) for own in has_rows]
    seen = at_all_rows(program, has_rows, *inputs, interpret=True)
    wanted = jax.vmap(function, [0 if own else None for own in has_rows])(*inputs)
    np.testing.assert_allclose(seen, wanted, rtol=1e-6)


def test_without_a_gpu_its_vmap_is_that_of_the_program(program):
    x, y, z = (RNG.uniform(0.5, 2.0, (*n, 2)).astype(np.float32) for n in ((4, 3), (3,), ()))
    nested = jax.vmap(jax.vmap(vmapped_as_kernel(program), (0, 0, None)), (0, None, None))
    wanted = jax.vmap(jax.vmap(function, (0, 0, None)), (0, None, None))(x, y, z)
    np.testing.assert_allclose(jax.jit(nested)(x, y, z), wanted, rtol=1e-6)
