"""Models that others wrote: each is solved with default settings, or refused with a reason."""

import json

import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError
from mjx_drax.modelling.postures import TOLERANCE, reach
from mjx_drax.models import path
from mjx_drax.studies.third_party import FOLDERS, TREES, fine, line, main, measure_apart, models

SMALL = [
    "dm_control/ball_in_cup",
    "dm_control/cartpole",
    "dm_control/finger",
    "dm_control/hopper",
    "dm_control/lqr",
    "dm_control/pendulum",
    "dm_control/point_mass",
    "dm_control/reacher",
    "dm_control/swimmer",
    "gymnasium/hopper",
    "gymnasium/inverted_double_pendulum",
    "gymnasium/inverted_pendulum",
    "gymnasium/reacher",
    "gymnasium/swimmer",
]
"""Solved or refused within minutes on two cores; `third_party` without names runs all."""


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", SMALL)
def test_is_solved_or_refused(name):
    if name not in models():
        pytest.skip(f"{name.split('/')[0]} is not installed: pip install 'mjx-drax[third-party]'")
    row = measure_apart(name, models()[name], chains=8, timeout=1000)
    assert fine(row), row


def test_the_posture_can_be_reached_and_is_not_the_start():
    problem = reach(path("acrobot"), seed=1, horizon=0.3)
    host = problem.dynamics.mj_model
    assert problem.horizon == 15
    assert np.isfinite(problem.bounds.u_lower).all()
    assert problem.reached(np.asarray(problem.x_init, float)) is False
    target = np.asarray(problem.terminal.residual.args[0].numbers[0], float)
    x = np.concatenate([target, np.zeros(host.nv)])
    assert problem.reached(x) is True
    x[0] += 1.1 * TOLERANCE
    assert problem.reached(x) is False


def test_other_seeds_draw_other_postures():
    starts = [reach(path("acrobot"), seed=s).terminal for s in (0, 0, 1)]
    values = [float(c(mujoco_data())) for c in starts]
    assert values[0] == values[1] != values[2]


def mujoco_data():
    model = mujoco.MjModel.from_xml_path(str(path("acrobot")))
    return mujoco.MjData(model)


def test_a_model_that_only_leaves_its_ranges_is_refused():
    xml = """<mujoco model="falling"><worldbody><body><joint name="drop" type="slide" axis="0 0 1"
    range="-0.001 0.001" limited="true"/><geom size="0.1"/></body></worldbody>
    <actuator><motor joint="drop" ctrlrange="0 1" ctrllimited="true"/></actuator></mujoco>"""
    with pytest.raises(DraxError, match="falling leaves the ranges of its joints within 5 knots"):
        reach(xml)


def test_rows_of_the_table():
    solved = {
        "model": "a/b", "nq": 1, "nv": 1, "nu": 1, "rows": 0, "knots": 15, "certified": True,
        "success_rate": 0.5, "max_defect": 1e-6, "deviation": 1e-5, "compile_time_s": 9.0,
        "solve_time_s": 0.25,
    }  # fmt: skip
    assert line(solved) == "| a/b | 1/1/1 | 0 | 15 |  | 9.0 | 0.25 | 50% | 1e-06 | 1e-05 |"
    assert fine(solved)
    refused = {"model": "a/c", "refused": "no |actuators|\n at all"}
    assert line(refused).startswith("| a/c | -/-/- | - | - | no \\|actuators\\| at all | - |")
    assert fine(refused)
    assert not fine({"model": "a/d", "failed": "not done after 1 s"})


def test_models_are_chosen_by_name(tmp_path, monkeypatch, capsys):
    rock = tmp_path / "rock.xml"
    monkeypatch.setattr("mjx_drax.studies.third_party.models", lambda folder: {"own/rock": rock})
    assert main(["own/stone"]) == 2
    assert "there is no model own/stone: there is own/rock" in capsys.readouterr().err
    rock.write_text("<mujoco model='rock'><worldbody/></mujoco>")
    assert main(["own/rock", "--here", str(rock)]) == 0
    row = json.loads(capsys.readouterr().out)
    assert "has no joints" in row["refused"]
    monkeypatch.setattr("mjx_drax.studies.third_party.measure_apart", lambda *_: row)
    assert main(["own/rock", "--out", str(tmp_path)]) == 0
    assert "| no joints | 1 | own/rock |" in capsys.readouterr().out
    assert json.loads((tmp_path / "third_party.json").read_text()) == [row]


def test_complete_models_of_a_folder_are_found(tmp_path):
    (tmp_path / "arm").mkdir()
    body = "<body><joint/><geom size='1'/></body>"
    (tmp_path / "arm" / "arm.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (tmp_path / "part.xml").write_text("<mujocoinclude/>")
    (tmp_path / "still.xml").write_text("<mujoco><worldbody/></mujoco>")
    found = models(tmp_path)
    assert found == {f"{tmp_path.name}/arm/arm": tmp_path / "arm" / "arm.xml"}


def test_only_files_of_the_packages_are_read():
    assert all(name.split("/")[0] in {**FOLDERS, **TREES} for name in models())
