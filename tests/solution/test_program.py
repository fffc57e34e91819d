"""Nonlinear programs that are not trajectories: KKT points in closed form, and scipy's.

min c(x)   s.t.   h(x) = 0,   g(x) <= 0,   lower <= x <= upper
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import NonlinearConstraint
from scipy.optimize import minimize as scipy_minimize

from mjx_drax import (
    Constant,
    DraxError,
    Geometric,
    Identity,
    Langevin,
    Polish,
    Restarts,
    Trajectory,
    from_function,
)
from mjx_drax.search.iterate import advance, start
from mjx_drax.solution.program import from_program, minimize


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


# min 1/2 x'Qx + q'x   s.t.   Ax = b: three unknowns, two constraints, both multipliers far from 0
Q = np.array([[3.0, 1.0, 0.0], [1.0, 2.0, -0.5], [0.0, -0.5, 1.0]])
q = np.array([1.0, -2.0, 0.5])
A = np.array([[1.0, 1.0, 1.0], [1.0, -2.0, 0.0]])
b = np.array([1.0, 0.5])
X, LAMBDA = np.split(
    np.linalg.solve(np.block([[Q, A.T], [A, np.zeros((2, 2))]]), np.append(-q, b)), [3]
)
MU = 2.0
ALPHA = 0.2 / np.linalg.eigvalsh(Q + MU * A.T @ A).max()
PLATT_BARR = Langevin(
    preconditioner=Identity(),
    noise=Constant(0.0),
    penalty=Constant(MU),
    step_size=ALPHA,
    iterations=5000,
    tail=0,
)


def quadratic(x):
    return 0.5 * x @ Q @ x + q @ x


@pytest.fixture(scope="module")
def linear():
    with jax.enable_x64(True):
        return from_program(3, cost=quadratic, equality=lambda x: A @ x - b)


@pytest.mark.parametrize("solver", [Langevin(), PLATT_BARR], ids=["gauss-newton", "platt-barr"])
@pytest.mark.slow
def test_every_chain_reaches_the_kkt_point(linear, solver):
    assert np.abs(LAMBDA).min() > 0.2
    found = minimize(linear, chains=3, solver=solver)
    np.testing.assert_allclose(found.x, np.tile(X, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(found.equality, np.tile(LAMBDA, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(found.cost, quadratic(X), atol=1e-5)
    assert found.inequality.shape == (3, 0)
    assert found.max_defect.max() < 1e-6


def test_a_residual_is_half_its_square(linear):
    root = np.linalg.cholesky(Q).T  # |R x + R^-T q|^2 / 2 = c(x) + a constant
    offset = np.linalg.solve(root.T, q)
    program = from_program(3, residual=lambda x: root @ x + offset, equality=lambda x: A @ x - b)
    for x in np.random.default_rng(0).normal(size=(3, 3)):
        at = Trajectory(jnp.zeros((1, 0)), jnp.asarray(x)[None])
        assert program.cost(at) == pytest.approx(linear.cost(at) + offset @ offset / 2)
        assert program.max_defect(at) == pytest.approx(np.abs(A @ x - b).max())


@pytest.mark.slow
def test_without_noise_the_papers_flow_is_the_differential_multiplier_method(linear):
    x, multipliers = np.array([1.0, -1.0, 2.0]), np.zeros(2)
    knots = Trajectory(jnp.zeros((1, 1, 0)), jnp.asarray(x)[None, None])
    state = start(PLATT_BARR, linear, knots, jax.random.key(0))
    for i in range(25):
        h = A @ x - b
        slope = Q @ x + q + A.T @ (multipliers + MU * h)
        x, multipliers = x - ALPHA * slope, multipliers + 2 * ALPHA * MU * h
        state, _ = advance(PLATT_BARR, linear, state, i, i + 1)
        np.testing.assert_allclose(state.trajectory.u[0, 0], x, rtol=1e-12)
        rows = state.multipliers.constraints.stage[0, 0]
        np.testing.assert_allclose(rows, multipliers, rtol=1e-12)


@pytest.mark.slow
def test_inequalities_and_bounds_active_and_not():
    # The answer comes first; q is whatever makes it stationary: Qx + q + G'nu - below + above = 0
    x = np.array([0.0, 0.7, 2.0])  # at its lower bound, free, at its upper bound
    G = np.array([[1.0, 2.0, -1.0], [0.5, -1.0, 1.0]])
    nu, limit = np.array([0.8, 0.0]), G @ x + np.array([0.0, 0.6])  # first row active, second not
    walls = np.array([-0.9, 0.0, 1.1])
    linear = -(Q @ x + G.T @ nu + walls)

    def cost(x):
        return 0.5 * x @ Q @ x + linear @ x

    program = from_program(
        3, cost=cost, inequality=lambda x: G @ x - limit, bounds=([0.0, -4.0, -4.0], [4.0, 4.0, 2])
    )
    solver = Langevin(tail=150, barrier_weight=Geometric(0.1, 0.01, 3e-6))
    found = minimize(program, chains=4, solver=solver)
    np.testing.assert_allclose(found.x, np.tile(x, (4, 1)), atol=1e-5)
    np.testing.assert_allclose(found.inequality, np.tile(nu, (4, 1)), atol=1e-5)
    assert (found.inequality > 0).all()
    slack = limit - found.x @ G.T
    np.testing.assert_allclose(found.inequality * slack, 0, atol=2e-5)
    assert found.max_defect.max() < 2e-5


def hs071():
    """Hock and Schittkowski's problem 71; x = (1, 4.743, 3.821, 1.379), c = 17.0140."""
    return {
        "cost": lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2],
        "equality": lambda x: jnp.sum(jnp.square(x))[None] - 40.0,
        "inequality": lambda x: 25.0 - jnp.prod(x)[None],
    }


@pytest.mark.slow
def test_hs071_and_its_multipliers_are_those_of_the_book_and_of_scipy():
    parts = hs071()
    program = from_program(4, **parts, bounds=(1.0, 5.0))
    solver = Langevin(tail=200, barrier_weight=Geometric(0.1, 0.01, 1e-6))
    found = minimize(program, chains=16, solver=solver)
    best = found.best_chain
    np.testing.assert_allclose(found.best, [1.0, 4.74299963, 3.82114998, 1.37940829], atol=1e-3)
    assert found.cost[best] == pytest.approx(17.0140173, abs=2e-3)
    assert (np.abs(found.cost - 17.0140173) < 2e-3).mean() > 0.5

    def constraint(name, ends):
        function = jax.jit(parts[name])
        return NonlinearConstraint(function, *ends, jac=jax.jit(jax.jacobian(parts[name])))

    reference = scipy_minimize(
        jax.jit(parts["cost"]),
        [1.0, 5.0, 5.0, 1.0],
        jac=jax.jit(jax.grad(parts["cost"])),
        bounds=[(1.0, 5.0)] * 4,
        constraints=[constraint("equality", (0, 0)), constraint("inequality", (-np.inf, 0))],
        method="trust-constr",
        options={"gtol": 1e-9, "xtol": 1e-9, "barrier_tol": 1e-9},
    )
    np.testing.assert_allclose(found.best, reference.x, atol=1e-3)
    np.testing.assert_allclose(found.equality[best], reference.v[0], atol=1e-3)
    np.testing.assert_allclose(found.inequality[best], reference.v[1], atol=1e-3)


def _slopes_at(x):
    """Slopes of cost, equality and inequality of hs071."""
    parts = hs071()
    names = "cost", "equality", "inequality"
    return [np.ravel(jax.jacobian(parts[name])(jnp.asarray(x))) for name in names]


@pytest.mark.slow
def test_the_polish_goes_to_the_tolerance_of_the_precision_or_to_the_one_given():
    """hs071 to all digits of the book; what is optimal is judged by the same tolerance."""
    program = from_program(4, **hs071(), bounds=(1.0, 5.0))
    found = minimize(program, chains=4)
    assert found.tolerance == 1e-8
    assert found.status == 4 * ["optimal"]
    best = found.best_chain  # there is a second local optimum
    np.testing.assert_allclose(found.x[best], [1.0, 4.7429994, 3.8211503, 1.3794082], atol=1e-6)
    np.testing.assert_allclose(found.cost[best], 17.0140173, atol=1e-6)
    forces = found.equality[best, 0], found.inequality[best, 0]
    slope, of_equality, of_inequality = _slopes_at(found.x[best])
    left = slope + of_equality * forces[0] + of_inequality * forces[1]
    np.testing.assert_allclose(left[1:], 0.0, atol=1e-6)  # x_0 lies on its bound,
    assert left[0] > 0.1  # which pushes back
    loose = minimize(program, chains=4, solver=Restarts(polish=Polish(1e-3)))
    assert loose.tolerance == 1e-3
    assert ((loose.residual > 1e-8) & (loose.residual < 1e-3)).all()


@pytest.mark.slow
def test_noise_finds_the_global_minimum_of_several():
    # On the unit circle c = cos(3 angle) + x_2 has three minima
    def cost(x):
        return 4.0 * x[0] ** 3 - 3.0 * x[0] + x[1]

    program = from_program(
        2, cost=cost, equality=lambda x: (x @ x - 1.0)[None], scatter=(-1.5, 1.5)
    )
    angle = np.linspace(0, 2 * np.pi, 100_001)
    curve = np.cos(3 * angle) + np.sin(angle)
    minima = (curve[1:-1] < curve[:-2]) & (curve[1:-1] < curve[2:])
    assert minima.sum() == 3
    lowest = curve.min()
    noisy = Langevin(
        preconditioner=Identity(),
        noise=Geometric(1.0, 0.1),
        penalty=Constant(10.0),
        step_size=0.01,
        iterations=4000,
        tail=200,
    )
    shares = []
    for solver in (noisy, replace(noisy, noise=Constant(0.0))):
        found = minimize(program, chains=128, solver=solver)
        shares.append(((found.cost < lowest + 0.01) & (found.max_defect < 1e-3)).mean())
        assert found.cost[found.best_chain] == pytest.approx(lowest, abs=2e-3)
    assert shares[0] > shares[1] + 0.2, shares
    assert shares[0] > 0.7, shares


def test_a_guess_is_where_the_chains_start(linear):
    still = replace(PLATT_BARR, step_size=0.0, iterations=1)
    one, each = np.arange(3.0), np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(
        minimize(linear, chains=2, solver=still, guess=one).x, np.tile(one, (2, 1))
    )
    np.testing.assert_array_equal(minimize(linear, chains=2, solver=still, guess=each).x, each)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cost": lambda x: x}, r"cost returned shape \(2,\).*must return a scalar"),
        ({"cost": jnp.sum, "bounds": ([0.0, 3.0], [1.0, 2.0])}, "cross at element 1.*3.*2"),
        ({}, "program has no cost"),
        ({"cost": jnp.sum, "bounds": ([0.0] * 3, 1.0)}, r"\(2,\)"),
        ({"cost": jnp.sum, "equality": lambda x: x @ jnp.ones(5)}, "equality failed"),
        ({"cost": jnp.sum, "inequality": lambda x: x > 0}, "inequality returned"),
    ],
)
def test_misfits_are_named(arguments, message):
    with pytest.raises(DraxError, match=message):
        from_program(2, **arguments)


def test_minimize_names_what_it_cannot_take(linear):
    with pytest.raises(DraxError, match=r"guess has shape.*2.*3"):
        minimize(linear, chains=2, guess=np.ones(2))
    trajectory = from_function(
        lambda x, u: x + u, x_init=[0.0], nu=1, dt=1.0, horizon=1.0, terminal_cost=lambda x: x @ x
    )
    with pytest.raises(DraxError, match=r"trajectory problem: use mjx_drax\.solve"):
        minimize(trajectory)
    with pytest.raises(DraxError, match="value of cost is not finite at the initial points"):
        minimize(from_program(1, cost=lambda x: jnp.log(-1.0 - x[0] ** 2)), chains=2)


def test_a_guess_that_is_a_number_is_named(linear):
    with pytest.raises(DraxError, match="guess"):
        minimize(linear, chains=2, guess=0.0)


@pytest.mark.parametrize("units", [1e-6, pytest.param(1e3, marks=pytest.mark.slow), 1e6])
def test_units_of_constraints_do_not_matter(units):
    program = from_program(
        4,
        cost=lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2],
        equality=lambda x: units * jnp.array([x @ x - 40.0]),
        inequality=lambda x: units * jnp.array([25.0 - jnp.prod(x)]),
        bounds=(1.0, 5.0),
    )
    found = minimize(program, chains=4)
    assert found.status == ["optimal"] * 4  # Hock and Schittkowski's problem 71
    assert found.cost == pytest.approx(17.0140173, rel=1e-4)
    assert units * found.equality[0] == pytest.approx([0.161469], rel=1e-2)
    assert units * found.inequality[0] == pytest.approx([0.552294], rel=1e-2)


def test_a_cost_without_a_lower_bound_is_told():
    falls = from_program(2, cost=lambda x: x[1] ** 2 - x[0])
    assert "as if it had no lower bound: bound what it rewards" in str(minimize(falls, chains=2))


def test_a_program_has_no_knots_and_no_times():
    opposed = from_program(1, cost=lambda x: x @ x, equality=lambda x: jnp.append(x, x - 1.0))
    last = str(minimize(opposed, chains=2)).splitlines()[-1]
    assert last.startswith("infeasible: breaks equality [")
    assert "knot" not in last
