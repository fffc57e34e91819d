"""The Riccati recursion against dense linear algebra, M = H + mu J'J, and against textbook LQR."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_are

from mjx_drax.method.model import Linearization, QuadraticCost
from mjx_drax.method.riccati import White, factorize, newton, solve_and_sample
from mjx_drax.studies.recursion import of_joint

K, NDX, NU = 6, 3, 2
KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def drawn(seed):
    """A linear model, a convex quadratic cost and multipliers, all random."""
    rng = np.random.default_rng(seed)
    A, B, h = (rng.normal(size=(K, NDX, *n)) for n in [(NDX,), (NU,), ()])
    root = rng.normal(size=(K + 1, NDX + NU, NDX + NU))
    H = root @ root.swapaxes(1, 2) + 0.1 * np.eye(NDX + NU)
    g = rng.normal(size=(K + 1, NDX + NU))
    return Linearization(A, B, h), of_joint(H, g, NDX), rng.normal(size=(K, NDX))


def dense(model, cost):
    """Hessian H, gradient g and Jacobian J over z = [x_1..x_K, u_0..u_{K-1}]."""
    n = K * NDX
    H = block_diag(*cost.Hxx[1:], *cost.Huu)
    for k in range(1, K):  # x_k is in block k - 1
        x, u = slice((k - 1) * NDX, k * NDX), slice(n + k * NU, n + (k + 1) * NU)
        H[u, x] = cost.Hux[k]
        H[x, u] = cost.Hux[k].T
    from_states = -np.eye(n)
    from_states[NDX:, :-NDX] += block_diag(*model.A[1:])
    J = np.hstack([from_states, block_diag(*model.B)])
    return H, np.concatenate([cost.gx[1:].ravel(), cost.gu.ravel()]), J


def flat(x, u):
    return np.concatenate([np.ravel(x), np.ravel(u)])


def white(key, dtype=None):
    key_u, key_e = jax.random.split(key)
    return White(
        jax.random.normal(key_u, (K, NU), dtype), jax.random.normal(key_e, (K, NDX), dtype)
    )


@pytest.mark.parametrize("mu", [0.1, 10.0, 1e5])
@pytest.mark.parametrize("seed", [0, 1])
def test_step_is_newtons_and_multipliers_follow_the_predicted_defect(mu, seed):
    model, cost, multipliers = drawn(seed)
    H, g, J = dense(model, cost)
    h, lam = model.h.ravel(), multipliers.ravel()
    d = -np.linalg.solve(H + mu * J.T @ J, g + J.T @ (lam + mu * h))
    step = jax.jit(newton)(model, cost, multipliers, mu, white(KEY))
    np.testing.assert_allclose(flat(step.dx, step.du), d, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(np.ravel(step.rate), mu * (h + J @ d), rtol=1e-7, atol=1e-5)


def test_without_a_penalty_the_linearized_dynamics_hold_and_noise_stays_on_them():
    model, cost, multipliers = drawn(5)
    H, g, J = dense(model, cost)
    zero, h = np.zeros((len(J), len(J))), model.h.ravel()
    d, of_rows = np.split(np.linalg.solve(np.block([[H, J.T], [J, zero]]), -np.r_[g, h]), [len(g)])
    step = jax.jit(newton)(model, cost, multipliers, None, white(KEY))
    np.testing.assert_allclose(flat(step.dx, step.du), d, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(np.ravel(step.rate), of_rows - multipliers.ravel(), atol=1e-6)
    noise = flat(step.noise_x, step.noise_u)
    np.testing.assert_allclose(J @ noise, 0, atol=1e-9)
    assert np.abs(noise).max() > 0.1


def test_float32_needs_no_digits_for_the_penalty():
    model, cost, multipliers = drawn(2)
    H, g, J = dense(model, cost)
    mu = 1e6  # M has a condition number far beyond 1 / eps
    d = -np.linalg.solve(H + mu * J.T @ J, g + J.T @ (multipliers.ravel() + mu * model.h.ravel()))
    single = jax.tree.map(np.float32, (model, cost, multipliers, mu))
    step = jax.jit(newton)(*single, white(KEY, np.float32))
    assert step.dx.dtype == np.float32
    np.testing.assert_allclose(flat(step.dx, step.du), d, rtol=1e-3, atol=1e-3 * np.abs(d).max())


@pytest.mark.parametrize(
    "mu",
    [0.1, pytest.param(10.0, marks=pytest.mark.slow), pytest.param(1e4, marks=pytest.mark.slow)],
)
def test_noise_covariance_is_exactly_the_inverse_of_M(mu):
    model, cost, multipliers = drawn(3)
    H, _, J = dense(model, cost)

    def noise(numbers):
        drawn = White(numbers[: K * NU].reshape(K, NU), numbers[K * NU :].reshape(K, NDX))
        _, factors = factorize(model, cost, multipliers, mu)
        step = solve_and_sample(model, factors, multipliers, mu, drawn)
        return jnp.concatenate([step.noise_x.ravel(), step.noise_u.ravel()])

    zero = np.zeros(K * (NDX + NU))
    assert not np.any(noise(zero))
    L = jax.jit(jax.jacfwd(noise))(zero)
    inverse = np.linalg.inv(H + mu * J.T @ J)
    np.testing.assert_allclose(L @ L.T, inverse, rtol=1e-8, atol=1e-8 * inverse.max())


def test_sampled_noise_is_white_in_the_metric():
    model, cost, multipliers = drawn(4)
    H, _, J = dense(model, cost)
    mu, samples = 10.0, 20_000
    drawn_white = jax.vmap(white)(jax.random.split(KEY, samples))
    over_noise = jax.jit(jax.vmap(newton, (None, None, None, None, 0)))
    step = over_noise(model, cost, multipliers, mu, drawn_white)
    n = np.hstack([step.noise_x.reshape(samples, -1), step.noise_u.reshape(samples, -1)])
    whitened = n @ np.linalg.cholesky(H + mu * J.T @ J)  # L'n ~ N(0, I) for M = L L'
    np.testing.assert_allclose(whitened.mean(0), 0, atol=6 / samples**0.5)
    covariance = whitened.T @ whitened / samples
    np.testing.assert_allclose(covariance, np.eye(len(H)), atol=6 * (2 / samples) ** 0.5)


def batch(chains, dtype):
    """Different problems for every chain, penalties included."""
    problems = [drawn(seed) for seed in range(chains)]
    model, cost, multipliers = jax.tree.map(lambda *a: np.stack(a), *problems)
    numbers = jax.vmap(white)(jax.random.split(KEY, chains))
    arguments = model, cost, multipliers, np.geomspace(10.0, 1e4, chains), numbers
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), arguments)


def test_without_white_numbers_there_is_no_noise():
    model, cost, multipliers, mu, numbers = batch(3, np.float64)
    noisy = jax.jit(jax.vmap(newton))(model, cost, multipliers, mu, numbers)
    plain = jax.jit(jax.vmap(newton))(model, cost, multipliers, mu)
    assert plain.noise_x is None
    assert plain.noise_u is None
    for name in ("dx", "du", "rate", "gains"):
        np.testing.assert_allclose(
            getattr(plain, name), getattr(noisy, name), rtol=1e-9, atol=1e-9, err_msg=name
        )


def test_maps_may_be_nested_and_arguments_shared():
    model, cost, multipliers, mu, numbers = batch(6, np.float64)
    cost = jax.tree.map(lambda a: a[0], cost)

    def alone(i):
        own, own_numbers = jax.tree.map(lambda a: a[i], (model, numbers))
        return one(own, cost, multipliers[i], mu[0], own_numbers)

    one = jax.jit(newton)
    steps = [alone(i) for i in range(6)]
    fold = jax.tree.map(lambda a: a.reshape(2, 3, *a.shape[1:]), (model, multipliers, numbers))
    inner = jax.vmap(newton, (0, None, 0, None, 0))
    nested = jax.jit(jax.vmap(inner, (0, None, 0, None, 0)))(fold[0], cost, fold[1], mu[0], fold[2])
    for name in ("dx", "rate", "gains"):
        expected = np.stack([getattr(step, name) for step in steps])
        np.testing.assert_allclose(
            getattr(nested, name).reshape(expected.shape), expected, rtol=1e-9, atol=1e-9
        )


def lqr(A, B, cost):
    """Textbook gains of u_k = K_k x_k, backwards from the terminal cost."""
    P, gains = cost.Hxx[-1], []
    for k in reversed(range(len(A))):
        Quu = cost.Huu[k] + B[k].T @ P @ B[k]
        Qux = cost.Hux[k] + B[k].T @ P @ A[k]
        gains.append(-np.linalg.solve(Quu, Qux))
        P = cost.Hxx[k] + A[k].T @ P @ A[k] - Qux.T @ np.linalg.solve(Quu, Qux)
    return np.array(gains[::-1])


def test_stiff_penalty_gives_lqr():
    model, cost, multipliers = drawn(5)
    gains = jax.jit(factorize)(model, cost, multipliers, 1e10)[1].gains
    np.testing.assert_allclose(gains, lqr(model.A, model.B, cost), rtol=1e-6, atol=1e-6)


def test_long_horizon_gives_the_stationary_lqr():
    rng = np.random.default_rng(6)
    A, B, long = rng.normal(size=(NDX, NDX)), rng.normal(size=(NDX, NU)), 100
    Q, R = np.eye(NDX), 2.0 * np.eye(NU)
    P = solve_discrete_are(A, B, Q, R)
    stationary = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)

    def every(a, n=long):
        return np.broadcast_to(a, (n, *a.shape))

    model = Linearization(every(A), every(B), np.zeros((long, NDX)))
    cost = QuadraticCost(
        np.zeros((long + 1, NDX)),
        np.zeros((long, NU)),
        every(Q, long + 1),
        np.zeros((long, NU, NDX)),
        every(R),
    )
    before, factors = jax.jit(factorize)(model, cost, np.zeros((long, NDX)), 1e10)
    np.testing.assert_allclose(factors.gains[0], stationary, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(factors.P[0], P, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(before[0], P, rtol=1e-6, atol=1e-6)
