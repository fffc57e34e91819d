"""Kernels of a program of scalars, those of GPUs interpreted, against vmap of the function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.scalars import kernel
from mjx_drax.kernels.scalars.kernel import THREADS, at_all_rows, by_windows, vmapped_as_kernel

RNG = np.random.default_rng(0)


def function(x, y, z):
    """Some arithmetic whose entries share most of what they are made of."""
    lean = jnp.sin(x[0] * y) + z[1] * jnp.where(x[1] > 1.0, x[1], jnp.exp(z[0]))
    return jnp.append(jnp.outer(lean, x), lean.sum() / z[1])


def of_entries(a, b, c, d, e, f):
    """`function` as a kernel takes it."""
    larger = jax.lax.select(b > 1.0, b, jnp.exp(e))
    lean = [jnp.sin(a * y) + f * larger for y in (c, d)]
    return [entry * x for entry in lean for x in (a, b)] + [(lean[0] + lean[1]) / f]


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


@pytest.mark.parametrize("size", [1_000, 7, 1])  # operations of a part: all of them, some, one
@pytest.mark.parametrize("has_rows", [(False, True, False), (True, False, True), (True,) * 3])
def test_a_cpu_computes_every_row_in_parts(program, has_rows, size, monkeypatch):
    """Of booleans too, which parts of one operation give to the next."""
    monkeypatch.setattr(kernel, "PART", size)
    inputs = [RNG.uniform(0.5, 2.0, (9,) * own + (2,)).astype(np.float32) for own in has_rows]
    seen = jax.jit(lambda *inputs: by_windows(program, has_rows, *inputs))(*inputs)
    wanted = jax.vmap(function, [0 if own else None for own in has_rows])(*inputs)
    np.testing.assert_allclose(seen, wanted, rtol=1e-6)


@pytest.mark.parametrize(("size", "in_parts"), [(1_000, False), (7, True)])
def test_a_row_alone_goes_in_parts_where_many_rows_do(program, size, in_parts, monkeypatch):
    """Else a CPU compiled the Jacobian of one knot of a quadrotor for minutes."""
    monkeypatch.setattr(kernel, "PART", size)
    inputs = [RNG.uniform(0.5, 2.0, 2).astype(np.float32) for _ in range(3)]
    alone = vmapped_as_kernel(program)
    assert ("reduce_window" in str(jax.make_jaxpr(alone)(*inputs))) is in_parts
    np.testing.assert_allclose(jax.jit(alone)(*inputs), function(*inputs), rtol=1e-6)
    seen, wanted = (jax.jit(jax.jacfwd(f, (0, 1, 2)))(*inputs) for f in (alone, function))
    for a, b in zip(seen, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_outputs_may_be_inputs():
    same = jax.make_jaxpr(lambda a, b, c: [a, b, a * c])(*[jnp.ones(())] * 3)
    a, b, c = np.arange(3.0, dtype=np.float32), np.float32(5.0), np.full(3, 2.0, np.float32)
    seen = by_windows(same, (True, False, True), a, b, c)
    np.testing.assert_array_equal(seen, [[0, 5, 0], [1, 5, 2], [2, 5, 4]])


def test_without_a_gpu_its_vmap_is_that_of_the_program(program):
    x, y, z = (RNG.uniform(0.5, 2.0, (*n, 2)).astype(np.float32) for n in ((4, 3), (3,), ()))
    nested = jax.vmap(jax.vmap(vmapped_as_kernel(program), (0, 0, None)), (0, None, None))
    wanted = jax.vmap(jax.vmap(function, (0, 0, None)), (0, None, None))(x, y, z)
    np.testing.assert_allclose(jax.jit(nested)(x, y, z), wanted, rtol=1e-6)
