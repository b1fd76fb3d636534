"""Base parameters as text: Eq. 24 as printed, and the numbers of kappa."""

import numpy as np
import pytest
from trees import mixed_tree, random_tree

from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.base_parameter_expressions import Summand, write_expression
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import (
    AsymmetricCoulombFriction,
    ConstantOffset,
    CoulombFriction,
    CoupledDrives,
    RigidBodies,
    RotorInertia,
    ViscousFriction,
)
from jaxid.robot import library
from jaxid.robot.robot import Robot
from jaxid.units.dimensions import length_power

DRIVES = (ViscousFriction(), CoulombFriction(), RotorInertia())
SEVEN, TEN = RigidBodies(principal_axes=True), RigidBodies()
X, Y, Z = UPRIGHT = np.eye(3)


@pytest.fixture(scope="module")
def paper() -> BaseParameters:
    return base_parameters(Model(library.tx90l_on_rail(), (SEVEN, *DRIVES)))


def combinations(base: BaseParameters) -> np.ndarray:
    """The factors of the expressions, from kappa: one row per base parameter."""
    matrix = np.zeros((base.size, base.model.size))
    matrix[:, base.indices] = np.eye(base.size)
    matrix[:, base.dependent] = base.kappa
    return matrix


def evaluated(base: BaseParameters) -> np.ndarray:
    """The factors that a reader finds in the expressions."""
    names = base.model.parameter_names
    unit_vectors = dict(zip(names, np.eye(len(names)), strict=True))
    return np.array([eval(text, {}, unit_vectors) for text in base.expressions])


def test_equation_24_as_printed(paper):
    """The paper's l2x and l3z are both 0.05 m."""
    assert paper.expressions[0] == "m1 + m2 + m3 - 20*mz4 + Ia1"
    assert paper.expressions[1] == "mx2 + 0.05*m3 - mz4"
    assert paper.expressions[26] == "fv1"
    assert paper.expressions[33] == "fc1"
    assert paper.expressions[40:] == ("Ia4", "Ia5", "Ia6", "Ia7")


def test_expressions_do_not_depend_on_the_seed(paper):
    assert base_parameters(paper.model, seed=11).expressions == paper.expressions


def test_moments_move_down_a_planar_arm():
    base = base_parameters(Model(library.planar_arm(3, [0.5, 0.4, 0.3]), (TEN,)))
    assert [e for e in base.expressions if " " in e] == [
        "mx1 + 0.5*(m2 + m3)",
        "C1 + 0.25*(m2 + m3)",
        "mx2 + 0.4*m3",
        "C2 + 0.16*m3",
    ]


def test_an_offset_on_a_lift_counts_as_mass_by_gravity():
    lift = Robot(
        "lift",
        revolute=(False, True, True),
        axis=[Z, Z, Y],
        rotation=[UPRIGHT] * 3,
        offset=[(0.0, 0.0, 0.0), (0.1, 0.0, 0.2), (0.2, 0.0, 0.1)],
        gravity=(0.0, 0.0, -9.80665),
    )
    base = base_parameters(Model(lift, (TEN, *DRIVES, ConstantOffset())))
    assert base.expressions[0] == "m1 + m2 + m3 + 0.101972*fo1"


MODELS = {
    "paper": lambda: Model(library.tx90l_on_rail(), (SEVEN, *DRIVES)),
    "coupled": lambda: Model(library.tx40(), (TEN, *DRIVES, CoupledDrives())),
    "panda": lambda: Model(
        library.panda(), (TEN, AsymmetricCoulombFriction(), ConstantOffset())
    ),
    "tree": lambda: Model(mixed_tree().robot(), (TEN, *DRIVES, ConstantOffset())),
    "skew": lambda: Model(random_tree(0, 5).robot(), (TEN, *DRIVES)),
}


@pytest.mark.parametrize("name", MODELS)
def test_expressions_have_the_numbers_of_kappa(name):
    base = base_parameters(MODELS[name]())
    expected = combinations(base)
    np.testing.assert_allclose(evaluated(base), expected, rtol=1e-5, atol=0)


def test_signs_brackets_and_shared_factors():
    summands = {
        "p1": 1.0,
        "p2": -0.5,
        "p3": 0.5,
        "p4": -1.0,
        "p5": -0.123456789,
        "p6": -0.5,
        "p7": 2.5e-7,
        "p8": 1.0000000001,
    }
    assert write_expression(Summand(*x) for x in summands.items()) == (
        "p1 - 0.5*(p2 - p3 + p6) - p4 - 0.123457*p5 + 2.5e-07*p7 + p8"
    )
    assert write_expression([Summand("p1", -1.0), Summand("p2", 3.0)]) == "-p1 + 3*p2"


@pytest.mark.parametrize(
    ("unit", "power"),
    [("kg", 0), ("kg m²", 2), ("N m s/rad", 2), ("N/(m s)", 0), ("A/furlong", 0)],
)
def test_powers_of_length_in_units(unit, power):
    assert length_power(unit) == power
