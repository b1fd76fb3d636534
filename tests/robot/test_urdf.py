import re
import sys
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from forward_kinematics import (
    body_transforms,
    random_configuration,
    tip_transform,
)
from urdf_text import arm, inertial, joint, link, robot

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import RigidBodies
from jaxid.errors import InputError
from jaxid.robot.inertia import Inertia
from jaxid.robot.rotations import rpy_angles, rpy_rotation
from jaxid.robot.urdf import load_urdf, urdf_parameters
from jaxid.workflow.robot_file import RobotFile

SHARE = "cmeel.prefix/share/example-robot-data/robots"
FOLDER = Path(str(distribution("example-robot-data").locate_file(SHARE)))
TREES = {
    "six axes": "ur_description/urdf/ur10_robot.urdf",
    "six continuous axes": "kinova_description/robots/kinova.urdf",
    "an arm with a gripper": "z1_description/urdf/z1.urdf",
    "a mobile manipulator": "tiago_description/robots/tiago_no_hand.urdf",
    "a humanoid": "talos_data/robots/talos_reduced.urdf",
    "oblique axes": "icub_description/robots/icub.urdf",
    "a dog with an arm": "anymal_b_simple_description/robots/anymal-kinova.urdf",
    "wheels and arms": "centauro_description/urdf/centauro.urdf",
}
CHAINS = {
    "panda": ("panda_description/urdf/panda.urdf", None, "panda_hand"),
    "baxter": (
        "baxter_description/urdf/baxter.urdf",
        "torso",
        "left_gripper_base_link",
    ),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", None, "tool0"),
}


@pytest.fixture
def write(tmp_path):
    def write_file(text, name="arm.urdf"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write_file


class Oracle:
    """Pinocchio's model of the same file, asked by names."""

    def __init__(self, path):
        self.model = pin.buildModelFromUrdf(str(path))
        self.data = self.model.createData()

    def set(self, names, q):
        full = pin.neutral(self.model)
        for name, value in zip(names, q, strict=True):
            j = self.model.joints[self.model.getJointId(name)]
            circle = [np.cos(value), np.sin(value)]
            full[j.idx_q : j.idx_q + j.nq] = circle if j.nq == 2 else value
        pin.framesForwardKinematics(self.model, self.data, full)

    def joint(self, name):
        return self.data.oMi[self.model.getJointId(name)].homogeneous

    def frame(self, name):
        return self.data.oMf[self.model.getFrameId(name, pin.BODY)].homogeneous

    def parameters(self, name):
        p = self.model.inertias[self.model.getJointId(name)].toDynamicParameters()
        m, x, y, z, xx, xy, yy, xz, yz, zz = p
        return [m, x, y, z, xx, yy, zz, -yz, -xz, -xy]


@pytest.mark.parametrize("file", TREES.values(), ids=TREES.keys())
def test_real_trees_agree_with_pinocchio(file):
    path, oracle = FOLDER / file, Oracle(FOLDER / file)
    ours = load_urdf(path)
    assert sorted(ours.joint_names) == sorted(oracle.model.names[1:])
    q = random_configuration(ours, 0)
    oracle.set(ours.joint_names, q)
    expected = np.array([oracle.joint(name) for name in ours.joint_names])
    np.testing.assert_allclose(body_transforms(ours, q), expected, atol=1e-10)
    p = urdf_parameters(path, check=False).reshape(-1, 10)
    expected = [oracle.parameters(name) for name in ours.joint_names]
    np.testing.assert_allclose(p, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("file", "base", "tip"), CHAINS.values(), ids=CHAINS.keys())
def test_real_chains_agree_with_pinocchio(file, base, tip):
    oracle = Oracle(FOLDER / file)
    ours = load_urdf(FOLDER / file, base=base, tip=tip)
    assert ours.parent == tuple(range(-1, ours.joints - 1))
    q = random_configuration(ours, 1)
    oracle.set(ours.joint_names, q)
    ground = np.eye(4) if base is None else np.linalg.inv(oracle.frame(base))
    expected = ground @ np.array([oracle.joint(name) for name in ours.joint_names])
    np.testing.assert_allclose(body_transforms(ours, q), expected, atol=1e-10)
    np.testing.assert_allclose(
        tip_transform(ours, q), ground @ oracle.frame(tip), atol=1e-10
    )


def test_panda_of_the_library_is_the_panda_of_the_file():
    from jaxid.robot.library import panda

    urdf = load_urdf(FOLDER / CHAINS["panda"][0], tip="panda_link8")
    q = random_configuration(urdf, 2)
    np.testing.assert_allclose(
        tip_transform(panda(), q), tip_transform(urdf, q), atol=1e-12
    )


# Snapping.


def test_a_rounded_quarter_turn_costs_no_base_parameter(write):
    # Two vertical axes, but only as vertical and parallel as the angle is a quarter
    # turn.
    def arm_of(angle):
        return robot(
            *(link(name) for name in ("base", "wall", "a", "b")),
            joint("mount", "base", "wall", "fixed", rpy=f"{angle} 0 0"),
            joint("j1", "wall", "a", axis="0 1 0"),
            joint("j2", "a", "b", rpy=f"-{angle} 0 0", xyz="0.1 0 0.4"),
        )

    def base(loaded):
        return base_parameters(Model(loaded, (RigidBodies(),)))

    rounded = load_urdf(write(arm_of("1.5708"), "rounded.urdf"))
    exact = load_urdf(write(arm_of(np.pi / 2), "exact.urdf"))
    assert base(rounded).size == base(exact).size == base(rounded.snapped()).size == 4
    assert base(rounded).expressions == base(exact).expressions
    # Forces keep the geometry of the file.
    assert (
        1e-6
        < np.abs(np.asarray(rounded.rotation) - np.asarray(exact.rotation)).max()
        < 1e-5
    )
    np.testing.assert_array_equal(rounded.snapped().rotation, exact.rotation)
    assert rounded.notes == exact.notes


# What the options mean.


def _branches():
    return robot(
        *(link(name) for name in ("base", "tool", "flange", "a", "b", "c", "camera")),
        joint("jc", "base", "c", "prismatic", xyz="0 1 0"),
        joint("ja", "base", "a"),
        joint("jb", "a", "b", xyz="1 0 0"),
        joint("to_camera", "b", "camera", "fixed", xyz="0 0 5"),
        joint("to_flange", "b", "flange", "fixed", xyz="0.5 0 0"),
        joint("to_tool", "flange", "tool", "fixed", xyz="0 0 0.25"),
    )


def test_joints_come_depth_first_in_the_order_of_the_file(write):
    loaded = load_urdf(write(_branches()), gravity=(0.0, 0.0, -1.62))
    assert loaded.joint_names == ("jc", "ja", "jb")
    assert (loaded.parent, loaded.revolute) == ((-1, -1, 1), (False, True, True))
    assert loaded.gravity.tolist() == [0.0, 0.0, -1.62]
    # Without `tip` the end-effector ends the longest chain.
    assert loaded.tip_body == 2
    assert loaded.tip_offset.tolist() == [0.5, 0.0, 0.25]


def test_tip_and_base_cut_out_a_chain(write):
    path = write(_branches())
    assert load_urdf(path, tip="camera").joint_names == ("ja", "jb")
    assert load_urdf(path, tip="camera").tip_offset.tolist() == [0.0, 0.0, 5.0]
    assert load_urdf(path, tip="a").joint_names == ("ja",)
    below = load_urdf(path, base="a")
    assert below.joint_names == ("jb",)
    assert below.offset.tolist() == [[1.0, 0.0, 0.0]]


def test_parameters_of_a_chain_hold_what_is_fixed_to_it_and_no_more(write):
    heavy = inertial(2.0, (0, 0, 0), (0, 0, 0), (1, 0, 0, 1, 0, 1))
    text = robot(
        link("base", heavy),
        *(link(name, heavy) for name in ("a", "side", "finger")),
        joint("j1", "base", "a"),
        joint("to_side", "a", "side", "fixed", xyz="0 3 0"),
        joint("to_finger", "a", "finger", "prismatic"),
    )
    p = urdf_parameters(write(text), tip="a")
    assert p.tolist() == [
        4.0,
        0.0,
        6.0,
        0.0,
        2.0 + 18.0,
        2.0,
        2.0 + 18.0,
        0.0,
        0.0,
        0.0,
    ]


def test_a_body_without_mass_is_noted_and_counts_as_massless(write):
    path = write(arm())
    (note,) = load_urdf(path).notes
    assert "`j1`" in note
    assert urdf_parameters(path).tolist() == [0.0] * 10


@pytest.mark.parametrize(
    ("kind", "limit", "expected"),
    [
        ("revolute", "", (-np.inf, np.inf, np.inf, np.inf)),
        ("revolute", 'lower="-1" upper="2" velocity="3" effort="4"', (-1, 2, 3, 4)),
        ("prismatic", 'upper="0.5" velocity="3"', (0, 0.5, 3, np.inf)),
        ("revolute", 'lower="-1"', (-1, 0, np.inf, np.inf)),
        ("revolute", 'lower="-1e16" upper="1e16"', (-np.inf, np.inf, np.inf, np.inf)),
        ("revolute", 'lower="-1000" upper="1"', (-np.inf, 1, np.inf, np.inf)),
        (
            "revolute",
            'lower="-100.530965" upper="100.530965"',
            (-100.530965, 100.530965, np.inf, np.inf),
        ),
        ("revolute", 'lower="0.7" upper="0.7"', (-np.inf, np.inf, np.inf, np.inf)),
        ("prismatic", 'lower="-1" upper="-1"', (-np.inf, np.inf, np.inf, np.inf)),
        ("prismatic", 'lower="-1e9" upper="1e9"', (-np.inf, np.inf, np.inf, np.inf)),
        ("revolute", 'effort="9"', (-np.inf, np.inf, np.inf, 9)),
        ("continuous", 'lower="-1" upper="1" effort="9"', (-np.inf, np.inf, np.inf, 9)),
        (
            "revolute",
            'lower="0" upper="0" velocity="0" effort="-1"',
            (-np.inf, *(np.inf,) * 3),
        ),
    ],
)
def test_limits(write, kind, limit, expected):
    limits = load_urdf(
        write(arm(kind=kind, inner=f"<limit {limit}/>" if limit else ""))
    ).limits
    read = (limits.position_min, limits.position_max, limits.velocity, limits.force)
    assert [values.item() for values in read] == list(expected)


@pytest.mark.parametrize(
    ("soft", "expected"),
    [
        ('soft_lower_limit="-1.0" soft_upper_limit="1.2"', (-1.0, 1.2)),
        ('soft_lower_limit="-9" soft_upper_limit="1.2"', (-2.5, 1.2)),
        ('soft_lower_limit="-9" soft_upper_limit="9"', (-2.5, 2.5)),
        ('soft_upper_limit="1.5"', (0.0, 1.5)),
        ("", (-2.5, 2.5)),
    ],
)
def test_soft_limits_narrow_a_range(write, soft, expected):
    inner = (
        '<limit lower="-2.5" upper="2.5" velocity="1" effort="2"/>'
        f'<safety_controller {soft} k_velocity="10"/>'
    )
    arm_of_file = load_urdf(write(arm(inner=inner)))
    limits = arm_of_file.limits
    assert (limits.position_min.item(), limits.position_max.item()) == expected
    are_noted = any("soft limits" in note for note in arm_of_file.notes)
    assert are_noted == (expected != (-2.5, 2.5))


def test_speeds_and_forces_of_a_billion_are_none(write):
    inner = '<limit lower="-1" upper="1" velocity="1e9" effort="1e+9"/>'
    arm_of_file = load_urdf(write(arm(inner=inner)))
    assert np.isinf([*arm_of_file.limits.velocity, *arm_of_file.limits.force]).all()
    assert [note.split(": ")[1] for note in arm_of_file.notes[:2]] == [
        "velocity 1e+09 is taken as unknown.",
        "effort 1e+09 is taken as unknown.",
    ]


@pytest.mark.parametrize("limit", ["0.7 0.7", "-1 -1", "0 0", "-1000 1000"])
def test_a_range_that_is_none_is_noted(write, limit):
    lower, upper = limit.split()
    inner = f'<limit lower="{lower}" upper="{upper}" velocity="1" effort="2"/>'
    note, _ = load_urdf(write(arm(inner=inner))).notes
    assert f"`j1`: a range from {lower} to {upper} is taken as unknown" in note


@pytest.mark.parametrize("turns", [1.25, -2.25, 3.1, 50.0])
def test_attitudes_beyond_a_full_turn_are_those_of_pinocchio(write, turns):
    rpy = f"{2 * np.pi * turns} 0.3 0"
    body = inertial(1.0, (0, 0, 0), (0.1, 2 * np.pi * turns, 0), (1, 0, 0, 2, 0, 2.5))
    limit = '<limit lower="-1" upper="1" velocity="1" effort="2"/>'
    parts = (link("base"), link("a", body))
    path = write(robot(*parts, joint("j1", "base", "a", rpy=rpy, inner=limit)))
    ours = load_urdf(path)
    oracle = Oracle(path)
    oracle.set(ours.joint_names, [0.5])
    np.testing.assert_allclose(
        body_transforms(ours, np.array([0.5])), [oracle.joint("j1")], atol=1e-12
    )
    np.testing.assert_allclose(
        urdf_parameters(path), oracle.parameters("j1"), atol=1e-12
    )


@pytest.mark.parametrize("quaternion", ["0 0 0.6 0.8", "-0.5 0.5 0.5 -0.5"])
@pytest.mark.parametrize("angles", ['rpy="0.1 0.2 0.3"', 'rpy="0.4 0.5 0.6"'])
def test_quaternions_are_those_of_pinocchio(write, quaternion, angles):
    body = inertial(1.0, (0.1, 0, 0), (0.1, 0.2, 0.3), (1, 0.1, 0, 2, 0, 2.5))
    limit = '<limit lower="-1" upper="1" velocity="1" effort="2"/>'
    turning = joint("j1", "base", "a", rpy="0.4 0.5 0.6", inner=limit)
    text = robot(link("base"), link("a", body), turning)
    text = text.replace("<robot ", '<robot version="1.2" ')
    assert angles in text
    path = write(text.replace(angles, f'quat_xyzw="{quaternion}"'))
    ours = load_urdf(path)
    oracle = Oracle(path)
    oracle.set(ours.joint_names, [0.5])
    np.testing.assert_allclose(
        body_transforms(ours, np.array([0.5])), [oracle.joint("j1")], atol=1e-12
    )
    np.testing.assert_allclose(
        urdf_parameters(path), oracle.parameters("j1"), atol=1e-12
    )


def test_a_quaternion_without_direction_is_refused(write):
    text = arm(rpy="0.4 0.5 0.6").replace("rpy=", "quat_xyzw=")
    with pytest.raises(InputError, match="`quat_xyzw` must hold 4 finite numbers"):
        load_urdf(write(text))
    zero = text.replace("0.4 0.5 0.6", "0 0 0 0")
    with pytest.raises(InputError, match="`quat_xyzw` must not be zero"):
        load_urdf(write(zero))


@pytest.mark.parametrize("xyz", ["0.1, 0.2, -0.3", "0.1 0.2, -0.3", " 0.1,  0.2 -0.3"])
def test_commas_before_blanks_separate_numbers(write, xyz):
    assert load_urdf(write(arm(xyz=xyz))).offset.tolist() == [[0.1, 0.2, -0.3]]


@pytest.mark.parametrize("xyz", ["0,1 0,2 -0,3", "0.1,0.2,-0.3", "0.1, 0.2, -0.3,"])
def test_other_commas_are_refused(write, xyz):
    with pytest.raises(InputError, match="`xyz` must hold 3 finite numbers"):
        load_urdf(write(arm(xyz=xyz)))


@pytest.mark.parametrize("key", ["armature", "damping", "friction", "stiffness"])
def test_a_negative_effect_is_noted_and_not_used(write, key):
    path = write(arm(inner=f'<dynamics {key}="-1"/>'))
    assert f"joint `j1`: `{key}` is negative and is not used" in " ".join(
        load_urdf(path).notes
    )
    positive = write(arm(inner=f'<dynamics {key}="1"/>'))
    assert "negative" not in " ".join(load_urdf(positive).notes)


@pytest.mark.parametrize(
    "head",
    [
        '\n\n<?xml version="1.0"?>',
        '<!-- made\nby hand -->\n<?xml version="1.0" encoding="utf-8"?>',
        '\ufeff\n<?xml version="1.0" encoding="UTF-8"?>',
        '<?xml version="1.0"?><!-- a -- b ---\n <link name="base"/> -->',
        '<?xml version="0.0"?>',
        '\n<?xml version="2.0"?>\n',
        '<?xml version="1.0"?>\n<!-- joint of <drake:joint> -->',
    ],
)
def test_faults_of_xml_that_other_programs_allow(write, head):
    text = arm().replace('<?xml version="1.0"?>', head)
    assert load_urdf(write(text)).joint_names == ("j1",)
    # Errors name the line of the file.
    broken = text.replace("</joint>", "")
    with pytest.raises(InputError, match=f"line {broken.count(chr(10))}: .* not XML"):
        load_urdf(write(broken))


def chain_of_three(masses, moment):
    """Return a chain of three bodies with round moments [kg m²]."""
    parts = [link("l0")]
    for k, mass in enumerate(masses, 1):
        tensor = (moment, 0.0, 0.0, moment, 0.0, moment)
        parts.append(link(f"l{k}", inertial(mass, (0, 0, 0.1), (0, 0, 0), tensor)))
        parts.append(joint(f"j{k}", f"l{k - 1}", f"l{k}", xyz="0 0 0.3"))
    return robot(*parts)


@pytest.mark.parametrize(
    ("masses", "moment", "words"),
    [
        ((4.0, 3.0, 1.5), 1e-2, ""),
        ((4000.0, 3.0, 1.5), 1e-2, "joint `j1`: .*is a mass in grams"),
        ((4.0, 3.0, 0.02), 1e-6, "joints `j1`, `j2`: .* are the moments placeholders"),
        ((4.0, 3.0, 1.5), 0.0, "joints `j1`, `j2`, `j3`: .* placeholders"),
    ],
)
def test_bodies_denser_than_any_material_are_noted(write, masses, moment, words):
    path = write(chain_of_three(masses, moment))
    notes = load_urdf(path).notes
    if not words:
        assert notes == ()
        bodies = RobotFile(path).possible_bodies()
        np.testing.assert_allclose(bodies[:, 0], masses)
    else:
        (note,) = notes
        assert re.match(words, note)


def test_branches_may_be_alike(write):
    tensor = (1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-3)
    body = inertial(0.2, (0, 0, 0), (0, 0, 0), tensor)
    parts = [
        part for name in "abc" for part in (link(name, body), joint(name, "l", name))
    ]
    assert load_urdf(write(robot(link("l"), *parts))).notes == ()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<limit ", '<limit drake:acceleration="2" '),
        ("<robot ", '<robot drake:version="1" '),
        ("</robot>", "<drake:joint/></robot>"),
        ('" velocity', '"velocity'),
        ("<limit lower='-1' ", "<limit lower='-1'"),
    ],
)
def test_undeclared_prefixes_and_missing_blanks_do_no_harm(write, old, new):
    text = arm(inner="""<limit lower='-1' upper="1" effort="9" velocity="2"/>""")
    assert new in text.replace(old, new)
    limits = load_urdf(write(text.replace(old, new))).limits
    assert limits.velocity.tolist() == [2.0]
    macro = text.replace("</robot>", "<xacro:arm/></robot>")
    with pytest.raises(InputError, match="is a xacro file"):
        load_urdf(write(macro))


def test_defaults_of_name_and_axis(write):
    assert load_urdf(write(arm(axis="0 1e300 0"))).axis.tolist() == [[0.0, 1.0, 0.0]]
    text = arm().replace(' name="arm"', "").replace('<axis xyz="0 0 1"/>', "")
    loaded = load_urdf(write(text, "left.urdf"))
    assert loaded.name == "left"
    assert loaded.axis.tolist() == [[1.0, 0.0, 0.0]]


# Mimic joints, xacro, and files with nonsense.

HAND = robot(
    link("base"),
    link("palm", inertial(20.0, (0, 0, 0), (0, 0, 0), (0.1, 0, 0, 0.1, 0, 0.1))),
    link(
        "left", inertial(0.2, (0.0, 0.01, 0.02), (0, 0, 0), (1e-4, 0, 0, 1e-4, 0, 1e-4))
    ),
    link(
        "right", inertial(0.3, (0.1, 0.0, 0.02), (0, 0, 0), (2e-4, 0, 0, 2e-4, 0, 2e-4))
    ),
    joint("wrist", "base", "palm", "continuous"),
    joint(
        "left",
        "palm",
        "left",
        "prismatic",
        inner='<limit lower="0.01" upper="0.04" velocity="1" effort="9"/>',
    ),
    joint(
        "right",
        "palm",
        "right",
        xyz="0.1 0 0",
        rpy="0.1 0.2 0.3",
        axis="1 2 0",
        inner='<mimic joint="left" multiplier="-20" offset="0.5"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="9"/>',
    ),
)


def test_a_mimic_joint_is_held_where_its_joint_puts_it(write):
    path = write(HAND)
    ours = load_urdf(path)
    assert ours.joint_names == ("wrist", "left")
    assert "`right`: held at 0.3 (mimic of joint `left`)" in ours.notes[0]
    full = pin.buildModelFromUrdf(str(path))
    reference = pin.neutral(full)
    reference[full.joints[full.getJointId("right")].idx_q] = 0.3
    reduced = pin.buildReducedModel(full, [full.getJointId("right")], reference)
    parameters = urdf_parameters(path).reshape(-1, 10)
    for name, p in zip(ours.joint_names, parameters, strict=True):
        expected = reduced.inertias[reduced.getJointId(name)].toDynamicParameters()
        np.testing.assert_allclose(
            Inertia.from_parameters(p).pinocchio, expected, atol=1e-14
        )


def test_a_mimic_of_nothing_is_held_at_its_offset(write):
    path = write(HAND.replace('<mimic joint="left"', '<mimic joint="lost"'))
    assert "held at 0.5 (mimic of joint `lost`)" in load_urdf(path).notes[0]
    path = write(HAND.replace('<mimic joint="left"', '<mimic joint="right"'))
    assert "held at 0.5" in load_urdf(path).notes[0]


def test_a_tip_leaves_mimics_out(write):
    path = write(HAND)
    assert load_urdf(path, tip="palm").joint_names == ("wrist",)
    assert urdf_parameters(path, tip="palm")[0] == 20.0


def follower(mass, *parts, parent="a", mimic='<mimic joint="j1"/>'):
    """An arm of 5 kg, and a link of some mass on a joint that follows the first one."""
    moments = (0.1, 0, 0, 0.1, 0, 0.1)
    return robot(
        link("base"),
        link("a", inertial(5.0, (0.1, 0, 0), (0, 0, 0), moments)),
        link("b", inertial(mass, (0.1, 0, 0), (0, 0, 0), moments)),
        joint("j1", "base", "a", axis="0 1 0"),
        joint("j2", parent, "b", axis="0 1 0", inner=mimic),
        *parts,
    )


WRIST = (link("c"), joint("j3", "b", "c", axis="0 1 0"))
LOADED = {
    "the last link": (follower(1.0), ["j2"]),
    "a bar beside the arm": (follower(1.0, parent="base"), ["j2"]),
    "a bar before the tip": (
        follower(1.0, link("tip"), joint("j3", "a", "tip", axis="0 1 0")),
        ["j2"],
    ),
    "a joint": (follower(0.01, *WRIST), ["j2"]),
    "a second follower": (
        follower(
            0.0,
            link("c", inertial(1.0, (0, 0, 0), (0, 0, 0), (0.1, 0, 0, 0.1, 0, 0.1))),
            joint("j3", "b", "c", axis="0 1 0", inner='<mimic joint="j2"/>'),
        ),
        ["j2", "j3"],
    ),
    "a light tip": (
        follower(0.01, link("tip"), joint("j3", "b", "tip", "fixed")),
        ["j2"],
    ),
}
FINGERS = {
    "a light link": follower(0.1),
    "a joint that stands": follower(
        1.0, mimic='<mimic joint="j1" multiplier="0" offset="0.2"/>'
    ),
    "without its joint": follower(1.0, mimic='<mimic joint="lost"/>'),
}


@pytest.mark.parametrize(("text", "names"), LOADED.values(), ids=LOADED)
def test_a_joint_that_follows_another_one_carries_a_link_of_the_arm(write, text, names):
    path = write(text)
    robot = load_urdf(path, tip="tip" if "tip" in text else None)
    assert [follower.name for follower in robot.followers] == names
    assert "`j2`: follows another one, at 1 * `j1` + 0" in robot.notes[0]
    parameters = urdf_parameters(path, tip=robot.source_tip)
    assert parameters.size == 10 * robot.bodies


REFUSED = {
    "a leader that is left out": (
        follower(1.0, *WRIST, parent="base"),
        "c",
        "leaves out",
    ),
    "a link that is left out": (
        follower(
            0.1,
            link("c", inertial(1.0, (0, 0, 0), (0, 0, 0), (0.1, 0, 0, 0.1, 0, 0.1))),
            link("tip"),
            joint("j3", "b", "c", axis="0 1 0", inner='<mimic joint="j1"/>'),
            joint("j4", "a", "tip"),
            mimic="",
        ),
        "tip",
        "another `tip`",
    ),
    "no common range": (
        follower(1.0, mimic='<mimic joint="j1" offset="9"/>').replace(
            '<axis xyz="0 1 0"/>',
            '<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/>',
        ),
        None,
        "`offset`",
    ),
}


@pytest.mark.parametrize(("text", "tip", "cure"), REFUSED.values(), ids=REFUSED)
def test_followers_that_no_model_has(write, text, tip, cure):
    with pytest.raises(InputError, match=f"joint `j[23]` .*{cure}"):
        load_urdf(write(text), tip=tip)


@pytest.mark.parametrize("text", FINGERS.values(), ids=FINGERS)
def test_fingers_and_joints_that_stand_are_held(write, text):
    robot = load_urdf(write(text))
    assert "`j2`: held" in robot.notes[0]


def test_what_the_error_of_a_follower_advises_is_possible(write):
    fixed = follower(1.0).replace('name="j2" type="revolute"', 'name="j2" type="fixed"')
    assert load_urdf(write(fixed)).joint_names == ("j1",)
    assert load_urdf(write(follower(1.0, mimic=""))).joint_names == ("j1", "j2")


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
def test_rpy_angles_are_precise_at_any_pitch(pitch):
    R = rpy_rotation((0.4, pitch, -2.0))
    np.testing.assert_allclose(rpy_rotation(rpy_angles(R)), R, atol=1e-15)


def test_nonsense_is_named_at_once(write):
    zero = '<limit lower="0" upper="0" velocity="0" effort="0"/>'
    weak = '<limit lower="-2" upper="2" velocity="3" effort="0.5"/>'
    bodies = {
        "a": inertial(2.0, (0.5, 0, 0), (0, 0, 0), (0.1, 0, 0, 0.1, 0, 0.1)),
        "b": inertial(-1.0, (0, 0, 0), (0, 0, 0), (0.1, 0, 0, 0.1, 0, 0.1)),
        "c": inertial(1.0, (0, 0, 0), (0, 0, 0), (0.1, 0, 0, 0.1, 0, 0.3)),
    }
    path = write(
        robot(
            *map(link, ("base", "d")),
            *(link(name, text) for name, text in bodies.items()),
            joint("j1", "base", "a", axis="0 1 0", inner=weak),
            joint("j2", "a", "b", inner=zero),
            joint("j3", "b", "c", inner=zero),
            joint("j4", "c", "d"),
        )
    )
    text = "\n".join(load_urdf(path).notes)
    for words in (
        "joints `j2`, `j3`: a range from 0 to 0",
        "joints `j2`, `j3`: velocity 0",
        "joints `j2`, `j3`: effort 0",
        "joint `j4`: the body has no mass",
        "link `b`: .*`mass` is -1 kg",
        "link `c`: .*larger than the sum",
    ):
        assert re.search(words, text), words
    assert len(load_urdf(path).notes) == 6


XACRO = HAND.replace(
    "<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'
).replace("</robot>", '<xacro:property name="x" value="1"/></robot>')


def test_a_xacro_file_is_expanded_by_the_program(write, tmp_path, monkeypatch):
    path = write(XACRO, "arm.urdf.xacro")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    with pytest.raises(
        InputError, match=r"`xacro .*arm.urdf.xacro -o arm.urdf`.*pip install"
    ):
        load_urdf(path)
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "xacro"
    program.write_text(
        f"#!{sys.executable}\nimport sys\n" + "print(open(sys.argv[1]).read()"
        """.replace('<xacro:property name="x" value="1"/>', ""))"""
    )
    program.chmod(0o755)
    assert load_urdf(path).joint_names == load_urdf(write(HAND)).joint_names
    program.write_text(f"#!{sys.executable}\nraise SystemExit('no such macro')")
    with pytest.raises(InputError, match="fails: no such macro"):
        load_urdf(path)


TRANSMISSIONS = """<transmission name="a"><joint name="j1"><x/></joint>
    <actuator name="m1"><mechanicalReduction>-50</mechanicalReduction></actuator>
  </transmission>
  <ros2_control><transmission name="b"><plugin>simple</plugin>
    <joint name="j2"><mechanical_reduction>2</mechanical_reduction></joint>
    <actuator name="m2"><mechanical_reduction>30</mechanical_reduction></actuator>
  </transmission></ros2_control>
  <transmission name="c" type="Differential"><joint name="j3"/><joint name="j4"/>
    <mechanicalReduction>9</mechanicalReduction></transmission>
  <transmission name="d"><joint name="j3"/>
    <mechanicalReduction>{}</mechanicalReduction></transmission>
  <transmission name="e"><joint name="no"/>
    <mechanicalReduction>7</mechanicalReduction></transmission>"""


def chain_of_four(inner):
    """Return an arm of four links with ranges of 2 rad, and further elements."""
    limit = '<limit lower="-1" upper="1" effort="9" velocity="2"/>'
    parts = [link("l0")]
    for k in range(1, 5):
        parts.append(link(f"l{k}"))
        parts.append(joint(f"j{k}", f"l{k - 1}", f"l{k}", inner=limit))
    return robot(*parts, inner)


def test_ratios_of_transmissions_are_read_and_change_nothing(write):
    text = chain_of_four(TRANSMISSIONS)
    for word, ratio in (("-0.5", -0.5), ("1", 1.0), ("0", 1.0), ("a", 1.0)):
        arm_of_file = load_urdf(write(text.format(word)))
        drives = arm_of_file.drives
        assert drives.stated_ratios.tolist() == [-50.0, 60.0, ratio, 1.0]
        assert drives.is_direct
        assert drives.lack_stated_ratios
    assert not any("transmission" in note for note in arm_of_file.notes)
    unit_gears = re.sub("(reduction|Reduction)>[-.0-9]+", r"\1>1", text.format("1"))
    assert not load_urdf(write(unit_gears)).drives.lack_stated_ratios
