"""A contact is told by the height at which the robot stops, not by large errors."""

import functools

import mujoco
import numpy as np
import pytest

import jaxid as jid
from jaxid.rollout.contact_evidence import contact_findings, find_table

LENGTHS = (0.16, 0.14)
TABLE_HEIGHT = 0.08
TIP_RADIUS = 0.01
ARM = """<mujoco><compiler angle="radian"/>
<option timestep="0.001" integrator="implicitfast"/><worldbody>
<geom type="plane" pos="0 0 {table}" size="2 2 0.1"/>
<body pos="0 0 0.25"><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
<joint axis="0 0 1" armature="0.05" damping="0.9"/>
<body><inertial pos="0.08 0 0" mass="{mass}" diaginertia="0.001 0.001 0.001"/>
<joint axis="0 1 0" armature="0.05" damping="0.9"/>
<body pos="0.16 0 0"><inertial pos="0.07 0 0" mass="{mass}"
 diaginertia="0.001 0.001 0.001"/>
<joint axis="0 1 0" armature="0.05" damping="0.9"/>
<geom type="sphere" pos="0.14 0 0" size="0.01" mass="0"/>
</body></body></body></worldbody></mujoco>"""
ROBOT = jid.Robot(
    "arm",
    revolute=(True, True, True),
    axis=[(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)],
    rotation=np.tile(np.eye(3), (3, 1, 1)),
    offset=[(0.0, 0.0, 0.25), (0.0, 0.0, 0.0), (LENGTHS[0], 0.0, 0.0)],
    tip_offset=(LENGTHS[1], 0.0, 0.0),
)
TIME = 0.02 * np.arange(600)


@functools.cache
def motion(table=-1.0, mass=0.3, max_torque=100.0, stuck_joint=None):
    """Return positions of the arm on MuJoCo behind its servos [joints, samples]."""
    model = mujoco.MjModel.from_xml_string(ARM.format(table=table, mass=mass))
    data = mujoco.MjData(model)
    data.qpos[:] = commands()[:, 0]
    positions = np.zeros((3, len(TIME)))
    for k in range(len(TIME)):
        positions[:, k] = data.qpos
        is_stuck = stuck_joint is not None and 200 <= k < 400
        if stuck_joint is not None:
            model.dof_frictionloss[stuck_joint] = 1e3 if is_stuck else 0.0
        for _ in range(20):
            torques = 15.0 * (commands()[:, k] - data.qpos)
            data.qfrc_applied[:] = np.clip(torques, -max_torque, max_torque)
            mujoco.mj_step(model, data)
    return positions


@functools.cache
def commands():
    """Return commands whose lowest point is reached again and again."""
    phases = 2 * np.pi * np.outer((0.3, 0.25, 0.5), TIME)
    return np.array([0.0, 0.4, 0.2])[:, None] - 0.3 * np.cos(phases)


def errors_of(measured, simulated):
    """Return errors of one motion."""
    names = ("turn", "lift", "elbow")
    counted = np.ones_like(measured)
    columns = [(x,) for x in (TIME, measured, simulated, counted)]
    baselines = {"command": (commands(),)}
    return jid.rollout.RolloutErrors(names, ("log",), *columns, baselines)


def test_a_table_is_found_at_its_height():
    errors = errors_of(motion(TABLE_HEIGHT), motion(mass=0.33))
    table = find_table(ROBOT, errors)
    assert table is not None
    assert table.point == "the end-effector"
    np.testing.assert_allclose(table.height, TABLE_HEIGHT + TIP_RADIUS, atol=0.003)
    # The error begins where the simulation passes the table.
    size = np.abs(errors.simulated[0] - errors.measured[0]).max(axis=0)
    assert np.median(size[table.below]) > 5 * np.median(size[~table.below])
    (finding,) = contact_findings(ROBOT, errors)
    assert "support the end-effector at a height of 0.09" in finding.text


@pytest.mark.parametrize(
    "measured",
    [{"mass": 0.6}, {"mass": 0.1}, {"max_torque": 1.0}, {"stuck_joint": 1}],
    ids=["too heavy", "too light", "saturation", "a joint that sticks"],
)
def test_errors_of_the_model_are_no_contact(measured):
    errors = errors_of(motion(**measured), motion())
    assert errors.total().max() > 0.01
    assert contact_findings(ROBOT, errors) == []
    assert find_table(ROBOT, errors) is None


def test_without_gravity_there_is_no_table():
    robot = jid.Robot(
        "slide",
        revolute=(True, True, True),
        axis=ROBOT.axis,
        rotation=ROBOT.rotation,
        offset=ROBOT.offset,
        gravity=(0.0, 0.0, 0.0),
    )
    errors = errors_of(motion(TABLE_HEIGHT), motion())
    assert contact_findings(robot, errors) == []
