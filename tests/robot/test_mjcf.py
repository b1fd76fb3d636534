"""Robots of MJCF files have the dynamics that MuJoCo computes from the same file."""

import re

import mujoco
import numpy as np
import pytest

import jaxid as jid
from jaxid.errors import InputError
from jaxid.robot.urdf import joint_parameters
from jaxid.workflow.robot_file import RobotFile

ARM = """
<mujoco model="cell">
  <compiler angle="degree" autolimits="true"/>
  <option gravity="0.5 0 -9.7"/>
  <default>
    <joint damping="0.2" armature="0.01"/>
    <default class="heavy"><geom density="3000"/></default>
  </default>
  <worldbody>
    <body name="object" pos="2 0 0"><freejoint name="free"/><geom size="0.1"/></body>
    <body name="table" pos="0 0 0.4" euler="10 20 30">
      <geom type="box" size="0.5 0.5 0.02"/>
      <body name="shoulder" pos="0 0 0.1" quat="1 1 0 0">
        <joint name="pan" pos="0.1 0 0" axis="0 1 1" ref="20" range="-100 160"
          frictionloss="0.3"/>
        <joint name="lift" pos="0 0.2 0.1" axis="1 0 0"/>
        <geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0.2" euler="0 30 0"/>
        <body name="plate" pos="0 0.2 0" euler="0 90 0">
          <geom type="capsule" size="0.05" fromto="0 0 0 0.3 0.1 0" class="heavy"/>
          <body name="ram" pos="0 0 0.3" euler="0 0 45">
            <joint name="slide" type="slide" axis="1 0 1" ref="0.1" range="-0.3 0.4"/>
            <inertial pos="0.1 0.2 0.3" mass="2"
              fullinertia="0.2 0.3 0.4 0.01 0.02 0.03"/>
            <site name="flange" pos="0 0 0.2" euler="0 45 0"/>
            <body name="left">
              <joint name="left" type="slide" axis="0 1 0" range="0.01 0.05"/>
              <geom size="0.02"/></body>
            <body name="right" pos="0 0 0.1"><joint name="right" axis="0 0 1"/>
              <geom size="0.03" pos="0.1 0 0"/></body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0.1 2 30 0 0"/></equality>
  <actuator>
    <motor joint="pan" ctrlrange="-3 2" gear="50"/>
    <position joint="slide" kp="10" forcerange="-70 70"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def write(tmp_path):
    def write_file(text):
        (tmp_path / "arm.xml").write_text(text)
        return tmp_path / "arm.xml"

    return write_file


def mujoco_forces(path, names, motion, held=None):
    """Forces of MuJoCo at named joints without friction, rotors and constraints."""
    model = mujoco.MjModel.from_xml_path(str(path))
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= (
        off.mjDSBL_CONSTRAINT | off.mjDSBL_DAMPER | off.mjDSBL_SPRING
    )
    model.dof_armature[:] = 0.0
    data, forces = mujoco.MjData(model), []
    for name, value in (held or {}).items():
        data.joint(name).qpos = value
    for q, qd, qdd in zip(motion.q, motion.qd, motion.qdd, strict=True):
        for name, *values in zip(names, q, qd, qdd, strict=True):
            data.joint(name).qpos, data.joint(name).qvel, data.joint(name).qacc = values
        mujoco.mj_inverse(model, data)
        forces.append([data.joint(name).qfrc_inverse[0] for name in names])
    return np.array(forces)


def random_motion(joints):
    rng = np.random.default_rng(0)
    return jid.Motion(*(rng.uniform(-s, s, (20, joints)) for s in (1.0, 2.0, 5.0)))


def assert_same_forces(path, robot, motion, held=None, **chain):
    model = jid.Model(robot, (jid.RigidBodies(),))
    ours = model.inverse_dynamics(jid.robots.urdf_parameters(path, **chain), motion)
    expected = mujoco_forces(path, robot.joint_names, motion, held)
    np.testing.assert_allclose(
        ours, expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


def test_forces_limits_and_gravity_are_those_of_mujoco(write):
    path = write(ARM)
    robot = jid.load_mjcf(path)
    assert robot.joint_names == ("pan", "lift", "slide", "left")
    assert robot.gravity.tolist() == [0.5, 0.0, -9.7]
    # The left finger is held at 0.01 m: 0.1 + 2 x 0.01 + 30 x 0.01^2.
    assert_same_forces(path, robot, random_motion(4), {"right": 0.123})
    limits = robot.limits
    np.testing.assert_allclose(
        limits.position_min, [*np.deg2rad([-100]), -np.inf, -0.3, 0.01]
    )
    np.testing.assert_allclose(
        limits.position_max, [*np.deg2rad([160]), np.inf, 0.4, 0.05]
    )
    assert limits.force.tolist() == [150.0, np.inf, 70.0, np.inf]
    held, loose = robot.notes[:2]
    assert "`right`: held at 0.123 (mimic of joint `left`)" in held
    assert "`object`" in loose
    values = joint_parameters(path)
    assert values["armature"].tolist() == [0.01] * 4
    assert values["damping"].tolist() == [0.2] * 4
    assert values["friction"].tolist() == [0.3, 0.0, 0.0, 0.0]


def test_a_link_that_follows_another_joint_has_its_forces(write):
    path = write(
        ARM.replace('joint1="right" joint2="left"', 'joint1="slide" joint2="pan"')
        .replace("0.1 2 30 0 0", "0.1 0.2 0 0 0")
        .replace(
            '<joint name="slide"', '<joint name="slide" springref="0.3" stiffness="9"'
        )
    )
    robot = jid.load_mjcf(path)
    assert robot.body_names == ("pan", "lift", "left", "right", "slide")
    motion = random_motion(4)
    # The relation is one of differences from both `ref`.
    ratios = np.vstack([np.eye(4), [[0.2, 0.0, 0.0, 0.0]]])
    offset = 0.1 + 0.1 - 0.2 * np.deg2rad(20)
    q, qd, qdd = (x @ ratios.T for x in (motion.q, motion.qd, motion.qdd))
    tree_motion = jid.Motion(q + offset * np.eye(5)[4], qd, qdd)
    expected = mujoco_forces(path, robot.body_names, tree_motion) @ ratios
    model = jid.Model(robot, (jid.RigidBodies(),))
    ours = model.inverse_dynamics(jid.robots.urdf_parameters(path), motion)
    np.testing.assert_allclose(ours, expected, atol=1e-12 * np.abs(expected).max())

    values = joint_parameters(path)
    np.testing.assert_allclose(values["damping"], [0.2 * 1.04, 0.2, 0.2, 0.2])
    np.testing.assert_allclose(values["armature"], [0.01 * 1.04, 0.01, 0.01, 0.01])
    np.testing.assert_allclose(values["stiffness"], [9 * 0.04, 0, 0, 0])
    # At rest the slide is at its own position of rest.
    np.testing.assert_allclose(0.2 * values["springref"][0] + offset, 0.3)
    np.testing.assert_allclose(robot.limits.position_max[0], (0.4 - offset) / 0.2)


def test_a_site_is_a_tip_and_leaves_the_fingers_out(write):
    path = write(ARM)
    robot = jid.load_mjcf(path, tip="flange")
    assert robot.joint_names == ("pan", "lift", "slide")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    q = np.array([0.3, -0.4, 0.2])
    for name, value in zip(robot.joint_names, q, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    from jaxid.robot.forward_kinematics import tip_placement

    R, r = tip_placement(robot, q)
    np.testing.assert_allclose(r, data.site("flange").xpos, atol=1e-14)
    np.testing.assert_allclose(R.ravel(), data.site("flange").xmat, atol=1e-14)


def test_switched_off_gravity_is_none(write):
    text = ARM.replace('gravity="0.5 0 -9.7"/>', '><flag gravity="disable"/></option>')
    assert not jid.load_mjcf(write(text)).gravity.any()


def test_a_free_robot_is_held_at_its_base(write):
    free = ARM.replace(
        '<body name="table" pos="0 0 0.4" euler="10 20 30">', "<body name='table'>"
    )
    free = free.replace(
        "<body name='table'>", "<body name='table'><freejoint name='root'/>"
    )
    path = write(free)
    with pytest.raises(InputError, match=r"joint `root` is floating.*`--base table`"):
        jid.load_mjcf(path)
    robot = jid.load_mjcf(path, base="table")
    held = {"right": 0.123}
    assert_same_forces(path, robot, random_motion(4), held, base="table")


REFUSED = {
    "a ball joint": (
        ARM.replace('name="lift"', 'name="lift" type="ball"'),
        "joint `lift` is ball.*remove it, which fixes its body",
    ),
    "a loop": (
        ARM.replace(
            "<equality>",
            '<equality><connect body1="ram" body2="table" anchor="0 0 0"/>',
        ),
        "have 0 freedom.s., but 2 motor.s., at `pan`, `slide`",
    ),
    "a mesh that is missing": (
        ARM.replace("<default>", '<asset><mesh file="no.stl"/></asset><default>', 1),
        "MuJoCo cannot compile this file: .*no.stl",
    ),
    "a mass that is no number": (
        ARM.replace('mass="2"', 'mass="nan"'),
        '`mass` must hold finite numbers, but is "nan"',
    ),
    "a density that is no number": (
        ARM.replace('density="3000"', 'density="NaN"'),
        "`density` must hold finite",
    ),
    "a huge field": (
        ARM.replace(
            "<default>",
            '<asset><hfield name="f" nrow="9999" ncol="9999" size="1 1 1 1"/></asset>'
            "<default>",
            1,
        ),
        "`<hfield>` makes 99980001 parts",
    ),
    "copies of copies": (
        ARM.replace(
            "<worldbody>",
            '<worldbody><replicate count="99"><replicate count="99"/></replicate>',
        ),
        "`<replicate>` makes 9801 parts",
    ),
    "a joint that moves a link by a square": (
        ARM.replace('joint1="right" joint2="left"', 'joint1="lift" joint2="pan"'),
        "joint `lift` carries .* follows joint `pan`, by a polynomial",
    ),
    "no model": ("<mujoco><bodies/></mujoco>", "MuJoCo cannot compile"),
}


@pytest.mark.parametrize(("text", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_no_open_tree_is_one_sentence(write, text, sentence):
    path = write(text)
    with pytest.raises(InputError, match=sentence) as caught:
        jid.load_mjcf(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_loop_outside_the_chain_does_no_harm(write):
    path = write(REFUSED["a loop"][0].replace('body1="ram"', 'body1="left"'))
    assert jid.load_mjcf(path, tip="flange").joints == 3


EFFECTS = """
<mujoco><option density="{density}"><flag {flag}/></option>
  <worldbody>
    <body name="upper"><joint name="lift" axis="0 1 0" {lift}/>
      <geom size="0.1" pos="0.2 0 0"/>
      <body name="lower" pos="0.4 0 0" {lower}><joint name="bend" axis="0 1 0" {bend}/>
        <geom size="0.1" pos="0.2 0 0"/>
        <body name="finger" pos="0.2 0 0"><joint name="grip" axis="0 0 1"
          {grip} stiffness="2" damping="1 2"/><geom size="0.01" pos="0.01 0 0"/></body>
      </body>
    </body>
  </worldbody>
  {rest}
</mujoco>
"""
TENDON = """<tendon><fixed name="cable" {}><joint joint="lift" coef="1"/>
  <joint joint="bend" coef="-1"/></fixed></tendon>"""
OMITTED = {
    "damping": ({"bend": 'damping="1 0.5 0.1"'}, "joint `bend`: .*damping"),
    "stiffness": ({"lift": 'stiffness="1 0 3"'}, "joint `lift`: .*stiffness"),
    "gravity": ({"lower": 'gravcomp="1"'}, "link `lower`: .*`gravcomp`"),
    "medium": ({"density": "1.2"}, "option `density`: .*medium"),
    "tendon": (
        {"rest": TENDON.format('stiffness="5" damping="1"')},
        "tendon `cable`: .* damping",
    ),
    "rotor": ({"rest": TENDON.format('armature="5"')}, "tendon `cable`: .*inertia"),
    "coupling": (
        {
            "rest": TENDON.format("")
            + '<equality><tendon name="stay" tendon1="cable"/></equality>'
        },
        "constraint `stay`: .*tendons",
    ),
}
OMITTED["actuator of a tendon"] = (
    {
        "rest": TENDON.format("")
        + '<actuator><motor name="winch" tendon="cable" damping="1"/></actuator>'
    },
    "actuator `winch`: .*several joints",
)
OMITTED["actuator's polynomial"] = (
    {"rest": '<actuator><motor joint="bend" damping="1 2" gear="3"/></actuator>'},
    "joint `bend`: .*depends on the speed",
)
SPRINGS = {
    "lift": 'stiffness="1 2"',
    "bend": 'stiffness="5" springref="20"',
    "rest": TENDON.format('stiffness="5"'),
}
DAMPERS = {
    "lift": 'damping="1 2"',
    "bend": 'damping="5"',
    "rest": TENDON.format('damping="5"')
    + '<actuator><motor tendon="cable" damping="1 2"/></actuator>',
}
NO_PASSIVE_FORCES = 'spring="disable" damper="disable"'
NO_EFFECTS = {
    "nothing": {},
    "no springs": SPRINGS | {"flag": 'spring="disable"'},
    "no dampers": DAMPERS | {"flag": 'damper="disable"'},
    "no passive forces": {
        "lower": 'gravcomp="1"',
        "density": "1.2",
        "flag": NO_PASSIVE_FORCES,
    },
    "no friction": {
        "rest": TENDON.format('frictionloss="5"'),
        "flag": 'frictionloss="disable"',
    },
    "no constraints": {
        "rest": TENDON.format('frictionloss="5"')
        + '<equality><tendon name="stay" tendon1="cable"/></equality>',
        "flag": 'constraint="disable"',
    },
    "no gravity": {"lower": 'gravcomp="1"', "flag": 'gravity="disable"'},
    "motors do it": {
        "lower": 'gravcomp="1"',
        "grip": 'actuatorgravcomp="true"',
        "lift": 'actuatorgravcomp="true"',
        "bend": 'actuatorgravcomp="true"',
    },
}


def effects(**changes):
    defaults = {
        "density": 0,
        "flag": "",
        "lift": "",
        "bend": "",
        "grip": "",
        "lower": "",
        "rest": "",
    }
    return EFFECTS.format(**(defaults | changes))


@pytest.mark.parametrize(("changes", "sentence"), OMITTED.values(), ids=OMITTED)
def test_a_note_names_each_effect_that_no_term_describes(write, changes, sentence):
    *_, note = jid.load_mjcf(write(effects(**changes)), tip="lower").notes
    assert re.match(sentence, note)
    assert "the default model does not include it" in note


@pytest.mark.parametrize("changes", NO_EFFECTS.values(), ids=NO_EFFECTS)
def test_what_does_not_act_is_not_noted(write, changes):
    # The joint of the finger, which the chain leaves out, has a spring of its own.
    assert not jid.load_mjcf(write(effects(**changes)), tip="lower").notes


MOTORS = """<actuator><motor joint="lift" gear="-3" armature="0.02" damping="0.3"/>
  <position joint="bend" kp="10" damping="0.5"/></actuator>"""


@pytest.mark.parametrize(
    "flag", ["", *(f'{x}="disable"' for x in ("spring", "damper"))]
)
def test_springs_dampers_and_rotors_are_those_of_mujoco(write, flag):
    text = effects(
        lift='stiffness="30" springref="40" ref="10" damping="2" armature="0.1"',
        bend='stiffness="7" damping="1"',
        rest=MOTORS,
        flag=flag,
    )
    path = write(text)
    robot = jid.load_mjcf(path, tip="lower")
    if "spring" in flag:
        assert not robot.notes
    else:
        assert "joints `lift`, `bend`: the file states a spring" in robot.notes[0]

    terms = (
        jid.RigidBodies(),
        jid.terms.ViscousFriction(),
        jid.terms.RotorInertia(),
        jid.terms.LinearSpring(),
        jid.terms.ConstantOffset(),
    )
    model = jid.Model(robot, terms)
    claims = RobotFile(path, tip="lower").claims()
    p = np.array([claims.get(name, 0.0) for name in model.parameter_names])
    motion = random_motion(2)
    # The finger is no part of the chain.
    compiled = mujoco.MjModel.from_xml_path(str(path))
    compiled.body_mass[-1] = 0.0
    compiled.body_inertia[-1] = 0.0
    compiled.dof_armature[-1] = 1.0
    data = mujoco.MjData(compiled)
    data.qpos[2] = compiled.qpos_spring[2]
    expected = []
    for sample in zip(motion.q, motion.qd, motion.qdd, strict=True):
        data.qpos[:2], data.qvel[:2], data.qacc[:2] = sample
        mujoco.mj_inverse(compiled, data)
        expected.append(data.qfrc_inverse[:2].copy())
    ours = model.inverse_dynamics(p, motion)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-10)


def test_a_constraint_that_is_switched_off_holds_no_joint(write):
    text = ARM.replace('-9.7"/>', '-9.7"><flag equality="disable"/></option>')
    robot = jid.load_mjcf(write(text))
    assert robot.joint_names == ("pan", "lift", "slide", "left", "right")


def test_friction_that_is_switched_off_is_not_claimed(write):
    text = ARM.replace('-9.7"/>', '-9.7"><flag frictionloss="disable"/></option>')
    assert not joint_parameters(write(text))["friction"].any()
