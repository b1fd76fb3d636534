"""What the room does not take, and the sentences that it says then."""

import numpy as np
import pytest
import trees

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.dispatch import on_samples
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import (
    CoulombFriction,
    CoupledDrives,
    HardSign,
    LinearSpring,
    RigidBodies,
    StribeckFriction,
    Tanh,
    ViscousFriction,
)
from jaxid.robot import library as robots
from jaxid.robot.drives import Drives

TREE = trees.mixed_tree(51)
MODEL = Model(TREE.robot())


def _refused(sentence):
    return pytest.raises(ValueError, match="^" + sentence)


def test_model_without_terms():
    with _refused("`terms` must hold at least one term, but is empty"):
        Model(TREE.robot(), ())


def test_the_same_term_twice():
    with _refused("`terms` must not contribute the same parameter twice, but `fv1` comes twice"):
        Model(TREE.robot(), (RigidBodies(), ViscousFriction(), ViscousFriction()))


@pytest.mark.parametrize("size", [64, 66])
def test_wrong_number_of_parameters(size):
    motion = Motion(*np.zeros((3, 2, 5)))
    sentence = (
        rf"`p` must hold one number for each standard parameter \(65\), but has shape \({size},\)"
    )
    for refused in (
        lambda p: MODEL.inverse_dynamics(p, motion),
        lambda p: MODEL.mass_matrix(p, motion.q),
        lambda p: MODEL.bias_forces(p, motion.q, motion.qd),
        lambda p: MODEL.kinetic_energy(p, motion.q, motion.qd),
        lambda p: MODEL.potential_energy(p, motion.q),
    ):
        with _refused(sentence):
            refused(np.zeros(size))


@pytest.mark.parametrize("shape", [(4,), (5, 6), (2, 3, 1)])
def test_motion_of_another_robot(shape):
    motion, p = Motion(*np.zeros((3, *shape))), np.zeros(65)
    for refused in (
        lambda: MODEL.regressor(motion),
        lambda: MODEL.inverse_dynamics(p, motion),
        lambda: MODEL.mass_matrix(p, motion.q),
        lambda: MODEL.bias_forces(p, motion.q, motion.qd),
        lambda: MODEL.potential_energy(p, motion.q),
        lambda: MODEL.tool_forces(motion),
    ):
        with _refused("`motion` must have one coordinate") as caught:
            refused()
        assert str(shape) in str(caught.value)


def test_coupled_drives_of_independent_drives():
    with _refused("the drives of `tree` are not coupled: leave `CoupledDrives` out"):
        Model(TREE.robot(), (RigidBodies(), CoupledDrives()))


@pytest.mark.parametrize("epsilon", [0.0, -0.01, np.array([0.01, 0.0, 0.01])])
def test_transition_without_width(epsilon):
    with _refused("`epsilon` must be a positive speed, but is .*: use `HardSign`"):
        CoulombFriction(Tanh(epsilon))


def test_velocities_of_other_instants():
    q = np.zeros((3, 5))
    sentence = r"coordinates, velocities and accelerations must have one shape, but have \(3, 5\)"
    with _refused(sentence + r", \(2, 5\), \(3, 5\)"):
        on_samples(MODEL, MODEL.columns, q, q[:2], q)


def test_motors_in_another_order_than_their_joints():
    robot = robots.planar_arm(2).replace(drives=Drives(2, reduction=[[0, 50], [40, 10]]))
    with _refused("`drives.reduction` of `planar arm, 2 joints` must name the motors in the order"):
        Model(robot, (CoupledDrives(),))


def test_parameters_as_a_list():
    p, motion = list(np.linspace(1.0, 2.0, 65)), Motion(*np.ones((3, 2, 5)))
    expected = MODEL.inverse_dynamics(np.array(p), motion)
    np.testing.assert_array_equal(MODEL.inverse_dynamics(p, motion), expected)
    as_lists = Motion(*([[1.0] * 5] * 2 for _ in range(3)))
    np.testing.assert_array_equal(MODEL.inverse_dynamics(p, as_lists), expected)
    q = [1.0] * 5
    np.testing.assert_array_equal(
        MODEL.mass_matrix(p, q), MODEL.mass_matrix(np.array(p), np.ones(5))
    )
    with _refused(r"`p` must hold one number for each standard parameter \(65\), but has shape"):
        MODEL.inverse_dynamics(p[:-1], motion)


@pytest.mark.parametrize("p", [[1.0, "heavy"], [[1.0, 2.0], [3.0]]])
def test_parameters_that_are_no_numbers(p):
    with _refused("`p` must be an array of numbers, but is "):
        on_samples(MODEL, MODEL.inertia, np.zeros(5), shared=(p,))


def test_wrong_number_of_base_parameters():
    base = base_parameters(Model(robots.planar_arm(2), (ViscousFriction(),)))
    motion = Motion(*np.zeros((3, 2)))
    for refused in (
        lambda p: base.inverse_dynamics(p, motion),
        lambda p: base.mass_matrix(p, motion.q),
        lambda p: base.to_standard(p),
    ):
        with _refused(
            r"`p` must hold one number for each base parameter \(2\) along its last axis"
        ):
            refused(np.zeros(3))
    with _refused(r"`p` must hold one number for each standard parameter \(2\) along its last"):
        base.from_standard([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("term", "name"),
    [
        (CoulombFriction(Tanh((0.01, 0.02, 0.03))), "epsilon"),
        (CoulombFriction(Tanh(dead_zone=[0.01, 0.02, 0.03])), "dead_zone"),
        (CoulombFriction(HardSign((0.01, 0.02, 0.03))), "dead_zone"),
        (StribeckFriction(speed=(0.1, 0.1, 0.1)), "speed"),
        (StribeckFriction(exponent=(1.0, 1.0, 1.0)), "exponent"),
        (LinearSpring((0.0, 0.0, 0.1)), "rest"),
    ],
)
def test_numbers_of_another_robot(term, name):
    motion = Motion(*np.ones((3, 4, 2)))
    model = Model(robots.planar_arm(2), (term,))
    with _refused(rf"`{name}` must be one number for all joints or one for each \(2\), but has sh"):
        model.regressor(motion)
