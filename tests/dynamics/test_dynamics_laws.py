"""Laws that any right model obeys, with every term at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trees

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import (
    ConstantOffset,
    CoulombFriction,
    CoupledDrives,
    LinearSpring,
    RigidBodies,
    RotorInertia,
    Tanh,
    ViscousFriction,
)
from jaxid.robot.limits_and_drives import Drives

N, SAMPLES, EPSILON = 4, 6, 0.05
TREE = trees.Tree(
    (-1, 0, 1, 1),
    (True, True, False, True),
    *trees.geometry(np.random.default_rng(31), N),
    np.array([2.0, -4.0, -8.0]),
)
REST = np.array([0.1, -0.4, 0.3, 0.2])
REDUCTION = np.diag([20.0, -30.0, 40.0, 25.0])
REDUCTION[3, 2], REDUCTION[1, 0] = 15.0, -12.0
COUPLED = [1, 3]
TERMS = (
    RigidBodies(),
    ViscousFriction(),
    CoulombFriction(Tanh(EPSILON)),
    RotorInertia(),
    ConstantOffset(),
    LinearSpring(REST),
    CoupledDrives(Tanh(EPSILON)),
)


@pytest.fixture(scope="module")
def model():
    robot = TREE.robot(drives=Drives(N, reduction=REDUCTION))
    return Model(robot, TERMS)


@pytest.fixture(scope="module")
def unknowns():
    """Parameters that a real robot could have: drives dissipate, rotors have mass."""
    rng = np.random.default_rng(32)
    A, J, fvm = REDUCTION, rng.uniform(1e-4, 1e-3, N), rng.uniform(1e-4, 1e-3, N)
    own = np.diag(A)[COUPLED] ** 2
    return {
        "bodies": trees.standard_parameters(trees.random_bodies(rng, N)).ravel(),
        "fv": (A**2).T @ fvm,
        "fc": rng.uniform(1.0, 3.0, N),
        "Ia": (A**2).T @ J,
        "fo": rng.normal(size=N),
        "ks": rng.uniform(10.0, 90.0, N),
        "Iam": own * J[COUPLED],
        "fvm": own * fvm[COUPLED],
        "fcm": rng.uniform(1.0, 3.0, len(COUPLED)),
    }


@pytest.fixture(scope="module")
def case(model, unknowns):
    """Everything that the laws speak of."""
    p = np.concatenate(list(unknowns.values()))
    assert p.shape == (model.size,)
    q, qd, qdd = trees.random_motion(np.random.default_rng(33), SAMPLES, N)

    motion, still = Motion(q, qd, qdd), np.zeros_like(q)
    rest = model.inverse_dynamics(p, Motion(q, still, still))
    units = [np.broadcast_to(unit, q.shape) for unit in np.eye(N)]
    pushed = [
        model.inverse_dynamics(p, Motion(q, still, unit)) - rest for unit in units
    ]
    found = {
        "theta": model.regressor(motion),
        "forces": model.inverse_dynamics(p, motion),
        "mass": model.mass_matrix(p, q),
        "bias": model.bias_forces(p, q, qd),
        "rest": rest,
        "slope": np.stack(pushed, axis=-1),
        "lift": trees.compiled(jax.vmap(jax.grad(lambda x: model.potential(p, x))))(q),
    }
    found = {name: np.asarray(value) for name, value in found.items()}
    return {"p": p, "q": q, "qd": qd, "qdd": qdd} | found


def test_forces_are_linear_in_the_parameters(case):
    assert trees.relative(case["theta"] @ case["p"], case["forces"]) < 1e-13


def test_mass_matrix_and_bias_make_the_forces(case):
    """Eq. 38."""
    inertial = np.einsum("sij,sj->si", case["mass"], case["qdd"])
    assert trees.relative(inertial + case["bias"], case["forces"]) < 1e-13


def test_mass_matrix_is_the_slope_of_the_forces(case):
    """Composite bodies against the inverse dynamics of unit accelerations: exact."""
    assert trees.relative(case["mass"], case["slope"]) < 1e-13


def test_mass_matrix_is_symmetric_and_positive_definite(case):
    M = np.asarray(case["mass"])
    np.testing.assert_allclose(
        M, M.swapaxes(1, 2), rtol=0, atol=1e-14 * np.abs(M).max()
    )
    assert np.linalg.eigvalsh(M).min() > 0.1


def test_forces_at_rest_lift_and_hold(case, unknowns):
    """At rest the forces are the slope of the potential energy and the offsets."""
    assert trees.relative(case["rest"], case["lift"] + unknowns["fo"]) < 1e-13


def test_power_goes_into_energy_and_friction(model, unknowns, case):
    """qd . Q = d/dt (kinetic + potential) + power of friction and offsets, smooth."""
    rng = np.random.default_rng(34)
    amplitude, rate, phase = rng.uniform(0.3, 1.5, (3, N))
    p = case["p"]

    def path(t):
        return amplitude * jnp.sin(rate * t + phase)

    def speed(t):
        return jax.jvp(path, (t,), (jnp.ones(()),))[1]

    def energy(t):
        q, qd = path(t), speed(t)
        return 0.5 * qd @ model.inertia(p, q) @ qd + model.potential(p, q)

    def balance(t):
        qd, qdd = jax.jvp(speed, (t,), (jnp.ones(()),))
        forces = model.forces(p, path(t), qd, qdd)
        return qd, forces, jax.jvp(energy, (t,), (jnp.ones(()),))[1]

    qd, forces, stored = (
        np.asarray(x)
        for x in trees.compiled(jax.vmap(balance))(jnp.linspace(0.0, 5.0, 7))
    )
    u = unknowns
    lost = qd**2 @ u["fv"] + (qd * np.tanh(qd / EPSILON)) @ u["fc"] + qd @ u["fo"]
    for k, i in enumerate(COUPLED):
        ratio = REDUCTION[i] / REDUCTION[i, i]
        motor = qd @ ratio
        lost += u["fvm"][k] * (motor**2 - qd**2 @ ratio**2)
        lost += u["fcm"][k] * motor * np.tanh(motor / EPSILON)
    assert trees.relative((qd * forces).sum(axis=1), stored + lost) < 1e-12
    assert np.abs(stored).max() > np.abs(lost).max() > 1.0


def test_principal_axes_leave_out_columns_and_nothing_else(model, case):
    """The paper's seven parameters of a body are the ten without D, E, F (Eq. 12)."""
    seven = Model(model.robot, (RigidBodies(principal_axes=True),))
    full = Model(model.robot, (RigidBodies(),))
    kept = [10 * i + k for i in range(N) for k in range(7)]
    p = case["p"][kept]
    ten = np.zeros((N, 10))
    ten[:, :7] = p.reshape(N, 7)

    q, motion = case["q"], Motion(case["q"], case["qd"], case["qdd"])
    theta = np.asarray(seven.regressor(motion))
    assert trees.relative(theta, case["theta"][..., kept]) < 1e-13
    assert trees.relative(seven.inverse_dynamics(p, motion), theta @ p) < 1e-13
    expected = full.mass_matrix(ten.ravel(), q)
    assert trees.relative(seven.mass_matrix(p, q), expected) < 1e-13
    expected = full.potential_energy(ten.ravel(), q)
    assert trees.relative(seven.potential_energy(p, q), expected) < 1e-13
    assert seven.parameter_names[:8] == (
        "m1",
        "mx1",
        "my1",
        "mz1",
        "A1",
        "B1",
        "C1",
        "m2",
    )


def test_columns_stand_in_the_papers_order(model):
    """Eq. 18: bodies, viscous, Coulomb, rotors."""
    plain = Model(model.robot)
    names = plain.parameter_names
    body = ("m", "mx", "my", "mz", "A", "B", "C", "D", "E", "F")
    assert names[:10] == tuple(f"{k}1" for k in body)
    assert names[30:40] == tuple(f"{k}4" for k in body)
    assert names[40:] == tuple(
        f"{k}{i}" for k in ("fv", "fc", "Ia") for i in range(1, N + 1)
    )
    assert plain.size == len(names) == len(plain.parameter_units) == 13 * N
    expected = ("kg", "kg m", "kg m", "kg m", *("kg m²",) * 6)
    assert plain.parameter_units[:10] == expected
