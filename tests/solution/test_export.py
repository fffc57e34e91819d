"""Files for other programs hold what was replayed; exporters of the user's own are like others."""

import csv
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from builders import fastest, made_up, point

from mjx_drax import (
    DraxError,
    Exporter,
    Solution,
    export_keyframes,
    from_mjcf,
    save_csv,
    save_dataset,
    solve,
)
from mjx_drax.base.files import complete, require
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.solution.export import NothingToExport, exporter, exporters
from mjx_drax.solution.formats import control_names, mjcf_of, state_names
from mjx_drax.tasks import load

SPACE = """
<mujoco><worldbody>
  <body><freejoint name="root"/><geom size="0.1"/>
    <body><joint name="neck" type="ball"/><geom size="0.1"/>
      <body><joint type="hinge"/><geom size="0.1"/></body>
    </body>
  </body>
</worldbody>
<actuator>
  <motor name="push" joint="root" gear="1 0 0 0 0 0"/>
  <general joint="root" gear="0 1 0 0 0 0" dyntype="integrator"/>
</actuator></mujoco>
"""


def test_names_say_joint_and_actuator(slider):
    dynamics = from_mjcf(SPACE, horizon=0.1, running_residual=lambda data, u: u).dynamics
    model = mujoco_model(dynamics)
    names = state_names(dynamics)
    assert names[:8] == [
        *(f"qpos_root_{p}" for p in ("x", "y", "z", "qw", "qx", "qy", "qz")),
        "qpos_neck_qw",
    ]
    assert names[11:14] == ["qpos_2", "qvel_root_vx", "qvel_root_vy"]
    assert names[-5:] == ["qvel_neck_wx", "qvel_neck_wy", "qvel_neck_wz", "qvel_2", "act_1"]
    assert len(names) == model.nq + model.nv + model.na
    assert control_names(dynamics) == ["ctrl_push", "ctrl_1"]
    trap = load("bug_trap").make().dynamics
    assert state_names(trap) == ["x [m]", "y [m]", "heading [rad]"]
    assert control_names(trap) == ["speed [m/s]", "turn rate [rad/s]"]
    plain = point().dynamics
    assert (state_names(plain), control_names(plain)) == (["x0", "x1"], ["u0", "u1"])


def test_names_are_saved(tmp_path):
    problem = point(x_names=("a", "b"), u_names=("force [N]", "turn"))
    loaded = Solution.load(made_up(problem).save(tmp_path)).problem.dynamics
    assert (state_names(loaded), control_names(loaded)) == (["a", "b"], ["force [N]", "turn"])


def test_a_table_has_a_row_for_every_knot(slider, tmp_path):
    with save_csv(slider, tmp_path / "new" / "replay.csv").open() as file:
        heading, *rows = csv.reader(file)
    assert heading == ["time", "qpos_slide", "qvel_slide", "ctrl_push"]
    states, controls = slider.replayed
    np.testing.assert_array_equal(np.array([row[1:3] for row in rows], float), states)
    np.testing.assert_array_equal(np.array([row[3:] for row in rows[:-1]], float), controls)
    np.testing.assert_allclose([float(row[0]) for row in rows], slider.problem.times)
    assert rows[-1][3] == ""


def test_keyframes_hold_the_replay_and_the_model_finds_its_meshes(slider, tmp_path):
    path = export_keyframes(slider, tmp_path / "elsewhere" / "keys.xml")
    (tmp_path / "elsewhere").rename(tmp_path / "moved")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "moved" / path.name))
    states, controls = slider.replayed
    assert model.nkey == 1 + len(states)
    assert [model.key(i).name for i in (0, 1, 26)] == ["home", "replay_0", "replay_25"]
    np.testing.assert_allclose(model.key_qpos[1:], states[:, :1], rtol=1e-15)
    np.testing.assert_allclose(model.key_qvel[1:], states[:, 1:], rtol=1e-15)
    np.testing.assert_allclose(model.key_ctrl[1:-1], controls, rtol=1e-15)
    np.testing.assert_allclose(model.key_time[1:], slider.problem.times)
    before = mujoco_model(slider.problem.dynamics)
    np.testing.assert_allclose(model.mesh_vert, before.mesh_vert)
    np.testing.assert_allclose(model.body_mass, before.body_mass, rtol=1e-5)


def test_keyframes_of_a_model_that_has_a_replay_have_names_of_their_own(slider, tmp_path):
    path = export_keyframes(slider, tmp_path / "keys.xml")
    dynamics = replace(slider.problem.dynamics, **_model_of(path))
    again = replace(slider, problem=replace(slider.problem, dynamics=dynamics))
    model = mujoco.MjModel.from_xml_path(str(export_keyframes(again, tmp_path / "more.xml")))
    assert [model.key(i).name for i in (1, 27)] == ["replay_0", "replay2_0"]


def _model_of(path):
    return {"mj_model": mujoco.MjModel.from_xml_path(str(path)), "origin": path}


def test_models_without_mjcf_have_no_keyframes(slider, tmp_path):
    with pytest.raises(DraxError, match="bug_trap has no MuJoCo model to write keyframes of"):
        mjcf_of(load("bug_trap").make())
    unknown = replace(slider.problem.dynamics, origin=None)
    with pytest.raises(DraxError, match=r"was given as a mujoco\.MjModel"):
        mjcf_of(replace(slider.problem, dynamics=unknown))
    (tmp_path / "r.xml").write_text(SPACE)
    problem = from_mjcf(tmp_path / "r.xml", horizon=0.1, running_residual=lambda data, u: u)
    mjcf_of(problem)
    (tmp_path / "r.xml").write_text(SPACE.replace("0.1", "0.2"))
    with pytest.raises(DraxError, match=r"r.xml cannot be read again: it has changed since"):
        mjcf_of(problem)
    (tmp_path / "r.xml").unlink()
    with pytest.raises(DraxError, match=r"r.xml cannot be read again"):
        mjcf_of(problem)


def test_a_dataset_holds_certified_trajectories_only(slider, tmp_path):
    h5py = pytest.importorskip("h5py")
    died = replace(slider, max_defect=np.where(np.arange(4) == 1, 1.0, slider.max_defect))
    path = save_dataset([slider, died], tmp_path / "data.h5")
    with h5py.File(path) as file:
        first, second = (file[name] for name in ("000_slider", "001_slider"))
        assert file.attrs["format"] == 1
        assert first.attrs["problem"] == "slider"
        assert list(first.attrs["state_names"]) == ["qpos_slide", "qvel_slide"]
        assert first["states"].shape == (4, 26, 2)
        assert first["gains"].shape == (4, 25, 1, 2)
        assert sorted(second["chain"]) == [0, 2, 3]
        best = int(np.flatnonzero(first["chain"][:] == slider.best_chain)[0])
        assert first["mode"].asstr()[best] == slider.replay_mode
        np.testing.assert_array_equal(first["states"][best], slider.replayed[0])
        np.testing.assert_array_equal(first["controls"][best], slider.replayed[1])
        np.testing.assert_array_equal(first["plan_controls"][best], slider.best.u)
        assert first["max_deviation"][best] == slider.certificate.open_loop["max_deviation"]
        assert (np.diff(first["replay_cost"]) >= 0).all()
        assert not first["optimal"][:].any()
    hopeless = replace(slider, max_defect=np.ones(4))
    with pytest.raises(NothingToExport, match="no chain is certified, so the dataset would be"):
        save_dataset(hopeless, tmp_path / "none.h5")
    assert not (tmp_path / "none.h5").exists()
    with h5py.File(save_dataset(hopeless, tmp_path / "all.h5", everything=True)) as file:
        assert not file["000_slider"]["feasible"][:].any()


class Markdown(Exporter):
    name, file = "markdown", "replay.md"
    summary = "times and states of the replay as a table in Markdown"

    def write(self, solution, path):
        rows = zip(solution.problem.times, solution.replayed[0], strict=True)
        with complete(path, (".md",)) as partial:
            partial.write_text("".join(f"| {time:g} | {x} |\n" for time, x in rows))


def test_an_exporter_of_the_users_own_is_like_the_others(slider, tmp_path):
    mine = exporters()["markdown"]
    assert (mine.file, type(mine)) == ("replay.md", Markdown)
    assert type(exporter("markdown")) is type(exporter(f"{__name__}:Markdown")) is Markdown
    mine.check(slider.problem)
    mine.write(slider, tmp_path / "new" / mine.file)
    rows = (tmp_path / "new" / "replay.md").read_text().splitlines()
    assert len(rows) == 26
    assert rows[0].startswith("| 0 | [0.05 ")


def test_an_exporter_from_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_exporters.py").write_text(
        "from mjx_drax import Exporter\n"
        "class Own(Exporter):\n"
        "    file = 'own.txt'\n"
        "    def write(self, solution, path): path.touch()\n"
        "class Base(Exporter): pass\n"
        "class Choosy(Own):\n"
        "    def __init__(self, kind): self.kind = kind\n"
        "LIST = []\n"
    )
    (tmp_path / "my_broken.py").write_text("1 / 0\n")
    assert exporter("my_exporters:Own").file == "own.txt"
    for text, words in {
        "own": "there is no exporter 'own': give one of .*markdown",
        "my_exporters:": "there is no exporter",
        "my_absent:Own": "ModuleNotFoundError: No module named 'my_absent'",
        "my_broken:Own": "ZeroDivisionError",
        "my_exporters:Absent": "has no attribute 'Absent'",
        "my_exporters:LIST": r"is \[\]: give a subclass of mjx_drax.Exporter",
        "my_exporters:Base": "has no file",
        "my_exporters:Choosy": "Choosy cannot be made: TypeError",
    }.items():
        with pytest.raises(DraxError, match=words):
            exporter(text)


def test_extras_that_are_missing_are_named(slider, tmp_path, without):
    without("h5py")
    with pytest.raises(DraxError, match=r'a dataset needs h5py.*pip install "mjx-drax\[dataset\]"'):
        save_dataset(slider, tmp_path / "data.h5")
    require("numpy", "x", "nothing")


def test_paths_that_are_refused(slider, tmp_path):
    with pytest.raises(DraxError, match=r"'replay.txt' does not end in .csv: rename it"):
        save_csv(slider, tmp_path / "replay.txt")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(DraxError, match="it is a folder"):
        save_csv(slider, tmp_path / "folder.csv")
    (tmp_path / "file").touch()
    with pytest.raises(DraxError, match=r"cannot write .*Choose another place"):
        save_csv(slider, tmp_path / "file" / "replay.csv")


def test_a_file_appears_once_it_is_complete(tmp_path):
    target = tmp_path / "file.txt"
    target.write_text("old")

    def fail():
        with complete(target) as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["file.txt"]
    assert target.read_text() == "old"
    with complete(target) as partial:
        partial.write_text("new")
    assert target.read_text() == "new"


@pytest.mark.slow
def test_a_dataset_of_free_durations_has_times_for_each_trajectory(tmp_path):
    h5py = pytest.importorskip("h5py")
    found = solve(fastest(knots=5), chains=3)
    with h5py.File(save_dataset(found, tmp_path / "free.h5", everything=True)) as file:
        (group,) = file.values()
        assert group["times"].shape == (3, 6)
        for times, chain in zip(group["times"][:], group["chain"][:], strict=True):
            np.testing.assert_array_equal(times, found.times_of(int(chain)))
