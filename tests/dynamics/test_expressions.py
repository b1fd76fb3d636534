"""Base parameters in letters: Eq. 24 as printed, and right for other lengths."""

import math
from fractions import Fraction

import numpy as np
import pytest
from trees import mixed_tree, random_tree

from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.base_parameter_expressions import (
    Coefficient,
    Expression,
    Monomial,
)
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
from jaxid.units.dimensions import Dimension, dimension, length_power

DRIVES = (ViscousFriction(), CoulombFriction(), RotorInertia())
SEVEN, TEN = RigidBodies(principal_axes=True), RigidBodies()
X, Y, Z = UPRIGHT = np.eye(3)


@pytest.fixture(scope="module")
def paper() -> BaseParameters:
    return base_parameters(Model(library.tx90l_on_rail(), (SEVEN, *DRIVES)))


def combinations(base: BaseParameters) -> np.ndarray:
    """The same numbers as `expressions`, from kappa: one row per base parameter."""
    full = np.zeros((base.size, base.model.size))
    full[:, base.indices] = np.eye(base.size)
    full[:, base.dependent] = base.kappa
    return full


def values(expression: Expression, lengths: dict[str, float]) -> dict[str, float]:
    """Return the coefficient of each standard parameter for given lengths."""
    return {
        name: sum(
            float(m.number) * math.prod(lengths[x] ** e for x, e in m.powers)
            for m in coefficient.monomials
        )
        for name, coefficient in expression.terms
    }


def evaluated(base: BaseParameters, lengths: dict[str, float]) -> np.ndarray:
    place = {name: k for k, name in enumerate(base.model.parameter_names)}
    full = np.zeros((base.size, base.model.size))
    for row, expression in enumerate(base.closed_forms[0]):
        for name, value in values(expression, lengths).items():
            full[row, place[name]] = value
    return full


def test_equation_24_as_printed(paper):
    assert paper.expressions[0] == "m1 + m2 + m3 - mz4/l3z + Ia1"
    assert paper.expressions[1] == "mx2 + l2x*m3 - l2x*mz4/l3z"
    assert paper.expressions[26] == "fv1"
    assert paper.expressions[33] == "fc1"
    assert paper.expressions[40:] == ("Ia4", "Ia5", "Ia6", "Ia7")
    assert (paper.lengths["l2x"], paper.lengths["l3z"]) == (0.05, 0.05)


def test_expressions_do_not_depend_on_the_seed(paper):
    again = base_parameters(paper.model, seed=11)
    assert again.expressions == paper.expressions
    assert again.lengths == paper.lengths


def test_moments_move_down_a_planar_arm():
    base = base_parameters(Model(library.planar_arm(3, [0.5, 0.4, 0.3]), (TEN,)))
    assert [e for e in base.expressions if " " in e] == [
        "mx1 + l1x*(m2 + m3)",
        "C1 + l1x^2*(m2 + m3)",
        "mx2 + l2x*m3",
        "C2 + l2x^2*m3",
    ]
    assert base.lengths == {"l1x": 0.5, "l2x": 0.4}


def test_gravity_is_a_symbol_on_a_lift():
    lift = Robot(
        "lift",
        revolute=(False, True, True),
        axis=[Z, Z, Y],
        rotation=[UPRIGHT] * 3,
        offset=[(0.0, 0.0, 0.0), (0.1, 0.0, 0.2), (0.2, 0.0, 0.1)],
        gravity=(0.0, 0.0, -9.80665),
    )
    base = base_parameters(Model(lift, (TEN, *DRIVES, ConstantOffset())))
    assert base.expressions[0] == "m1 + m2 + m3 + fo1/g"
    assert base.lengths["g"] == pytest.approx(9.80665)


def test_bodies_with_several_children_name_both_ends():
    tree = Robot(
        "tree",
        parent=(-1, 0, 0),
        revolute=(True, True, True),
        axis=[Z, Y, Y],
        rotation=[UPRIGHT] * 3,
        offset=[(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-0.3, 0.0, 0.2)],
    )
    base = base_parameters(Model(tree, (TEN,)))
    assert base.expressions[0] == "C1 + l1_2x^2*m2 + C2 + l1_3x^2*m3 + C3"
    assert base.lengths == {"l1_2x": 0.1, "l1_3x": -0.3}


def test_lengths_that_must_stay_equal_change_together():
    # Joint 4 turns about the same line as joint 1 only because two offsets cancel each
    # other.
    arm = Robot(
        "arm",
        revolute=(True, False, True, True),
        axis=[Z, Z, Z, Y],
        rotation=[UPRIGHT] * 4,
        offset=[(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (-0.3, 0.0, 0.0), (0.2, 0.0, 0.1)],
    )
    base = base_parameters(Model(arm, (TEN, *DRIVES)))
    assert "C1 + 2*l1x*mx2 + C2 - l1x^2*(m3 + m4) + Ia1" in base.expressions
    assert base.lengths == {"l1x": 0.3, "l3x": 0.2}
    np.testing.assert_allclose(
        evaluated(base, base.lengths), combinations(base), atol=1e-12
    )


def test_what_has_no_short_form_is_a_number():
    base = base_parameters(Model(mixed_tree().robot(), (SEVEN, *DRIVES)))
    numbers = [
        coefficient.monomials[0].number
        for e in base.closed_forms[0]
        for _, coefficient in e.terms
        if len(coefficient.monomials) == 1 and not coefficient.symbols
    ]
    assert any(isinstance(x, float) for x in numbers)


MODELS = {
    "paper": lambda: Model(library.tx90l_on_rail(), (SEVEN, *DRIVES)),
    "ur10": lambda: Model(library.ur10(), (TEN, *DRIVES, ConstantOffset())),
    "coupled": lambda: Model(library.tx40(), (TEN, *DRIVES, CoupledDrives())),
    "kr300": lambda: Model(library.kr300(), (TEN, *DRIVES)),
    "panda": lambda: Model(
        library.panda(), (TEN, AsymmetricCoulombFriction(), ConstantOffset())
    ),
    "tree": lambda: Model(mixed_tree().robot(), (TEN, *DRIVES, ConstantOffset())),
    **{
        f"skew{s}": lambda s=s: Model(random_tree(s, 5).robot(), (TEN, *DRIVES))
        for s in range(1)
    },
}


def stretched(
    robot: Robot, lengths: dict[str, float], seed: int
) -> tuple[Robot, dict[str, float]]:
    """The robot with random changes of its offsets and gravity, and its new lengths."""
    rng = np.random.default_rng(seed)
    offset = np.array(robot.offset) * rng.uniform(0.6, 1.6, (robot.joints, 3))
    factor = rng.uniform(0.3, 3.0)
    changed = robot.replace(offset=offset, gravity=factor * np.asarray(robot.gravity))
    values = {}
    for name in lengths:
        if name == "g":
            values[name] = float(np.linalg.norm(changed.gravity))
            continue
        ends, axis = name[1:-1].split("_"), "xyz".index(name[-1])
        children = [i for i, p in enumerate(robot.parent) if p + 1 == int(ends[0])]
        body = int(ends[1]) - 1 if len(ends) == 2 else children[0]
        values[name] = float(offset[body, axis])
    return changed, values


SQUARE = ("paper", "ur10", "coupled", "kr300", "panda")
"""Robots whose axes stand square: every coefficient has a short form."""


@pytest.mark.parametrize("name", MODELS)
def test_letters_hold_for_robots_of_other_lengths(name):
    model = MODELS[name]()
    base = base_parameters(model)
    own = combinations(base)
    np.testing.assert_allclose(
        evaluated(base, base.lengths), own, rtol=1e-9, atol=1e-10 * np.abs(own).max()
    )
    robot, lengths = stretched(model.robot, base.lengths, 1)
    fresh = base_parameters(Model(robot, model.terms))
    assert fresh.indices == base.indices
    expected, found = combinations(fresh), evaluated(base, lengths)
    if name in SQUARE:
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-10)
        coefficients = [c for e in base.closed_forms[0] for _, c in e.terms]
        assert all(
            isinstance(m.number, Fraction) for c in coefficients for m in c.monomials
        )
    # A plain number is what has no short form: it need not hold for other lengths.
    place = {label: k for k, label in enumerate(model.parameter_names)}
    for row, expression in enumerate(base.closed_forms[0]):
        for label, coefficient in expression.terms:
            if coefficient.symbols:
                exact = pytest.approx(expected[row, place[label]], rel=1e-8, abs=1e-10)
                assert found[row, place[label]] == exact, (str(expression), label)


def test_a_tiny_length_is_still_seen():
    robot = library.tx90l_on_rail()
    offset = np.array(robot.offset)
    offset[3, 2] = 1e-5
    base = base_parameters(Model(robot.replace(offset=offset), (SEVEN, *DRIVES)))
    assert base.expressions[0] == "m1 + m2 + m3 - mz4/l3z + Ia1"
    assert base.lengths["l3z"] == 1e-5


def written(*terms: tuple[str, tuple]) -> Expression:
    return Expression(
        tuple((n, Coefficient(tuple(Monomial(x, p) for x, p in c))) for n, c in terms)
    )


def test_signs_fractions_brackets_and_shared_factors():
    one, half = Fraction(1), Fraction(1, 2)
    a, b = ("a", 1), ("b", -2)
    e = written(
        ("p1", ((one, ()),)),
        ("p2", ((-half, (a, b)),)),
        ("p3", ((-one, (("a", 2),)), (-2 * one, (a, ("c", 1))))),
        ("p4", ((one, (("a", 2),)), (2 * one, (a, ("c", 1))))),
        ("p5", ((-0.25, (a,)),)),
        ("p6", ((-one, ()),)),
        ("p7", ((0.123456789, (a,)), (2.5e-7, (("c", 1),)))),
    )
    assert str(e) == (
        "p1 - a*p2/(2*b^2) - a*(a + 2*c)*(p3 - p4) - 0.25*a*p5 - p6 + (0.123457*a + "
        "2.5e-07*c)*p7"
    )
    found = values(e, {"a": 3.0, "b": 2.0, "c": 5.0})
    assert found["p2"] == pytest.approx(-0.375)
    assert found["p3"] == pytest.approx(-39.0)
    assert found["p4"] == -found["p3"]
    assert e.symbols == ("a", "b", "c")


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("kg", (1, 0, 0)),
        ("N m s/rad", (1, 2, -1)),
        ("N/(m s)", (1, 0, -3)),
    ],
)
def test_dimensions_of_units(unit, expected):
    assert dimension(unit) == Dimension(*expected)
    assert length_power(unit) == expected[1]


def test_unknown_units_have_no_dimension():
    assert dimension("A/furlong") is None
    assert length_power("A/furlong") == 0
