"""What a program computes is told apart by all that changes it, and by nothing else."""

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import arm, point, robot
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.tree_util import Partial

from mjx_drax import (
    MPC,
    from_dynamics,
    from_program,
    minimize,
    register_dataclass,
    solve,
    solve_batch,
)
from mjx_drax.control.planner import planner_of
from mjx_drax.kernels.compilation import compiled
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.search import iterate, sizes
from mjx_drax.search.identity import identity, look_again
from mjx_drax.solution import violations

TABLE = np.linspace(0.0, 1.0, 100_000, dtype=np.float32)

GOAL = np.array([0.5])


@dataclass(slots=True)
class Holder:
    target: np.ndarray

    def cost(self, x, u):
        return (x[0] - jnp.asarray(self.target)[0]) ** 2


def posed(push=0.1, weight=1.0, table=TABLE, bound=2.0, **changes):
    """A point whose cost closes over an array and binds a number."""

    def running(bound, x, u):
        return bound * weight * jnp.sum(u**2) + jnp.asarray(table)[jnp.int32(x[0])]

    rest = {"running_cost": Partial(running, bound), "f": lambda x, u: x + push * u}
    return point(**rest | changes)


def of(p):
    return identity((p, 1.0), p)


def test_what_computes_the_same_is_the_same():
    assert of(posed()) is not None
    assert of(posed()) == of(posed(bound=3.0))  # all else is made anew
    assert of(posed()) == of(posed(x_init=[1.0, 1.0], name="another"))


@pytest.mark.parametrize(
    "change",
    [
        {"push": 0.2},
        {"weight": 1.1},
        {"table": np.where(np.arange(len(TABLE)) == 70_000, 0.5, TABLE)},
        {"horizon": 1.1},
        {"terminal_residual": lambda x: x - 2.0},
        {"equality": lambda x, u: u[0]},
        {"inequality": lambda x, u: u[0] - 1.0},
        {"terminal_equality": lambda x: x[0] - 1.0},
        {"running_cost": lambda x, u: x[0] + u[0]},
        {"running_residual": lambda x, u: u},
    ],
    ids=lambda change: next(iter(change)),
)
def test_what_computes_something_else_is_told_apart(change):
    assert of(posed(**change)) is not None
    assert of(posed(**change)) != of(posed())


def test_models_are_told_apart_by_what_programs_know_of_them():
    heavy, tilted = arm(joint='damping="1"'), arm(joint='damping="1" pos="0.1 0 0"')
    assert of(robot(heavy)) is not None
    assert of(robot(heavy)) == of(robot(heavy.replace('mass="1"', 'mass="2"')))  # a number
    assert of(robot(heavy)) != of(robot(tilted))  # not 0 any more
    assert of(robot(heavy)) != of(robot(heavy, running_cost=lambda d, u: d.qpos[0] ** 2))


def test_rules_of_derivatives_count():
    def ruled(slope):
        @jax.custom_jvp
        def square(x):
            return x**2

        square.defjvp(lambda p, t: (square(p[0]), slope * p[0] * t[0]))
        return posed(running_cost=lambda x, u: square(u[0]) + x[0])

    assert of(ruled(2.0)) is not None
    assert of(ruled(2.0)) == of(ruled(2.0))
    assert of(ruled(2.0)) != of(ruled(3.0))


def test_what_derivatives_alone_know_of_counts():
    stop = jax.lax.stop_gradient
    costs = (
        lambda x, u: u[0] * u[1],
        lambda x, u: u[0] * stop(u[1]),
        lambda x, u: stop(u[0]) * u[1],
    )
    found = {of(posed(running_cost=cost)) for cost in costs}
    assert len(found - {None}) == 3


def test_rules_of_operations_that_are_not_jaxs_count():
    def ruled(slope):
        square = Primitive("square_of_a_user")
        square.def_impl(lambda x: x**2)
        square.def_abstract_eval(lambda x: x)
        mlir.register_lowering(square, mlir.lower_fun(lambda x: x**2, multiple_results=False))
        ad.defjvp(square, lambda t, x: slope * x * t)
        batching.defvectorized(square)
        return posed(running_cost=lambda x, u: square.bind(u[0]))

    assert of(ruled(2.0)) is not None
    assert of(ruled(2.0)) != of(ruled(3.0))


def test_what_functions_read_is_looked_at_each_time():
    target = [0.0]
    problem = posed(running_cost=lambda x, u: (x[0] - target[0]) ** 2)
    before = of(problem)
    target[0] = 1.0
    assert before != of(problem)
    target[0] = 0.0
    assert before == of(problem)


def test_jax_forgets_programs_only_if_what_functions_read_has_changed():
    target = [0.5]
    problem = posed(running_cost=lambda x, u: (x[0] - target[0]) ** 2)
    program = jax.jit(lambda x: x + target[0])
    for target[0], known in ((0.5, 0), (0.5, 1), (0.7, 0), (0.7, 1), (0.5, 0)):
        look_again(problem)
        assert program._cache_size() == known
        assert program(1.0) == pytest.approx(1.0 + target[0])


@pytest.mark.parametrize("reached_by", ["closure", "global", "attribute", "partial", "list"])
def test_arrays_may_be_changed_in_place(reached_by):
    target = np.array([0.5])  # of 64 bits, so that JAX has a copy

    def reach(target, x, u):
        return (x[0] - jnp.asarray(target)[0]) ** 2

    holder, listed = Holder(target), [target]
    costs = {
        "closure": lambda x, u: reach(target, x, u),
        "global": lambda x, u: reach(GOAL, x, u),
        "attribute": holder.cost,
        "partial": partial(reach, target),
        "list": lambda x, u: reach(listed[0], x, u),
    }
    cost = costs[reached_by]
    problem = posed(running_cost=cost)
    program = jax.jit(lambda x: cost(x, x))
    for goal, known in ((0.5, 0), (0.5, 1), (0.7, 0), (0.7, 1), (0.5, 0)):
        target[0] = GOAL[0] = goal
        look_again(problem)
        assert program._cache_size() == known
        assert program(jnp.ones(2)) == pytest.approx((1.0 - goal) ** 2)


def test_a_change_that_float32_does_not_show_hides_no_later_one():
    target = np.array([0.5])
    problem = posed(running_cost=lambda x, u: (x[0] - jnp.asarray(target)[0]) ** 2)
    program = jax.jit(lambda x: x - jnp.asarray(target))
    for target[0] in (0.5, 0.5 + 1e-12, 0.7):
        look_again(problem)
        assert program(1.0)[0] == pytest.approx(1.0 - target[0])


def test_arrays_that_no_function_reads_cost_one_compilation_at_most():
    logged = {"aim": Holder(np.array([0.5])), "log": np.zeros(3)}
    problem = posed(running_cost=lambda x, u: logged["aim"].cost(x, u))
    another = posed(running_cost=lambda x, u: x @ x + jnp.asarray(logged["log"])[0])
    program = jax.jit(lambda x: x + jnp.asarray(logged["log"]))
    for step, known in enumerate((0, 0, 1, 1)):
        logged["log"][0] = 1.0 + step
        look_again(problem)
        assert program._cache_size() == known
        program(1.0)
    for logged["log"][0], known in ((7.0, 0), (7.0, 1), (8.0, 0)):  # which others may read
        look_again(another)
        assert program._cache_size() == known
        assert program(1.0)[0] == 1.0 + logged["log"][0]


@pytest.mark.slow
def test_another_program_has_what_functions_read_by_then():
    target = [0.5]
    program = from_program(1, cost=lambda x: (x[0] - target[0]) ** 2)
    for target[0] in (0.5, -0.5):
        assert np.allclose(minimize(program, chains=2, progress=False).x, target[0], atol=1e-3)


SLOW = pytest.mark.slow


@pytest.mark.parametrize("many", [False, pytest.param(True, marks=SLOW)])
@pytest.mark.parametrize(
    "target", [pytest.param([0.5], marks=SLOW), np.array([0.5])], ids=["list", "array"]
)
def test_another_motion_has_what_functions_read_by_then(many, target):
    def running(x, u):
        return 1e-3 * u @ u + (x[0] - jnp.asarray(target)[0]) ** 2

    reach = {"running_cost": running}
    problem = posed(terminal_residual=None, **reach)
    for target[0] in (0.5, -0.5, 0.5):
        if many:
            ends = solve_batch(lambda x: replace(problem, x_init=x), np.zeros((2, 2)), 2).x[:, -1]
        else:
            ends = solve(problem, chains=2, progress=False).trajectories.x[:, -1]
        assert np.allclose(ends[:, 0], target[0], atol=0.02)


@pytest.mark.parametrize("told", [True, False], ids=["told", "cannot be told"])
def test_another_problem_is_replayed_with_what_f_reads_by_then(told):
    mass = [1.0]

    def cart(x, u):
        return x + 0.1 * jnp.stack([x[1], u[0] / mass[0]])

    @jax.custom_vjp
    def square(x):
        return x**2

    square.defvjp(lambda x: (x**2, x), lambda x, g: (2 * x * g,))

    def effort(x, u):
        return u @ u if told else square(u[0])

    plan, u = np.zeros((1, 4, 2)), np.ones((1, 3, 2))
    for mass[0] in (1.0, 2.0):
        running = (lambda x, u: u @ u) if told else effort  # another one each time, or the same
        problem = posed(f=cart, running_cost=running, horizon=0.3)
        look_again(problem)
        states, _ = problem.replay(plan, u, np.zeros((1, 3, 2, 2)))
        assert states[0, -1, 1] == pytest.approx(0.3 / mass[0])


def test_rules_of_batches_count():
    def ruled(factor):
        @jax.custom_batching.custom_vmap
        def double(x):
            return 2.0 * x

        double.def_vmap(lambda size, batched, x: (factor * x, True))
        return posed(running_cost=lambda x, u: double(u[0]))

    assert of(ruled(2.0)) is not None
    assert of(ruled(2.0)) == of(ruled(2.0))
    assert of(ruled(2.0)) != of(ruled(3.0))


def test_what_cannot_be_told_has_no_identity():
    @jax.custom_vjp
    def square(x):
        return x**2

    square.defvjp(lambda x: (x**2, x), lambda x, g: (2 * x * g,))
    assert of(posed(running_cost=lambda x, u: square(u[0]))) is None

    def called_back(x, u):
        return jax.pure_callback(lambda y: y, jax.ShapeDtypeStruct((), x.dtype), u[0])

    assert of(posed(running_cost=called_back)) is None

    @register_dataclass
    @dataclass(frozen=True)
    class Point(Dynamics):
        dt: float = 0.1
        nx, nu = 2, 1

        def step(self, x, u):
            return x + self.dt * jnp.array([x[1], u[0]])

    own = from_dynamics(Point(), x_init=[0.0, 0.0], horizon=1.0, running_cost=lambda x, u: x @ x)
    assert of(own) is None


PROGRAMS = iterate.iterate, sizes.sizes_of, violations._measured


def traced(program):
    raise AssertionError(f"{program.__name__} was traced")


@pytest.mark.parametrize("kind", [pytest.param("function", marks=pytest.mark.slow), "model"])
def test_a_second_process_solves_alike_without_tracing(monkeypatch, keeps_programs, kind):
    def anew():
        return posed() if kind == "function" else robot(running_cost=lambda d, u: u[0] ** 2)

    def forget():
        for program in PROGRAMS:
            program._programs.clear()
            program._last.clear()

    forget()
    first = solve(anew(), chains=2, progress=False)
    assert len(list(keeps_programs.iterdir())) >= len(PROGRAMS)
    forget()

    monkeypatch.setattr(compiled, "traced", property(traced))
    second = solve(anew(), chains=2, progress=False)
    for a, b in zip(*(jax.tree.leaves(s.trajectories) for s in (first, second)), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.feedback.cost, second.feedback.cost)
    forget()


@pytest.mark.slow
def test_a_second_process_plans_alike_without_tracing(monkeypatch, keeps_programs):
    def plan():
        planner_of.cache_clear()
        policy = MPC(posed(running_cost=lambda x, u: u @ u), chains=2)
        return policy.reset([0.0, 0.0]).u

    first = plan()
    monkeypatch.setattr(compiled, "traced", property(traced))
    np.testing.assert_array_equal(first, plan())
    planner_of.cache_clear()


ALONE = """
import jax.numpy as jnp
from mjx_drax import from_function, solve
from mjx_drax.search.iterate import iterate

problem = from_function(
    lambda x, u: x + 0.5 * u, x_init=[0.0], nu=1, horizon=1.0, dt=0.1,
    running_cost=lambda x, u: jnp.sum((x - 1.0) ** 2) + 0.1 * jnp.sum(u**2),
)
solution = solve(problem, chains=2, progress=False)
print(iterate.traced._cache_size(), solution.trajectories.x.tobytes().hex())
"""


def test_another_process_finds_a_program_that_calls_lapack(tmp_path):
    known = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", ALONE], env=os.environ | known, capture_output=True, check=True
        ).stdout
        for _ in range(2)
    )
    assert len(list((tmp_path / "programs").iterdir())) >= len(PROGRAMS)
    assert first == second
