"""Units of the cost and of states, constants and terminal weights: the same motions come out."""

from dataclasses import replace
from functools import cache, partial

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax import from_function, from_mjcf, solve
from mjx_drax.problem.cost import Cost
from mjx_drax.tasks import bug_trap, cartpole_swingup, pendulum

CLOSE = 2e-2  # of motions, relative to how far a coordinate moves; costs agree to 0.2 %

# Problems: a step or a model, a cost in metres and radians, and what millimetres make of states


def in_units(f, unit, x, u):
    return unit * f(x / unit, u)


def in_metres(g, unit, x, *u):
    state = jnp.concatenate([x.qpos, x.qvel]) if hasattr(x, "qpos") else x
    return g(state / unit, *u)


def times(root, r, *at):
    return root * r(*at)


def constant_of(value, *at):
    return value


def cart_pole(z, u, dt=0.05):
    """Cart of 1 kg, pole of 0.3 kg and 0.5 m; x = (position, angle, velocities)."""
    _, angle, v, w = z
    s, c = jnp.sin(angle), jnp.cos(angle)
    force, below = 8.0 * u[0], 1.0 + 0.3 * s**2
    a = (0.15 * s * w**2 + force + 0.3 * 9.81 * c * s) / below
    turn = -(0.15 * c * s * w**2 + force * c + 1.3 * 9.81 * s) / (0.5 * below)
    v, w = v + dt * a, w + dt * turn
    return z + dt * jnp.array([v, w, a, turn])


def mass(x, u, dt=0.1):
    """A mass that a force pushes along a line or in a plane."""
    n = len(u)
    return x + dt * jnp.concatenate([x[n:] + 0.5 * dt * u, u])


def model(unit):
    """A cart with a pole on a rail, its lengths in 1 / unit metres."""
    return f"""<mujoco><option timestep="0.05" gravity="0 0 {-9.81 * unit}" integrator="Euler">
  <flag contact="disable"/></option><compiler angle="radian"/><worldbody><body>
  <joint name="rail" type="slide" axis="1 0 0" range="{-1.5 * unit} {1.5 * unit}" limited="true"/>
  <geom type="box" size="{0.1 * unit} {0.1 * unit} {0.1 * unit}" mass="1"/>
  <body><joint name="pole" axis="0 -1 0"/><geom type="capsule" mass="0.2"
  fromto="0 0 0 0 0 {-0.5 * unit}" size="{0.02 * unit}"/></body></body></worldbody><actuator>
  <motor joint="rail" gear="{6 * unit}" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>"""


def effort(weight, x, u):
    return np.sqrt(weight) * u


def end(weights, target, x):
    return jnp.asarray(np.sqrt(weights)) * (x - jnp.asarray(target))


PLANAR = [1.0, 0.0, 0.0, 0.0]
SWUNG = [0.0, np.pi, 0.0, 0.0]
PROBLEMS = {
    "line": {
        "f": mass,
        "x_init": [-1.0, 0.0],
        "nu": 1,
        "dt": 0.1,
        "horizon": 2.0,
        "running_residual": partial(effort, 0.02),
        "terminal_residual": partial(end, [20.0, 20.0], [0.0, 0.0]),
        "u_bounds": (-1.5, 1.5),
        "x_bounds": ([-2.0, -0.8], [2.0, 0.8]),
        "chains": 4,
        "unit": [1e3, 1e3],
    },
    "pendulum": {
        "f": pendulum.step,
        "x_init": [3.1, 0.0],
        "nu": 1,
        "dt": pendulum.DT,
        "horizon": 4.9,
        "running_residual": pendulum.running,
        "terminal_residual": pendulum.terminal,
        "u_bounds": (-1.0, 1.0),
        "x_scatter": (-6.0, 6.0),
        "chains": 16,
        "unit": [1e3, 1e3],
    },
    "round": {  # round a disc
        "f": mass,
        "x_init": [-1.0, 0.1, 0.0, 0.0],
        "nu": 2,
        "dt": 0.1,
        "horizon": 3.0,
        "running_residual": partial(effort, 0.02),
        "terminal_residual": partial(end, [20.0] * 4, PLANAR),
        "inequality": lambda x, u: (0.25 - jnp.sum(x[:2] ** 2))[None],
        "u_bounds": (-3.0, 3.0),
        "x_bounds": ([-2.0, -2.0, -3.0, -3.0], [2.0, 2.0, 3.0, 3.0]),
        "chains": 16,
        "unit": [1e3] * 4,
    },
    "cart_pole": {
        "f": cart_pole,
        "x_init": [0.0] * 4,
        "nu": 1,
        "dt": 0.05,
        "horizon": 2.0,
        "running_residual": partial(effort, 0.1),
        "terminal_residual": partial(end, [16.0, 100.0, 16.0, 16.0], SWUNG),
        "u_bounds": (-2.5, 2.5),
        "x_bounds": ([-2.0] + [-np.inf] * 3, [2.0] + [np.inf] * 3),
        "x_scatter": ([-2.0, -4.0, -4.0, -8.0], [2.0, 4.0, 4.0, 8.0]),
        "chains": 32,
        "unit": [1e3, 1.0, 1e3, 1.0],
    },
    "bug_trap": {
        "f": bug_trap.step,
        "x_init": [-1.0, 0.0, 0.0],
        "nu": 2,
        "dt": bug_trap.DT,
        "horizon": 11.9,
        "running_residual": partial(bug_trap.running, bug_trap.WALL),
        "terminal_residual": bug_trap.terminal,
        "x_bounds": ([-3.0, -3.0, -np.inf], [3.0, 3.0, np.inf]),
        "u_bounds": (-1.0, 1.0),
        "x_scatter": ([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi]),
        "chains": 64,
        "unit": [1e3, 1e3, 1.0],
    },
    "mjcf": {
        "model": model,
        "horizon": 1.5,
        "running_residual": lambda data, u: np.sqrt(0.1) * u,
        "terminal_residual": partial(end, [16.0, 100.0, 16.0, 16.0], SWUNG),
        "x_scatter": ([-1.5, -np.pi, -5.0, -8.0], [1.5, np.pi, 5.0, 8.0]),
        "chains": 16,
        "unit": [1e3, 1.0, 1e3, 1.0],
    },
    "cartpole_swingup": {"task": cartpole_swingup.make, "chains": 16},
}
SAME = {"cost x 1e-6": {"weight": 1e-6}, "cost x 1e6": {"weight": 1e6}}
SAME |= {"+ 1000": {"constant": 1e3}, "- 1000": {"constant": -1e3}, "mm": {"millimetres": True}}
WEIGHTS = (1e-2, 1.0, 1e2, 1e4, 1e6)


def made(name, millimetres=False, weight=1.0, constant=0.0, terminal=1.0):
    """The problem: weight (l + terminal phi) + constant. All changes share one compilation."""
    given = {n: g for n, g in PROBLEMS[name].items() if n not in ("chains", "unit", "task")}
    if "task" in PROBLEMS[name]:
        problem = PROBLEMS[name]["task"]()
    else:
        unit = np.array(PROBLEMS[name]["unit"]) if millimetres else np.ones(len(unit_of(name)))
        here = jnp.asarray(unit, float)
        for n in ("running_residual", "terminal_residual", "inequality"):
            if n in given:
                given[n] = Partial(in_metres, Partial(given[n]), here)
        for n in ("x_bounds", "x_scatter"):
            if n in given:
                given[n] = tuple(unit * np.array(end) for end in given[n])
        if "model" in given:
            problem = from_mjcf(given.pop("model")(unit[0]), **given)
        else:
            given |= {"f": Partial(in_units, Partial(given["f"]), here)}
            problem = from_function(**{**given, "x_init": unit * given["x_init"]})

    def changed(cost, root, share):
        scalar = Partial(constant_of, jnp.asarray(share, float))
        return Cost(scalar, Partial(times, jnp.asarray(root, float), cost.residual))

    running = changed(problem.running, np.sqrt(weight), constant / 2 / problem.horizon)
    last = changed(problem.terminal, np.sqrt(weight * terminal), constant / 2)
    return replace(problem, running=running, terminal=last, goal=None)


def unit_of(name):
    return PROBLEMS[name].get("unit", [1.0])


@cache
def answer(name, **changes):
    """Knots of the best chain in metres, and what share of the chains costs the same."""
    found = solve(made(name, **changes), chains=PROBLEMS[name]["chains"])
    unit = np.array(unit_of(name)) if changes.get("millimetres") else 1.0
    best = found.best_chain
    assert found.optimal_chains[best], (name, changes)
    least = {**changes, "millimetres": False, "weight": 1.0, "constant": 0.0}
    knots = replace(found.best, x=found.best.x / unit)
    excess = (found.cost - changes.get("constant", 0.0)) / changes.get("weight", 1.0)
    cost = float(made(name, **least).cost(replace(knots, slack=None)))
    return knots, cost, np.mean(excess < 1.1 * cost + 1e-6)


def mirrored(name, z):
    """The motion round the other side of the trap, or of the cart; it costs the same."""
    x, u = np.asarray(z.x), np.asarray(z.u)
    sides = {"bug_trap": ([1, -1, -1], [1, -1]), "cartpole_swingup": (-1, -1)}
    of_x, of_u = sides.get(name, (1, 1))
    return x * of_x, u * of_u


@pytest.mark.slow
@pytest.mark.parametrize("change", SAME)
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_same_motion_comes_out(name, change):
    if change == "mm" and "unit" not in PROBLEMS[name]:
        pytest.skip("its model is a file in metres")
    knots, cost, share = answer(name)
    other, other_cost, other_share = answer(name, **SAME[change])
    assert other_cost == pytest.approx(cost, rel=2e-3)
    assert other_share >= share - 0.35
    x, u = np.asarray(other.x), np.asarray(other.u)
    apart = []
    for mine in ((np.asarray(knots.x), np.asarray(knots.u)), mirrored(name, knots)):
        extents = [np.maximum(np.abs(z).max(axis=0), 0.1) for z in mine]
        apart.append(
            max(np.max(np.abs(a - b) / e) for a, b, e in zip((x, u), mine, extents, strict=True))
        )
    assert min(apart) < CLOSE


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_answer_to_each_terminal_weight_is_the_cheapest_at_that_weight(name):
    # At 1e6 the swing-up's is 5e8 times the running weight: too much for float32
    weights = WEIGHTS[:-1] if name == "cartpole_swingup" else WEIGHTS
    answers = [answer(name, terminal=w)[0] for w in weights]
    for weight, mine in zip(weights, answers, strict=True):
        problem = made(name, terminal=weight)
        own, *others = (float(problem.cost(replace(z, slack=None))) for z in (mine, *answers))
        assert own <= 1.002 * min(others), weight


@pytest.mark.slow
def test_states_may_be_of_any_size_though_nobody_gives_their_box():
    given = {n: PROBLEMS["line"][n] for n in ("nu", "dt", "horizon", "u_bounds")}
    costs = []
    for size in (1.0, 1e6):
        problem = from_function(
            partial(in_units, mass, size),
            x_init=[-size, 0.0],
            running_residual=partial(in_metres, partial(effort, 0.02), size),
            terminal_residual=partial(in_metres, PROBLEMS["line"]["terminal_residual"], size),
            **given,
        )
        found = solve(problem, chains=4, progress=False)
        assert found.optimal
        costs.append(found.replay_cost[found.best_chain])
    assert costs[1] == pytest.approx(costs[0], rel=1e-3)
