"""Any number of vmaps is one call for all rows, which gives what vmap gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.kernels.batching import merged_vmaps, padded, repeated, thread_for_each_row

RNG = np.random.default_rng(0)
SIZES = (2, 3, 4)  # of the axes that are mapped, from the innermost outwards


def one(pair, z):
    x, y = pair["x"], pair["y"]
    return {"outer": jnp.outer(x, z), "none": None, "sum": x.sum() - y}


def common_stays_common(has_rows, *arguments):
    tree = jax.tree.structure(arguments)
    axes = jax.tree.unflatten(tree, [0 if own else None for own in has_rows])
    return jax.vmap(one, axes)(*arguments)


def common_is_repeated(has_rows, *arguments):
    return jax.vmap(one)(*repeated(has_rows, arguments))


@pytest.mark.parametrize("axes", [[(0, 0, None), (None, 0, 0)], [(None, 0, None)], [(0, 0, 0)] * 3])
@pytest.mark.parametrize("at_all_rows", [common_stays_common, common_is_repeated])
def test_all_maps_are_one_call_for_all_rows(axes, at_all_rows):
    """Axes: of x, y and z in each map."""
    calls = []

    def all_rows(has_rows, *arguments):
        calls.append(has_rows)
        return at_all_rows(has_rows, *arguments)

    def mapped(function):
        for x, y, z in axes:
            function = jax.vmap(function, ({"x": x, "y": y}, z))
        return jax.jit(function)

    def drawn(which, *shape):
        own = [n for n, axis in zip(SIZES, axes, strict=False) if axis[which] == 0]
        return RNG.normal(size=(*own[::-1], *shape)).astype(np.float32)

    arguments = {"x": drawn(0, 2), "y": drawn(1)}, drawn(2, 3)
    seen, wanted = mapped(merged_vmaps(one, all_rows))(*arguments), mapped(one)(*arguments)
    assert jax.tree.structure(seen) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    assert set(calls[-1:]) == {tuple(0 in column for column in zip(*axes, strict=True))}


def test_without_a_map_it_is_the_function_of_one_row():
    seen = merged_vmaps(one, common_is_repeated)({"x": jnp.arange(2.0), "y": 1.0}, jnp.ones(3))
    assert seen["sum"] == 0.0


def test_a_kernel_gives_every_row_what_its_body_says():
    rows, threads = 70, 32
    own = RNG.normal(size=(2, 3, rows)).astype(np.float32)
    common = np.array([2.0, 3.0], np.float32)

    def body(own_ref, common_ref, out_ref):
        for i in range(3):
            out_ref[i, :] = common_ref[0] * own_ref[0, i, :] + common_ref[1] * own_ref[1, i, :]

    array = padded(own, threads)
    assert array.shape == (2, 3, 96)
    out = thread_for_each_row(body, threads, (3,), [array], [common], interpret=True)
    np.testing.assert_allclose(out[:, :rows], 2.0 * own[0] + 3.0 * own[1], rtol=1e-6)
