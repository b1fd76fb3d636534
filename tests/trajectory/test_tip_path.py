"""The verification path and how joints follow it."""

import jax
import numpy as np
import pytest

from jaxid.excitation.constraints import tip_motion
from jaxid.robot import library
from jaxid.robot.forward_kinematics import tip_placement
from jaxid.trajectory.prescribed_tip_path import iso9283_path, joint_path

ROBOT = library.tx90l_on_rail()
DOWN = np.diag([1.0, -1.0, -1.0])
BENT = [0.0, 1.57, 0.3, 1.6, 0.0, 0.5, 0.0]
PATH = iso9283_path([0.0, 0.65, 0.65], 0.5, DOWN, acceleration=3.0)


@pytest.fixture(scope="module")
def followed():
    return joint_path(ROBOT, PATH, posture=BENT)


def test_the_path_lies_on_one_inclined_plane_within_the_cube():
    places = PATH.positions(np.linspace(0.0, PATH.duration, 2000))
    away = places - [0.0, 0.65, 0.65]
    assert np.abs(away).max() < 0.25
    np.testing.assert_allclose(away[:, 0], away[:, 2], atol=1e-12)
    # Corners a tenth of the diagonal inside; circles of 80 % of the edge and of a tenth
    # of that.
    np.testing.assert_allclose(np.abs(away).max(axis=0), 0.2, atol=1e-6)
    radii = [piece.radius for piece in PATH.pieces if np.isfinite(piece.radius)]
    assert radii == pytest.approx([0.2, 0.02])
    np.testing.assert_allclose(places[0], places[-1], atol=1e-12)


def test_speed_and_acceleration_of_the_tip_stay_within_what_was_asked(followed):
    times, motion = followed.sample(1e-3)
    position, velocity, acceleration = tip_motion(ROBOT, motion)
    np.testing.assert_allclose(position, PATH.positions(times), atol=1e-9)
    speed = np.linalg.norm(velocity, axis=1)
    assert 0.99 < speed.max() <= 1.0 + 1e-6
    along = np.einsum("ki,ki->k", velocity, acceleration)[speed > 0.05]
    along = np.abs(along) / speed[speed > 0.05]
    assert 2.9 < along.max() <= 3.0 + 1e-6
    still = followed.motion(np.cumsum(PATH.durations)[:-1])
    np.testing.assert_allclose(still.qd, 0.0, atol=1e-9)
    np.testing.assert_allclose(still.qdd, 0.0, atol=1e-7)


def test_the_attitude_is_held_and_the_joints_stay_within_their_limits(followed):
    _, motion = followed.sample(0.02)
    R, _ = jax.vmap(lambda q: tip_placement(ROBOT, q))(motion.q)
    np.testing.assert_allclose(R, np.broadcast_to(DOWN, R.shape), atol=1e-9)
    limits = ROBOT.limits
    assert ((motion.q >= limits.position_min) & (motion.q <= limits.position_max)).all()
    assert (np.abs(motion.qd) <= limits.velocity).all()
    assert (np.abs(motion.qdd) <= limits.acceleration).all()
    fast = iso9283_path([0.0, 0.65, 0.65], 0.5, DOWN, speed=3.0, acceleration=40.0)
    with pytest.raises(
        ValueError, match=r"joint `\w+` would need .* times its largest"
    ):
        joint_path(ROBOT, fast, posture=BENT)
