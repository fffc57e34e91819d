"""The rule of the room: equations only, in few short files that can be read beside the paper."""

import ast
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from builders import double_integrator

import mjx_drax
from mjx_drax.problem.trajectory import Trajectory

FILES = [
    path
    for path in sorted((Path(mjx_drax.__file__).parent / "method").glob("*.py"))
    if path.name != "__init__.py"
]
FORBIDDEN = {
    "kinked": "whether f has kinks is the business of the search",
    "jit": "the search compiles",
    "device_put": "the search chooses devices",
    "devices": "the search chooses devices",
}


def test_the_room_is_small():
    assert len(FILES) <= 8


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_holds_equations_only(path):
    text = path.read_text(encoding="utf-8")
    lines = text.count("\n")
    assert lines <= 250
    for node in ast.walk(ast.parse(text)):
        assert not isinstance(node, ast.Raise), f"line {node.lineno}: checks stand at the doors"
        for name in {getattr(node, field, None) for field in ("id", "attr", "arg", "name")}:
            assert name not in FORBIDDEN, f"line {node.lineno}: {FORBIDDEN[name]}"


def test_an_iteration_with_noise_runs_through_six_files():
    problem = double_integrator(running_cost=lambda x, u: u @ u, u_bounds=(-1.0, 1.0))
    flow, key = mjx_drax.Langevin(), jax.random.key(0)
    K, nx, nu = problem.horizon, problem.dynamics.nx, problem.dynamics.nu
    state = flow.init(problem, Trajectory(jnp.zeros((K, nx)), jnp.zeros((K, nu))), key)
    seen = set()

    def iterate(state):
        model = flow.model(problem, state, flow.weights(0.0), key, tail=True)
        to = flow.preconditioner.direction(problem, model, key, state.memory)
        return flow.diffuse(problem, state, model, to, key, tail=True)

    sys.setprofile(lambda frame, event, arg: seen.add(frame.f_code.co_filename))
    try:
        jax.eval_shape(iterate, state)
    finally:
        sys.setprofile(None)
    names = {path.stem for path in FILES if str(path) in seen}
    assert names == {"schedules", "model", "bounds", "riccati", "gauss_newton", "langevin"}
