"""The residual of the KKT system: each part alone, and no units."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax import LogBarrier, Trajectory, from_function, from_mjcf, from_program, solve
from mjx_drax.method.model import Multipliers, expand
from mjx_drax.method.schedules import Weights
from mjx_drax.polish.residual import residual_of
from mjx_drax.problem.differentiators import Autodiff
from mjx_drax.problem.trajectory import Stagewise

K, NX, NU = 4, 2, 2
WEIGHTS = Weights(*map(jnp.asarray, (0.0, 1.0, 0.0, 1e-3)))  # none enters the residual


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def parts_of(problem, knots, multipliers, v):
    """The residual: stationarity, defects, constraints, complementarity, price."""
    at = problem, LogBarrier(), knots, multipliers, WEIGHTS, Autodiff(), jax.random.key(0)
    found = residual_of(problem, expand(*at), v)[0]
    parts = [found.stationarity, found.defects, found.constraints, found.complementarity]
    parts.append(found.price)
    assert float(found.total) == max(map(float, parts))
    return np.array(parts)


def everything(factor=1.0, constant=0.0, length=1.0, offset=0.0, wanted=0.3):
    """All kinds of constraints.

    Args:
        factor, constant: the cost is factor times the usual one, and a constant.
        length: states are measured in a unit of which the usual one has so many.
        offset: what f has besides.
        wanted: what the equality asks for.
    """

    def f(x, u):
        x = x / length
        return length * jnp.array([x[0] + 0.1 * x[1] + offset, x[1] + 0.1 * jnp.sin(x[0]) * u[0]])

    def running(x, u):
        x = x / length
        return factor * (x[0] ** 2 * u[1] + jnp.cos(x[1]) + u @ u) + constant

    return from_function(
        f,
        x_init=length * jnp.array([0.3, -0.2]),
        nu=NU,
        dt=1.0,
        horizon=float(K),
        running_cost=running,
        terminal_cost=lambda x: factor * jnp.exp(x[0] / length) + constant,
        equality=lambda x, u: jnp.array([u[0] + x[1] / length - wanted]),
        inequality=lambda x, u: jnp.array([u[0] * u[1] - 4.0]),
        terminal_inequality=lambda x: x[:1] / length - 3.0,
        x_bounds=(-5.0 * length, 5.0 * length),
        u_bounds=(-2.0, 2.0),
        x_scatter=(-length, length),
    )


def somewhere(problem, factor=1.0, length=1.0):
    """Knots inside, multipliers, and forces of bounds, none of them optimal."""
    rng = np.random.default_rng(0)

    def drawn(low, high, *shape):
        return jnp.asarray(rng.uniform(low, high, shape))

    x, u = length * drawn(-1, 1, K, NX), drawn(-1, 1, K, NU)
    slack = Stagewise(drawn(0.5, 1, K, 1), drawn(0.5, 1, 1))
    lambda_ = Multipliers(
        factor / length * drawn(-1, 1, K, NX),
        Stagewise(factor * drawn(-1, 1, K, 2), factor * drawn(-1, 1, 1)),
    )
    forces = Trajectory(
        factor / length * drawn(0, 1, K, NX),
        factor * drawn(0, 1, K, NU),
        Stagewise(factor * drawn(0, 1, K, 1), factor * drawn(0, 1, 1)),
    )
    none = jax.tree.map(jnp.zeros_like, forces.slack)  # slacks have no upper end
    return problem, Trajectory(x, u, slack), lambda_, (forces, replace(forces, slack=none))


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [{"factor": 1e6}, {"factor": 1e-6}, {"constant": 1e3}, {"length": 1e3}, {"length": 1e-3}],
    ids=str,
)
def test_the_residual_has_no_units(change):
    usual = parts_of(*somewhere(everything()))
    assert (usual > 1e-3).all()
    units = {name: value for name, value in change.items() if name != "constant"}
    np.testing.assert_allclose(parts_of(*somewhere(everything(**change), **units)), usual, 1e-9)


@pytest.mark.slow
def test_defects_and_constraints_are_told_apart():
    usual = parts_of(*somewhere(everything()))
    off = parts_of(*somewhere(everything(offset=50.0)))
    np.testing.assert_allclose(off[[0, 2, 3]], usual[[0, 2, 3]])
    assert off[1] > 5 * usual[1]
    off = parts_of(*somewhere(everything(wanted=50.0)))
    np.testing.assert_allclose(off[[0, 1, 3]], usual[[0, 1, 3]])
    assert off[2] > 5 * usual[2]


A, B = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0, 0.1], [0.3, 0.0]])


def regulator():
    """The linear quadratic regulator, its optimum and its multipliers, from one dense system."""
    problem = from_function(
        lambda x, u: A @ x + B @ u,
        x_init=[1.0, -2.0],
        nu=NU,
        dt=1.0,
        horizon=float(K),
        running_residual=lambda x, u: jnp.concatenate([x, 0.5 * u]),
        terminal_residual=lambda x: 3.0 * x,
    )
    n, m = K * NX, K * NU
    weights = np.concatenate([np.ones(n - NX), 9.0 * np.ones(NX), 0.25 * np.ones(m)])
    f = np.eye(K, k=-1)  # x_k enters knot k + 1
    J = np.hstack([np.kron(f, A) - np.eye(n), np.kron(np.eye(K), B)])
    h = np.concatenate([A @ np.asarray(problem.x_init), np.zeros(n - NX)])
    whole = np.block([[np.diag(weights), J.T], [J, np.zeros((n, n))]])
    x, u, lambda_ = np.split(
        np.linalg.solve(whole, np.concatenate([np.zeros(n + m), -h])), [n, n + m]
    )
    knots = Trajectory(jnp.asarray(x.reshape(K, NX)), jnp.asarray(u.reshape(K, NU)))
    none = Stagewise(jnp.zeros((K, 0)), jnp.zeros(0))
    multipliers = Multipliers(jnp.asarray(lambda_.reshape(K, NX)), none)
    nothing = jax.tree.map(jnp.zeros_like, knots)
    return problem, knots, multipliers, (nothing, nothing)


@pytest.mark.slow
def test_it_is_zero_at_a_known_optimum_and_grows_with_the_distance():
    problem, knots, multipliers, v = regulator()
    assert parts_of(problem, knots, multipliers, v).max() < 1e-14
    for size in (1e-6, 1e-3):
        moved = replace(knots, u=knots.u.at[1, 0].add(size))
        off = parts_of(problem, moved, multipliers, v)
        assert (0.01 * size < off[:2]).all()  # stationarity and defects
        assert (off < 10 * size).all()
        forced = replace(multipliers, dynamics=multipliers.dynamics + size)
        off = parts_of(problem, knots, forced, v)
        assert 0.01 * size < off[0] < 10 * size
        assert off[1:].max() < 1e-14


def nearest(x, slack, force, of_bound):
    """The residual for (2, 1), which u_0 + u_1 <= 2 and u_0 <= 1.2 keep at (1.2, 0.8)."""
    program = from_program(
        2,
        cost=lambda z: 0.5 * jnp.sum((z - jnp.array([2.0, 1.0])) ** 2),
        inequality=lambda z: jnp.sum(z)[None] - 2.0,
        bounds=([-3.0, -3.0], [1.2, 3.0]),
    )
    rows, none = Stagewise(jnp.array([[force]]), jnp.zeros(0)), jnp.zeros((1, 0))
    s = Stagewise(jnp.array([[slack]]), jnp.zeros(0))
    knots = Trajectory(none, jnp.array([x]), s)
    lower = Trajectory(none, jnp.zeros((1, 2)), Stagewise(jnp.array([[force]]), jnp.zeros(0)))
    upper = Trajectory(none, jnp.array([[of_bound, 0.0]]), jax.tree.map(jnp.zeros_like, s))
    return parts_of(program, knots, Multipliers(none, rows), (lower, upper))


@pytest.mark.slow
def test_complementarity_is_a_part_of_its_own():
    """Along u_1 = 1 - force and u_0 = 1.2 - gap slopes balance, and only force slack is left."""
    assert nearest([1.2, 0.8], 0.0, 0.2, 0.6).max() < 1e-15
    sizes = []
    for gap in (1e-4, 1e-2):
        off = nearest([1.2 - gap, 0.8], gap, 0.2, 0.6 + gap)
        assert off[:3].max() < 1e-14
        sizes.append(off[3])
    assert 1e-5 < sizes[0] < 1e-3
    assert sizes[1] == pytest.approx(100 * sizes[0], rel=0.05)
    assert nearest([1.2, 0.8], 0.0, 0.3, 0.6)[0] > 1e-2  # forces that do not balance
    assert nearest([1.2, 0.9], 0.0, 0.1, 0.7)[2] > 1e-2  # too far


@pytest.mark.slow
def test_the_price_is_what_the_cost_would_change_by_if_constraints_held():
    """Relative to three times what the slope of the cost promises, 0.8 1.2 + 0.2 0.8."""
    for off in (1e-4, -1e-3):
        at = nearest([1.2, 0.8 + off], 0.0, 0.2, 0.6)
        assert at[4] == pytest.approx(0.2 * abs(off) / (3.0 * 1.12), rel=0.02)
    usual = parts_of(*somewhere(everything()))
    assert parts_of(*somewhere(everything(wanted=50.0)))[4] > 5 * usual[4]


def test_rounding_is_no_motion_where_a_coordinate_has_no_box():
    problem = from_function(
        lambda x, u: x + jnp.array([1.0, 0.0]) * u,
        x_init=[0.0, 0.0],
        nu=1,
        dt=1.0,
        horizon=float(K),
        running_residual=lambda x, u: u,
        x_scatter=(0.0, 0.0),
    )
    x = np.zeros((K, NX))
    x[0, 1] = 1e-9  # which comes back in the next step
    knots = Trajectory(jnp.asarray(x), jnp.zeros((K, 1)))
    none = Stagewise(jnp.zeros((K, 0)), jnp.zeros(0))
    nothing = jax.tree.map(jnp.zeros_like, knots)
    found = parts_of(problem, knots, Multipliers(jnp.zeros((K, NX)), none), (nothing, nothing))
    np.testing.assert_allclose(found[1], 1e-9 / 0.01)


@pytest.mark.slow
def test_a_ball_joint_need_not_turn_about_its_axis():
    problem = from_mjcf(
        """<mujoco><option timestep="0.02"/><worldbody><body><joint name="b" type="ball"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 -0.4"/></body></worldbody><actuator>
        <motor joint="b" gear="1 0 0"/><motor joint="b" gear="0 1 0"/></actuator></mujoco>""",
        horizon=1.0,
        running_residual=lambda data, u: 0.1 * u,
        terminal_residual=lambda data: 10 * (data.site("tip").xpos - jnp.array([0.2, 0.1, -0.33])),
    )
    solution = solve(problem, chains=4, seed=0, progress=False)
    assert solution.optimal_chains.all()
