"""Solves that are killed go on to the same answer, and files that cannot be used are refused."""

import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, fields, is_dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import Bouncing, bouncing

from mjx_drax import (
    DraxError,
    Langevin,
    Restarts,
    Trajectory,
    from_function,
    from_mjcf,
    solve,
    solve_batch,
)
from mjx_drax.base import digests
from mjx_drax.base.errors import DraxWarning
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.search import checkpoint, engine, recording, restarts
from mjx_drax.search.engine import Search
from mjx_drax.search.iterate import iterate
from mjx_drax.search.restarts import Rollouts

DT, CHAINS = 0.1, 4
SOLVER = Restarts(
    replace(Restarts().flow, iterations=20, tail=20), descent=20, attempts=3, done_share=2.0
)
STARTS = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 2)).astype(np.float32)


def swing(x, u):
    return x + DT * jnp.array([x[1], u[0] - jnp.sin(x[0])])


def problem(f=swing, effort=0.1, **rest):
    given = {"x_init": [0.5, 0.0], "u_bounds": (-2.0, 2.0)} | rest
    return from_function(
        f,
        nu=1,
        dt=DT,
        horizon=10 * DT,
        running_residual=lambda x, u: effort * u,
        terminal_residual=lambda x: 10.0 * x,
        **given,
    )


PROBLEM = problem()


def from_start(x):
    return replace(PROBLEM, x_init=x)


def solved(**changes):
    return solve(**({"problem": PROBLEM, "chains": CHAINS, "solver": SOLVER} | changes))


def batch(**changes):
    given = {"make": from_start, "values": STARTS, "chains": 2, "solver": SOLVER, "chunk": 2}
    return solve_batch(**(given | changes))


def assert_same(one, other):
    """Bit for bit, but for the time that it took."""
    if is_dataclass(one):
        names = {f.name for f in fields(one)} - {"problem", "family", "solver"}
        for name in names - {"compile_time", "solve_time", "replay_time"}:
            assert_same(getattr(one, name), getattr(other, name))
    elif isinstance(one, dict):
        for name in one:
            assert_same(one[name], other[name])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    else:
        np.testing.assert_array_equal(one, other)


class Killed(BaseException):
    """Stands for SIGKILL: nothing in the library catches it."""


def killed_after(count):
    """A callback that kills at its call of that number, from 1."""
    calls = iter(range(1, 10_000))

    def progress(*_):
        if next(calls) == count:
            raise Killed

    return progress


@pytest.fixture
def often(monkeypatch):
    """A checkpoint at every report."""
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    monkeypatch.setattr(checkpoint, "SHARE", np.inf)


@pytest.fixture(scope="module")
def whole():
    return solved()


@pytest.fixture(scope="module")
def whole_batch():
    return batch()


# The answer


@pytest.mark.slow
def test_the_same_call_gives_the_same_answer(whole, whole_batch):
    assert_same(solved(), whole)
    assert_same(batch(), whole_batch)
    assert whole.history["began"].tolist() == [0, 40, 80]  # all attempts are made


@pytest.mark.usefixtures("often")
def test_killed_at_any_report_it_goes_on_to_the_same_answer(whole, tmp_path):
    file = tmp_path / "deep" / "run.ckpt"
    for count in range(1, 7):  # of six reports
        with pytest.raises(Killed):
            solved(checkpoint=file, progress=killed_after(count))
        assert_same(solved(checkpoint=file), whole)
        file.unlink()
    for _ in range(6):  # and one after the other
        with pytest.raises(Killed):
            solved(checkpoint=file, progress=killed_after(1))
    assert_same(solved(checkpoint=file), whole)
    assert [f.name for f in file.parent.iterdir()] == ["run.ckpt"]


@pytest.mark.slow
@pytest.mark.usefixtures("often")
def test_a_batch_that_is_killed_goes_on_to_the_same_answer(whole_batch, tmp_path):
    file, seen = tmp_path / "run.ckpt", []

    def killed(done, total):
        seen.append(done)
        raise Killed

    for _ in range(9):  # chunks, in three attempts
        with pytest.raises(Killed):
            batch(checkpoint=file, progress=killed)
    assert seen == [2, 4, 5] * 3  # and no chunk was solved twice
    assert_same(batch(checkpoint=file, chunk=None), whole_batch)  # whatever memory is free now
    with pytest.raises(DraxError, match="was written for chunk 2, and this solve has chunk 3"):
        batch(checkpoint=file, chunk=3)
    with pytest.raises(DraxError, match="was written for call solve_batch, and"):
        solved(checkpoint=file)


@pytest.mark.slow
@pytest.mark.usefixtures("often")
def test_a_large_batch_goes_on_where_its_last_chains_were(tmp_path, monkeypatch):
    for name, value in {"MANY": 16, "REPORT_EVERY": 2}.items():
        monkeypatch.setattr(engine, name, value)
    starts = np.random.default_rng(2).uniform(-0.3, 0.3, (8, 2)).astype(np.float32)
    starts[5] = 0.9, 9.0  # it hits the wall, so later attempts are at this one alone
    walls = replace(PROBLEM.bounds, x_upper=jnp.array([1.0, 10.0]))
    given = {
        "make": lambda x: replace(PROBLEM, x_init=x, bounds=walls),
        "values": starts,
        "chunk": None,
        "solver": replace(SOLVER, done_share=None),
    }
    file, calls, kill_at, iterated = tmp_path / "run.ckpt", [], [], Search._iterated

    def stopped(self, state, start, stop):
        if stop > start:
            calls.append(len(state.alive))
            if [len(calls)] == kill_at:
                raise Killed
        return iterated(self, state, start, stop)

    monkeypatch.setattr(Search, "_iterated", stopped)
    whole = batch(**given)
    widths = calls.copy()
    assert widths[-2:] == [2, 2]
    assert set(widths[:-2]) == {16}
    assert len(widths) > 3
    for count in range(2, len(widths) + 1):
        calls.clear()
        kill_at[:] = [count]
        with pytest.raises(Killed):
            batch(checkpoint=file, **given)
        kill_at.clear()
        assert_same(batch(checkpoint=file, **given), whole)
        file.unlink()


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize(("limit", "stops"), [(recording.LIMIT, (1, 10, 20)), (6000, (1, 5, 12))])
def test_a_recording_goes_on_too(limit, stops, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "LIMIT", limit)  # if it is full, fewer snapshots are taken
    whole, file = solved(record=3), tmp_path / "run.ckpt"
    for count in stops:
        with pytest.raises(Killed):
            solved(record=3, checkpoint=file, progress=killed_after(count))
    assert_same(solved(record=3, checkpoint=file), whole)
    with pytest.raises(DraxError, match="record 3, and this solve has record None"):
        solved(checkpoint=file)


@pytest.mark.slow
@pytest.mark.usefixtures("often")
def test_attempts_of_different_sizes_go_on_too(tmp_path, monkeypatch):
    monkeypatch.setattr(restarts, "ROOM", 2 * CHAINS)
    again = {"solver": replace(SOLVER, tries=3), "record": 3}
    whole, file = solved(**again), tmp_path / "run.ckpt"
    sizes = [len(attempt.owners) for attempt in whole.recording.attempts]
    assert sizes == [2 * CHAINS, 3 * CHAINS, 3 * CHAINS]
    _, second, third = (whole.history["iteration"] <= began for began in whole.history["began"])
    for count in (second.sum(), third.sum() - second.sum(), 1):  # in the second, third and third
        with pytest.raises(Killed):
            solved(**again, checkpoint=file, progress=killed_after(count))
    assert_same(solved(**again, checkpoint=file), whole)


stop_at_replay = []
"""What to raise at the next replay but n, as [n, exception]; empty for nothing."""


@register_dataclass
@dataclass(frozen=True)
class Stopped(Bouncing):
    """The bouncing ball, whose replays may be stopped."""

    def replay(self, *arguments):
        """By `stop_at_replay`."""
        if stop_at_replay:
            left, stop = stop_at_replay
            stop_at_replay[:] = [left - 1, stop] if left else []
            if not left:
                raise stop
        return super().replay(*arguments)


KINKED = Restarts(replace(Restarts().flow, tail=40), descent=60, attempts=1)
STOPS = [(0, Killed), (1, KeyboardInterrupt), (1, Killed), (2, KeyboardInterrupt), (1, Killed)]


@pytest.mark.slow
@pytest.mark.usefixtures("often")
def test_killed_between_rollouts(tmp_path):
    given = {"problem": bouncing(Stopped), "solver": KINKED}
    whole, file = solved(**given), tmp_path / "run.ckpt"
    assert whole.iterations > 100 + 3 * Rollouts().iterations  # so there were some
    for left, stop in STOPS:
        stop_at_replay[:] = [left, stop]
        if stop is Killed:
            with pytest.raises(Killed):
                solved(checkpoint=file, **given)
        else:
            assert solved(checkpoint=file, **given).iterations < whole.iterations
        assert not stop_at_replay  # it came so far
    assert_same(solved(checkpoint=file, **given), whole)


@pytest.mark.slow
@pytest.mark.usefixtures("often")
def test_a_batch_that_is_killed_between_rollouts(tmp_path):
    ball, starts = bouncing(Stopped), np.array([[1.0, 0.0], [0.8, 0.5], [1.1, 0.0]], np.float32)
    given = {"make": lambda x: replace(ball, x_init=x), "values": starts, "solver": KINKED}
    whole, file = batch(**given), tmp_path / "run.ckpt"
    for left, stop in STOPS[:-1]:
        stop_at_replay[:] = [left, stop]
        if stop is Killed:
            with pytest.raises(Killed):
                batch(checkpoint=file, **given)
        else:
            assert not np.isfinite(batch(checkpoint=file, **given).cost[2])  # of the next chunk
        assert not stop_at_replay
    assert_same(batch(checkpoint=file, **given), whole)


class Unused:
    """The loop over iterations, of which it is only asked what it computes."""

    identity = iterate.identity

    def __call__(self, *_, **__):
        pytest.fail("it iterates")


def test_what_is_complete_is_not_solved_again(whole, whole_batch, tmp_path, monkeypatch):
    one, many = tmp_path / "one.ckpt", tmp_path / "many.ckpt"
    first = solved(checkpoint=one)
    batch(checkpoint=many)
    written = one.stat().st_mtime_ns, many.stat().st_mtime_ns
    monkeypatch.setattr(engine, "iterate", Unused())
    # The text of a traced program differs with what a process has traced before
    monkeypatch.setattr(type(iterate), "lower", lambda *_, **__: pytest.fail("it is traced"))
    again = solved(checkpoint=one)
    assert_same(again, whole)
    assert again.solve_time == pytest.approx(first.solve_time, abs=0.1)
    assert_same(batch(checkpoint=many), whole_batch)
    assert written == (one.stat().st_mtime_ns, many.stat().st_mtime_ns)


def test_ctrl_c_keeps_the_best_and_the_same_call_goes_on(whole, tmp_path):
    def interrupt(done, total, info):
        if done > 60:
            raise KeyboardInterrupt

    file = tmp_path / "run.ckpt"
    early = solved(checkpoint=file, progress=interrupt)
    assert early.iterations < whole.iterations
    seen = []
    assert_same(solved(checkpoint=file, progress=lambda done, *_: seen.append(done)), whole)
    assert seen[0] > early.iterations


BALL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.5">
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="lift" ctrlrange="-3 3"/></actuator>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.usefixtures("often")
def test_a_model_with_contacts_goes_on_to_the_same_answer(tmp_path):
    model = from_mjcf(BALL, horizon=0.6, dt=0.02, terminal_residual=lambda data: 10.0 * data.qpos)
    given = {"problem": model, "solver": replace(SOLVER, attempts=2)}
    seen, file = [], tmp_path / "run.ckpt"
    whole = solved(progress=lambda *_: seen.append(1), **given)
    assert len(seen) > 4
    for count in range(1, len(seen) + 1):
        with pytest.raises(Killed):
            solved(checkpoint=file, progress=killed_after(count), **given)
        assert_same(solved(checkpoint=file, **given), whole)
        file.unlink()


# The question


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    file = tmp_path_factory.mktemp("checkpoint") / "run.ckpt"
    solved(checkpoint=file)
    return file


GUESS = Trajectory(jnp.ones((10, 2)), jnp.zeros((10, 1)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 1}, "was written for seed 0, and this solve has seed 1: choose another file, or"),
        ({"chains": 8}, "chains 4, and this solve has chains 8"),
        ({"solver": replace(SOLVER, within=0.5)}, "settings.within 0.1, and this solve has"),
        ({"solver": Langevin()}, "settings.flow.iterations 20, and this solve has"),
        (
            {"problem": problem(x_init=[0.4, 0.0])},
            "other numbers in problem.x_init than this solve",
        ),
        ({"problem": problem(u_bounds=(-1.0, 2.0))}, "other numbers in problem.bounds.u_lower"),
        ({"guess": GUESS}, "other initial knots"),
        ({"problem": problem(guess=lambda key: GUESS)}, "other initial knots"),
        ({"problem": problem(effort=0.2)}, "other functions"),
        pytest.param(
            {"problem": problem(f=lambda x, u: swing(x, 1.1 * u))},
            "other functions",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_another_question_is_refused(written, changes, words):
    before = written.read_bytes()
    with pytest.raises(DraxError, match=words):
        solved(checkpoint=written, **changes)
    assert written.read_bytes() == before


def test_a_file_that_other_code_has_written_is_refused(written, monkeypatch):
    monkeypatch.setattr(checkpoint, "code", lambda: "sha256:0")
    with pytest.raises(DraxError, match="written for other code of mjx_drax than this solve has"):
        solved(checkpoint=written)


@pytest.mark.slow
def test_names_and_goals_are_no_part_of_the_question(written, whole):
    other = problem(goal=lambda x: False, name="other")
    again = solved(problem=other, checkpoint=written)
    np.testing.assert_array_equal(again.trajectories.u, whole.trajectories.u)
    assert not again.certified


def test_damaged_files_are_refused(written, whole, tmp_path):
    file, content = tmp_path / "run.ckpt", written.read_bytes()
    for size in (0, 1, 100, len(content) // 2, len(content) - 1):
        file.write_bytes(content[:size])
        with pytest.raises(
            DraxError, match=r"run.ckpt' is damaged, or no checkpoint: .* delete it"
        ):
            solved(checkpoint=file)
    for place in np.random.default_rng(0).integers(0, len(content), 40):
        file.write_bytes(content[:place] + bytes([content[place] ^ 255]) + content[place + 1 :])
        try:
            found, question = checkpoint.read(file)
        except DraxError:
            continue
        assert_same((found, question), checkpoint.read(written))  # a date, or the like


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"not a checkpoint", "is damaged, or no checkpoint"),
        (None, "Is a directory"),
    ],
)
def test_what_is_no_checkpoint_is_refused(content, words, tmp_path):
    file = tmp_path / "run.ckpt"
    file.mkdir() if content is None else file.write_bytes(content)
    with pytest.raises(DraxError, match=words):
        solved(checkpoint=file)


def test_a_checkpoint_of_another_version_is_refused(written, tmp_path, monkeypatch):
    monkeypatch.setattr(digests, "__version__", "9.9")
    with pytest.raises(DraxError, match=r"version.mjx-drax .*, and this solve has .* 9.9"):
        solved(checkpoint=written)
    monkeypatch.setattr(checkpoint, "FORMAT", 9)
    with pytest.raises(DraxError, match="is a checkpoint of format 8, and this version"):
        solved(checkpoint=written)


# The disk


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_iterates")
@pytest.mark.parametrize("call", [solved, batch])
def test_what_cannot_be_written_is_refused_before_the_solve(call, tmp_path, monkeypatch):
    fresh = problem()  # for which nothing is compiled yet
    make = {"make": lambda x: replace(fresh, x_init=x)}
    given = {"problem": fresh} if call is solved else make
    (tmp_path / "file").touch()
    with pytest.raises(DraxError, match="Not a directory"):
        call(checkpoint=tmp_path / "file" / "run.ckpt", **given)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(DraxError, match=r"cannot write '.*run.ckpt': No space left on device"):
        call(checkpoint=tmp_path / "run.ckpt", **given)
    assert [f.name for f in tmp_path.iterdir()] == ["file"]


@pytest.mark.slow
def test_the_room_that_is_tried_is_what_is_needed(tmp_path, monkeypatch):
    sizes, allocate = [], os.posix_fallocate
    monkeypatch.setattr(os, "posix_fallocate", lambda *a: (sizes.append(a[-1]), allocate(*a)))
    for file, call in ((tmp_path / "one", solved), (tmp_path / "many", batch)):
        call(checkpoint=file)
        size = file.stat().st_size
        assert size < sizes[-1] < 2 * (2 * size + 1e6)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_disk_that_fills_up_ends_no_solve(name, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(os, name, full)
    with pytest.warns(DraxWarning, match="goes on without checkpoints: cannot write") as warned:
        found = solved(checkpoint=tmp_path / "run.ckpt")
    assert len([w for w in warned if w.category is DraxWarning]) == 1
    assert_same(found, whole)
    assert not list(tmp_path.iterdir())


# The real thing

PROGRAM = """
import sys, time
import numpy as np
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/.."]
from mjx_drax.search import checkpoint
from test_checkpoint import batch, solved
checkpoint.EVERY, checkpoint.SHARE = 0.0, np.inf
def slowly(*_):
    time.sleep(0.05)
one = solved(checkpoint=sys.argv[2] + "/one.ckpt", progress=slowly)
many = batch(checkpoint=sys.argv[2] + "/many.ckpt", progress=slowly)
np.savez(sys.argv[2] + "/answer.npz", one.trajectories.u, one.cost, many.u, many.chain_cost)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 8])
def test_killed_by_the_system_at_random_moments(kills, whole, whole_batch, tmp_path):
    here, answer = os.path.dirname(__file__), tmp_path / "answer.npz"
    command = [sys.executable, "-c", PROGRAM, here, str(tmp_path)]
    random = np.random.default_rng()

    def written():
        return [f.stat().st_mtime_ns for f in sorted(tmp_path.glob("[!.]*.ckpt"))]

    for _ in range(kills):
        before, process = written(), subprocess.Popen(command)
        while written() == before and process.poll() is None:
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 0.3))
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, check=True)
    with np.load(answer) as found:
        expected = (whole.trajectories.u, whole.cost, whole_batch.u, whole_batch.chain_cost)
        for a, b in zip(found.values(), expected, strict=True):
            np.testing.assert_array_equal(a, b)


def test_each_call_has_its_own_seconds(tmp_path):
    once = {"chains": CHAINS, "solver": SOLVER, "checkpoint": tmp_path / "file"}
    first = solve(PROBLEM, max_seconds=1e-9, **once)
    assert first.interrupted
    with np.load(once["checkpoint"]) as content:
        arrays = dict(content)
    arrays["solve_time"] = np.array(1e3)  # as if that call had taken long
    np.savez(once["checkpoint"].open("wb"), **arrays)
    second = solve(PROBLEM, max_seconds=500.0, **once)
    assert not second.interrupted
    assert second.solve_time > 1e3
