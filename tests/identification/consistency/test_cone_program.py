"""The optimum against a conic solver, the certificate, and the two machines against each other."""

import arms
import conic
import jax
import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.consistency import solver
from jaxid.identification.consistency.cone_program import cone_program
from jaxid.identification.consistency.feasible_set import feasible_set, nominal_bodies

TERMS = (
    jid.RigidBodies(),
    jid.ViscousFriction(),
    jid.CoulombFriction(),
    jid.RotorInertia(),
    jid.ConstantOffset(),
)


def _robot(name):
    return {
        "panda": jid.robots.panda,
        "tx40": jid.robots.tx40,
        "planar": lambda: jid.robots.planar_arm(2, 0.5),
        "rail": jid.robots.tx90l_on_rail,
    }[name]()


def _case(name, terms=TERMS, margin=0.0, **bounds):
    base = jid.base_parameters(jid.Model(_robot(name), terms))
    wide = jid.consistency.BodyBounds.from_geometry(base.model.robot)
    return base, feasible_set(base.model, wide.replace(**bounds), margin)


def _program(feasible, data):
    return cone_program(np, feasible, data)


CASES = {
    "a seven-axis arm": (_case("panda"), 0.2),
    "coupled drives": (_case("tx40", (*TERMS, jid.terms.CoupledDrives())), 0.3),
    "a rail": (_case("rail"), 0.1),
    "seven parameters": (_case("planar", (jid.RigidBodies(principal_axes=True), *TERMS[1:])), 0.2),
    "all bounds": (
        _case(
            "planar",
            mass_min=1.0,
            mass_max=[30.0, 9.0],
            centre_min=[0.0, -0.1, -np.inf],
            centre_max=[0.4, 0.2, 0.3],
            ellipsoid_centre=[0.2, 0.0, 0.0],
            ellipsoid_axes=[[0.3, 0.2, 0.2], [np.inf] * 3],
            total_mass=12.0,
            margin=0.02,
        ),
        0.2,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_optimum_is_a_conic_solvers(name):
    (base, feasible), noise = CASES[name]
    data = arms.data(base, 3, noise)
    optimum = solver.solve_in_numpy(_program(feasible, data))
    value, p = conic.optimum(feasible, data)
    assert optimum.certified
    assert optimum.iterations <= 30
    assert abs(optimum.value - value) <= 1e-6 * value
    ours = feasible.standard_parameters(np, data.A, data.b, optimum.y)
    np.testing.assert_allclose(
        data.A @ ours, data.A @ p, atol=5e-3 * np.sqrt(value), err_msg="forces of the optimum"
    )


def test_noise_free_forces_are_met_exactly():
    (base, feasible), _ = CASES["a seven-axis arm"]
    data = arms.data(base, 5, 0.0)
    optimum = solver.solve_in_numpy(_program(feasible, data))
    assert optimum.certified
    assert optimum.value < 1e-6 * data.scale


def test_the_bound_holds_on_the_way(monkeypatch):
    (base, feasible), _ = CASES["coupled drives"]
    program = _program(feasible, arms.data(base, 7, 0.3))
    best = solver.solve_in_numpy(program).value
    for most in (1, 3, 6, 9):
        monkeypatch.setattr(solver, "MAX_ITERATIONS", most)
        early = solver.solve_in_numpy(program)
        assert early.value - best <= early.error * (1 + 1e-9)
        assert not early.certified


def test_the_bound_holds_with_a_pull(monkeypatch):
    (base, feasible), _ = CASES["all bounds"]
    data = arms.data(base, 7, 0.3)
    prior = nominal_bodies(feasible.bounds)
    program = cone_program(np, feasible, data, 3.0, prior)
    optimum = solver.solve_in_numpy(program)
    assert optimum.certified

    def objective(y):
        S = program.slacks(np, y)[0][: program.bodies]
        away = program.A @ y - program.b
        return 0.5 * away @ away + 3.0 * np.sum(
            np.einsum("kab,kab->k", program.prior, S) - np.linalg.slogdet(S)[1]
        )

    best = objective(optimum.y)
    for most in (2, 5):
        monkeypatch.setattr(solver, "MAX_ITERATIONS", most)
        early = solver.solve_in_numpy(program)
        assert -1e-6 <= objective(early.y) - best <= early.error * (1 + 1e-9)


def test_both_machines_find_the_same():
    (base, feasible), _ = CASES["coupled drives"]
    programs = [_program(feasible, arms.data(base, seed, 0.2)) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *programs)
    many = jax.vmap(solver.solve_compiled)(stacked)
    for k, program in enumerate(programs):
        one = solver.solve_in_numpy(program)
        np.testing.assert_allclose(many.value[k], one.value, rtol=1e-6)
        assert many.certified[k]
        assert abs(int(many.iterations[k]) - int(one.iterations)) <= 2
