"""Bad arguments and functions of a problem give one clear error, before anything iterates.

What the library cannot find out, and so is not here:

- a cost that is wrong in one region of the state space only: its chains diverge, and are marked;
- a cost that never returns.
"""

import math
import random
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import INF, NAN, At, arm, assert_complains, cases, point

from mjx_drax import (
    LBFGS,
    DraxError,
    GaussNewton,
    Identity,
    Langevin,
    Restarts,
    Smoothed,
    Trajectory,
    from_program,
    minimize,
    solve,
)
from mjx_drax.search.restarts import settled

pytestmark = pytest.mark.usefixtures("nothing_iterates")

COUNTS = []


def counting(x, u):
    """Costs more each time it is called."""
    COUNTS.append(1)
    return len(COUNTS) * (x @ x)


KEPT = []


def keeping(x, u):
    """Uses what it was first called with."""
    KEPT.append(x)
    return KEPT[0] @ x


@jax.custom_vjp
def backwards(x):
    return x @ x


backwards.defvjp(lambda x: (backwards(x), x), lambda x, g: (2 * g * x,))


def called_back(x, u):
    """Computed by numpy."""
    return jax.pure_callback(lambda x: np.float32(x @ x), jax.ShapeDtypeStruct((), x.dtype), x)


def fails(*_):
    raise KeyError("no such sensor")


def shouts(*_):
    raise RuntimeError("line\n" * 500)


def solved(**changes):
    """A solve of two chains, of a problem from a function."""
    return solve(point(**changes), 2)


def heavy(x, u, knot, factor):
    return factor * knot.data["mass"] * u @ u


def with_cost(l):
    """A solve with another running cost."""
    return solved(running_cost=l)


def with_residual(**changes):
    """A solve with a running residual."""
    return solved(**{"running_residual": lambda x, u: u, **changes})


# fmt: off
ARGUMENTS = [
    ("horizon-infinite", lambda at: point(horizon=INF), "horizon is inf"),
    ("horizon-text", lambda at: point(horizon="10"), "horizon is '10'", "seconds"),
    ("horizon-none", lambda at: point(horizon=None), "horizon is None"),
    ("horizon-list", lambda at: point(horizon=[1.0]), "horizon is [1.0]"),
    ("horizon-complex", lambda at: point(horizon=1j), "horizon is 1j"),
    ("horizon-short", lambda at: point(horizon=0.01), "horizon is 0.01 s", "at least 0.1 s"),
    ("horizon-endless", lambda at: point(horizon=1e300), "1e+300", "less than"),
    ("horizon-knots-0", lambda at: solve(replace(at.point, horizon=0)), "horizon", "is 0"),
    ("horizon-knots-half", lambda at: solve(replace(at.point, horizon=1.5)), "horizon", "1.5"),
    ("dt-0", lambda at: point(dt=0), "dt is 0"),
    ("nu-0", lambda at: point(nu=0), "nu is 0", "at least 1"),
    ("nu-negative", lambda at: point(nu=-2), "nu is -2"),
    ("nu-text", lambda at: point(nu="2"), "nu is '2'"),
    ("nu-huge", lambda at: point(nu=10**12), "nu is 1000000000000", "at most"),
    ("nu-half", lambda at: point(nu=1.5), "nu is 1.5"),
    ("name-number", lambda at: point(name=3), "name is 3"),
    ("x_names-count", lambda at: point(x_names=("a",)), "x_names", "2 different"),
    ("u_names-twice", lambda at: point(u_names=("a", "a")), "u_names", "2 different"),
    ("x_init-nan", lambda at: point(x_init=[0.0, NAN]), "x_init is [0.0, nan]", "finite"),
    ("x_init-beyond-float32", lambda at: point(x_init=[1e39, 0.0]), "x_init", "1e+39", "finite"),
    ("x_init-matrix", lambda at: point(x_init=np.zeros((2, 2))), "x_init is array", "vector"),
    ("x_init-number", lambda at: point(x_init=0.0), "x_init is 0.0", "vector"),
    ("x_init-texts", lambda at: point(x_init=["0", "1"]), "x_init is ['0', '1']"),
    ("x_init-none", lambda at: point(x_init=None), "x_init is None"),
    ("x_init-objects", lambda at: point(x_init=[object(), None]), "x_init is [<object"),
    ("x_init-dict", lambda at: point(x_init={"x": 0}), "x_init is {'x': 0}"),
    ("x_init-endless", lambda at: point(x_init=[10**400, 0]), "x_init is [1000000", "..."),
    ("x_init-ragged", lambda at: point(x_init=[[0.0], [0.0, 1.0]]), "x_init is [[0.0]"),
    ("x_init-complex", lambda at: point(x_init=[0j, 1.0]), "x_init", "numbers"),
    ("x_init-huge", lambda at: point(x_init=np.full((99, 99), NAN)), "x_init is array", "..."),
    ("x_init-replaced", lambda at: solve(replace(at.point, x_init=[0, 0])),
     "x_init is array", "floats"),
    ("x_init-replaced-nan", lambda at: solve(replace(at.point, x_init=jnp.full(2, NAN))), "nan"),
    ("x_init-later", lambda at: at.point.with_x_init([1.0]), "x_init has shape (1,)", "give 2"),
    ("x_init-outside", lambda at: point(x_bounds=(1.0, 2.0)), "outside the bounds", "by 1"),
    ("x_init-below-one", lambda at: point(x_bounds=([-1, 0.5], [1, 1])), "x_init", "by 0.5"),
    ("x_bounds-number", lambda at: point(x_bounds=3.0), "bounds of x are 3.0", "pair"),
    ("x_bounds-three", lambda at: point(x_bounds=(1, 2, 3)), "bounds of x are (1, 2, 3)"),
    ("x_bounds-crossed", lambda at: point(x_bounds=(1.0, -1.0)),
     "cross", "lower 1.0", "upper -1.0"),
    ("x_bounds-nan", lambda at: point(x_bounds=(NAN, 1.0)), "lower end of x is nan", "-inf"),
    ("x_bounds-shut", lambda at: point(x_bounds=(INF, INF)), "leave nothing", "lower inf"),
    ("x_bounds-shape", lambda at: point(x_bounds=(np.zeros(3), 1)), "lower end of x", "(2,)"),
    ("x_bounds-knots", lambda at: point(x_bounds=(np.zeros((7, 2)), 1)), "(7, 2)", "(10, 2)"),
    ("x_bounds-text", lambda at: point(x_bounds=("low", "high")), "lower end of x is 'low'"),
    ("u_bounds-nan", lambda at: point(u_bounds=(-1.0, [1.0, NAN])), "upper end of u is [1.0, nan]"),
    ("u_bounds-one-end", lambda at: point(u_bounds=(1.0,)), "bounds of u are (1.0,)"),
    ("u_bounds-complex", lambda at: point(u_bounds=(0j, 1j)), "lower end of u is 0j"),
    ("u_bounds-minus-infinite", lambda at: point(u_bounds=(-INF, -INF)), "bounds of u", "-inf"),
    ("scatter-crossed", lambda at: point(x_scatter=(1, -1)), "scatter of x cross"),
    ("scatter-nan", lambda at: point(u_scatter=(NAN, NAN)), "lower end of u is nan"),
    ("scatter-text", lambda at: point(u_scatter="wide"), "bounds of u are 'wide'"),
    ("no-cost", lambda at: point(terminal_residual=None), "point has no cost", "give"),
    ("problem-none", lambda at: solve(None), "the problem is None", "from_mjcf"),
    ("problem-model", lambda at: solve(arm()), "the problem is", "from_mjcf"),
]
# fmt: on

# fmt: off
COSTS = [
    ("raises", lambda at: with_cost(fails), "running_cost failed", "KeyError", "no such sensor"),
    ("raises-at-length", lambda at: with_cost(shouts), "running_cost failed", "RuntimeError: line"),
    ("raises-nothing", lambda at: with_cost(lambda x, u: 1 / 0), "ZeroDivisionError"),
    ("assertion", lambda at: with_cost(lambda x, u: exec("assert False")), "AssertionError"),
    ("no-function", lambda at: with_cost(3), "running_cost is 3", "function"),
    ("class", lambda at: with_cost(dict), "running_cost is <class 'dict'>"),
    ("text", lambda at: point(terminal_cost="x @ x"), "terminal_cost is 'x @ x'"),
    ("residual-list", lambda at: point(running_residual=[]), "running_residual is []"),
    ("no-arguments", lambda at: with_cost(lambda: 0.0),
     "running_cost failed", "takes 0", "2 arguments"),
    ("one-argument", lambda at: with_cost(lambda x: x @ x), "running_cost failed", "2 arguments"),
    ("terminal-with-control", lambda at: point(terminal_cost=lambda x, u: 0.0),
     "terminal_cost failed", "'u'", "1 argument"),
    ("vector", lambda at: with_cost(lambda x, u: x),
     "running_cost returned shape (2,)", "residual"),
    ("matrix", lambda at: point(terminal_cost=lambda x: jnp.outer(x, x)), "shape (2, 2)"),
    ("none", lambda at: with_cost(lambda x, u: None), "running_cost returned None"),
    ("string", lambda at: with_cost(lambda x, u: "cheap"), "running_cost returned 'cheap'"),
    ("whole", lambda at: with_cost(lambda x, u: 1), "running_cost returned 1"),
    ("truth", lambda at: with_cost(lambda x, u: True), "running_cost returned True"),
    ("truths", lambda at: with_cost(lambda x, u: x[0] > 0), "running_cost", "bool", "floats"),
    ("integers", lambda at: with_cost(lambda x, u: jnp.argmax(x)), "running_cost", "int32"),
    ("complex", lambda at: with_cost(lambda x, u: x[0] * 1j), "running_cost", "complex64"),
    ("imaginary", lambda at: with_cost(lambda x, u: 1j), "running_cost returned 1j"),
    ("tuple", lambda at: with_cost(lambda x, u: (x[0], u[0])), "running_cost returned a tuple"),
    ("dict", lambda at: with_cost(lambda x, u: {"cost": x[0]}), "running_cost returned a dict"),
    ("generator", lambda at: with_cost(lambda x, u: (a for a in x)), "returned a generator"),
    ("function", lambda at: with_cost(lambda x, u: lambda: x[0]), "returned a function"),
    ("objects", lambda at: with_cost(lambda x, u: np.array(None)), "running_cost", "object"),
    ("residual-none", lambda at: point(running_residual=lambda x, u: None), "running_residual"),
    ("residual-list-of-arrays", lambda at: point(terminal_residual=lambda x: [x, x]), "a list"),
    ("residual-integers", lambda at: point(terminal_residual=lambda x: jnp.arange(2)), "int32"),
    ("branch", lambda at: with_cost(lambda x, u: 1.0 if x[0] > 0 else 0.0), "`if`", "jnp.where"),
    ("loop", lambda at: with_cost(lambda x, u: sum(1.0 for _ in range(int(x[0])))), "int()"),
    ("numpy", lambda at: with_cost(lambda x, u: np.sin(x).sum()), "numpy", "jax.numpy"),
    ("float", lambda at: with_cost(lambda x, u: float(x[0])), "float()"),
    ("math", lambda at: with_cost(lambda x, u: math.sin(x[0])), "running_cost failed", "float()"),
    ("in-place", lambda at: with_cost(lambda x, u: x.__setitem__(0, 1.0)), "running_cost failed"),
    ("wrong-shapes", lambda at: with_cost(lambda x, u: x @ jnp.zeros(3)), "running_cost failed"),
    ("no-such-entry", lambda at: with_cost(lambda x, u: u[2] ** 2), "reads [2]", "shape (2,)"),
    ("no-such-entry-from-the-end", lambda at: with_cost(lambda x, u: x[-3]), "reads [-3]"),
    ("no-such-column", lambda at: with_cost(lambda x, u: jnp.outer(x, u)[1, 5]), "reads [5]"),
    ("no-such-entry-of-a-list",
     lambda at: with_cost(lambda x, u: x[jnp.array([1, 5])].sum()), "reads [5]", "shape (2,)"),
    ("no-such-entry-when-compiled", lambda at: with_cost(jax.jit(lambda x, u: x[5])), "reads [5]"),
    ("no-such-slice", lambda at: with_cost(lambda x, u: jax.lax.dynamic_slice(x, (1,), (2,)).sum()),
     "reads [1:3]", "clip"),
    ("program-bounds-cross",
     lambda at: from_program(2, cost=lambda x: x @ x, bounds=([1, 1], [0, 2])), "of x cross"),
    ("program-not-finite", lambda at: minimize(from_program(2, cost=lambda x: jnp.log(-x @ x))),
     "move the scatter of initial points"),
    ("empty-slice", lambda at: point(terminal_residual=lambda x: x[3:4] - 0.1),
     "terminal_residual returned shape (0,)", "slice"),
    ("no-rows", lambda at: point(equality=lambda x, u: u[5:]), "equality returned shape (0,)"),
    ("no-rates", lambda at: with_residual(running_residual=lambda x, u, knot: knot.rate),
     "returned None", "rates=1"),
    ("no-data", lambda at: with_cost(lambda x, u, knot: knot.data["mass"] * u @ u), "data="),
    ("no-parameters", lambda at: with_cost(lambda x, u, knot: knot.parameters["mass"] * u @ u),
     "parameters="),
    ("data-of-another-horizon",
     lambda at: solve(replace(at.point, horizon=3, data={"mass": np.ones(2)})),
     "data['mass'] has shape (2,)", "give 4 rows"),
    ("no-data-through-others", lambda at: with_cost(partial(heavy, factor=2.0)), "data="),
    ("no-jerk", lambda at: with_residual(running_residual=lambda x, u, knot: knot.jerk, rates=1),
     "returned None", "rates=2"),
    ("words-for-a-knot", lambda at: with_cost(lambda x, u, knot: "cheap"), "Return one array"),
    ("takes-a-knot", lambda at: with_cost(lambda x, u, knot: x @ jnp.zeros(3)), "and knot="),
    ("no-fault-of-the-knot",
     lambda at: with_cost(lambda x, u, knot: knot.data["mass"] if knot.data else x @ jnp.zeros(3)),
     "(3,)", "Change it"),
    ("no-such-parameter",
     lambda at: solved(running_cost=lambda x, u, knot: knot.parameters["mass"] * u @ u,
                       parameters={"length": (0.1, 1.0)}),
     "KeyError: 'mass'", "shape (2,)"),
    ("counter", lambda at: with_cost(counting), "running_cost", "global"),
    ("random", lambda at: with_cost(lambda x, u: random.random() * (x @ x)), "random numbers"),
    ("random-array",
     lambda at: with_cost(lambda x, u: x @ np.random.default_rng().normal(size=2).astype("f")),
     "random numbers"),
    ("random-inside",
     lambda at: with_cost(lambda x, u: jax.jit(lambda x: random.random() * x)(x[0])),
     "running_cost", "random"),
    ("leaked", lambda at: with_cost(keeping), "running_cost", "global"),
    ("rounds", lambda at: with_cost(lambda x, u: jnp.round(x).sum()),
     "running_cost", "zero everywhere"),
    ("argmax", lambda at: with_cost(lambda x, u: 1.0 * jnp.argmax(u)),
     "zero everywhere", "Smoothed"),
    ("stopped", lambda at: with_cost(lambda x, u: jax.lax.stop_gradient(x @ x)), "zero everywhere"),
    ("compares", lambda at: with_residual(terminal_residual=lambda x: jnp.where(x > 0, 1.0, 0.0)),
     "terminal_residual", "zero"),
    ("callback", lambda at: with_cost(called_back), "cannot be differentiated", "allbacks"),
    ("reverse-only", lambda at: with_cost(lambda x, u: backwards(x)), "custom_vjp", "custom_jvp"),
    ("reverse-only-identity",
     lambda at: solve(
         point(running_cost=lambda x, u: backwards(x)),
         1,
         solver=Langevin(preconditioner=Identity()),
     ),
     "custom_vjp"),
    ("forward-only",
     lambda at: solve(
         point(
             running_cost=lambda x, u: jax.lax.while_loop(
                 lambda c: c < 9, lambda c: c + 1.0, x @ x
             )
         ),
         1,
         solver=Langevin(preconditioner=LBFGS()),
     ),
     "cannot be differentiated", "everse"),
    ("sqrt", lambda at: with_cost(lambda x, u: jnp.sqrt(x @ x)),
     "derivative of running_cost", "x_init"),
    ("norm", lambda at: solved(running_residual=lambda x, u: jnp.linalg.norm(x)[None]),
     "derivative of running_residual"),
    ("power", lambda at: with_cost(lambda x, u: (jnp.abs(x) ** 1.5).sum()),
     "second derivative of running_cost"),
    ("nan", lambda at: with_cost(lambda x, u: x @ x + jnp.nan),
     "value of running_cost", "not finite"),
    ("nan-number", lambda at: with_cost(lambda x, u: NAN), "value of running_cost"),
    ("infinite", lambda at: solved(terminal_cost=lambda x: 1 / (0 * x[0])), "terminal_cost"),
    ("log", lambda at: solved(running_residual=lambda x, u: jnp.log(x)),
     "running_residual", "log"),
]
# fmt: on

# fmt: off
FUNCTIONS = [
    ("f-none", lambda at: point(f=None), "f is None"),
    ("f-array", lambda at: point(f=np.eye(2)), "f is array"),
    ("f-shape", lambda at: point(f=lambda x, u: x[:1]), "f(x, u) returned shape (1,)", "(2,)"),
    ("f-scalar", lambda at: point(f=lambda x, u: x @ u), "shape ()"),
    ("f-integers", lambda at: point(f=lambda x, u: x.astype(int)), "dynamics", "int32"),
    ("f-complex", lambda at: point(f=lambda x, u: x + 1j), "dynamics", "complex64"),
    ("f-tuple", lambda at: point(f=lambda x, u: (x, u)), "returned a tuple"),
    ("f-none-returned", lambda at: point(f=lambda x, u: None), "returned None"),
    ("f-raises", lambda at: point(f=fails), "dynamics", "no such sensor"),
    ("f-one-argument", lambda at: point(f=lambda x: x), "dynamics", "2 arguments"),
    ("f-numpy", lambda at: point(f=lambda x, u: np.cos(x)), "dynamics", "jax.numpy"),
    ("f-random", lambda at: point(f=lambda x, u: x + random.random()), "dynamics", "random"),
    ("f-nan", lambda at: solved(f=lambda x, u: x / 0 + u), "dynamics", "not finite"),
    ("f-no-derivative", lambda at: solved(f=lambda x, u: jnp.round(x + u)), "dynamics", "zero"),
    ("f-derivative-nan", lambda at: solved(f=lambda x, u: jnp.sqrt(x) + u),
     "derivative of the dynamics"),
    ("f-callback", lambda at: solved(f=lambda x, u: x * called_back(x, u)),
     "dynamics", "differentiated"),
    ("equality-raises", lambda at: point(equality=fails), "equality failed", "no such sensor"),
    ("equality-text", lambda at: point(equality="x = 0"), "equality is 'x = 0'"),
    ("equality-none", lambda at: point(equality=lambda x, u: None), "equality returned None"),
    ("inequality-truth", lambda at: point(inequality=lambda x, u: x <= 1), "inequality", "bool"),
    ("inequality-tuple", lambda at: point(inequality=lambda x, u: (x, u)), "inequality", "tuple"),
    ("inequality-random", lambda at: point(inequality=lambda x, u: x - random.random()), "random"),
    ("inequality-sign", lambda at: with_residual(inequality=lambda x, u: jnp.sign(x) - 1),
     "inequality", "zero"),
    ("inequality-nan", lambda at: with_residual(inequality=lambda x, u: x / 0),
     "inequality", "not finite"),
    ("inequality-norm", lambda at: with_residual(inequality=lambda x, u: jnp.linalg.norm(x) - 1),
     "derivative of inequality"),
    ("terminal-equality-arity", lambda at: point(terminal_equality=lambda x, u: x),
     "terminal_equality", "1 argument"),
    ("terminal-inequality-text", lambda at: point(terminal_inequality=lambda x: "no"), "'no'"),
    ("goal-text", lambda at: point(goal="upright"), "goal is 'upright'"),
    ("goal-raises", lambda at: point(goal=fails), "goal failed", "no such sensor"),
    ("goal-text-returned", lambda at: point(goal=lambda x: "yes"), "goal returned", "truth value"),
    ("goal-vector", lambda at: point(goal=lambda x: x > 0), "goal returned shape (2,)"),
    ("guess-number", lambda at: point(guess=3), "guess is 3"),
    ("guess-raises", lambda at: point(guess=fails), "guess failed", "no such sensor"),
    ("guess-none", lambda at: point(guess=lambda key: None),
     "guess returned a NoneType", "x (10, 2)"),
    ("guess-shape",
     lambda at: point(guess=lambda key: Trajectory(jnp.zeros((9, 2)), jnp.zeros((10, 2)))),
     "(9, 2)", "x (10, 2)"),
    ("guess-tuple", lambda at: point(guess=lambda key: (jnp.zeros((10, 2)), jnp.zeros((10, 2)))),
     "guess returned a tuple"),
]
# fmt: on


@pytest.mark.parametrize(
    ("call", "words"), cases(argument=ARGUMENTS, cost=COSTS, function=FUNCTIONS)
)
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)


NOTED = []


def noting(x, u):
    """Keeps count without reading it."""
    NOTED.append(1)
    return x @ x


def jumps(x, u):
    """As no exact derivative follows it."""
    return jnp.round(x).sum()


SAMPLED = Langevin(preconditioner=GaussNewton(derivatives=Smoothed()))

# fmt: off
ACCEPTED = {
    "constant": (lambda x, u: 1.0, Restarts()),
    "zero": (lambda x, u: jnp.zeros(()), Restarts()),
    "relu": (lambda x, u: jax.nn.relu(x).sum() + jnp.abs(u).sum(), Restarts()),
    "where": (lambda x, u: jnp.where(x > 0, x, 0.0).sum(), Restarts()),
    "cond": (lambda x, u: jax.lax.cond(x[0] > 0, jnp.sum, jnp.prod, x), Restarts()),
    "partly": (lambda x, u: jumps(x, u) + u @ u, Restarts()),
    "ends": (lambda x, u: x[jnp.array([0, -1])] @ x[np.array([-2, 1])] + u[-1] ** 2, Restarts()),
    "clipped": (lambda x, u: x[jnp.clip(jnp.array([5, -7]), 0, 1)].sum(), Restarts()),
    "filled": (lambda x, u: x.at[5].get(mode="fill", fill_value=0.0) + u @ u, Restarts()),
    "notes": (noting, Restarts()),
    "callback": (called_back, SAMPLED),
    "jumps": (jumps, SAMPLED),
    "law": (jumps, Langevin(preconditioner=Identity(), adjusted=True)),
}
# fmt: on


@pytest.mark.parametrize(("cost", "solver"), ACCEPTED.values(), ids=ACCEPTED)
def test_what_only_looks_bad_is_accepted(cost, solver):
    settled(point(running_cost=cost), 1, 0, solver)


def test_a_reverse_rule_is_enough_for_a_flow_that_needs_no_other():
    settled(from_program(2, cost=backwards), 1, 0, Langevin(preconditioner=LBFGS()))


@pytest.mark.parametrize("bounds", [None, (-INF, INF), (-INF, 1.0), np.array([[-1, -1], [1, 1]])])
def test_bounds_that_leave_room_are_accepted(bounds):
    assert np.isfinite(point(x_bounds=bounds).scatter.x_upper).all()


def test_an_error_in_a_users_function_is_told_with_its_line():
    def helper(x):
        return jnp.ones(3) @ x

    def cost(x, u):
        return helper(x)

    line = helper.__code__.co_firstlineno + 1
    with pytest.raises(DraxError, match=rf"\(test_bad_input\.py, line {line}\)\. Change it: "):
        point(running_cost=cost)
    with pytest.raises(DraxError, match=r"traced: NameError: .* is not defined \("):
        point(running_cost=lambda x, u: nothing_of_that_name)  # noqa: F821
