"""Designed motions are checked against floor and self-collision, or it is said what was not."""

import types

import numpy as np
import pytest
from jaxid.experiment.collision_check import collision_remarks

import jaxid as jid
from jaxid.experiment.experiment import load_experiment
from jaxid.result_table import Status

LINK = """<link name="{name}"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"
 ixy="0" ixz="0" iyz="0"/></inertial>{shape}</link>"""
SHAPE = """<collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.04" length="0.3"/>
</geometry></collision>"""
JOINT = """<joint name="j{k}" type="revolute"><parent link="l{p}"/><child link="l{k}"/>
<origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-3.1" upper="3.1" velocity="2" effort="9"/>
</joint>"""


@pytest.fixture
def experiment(tmp_path):
    def write(shape=SHAPE, table="", robot=""):
        links = "".join(LINK.format(name=f"l{k}", shape=shape if k else "") for k in range(4))
        joints = "".join(JOINT.format(k=k, p=k - 1) for k in range(1, 4))
        (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
        (tmp_path / "e.toml").write_text(f'[robot]\nurdf = "arm.urdf"\n{robot}\n{table}')
        return load_experiment(tmp_path / "e.toml")

    return write


def swing(*ends):
    """A motion from the upright pose to some angles."""
    ends = np.array(ends)
    return types.SimpleNamespace(
        duration=2.0, motion=lambda t: jid.Motion(*([np.outer(t / 2.0, ends)] * 3))
    )


def said(experiment, motion):
    return [(remark.status, remark.text) for remark in collision_remarks(experiment, motion)]


def test_a_motion_that_keeps_clear_is_said_to(experiment):
    ((status, text),) = said(experiment(), swing(0.3, 0.3, 0.3))
    assert status is Status.NEUTRAL
    assert "capsules" in text
    assert "keep" in text


def test_floor_and_own_bodies_are_found(experiment):
    # At 2.6 rad the end of the chain, 1.2 m above the first joint when upright, is far below it.
    ((status, text),) = said(experiment(), swing(2.6, 0.0, 0.0))
    assert status is Status.BAD
    assert "l3 and the floor overlap by" in text
    assert "at 2.00 s" in text
    ((status, text),) = said(experiment(), swing(0.0, 2.6, 2.6))
    assert status is Status.BAD
    assert "l1 and l3 overlap" in text


def test_what_was_not_checked_is_said(experiment):
    (first, second) = said(experiment(shape=""), swing(2.6, 0.0, 0.0))
    assert first[0] is second[0] is Status.BAD
    assert "self-collision was not checked (" in first[1]
    depth = 100 * -(0.4 + 0.8 * np.cos(2.6))
    assert f"the lowest joint and the floor overlap by {depth:.1f} cm" in second[1]
    hanging = experiment(robot="base_rotation = [180, 0, 0]")
    assert "no floor was checked" in said(hanging, swing(0.1, 0.1, 0.1))[0][1]
    apart = experiment(table="[collision]\nfit = true\n")
    assert "no floor and no obstacle" in said(apart, swing(0.1, 0.1, 0.1))[0][1]
    assert said(experiment(table="[collision]\nfit = true\nground = 0.0\n"), swing(0.1, 0, 0)) == []
