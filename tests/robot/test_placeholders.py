"""Masses and moments that nobody has measured are doubted, and others are not."""

import re

import mujoco
import pytest
from urdf_text import inertial, joint, link, robot

import jaxid as jid
from jaxid.result_table import Status

ROD = (0.02, 0.0, 0.0, 0.02, 0.0, 0.003)
UNIT = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
SMALL = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
BOX = '<collision><geometry><box size="0.1 0.1 0.3"/></geometry></collision>'
MESH = '<visual><geometry><mesh filename="no.stl"/></geometry></visual>'


def chain(*bodies, shape=""):
    """Return an arm with a mass, a centre and moments for each link."""
    parts = [link("l0")]
    for k, body in enumerate(bodies, 1):
        mass, centre, moments = body
        text = inertial(mass, (0, 0, centre), (0, 0, 0), moments)
        parts.append(link(f"l{k}", text + shape))
        parts.append(joint(f"j{k}", f"l{k - 1}", f"l{k}", xyz="0 0 0.3"))
    return robot(*parts)


REAL = ((4.0, 0.1, ROD), (3.0, 0.1, ROD), (1.5, 0.1, ROD))
DOUBTS = {
    "1 g and 1e-6": (
        chain(REAL[0], (1e-3, 0.0, SMALL), REAL[2]),
        "joint `j2`: the moments",
    ),
    "all 1 kg and 1 kg m2": (
        chain(*[(1.0, c, UNIT) for c in (0.1, 0.2, 0.3)]),
        "joints `j1`, `j2`, `j3`: the moments",
    ),
    "all 1 kg m2": (
        chain(*[(m, 0.1, UNIT) for m in (4.0, 3.0, 1.5)]),
        "joints `j1`, `j2`, `j3`: the moments",
    ),
}
CLEAN = {
    "an arm": chain(*REAL),
    "an arm of boxes": chain(*REAL, shape=BOX),
    "meshes that are not there": chain(*REAL, shape=MESH),
    "one light link": chain((0.05, 0.1, ROD), *REAL[1:], shape=BOX),
    "a camera beside a link": chain(*REAL).replace(
        "</robot>",
        link("eye", inertial(1e-3, (0, 0, 0), (0, 0, 0), SMALL))
        + joint("mount", "l3", "eye", "fixed")
        + "</robot>",
    ),
    "propellers": robot(
        link("l0"),
        *[link(x, inertial(5e-3, (0, 0, 0), (0, 0, 0), SMALL) + BOX) for x in "abc"],
        *[joint(x, "l0", x) for x in "abc"],
    ),
}


def doubts(path):
    """Return the texts of doubts about a file."""
    remarks = jid.load_urdf(path).remarks
    return [x.text for x in remarks if x.status is Status.DOUBTFUL]


@pytest.mark.parametrize(("text", "words"), DOUBTS.values(), ids=DOUBTS)
def test_placeholders_are_doubted_with_the_links_and_a_cure(tmp_path, text, words):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    (doubt,) = [x for x in doubts(path) if "an estimate is pulled" in x]
    assert re.match(words, doubt)
    assert "as placeholders have" in doubt
    assert doubt.endswith("or write `pull = 0` in `[estimator]`.")


@pytest.mark.parametrize("text", CLEAN.values(), ids=CLEAN)
def test_real_links_are_not_doubted(tmp_path, text):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    assert not doubts(path)


MJCF = """<mujoco><worldbody><body name="a"><joint name="a" axis="0 1 0"/>{}
  <body name="b" pos="0.3 0 0"><joint name="b" axis="0 1 0"/>{}
  <body name="c" pos="0.3 0 0"><joint name="c" axis="0 1 0"/>{}</body></body></body>
  </worldbody></mujoco>"""
CAPSULE = '<geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0" {}/>'
BALL = '<geom size="0.1" pos="0.2 0 0" mass="1"/>'


@pytest.mark.parametrize(
    ("geom", "words"),
    [
        (CAPSULE.format(""), ""),
        (BALL, ""),
        (
            '<inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1"/>',
            "joints `a`, `b`, `c`: the moments",
        ),
        (
            '<inertial pos="0 0 0" mass="1e-3" diaginertia="1e-6 1e-6 1e-6"/>',
            "all bodies have the same mass",
        ),
    ],
)
def test_bodies_of_mujoco_are_doubted_alike(tmp_path, geom, words):
    path = tmp_path / "arm.xml"
    path.write_text(MJCF.format(geom, geom, geom))
    assert mujoco.MjModel.from_xml_path(str(path)).nv == 3
    texts = [x for x in doubts(path) if "as placeholders have" in x]
    assert len(texts) == bool(words)
    assert all(text.startswith(words) for text in texts)
