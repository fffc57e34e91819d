"""Actuators for models that have none."""

import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError
from mjx_drax.physics.source import Source, load, origin_of

XML = """
<mujoco model="leg">
  <compiler angle="radian"/>
  <default><general gear="9" ctrlrange="-9 9"/></default>
  <worldbody>
    <body><freejoint/><geom size="0.1"/>
      <body><joint name="hip" axis="0 1 0" range="-1 1" limited="true" {hip}/>
        <geom size="0.1" pos="0 0 -0.3"/>
        <body pos="0 0 -0.6"><joint name="knee" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.3"/>
          <body><joint type="slide"/><geom size="0.02"/></body>
        </body></body></body>
  </worldbody>
  <keyframe><key qpos="0 0 1 1 0 0 0 0.5 -1 0"/></keyframe>
  {more}
</mujoco>"""
LEG = XML.format(hip='actuatorfrcrange="-30 20"', more="")


def limits(model):
    ranges = zip(model.actuator_ctrllimited, model.actuator_ctrlrange.tolist(), strict=True)
    return [range_ if limited else None for limited, range_ in ranges]


def test_motors_have_the_limits_of_the_joints():
    model = load(LEG, "torque")
    assert [model.actuator(a).name for a in range(model.nu)] == ["hip", "knee", "joint_3"]
    assert limits(model) == [[-30, 20], None, None]
    assert limits(load(LEG, {"torque": 5})) == [[-30, 20], [-5, 5], [-5, 5]]
    some = load(LEG, {"torque": {"knee": 5.0, "h*": 7.0}})
    assert limits(some) == [[-30, 20], [-5, 5]]
    data = mujoco.MjData(some)
    data.ctrl[:] = 1.0, 2.0
    mujoco.mj_forward(some, data)
    np.testing.assert_allclose(data.qfrc_actuator[6:8], [1.0, 2.0])


def test_servos_are_critically_damped_and_move_within_the_range():
    model = load(LEG, {"position": 40})
    assert limits(model) == [[-1, 1], None, None]
    servo = '<actuator><position joint="hip" kp="40" dampratio="1" gear="1" ctrlrange="-1 1"/>'
    written = load(XML.format(hip='actuatorfrcrange="-30 20"', more=f"{servo}</actuator>"))
    for name in ("gainprm", "biasprm", "ctrlrange", "gear", "biastype"):
        own, wanted = (getattr(m, f"actuator_{name}")[0] for m in (model, written))
        np.testing.assert_array_equal(own, wanted, name)
    assert model.actuator_biasprm[0, 2] < 0


@pytest.mark.parametrize(
    ("actuators", "words"),
    [
        ("position", "actuators is 'position': give \"torque\""),
        ({"torque": -1}, "positive numbers"),
        ({"velocity": 1}, 'give "torque"'),
        ({"torque": {"knie": 3}}, "fits 'knie': its joints are 'hip', 'knee'"),
    ],
)
def test_other_forms_are_refused(actuators, words):
    with pytest.raises(DraxError, match=words):
        load(LEG, actuators)


def test_a_model_with_actuators_keeps_them():
    more = '<actuator><motor joint="hip"/></actuator>'
    with pytest.raises(DraxError, match="leg has 1 of its own: leave it out"):
        load(XML.format(hip="", more=more), "torque")
    with pytest.raises(DraxError, match="compiled: give its MJCF file or XML"):
        load(load(LEG), "torque")


def test_a_model_is_written_with_its_motors(tmp_path):
    path = tmp_path / "leg.xml"
    path.write_text(LEG)
    model = load(path, "torque")
    again = origin_of(path, model, "torque").compiled()
    assert (model.nu, again.nu) == (3, 3)
    np.testing.assert_array_equal(again.actuator_ctrlrange, model.actuator_ctrlrange)


PART = """<mujoco><compiler meshdir="meshes"/><asset><mesh name="m" file="m.obj"/></asset>
  <worldbody><body name="x"><joint axis="0 1 0"/><geom type="mesh" mesh="m"/></body></worldbody>
</mujoco>"""
ATTACHED = """<mujoco model="two"><asset><model name="part" file="part/part.xml"/>{more}</asset>
  <worldbody><frame><attach model="part" body="x" prefix="p_"/></frame>
  <body name="y"><joint axis="0 1 0"/><geom size=".1"/></body></worldbody></mujoco>"""
CORNERS = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 {}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_a_model_that_attaches_another_is_written_with_the_meshes_of_both(tmp_path, monkeypatch):
    (tmp_path / "part" / "meshes").mkdir(parents=True)
    (tmp_path / "part" / "part.xml").write_text(PART)
    (tmp_path / "part" / "meshes" / "m.obj").write_text(CORNERS.format(0.1))
    (tmp_path / "own.obj").write_text(CORNERS.format(0.2))
    (tmp_path / "two.xml").write_text(ATTACHED.format(more='<mesh name="own" file="own.obj"/>'))
    monkeypatch.chdir(tmp_path)
    model = load("two.xml", "torque")
    source = Source.of(tmp_path / "two.xml", model, "torque")  # by its absolute path
    assert sorted(source.assets) == ["m.obj", "own.obj"]
    again = source.compiled()
    assert (model.nu, again.nu) == (2, 2)
    np.testing.assert_array_equal(again.mesh_vert, model.mesh_vert)


def test_files_that_an_included_file_names_are_where_mujoco_finds_them(tmp_path):
    (tmp_path / "sub").mkdir()
    part = '<mujocoinclude><asset><mesh name="m" file="m.obj"/></asset></mujocoinclude>'
    (tmp_path / "sub" / "part.xml").write_text(part)
    (tmp_path / "sub" / "m.obj").write_text(CORNERS.format(0.1))
    (tmp_path / "m.obj").write_text(CORNERS.format(0.2))
    body = '<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody>'
    (tmp_path / "whole.xml").write_text(f'<mujoco><include file="sub/part.xml"/>{body}</mujoco>')
    model = load(tmp_path / "whole.xml", "torque")
    again = Source.of(tmp_path / "whole.xml", model, "torque").compiled()
    np.testing.assert_array_equal(again.mesh_vert, model.mesh_vert)


def test_files_of_one_name_in_two_models_are_not_confused(tmp_path):
    (tmp_path / "part" / "meshes").mkdir(parents=True)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "part" / "part.xml").write_text(PART)
    (tmp_path / "part" / "meshes" / "m.obj").write_text(CORNERS.format(0.1))
    (tmp_path / "meshes" / "m.obj").write_text(CORNERS.format(0.2))
    (tmp_path / "two.xml").write_text(ATTACHED.format(more=""))
    model = load(tmp_path / "two.xml", "torque")
    with pytest.raises(DraxError, match=r"files 'm\.obj' of several of its models differ"):
        Source.of(tmp_path / "two.xml", model, "torque")


def test_defaults_of_the_file_are_for_other_actuators():
    given = 'gear="50" group="3" armature="4" damping="3" delay=".01" nsample="2"'
    defaults = f"<default><motor {given}/></default>"
    model = load(LEG.replace("<worldbody>", f"{defaults}<worldbody>", 1), "torque")
    for name in ("group", "armature", "damping", "delay"):
        assert not np.any(getattr(model, f"actuator_{name}")), name
    assert np.all(model.actuator_gear[:, 0] == 1)


def test_a_joint_that_follows_another_gets_a_motor_only_by_its_name():
    follows = '<equality><joint joint1="knee" joint2="hip"/></equality></mujoco>'
    leg = LEG.replace("</mujoco>", follows)
    every = [load(LEG, "torque").actuator(i).name for i in range(3)]
    some = load(leg, "torque")
    assert [some.actuator(i).name for i in range(some.nu)] == [n for n in every if n != "knee"]
    assert load(leg, {"torque": {"knee": 1.0}}).nu == 1


def test_a_urdf_gives_its_efforts():
    link = '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
    link += 'ixy="0" ixz="0" iyz="0"/></inertial></link>'
    joint = '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
    joint += '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="1"/></joint>'
    urdf = f'<robot name="r">{link.format("a")}{link.format("b")}{joint}</robot>'
    assert limits(load(urdf, "torque")) == [[-5, 5]]


URDF = """<robot name="arm"><link name="base"/><link name="tip">
  <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><geometry><mesh filename="package://arm/meshes/only_seen.dae"/></geometry></visual>
  <collision><geometry><mesh filename="package://arm/meshes/{mesh}.obj"/></geometry></collision>
  </link><joint name="turn" type="revolute"><parent link="base"/><child link="tip"/>
  <limit lower="-2" upper="2" effort="10" velocity="5"/></joint></robot>"""


def test_meshes_are_found_in_the_package_of_a_urdf(tmp_path):
    for folder in ("urdf", "meshes"):
        (tmp_path / "arm" / folder).mkdir(parents=True)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "arm" / "meshes" / "tip.obj").write_text(corners)
    file = tmp_path / "arm" / "urdf" / "arm.urdf"
    file.write_text(URDF.format(mesh="tip"))
    for actuators, nu in ((None, 0), ("torque", 1)):
        model = load(file, actuators)
        assert (model.nmesh, model.nu) == (1, nu)
        # which can be saved, and read elsewhere
        again = Source.of(file, model, actuators).compiled()
        np.testing.assert_array_equal(again.mesh_vert, model.mesh_vert)
    file.write_text(URDF.format(mesh="lost"))
    with pytest.raises(DraxError, match=r"lost\.obj', which is not in a folder above it: put the"):
        load(file)
