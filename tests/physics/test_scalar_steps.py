"""Steps of MJX in scalar arithmetic: the same numbers, few operations, constants may change."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import from_mjcf
from mjx_drax.kernels.pruning import pruned
from mjx_drax.kernels.scalars import scalarize
from mjx_drax.models import path
from mjx_drax.physics import dynamics as mjx_dynamics
from mjx_drax.physics import step as one_step
from mjx_drax.physics.step import step
from mjx_drax.problem.differentiators import Autodiff, InScalars
from mjx_drax.problem.trajectory import Knot

RNG = np.random.default_rng(0)


def close(seen, wanted, rtol):
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(wanted), strict=True):
        scale = max(1.0, np.abs(b).max(initial=0.0))
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * scale)


EVERYTHING = """
<mujoco model="everything">
  <option timestep="0.01" gravity="1 -2 -9"><flag contact="disable"/></option>
  <worldbody>
    <body pos="0 0.1 1" euler="10 20 30">
      <joint name="rail" type="slide" axis="1 0 0.5" damping="0.3" stiffness="2" springref="0.2"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.05 0.02 0.01"/>
      <body pos="0.3 0 0.1">
        <joint name="arm" axis="0 1 0.2" pos="0.01 0 0.02" armature="0.1" damping="0.2"/>
        <inertial pos="0.2 0.05 0.01" mass="0.7" fullinertia="0.02 0.03 0.04 0.001 0.002 0.003"/>
        <body pos="0 0 0.4" quat="0.9 0.1 0.3 0.2">
          <joint name="wrist" axis="1 1 1" stiffness="1"/>
          <geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="rail" gear="3"/>
    <position joint="arm" kp="5" kv="1"/>
    <general joint="wrist" dyntype="filter" dynprm="0.1" gainprm="2"/>
  </actuator>
</mujoco>"""


def chain(links):
    body = "".join(
        f'<body pos="0 0 {-0.5 * (i > 0)}"><joint name="j{i}" axis="0 1 0" damping="0.1"/>'
        '<geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.5"/>'
        for i in range(links)
    )
    return (
        '<mujoco><option timestep="0.01"><flag contact="disable"/></option>'
        f"<worldbody>{body}{'</body>' * links}</worldbody>"
        '<actuator><motor joint="j0"/><motor joint="j1" gear="2"/></actuator></mujoco>'
    )


def task(model, dt=0.01):
    model = path(model) if model in ("pendulum", "cartpole", "acrobot") else model
    return from_mjcf(model, horizon=2 * dt, dt=dt, running_residual=lambda data, u: u)


MODELS = {
    **{name: name for name in ("pendulum", "cartpole", "acrobot")},
    "chain": chain(5),
    "everything": EVERYTHING,
}


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_steps_and_jacobians_are_those_of_mjx(model, monkeypatch):
    with jax.enable_x64(True):
        dynamics = task(MODELS[model]).dynamics
        n, nx = dynamics.nx + dynamics.nu, dynamics.nx
        z = jnp.asarray(RNG.uniform(-1.0, 1.0, n))

        def derivatives(by, dynamics, z):
            def f(dz):
                return dynamics.step(*jnp.split(z + dz, [nx]))

            return by.jacobian(f, n, jax.random.key(0))

        def all_of_it(by, z, dynamics):
            return jax.jit(lambda dynamics, z: derivatives(by, dynamics, z))(dynamics, z)

        seen = all_of_it(InScalars(Autodiff()), z, dynamics)
        monkeypatch.setattr(mjx_dynamics, "scalarized", lambda function, *_, **__: function)
        jax.clear_caches()
        close(seen, all_of_it(Autodiff(), z, dynamics), 1e-12)


def test_a_cart_pole_is_a_few_hundred_operations():
    dynamics = task("cartpole").dynamics
    x, u = jnp.zeros(4), jnp.zeros(1)

    def f(dynamics, x, u):
        return InScalars(Autodiff()).jacobian(
            lambda dz: dynamics.step(x + dz[:4], u + dz[4:]), 5, jax.random.key(0)
        )

    around = jax.make_jaxpr(pruned(f))(dynamics, x, u).eqns
    (kernel,) = (e for e in around if e.primitive.name == "custom_vmap_call")
    equations = kernel.params["call"].eqns
    moves = ("slice", "squeeze", "reshape", "concatenate", "broadcast_in_dim", "stack")
    assert sum(e.primitive.name not in moves for e in equations) < 600
    assert all(e.outvars[0].aval.size == 1 or e.primitive.name in moves for e in equations)


def test_a_cpu_is_given_each_operation_once(monkeypatch):
    """And not what entries of a Jacobian share once for each of them, as where XLA fuses."""
    dynamics, z = task("cartpole").dynamics, jnp.ones((9, 5))
    programs, as_kernel = [], scalarize.vmapped_as_kernel

    def jacobian(z):
        def step(dz):
            return dynamics.step(*jnp.split(z + dz, [4]))

        return InScalars(Autodiff()).jacobian(step, 5, jax.random.key(0))

    monkeypatch.setattr(
        scalarize,
        "vmapped_as_kernel",
        lambda program: programs.append(program) or as_kernel(program),
    )
    compiled = jax.jit(jax.vmap(jacobian)).lower(z).compile().as_text()
    (program,) = programs
    products = [e for e in program.eqns if e.primitive.name == "mul"]
    # Integer powers become products too: 150 for 142; with fusion it was 725
    assert 100 < compiled.count(" multiply(") < 2 * len(products)


@pytest.mark.parametrize(
    "integrator", ["Euler", "implicitfast", pytest.param("RK4", marks=pytest.mark.slow)]
)
def test_derivatives_in_closed_form_are_those_of_the_operations(integrator):
    xml = EVERYTHING.replace("<option", f'<option integrator="{integrator}"')
    with jax.enable_x64(True):
        dynamics = task(xml).dynamics
        z = jnp.asarray(RNG.uniform(-1.0, 1.0, dynamics.nx + dynamics.nu))

        @partial(jax.jit, static_argnums=0)
        def jacobian(by_operations, model, z):
            def f(z):
                return step(model, *jnp.split(z, [dynamics.nx]), by_operations)

            return jax.jacfwd(f)(z)

        seen, wanted = (jacobian(by, dynamics.model, z) for by in (False, True))
        close(seen, wanted, 1e-10)


def test_more_operations_than_scalars_are_for_are_derived_in_closed_form(monkeypatch):
    """An acrobot, of whose step the limit makes one of arrays."""
    dynamics, asked = task("acrobot").dynamics, []
    closed = one_step.inverse_derivatives  # by which nothing else is computed
    monkeypatch.setattr(one_step, "inverse_derivatives", lambda *a: asked.append(a) or closed(*a))
    z = jnp.asarray(RNG.uniform(-1.0, 1.0, 5), jnp.float32)
    found = []
    for limit in (mjx_dynamics.STEP_LIMIT, 100):
        monkeypatch.setattr(mjx_dynamics, "STEP_LIMIT", limit)
        jax.clear_caches()
        found.append(jax.jit(jax.jacfwd(lambda z: dynamics.step(z[:4], z[4:])))(z))
        assert bool(asked) is (limit == 100)
    close(*found, 1e-4)


@pytest.mark.parametrize("gpu", [True, False])
def test_many_small_steps_are_a_loop_of_scalar_arithmetic(gpu, monkeypatch):
    """On CPUs each step's value and Jacobian come from a kernel, whose outputs are put in place."""
    monkeypatch.setattr(mjx_dynamics, "on_gpu", lambda: gpu)
    jax.clear_caches()
    dynamics = task("cartpole", dt=0.1).dynamics
    assert dynamics.substeps == 10
    x, u = jnp.array([0.1, 0.4, -0.3, 0.2]), jnp.array([0.5])

    def derivatives(dynamics, x, u):
        return InScalars(Autodiff()).jacobian(
            lambda dz: dynamics.step(x + dz[:4], u + dz[4:]), 5, jax.random.key(0)
        )

    program = jax.make_jaxpr(pruned(derivatives))(dynamics, x, u).jaxpr
    loops = [body for name, body in operations(program) if name == "scan"]
    assert len(loops) == 1
    kernels = [name for name, _ in operations(loops[0])].count("custom_vmap_call")
    assert kernels == (0 if gpu else 1)
    names = {name for name, _ in operations(loops[0])}
    assert {"sin", "cos"} <= names
    if not gpu:
        names.remove("gather")  # which places a kernel's outputs
    assert not names & {"dot_general", "gather", "scatter", "cholesky", "while"}
    seen = jax.jit(derivatives)(dynamics, x, u)
    monkeypatch.setattr(mjx_dynamics, "scalarized", lambda function, *_, **__: function)
    jax.clear_caches()
    close(seen, jax.jit(derivatives)(dynamics, x, u), 1e-4)


def operations(jaxpr):
    """Names of the operations of a program and of all that it calls, with what they call."""
    for equation in jaxpr.eqns:
        inner = [getattr(p, "jaxpr", p) for p in equation.params.values() if hasattr(p, "eqns")]
        yield equation.primitive.name, inner[0] if inner else None
        for program in inner:
            yield from operations(program)


def after(dynamics):
    return np.asarray(dynamics.step(jnp.array([0.3, 0.2]), jnp.array([0.1])))


@pytest.mark.slow
def test_a_number_that_was_zero_is_seen_when_it_changes():
    dynamics = task("pendulum").dynamics
    model = dynamics.model
    assert np.asarray(model.opt.gravity)[0] == 0
    assert np.asarray(model.dof_armature)[0] == 0
    for change in (
        {"dof_armature": model.dof_armature + 1.0},
        {"opt": model.opt.replace(gravity=jnp.array([5.0, 0.0, -9.81]))},
        {"jnt_axis": jnp.array([[0.0, -0.8, 0.6]])},
    ):
        other = replace(dynamics, model=model.replace(**change))
        assert other.structure != dynamics.structure
        assert np.abs(after(other) - after(dynamics)).max() > 1e-4, change
        # and inside of a compiled function, where the numbers themselves are not known
        seen = jax.jit(lambda change: after_of(dynamics, change))(change)
        np.testing.assert_allclose(seen, after(other), rtol=1e-5)


def after_of(dynamics, change):
    other = replace(dynamics, model=dynamics.model.replace(**change))
    return other.step(jnp.array([0.3, 0.2]), jnp.array([0.1]))


def test_other_numbers_have_the_same_structure():
    dynamics = task("pendulum").dynamics
    model = dynamics.model
    heavy = replace(dynamics, model=model.replace(body_mass=2.0 * model.body_mass))
    assert heavy.structure == dynamics.structure
    before, _ = after(dynamics), mjx_dynamics._step._cache_size()
    size = mjx_dynamics._step._cache_size()
    assert np.abs(after(heavy) - before).max() > 1e-4
    assert mjx_dynamics._step._cache_size() == size


def test_dynamics_survive_as_a_pytree():
    dynamics = task("pendulum").dynamics
    leaves, tree = jax.tree.flatten(dynamics)
    again = jax.tree.unflatten(tree, leaves)
    assert again.structure == dynamics.structure
    assert (again.dt, again.substeps) == (dynamics.dt, dynamics.substeps)
    assert jax.tree.structure(again) == tree
    paths, _ = zip(*jax.tree_util.tree_leaves_with_path(dynamics), strict=True)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path in paths]
    assert leaves[names.index("opt.gravity")] is dynamics.model.opt.gravity
    assert leaves[names.index("dt")] is dynamics.dt
    many = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * 2), dynamics)
    x, u = jnp.array([0.3, 0.2]), jnp.array([0.1])
    seen = jax.vmap(lambda dynamics: dynamics.step(x, u))(many)
    np.testing.assert_allclose(seen, [after(dynamics)] * 2, rtol=1e-6)


def test_flattened_dynamics_have_the_numbers_of_their_knot():
    dynamics = task("pendulum").dynamics
    steered = dynamics.steered(
        False, lambda model, mass: {"body_mass": mass * model.body_mass}, ["body_mass"]
    )
    jax.tree.leaves(steered)  # found once, but not kept for another model
    knot = Knot(jnp.zeros(()), jnp.zeros((), int), jnp.array(0.1), parameters=jnp.array(3.0))
    heavy = steered.at(knot)
    leaves, tree = jax.tree.flatten(heavy)
    again = jax.tree.unflatten(tree, leaves)
    for seen in (heavy, again):
        np.testing.assert_array_equal(seen.model.body_mass, 3.0 * dynamics.model.body_mass)


def test_a_model_is_flattened_once(monkeypatch):
    dynamics = task("pendulum").dynamics
    jax.tree.leaves(dynamics)
    monkeypatch.setattr(jax.tree, "flatten", None)
    assert len(jax.tree.leaves(dynamics)) > 100
