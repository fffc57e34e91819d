"""Forces of contacts without the Jacobian of their rows, against those with it."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_drax import from_mjcf
from mjx_drax.kernels.compilation import run_once
from mjx_drax.physics import step
from mjx_drax.physics._mjx import internal
from mjx_drax.physics.contacts.collision import bodies_in_contact
from mjx_drax.physics.tree import kinematics

ON_TOP = """
<mujoco model="on_top">
  <option cone="{cone}" impratio="2"/>
  <default><geom friction="0.8 0.05 0.02" solref="0.02 0.7" mass="1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" friction="0.3 0.001 0.001"/>
    <body pos="0 0 0.99"><freejoint/><geom size="1" condim="1"/></body>
    <body pos="3 0 0.99"><freejoint/><geom size="1" condim="3"/>
      <body pos="0.1 0.2 1.97"><joint type="ball"/><geom size="0.01"/>
        <body pos="0.2 0.1 0">
          <joint name="turn" axis="1 2 3" range="0 1"/><geom size="0.99" condim="4"/>
        </body>
      </body>
    </body>
    <body pos="0 0 9"><freejoint/><geom size="0.1" contype="0" conaffinity="0"/></body>
    <body pos="6 0.3 0.98"><freejoint/><geom size="1" condim="6" priority="1"/></body>
  </worldbody>
  <actuator><motor joint="turn"/></actuator>
</mujoco>
"""


@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize("cone", ["pyramidal", pytest.param("elliptic", marks=pytest.mark.slow)])
def test_they_and_their_derivatives_are_those_of_the_rows(cone):
    model = mujoco.MjModel.from_xml_string(ON_TOP.format(cone=cone))
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        dynamics = from_mjcf(model, horizon=0.1, running_cost=lambda data, u: 0.0).dynamics
        x = jnp.concatenate([model.qpos0, 0.3 * rng.normal(size=model.nv)])
        acceleration = jnp.asarray(rng.normal(size=model.nv))

        def pulled(of, dq):
            q = dynamics.joints.integrate(x[: model.nq], dq)
            data = step.data_at(dynamics.model, jnp.concatenate([q, x[model.nq :]]), jnp.zeros(1))
            data = step._smooth(dynamics.model, kinematics(dynamics.model, data))
            assert len(internal(data).contact.dim) > step.MANY
            return of(dynamics.model, data, acceleration)

        def both(of):
            still = jnp.zeros(model.nv)
            return pulled(of, still), jax.jacfwd(partial(pulled, of))(still)

        ways = step._pull, lambda *given: step._forces(*given)[1]
        (pull, slope), (by_rows, slope_by_rows) = run_once(lambda: [both(of) for of in ways])
    assert np.abs(by_rows).max() > 1.0
    assert np.abs(slope_by_rows).max() > 100.0
    np.testing.assert_allclose(pull, by_rows, atol=1e-9 * np.abs(by_rows).max())
    np.testing.assert_allclose(slope, slope_by_rows, atol=1e-9 * np.abs(slope_by_rows).max())
    assert bodies_in_contact(dynamics.model).tolist() == [0, 1, 2, 3, 4, 6]  # not the one far away
