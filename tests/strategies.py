"""What hypothesis gives to the tests of properties; the examples are the same in every run."""

import math

import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

bounded = settings(
    max_examples=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)

anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-3, 20),
    st.floats(),
    st.floats(0.01, 3.0),
    st.complex_numbers(),
    st.text(max_size=6),
    st.binary(max_size=4),
    st.lists(st.floats(), max_size=3),
    st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=2),
    st.tuples(st.floats(), st.floats()),
    st.tuples(st.floats(-2.0, 0.0), st.floats(0.0, 2.0)),
    st.dictionaries(st.text(max_size=2), st.floats(), max_size=2),
    st.sampled_from(
        [
            object(),
            float,
            np.float16(1.5),
            np.int8(3),
            np.bool_(True),
            np.zeros((0, 2)),
            np.zeros((10, 2)),
            np.zeros((2, 10, 2)),
            np.full(2, math.nan),
            np.array([None, 1.0]),
            np.array(["1", "2"]),
            np.array([1, 2], "M8[s]"),
            jnp.ones(2),
            jnp.ones(2, bool),
            10**400,
            [[1.0], [2.0, 3.0]],
            {1.0, 2.0},
            range(2),
        ]
    ),
)
