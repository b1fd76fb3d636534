import json
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
import pytest
from forward_kinematics import (
    about,
    body_transforms,
    dh_frames,
    random_configuration,
    tip_transform,
    urdf_chain,
)

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import (
    CoulombFriction,
    RigidBodies,
    RotorInertia,
    ViscousFriction,
)
from jaxid.robot import library
from jaxid.robot.urdf import load_urdf

SHARE = (
    "cmeel.prefix/share/example-robot-data/robots/ur_description/urdf/ur10_robot.urdf"
)
RAIL = library.tx90l_on_rail()


@pytest.fixture(scope="module")
def facts(shared_data):
    return json.loads((shared_data / "robots.json").read_text())


def test_rail_robot_is_the_published_chain_on_a_rail(facts):
    q, arm, limits = random_configuration(RAIL, 0), facts["tx90l"], RAIL.limits
    rows = [("prismatic", [0, 0, 0], [1, 0, 0]), *arm["rows"]]
    expected, ours = urdf_chain(rows, q), body_transforms(RAIL, q)
    np.testing.assert_allclose(ours[:, :3, 3], expected[:, :3, 3], atol=1e-14)
    turned = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for i in range(7):
        attitude = expected[i, :3, :3] @ (turned if i in (2, 3, 5) else np.eye(3))
        np.testing.assert_allclose(ours[i, :3, :3], attitude, atol=1e-14)
    assert np.array_equal(RAIL.axis[1:], np.tile([0.0, 0.0, 1.0], (6, 1)))
    assert set(np.abs(RAIL.rotation).ravel()) == {0.0, 1.0}
    np.testing.assert_allclose(limits.position_min[1:], np.deg2rad(arm["q_min_deg"]))
    np.testing.assert_allclose(limits.position_max[1:], np.deg2rad(arm["q_max_deg"]))
    np.testing.assert_allclose(limits.velocity[1:], np.deg2rad(arm["qd_max_deg"]))
    assert limits.force.tolist() == [3000.0, *arm["tau_max"]]


def test_rail_robot_has_the_papers_base_parameters():
    """44 of 70, and the regrouping of Eq. 24: a test of the frames behind its form."""
    terms = (
        RigidBodies(principal_axes=True),
        ViscousFriction(),
        CoulombFriction(),
        RotorInertia(),
    )
    base = base_parameters(Model(RAIL, terms))
    names = base.model.parameter_names
    assert len(names) == 70
    assert base.size == 44
    regrouped = [
        {names[d]: k for d, k in zip(base.dependent, row, strict=True) if abs(k) > 1e-9}
        for row in base.kappa[:2]
    ]
    assert base.names[:2] == ("m1", "mx2")
    assert regrouped[0] == pytest.approx(
        {"m2": 1.0, "m3": 1.0, "mz4": -20.0, "Ia1": 1.0}
    )
    assert regrouped[1] == pytest.approx({"m3": 0.05, "mz4": -1.0})


@pytest.mark.parametrize("name", ["panda", "ur10", "ur10e"])
def test_arms_from_tables_are_their_tables(facts, name):
    robot = getattr(library, name)()
    q = random_configuration(robot, 0)
    expected = dh_frames(facts[name]["rows"], q, facts[name]["convention"].split()[0])[
        -1
    ]
    expected[:3, 3] += facts[name].get("flange_d", 0.0) * expected[:3, 2]
    np.testing.assert_allclose(tip_transform(robot, q), expected, atol=1e-13)


@pytest.mark.parametrize("name", ["panda", "ur10e", "lbr_iiwa14"])
def test_published_limits(facts, name):
    published = facts[name]
    limits = getattr(library, name.removeprefix("lbr_"))().limits
    speed = published.get("qd_max", np.deg2rad(published.get("qd_max_deg", [])))
    np.testing.assert_allclose(limits.velocity, speed)
    for key, ours in (
        ("q_max", limits.position_max),
        ("q_min", limits.position_min),
        ("qdd_max", limits.acceleration),
        ("jerk_max", limits.jerk),
        ("tau_max", limits.force),
    ):
        if key in published:
            np.testing.assert_allclose(ours, published[key])


def test_ur10_has_the_limits_of_its_urdf():
    urdf = load_urdf(Path(str(distribution("example-robot-data").locate_file(SHARE))))
    for field in ("position_min", "position_max", "velocity", "force"):
        ours, expected = (getattr(x.limits, field) for x in (library.ur10(), urdf))
        np.testing.assert_allclose(ours, expected, rtol=1e-11)


def test_iiwa_is_its_chain(facts):
    robot = library.iiwa14()
    q = random_configuration(robot, 0)
    expected = urdf_chain(facts["lbr_iiwa14"]["rows"], q)
    np.testing.assert_allclose(body_transforms(robot, q), expected, atol=1e-14)
    tip = expected[-1, :3, 3] + facts["lbr_iiwa14"]["tool_z"] * expected[-1, :3, 2]
    np.testing.assert_allclose(tip_transform(robot, q)[:3, 3], tip, atol=1e-14)


def test_kr300_takes_the_recorded_angles_as_they_are(facts):
    robot = library.kr300()
    q = random_configuration(robot, 0)
    model_q = q + np.deg2rad([0.0, -90.0, 90.0, 0.0, 0.0, 0.0])
    frames = about([1.0, 0.0, 0.0], np.pi) @ dh_frames(
        facts["kr300"]["rows"], model_q, "standard"
    )
    np.testing.assert_allclose(tip_transform(robot, q), frames[-1], atol=1e-13)
    assert np.diag(robot.drives.reduction).tolist() == facts["kr300"]["gear"]
    assert not robot.drives.zero.any()


def test_tx40_and_its_drives_are_those_of_the_data(shared_data, facts):
    robot, published = library.tx40(), facts["tx40"]
    urdf = load_urdf(
        shared_data / "tx40" / "tx40_mdh_modified.urdf", tip="link_6"
    ).snapped()
    q = random_configuration(robot, 0)
    np.testing.assert_allclose(
        body_transforms(robot, q), body_transforms(urdf, q), atol=1e-13
    )
    assert robot.limits.force.tolist() == urdf.limits.force.tolist()
    # The manufacturer's angles with the table's theta give the same arm as the drives'
    # angles.
    A = np.diag(np.array(published["gear"], dtype=float))
    A[5, 4] = 32.0
    file = shared_data / "tx40" / "motor_position.csv"
    motor = np.loadtxt(file, delimiter=",", skiprows=1, max_rows=20000)[::500]
    q = robot.drives.joint_angles(motor)
    assert ((q > robot.limits.position_min) & (q < robot.limits.position_max)).all()
    with_theta = dh_frames(published["rows"], np.linalg.solve(A, motor[7]), "modified")[
        -1
    ]
    with_theta[2, 3] += published["base_z"]
    np.testing.assert_allclose(tip_transform(robot, q[7]), with_theta, atol=1e-12)


@pytest.mark.parametrize(("joints", "length"), [(1, 0.7), (3, (0.5, 0.4, 0.3))])
def test_planar_arm_is_a_chain_of_angles_in_a_vertical_plane(joints, length):
    robot = library.planar_arm(joints, length)
    q = random_configuration(robot, 0)
    angles = np.cumsum(q)
    lengths = np.broadcast_to(length, joints)
    expected = [lengths @ np.cos(angles), lengths @ np.sin(angles), 0.0]
    np.testing.assert_allclose(tip_transform(robot, q)[:3, 3], expected, atol=1e-14)
    assert robot.gravity.tolist() == [0.0, -9.81, 0.0]
