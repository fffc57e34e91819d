"""Parts of a user's own, as CONTRIBUTING shows them, work like those of the library.

The examples are taken from the page into a module of their own, which nothing in the library knows.
"""

import importlib
import json
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import ArrayLike

from mjx_drax import (
    MPC,
    DraxError,
    Geometric,
    Langevin,
    Metric,
    Restarts,
    Solution,
    Trajectory,
    from_dynamics,
    from_function,
    register_dataclass,
    solve,
)
from mjx_drax.method.model import expand
from mjx_drax.problem.trajectory import box
from mjx_drax.search.settings import changed, from_data, to_data
from mjx_drax.solution.export import exporter, exporters
from mjx_drax.solution.optima import cluster

PAGE = Path(__file__).parents[2] / "CONTRIBUTING.md"
MODULE = "my_parts"
SECTIONS = ["A metric", "A handling of bounds", "A schedule", "Dynamics", "An exporter"]


def examples():
    """The examples of every section about own parts, by its heading."""
    text = PAGE.read_text(encoding="utf-8")
    chapter = re.search(r"^## Parts of your own\n(.*?)^## ", text, re.DOTALL | re.MULTILINE)[1]
    heading, *rest = re.split(r"^### (.*)\n", chapter, flags=re.MULTILINE)
    assert "```python" not in heading
    return {
        name: re.findall(r"```python\n(.*?)```", body, re.DOTALL)
        for name, body in zip(rest[::2], rest[1::2], strict=True)
    }


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """The module that holds all examples."""
    folder = tmp_path_factory.mktemp("own")
    blocks = [block for blocks in examples().values() for block in blocks]
    (folder / f"{MODULE}.py").write_text("\n\n".join(blocks), encoding="utf-8")
    sys.path.insert(0, str(folder))
    yield importlib.import_module(MODULE)
    sys.path.remove(str(folder))
    sys.modules.pop(MODULE)


def test_every_part_has_a_short_example():
    found = examples()
    assert list(found) == SECTIONS
    for name, blocks in found.items():
        assert blocks, name
        for block in blocks:
            assert len([line for line in block.splitlines() if line.strip()]) <= 20, name


# On a problem whose functions are known

SOLVER = Restarts(
    Langevin(
        iterations=5,
        tail=30,
        noise=Geometric(0.1, 0.01),
        penalty=Geometric(2.0, 2.0),
        step_size=1e-2,
    ),
    descent=None,
    attempts=1,
)
FOLLOWING = "flow.preconditioner", f"{MODULE}:Following"


def cart():
    return from_function(
        lambda x, u: x + 0.1 * jnp.array([x[1], u[0]]),
        x_init=[0.0, 0.0],
        nu=1,
        dt=0.1,
        horizon=0.5,
        running_residual=lambda x, u: 0.1 * u,
        terminal_residual=lambda x: x - jnp.array([1.0, 0.0]),
        inequality=lambda x, u: x[1:] - 0.8,
        u_bounds=(-1.0, 1.0),
    )


def with_part(**part):
    return replace(SOLVER, flow=replace(SOLVER.flow, **part))


def reached(solver, name):
    for part in name.split("."):
        solver = getattr(solver, part)
    return solver


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text", "cls", "fields"),
    [
        ("flow.preconditioner", "Stiff", "Stiff", {"control": 10.0}),
        ("flow.preconditioner", "Stiff(control=5.0)", "Stiff", {"control": 5.0}),
        ("flow.preconditioner", "Following()", "Following", {"control": 10.0}),
        pytest.param(
            "flow.bounds", "Approach(0.9)", "Approach", {"share": 0.9}, marks=pytest.mark.slow
        ),
        ("flow.noise", "Cosine(0.1, 0.01)", "Cosine", {"start": 0.1, "end": 0.01}),
    ],
)
def test_a_part_is_set_by_name_solves_and_comes_back(mine, name, text, cls, fields, tmp_path):
    solver = changed(SOLVER, name, f"{MODULE}:{text}")
    part = reached(solver, name)
    assert type(part) is getattr(mine, cls)
    assert {field: getattr(part, field) for field in fields} == fields
    for field, value in fields.items():  # and its own settings by theirs
        again = changed(solver, f"{name}.{field}", str(value / 2))
        assert reached(again, f"{name}.{field}") == value / 2

    problem = cart()
    found = solve(problem, chains=2, solver=solver)
    assert (found.died_at == -1).all()
    assert found.max_defect.max() < 0.5 * found.history["max_defect"][0].max()
    assert found.max_violation.max() == 0.0
    assert reached(found.solver, name) == part
    found.save(tmp_path)
    for loaded in (Solution.load(tmp_path), Solution.load(tmp_path, problem)):
        assert loaded.solver == found.solver
        assert type(reached(loaded.solver, name)) is type(part)


@pytest.mark.slow
def test_a_solution_says_which_module_it_needs(mine, tmp_path):
    solver = changed(SOLVER, "flow.noise", f"{MODULE}:Cosine(0.1, 0.01)")
    solve(cart(), chains=1, solver=solver).save(tmp_path)
    module = sys.modules.pop(MODULE)
    try:
        with pytest.raises(DraxError, match=f"Cosine of the module {MODULE}: import {MODULE}"):
            Solution.load(tmp_path)
    finally:
        sys.modules[MODULE] = module


@pytest.mark.slow
def test_the_metrics_drift_and_noise_are_those_of_its_matrix(mine):
    problem, metric, flow = cart(), mine.Stiff(control=5.0), Langevin()
    knots = flow.inside(problem, problem.draw(jax.random.key(0)))
    state = flow.init(problem, knots, jax.random.key(1))
    at = knots, state.multipliers, flow.weights(0.0), metric.derivatives
    model = expand(problem, flow.bounds, *at, jax.random.key(2))
    to = metric.direction(problem, model, None, ())
    assert to.noise is None
    np.testing.assert_allclose(to.drift.x, -model.gradient.x)
    np.testing.assert_allclose(to.drift.u, -model.gradient.u / 5.0, rtol=1e-6)
    np.testing.assert_allclose(to.drift.slack.stage, -model.gradient.slack.stage)

    keys = jax.random.split(jax.random.key(3), 4000)
    noise = jax.vmap(lambda key: metric.direction(problem, model, key, ()).noise)(keys)
    for drawn, variance in ((noise.x, 1.0), (noise.u, 0.2), (noise.slack.stage, 1.0)):
        flat = np.asarray(drawn).reshape(len(keys), -1)
        expected = variance * np.eye(flat.shape[1])
        np.testing.assert_allclose(np.cov(flat.T), expected, atol=0.12 * variance)


def test_no_step_leaves_the_box(mine):
    bounds = box(2, 1, ([0.0, -np.inf], [1.0, np.inf]), (-1.0, 1.0))
    old = Trajectory(jnp.full((3, 2), 0.5), jnp.full((3, 1), -0.5))
    for size in (1e30, -1e30, 10.0, 0.1):
        new = mine.Approach().confine(bounds, old, jax.tree.map(lambda z, s=size: z + s, old))
        assert bounds.violation(new) == 0.0
        np.testing.assert_allclose(new.x[:, 0], 0.5 + np.clip(size, -0.25, 0.25), rtol=1e-6)
        np.testing.assert_allclose(new.x[:, 1], 0.5 + size, rtol=1e-6)
        np.testing.assert_allclose(new.u[:, 0], -0.5 + np.clip(size, -0.25, 0.75), rtol=1e-6)


def test_the_schedule_goes_from_start_to_end(mine):
    flow = replace(Langevin(), noise=mine.Cosine(3.0, 1.0))
    seen = [float(flow.weights(t).noise) for t in (0.0, 0.5, 1.0, 1.5, 2.0)]
    np.testing.assert_allclose(seen, [3.0, 2.0, 1.0, 1.0, 1.0], rtol=1e-6)


@register_dataclass
@dataclass(frozen=True)
class Odd(Metric):
    """Settings of all kinds, annotated with classes and not with texts."""

    count: int = 3
    pairs: float = 0.5  # of `LBFGS`, a whole number
    shift: float = -1.0
    weights: tuple = (1.0, -2.0)
    chosen: bool = False
    limit: float | None = None
    number: ArrayLike = 1
    inner: Geometric = Geometric(1.0, 0.1)


def test_settings_of_any_kind_are_set_and_come_back():
    solver, name = with_part(preconditioner=Odd()), "flow.preconditioner"
    solver.check(cart())
    for field, text, value in (
        ("count", "4", 4),
        ("shift", "-3", -3.0),
        ("chosen", "True", True),
        ("limit", "2", 2.0),
        ("number", "0.5", 0.5),
        ("inner.end", "0.2", 0.2),
    ):
        solver = changed(solver, f"{name}.{field}", text)
        seen = reached(solver, f"{name}.{field}")
        assert (seen, type(seen)) == (value, type(value))
    assert from_data(json.loads(json.dumps(to_data(solver)))) == solver


@dataclass(frozen=True)
class Bare(Metric):
    pass


@register_dataclass
@dataclass(frozen=True)
class Alone:
    def confine(self, box, old, new):
        return old


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"preconditioner": Bare()}, r"preconditioner is Bare\(\), no registered dataclass"),
        ({"noise": lambda t: t}, "noise is <function .*, no registered dataclass: make its class"),
        ({"bounds": Alone()}, r"bounds is Alone\(\): make its class inherit mjx_drax.Bounds"),
    ],
)
def test_what_could_not_come_back_is_refused_before_a_solve(part, words):
    with pytest.raises(DraxError, match=words):
        solve(cart(), chains=1, solver=with_part(**part))


def test_names_that_lead_nowhere_are_named(mine, tmp_path, monkeypatch):
    for text, words in (
        ("my_absent:Own", "'my_absent:Own' cannot be imported: ModuleNotFoundError"),
        (f"{MODULE}:Absent", "has no attribute 'Absent'"),
        (f"{MODULE}:Approach", "give one of .*Diagonal, .*, or MODULE:CLASS"),
    ):
        with pytest.raises(DraxError, match=words):
            changed(SOLVER, "flow.preconditioner", text)
    block = examples()["A metric"][0]
    (tmp_path / "parts_from_here.py").write_text(block, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    part = changed(SOLVER, "flow.preconditioner", "parts_from_here:Stiff").flow.preconditioner
    assert type(part).__module__ == "parts_from_here"


# On states that are no vectors

START, UP = 3.0, np.pi + 0.3  # the shortest way leads through the angle's jump at pi


def problem_of(dynamics):
    """Turn a pendulum by a third of a radian; for `Pendulum` the angle jumps on the way."""
    on_circle = dynamics.nx == 3
    x_init = [np.cos(START), np.sin(START), 0.0] if on_circle else [START, 0.0]

    def miss(x):
        c, s = (x[0], x[1]) if on_circle else (jnp.cos(x[0]), jnp.sin(x[0]))
        return 10.0 * jnp.array([c - np.cos(UP), s - np.sin(UP), 0.1 * x[-1]])

    return from_dynamics(
        dynamics,
        x_init=x_init,
        horizon=0.5,
        running_residual=lambda x, u: 0.01 * u,
        terminal_residual=miss,
        u_bounds=(-20.0, 20.0),
    )


def angle(x):
    """Of states (..., nx)."""
    x = np.asarray(x)
    return np.arctan2(x[..., 1], x[..., 0]) if x.shape[-1] == 3 else x[..., 0]


def off(a, b):
    """Between two angles."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


@pytest.fixture(
    scope="module", params=[pytest.param("Pendulum", marks=pytest.mark.slow), "OnCircle"]
)
def swung(mine, request):
    """A solution with dynamics of a user's own."""
    problem = problem_of(getattr(mine, request.param)())
    return solve(problem, chains=2, solver=Langevin(iterations=5, tail=40))


def test_states_are_compared_and_displaced_as_the_dynamics_say(swung):
    dynamics = swung.problem.dynamics
    x, y = (swung.problem.draw(jax.random.key(i)).x[0] for i in (0, 1))
    dx = dynamics.difference(x, y)
    assert dx.shape == (2,) == (dynamics.ndx,)
    np.testing.assert_allclose(dynamics.integrate(y, dx), x, atol=1e-5)
    np.testing.assert_allclose(dynamics.host_difference(*map(np.asarray, (x, y))), dx, atol=1e-5)
    host = dynamics.host_integrate(np.asarray(y), np.asarray(dx))
    np.testing.assert_allclose(host, x, atol=1e-5)
    if dynamics.nx == 3:
        np.testing.assert_allclose(np.hypot(x[0], x[1]), 1.0, rtol=1e-5)


def test_own_dynamics_are_solved_certified_and_come_back(swung, tmp_path):
    assert swung.certified, swung.max_defect
    assert off(angle(swung.best.x[-1]), UP) < 0.05
    assert np.abs(np.diff(np.unwrap(angle(swung.best.x)))).max() < 0.3
    assert swung.gains.shape[-1] == 2
    swung.save(tmp_path)
    problem = swung.problem
    again = Solution.load(tmp_path, problem)
    assert type(again.problem.dynamics) is type(problem.dynamics)
    assert again.certify().certificate.success
    assert len(again.optima) == len(swung.optima) == 1
    alone = Solution.load(tmp_path)
    assert alone.certified
    dynamics = alone.problem.dynamics
    assert (dynamics.nx, dynamics.ndx, dynamics.nu) == (problem.dynamics.nx, 2, 1)
    np.testing.assert_array_equal(alone.replayed[0], swung.replayed[0])
    with pytest.raises(DraxError, match="not saved: load the solution with its problem"):
        cluster(dynamics, alone.trajectories.x)


@pytest.mark.slow
def test_mpc_takes_own_dynamics_metric_bounds_and_schedule(swung, mine):
    solver = SOLVER
    for name, text in (
        FOLLOWING,
        ("flow.bounds", f"{MODULE}:Approach(0.9)"),
        ("flow.noise", f"{MODULE}:Cosine(0.1, 0.01)"),
    ):
        solver = changed(solver, name, text)
    policy = MPC(swung.problem, chains=2, iterations=2, solver=solver)
    x, dynamics = np.asarray(swung.problem.x_init), swung.problem.dynamics
    for k in range(4):
        u = policy(x, k * dynamics.dt)
        assert np.abs(u).max() <= 20.0
        assert policy.latest.finite
        assert policy.latest.gains.shape == (10, 1, 2)
        assert np.abs(policy.latest.gains).max() > 0.0
        x = np.asarray(dynamics.step(jnp.asarray(x), jnp.asarray(u, jnp.float32)))


@pytest.mark.slow
def test_mpc_turns_through_the_jump(swung):
    policy = MPC(swung.problem, chains=4, iterations=4, solver=Langevin(iterations=5, tail=40))
    x, dynamics = np.asarray(swung.problem.x_init), swung.problem.dynamics
    for k in range(12):
        x = np.asarray(
            dynamics.step(jnp.asarray(x), jnp.asarray(policy(x, k * dynamics.dt), float))
        )
    assert policy.statistics.failed == 0
    assert off(angle(x), UP) < 0.2


# Exporters


@pytest.mark.slow
def test_the_exporter_writes_its_file(mine, tmp_path):
    each = exporter(f"{MODULE}:Text")
    assert type(each) is type(exporter("text")) is type(exporters()["text"]) is mine.Text
    found = solve(cart(), chains=1, solver=SOLVER)
    each.check(found.problem)
    each.write(found, tmp_path / each.file)
    written = np.loadtxt(tmp_path / each.file)
    np.testing.assert_allclose(written, found.replayed[1][:, 0])
