"""A pruned function gives what the function gives, and computes nothing else."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.kernels.pruning import pruned


def test_pruned_keeps_what_the_result_needs_inside_of_functions_too():
    """And loses the rest before it is differentiated; what is closed over may be traced."""

    @jax.jit
    def observe(x):
        return {"sine": jnp.sin(x), "loop": jax.lax.fori_loop(0, 3, lambda i, y: 2 * y, x)}

    def derivative(scale, x):
        return jax.jvp(pruned(lambda x: scale * observe(x)["sine"]), (x,), (jnp.ones(2),))

    x = jnp.array([0.3, 1.0])
    text = str(jax.make_jaxpr(derivative)(2.0, x))
    assert "sin" in text
    assert "scan" not in text
    value, slope = jax.jit(derivative)(2.0, x)
    np.testing.assert_allclose(value, 2 * np.sin(x), rtol=1e-6)
    np.testing.assert_allclose(slope, 2 * np.cos(x), rtol=1e-6)


def test_arguments_of_the_same_shapes_are_traced_once():
    traced = []

    def function(x):
        traced.append(x.shape)
        return 2.0 * x

    @jax.jit
    def sums(x):
        lean = pruned(function)
        return lean(x) + lean(-3.0 * x), lean(x[:1]), jax.jvp(lean, (x,), (x,))[1]

    both, one, slope = sums(jnp.arange(2.0))
    assert traced == [(2,), (1,)]
    np.testing.assert_array_equal(both, [0.0, -4.0])
    np.testing.assert_array_equal(one, [0.0])
    np.testing.assert_array_equal(slope, [0.0, 2.0])


def test_pruned_functions_of_pytrees_return_the_same_pytrees():
    def function(x, scale):
        unused = jnp.sort(x)
        return {"x": [scale["a"] * x, None], "sum": unused.sum() * 0 + x.sum()}

    x, scale = jnp.arange(3.0), {"a": 2.0, "b": 3.0}
    seen, wanted = jax.jit(pruned(function))(x, scale), function(x, scale)
    assert jax.tree.structure(seen) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(a, b)
    assert pruned(function).__name__ == "function"


def test_products_have_the_precision_that_is_asked_for():
    lean = pruned(lambda x: x @ x)
    assert "HIGHEST" not in str(jax.make_jaxpr(lean)(jnp.ones(2)))
    with jax.default_matmul_precision("float32"):
        assert "HIGHEST" in str(jax.make_jaxpr(lean)(jnp.ones(2)))
    assert "HIGHEST" not in str(jax.make_jaxpr(lean)(jnp.ones(2)))
