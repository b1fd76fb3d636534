"""Invalid input of the room: each error names what is wrong, and the file if any."""

import re

import numpy as np
import pytest
from urdf_text import arm, inertial, joint, link, robot

from jaxid.errors import InputError
from jaxid.result_table import Status
from jaxid.robot.capsule_fit import fit_capsules
from jaxid.robot.collision import Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.inertia import Tool
from jaxid.robot.inverse_kinematics import inverse_kinematics_along
from jaxid.robot.library import from_dh, panda, planar_arm
from jaxid.robot.limits_and_drives import Drives, Limits
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import load_urdf, urdf_parameters
from jaxid.workflow.robot_file import RobotFile

ARM = {
    "revolute": (True,),
    "axis": [(0, 0, 1)],
    "rotation": [np.eye(3)],
    "offset": [(0, 0, 0)],
}
LOAD = {"mass": 1.0, "centre_of_mass": (0.0, 0.0, 0.1)}
ROD = {"start": (0, 0, 0), "end": (1, 0, 0), "radius": 0.1}
STANDARD = {"convention": "standard"}


def two(*parts):
    """The one-joint arm with more in it."""
    return robot(link("base"), link("a"), joint("j1", "base", "a"), *parts)


CALLS = [
    (lambda: Limits(2, velocity=[1.0, 0.0]), "`velocity`"),
    (lambda: Limits(1, position_min=[1.0], position_max=[0.5]), "`position_min`"),
    (lambda: Limits(), "`joints`"),
    (lambda: Drives(2, reduction=np.ones((2, 2))), "`reduction`"),
    (lambda: Drives(1, max_torques=[-1.0]), "`max_torques`"),
    (lambda: Drives(1, rotor_inertia=[-1.0]), "`rotor_inertia`"),
    (lambda: Drives(1, zero=[np.inf]), "`zero`"),
    (lambda: Robot("arm", **ARM, tip_body=1), "`tip_body`"),
    (lambda: Robot("arm", **ARM, tool=Tool(2, **LOAD)), "`tool.body`"),
    (lambda: Robot("arm", **ARM, tip_rotation=2 * np.eye(3)), "`tip_rotation`"),
    (lambda: Robot("arm", **{**ARM, "axis": [(0, 0, 0)]}), "`axis` of joint 1"),
    (
        lambda: Robot("arm", **{**ARM, "offset": [(0, 0, 1e4)]}),
        "`offset` of joint `joint1`",
    ),
    (lambda: planar_arm(3).replace(parent=(-1, 1, 0)), "`parent`"),
    (lambda: planar_arm(3).replace(joint_names=("a", "b")), "`joint_names`"),
    (lambda: planar_arm(3).replace(limits=Limits(2)), "`limits`"),
    (lambda: planar_arm(3).replace(drives=Drives(4)), "`drives`"),
    (lambda: planar_arm().mounted(np.diag([1.0, 1.0, -1.0])), "`rotation`"),
    (lambda: planar_arm().max_forces, "`limits.force`"),
    (lambda: planar_arm(0), "`joints`"),
    (lambda: Tool(0, **{**LOAD, "mass": 0.0}), "`mass`"),
    (
        lambda: Tool(0, **{**LOAD, "centre_of_mass": (0.0, 0.0, 3e3)}),
        "`centre_of_mass`",
    ),
    (
        lambda: Tool(0, **LOAD, inertia=np.triu(np.ones((3, 3)))),
        "`inertia` is not symmetric",
    ),
    (lambda: Tool(0, **LOAD, inertia=np.diag([1.0, 1.0, 2.1])), "`inertia`.*principal"),
    (lambda: Capsule("a", 0, start=(0, 0), radius=0.1), "`start`"),
    (lambda: Capsule("a", 0, start=(0, 0, 0), radius=0.0), "`radius`"),
    (lambda: Box("b", centre=(0, 0, 0), size=(1, 0, 1)), "`size`"),
    (
        lambda: Box("b", centre=(0, 0, 0), size=(1, 1, 1), rotation=np.ones((3, 3))),
        "`rotation`",
    ),
    (lambda: HalfSpace("h", normal=(0, 0, 0)), "`normal`"),
    (
        lambda: CollisionModel(panda(), [Capsule("a", 7, **ROD)]),
        "`body` of capsule `a`",
    ),
    (
        lambda: CollisionModel(panda(), [Capsule("a", 0, **ROD)] * 2),
        "two shapes are named `a`",
    ),
    (lambda: CollisionModel(panda(), [Capsule("a", 0, **ROD)]), "at least one pair"),
    (
        lambda: CollisionModel(panda(), [Capsule("a", 0, **ROD)], pairs=[("a", "c")]),
        "`c`",
    ),
    (
        lambda: CollisionModel(
            panda(), [], [HalfSpace("f"), HalfSpace("g")], [("f", "g")]
        ),
        "`f`",
    ),
    (lambda: from_dh(np.zeros((2, 4)), convention="craig"), "`convention`"),
    (lambda: from_dh([(0.0, 1.0)], **STANDARD), "`rows`"),
    (lambda: from_dh(np.zeros((2, 4)), **STANDARD, revolute=(True,)), "`axis`"),
    (lambda: from_dh(np.zeros((2, 4)), **STANDARD).snapped(1.0), "`snap_tolerance`"),
    (
        lambda: inverse_kinematics_along(panda(), np.ones((1, 3)), 2 * np.eye(3)),
        "rotation",
    ),
    (
        lambda: inverse_kinematics_along(panda(), np.ones((1, 3)), np.eye(3), [0.0]),
        "`posture`",
    ),
]


@pytest.mark.parametrize("case", range(len(CALLS)))
def test_invalid_arguments_are_named(case):
    call, named = CALLS[case]
    with pytest.raises(InputError, match=named):
        call()


FILES = {
    "a floating base": (
        robot(
            *map(link, ("world", "base", "a")),
            joint("root", "world", "base", "floating"),
            joint("j1", "base", "a"),
        ),
        "joint `root` is floating.*`--tip`.*`--base base`",
    ),
    "a place in millimetres": (
        arm(xyz="0 0 300"),
        "joint `j1` stands 300 m from its link: give its place in metres",
    ),
    "a planar joint": (
        arm(kind="planar"),
        "joint `j1` is planar.*`--tip`.*make it fixed",
    ),
    "an unknown type": (
        arm(kind="Revolute"),
        "joint `j1` has the type `Revolute`: write one of `revolute`, `continuous`",
    ),
    "a planar base": (
        robot(
            *map(link, ("world", "base", "a")),
            joint("root", "world", "base", "planar"),
            joint("j1", "base", "a"),
        ),
        "joint `root` is planar.*`--tip`.*`--base base`",
    ),
    "two parents": (
        two(link("b"), joint("j2", "base", "b"), joint("j3", "a", "b")),
        "`j3` moves",
    ),
    "a loop without root": (
        robot(link("a"), link("b"), joint("j1", "a", "b"), joint("j2", "b", "a")),
        "joint `j2` is part of a closed loop",
    ),
    "a loop beside a tree": (
        two(link("b"), link("c"), joint("j2", "b", "c"), joint("j3", "c", "b")),
        "joint `j3` is part of a closed loop",
    ),
    "several roots": (two(link("lost")), "one root link, but has `base`, `lost`"),
    "a missing link": (
        two(joint("j2", "a", "nowhere")),
        "joint `j2` connects link `nowhere`",
    ),
    "a zero axis": (arm(axis="0 0 0"), "joint `j1` has the zero vector"),
    "words for numbers": (arm(xyz="0 zero 0"), 'line 5: `xyz` .*"0 zero 0"'),
    "a limit that is none": (
        arm(inner='<limit lower="nan" upper="1"/>'),
        "line 5: `lower`",
    ),
    "a range upside down": (
        arm(inner='<limit lower="1" upper="-1"/>'),
        "`j1` ranges from 1 to -1",
    ),
    "a range in degrees": (
        arm(inner='<limit lower="-170" upper="170"/>'),
        "`j1` .*not degrees",
    ),
    "a rail in millimetres": (
        arm(kind="prismatic", inner='<limit lower="0" upper="1500"/>'),
        "joint `j1` ranges to 1500 m, .* in metres",
    ),
    "an attitude in degrees": (
        arm(rpy="90 0 0"),
        "joint `j1` has an `rpy` of 90 0 0: .*degrees",
    ),
    "an attitude of ten degrees": (arm(rpy="0 10 0"), "`rpy` of 0 10 0: .*degrees"),
    "an attitude of rounded degrees": (arm(rpy="0 89.9998 0"), "`rpy` .*degrees"),
    "one end of a range": (arm(inner='<limit lower="1"/>'), "or state both"),
    "a place far away": (
        arm(xyz="0 0 1e300"),
        "joint `j1` stands 1e[+]300 m .* metres",
    ),
    "nothing that moves": (arm(kind="fixed"), "no moving joint below link `base`"),
    "no links": (robot(), "has no links: give the file that describes"),
    "no child": (
        arm().replace('<child link="a"/>', ""),
        "line 5: the joint has no `<child>`",
    ),
    "two links of one name": (two(link("a")), "two links named `a`"),
    "a control character": (arm().replace('name="j1"', 'name="j&#9;1"'), "printable"),
    "broken XML": (arm().replace("</joint>", ""), "line 6: this is not XML"),
    "comments without an end": (f"<robot>{'<!--' * 200_000}", "this is not XML"),
    "another language": ("<sdf><model/></sdf>", "its root is `<sdf>`"),
    "a xacro file": (
        arm().replace(
            "<joint",
            '<xacro:arm xmlns:xacro="http://www.ros.org/wiki/xacro" n="1"/><joint',
        ),
        "xacro file: expand it",
    ),
}


@pytest.mark.parametrize(("text", "sentence"), FILES.values(), ids=FILES.keys())
def test_an_error_of_a_file_is_one_sentence_about_it(tmp_path, text, sentence):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        load_urdf(path)
    assert f"`{path}`" in str(caught.value)
    assert re.fullmatch(r"[^\n]*[^.]\.", str(caught.value))


def test_joints_that_the_chain_avoids_do_no_harm(tmp_path):
    path = tmp_path / "arm.urdf"
    hand = joint("j2", "a", "b", kind="planar")
    path.write_text(two(link("b"), link("c"), hand, joint("j3", "b", "c")))
    assert load_urdf(path, tip="a").joint_names == ("j1",)
    assert load_urdf(path, base="b").joint_names == ("j3",)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"tip": "hand"}, "`tip` must be a link of .* its links are `base`, `a`"),
        (
            {"base": "a", "tip": "base"},
            "no chain leads from `base` `a` to `tip` `base`",
        ),
        ({"tip": "base"}, "no moving joint between links `base` and `base`"),
        ({"base_rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "`rotation`"),
        ({"gravity": (0.0, 9.81)}, "`gravity`"),
    ],
)
def test_options_that_do_not_fit_the_file(tmp_path, options, sentence):
    path = tmp_path / "arm.urdf"
    path.write_text(arm())
    with pytest.raises(InputError, match=sentence):
        load_urdf(path, **options)
    with pytest.raises(FileNotFoundError, match="lost"):
        load_urdf(tmp_path / "lost.urdf")


ROUND = (1e-2, 0, 0, 1e-2, 0, 1e-2)
IMPOSSIBLE = {
    "a negative mass": (-5.0, (0, 0, 0), (0, 0, 0), ROUND, "`mass` is -5 kg"),
    "a negative moment": (
        1.0,
        (0, 0, 0),
        (0, 0, 0),
        (-1, 0, 0, 1, 0, 1),
        "moments -1, 1, 1",
    ),
    "a flat triangle": (
        1.0,
        (0, 0, 0),
        (0, 0, 0),
        (1, 0, 0, 1, 0, 3),
        "larger than the sum",
    ),
    "millimetres": (1.0, (0, 0, 0), (0, 0, 0), (1e4, 0, 0, 1e4, 0, 1e4), "kg mm²"),
    "a centre far away": (
        1.0,
        (0, 3e3, 0),
        (0, 0, 0),
        ROUND,
        "`centre_of_mass` is 3000 m",
    ),
    "a centre in millimetres": (
        1.0,
        (0, 0, 120.0),
        (0, 0, 0),
        ROUND,
        "`centre_of_mass` is 120 m away: is it in millimetres",
    ),
    "degrees": (
        1.0,
        (0, 0, 0),
        (0, 90, 0),
        ROUND,
        "`rpy` is 0 90 0, which are degrees",
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_inertials_that_cannot_exist_are_noted_and_not_used(tmp_path, case):
    *claimed, sentence = case
    path = tmp_path / "arm.urdf"
    path.write_text(
        robot(link("base"), link("a", inertial(*claimed)), joint("j1", "base", "a"))
    )
    with pytest.raises(InputError, match=f"link `a` .*{sentence}"):
        urdf_parameters(path)
    (remark,) = load_urdf(path).remarks
    assert re.search(f"link `a`: .*{sentence}.*correct the inertial", remark.text)
    assert "cannot belong to a real body" in remark.text
    assert remark.status is Status.DOUBTFUL
    assert urdf_parameters(path, check=False)[0] == claimed[0]


def test_links_with_one_fault_share_a_remark(tmp_path):
    path = tmp_path / "arm.urdf"
    placeholder = inertial(
        1e-6, (0, 0, 0), (0, 0, 0), (1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
    )
    path.write_text(
        robot(
            link("base"),
            link("a", placeholder),
            joint("j1", "base", "a"),
            link("b", placeholder),
            joint("j2", "a", "b"),
        )
    )
    (remark,) = load_urdf(path).remarks
    assert "links `a`, `b`: the moments of inertia cannot belong" in remark.text


@pytest.mark.parametrize(
    ("moments", "is_noted"),
    [
        ((1.0, 0, 0, 1.0, 0, 2.01), True),  # a plate, rounded to two digits
        ((0.0, 0, 0, 1.0, 0, 1.003), True),  # a rod
        ((1.5, -0.505, 0, 1.5, 0, 1.0), True),  # a turned plate
        ((1.0, 0, 0, 1.0, 0, 2.0), False),
        ((0.0, 0, 0, 1.0, 0, 1.0), False),
        ((1.5, -0.5, 0, 1.5, 0, 1.0), False),
    ],
)
def test_moments_that_rounding_makes_impossible_are_noted(tmp_path, moments, is_noted):
    path = tmp_path / "arm.urdf"
    body = inertial(1.0, (0, 0, 0), (0, 0, 0), moments)
    path.write_text(robot(link("base"), link("a", body), joint("j1", "base", "a")))
    notes = [note for note in load_urdf(path).notes if "because of rounding" in note]
    assert len(notes) == is_noted
    assert all("link `a`" in note for note in notes)
    file = RobotFile(str(path))
    is_same = np.array_equal(file.bodies().ravel(), urdf_parameters(path))
    assert is_same != is_noted


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        ('<cone radius="1"/>', "line 4: `cone`"),
        ('<box size="1 2"/>', "`size`"),
        ('<box size="1e300 1 1"/>', "`a` must be within 50 m"),
        ('<sphere radius="2000"/>', "`a` must be within 50 m"),
        ('<mesh filename="huge.obj"/>', "`a` must be within 50 m"),
        ('<cylinder radius="40" length="300"/>', "`a` must be within 50 m.*in metres"),
        ('<mesh filename="huge.obj" scale="1e300 1 1"/>', "`a` must be within 50 m"),
        (None, "no collision geometry"),
    ],
)
def test_geometry_that_cannot_be_read(tmp_path, geometry, message):
    path = tmp_path / "arm.urdf"
    text = (
        ""
        if geometry is None
        else f"<collision><geometry>{geometry}</geometry></collision>"
    )
    path.write_text(robot(link("base"), link("a", text), joint("j1", "base", "a")))
    corners = ("0 0 0", "1e300 0 0", "0 1e300 0", "0 0 1e300", "1 1 1")
    vertices = "".join(f"v {corner}\n" for corner in corners)
    (tmp_path / "huge.obj").write_text(f"{vertices}f 1 2 3\nf 1 2 4\nf 3 4 5\n")
    with pytest.raises(InputError, match=message):
        fit_capsules(path)


@pytest.mark.parametrize(
    ("options", "note"),
    [
        ({"inner": '<limit velocity="180"/>'}, "180 rad/s .* in degrees"),
        ({"xyz": "0 0 30"}, "`offset` of joint `j1` is 30 m: .* millimetres"),
        (
            {"kind": "prismatic", "inner": '<limit lower="0" upper="500"/>'},
            "`j1`.* 500 m",
        ),
    ],
)
def test_suspicious_units_are_noted(tmp_path, options, note):
    path = tmp_path / "arm.urdf"
    path.write_text(arm(**options))
    assert any(re.search(note, each) for each in load_urdf(path).notes)
