"""Invalid input of models, terms and base parameters is rejected by argument name."""

import numpy as np
import pytest
import trees

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import (
    CoulombFriction,
    CoupledDrives,
    LinearSpring,
    RigidBodies,
    StribeckFriction,
    Tanh,
    ViscousFriction,
)
from jaxid.errors import InputError
from jaxid.program.sample_methods import on_samples
from jaxid.robot import library as robots
from jaxid.robot.limits_and_drives import Drives

TREE = trees.mixed_tree(51)
MODEL = Model(TREE.robot())
ARM = robots.planar_arm(2)
BASE = base_parameters(Model(ARM, (ViscousFriction(),)))
P = np.zeros(65)
ARM_MOTION = Motion(*np.ones((3, 4, 2)))
SWAPPED = ARM.replace(drives=Drives(2, reduction=[[0, 50], [40, 10]]))


def still(shape):
    return Motion(*np.zeros((3, *shape)))


def methods(p, motion):
    """Every method of a model on parameters and a motion."""
    q, qd = motion.q, motion.qd
    return (
        lambda: MODEL.inverse_dynamics(p, motion),
        lambda: MODEL.mass_matrix(p, q),
        lambda: MODEL.bias_forces(p, q, qd),
        lambda: MODEL.forward_dynamics(p, q, qd, q),
        lambda: MODEL.kinetic_energy(p, q, qd),
        lambda: MODEL.potential_energy(p, q),
    )


def of_numbers_for_another_robot():
    three = (0.1, 0.2, 0.3)
    for term, name in (
        (CoulombFriction(Tanh(three)), "epsilon"),
        (StribeckFriction(speed=three), "speed"),
        (StribeckFriction(exponent=three), "exponent"),
        (LinearSpring(three), "rest"),
    ):
        yield lambda term=term: Model(ARM, (term,)).regressor(ARM_MOTION), name


REFUSED = [
    (lambda: Model(TREE.robot(), ()), "terms"),
    (lambda: Model(TREE.robot(), (ViscousFriction(), ViscousFriction())), "fv1"),
    *((x, "p") for size in (64,) for x in methods(np.zeros(size), still((2, 5)))),
    *((x, "motion") for s in ((5, 6),) for x in methods(P, still(s))),
    (lambda: MODEL.regressor(still((4,))), "motion"),
    (lambda: MODEL.tool_forces(still((4,))), "motion"),
    (lambda: Model(TREE.robot(), (RigidBodies(), CoupledDrives())), "CoupledDrives"),
    (lambda: Model(SWAPPED, (CoupledDrives(),)), "drives.reduction"),
    *((lambda e=e: Tanh(e), "epsilon") for e in (0.0, -0.01, np.array([0.01, 0.0]))),
    *((lambda p=p: on_samples(MODEL, MODEL.inertia, np.zeros(5), shared=(p,)), "p")
      for p in ([1.0, "heavy"], [[1.0, 2.0], [3.0]])),
    (lambda: BASE.inverse_dynamics(np.zeros(3), ARM_MOTION), "p"),
    (lambda: BASE.mass_matrix(np.zeros(3), ARM_MOTION.q), "p"),
    (lambda: BASE.to_standard(np.zeros(3)), "p"),
    (lambda: BASE.from_standard([1.0, 2.0, 3.0]), "p"),
    *of_numbers_for_another_robot(),
]  # fmt: skip


@pytest.mark.parametrize(("call", "name"), REFUSED)
def test_invalid_input_is_rejected_by_name(call, name):
    with pytest.raises(InputError, match=f"`{name}`"):
        call()


def test_instants_that_do_not_match():
    q = np.zeros((3, 5))
    with pytest.raises(
        InputError, match=r"fit each other, .* \(3, 5\), \(2, 5\), \(3, 5\)"
    ):
        on_samples(MODEL, MODEL.columns, q, q[:2], q)


def test_lists_are_arrays():
    p, motion = list(np.linspace(1.0, 2.0, 65)), Motion(*np.ones((3, 2, 5)))
    expected = MODEL.inverse_dynamics(np.array(p), motion)
    as_lists = Motion(*([[1.0] * 5] * 2 for _ in range(3)))
    np.testing.assert_array_equal(MODEL.inverse_dynamics(p, as_lists), expected)
    q = [1.0] * 5
    np.testing.assert_array_equal(
        MODEL.mass_matrix(p, q), MODEL.mass_matrix(p, np.ones(5))
    )
