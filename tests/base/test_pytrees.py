"""Structures of different classes differ, so no compiled program is taken for another's."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import Projection, Reflection
from mjx_drax.base.pytrees import Static, packed, register_dataclass, unpacked
from mjx_drax.problem.cost import as_partial
from mjx_drax.problem.dynamics import FunctionDynamics


@register_dataclass
@dataclass(frozen=True)
class One:
    x: float
    n: int = field(metadata=Static)
    y: tuple[float, ...]


@register_dataclass
@dataclass(frozen=True)
class Other(One):
    kinked = True


@register_dataclass
@dataclass(frozen=True)
class Kinked(FunctionDynamics):
    kinked = True


SYSTEM = as_partial(lambda x, u: x + u), 0.1, 1, 1


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (One(1.0, 2, (3.0,)), Other(1.0, 2, (3.0,))),
        (One(1.0, 2, (3.0,)), One(1.0, 3, (3.0,))),
        (Projection(), Reflection()),
        (FunctionDynamics(*SYSTEM), Kinked(*SYSTEM)),
    ],
    ids=["classes", "static fields", "bounds", "dynamics"],
)
def test_structures_of_two_classes_differ(one, other):
    """Equal ones with different hashes would still be found for one another, now and then."""
    structures = [jax.tree.structure(node) for node in (one, other)]
    assert structures[0] != structures[1]
    assert structures[0] == jax.tree.structure(one)


def test_costs_of_two_classes_differ_even_if_jax_registered_them():
    class Near:
        def __call__(self, x, u):
            return x

    class Far(Near):
        pass

    for cls in (Near, Far):
        jax.tree_util.register_dataclass(cls, [], [])  # noqa: TID251 - as users do
    near, other, far = (jax.tree.structure(as_partial(cls())) for cls in (Near, Near, Far))
    assert near == other != far


def test_leaves_have_the_names_of_their_fields_and_make_the_same_object_again():
    node = One(1.0, 2, (3.0, 4.0))
    leaves, structure = jax.tree_util.tree_flatten_with_path(node)
    assert [(jax.tree_util.keystr(path), leaf) for path, leaf in leaves] == [
        (".x", 1.0),
        (".y[0]", 3.0),
        (".y[1]", 4.0),
    ]
    assert jax.tree.unflatten(structure, [leaf for _, leaf in leaves]) == node
    assert jax.tree.map(lambda leaf: 2 * leaf, node) == One(2.0, 2, (6.0, 8.0))


@pytest.mark.parametrize("to", [np, jnp])
def test_a_tree_comes_back_from_one_vector(to):
    like = One(np.zeros((2, 3), np.float32), 5, (np.zeros((), bool), np.zeros(1, np.int32)))
    node = One(np.arange(6.0).reshape(2, 3), 5, (True, -7))
    vector = packed(node, np.float32, to)
    assert vector.dtype == np.float32
    np.testing.assert_array_equal(vector, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 1.0, -7.0])
    back = unpacked(vector, like)
    assert jax.tree.structure(back) == jax.tree.structure(like)
    for one, other, before in zip(*map(jax.tree.leaves, (back, like, node)), strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        np.testing.assert_array_equal(np.ravel(one), np.ravel(before))


@pytest.mark.slow
def test_a_compiled_function_answers_for_each_of_many_classes():
    """With JAX's own decorator 13 to 17 of a hundred classes got another's answer."""
    answer = jax.jit(lambda node: node.number + 0.0 * node.x)
    for number in range(100):
        body = {"__annotations__": {"x": float}, "number": number}
        cls = register_dataclass(dataclass(frozen=True)(type("Numbered", (), body)))
        assert answer(cls(1.0)) == number
