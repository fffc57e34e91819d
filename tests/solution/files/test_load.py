"""Solutions come back from their files with all that they were, or are refused with a reason."""

import json
import shutil
from dataclasses import fields, replace
from hashlib import sha256

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import point as to_a_point

from mjx_drax import (
    DraxError,
    Geometric,
    Identity,
    Langevin,
    Rollouts,
    Solution,
    from_function,
    render,
    solve,
)
from mjx_drax.base.errors import DraxWarning
from mjx_drax.solution.files import save as results
from mjx_drax.view.plotting import plot_solution


@pytest.fixture(scope="module")
def point():
    """A solution of a problem with a function, an inequality and no goal."""
    problem = from_function(
        lambda x, u: x + 0.1 * u,
        x_init=[0.0],
        nu=1,
        dt=0.1,
        horizon=0.5,
        running_residual=lambda x, u: u,
        terminal_residual=lambda x: 10.0 * (x - 1.0),
        inequality=lambda x, u: u - 3.0,
        u_bounds=(-5.0, 5.0),
        name="point",
    )
    return solve(problem, chains=3, solver=Langevin(iterations=10, tail=20))


@pytest.fixture
def folder(slider, tmp_path):
    return slider.save(tmp_path / "result")


def everything(solution):
    """Every array and number of a solution, but the problem."""
    parts = {f.name: getattr(solution, f.name) for f in fields(solution) if f.name != "problem"}
    parts |= {mode: dict(vars(parts[mode])) for mode in ("plan", "open_loop", "feedback")}
    for mode in ("open_loop", "feedback"):
        parts[mode]["violations"] = vars(parts[mode]["violations"])
    parts |= {"tolerances": vars(parts["tolerances"])}
    return parts


@pytest.mark.parametrize("name", ["slider", "point"])
def test_all_comes_back(name, request, tmp_path):
    solution = request.getfixturevalue(name)
    solution.save(tmp_path)
    again = Solution.load(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, everything(again), everything(solution))
    kinds = [jax.tree.map(lambda a: np.asarray(a).dtype, s.trajectories) for s in (again, solution)]
    assert kinds[0] == kinds[1]
    for said in ("certificate", "certified", "best_chain", "status", "replay_mode", "verdict"):
        assert getattr(again, said) == getattr(solution, said)
    for mode in ("open loop", "with feedback"):
        assert again.outcome(mode) == solution.outcome(mode)
    assert len(again.optima) == len(solution.optima)
    np.testing.assert_array_equal(again.problem.times, solution.problem.times)
    np.testing.assert_array_equal(again.problem.x_init, solution.problem.x_init)
    for part in ("constraint", "terminal_constraint"):
        rows = [getattr(s.problem, part) for s in (again, solution)]
        assert rows[0].inequalities == rows[1].inequalities
        assert rows[0].equalities == rows[1].equalities
    plot_solution(again, tmp_path / "plot.png")
    assert again.save(tmp_path / "again").is_dir()
    np.testing.assert_array_equal(
        Solution.load(tmp_path / "again").feedback.states, solution.feedback.states
    )


def test_the_box_that_fits_the_motion_comes_back_with_the_problem(point, tmp_path):
    given, box = point.problem, point.problem.scatter
    narrow = replace(box, x_lower=0.01 * box.x_lower, x_upper=0.01 * box.x_upper)
    replace(point, problem=replace(given, scatter=narrow)).save(tmp_path)
    again = Solution.load(tmp_path, given)
    jax.tree.map(np.testing.assert_array_equal, again.problem.scatter, narrow)
    again.certify()


def test_a_model_comes_back_and_can_be_filmed(slider, folder, tmp_path):
    shutil.copytree(folder, tmp_path / "elsewhere")
    again = Solution.load(tmp_path / "elsewhere")
    model, before = (s.problem.dynamics.mj_model for s in (again, slider))
    np.testing.assert_array_equal(model.mesh_vert, before.mesh_vert)
    assert again.problem.dynamics.source() == slider.problem.dynamics.source()
    assert again.problem.dynamics.contacts == slider.problem.dynamics.contacts
    assert render(again, tmp_path / "film.mp4", fps=2, size=(64, 64)).stat().st_size > 500


def test_functions_are_missing_until_the_problem_is_given(slider, folder):
    again = Solution.load(folder)
    for needs in (again.certify, lambda: solve(again.problem, chains=1)):
        with pytest.raises(DraxError, match="is code, which is not saved: load the solution with"):
            needs()
    certified = Solution.load(folder, slider.problem).certify()
    assert certified.certificate == slider.certificate


def test_another_problem_judges_plans_and_their_optimality_anew(tmp_path):
    """Another cost, a cost with the same value at the plan, and the same problem."""

    def reaching(target, weight):
        return to_a_point(
            terminal_residual=lambda x: 10.0 * (x - target),
            running_cost=lambda x, u: 1e-2 * u @ u + weight * (u[0] - u[1]),
        )

    solved = solve(reaching(jnp.array([1.0, 1.0]), 0.0), chains=2)
    assert solved.optimal
    solved.save(tmp_path)
    for problem, as_before, optimal in (
        (reaching(jnp.array([1.0, 1.0]), 0.0), True, True),
        (reaching(jnp.array([3.0, 3.0]), 0.0), False, False),
        (reaching(jnp.array([1.0, 1.0]), 1.0), True, False),
    ):
        again = Solution.load(tmp_path, problem).certify()
        assert again.optimal == optimal
        assert np.allclose(again.cost, solved.cost, rtol=1e-3, atol=1e-5) == as_before
        assert np.allclose(again.cost, again.replay_cost, rtol=1e-3, atol=1e-5)
        assert (again.residual >= solved.residual).all()


def test_another_problem_is_refused(slider, folder):
    problem = slider.problem
    for other, words in (
        (replace(problem, horizon=24), "has K = 24, the saved solution of slider has 25"),
        (problem.with_x_init([0.1, 0.0]), r"x_init of the problem slider is \[0.1"),
    ):
        with pytest.raises(DraxError, match=words):
            Solution.load(folder, other)


def rewritten(folder, **changes):
    path = folder / "result.json"
    said = json.loads(path.read_text())
    said.pop("json_sha256", None)  # it would tell that the file was changed
    path.write_text(json.dumps({**said, **changes}))


def test_files_that_are_refused(folder, tmp_path):
    with pytest.raises(DraxError, match=r"cannot read .*nowhere.*result.json"):
        Solution.load(tmp_path / "nowhere")
    rewritten(folder, format=7)
    with pytest.raises(
        DraxError, match=r"has format 7 .* this version reads format 3: solve again"
    ):
        Solution.load(folder)
    rewritten(folder, format=None)
    with pytest.raises(DraxError, match="has no format number"):
        Solution.load(folder)
    rewritten(folder, format=3, settings={"part": "Nonsense"})
    with pytest.raises(DraxError, match="Another version of mjx_drax wrote them"):
        Solution.load(folder)
    rewritten(folder, settings=None, certificate={})
    with pytest.raises(DraxError, match="is damaged"):
        Solution.load(folder)
    (folder / "result.json").write_text("{")
    with pytest.raises(DraxError, match="is damaged, it is no JSON object"):
        Solution.load(folder)
    (folder / "result.json").write_text("[1]")
    with pytest.raises(DraxError, match="is damaged, it is no JSON object"):
        Solution.load(folder)


@pytest.mark.parametrize(
    "name", ["../../../x.sh", "/x.sh", "a/b.stl", "..", "", "..\\x.sh", "C:x.sh"]
)
def test_files_of_a_model_that_lead_elsewhere_are_refused(folder, name):
    arrays = dict(np.load(folder / "result.npz"))
    arrays[f"model.files/{name}"] = np.frombuffer(b"#!", np.uint8)
    np.savez(folder / "result.npz", **arrays)
    rewritten(folder, npz_sha256=sha256((folder / "result.npz").read_bytes()).hexdigest())
    with pytest.raises(DraxError, match="may lie in another folder: use results from where"):
        Solution.load(folder)


@pytest.mark.parametrize("keep", [0, 100, -1])
def test_truncated_arrays_are_refused(folder, keep):
    content = (folder / "result.npz").read_bytes()
    (folder / "result.npz").write_bytes(content[:keep])
    with pytest.raises(DraxError, match=r"result.npz' does not belong to result.json"):
        Solution.load(folder)
    (folder / "result.npz").unlink()
    with pytest.raises(DraxError, match=r"cannot read .*result.npz"):
        Solution.load(folder)


def test_an_interrupted_save_leaves_what_was_there(slider, folder, monkeypatch):
    def fail(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(results.np, "savez_compressed", fail)
    with pytest.raises(KeyboardInterrupt):
        slider.save(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["result.json", "result.npz"]
    assert Solution.load(folder).certified


def test_another_version_of_mujoco_compiles_the_mjcf_again(slider, folder, monkeypatch):
    versions = json.loads((folder / "result.json").read_text())["versions"]
    rewritten(folder, versions={**versions, "mujoco": "3.0.0"})
    with pytest.warns(DraxWarning, match=r"saved by MuJoCo 3.0.0"):
        again = Solution.load(folder)
    np.testing.assert_allclose(
        again.problem.dynamics.mj_model.body_mass,
        slider.problem.dynamics.mj_model.body_mass,
        rtol=1e-5,
    )
    dynamics = slider.problem.dynamics
    unknown = replace(dynamics, origin=None)
    replace(slider, problem=replace(slider.problem, dynamics=unknown)).save(folder)
    assert Solution.load(folder).certified
    rewritten(folder, versions={**versions, "mujoco": "3.0.0"})
    with pytest.raises(DraxError, match=r"MuJoCo 3.0.0 without MJCF.* pip install mujoco==3.0.0"):
        Solution.load(folder)


def test_other_settings_come_back(slider, tmp_path):
    flow = Langevin(noise=Geometric(np.float32(3.0), 1e-3), preconditioner=Identity())
    solver = replace(slider.solver, flow=flow, rollouts=Rollouts(rounds=7))
    replace(slider, solver=solver).save(tmp_path)
    assert Solution.load(tmp_path).solver == solver
    assert mujoco.__version__ in Solution.load(tmp_path).certificate.engine
