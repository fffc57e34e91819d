"""Scalar arithmetic against the functions it stands for; what it prunes, and when it gives up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import Literal

from mjx_drax.kernels.pruning import pruned
from mjx_drax.kernels.scalars import scalarize
from mjx_drax.kernels.scalars.arithmetic import IN_KERNELS
from mjx_drax.kernels.scalars.scalarize import scalarized

RNG = np.random.default_rng(0)
A = RNG.uniform(0.5, 2.0, (3, 4))
MANY = np.array([[0, 2], [1, 1], [2, 3]])


def moved(x):
    """Numbers change places."""
    return [
        x.reshape(4, 3)[::2].T,
        x[1:, ::-1][..., None],
        jnp.concatenate([x, x[:1] * 0.5]),
        jnp.stack([x[0], x[1]], axis=1),
        jnp.pad(x, ((1, 2), (0, 1)), constant_values=7.0),
        lax.pad(x, 1.0, [(-1, 2, 1), (1, -1, 2)]),
        jnp.split(x, [1, 3], axis=1),
        jnp.tile(x, (2, 1)),
        jnp.broadcast_to(x[:, None, :1], (3, 2, 4)),
        jnp.where(np.arange(4) % 2 == 0, x, -x),
        x.astype(int).astype(x.dtype),
    ]


def indexed(x):
    """Gathers and scatters with known indices."""
    rows, columns = MANY.T
    many = jax.vmap(lambda row, i: row[i])(x, columns)  # batching dimensions
    return [
        x[rows, columns],
        x[:, np.array([3, 0, 0])],
        x[np.array([2, 0])],
        many,
        lax.dynamic_slice(x, (1, 9), (2, 2)),
        lax.dynamic_update_slice(x, x[:2, :2] * 2.0, (1, 1)),
        x.at[rows, columns].set(5.0),
        x.at[np.array([0, 0, 1]), 1].add(x[0, :3]),
        x.at[np.array([1, 2])].multiply(x[:2], unique_indices=True),
        x.at[np.array([1, 8])].set(3.0, mode="drop"),
        jax.vmap(lambda row, i: row.at[i].add(1.0))(x, columns),
    ]


def elementwise(x):
    return [
        jnp.sin(x) * jnp.exp(-x) / jnp.sqrt(x),
        jnp.maximum(x, 1.0) ** 3 + jnp.arctan2(x, 1.0 - x),
        jnp.clip(x, 0.7, 1.3) - jnp.abs(-x) % 0.4,
        jnp.where((x > 1.0) & ~(x > 1.5) | (x < 0.6), x, jnp.tanh(x)),
        jnp.sign(x - 1.0) + jnp.floor(2.0 * x) + jnp.log1p(x) + x**2.5 + lax.rsqrt(x),
    ]


def reduced(x):
    return [
        x @ jnp.cos(x).T,
        jnp.einsum("ij,ij->i", x, x**2),
        jnp.einsum("ij,kj->jik", x, x),
        x.sum(0),
        x.max(1),
        x.min(),
        x.prod(axis=(0, 1)),
        jnp.any(x > 1.9, axis=1).astype(x.dtype),
        jnp.all(x > 0.6, axis=0).astype(x.dtype),
        jnp.cumsum(x, 1),
        jnp.cumprod(x, 0),
        lax.cummax(x, 1, reverse=True),
    ]


def factored(x):
    matrix = jnp.eye(3) + x[:, :3] @ x[:, :3].T
    L = jnp.linalg.cholesky(matrix)
    solves = [
        lax.linalg.triangular_solve(L, b, left_side=left, lower=True, transpose_a=trans)
        for left, b in ((True, x), (False, x.T))
        for trans in (False, True)
    ]
    upper = jax.scipy.linalg.solve_triangular(L.T, x, lower=False, unit_diagonal=True)
    batch = jnp.linalg.cholesky(jnp.stack([matrix, 2.0 * matrix]))
    return [L, *solves, upper, batch, jax.scipy.linalg.cho_solve((L, True), x)]


def controlled(x):
    def body(carry, row):
        return carry + jnp.sin(row), carry * row

    rows = lax.scan(body, x[0], x, reverse=True)
    loop = lax.fori_loop(0, 3, lambda i, y: y + x[i], x[0])
    until = lax.while_loop(lambda c: c[0] < 4, lambda c: (c[0] + 2, c[1] * x[0]), (0, x[1]))
    branch = lax.cond(np.True_, jnp.sin, jnp.cos, x)
    return [rows, loop, until[1], branch, jax.checkpoint(jnp.sin)(x), jax.jit(jnp.cos)(x)]


def close(seen, wanted, rtol):
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(wanted), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        scale = max(1.0, np.abs(b).max(initial=0.0))
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * scale)


@pytest.fixture
def strictly(monkeypatch):
    """Falling back is a failure."""

    def refuse(program, inputs):
        raise AssertionError("fell back")

    monkeypatch.setattr(scalarize, "unchanged", refuse)


@pytest.fixture
def on_gpu(monkeypatch):
    """What is built on a GPU; it runs here without the kernel itself."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


@pytest.mark.parametrize("x64", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("function", [moved, indexed, elementwise, reduced, factored, controlled])
def test_every_class_of_operations(function, x64, strictly):
    with jax.enable_x64(x64):
        x = jnp.asarray(A)
        for f in (function, lambda x: jax.jacfwd(function)(x)):
            close(jax.jit(scalarized(f))(x), jax.jit(f)(x), 1e-12 if x64 else 3e-5)


@pytest.mark.slow
def test_inside_of_every_transformation(strictly):
    with jax.enable_x64(True):
        x = jnp.asarray(RNG.uniform(0.5, 2.0, (5, 3, 4)))

        def f(x):
            return sum(jnp.sum(jnp.sin(y)) for y in [*elementwise(x), x @ x.T])

        g = scalarized(f)
        close(jax.vmap(g)(x), jax.vmap(f)(x), 1e-12)
        close(jax.vmap(jax.grad(g))(x), jax.vmap(jax.grad(f))(x), 1e-12)
        close(jax.hessian(g)(x[0]), jax.hessian(f)(x[0]), 1e-10)
        loop = [lax.fori_loop(0, 3, lambda i, y, f=f: y + 0.01 * f(y), x[0]) for f in (f, g)]
        close(*loop, 1e-12)


def operations(function, *arguments):
    """Arithmetic that the scalarized function's outputs need, without what moves numbers about."""
    moves = {"slice", "squeeze", "reshape", "concatenate", "broadcast_in_dim"}
    names = [
        e.primitive.name for e in jax.make_jaxpr(pruned(scalarized(function)))(*arguments).eqns
    ]
    return sorted(name for name in names if name not in moves)


@pytest.mark.parametrize(
    ("function", "wanted"),
    [
        (lambda x: np.array([0.0, 1.0, -1.0]) * x, ["neg"]),
        (lambda x: x + np.zeros(3) - np.zeros(3), []),
        (lambda x: 0.0 - jnp.negative(x), []),
        (lambda x: -jnp.negative(x), []),
        (lambda x: (0.0 / x)[0] + x[0] / 1.0, []),
        (lambda x: x[0] + (-x[1]), ["sub"]),
        (lambda x: x - x, []),
        (lambda x: jnp.sin(x[0]) + jnp.sin(x[::-1])[2], ["add", "sin"]),
        (lambda x: x[0] * x[1] - x[1] * x[0], []),
        (lambda x: jnp.where(x > np.inf, x, x), []),
        (lambda x: np.diag([2.0, 0.0, 1.0]) @ x, ["mul"]),
        (lambda x: jnp.sin(np.ones(3)) * 2.0, []),
        (lambda x: x[jnp.argsort(np.array([3, 1, 2]))], []),  # known: computed here and now
        (lambda x: (x * np.array([1.0, 2.0, 3.0]))[:1], []),
    ],
)
def test_pruned_and_shared(function, wanted, strictly):
    assert operations(function, jnp.ones(3)) == wanted
    close(scalarized(function)(jnp.arange(1.0, 4.0)), function(jnp.arange(1.0, 4.0)), 1e-6)


def test_zero_times_infinity_is_zero_here():
    x = jnp.array([np.inf, np.nan])
    assert np.isnan(0.0 * x).all()
    np.testing.assert_array_equal(jax.jit(scalarized(lambda x: 0.0 * x))(x), 0.0)
    assert not np.isfinite(scalarized(lambda x: 2.0 * x)(x)).any()


@jax.custom_jvp
def bent(x):
    return x**2


bent.defjvp(lambda primals, tangents: (bent(*primals), 5.0 * tangents[0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "function",
    [
        jnp.sort,
        bent,
        lambda x: x[jnp.argmax(x)],
        lambda x: lax.while_loop(lambda x: x[0] < 9.0, lambda x: 2.0 * x, x),
        lambda x: x + jax.random.normal(jax.random.key(3), (3,)) * jnp.linalg.det(jnp.diag(x)),
        lambda x: jnp.cumsum(jnp.sin(jnp.outer(jnp.arange(5000.0), x))),
    ],
)
def test_what_is_not_supported_is_left_as_it_is(function):
    x = jnp.array([2.0, 3.0, 1.0])
    close(jax.jit(scalarized(function))(x), jax.jit(function)(x), 1e-6)
    derivative = jax.jacfwd(function)
    close(jax.jit(jax.jacfwd(scalarized(function)))(x), jax.jit(derivative)(x), 1e-6)


def test_keys_pass_through():
    def f(key, x):
        return jax.random.normal(key, (2,)) + x

    close(scalarized(f)(jax.random.key(0), 1.0), f(jax.random.key(0), 1.0), 0)


def pulled(x, y, z):
    """Some arithmetic whose entries share most of what they are made of."""
    lean = jnp.sin(x[0] * y) + z[1] * jnp.where(x[1] > 1.0, x[1], jnp.exp(z[0]))
    return {"out": jnp.stack([jnp.outer(lean, x), jnp.ones((2, 2))]), "sum": lean.sum() / z[1]}


@pytest.mark.parametrize("outer", [(0, 0, None), (None, 0, None), (None, None, 0)])
@pytest.mark.parametrize("inner", [(0, None, None), (0, 0, 0)])
def test_rows_of_a_batch_are_those_of_single_calls(inner, outer, strictly, on_gpu):
    """Any argument may be batched at any level."""
    sizes = [[n for n, axes in ((4, outer), (3, inner)) if axes[i] == 0] for i in range(3)]
    arguments = [RNG.uniform(0.5, 2.0, (*size, 2)).astype(np.float32) for size in sizes]

    def over(function):
        return jax.jit(jax.vmap(jax.vmap(function, inner), outer))(*arguments)

    close(over(scalarized(pulled, outermost=True)), over(pulled), 1e-6)
    single = [np.ones(2, np.float32)] * 3
    assert "custom_vmap" in str(jax.make_jaxpr(scalarized(pulled, outermost=True))(*single))


def test_kernels_serve_float64_and_no_mixture(strictly, on_gpu):
    with jax.enable_x64(True):
        for kinds, served in (("ddd", True), ("fdf", False)):
            inputs = [np.ones(2, kind) for kind in kinds]
            program = str(jax.make_jaxpr(scalarized(pulled, outermost=True))(*inputs))
            assert ("custom_vmap" in program) is served


def test_kernels_read_only_what_is_used(strictly, monkeypatch):
    """Not integers that a choice leaves out, which would keep a model's step out of kernels."""
    read, as_kernel = [], scalarize.vmapped_as_kernel

    def noted(program):
        read.append(len(program.in_avals))
        return as_kernel(program)

    def chosen(x, whole):
        return 2.0 * x[1] + jax.lax.select(np.array([True, True]), np.array([3, 4]), whole).sum()

    monkeypatch.setattr(scalarize, "vmapped_as_kernel", noted)
    over = jax.jit(jax.vmap(scalarized(chosen, outermost=True), (0, None)))
    x = A.astype(np.float32)
    close(over(x, jnp.arange(2)), 2.0 * x[:, 1] + 7, 1e-6)
    assert read == [1]


def test_kernels_may_return_what_they_are_given(strictly):
    def function(x, y):
        return x, y[0] * x, y

    x, y = A.astype(np.float32), np.float32([3.0, 4.0])
    over = jax.jit(jax.vmap(scalarized(function, outermost=True), (0, None)))
    close(over(x, y), (x, 3.0 * x, np.tile(y, (3, 1))), 1e-6)


def test_kernels_write_each_number_once_and_none_that_is_known(strictly, on_gpu, monkeypatch):
    written, as_kernel = set(), scalarize.vmapped_as_kernel

    def counted(program):
        written.add(len(program.out_avals))
        return as_kernel(program)

    def mostly_known(x):
        once = jnp.diag(jnp.sin(x))
        return jnp.stack([once, 2.0 * jnp.eye(3), once])

    monkeypatch.setattr(scalarize, "vmapped_as_kernel", counted)
    x = jnp.asarray(A, jnp.float32).reshape(-1)[:6].reshape(2, 3)
    for function in (mostly_known, lambda x: jnp.outer(jnp.ones(2), jnp.ones(3))):
        seen = jax.jit(jax.vmap(scalarized(function, outermost=True)))(x)
        close(seen, jax.vmap(function)(x), 1e-6)
    assert written == {3}


def test_kernels_compute_nothing_of_numbers_alone(strictly, on_gpu, monkeypatch):
    """Pallas cannot lower integer_pow of a number, for one."""
    seen, as_kernel = [], scalarize.vmapped_as_kernel

    def watched(program):
        seen.extend(program.eqns)
        return as_kernel(program)

    def partly_known(x):
        return jnp.concatenate([x, np.float32([3.0, 0.5])]) ** 5

    monkeypatch.setattr(scalarize, "vmapped_as_kernel", watched)
    x = jnp.asarray(A, jnp.float32)[:, :2]
    close(
        jax.jit(jax.vmap(scalarized(partly_known, outermost=True)))(x),
        jax.vmap(partly_known)(x),
        1e-5,
    )
    assert {e.primitive.name for e in seen} == {"integer_pow"}
    assert not any(all(isinstance(v, Literal) for v in e.invars) for e in seen)


@pytest.mark.parametrize("name", sorted(IN_KERNELS))
def test_kernels_hold_only_what_pallas_lowers(name):
    from jax._src.pallas.triton.lowering import triton_lowering_rules

    assert name in {str(primitive) for primitive in triton_lowering_rules}


@pytest.mark.parametrize("function", [jnp.round, jax.scipy.special.erf, lambda x: x.astype(int)])
def test_what_kernels_lack_stays_in_loops(function, strictly, on_gpu):
    x = jnp.asarray(A, jnp.float32)
    close(jax.jit(jax.vmap(scalarized(function, outermost=True)))(x), function(x), 1e-6)
