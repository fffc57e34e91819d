"""The Langevin flow on an equality-constrained quadratic program, whose answer is known.

min 1/2 z'Hz + g'z   s.t.   h(z) = Jz + h0 = 0,     z = [x_1..x_K, u_0..u_{K-1}]
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.linalg import block_diag

from mjx_drax import Constant, GaussNewton, Geometric, Identity, Langevin, Trajectory, from_function
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.problem.trajectory import box
from mjx_drax.search import iterate
from mjx_drax.search.iterate import evaluate

K, NX, NU = 4, 2, 1
A = np.array([[1.0, 0.3], [-0.4, 0.9]])
B = np.array([[0.1], [0.5]])
X0 = np.array([1.0, -2.0])
WX, WU, WT = np.array([0.5, 1.0]), 0.8, 3.0
TARGET = np.array([0.3, -0.2])
N = K * NX

H = block_diag(*[np.diag(WX**2)] * (K - 1), WT**2 * np.eye(NX), WU**2 * np.eye(K * NU))
g = np.concatenate([np.zeros(N - NX), -(WT**2) * TARGET, np.zeros(K * NU)])
J = np.hstack([np.kron(np.eye(K, k=-1), A) - np.eye(N), np.kron(np.eye(K), B)])
h0 = np.concatenate([A @ X0, np.zeros(N - NX)])
KKT = np.block([[H, J.T], [J, np.zeros((N, N))]])
Z, LAMBDA = np.split(np.linalg.solve(KKT, -np.concatenate([g, h0])), [len(H)])

QUIET = Langevin(noise=Constant(0.0), damping=Constant(0.0))


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def linear(A, B, x, u):
    return A @ x + B @ u


def running(weight, x, u):
    return jnp.concatenate([WX * x, weight * u])


def terminal(x):
    return WT * (x - TARGET)


def program(x_init=X0, weight=WU, **rest):
    return from_function(
        Partial(linear, A, B),
        x_init=x_init,
        nu=NU,
        dt=0.1,
        horizon=K * 0.1,
        running_residual=Partial(running, weight),
        terminal_residual=terminal,
        **rest,
    )


def advance(*arguments):
    return iterate.advance(*arguments)[0]


def compilations():
    return iterate.iterate._cache_size()


def start(solver, problem, chains=1, seed=0, knots=None):
    rng = np.random.default_rng(seed)
    x, u = knots or (rng.normal(size=(chains, K, NX)), rng.normal(size=(chains, K, NU)))
    knots = Trajectory(jnp.asarray(x), jnp.asarray(u))
    return iterate.start(solver, problem, knots, jax.random.key(seed))


def z(state):
    x, u = state.trajectory.x, state.trajectory.u
    return np.hstack([x.reshape(len(x), -1), u.reshape(len(u), -1)])


def assert_optimal(state, atol):
    np.testing.assert_allclose(z(state)[0], Z, atol=atol)
    np.testing.assert_allclose(state.multipliers.dynamics[0].ravel(), LAMBDA, atol=atol)


def test_the_program_is_the_one_that_the_solver_sees():
    problem, state = program(), start(QUIET, program())
    info = evaluate(problem, state.trajectory)
    point, at_x0 = z(state)[0], 0.5 * np.sum(np.square(WX * X0))
    np.testing.assert_allclose(
        info.cost, [0.5 * point @ H @ point + g @ point + at_x0 + WT**2 * TARGET @ TARGET / 2]
    )
    h = np.abs(J @ point + h0).reshape(K, NX) / problem.defect_scale
    np.testing.assert_allclose(info.max_defect, [h.max()])


@pytest.mark.parametrize("iterations", [(0, 8), (8, 0)], ids=["line search", "full steps"])
def test_gauss_newton_reaches_the_kkt_point_in_a_few_iterations(iterations):
    solver = replace(QUIET, step_size=1.0, penalty=Constant(1e4))
    solver = replace(solver, iterations=iterations[0], tail=iterations[1])
    problem = program()
    assert_optimal(advance(solver, problem, start(solver, problem), 0, sum(iterations)), 1e-9)


def test_gauss_newtons_partial_steps_reach_it_too():
    solver = replace(QUIET, step_size=0.3, penalty=Constant(1e3), iterations=200)
    problem = program()
    assert_optimal(advance(solver, problem, start(solver, problem), 0, 200), 1e-9)


@register_dataclass
@dataclass(frozen=True)
class Kinked(FunctionDynamics):
    kinked = True
    state_damping = 0.01


@pytest.mark.slow
def test_states_are_damped_less_where_f_has_kinks():
    """A full step is -(H + mu J'J + delta D)^-1 grad; another number does not recompile."""
    quiet, problem, delta, mu = Langevin(noise=Constant(0.0)), program(), 0.3, 5.0
    f = problem.dynamics
    kinked = replace(problem, dynamics=Kinked(f.function, f.dt, f.nx, f.nu))
    compiled = []
    for task, given, of_states in (
        (kinked, None, 0.01),
        (kinked, 0.5, 0.5),
        (kinked, 0.2, 0.2),
        (problem, None, 1.0),
    ):
        solver = replace(
            quiet,
            step_size=1.0,
            penalty=Constant(mu),
            damping=Constant(delta),
            preconditioner=GaussNewton(state_damping=given),
        )
        state = start(solver, task)
        point, D = z(state)[0], np.diag([of_states] * N + [1.0] * K * NU)
        slope = H @ point + g + mu * J.T @ (J @ point + h0)
        expected = point - np.linalg.solve(H + mu * J.T @ J + delta * D, slope)
        np.testing.assert_allclose(z(advance(solver, task, state, 0, 1))[0], expected, rtol=1e-9)
        compiled.append(compilations())
    assert compiled[1] == compiled[2]


@pytest.mark.slow
@pytest.mark.parametrize("noisy", [0, 2])
def test_the_loop_that_diagnoses_does_what_the_loop_and_a_diagnosis_do(noisy):
    problem = program()
    f = problem.dynamics
    kinked = replace(problem, dynamics=Kinked(f.function, f.dt, f.nx, f.nu))
    solver = Langevin(iterations=noisy, tail=4, preconditioner=GaussNewton(state_damping=0.01))
    state = start(solver, kinked)
    for first, last in ((0, 0), (0, 3), (0, 4 + noisy)):
        moved, info = iterate.advance(solver, kinked, state, first, last)
        expected, wanted = iterate.advance(solver, problem, state, first, last)
        np.testing.assert_allclose(z(moved), z(expected), rtol=1e-12)
        np.testing.assert_allclose(moved.damping, expected.damping)
        np.testing.assert_allclose(info.cost, wanted.cost, rtol=1e-12)
        np.testing.assert_allclose(info.max_defect, wanted.max_defect, rtol=1e-6, atol=1e-12)
    assert info.max_defect.max() > 0.0


MU = 2.0
ALPHA = 0.2 / np.linalg.eigvalsh(H + MU * J.T @ J).max()
PAPER = replace(
    QUIET, preconditioner=Identity(), penalty=Constant(MU), step_size=ALPHA, iterations=10**6
)


def test_the_papers_flow_reaches_the_kkt_point():
    problem = program()
    assert_optimal(advance(PAPER, problem, start(PAPER, problem), 0, 20_000), 1e-8)


def test_the_papers_flow_without_noise_is_primal_dual_descent():
    problem = program()
    state = start(PAPER, problem)
    point, multipliers = z(state)[0], np.zeros(N)
    for i in range(30):
        h = J @ point + h0
        slope = H @ point + g + J.T @ (multipliers + MU * h)
        point, multipliers = point - ALPHA * slope, multipliers + 2 * ALPHA * MU * h
        state = advance(PAPER, problem, state, i, i + 1)
        np.testing.assert_allclose(z(state)[0], point, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(state.multipliers.dynamics[0].ravel(), multipliers, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preconditioner", "M"),
    [(Identity(), np.eye(len(H))), (GaussNewton(), H + MU * J.T @ J + 0.1 * np.eye(len(H)))],
    ids=["identity", "gauss-newton"],
)
def test_the_noise_of_a_step_has_covariance_2_alpha_sigma2_over_M(preconditioner, M):
    chains, sigma, alpha = 20_000, 0.7, 0.1
    quiet = replace(
        QUIET,
        preconditioner=preconditioner,
        penalty=Constant(MU),
        damping=Constant(0.1),
        step_size=alpha,
    )
    noisy, problem = replace(quiet, noise=Constant(sigma)), program()
    knots = np.ones((chains, K, NX)), np.ones((chains, K, NU))
    state = start(quiet, problem, knots=knots)
    moved = z(advance(noisy, problem, state, 0, 1)) - z(advance(quiet, problem, state, 0, 1))
    white = moved @ np.linalg.cholesky(M) / (sigma * np.sqrt(2 * alpha))
    np.testing.assert_allclose(white.mean(0), 0, atol=6 / chains**0.5)
    np.testing.assert_allclose(
        white.T @ white / chains, np.eye(len(M)), atol=6 * (2 / chains) ** 0.5
    )


def test_the_tail_has_no_noise():
    problem = program()
    solver = replace(QUIET, noise=Constant(5.0), iterations=0, tail=3)
    knots = np.ones((2, K, NX)), np.ones((2, K, NU))  # two chains, same knots, other keys
    first, second = z(advance(solver, problem, start(solver, problem, knots=knots), 0, 3))
    np.testing.assert_array_equal(first, second)


def identical(one, other):
    same = jax.tree.map(
        lambda a, b: np.array_equal(a, b, equal_nan=True), *map(numbers, (one, other))
    )
    return all(jax.tree.leaves(same))


def numbers(state):
    return replace(state, key=jax.random.key_data(state.key))


NOISY = Langevin(iterations=14, tail=6)


@pytest.mark.parametrize(
    "preconditioner", [pytest.param(GaussNewton(), marks=pytest.mark.slow), Identity()]
)
def test_chunks_do_not_matter(preconditioner):
    solver, problem = replace(NOISY, preconditioner=preconditioner, step_size=1e-3), program()
    state = start(solver, problem, chains=3)
    whole = advance(solver, problem, state, 0, 20)
    halves = advance(solver, problem, advance(solver, problem, state, 0, 9), 9, 20)
    assert identical(whole, halves)
    assert identical(whole, advance(solver, problem, state, 0, 20))
    assert not np.array_equal(z(whole), z(state))


def test_the_noise_of_a_chain_depends_on_the_seed_and_not_on_its_neighbours():
    problem = program()
    knots = np.ones((3, K, NX)), np.ones((3, K, NU))
    ran = advance(NOISY, problem, start(NOISY, problem, knots=knots), 0, 5)
    one = tuple(a[:1] for a in knots)
    alone = advance(NOISY, problem, start(NOISY, problem, knots=one), 0, 5)
    other = advance(NOISY, problem, start(NOISY, problem, knots=one, seed=1), 0, 5)
    np.testing.assert_allclose(z(alone)[0], z(ran)[0], rtol=1e-9)
    assert np.abs(z(ran)[0] - z(ran)[1]).max() > 1e-3
    assert np.abs(z(ran)[0] - z(other)[0]).max() > 1e-3


def test_a_chain_that_turns_nan_is_frozen_and_leaves_the_others_alone():
    problem = program()
    state = advance(NOISY, problem, start(NOISY, problem, chains=3), 0, 4)
    bad = state.multipliers.dynamics.at[1, 0, 0].set(jnp.nan)
    sick = replace(state, multipliers=replace(state.multipliers, dynamics=bad))
    healthy, ill = (advance(NOISY, problem, s, 4, 20) for s in (state, sick))
    np.testing.assert_array_equal(ill.died_at, [-1, 4, -1])
    np.testing.assert_array_equal(ill.alive, [True, False, True])
    np.testing.assert_array_equal(z(ill)[1], z(state)[1])  # where it last was finite
    np.testing.assert_array_equal(z(ill)[[0, 2]], z(healthy)[[0, 2]])
    np.testing.assert_array_equal(ill.multipliers.dynamics[::2], healthy.multipliers.dynamics[::2])


def test_a_chain_that_starts_with_nan_knots_dies_at_once():
    problem = program()
    x, u = np.ones((3, K, NX)), np.ones((3, K, NU))
    healthy = advance(NOISY, problem, start(NOISY, problem, knots=(x, u)), 0, 20)
    spoiled = x.copy()
    spoiled[2, 1, 0] = np.nan
    ill = advance(NOISY, problem, start(NOISY, problem, knots=(spoiled, u)), 0, 20)
    np.testing.assert_array_equal(ill.died_at, [-1, -1, 0])
    np.testing.assert_array_equal(z(ill)[:2], z(healthy)[:2])


def test_a_chain_that_overflows_is_frozen_at_finite_knots():
    problem = program()
    violent = replace(PAPER, step_size=1e3)
    state = advance(violent, problem, start(violent, problem), 0, 1000)
    assert 0 < state.died_at[0] < 1000
    assert np.isfinite(z(state)).all()


@pytest.mark.slow
def test_numbers_change_without_recompiling():
    traced = []

    def counted(weight, x, u):
        traced.append(weight)
        return running(weight, x, u)

    def make(weight=WU, **rest):
        problem = program(x_bounds=(-3.0, 3.0), u_bounds=(-1.0, 1.0), **rest)
        return replace(problem, running=replace(problem.running, residual=Partial(counted, weight)))

    base = Langevin(
        iterations=6,
        tail=3,
        noise=Geometric(10.0, 0.1),
        penalty=Geometric(100.0, 1000.0),
        damping=Geometric(0.1, 1e-3),
        barrier_weight=Geometric(0.1, 1e-3, 1e-6),
    )
    cases = [
        (base, make()),
        (base, make(x_init=X0 + 1)),
        (base, make(weight=2.0)),
        (base, replace(make(), bounds=box(NX, NU, (-4.0, 3.0), (-np.inf, 2.0)))),
        (replace(base, iterations=3, tail=5), make()),
        (replace(base, step_size=0.1), make()),
        (replace(base, noise=Geometric(1.0, 0.1)), make()),
        (replace(base, penalty=Geometric(10.0, 20.0)), make()),
        (replace(base, damping=Geometric(1.0, 0.1)), make()),
        (replace(base, barrier_weight=Geometric(1.0, 0.1, 1e-3)), make()),
        (replace(base, bounds=replace(base.bounds, floor=1e-4, fraction=0.5)), make()),
    ]
    before, answers = compilations(), []
    for solver, problem in cases:
        state = start(solver, problem, chains=2)
        for begin in range(0, 8, 4):
            state = advance(solver, problem, state, begin, begin + 4)
        answers.append(z(state))
        traced.append("case")
    assert compilations() - before == 1
    assert set(traced[traced.index("case") :]) == {"case"}  # traced for the first case only
    for answer in answers[1:]:
        assert not np.array_equal(answer, answers[0])  # every one of these numbers matters


def test_products_are_not_rounded_on_gpus():
    """By default JAX rounds their factors to 10 bits (TF32) there, and defects stall at 1e-3."""
    solver = replace(QUIET, iterations=1, tail=1)
    shared, own = iterate.partition(iterate.Question(solver, program()), None)
    rows = start(solver, program()), own
    text = iterate.iterate.lower(rows, shared, 0, 2).as_text()
    products = [line for line in text.splitlines() if "stablehlo.dot_general" in line]
    assert products
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)
