"""Chains spread over devices: the same answers. Virtual CPU devices, in a process of their own."""

import os
import socket
import subprocess
import sys

import numpy as np
import pytest

from mjx_drax import DraxError
from mjx_drax.search.devices import mesh_for

PROBLEM = """
from dataclasses import replace
import jax.numpy as jnp, numpy as np, pytest
from mjx_drax import DraxError, Restarts, from_function, from_mjcf, solve, solve_batch
from mjx_drax.search import checkpoint

problem = from_function(
    lambda x, u: x + 0.1 * jnp.array([x[1], u[0] - jnp.sin(x[0])]),
    x_init=[0.5, 0.0], nu=1, dt=0.1, horizon=1.0,
    running_residual=lambda x, u: 0.1 * u, terminal_residual=lambda x: 10.0 * x,
    u_bounds=(-2.0, 2.0),
)
"""

PROGRAM = """
import sys, time
import jax
from mjx_drax.search import devices

count = int(sys.argv[2])
assert len(jax.devices()) == count
solver = Restarts(replace(Restarts().flow, iterations=20, tail=10), descent=10, attempts=2)
if sys.argv[3] == "solve":
    solver = solver.flow  # half the programs
alone, spread = (solve(problem, 8, 0, solver, devices=n) for n in (1, count))

def same(one, other):
    np.testing.assert_array_equal(one.trajectories.u, other.trajectories.u)
    np.testing.assert_array_equal(one.cost, other.cost)

same(spread, alone)
assert sys.argv[3] in ("solve", "all")
if sys.argv[3] == "solve":
    sys.exit()

class Killed(BaseException):
    pass

def kill(*_):
    raise Killed

checkpoint.EVERY = 0.0
with pytest.raises(Killed):
    solve(problem, 8, 0, solver, progress=kill, devices=count, checkpoint=sys.argv[1])
same(solve(problem, 8, 0, solver, devices=max(count // 4, 1), checkpoint=sys.argv[1]), alone)
starts = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 2)).astype(np.float32)
alone, many = (
    solve_batch(lambda x: replace(problem, x_init=x), starts, 2, 0, solver, devices=n)
    for n in (1, 2)
)
np.testing.assert_array_equal(many.u, alone.u)
three = solve_batch(lambda x: replace(problem, x_init=x), starts[:3], 2, 0, solver, devices=2)
np.testing.assert_array_equal(three.u, alone.u[:3])

def overlap(compiles):
    # How many devices work at a time.
    busy, most = [], []
    def program(rows):
        busy.append(rows)
        time.sleep(0.2)
        most.append(len(busy))
        busy.pop()
        return rows
    devices.split_over(program, devices.mesh_for(8, count))(jnp.zeros(8), compiles=compiles)
    return max(most)

assert overlap(False) == overlap(True) == count
jax.default_backend = lambda: "gpu"  # where the others find what the first one compiled
assert overlap(False) == count and overlap(True) == 1
"""


@pytest.mark.slow
@pytest.mark.parametrize(("count", "what"), [(2, "solve"), (2, "all"), (8, "all")])
def test_several_devices_give_the_answers_of_one(count, what, tmp_path):
    flags = f"--xla_force_host_platform_device_count={count}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    ran = subprocess.run(
        [sys.executable, "-c", PROBLEM + PROGRAM, str(tmp_path / "run.ckpt"), str(count), what],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr


PROCESS = """
import sys
import jax
port, index, out = sys.argv[1:]
if port != "alone":
    jax.distributed.initialize(f"127.0.0.1:{port}", 2, int(index))
PROBLEM
from mjx_drax.models import path

from_mjcf(path("pendulum"), horizon=0.2, running_residual=lambda data, u: u)  # on own devices
solver = Restarts(replace(Restarts().flow, iterations=8, tail=4), descent=4, attempts=2)
found = solve(problem, 4, 0, solver)
once = solve(problem, 4, 0, replace(solver, attempts=1))
starts = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 2)).astype(np.float32)
many = solve_batch(lambda x: replace(problem, x_init=x), starts, 2, 0, solver)
if port != "alone":
    for count, options, words in ((3, {}, "2 processes"), (4, {"checkpoint": "x"}, "one file")):
        with pytest.raises(DraxError, match=words):
            solve(problem, count, 0, solver, **options)
np.savez(out, u=found.trajectories.u, x=found.trajectories.x, cost=found.cost,
         once=once.trajectories.u, ends=found.feedback.states, many=many.u, costs=many.cost)
""".replace("PROBLEM", PROBLEM)  # jax.distributed comes before anything else of JAX


@pytest.mark.slow
def test_two_processes_give_the_answers_of_one(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}

    def start(port, index):
        command = [sys.executable, "-c", PROCESS, port, index, str(tmp_path / f"{port}{index}.npz")]
        return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)

    running = [start("alone", "0"), start(port, "0"), start(port, "1")]
    for process in running:
        _, words = process.communicate(timeout=250)
        assert process.returncode == 0, words
    alone, first, second = (
        np.load(tmp_path / f"{name}.npz") for name in ("alone0", f"{port}0", f"{port}1")
    )
    for name in alone:
        np.testing.assert_array_equal(first[name], second[name])
        np.testing.assert_array_equal(first[name], alone[name])


@pytest.mark.parametrize("devices", [0, 1000, "two"])
def test_devices_that_are_not_there_are_refused(devices):
    with pytest.raises(DraxError, match="give a whole number from 1 to"):
        mesh_for(8, devices)


def test_one_device_needs_no_mesh():
    assert mesh_for(7) is None
