"""Each term against its formula, and what all terms have in common."""

import inspect
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trees

from jaxid.dynamics import terms
from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import (
    AbstractTerm,
    AsymmetricCoulombFriction,
    AsymmetricViscousFriction,
    ConstantOffset,
    CoulombFriction,
    CoupledDrives,
    HardSign,
    LinearSpring,
    LoadFriction,
    PassiveFriction,
    RigidBodies,
    RotorInertia,
    SensorBias,
    SensorLoad,
    SensorRotation,
    SquareRootFriction,
    StribeckFriction,
    Tanh,
    TemperatureScaled,
    TorqueRipple,
    ViscousFriction,
)
from jaxid.errors import InputError
from jaxid.report.parameter_words import in_words
from jaxid.robot.library import tx40
from jaxid.robot.limits_and_drives import Drives

N = 3
TREE = trees.Tree(
    (-1, 0, 0),
    (True, False, True),
    *trees.geometry(np.random.default_rng(41), N),
    np.array([0.0, 0.0, -9.81]),
)
Q, QD, QDD = trees.random_motion(np.random.default_rng(42), N)
REDUCTION = np.array([[10.0, 0.0, 0.0], [0.0, 20.0, 5.0], [4.0, 0.0, -8.0]])

ALL = [
    RigidBodies(),
    RigidBodies(principal_axes=True),
    ViscousFriction(),
    CoulombFriction(),
    CoulombFriction(HardSign()),
    CoulombFriction(Tanh(np.array([0.01, 0.001, 0.02]))),
    AsymmetricCoulombFriction(),
    ConstantOffset(),
    RotorInertia(),
    LinearSpring(),
    LinearSpring(np.array([0.1, 0.2, 0.3])),
    CoupledDrives(),
    StribeckFriction(),
    StribeckFriction(np.array([0.1, 0.2, 0.05]), exponent=1.3),
    AsymmetricViscousFriction(),
    SquareRootFriction(),
    LoadFriction(np.random.default_rng(44).uniform(0.2, 2.0, (N, 10))),
    TemperatureScaled(ViscousFriction(), rate=0.02, temperature=40.0),
    TorqueRipple((1, 6), (2,)),
]
FORCE = ("N m", "N", "N m")


@pytest.fixture(scope="module")
def robot():
    return TREE.robot(drives=Drives(N, reduction=REDUCTION))


def _columns(term, robot, q=Q, qd=QD, qdd=QDD):
    return np.asarray(term.columns(robot, *(jnp.asarray(x) for x in (q, qd, qdd))))


@pytest.mark.parametrize("term", ALL, ids=lambda t: type(t).__name__)
class TestContract:
    """What a colleague's new term must do; add it to the list above."""

    def test_parameters_are_named_once_and_have_units(self, term, robot):
        parameters = term.parameters(robot)
        names = [name for name, _ in parameters]
        assert len(set(names)) == len(names) > 0
        assert all(name.isidentifier() and unit for name, unit in parameters)

    def test_every_parameter_has_words_for_the_report(self, term, robot):
        model = Model(robot, (term,))
        for name in model.parameter_names:
            assert "your own" not in in_words(name, model)[0]

    def test_everything_fits_and_is_linear(self, term, robot):
        """Shapes; forces = columns p; the slopes of mass matrix and potential."""
        size = len(term.parameters(robot))
        p = np.random.default_rng(43).normal(size=size)

        @trees.compiled
        def parts(q, qd, qdd):
            rest = jnp.zeros_like(q)
            return (
                term.columns(robot, q, qd, qdd),
                term.forces(robot, p, q, qd, qdd),
                term.mass_matrix(robot, p, q),
                term.columns(robot, q, qd, rest),
                jax.jacfwd(lambda x: term.potential_columns(robot, x))(q),
                term.columns(robot, q, rest, rest),
            )

        columns, forces, mass, bias, lift, still = (
            np.asarray(x) for x in parts(Q, QD, QDD)
        )
        assert columns.shape == bias.shape == (N, size)
        assert lift.shape == (size, N)
        np.testing.assert_allclose(forces, columns @ p, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(
            mass @ QDD + bias @ p, forces, rtol=1e-12, atol=1e-12
        )
        if np.any(lift):
            np.testing.assert_allclose(lift.T, still, rtol=1e-12, atol=1e-12)

    def test_derivatives_and_batches_are_finite(self, term, robot):
        """Also at standstill, where transitions are steepest."""
        p = np.ones(len(term.parameters(robot)))

        def work(q, qd, qdd, p):
            return (term.forces(robot, p, q, qd, qdd) ** 2).sum()

        batch = [np.stack([x, 0.0 * x]) for x in (Q, QD, QDD)]
        slopes = trees.compiled(
            jax.vmap(jax.grad(work, argnums=(0, 1, 2, 3)), (0, 0, 0, None))
        )
        for slope in slopes(*batch, p):
            assert np.isfinite(np.asarray(slope)).all()


def test_the_contract_covers_every_term():
    members = {
        c
        for _, c in inspect.getmembers(terms, inspect.isclass)
        if issubclass(c, AbstractTerm) and not inspect.isabstract(c)
    }
    # The laws of these need a robot with a sensor: `test_force_sensors`.
    special_terms = {SensorBias, SensorLoad, SensorRotation}
    # That of this one needs a closed loop: `test_closed_chains`.
    special_terms.add(PassiveFriction)
    assert members - special_terms == {type(t) for t in ALL}, (
        "add the new term to the list `ALL` of this file"
    )
    assert members == set(terms.TERMS.values()), "add the new term to `TERMS`"
    conventions = (Path(__file__).parents[2] / "docs" / "conventions.md").read_text()
    for term in members:
        assert f"`{term.__name__}" in conventions, "add a row to docs/conventions.md"


@pytest.mark.parametrize(
    ("term", "diagonal", "name", "units"),
    [
        (ViscousFriction(), QD, "fv", ("N m s", "N s/m", "N m s")),
        (CoulombFriction(), np.tanh(QD / 0.01), "fc", FORCE),
        (CoulombFriction(Tanh(0.3)), np.tanh(QD / 0.3), "fc", FORCE),
        (CoulombFriction(HardSign()), np.sign(QD), "fc", FORCE),
        (ConstantOffset(), np.ones(N), "fo", FORCE),
        (RotorInertia(), QDD, "Ia", ("kg m²", "kg", "kg m²")),
        (LinearSpring(), Q, "ks", ("N m/rad", "N/m", "N m/rad")),
        (LinearSpring(0.25), Q - 0.25, "ks", ("N m/rad", "N/m", "N m/rad")),
    ],
)
def test_diagonal_terms(robot, term, diagonal, name, units):
    """Eqs. 13, 14, 17: one column for each joint, and only on that joint."""
    np.testing.assert_allclose(_columns(term, robot), np.diag(diagonal), rtol=1e-15)
    assert term.parameters(robot) == tuple(
        (f"{name}{i + 1}", u) for i, u in enumerate(units)
    )


def test_asymmetric_friction_is_its_level_in_each_direction(robot):
    term = AsymmetricCoulombFriction(HardSign())
    levels = np.array([1.0, 2.0, 3.0, 10.0, 20.0, 30.0])
    forward = _columns(term, robot, qd=np.array([0.3, 0.2, 0.1])) @ levels
    backward = _columns(term, robot, qd=np.array([-0.3, -0.2, -0.1])) @ levels
    np.testing.assert_allclose(forward, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(backward, [-10.0, -20.0, -30.0])
    names = ("fcp1", "fcp2", "fcp3", "fcn1", "fcn2", "fcn3")
    assert term.parameters(robot) == tuple(zip(names, FORCE * 2, strict=True))


def test_asymmetric_friction_is_symmetric_friction_with_an_offset(robot):
    """The docstring's claim: it spans the columns of the two terms it replaces."""
    fcp, fcn = np.random.default_rng(44).uniform(1, 5, (2, N))
    found = _columns(AsymmetricCoulombFriction(), robot) @ np.concatenate([fcp, fcn])
    dry = _columns(CoulombFriction(), robot) @ (0.5 * (fcp + fcn))
    offset = _columns(ConstantOffset(), robot) @ (0.5 * (fcp - fcn))
    np.testing.assert_allclose(found, dry + offset, rtol=1e-14)


def test_ripple_is_that_of_the_motors_and_joints(robot):
    """Motors with torques of their own angles, through the gears: A^T M(A q)."""
    term = TorqueRipple((1, 6), (2,))
    a, b = np.random.default_rng(45).normal(size=(2, 2, N))
    joint = np.random.default_rng(46).normal(size=(2, N))
    turned = REDUCTION @ Q
    motors = 0
    for i, k in enumerate((1, 6)):
        motors = motors + a[i] * np.sin(k * turned) + b[i] * np.cos(k * turned)
    expected = (
        REDUCTION.T @ motors + joint[0] * np.sin(2 * Q) + joint[1] * np.cos(2 * Q)
    )
    gears = np.diag(REDUCTION)
    p = np.concatenate([gears * a[0], gears * b[0], gears * a[1], gears * b[1], *joint])
    np.testing.assert_allclose(_columns(term, robot) @ p, expected, rtol=1e-12)
    assert term.parameters(robot)[:4] == (
        ("sm1_1", "N m"),
        ("sm1_2", "N"),
        ("sm1_3", "N m"),
        ("cm1_1", "N m"),
    )
    for refused in ((), (0,), (1.5,)):
        with pytest.raises(InputError, match="`TorqueRipple`"):
            TorqueRipple(refused)


def _motor_level(A, J, fv, fc, epsilon, qd, qdd):
    """A^T (J A qdd + fv A qd + fc s(A qd / a_ii)): motors with rotor and friction."""
    own = np.diag(A)
    motors = (
        J * (A @ qdd)
        + fv * (A @ qd)
        + np.sign(own) * fc * np.tanh(A @ qd / own / epsilon)
    )
    return A.T @ motors


@pytest.mark.parametrize("which", ["tx40", "two coupled motors"])
def test_coupled_drives_are_the_motors_own_equations(which, robot):
    """Rotor inertia and friction of all motors, seen from the joints (TX40: wrist)."""
    robot = tx40() if which == "tx40" else robot
    A, n = np.asarray(robot.drives.reduction), robot.joints
    coupled = [5] if which == "tx40" else [1, 2]
    rng = np.random.default_rng(45)
    J, fv, fc = rng.uniform(1e-4, 1e-3, (3, n))
    q, qd, qdd = rng.normal(size=(3, n)) * 0.02
    own = np.diag(A)
    model = Model(
        robot,
        (
            RotorInertia(),
            ViscousFriction(),
            CoulombFriction(Tanh(0.01)),
            CoupledDrives(),
        ),
    )
    single = np.where(np.isin(np.arange(n), coupled), 0.0, fc * np.abs(own))
    p = np.concatenate(
        [
            (A**2).T @ J,
            (A**2).T @ fv,
            single,
            (own**2 * J)[coupled],
            (own**2 * fv)[coupled],
            (np.abs(own) * fc)[coupled],
        ]
    )
    assert model.parameter_names[3 * n :] == tuple(
        f"{name}{i + 1}" for name in ("Iam", "fvm", "fcm") for i in coupled
    )
    found = np.asarray(model.columns(*(jnp.asarray(x) for x in (q, qd, qdd)))) @ p
    np.testing.assert_allclose(
        found, _motor_level(A, J, fv, fc, 0.01, qd, qdd), rtol=1e-12
    )


def test_coupled_drives_of_the_tx40_are_the_published_columns():
    """Row 5: (qdd6, qd6, s(qd5 + qd6)), row 6: (qdd5, qd5, s(qd5 + qd6))."""
    q, qd, qdd = np.random.default_rng(46).normal(size=(3, 6)) * 0.01
    found = _columns(CoupledDrives(), tx40(), q, qd, qdd)
    s = np.tanh((qd[4] + qd[5]) / 0.01)
    expected = np.zeros((6, 3))
    expected[4], expected[5] = (qdd[5], qd[5], s), (qdd[4], qd[4], s)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    units = [unit for _, unit in CoupledDrives().parameters(tx40())]
    assert units == ["kg m²", "N m s", "N m"]
    slide = dict(
        CoupledDrives().parameters(TREE.robot(drives=Drives(N, reduction=REDUCTION)))
    )
    assert [slide[name] for name in ("Iam2", "fvm2", "fcm2")] == ["kg", "N s/m", "N"]


def test_stribeck_friction_falls_from_its_static_level(robot):
    """At a few epsilons the sum of both levels, at the Stribeck speed what is left."""
    speeds = np.array([0.1, 0.2, 0.4])
    term = StribeckFriction(speeds, exponent=1.5, transition=Tanh(1e-4))
    levels = np.array([1.0, 2.0, 3.0, 0.5, 0.6, 0.7])
    slow = _columns(term, robot, qd=np.full(N, 2e-3)) @ levels
    np.testing.assert_allclose(slow, levels[:N] + levels[N:], rtol=2e-3)
    at = _columns(term, robot, qd=-speeds) @ levels
    np.testing.assert_allclose(at, -(levels[:N] + levels[N:] / np.e), rtol=1e-12)
    fast = _columns(term, robot, qd=np.full(N, 30.0)) @ levels
    np.testing.assert_allclose(fast, levels[:N], rtol=1e-12)


def test_friction_under_load_is_a_share_of_the_weight(robot):
    p = np.random.default_rng(45).uniform(0.2, 2.0, 10 * N)
    weight = RigidBodies().forces(
        robot, jnp.asarray(p), *(jnp.asarray(x) for x in (Q, 0 * Q, 0 * Q))
    )
    found = np.diag(_columns(LoadFriction(p, HardSign()), robot))
    np.testing.assert_allclose(found, np.abs(weight) * np.sign(QD), rtol=1e-12)
    with pytest.raises(InputError, match="`bodies`"):
        Model(robot, (LoadFriction(p[:5]),))


def test_warm_friction_is_smaller(robot):
    rates = np.array([0.01, 0.02, 0.03])
    cold = TemperatureScaled(ViscousFriction(), rates)
    np.testing.assert_allclose(_columns(cold, robot), np.diag(QD), rtol=1e-15)
    warm = TemperatureScaled(ViscousFriction(), rates, temperature=45.0)
    np.testing.assert_allclose(
        _columns(warm, robot), np.diag(np.exp(-20 * rates) * QD), rtol=1e-12
    )


def test_base_parameters_see_friction_near_standstill():
    model = Model(
        tx40(),
        (RigidBodies(), ViscousFriction(), StribeckFriction(0.02), RotorInertia()),
    )
    base = base_parameters(model)
    assert {f"fs{k}" for k in range(1, 7)} < set(base.names)
    assert not base.notes


def test_a_coupled_motor_has_the_transition_of_its_own_joint():
    """Widths for each joint: motor 3 of the wrist turns two axes, with one friction."""
    robot = TREE.robot().replace(drives=Drives(N, reduction=REDUCTION))
    widths = (0.01, 0.3, 0.7)
    found = CoupledDrives(Tanh(widths)).columns(robot, Q, QD, QDD)
    for column, motor in zip(found[:, -2:].T, (1, 2), strict=True):
        ratios = REDUCTION[motor] / REDUCTION[motor, motor]
        np.testing.assert_allclose(
            column, ratios * np.tanh(ratios @ QD / widths[motor])
        )
