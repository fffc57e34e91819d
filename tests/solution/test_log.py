"""How chains got there, as a table, and how their polish ended."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from builders import INF, NAN, point

from mjx_drax import Restarts, Solution, from_program, minimize, solve
from mjx_drax.solution.files import save as results
from mjx_drax.solution.log import residuals, table

HISTORY = {
    "iteration": np.array([0, 20, 40]),
    "cost": np.array([[9.0, 8.0, 7.0], [3.0, 2.0, 1.0], [4.0, 0.5, NAN]]),
    "max_defect": np.array([[1.0, 0.5, 2.0], [1e-5, 1e-4, 0.1], [1e-6, 1e-6, NAN]]),
    "residual": np.array([[INF] * 3, [1e-5, 1e-2, INF], [1e-6, 1e-5, NAN]]),
    "began": np.array([0, 20]),
    "noise_ends": np.array([0, 20]),
}


def test_a_line_says_what_the_best_and_the_median_chain_are_at():
    lines = table(HISTORY, 1e-4).splitlines()
    assert lines[1].split()[:2] == ["attempt", "iteration"]
    assert [line.split() for line in lines[2:]] == [
        ["1", "0", "8", "5e-01", "-", "8", "1e+00", "-", "0", "0"],
        ["1", "20", "2", "1e-04", "1.0e-02", "2", "1e-04", "5.0e-03", "2", "1"],
        ["2", "40", "0.5", "1e-06", "1.0e-05", "2.25", "1e-06", "5.5e-06", "2", "2"],
    ]
    assert len({len(line) for line in lines[1:]}) == 1  # columns stand below each other


def test_a_history_without_residuals_has_dashes():
    older = {name: values for name, values in HISTORY.items() if name != "residual"}
    assert np.isnan(residuals(older)).all()
    assert [line.split()[-1] for line in table(older, 1e-4).splitlines()[2:]] == ["0"] * 3


@pytest.mark.slow
def test_programs_have_a_log_too():
    program = from_program(2, cost=lambda x: (x[0] - 1) ** 2 + (x[1] - x[0] ** 2) ** 2)
    found = minimize(program, chains=4)
    last = found.log().splitlines()[-1].split()
    assert int(last[-1]) == found.optimal_chains.sum() == 4
    assert float(last[4]) == pytest.approx(found.residual[found.best_chain], rel=0.1)
    np.testing.assert_array_equal(found.history["residual"][-1], found.residual)


@pytest.mark.slow
def test_chains_that_stall_are_told_from_chains_that_run_out_of_iterations(tmp_path):
    once = Restarts(descent=20, attempts=1)
    kink = from_program(2, cost=lambda z: jnp.abs(z[0] - 0.3) + z[1] ** 2)
    found = minimize(kink, chains=2, solver=once, precision=64)
    assert found.polished == ["stalled"] * 2
    assert found.status == ["feasible"] * 2
    short = solve(point(), chains=2, solver=once, max_iterations=1)
    assert short.polished == ["unfinished"] * 2
    assert not short.stalled.any()
    lines = str(short).splitlines()
    assert "polish: 2 unfinished" in lines[0]
    assert any("the polish is unfinished" in line for line in lines)
    stalled = replace(short, stalled=np.array([True, False]))
    loaded = Solution.load(stalled.save(tmp_path))
    assert loaded.polished == ["stalled", "unfinished"]
    assert results.summary(loaded)["polished"] == {"stalled": 1, "unfinished": 1}
