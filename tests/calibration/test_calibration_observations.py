"""The family of observations: each kind finds an arm that Pinocchio moves."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="Pinocchio is not installed")

from true_arm import TrueArm, random_poses, true_origins

import jaxid as jid
from jaxid.calibration.problem import build_problem

c = jid.calibration
TOOL = np.array([0.03, -0.02, 0.12])
SESSIONS = 4
POSES = 24


@pytest.fixture(scope="module")
def robot():
    return jid.robots.panda()


@pytest.fixture(scope="module")
def arm(robot):
    return TrueArm(robot, true_origins(robot))


def random_frame(rng):
    matrix = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return matrix * np.array([1.0, 1.0, np.linalg.det(matrix)]), rng.normal(size=3)


def point_contact(arm, robot, number, rng):
    q = random_poses(robot, POSES, number)
    point = arm.placement(q[0], TOOL)[1]
    q = arm.touching(
        q[:1] + rng.uniform(-0.7, 0.7, q.shape), TOOL, np.tile(point, (POSES, 1))
    )
    return c.PointContact(f"s{number}", q)


def known_distance(arm, robot, number, rng):
    q = random_poses(robot, POSES, number)
    points = arm.placements(q, TOOL)[1]
    distances = np.linalg.norm(points - rng.normal(size=3), axis=1)
    return c.KnownDistance(f"s{number}", q, distance=distances)


def measured_position(arm, robot, number, rng):
    q = random_poses(robot, POSES, number)
    rotation, position = random_frame(rng)
    points = (arm.placements(q, TOOL)[1] - position) @ rotation
    return c.MeasuredPosition(f"s{number}", q, positions=points)


def measured_pose(arm, robot, number, rng):
    """A camera on the robot sees a board."""
    q = random_poses(robot, POSES, number)
    board_rotation, board_position = random_frame(rng)
    rotations, positions = arm.placements(q, TOOL)
    boards = np.swapaxes(rotations, 1, 2) @ board_rotation
    seen = np.einsum("pji,pj->pi", rotations, board_position - positions)
    return c.MeasuredPose.eye_in_hand(f"s{number}", q, rotations=boards, positions=seen)


def plane_contact(arm, robot, number, rng):
    q = random_poses(robot, POSES, number)
    rotation, position = random_frame(rng)
    position = arm.placement(q[0], TOOL)[1]
    points = arm.placements(q, TOOL)[1]
    heights = (points - position) @ rotation[:, 2]
    q = arm.touching(q, TOOL, points - np.outer(heights, rotation[:, 2]))
    is_reached = np.abs((arm.placements(q, TOOL)[1] - position) @ rotation[:, 2]) < 1e-6
    return c.PlaneContact(f"s{number}", q[is_reached])


SIMULATED = {
    "point_contact": point_contact,
    "known_distance": known_distance,
    "measured_position": measured_position,
    "measured_pose": measured_pose,
    "plane_contact": plane_contact,
}


def test_every_kind_is_simulated():
    assert SIMULATED.keys() == c.OBSERVATIONS.keys()


@pytest.fixture(scope="module", params=SIMULATED)
def observations(request, robot, arm):
    rng = np.random.default_rng(0)
    simulate = SIMULATED[request.param]
    return [simulate(arm, robot, number, rng) for number in range(SESSIONS)]


def test_a_kind_finds_the_arm(observations, robot):
    """Without noise, errors vanish, and become small in sessions that are held out."""
    fit = jid.calibrate(robot, observations, compliance=False)
    assert fit.solution.adjustment.has_converged
    assert fit.mean_error(fit.errors) < 5e-5
    held_out = fit.mean_error(fit.held_out.calibrated)
    assert held_out < 0.3 * fit.mean_error(fit.held_out.nominal)


def test_derivatives_are_those_of_differences(observations, robot):
    problem = build_problem(robot, observations[:2], np.ones((7, 10)))
    rng = np.random.default_rng(1)
    scales = problem.nominal._replace(
        origins=np.full((7, 6), 1e-2),
        compliances=np.full(7, 1e-4),
        frames=0.1 * problem.freedoms,
    ).vector
    vector = scales * rng.normal(size=len(scales))
    jacobian = problem.linearise(vector).jacobian
    for column in np.flatnonzero(scales):
        step = np.zeros(len(vector))
        step[column] = 1e-3 * scales[column]
        upper = problem.linearise(vector + step).errors
        lower = problem.linearise(vector - step).errors
        difference = (upper - lower) / (2 * step[column])
        size = np.abs(jacobian[..., column]).max()
        assert jacobian[..., column] == pytest.approx(
            difference, abs=1e-5 * size + 1e-6
        )


def test_derivatives_of_a_tree_with_a_rail_and_a_follower():
    """Prismatic joints, followers, and bodies beside the chain to the end-effector."""
    rng = np.random.default_rng(2)
    rotations = np.stack([random_frame(rng)[0] for _ in range(5)])
    robot = jid.Robot(
        "tree",
        revolute=(False, True, True, True),
        parent=(-1, 0, 1, 1, 2),
        followers=(jid.robots.Follower("copy", revolute=True, leader=1, factor=-0.5),),
        axis=rng.normal(size=(5, 3)),
        rotation=rotations,
        offset=0.3 * rng.normal(size=(5, 3)),
        tip_body=4,
        tip_offset=(0.1, 0.2, 0.3),
    )
    q = rng.uniform(-1, 1, (12, 4))
    observation = c.MeasuredPosition("s", q, positions=rng.normal(size=(12, 3)))
    problem = build_problem(robot, [observation], np.ones((5, 10)))
    vector = problem.nominal._replace(
        origins=1e-2 * rng.normal(size=(5, 6)), compliances=1e-4 * rng.normal(size=4)
    ).vector
    jacobian = problem.linearise(vector).jacobian
    for column in range(34):
        step = np.zeros(len(vector))
        step[column] = 1e-5
        upper = problem.linearise(vector + step).errors
        lower = problem.linearise(vector - step).errors
        difference = (upper - lower) / 2e-5
        size = np.abs(jacobian[..., column]).max()
        assert jacobian[..., column] == pytest.approx(
            difference, abs=1e-5 * size + 1e-5
        )
    # The body beside the chain does not move the end-effector.
    assert not jacobian[..., 18:24].any()


def with_sign(x):
    return dataclasses.replace(x, q=x.q * np.array([1, 1, 1, -1, 1, 1, 1]))


def swapped(x):
    return dataclasses.replace(x, q=x.q[:, [0, 2, 1, 3, 4, 5, 6]])


def in_millimetres(x):
    return dataclasses.replace(x, positions=1e3 * x.positions)


def other_way_round(x):
    pose = x.measured.inverse
    return dataclasses.replace(x, rotations=pose.rotation, positions=pose.position)


@pytest.mark.parametrize(
    ("kind", "mistake", "words"),
    [
        ("point_contact", with_sign, "the other sign of `joint4`"),
        ("plane_contact", swapped, "`joint2` and `joint3` swapped"),
        ("measured_position", in_millimetres, "1,000 times smaller .`length_unit"),
        ("measured_pose", other_way_round, "`eye_in_hand`"),
        ("measured_position", lambda x: dataclasses.replace(x, q=x.q[::-1]), "zeros"),
    ],
)
def test_mistakes_are_named(robot, arm, kind, mistake, words):
    """Calibration is refused, and says what was probably wrong."""
    rng = np.random.default_rng(0)
    observations = [SIMULATED[kind](arm, robot, k, rng) for k in range(2)]
    assert jid.calibrate(robot, observations, compliance=False)
    with pytest.raises(jid.InputError, match=f"not poses of `Panda`.*{words}"):
        jid.calibrate(robot, [mistake(x) for x in observations], compliance=False)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("q", {"q": np.zeros(7)}),
        ("q", {"q": np.full((3, 7), np.nan)}),
        ("positions", {"positions": np.zeros((4, 3))}),
        ("deviation", {"deviation": 0.0}),
    ],
)
def test_wrong_observations_are_refused(name, arguments):
    fields = {"q": np.zeros((3, 7)), "positions": np.zeros((3, 3))} | arguments
    with pytest.raises(jid.InputError, match=f"`{name}`"):
        c.MeasuredPosition("s", **fields)


def test_attitudes_must_be_rotations():
    with pytest.raises(jid.InputError, match="`rotations`"):
        c.MeasuredPose(
            "s",
            np.zeros((2, 7)),
            rotations=np.ones((2, 3, 3)),
            positions=np.ones((2, 3)),
        )


def test_wrong_calibrations_are_refused(robot):
    with pytest.raises(jid.InputError, match="`observations`"):
        jid.calibrate(robot, [])
    with pytest.raises(jid.InputError, match="`q`"):
        jid.calibrate(robot, [c.PointContact("s", np.zeros((3, 6)))])
    with pytest.raises(jid.InputError, match="`bodies`"):
        jid.calibrate(
            robot, [c.PointContact("s", np.zeros((3, 7)))], bodies=np.ones(20)
        )
    degrees = np.linspace(np.zeros(7), np.full(7, -60.0), 9)
    with pytest.raises(jid.InputError, match="radians"):
        jid.calibrate(robot, [c.PointContact("s", degrees)])
    # Two places of one pose each: 7 numbers for 9 unknown ones.
    few = [c.PointContact("s", np.zeros((1, 7)), place=place) for place in "ab"]
    distance = c.SocketDistance("s", place="a", other_place="b", distance=0.05)
    with pytest.raises(jid.InputError, match="`observations`"):
        jid.calibrate(robot, [*few, distance])
