"""Damaged files load as they were, or a DraxError says why not; nothing else is raised."""

import json

import numpy as np
import pytest
from builders import made_up, outcome, point, robot
from hypothesis import given
from hypothesis import strategies as st
from strategies import bounded

from mjx_drax import DraxError, Solution


@pytest.fixture(scope="module", params=["robot", "point"])
def saved(request, tmp_path_factory):
    """A folder with a saved solution, and what its files hold."""
    folder = tmp_path_factory.mktemp("saved")
    made_up(robot() if request.param == "robot" else point()).save(folder)
    return folder, {n: (folder / n).read_bytes() for n in ("result.json", "result.npz")}


def content(solution):
    """All that a solution holds, in a form that can be compared."""
    arrays = {
        "x": solution.trajectories.x,
        "u": solution.trajectories.u,
        "gains": solution.gains,
        "multipliers": solution.multipliers.dynamics,
        "cost": solution.cost,
        "died_at": solution.died_at,
        "states": solution.feedback.states,
        "success": solution.open_loop.success,
        "x_init": solution.problem.x_init,
        "upper": solution.problem.bounds.u_upper,
        **solution.history,
    }
    said = (
        solution.seed,
        solution.solver,
        solution.iterations,
        solution.engine,
        solution.problem.name,
        solution.problem.horizon,
        solution.problem.dynamics.dt,
        solution.solve_time,
    )
    return said, {name: (a.dtype, a.shape, np.asarray(a).tobytes()) for name, a in arrays.items()}


@pytest.mark.slow
@bounded
@given(data=st.data())
def test_damaged_files_load_as_they_were_or_not_at_all(saved, data):
    folder, whole = saved
    for name, original in whole.items():
        (folder / name).write_bytes(original)
    expected = content(Solution.load(folder))
    name = data.draw(st.sampled_from(sorted(whole)))
    damaged = bytearray(whole[name])
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.none() | st.integers(0, len(damaged)))
    (folder / name).write_bytes(bytes(damaged[:cut]))
    found = outcome(lambda: Solution.load(folder))
    assert isinstance(found, DraxError) or content(found) == expected


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=5), inner, max_size=2)
    ),
    max_leaves=3,
)


@bounded
@given(data=st.data())
def test_any_value_in_the_summary_is_refused_or_harmless(saved, data):
    folder, whole = saved
    said = json.loads(whole["result.json"])
    del said["json_sha256"]
    name = data.draw(st.sampled_from(sorted(said)))
    (folder / "result.npz").write_bytes(whole["result.npz"])
    (folder / "result.json").write_text(json.dumps({**said, name: data.draw(json_values)}))
    found = outcome(lambda: Solution.load(folder))
    if isinstance(found, Solution):
        assert found.problem.times.shape == (found.problem.horizon + 1,)
