import re

import pytest
from urdf_text import arm, inertial, joint, link, robot

from jaxid.robot.urdf import load_urdf, urdf_parameters

MIMIC = '<mimic joint="j1"/>'


def two(*parts):
    """The one-joint arm with more in it."""
    return robot(link("base"), link("a"), joint("j1", "base", "a"), *parts)


REFUSED = {
    "a floating joint": (arm(kind="floating"), "joint `j1` is floating, but only .* choose `tip`"),
    "a planar joint": (arm(kind="planar"), "joint `j1` is planar, but only .* choose `tip`"),
    "a mimic joint": (
        two(link("b"), joint("j2", "a", "b", inner=MIMIC)),
        "joint `j2` mimics joint `j1`, but every joint must move freely: choose `tip`",
    ),
    "two parents": (
        two(link("b"), joint("j2", "base", "b"), joint("j3", "a", "b")),
        "joint `j3` moves link `b`, which joint `j2` moves as well; closed loops",
    ),
    "a loop without root": (
        robot(link("a"), link("b"), joint("j1", "a", "b"), joint("j2", "b", "a")),
        "joint `j2` is part of a closed loop: no path leads from a root link to `a`",
    ),
    "a loop beside a tree": (
        two(link("b"), link("c"), joint("j2", "b", "c"), joint("j3", "c", "b")),
        "joint `j3` is part of a closed loop",
    ),
    "several roots": (two(link("lost")), r"has several root links \(`base`, `lost`\)"),
    "a missing link": (
        two(joint("j2", "a", "nowhere")),
        "joint `j2` connects link `nowhere`, which the file does not define",
    ),
    "a zero axis": (arm(axis="0 0 0"), "joint `j1` has the zero vector as its axis"),
    "an infinite axis": (arm(axis="0 inf 0"), "joint `j1` must have 3 finite numbers as `axis`"),
    "a place nowhere": (
        arm(xyz="0 nan 0"),
        "joint `j1` must have 3 finite numbers as `xyz`",
    ),
    "an endless turn": (arm(rpy="inf 0 0"), "joint `j1` must have 3 finite numbers as `rpy`"),
    "a limit that is none": (
        arm(inner='<limit lower="nan" upper="1"/>'),
        "joint `j1` has a limit that is not a number",
    ),
    "a range upside down": (
        arm(inner='<limit lower="1" upper="-1"/>'),
        "joint `j1` ranges from 1 to -1, but the lower end must be below",
    ),
    "a range in degrees": (
        arm(inner='<limit lower="-170" upper="170"/>'),
        "joint `j1` ranges to -170 rad, which is 27.1 turns: .* in radians, not degrees",
    ),
    "a rail in millimetres": (
        arm(kind="prismatic", inner='<limit lower="0" upper="1500"/>'),
        "joint `j1` ranges to 1500 m, which no robot does: limits in a URDF are in metres",
    ),
    "an attitude in degrees": (
        arm(rpy="90 0 0"),
        'joint `j1` has `rpy="90 0 0"`, .* in radians, not degrees',
    ),
    "a place beyond the horizon": (
        arm(xyz="0 0 1e300"),
        'joint `j1` has `xyz="0 0 1e.300"`, which is 1e.300 m: lengths in a URDF are in metres',
    ),
    "nothing that moves": (arm(kind="fixed"), "has no moving joint below link `base`"),
    "no links": (robot(), "has no links"),
    "an unknown type": (arm(kind="spherical"), "is not a URDF that can be read: .*spherical"),
    "words for numbers": (arm(xyz="0 zero 0"), "is not a URDF that can be read: .*zero"),
    "too few numbers": (arm(xyz="0 0"), "is not a URDF that can be read: .*j1"),
    "a joint without child": (
        arm().replace('<child link="a"/>', ""),
        "is not a URDF that can be read: .*child",
    ),
    "two axes": (
        arm(inner='<axis xyz="1 0 0"/>'),
        "line 5: `<joint>` has a second `<axis>`, and only one can hold",
    ),
    "two links of one name": (two(link("a")), "has two links named `a`: rename one"),
    "two joints of one name": (
        two(link("b"), joint("j1", "a", "b")),
        "has two joints named `j1`: rename one",
    ),
    "a DOCTYPE": (
        arm().replace("<robot", '<!DOCTYPE robot [<!ENTITY x SYSTEM "secret.txt">]><robot'),
        "has a DOCTYPE, .*: remove it",
    ),
    "broken XML": (arm().replace("</joint>", ""), "line 6: this is not XML"),
    "an empty file": ("", "line 1: this is not XML"),
    "another language": ("<sdf><model/></sdf>", "its root is `<sdf>`, not `<robot>`"),
    "a xacro file": (
        arm().replace(
            "<joint", '<xacro:arm xmlns:xacro="http://www.ros.org/wiki/xacro" n="1"/><joint'
        ),
        "is a xacro file: expand it first",
    ),
}


@pytest.mark.parametrize(("text", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_refusals_name_the_file_and_what_is_wrong(tmp_path, text, sentence):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with pytest.raises(ValueError, match=sentence) as caught:
        load_urdf(path)
    message = str(caught.value)
    assert message.startswith(f"`{path}`")
    assert "\n" not in message
    assert re.search(r"[^.]\.$", message)


@pytest.mark.parametrize("kind", ["floating", "planar", "mimic"])
def test_what_the_chain_avoids_is_no_problem(tmp_path, kind):
    path = tmp_path / "arm.urdf"
    hand = {"inner": MIMIC} if kind == "mimic" else {"kind": kind}
    path.write_text(two(link("b"), link("c"), joint("j2", "a", "b", **hand), joint("j3", "b", "c")))
    assert load_urdf(path, tip="a").joint_names == ("j1",)
    assert load_urdf(path, base="b").joint_names == ("j3",)
    with pytest.raises(ValueError, match="joint `j2`"):
        load_urdf(path, tip="b")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"tip": "hand"}, "`tip` must be a link of .* but is `hand`; its links are `base`, `a`"),
        ({"base": "floor"}, "`base` must be a link of .* but is `floor`"),
        ({"base": "a", "tip": "base"}, "no chain leads from `base` `a` to `tip` `base`"),
        ({"tip": "base"}, "has no moving joint between links `base` and `base`"),
        ({"snap_tolerance": -1.0}, "`snap_tolerance` must be an angle from 0"),
        ({"base_rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "base's rotation is no rotation"),
        ({"gravity": (0.0, 9.81)}, "`gravity` must hold finite numbers"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, options, sentence):
    path = tmp_path / "arm.urdf"
    path.write_text(arm())
    with pytest.raises(ValueError, match=sentence):
        load_urdf(path, **options)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"the URDF file `.*lost\.urdf` does not exist"):
        load_urdf(tmp_path / "lost.urdf")


def test_a_file_far_too_large_is_not_even_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxid.robot.urdf_file._LARGEST_FILE", 100)
    path = tmp_path / "arm.urdf"
    path.write_text(arm())
    with pytest.raises(ValueError, match=r"is larger than .* MiB: this is no URDF"):
        load_urdf(path)


def test_entities_never_read_other_files(tmp_path):
    (tmp_path / "secret.txt").write_text("classified")
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<!DOCTYPE robot [<!ENTITY x SYSTEM "secret.txt">]>'
        '<robot name="r"><link name="a">&x;</link></robot>'
    )
    with pytest.raises(ValueError, match="DOCTYPE") as caught:
        load_urdf(path)
    assert "classified" not in str(caught.value)


def test_an_inertia_that_is_not_finite_is_refused(tmp_path):
    path = tmp_path / "arm.urdf"
    heavy = inertial("nan", (0, 0, 0), (0, 0, 0), (1, 0, 0, 1, 0, 1))
    path.write_text(robot(link("base"), link("a", heavy), joint("j1", "base", "a")))
    with pytest.raises(ValueError, match="link `a` has an inertial that is not finite"):
        urdf_parameters(path)


ROUND = (1e-2, 0, 0, 1e-2, 0, 1e-2)
IMPOSSIBLE = {
    "a negative mass": (-5.0, (0, 0, 0), (0, 0, 0), ROUND, "its mass is -5 kg"),
    "a mass beyond all": (1e300, (0, 0, 0), (0, 0, 0), ROUND, r"1e\+300 kg, and no part of a rob"),
    "a negative moment": (1.0, (0, 0, 0), (0, 0, 0), (-1, 0, 0, 1, 0, 1), "moments are -1, 1, 1"),
    "a flat triangle": (1.0, (0, 0, 0), (0, 0, 0), (1, 0, 0, 1, 0, 3), "larger than the sum"),
    "millimetres": (1.0, (0, 0, 0), (0, 0, 0), (1e4, 0, 0, 1e4, 0, 1e4), "are these kg mm²"),
    "a centre far away": (1.0, (0, 3e3, 0), (0, 0, 0), ROUND, "centre of mass lies 3000 m away"),
    "degrees": (1.0, (0, 0, 0), (0, 90, 0), ROUND, "`rpy` is 0 90 0, which are degrees"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_what_no_body_could_be_is_named_and_not_used(tmp_path, case):
    *claimed, sentence = case
    path = tmp_path / "arm.urdf"
    path.write_text(robot(link("base"), link("a", inertial(*claimed)), joint("j1", "base", "a")))
    with pytest.raises(
        ValueError, match=f"the inertial of link `a` belongs to no body: .*{sentence}"
    ):
        urdf_parameters(path)
    (note,) = load_urdf(path).notes
    assert re.search(f"link `a`: .* belongs to no body: .*{sentence}", note)
    assert urdf_parameters(path, check=False)[0] == claimed[0]


@pytest.mark.parametrize(
    ("options", "note"),
    [
        ({"inner": '<limit velocity="180"/>'}, "180 rad/s is 1719 turns a minute: .* in degrees"),
        ({"xyz": "0 0 300"}, "`offset` of joint `j1` is 300 m: is the length in millimetres"),
        (
            {"kind": "prismatic", "inner": '<limit lower="0" upper="500"/>'},
            "joint `j1`: an end of its range is 500 m: is the length in millimetres",
        ),
    ],
)
def test_what_could_be_in_another_unit_is_named(tmp_path, options, note):
    path = tmp_path / "arm.urdf"
    path.write_text(arm(**options))
    assert any(re.search(note, said) for said in load_urdf(path).notes)


def test_a_joint_that_turns_without_end_has_no_range(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(arm(inner='<limit lower="-1e16" upper="1e16"/>'))
    limits = load_urdf(path).limits
    assert (limits.position_min.item(), limits.position_max.item()) == (-float("inf"), float("inf"))
