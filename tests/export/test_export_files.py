"""Files for simulators give the same torques, as far as they can hold the model."""

import dataclasses
import importlib.util
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trees
from export_samples import fit_of, motion, possible
from lxml import etree

import jaxid as jid
from jaxid.export.bodies_and_joint_dynamics import joint_dynamics

URDF = """<?xml version="1.0"?>
<!-- kept -->
<robot name="small" xmlns:xacro="http://example.org">
  <link name="world"/>
  <link name="cart">
    <visual><geometry><mesh filename="package://a/cart.dae"/></geometry></visual></link>
  <link name="plate"><inertial><mass value="9"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="upper"/>
  <link name="lower"><inertial><origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><mass value="2"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="rail" type="prismatic"><parent link="world"/><child link="cart"/>
    <origin xyz="0 0 0.5" rpy="0.3 0.2 0.1"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="100" velocity="2"/></joint>
  <joint name="mount" type="fixed"><parent link="cart"/><child link="plate"/>
    <origin xyz="0 0.1 0"/></joint>
  <joint name="shoulder" type="continuous"><parent link="plate"/><child link="upper"/>
    <origin xyz="0.1 0 0.2" rpy="0.4 0 0"/><axis xyz="0 1 0"/>
    <dynamics damping="7" friction="8"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0.3 0" rpy="0 0.7 0.2"/><axis xyz="0.6 0 0.8"/>
    <safety_controller k_velocity="3"/>
    <limit lower="-2" upper="2" effort="30" velocity="2"/></joint>
  <transmission name="t"><type>simple</type></transmission>
</robot>
"""


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "small.urdf"
    path.write_text(URDF, "utf-8")
    return path


@pytest.fixture
def fit(source):
    robot = jid.load_urdf(source)
    limits = jid.Limits(3, force=[120.0, np.inf, 25.0])
    terms = (*jid.Model(robot).terms, jid.ConstantOffset())
    model = jid.Model(robot.replace(limits=limits), terms)
    return fit_of(model, possible(model), full=True)


def held(fit, m, *, drives):
    """Torques of the parts that a simulator holds."""
    model, p = fit.base.model, fit.standard_parameters.copy()
    p[10 * model.robot.joints :] = 0.0
    forces = np.asarray(model.inverse_dynamics(p, m))
    if drives:
        joints = joint_dynamics(fit).values
        forces = forces + joints["armature"] * m.qdd + joints["damping"] * m.qd
    return forces


def close(values, expected, tolerance):
    np.testing.assert_allclose(
        values, expected, rtol=0, atol=tolerance * np.abs(expected).max()
    )


def pinocchio_torques(pin, model, m):
    data, order = model.createData(), []
    for v in zip(m.q, m.qd, m.qdd, strict=True):
        q = pin.neutral(model)
        for j, joint in enumerate(model.joints):
            if joint.nq == 2:
                q[joint.idx_q : joint.idx_q + 2] = (
                    np.cos(v[0][j - 1]),
                    np.sin(v[0][j - 1]),
                )
            elif joint.nq == 1:
                q[joint.idx_q] = v[0][j - 1]
        order.append(pin.rnea(model, data, q, v[1], v[2]).copy())
    return np.array(order)


def test_the_urdf_gives_the_same_torques_in_pinocchio(fit, source, tmp_path):
    pin = pytest.importorskip("pinocchio")
    path = jid.export_urdf(fit, source, tmp_path / "new" / "arm.urdf")
    model = pin.buildModelFromUrdf(str(path))
    assert list(model.names)[1:] == ["rail", "shoulder", "elbow"]
    m, joints = motion(3, 40), joint_dynamics(fit).values
    close(pinocchio_torques(pin, model, m), held(fit, m, drives=False), 1e-12)
    np.testing.assert_array_equal(model.damping, joints["damping"])
    np.testing.assert_array_equal(model.friction, joints["friction"])
    np.testing.assert_array_equal(model.effortLimit[[0, 2]], [120.0, 25.0])


def test_everything_else_in_the_urdf_is_untouched(fit, source, tmp_path):
    path = jid.export_urdf(fit, source, tmp_path / "arm.urdf")

    def rest(file):
        root = etree.parse(str(file), etree.XMLParser(remove_blank_text=True)).getroot()
        for element in root.xpath(
            "//inertial | //dynamics | //comment()[contains(., 'friction')]"
        ):
            element.getparent().remove(element)
        for limit in root.iter("limit"):
            limit.attrib.pop("effort")
        return etree.tostring(root, method="c14n")

    assert rest(path) == rest(source)
    text = path.read_text("utf-8")
    assert "<!-- kept -->" in text
    assert f"{fit.checksum}. Not in this file: Ia1, Ia2, Ia3, fo1, fo2, fo3." in text
    assert (
        path.read_bytes()
        == jid.export_urdf(fit, path, tmp_path / "b.urdf").read_bytes()
    )


FINGERS = """
  <link name="left"><inertial><mass value="0.3"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="right"><inertial><mass value="0.4"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="tip"><inertial><mass value="0.1"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="right" type="revolute"><parent link="lower"/><child link="right"/>
    <axis xyz="0 1 1"/><mimic joint="left" multiplier="2" offset="0.5"/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/></joint>
  <joint name="left" type="prismatic"><parent link="lower"/><child link="left"/>
    <limit lower="0.1" upper="0.2" effort="5" velocity="1"/></joint>
  <joint name="pad" type="fixed"><parent link="left"/><child link="tip"/></joint>
</robot>"""


@pytest.mark.parametrize("tip", [None, "lower"], ids=["the tree", "a chain"])
def test_fingers_are_exported_once_to_pinocchio_and_mujoco(source, tmp_path, tip):
    pin, mujoco = pytest.importorskip("pinocchio"), pytest.importorskip("mujoco")
    source.write_text(URDF.replace("</robot>", FINGERS), "utf-8")
    robot = jid.load_urdf(source, tip=tip)
    assert robot.joint_names == ("rail", "shoulder", "elbow", "left")[: 3 if tip else 4]
    model = jid.Model(robot)
    fit = fit_of(model, possible(model), full=True)
    path = jid.export_urdf(fit, source, tmp_path / "arm.urdf", tip=tip)
    again = jid.load_urdf(path, tip=tip)
    assert not any("held" in note for note in again.notes)
    np.testing.assert_allclose(again.offset, robot.offset, atol=1e-15)
    bodies = fit.full_parameters[: 10 * robot.joints].reshape(-1, 10)
    m, total = motion(robot.joints, 20), bodies[:, 0].sum()
    there = pin.buildModelFromUrdf(str(path))
    assert list(there.names)[1:] == list(robot.joint_names)
    assert abs(pin.computeTotalMass(there) - total) < 1e-12 * total
    close(pinocchio_torques(pin, there, m), held(fit, m, drives=False), 1e-12)
    there = mujoco.MjModel.from_xml_path(str(path))
    assert [there.joint(i).name for i in range(there.njnt)] == list(robot.joint_names)
    assert abs(there.body_mass.sum() - total) < 1e-12 * total
    there.dof_damping[:] = 0.0
    close(mujoco_torques(mujoco, there, m), held(fit, m, drives=False), 1e-11)


def test_fingers_beside_the_tip_keep_their_type(source, tmp_path):
    """They weigh little; their links are no longer in the body that carries them."""
    pin, mujoco = pytest.importorskip("pinocchio"), pytest.importorskip("mujoco")
    moments = 'ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"'
    small_moments = moments.replace('"1"', '"1e-5"')
    fingers = FINGERS.replace(moments, small_moments)
    for mass in ("0.3", "0.4", "0.1"):
        fingers = fingers.replace(f'mass value="{mass}"', 'mass value="1e-3"')
    # Pinocchio wants names that no link has.
    for name in ("left", "right"):
        fingers = fingers.replace(f'joint name="{name}', f'joint name="turn_{name}')
    fingers = fingers.replace('mimic joint="left', 'mimic joint="turn_left')
    source.write_text(URDF.replace("</robot>", fingers), "utf-8")
    model = jid.Model(jid.load_urdf(source, tip="lower"))
    fit = fit_of(model, possible(model), full=True)
    path = jid.export_urdf(fit, source, tmp_path / "arm.urdf")
    root = etree.parse(str(path)).getroot()
    types = {joint.get("name"): joint.get("type") for joint in root.iterfind("joint")}
    assert (types["turn_right"], types["turn_left"]) == ("revolute", "prismatic")
    assert root.find("joint[@name='turn_right']/mimic") is not None
    total_mass = fit.full_parameters[:30:10].sum()
    there = mujoco.MjModel.from_xml_path(str(path))
    assert there.njnt == 5
    assert abs(there.body_mass.sum() - total_mass) < 1e-12 * total_mass
    there = pin.buildModelFromUrdf(str(path))
    assert abs(pin.computeTotalMass(there) - total_mass) < 1e-12 * total_mass
    pose = pin.neutral(there)
    ids = [there.getJointId(name) for name in ("turn_right", "turn_left")]
    # `left` is held at the lower end of its range, `right` mimics it.
    for joint_id, value in zip(ids, (2 * 0.1 + 0.5, 0.1), strict=True):
        pose[there.joints[joint_id].idx_q] = value
    arm = pin.buildReducedModel(there, ids, pose)
    m = motion(3, 20)
    close(pinocchio_torques(pin, arm, m), held(fit, m, drives=False), 1e-11)


CHAINS = [{"base": "plate"}, {"tip": "upper"}, {"base": "plate", "tip": "upper"}]


@pytest.mark.parametrize("chain", CHAINS)
def test_the_chain_of_the_file_is_remembered(source, tmp_path, chain):
    robot = jid.load_urdf(source, **chain)
    model = jid.Model(robot)
    fit = fit_of(model, possible(model), full=True)
    fit.save(tmp_path / "model.json")
    same_fit = jid.load_fit(tmp_path / "model.json")
    path = jid.export_urdf(same_fit, source, tmp_path / "arm.urdf")
    assert jid.load_urdf(path, **chain).joint_names == robot.joint_names
    given = jid.export_urdf(fit, source, tmp_path / "given.urdf", **chain)
    assert given.read_bytes() == path.read_bytes()


def test_arguments_of_a_xacro_file_are_remembered(tmp_path, monkeypatch):
    program = tmp_path / "xacro"
    program.write_text(
        f"#!{sys.executable} -S\nimport sys\ntext = open(sys.argv[1]).read()\n"
        'print(text.replace("${hand}", sys.argv[2].split(":=")[1]))'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    source = tmp_path / "small.urdf.xacro"
    namespace = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    text = URDF.replace('xmlns:xacro="http://example.org"', "").replace(
        '"lower"', '"${hand}"'
    )
    source.write_text(
        text.replace("<robot", f"<robot {namespace}").replace(
            "<transmission", '<xacro:arg name="hand"/><transmission'
        )
    )
    robot = jid.load_urdf(source, xacro_arguments={"hand": "gripper"})
    model = jid.Model(robot)
    fit_of(model, possible(model), full=True).save(tmp_path / "model.json")
    fit = jid.load_fit(tmp_path / "model.json")
    path = jid.export_urdf(fit, source, tmp_path / "arm.urdf")
    assert etree.parse(str(path)).find("link[@name='gripper']/inertial") is not None


def test_an_mjcf_file_is_exported_to_both_formats(source, tmp_path):
    pin, mujoco = pytest.importorskip("pinocchio"), pytest.importorskip("mujoco")
    model = jid.Model(jid.load_urdf(source))
    first = jid.export_mjcf(
        fit_of(model, possible(model), full=True), tmp_path / "first.xml"
    )
    robot = jid.load_mjcf(first)
    assert robot.joint_names == model.robot.joint_names
    np.testing.assert_allclose(robot.offset, model.robot.offset, atol=1e-14)
    np.testing.assert_allclose(robot.rotation, model.robot.rotation, atol=1e-14)
    expected = possible(model)[:30]
    np.testing.assert_allclose(
        jid.robots.urdf_parameters(first), expected, rtol=0, atol=1e-13
    )
    fit, m = fit_of(jid.Model(robot), possible(model, 1), full=True), motion(3, 20)
    there = pin.buildModelFromUrdf(
        str(jid.export_urdf(fit, first, tmp_path / "arm.urdf"))
    )
    close(pinocchio_torques(pin, there, m), held(fit, m, drives=False), 1e-12)
    there = mujoco.MjModel.from_xml_path(
        str(jid.export_mjcf(fit, tmp_path / "arm.xml"))
    )
    assert [there.joint(i).name for i in range(3)] == ["rail", "shoulder", "elbow"]
    close(mujoco_torques(mujoco, there, m), held(fit, m, drives=True), 1e-11)


def test_a_urdf_of_another_robot_is_refused(fit, source, tmp_path):
    source.write_text(URDF.replace('"elbow"', '"knee"'), "utf-8")
    with pytest.raises(ValueError, match="has the joints rail, shoulder, knee"):
        jid.export_urdf(fit, source, tmp_path / "arm.urdf")
    source.write_text(URDF.replace("0 0.3 0", "0 0.4 0"), "utf-8")
    with pytest.raises(ValueError, match="other places of joints"):
        jid.export_urdf(fit, source, tmp_path / "arm.urdf")
    sliding = URDF.replace(
        'name="elbow" type="revolute"', 'name="elbow" type="prismatic"'
    )
    assert sliding != URDF
    source.write_text(sliding, "utf-8")
    with pytest.raises(ValueError, match="other kinds of joints"):
        jid.export_urdf(fit, source, tmp_path / "arm.urdf")
    assert not (tmp_path / "arm.urdf").exists()


def mujoco_torques(mujoco, model, m):
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_FRICTIONLOSS | flags.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    torques = []
    for q, qd, qdd in zip(m.q, m.qd, m.qdd, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse.copy())
    return np.array(torques)


@pytest.mark.parametrize("name", ["small", "panda"])
def test_the_mjcf_gives_the_same_torques_in_mujoco(fit, tmp_path, name):
    mujoco = pytest.importorskip("mujoco")
    if name != "small":
        model = jid.Model(getattr(jid.robots, name)())
        fit = fit_of(model, possible(model), full=True)
    path = jid.export_mjcf(fit, tmp_path / "arm.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    m, joints = motion(model.nu, 40), joint_dynamics(fit).values
    close(mujoco_torques(mujoco, model, m), held(fit, m, drives=True), 1e-11)
    np.testing.assert_array_equal(model.dof_armature, joints["armature"])
    np.testing.assert_array_equal(model.dof_damping, joints["damping"])
    np.testing.assert_array_equal(model.dof_frictionloss, joints["friction"])
    assert fit.checksum in path.read_text("utf-8")


def test_pinocchio_gets_a_tree_whose_branches_are_mixed():
    pin = pytest.importorskip("pinocchio")
    rng = np.random.default_rng(1)
    # Joint 4 belongs to the branch of joint 2: Pinocchio wants it before joint 3.
    parents, turns = (-1, 0, 0, 1, 2), (True, True, True, True, False)
    tree = trees.Tree(parents, turns, *trees.geometry(rng, 5), rng.normal(size=3) * 9)
    ends = [0.5, 1.0, 1.5, 2.0, 2.5]
    limits = jid.Limits(5, position_min=np.negative(ends), position_max=ends)
    model = jid.Model(tree.robot(limits=limits))
    fit, m = fit_of(model, possible(model), full=True), motion(5, 20)
    theirs = jid.as_pinocchio(fit)
    assert list(theirs.names)[1:] == ["joint1", "joint2", "joint4", "joint3", "joint5"]
    places = [theirs.getJointId(name) - 1 for name in model.robot.joint_names]
    np.testing.assert_array_equal(
        theirs.upperPositionLimit[places], limits.position_max
    )
    damping = joint_dynamics(fit).values["damping"]
    np.testing.assert_array_equal(theirs.damping[places], damping)
    order = np.argsort(places)
    moved = jid.Motion(m.q[:, order], m.qd[:, order], m.qdd[:, order])
    expected = held(fit, m, drives=True) - damping * m.qd
    close(pinocchio_torques(pin, theirs, moved)[:, places], expected, 1e-12)
    # Its mass matrix by the composite bodies is wrong in another order.
    data = theirs.createData()
    upper = np.triu(pin.crba(theirs, data, moved.q[0]))[np.ix_(places, places)]
    ours = np.asarray(model.mass_matrix(fit.standard_parameters, m.q[0]))
    close(np.maximum(np.abs(upper), np.abs(upper).T), np.abs(ours), 1e-12)


def test_mujoco_gets_a_specification_that_can_be_extended(fit):
    mujoco = pytest.importorskip("mujoco")
    specification = jid.as_mujoco(fit)
    specification.worldbody.add_geom(size=[1, 1, 1])
    model = specification.compile()
    m = motion(model.nu, 20)
    close(mujoco_torques(mujoco, model, m), held(fit, m, drives=True), 1e-11)


def test_pinocchio_parameters_are_those_of_its_inertias_and_regressor(fit, source):
    pin = pytest.importorskip("pinocchio")
    rows, m = jid.export.pinocchio_parameters(fit), motion(3, 20)
    model = pin.buildModelFromUrdf(str(source))
    for i, row in enumerate(rows):
        model.inertias[i + 1] = pin.Inertia.FromDynamicParameters(row)
        np.testing.assert_allclose(
            model.inertias[i + 1].toDynamicParameters(), row, atol=1e-12
        )
    close(pinocchio_torques(pin, model, m), held(fit, m, drives=False), 1e-12)


def test_the_exported_function_takes_any_number_of_samples_and_needs_no_jaxid(
    fit, tmp_path
):
    exported, m = jid.export.exported_function(fit), motion(3, 30)
    close(exported.call(m.q, m.qd, m.qdd), fit.predict(m), 1e-13)
    if importlib.util.find_spec("flatbuffers") is None:
        with pytest.raises(RuntimeError, match="pip install flatbuffers"):
            jid.export.export_jax(fit, tmp_path / "arm.bin")
        return
    path, m = jid.export.export_jax(fit, tmp_path / "arm.bin"), motion(3, 1)
    read = jax.export.deserialize(bytearray(path.read_bytes()))
    close(read.call(m.q, m.qd, m.qdd), fit.predict(m), 1e-13)


class Drag(jid.terms.AbstractTerm):
    """A damping term of a user, with one friction that depends on the direction."""

    def parameters(self, robot):
        return (
            ("d1", "N m s"),
            ("c2+", "N m"),
            ("c2-", "N m"),
            ("x3", "N m s²"),
            ("s1", "N m"),
        )

    def columns(self, robot, q, qd, qdd):
        one = np.eye(3)
        falling = jnp.minimum(jnp.sign(qd[1]), 0.0)
        rising = jnp.maximum(jnp.sign(qd[1]), 0.0)
        parts = (qd[0] * one[0], rising * one[1], falling * one[1], qd[2] ** 3 * one[2])
        return jnp.stack([*parts, q[0] * one[0]], axis=1)


def test_joint_friction_is_that_of_parameters_with_a_role(fit):
    warm = jid.terms.TemperatureScaled(jid.ViscousFriction(), 0.02, temperature=40.0)
    terms = (jid.RigidBodies(), warm, jid.terms.AsymmetricCoulombFriction(), Drag())
    model = jid.Model(fit.base.model.robot, terms)
    bodies = possible(jid.Model(model.robot, terms[:1]))
    forces = [2.0, 4.0, 1.0, 3.0, 3.0, 3.0, 1.0, 2.0, 3.0, 9, 9, 9, 9, 9]
    p = np.concatenate([bodies, forces])
    joints, _, left_out, _ = joint_dynamics(fit_of(model, p, full=True))
    cooled = np.exp(-0.02 * 15.0) * np.array([2.0, 4.0, 1.0])
    np.testing.assert_allclose(joints["damping"], cooled, rtol=1e-12)
    np.testing.assert_allclose(joints["friction"], [2.0, 2.5, 3.0], rtol=1e-12)
    assert left_out == tuple(name for name, _ in Drag().parameters(model.robot))


def as_urdf(fit, path):
    jid.export_urdf(fit, path.parent / "small.urdf", path)


@pytest.mark.parametrize("write", [jid.export_mjcf, as_urdf])
@pytest.mark.parametrize("case", ["base", "body", "friction"])
@pytest.mark.usefixtures("source")
def test_what_could_not_exist_is_refused_with_the_way_out(fit, tmp_path, write, case):
    p = fit.standard_parameters.copy()
    if case == "body":
        p[14] = -1.0
    if case == "friction":
        p[30] = -0.1
    fit = dataclasses.replace(fit, full_parameters=None if case == "base" else p)
    said = {
        "base": "only base parameters",
        "body": "body 2 is not",
        "friction": "`damping`",
    }
    with pytest.raises(ValueError, match=f"{said[case]}.*`jid.PhysicallyConsistent"):
        write(fit, tmp_path / "out")
    assert not (tmp_path / "out").exists()
