"""The optimum against a conic solver, its certificate, and NumPy, JAX, batches."""

import arms
import conic
import jax
import numpy as np
import pytest
from arms import TERMS

import jaxid as jid
from jaxid.identification.consistency import consistency_margin, solver
from jaxid.identification.consistency.cone_program import cone_program
from jaxid.identification.consistency.feasible_set import feasible_set, nominal_bodies

PLANAR = jid.robots.planar_arm(2, 0.5)


def case(robot, terms=TERMS, **bounds):
    base = jid.base_parameters(jid.Model(robot, terms))
    wide = jid.consistency.BodyBounds.from_geometry(robot)
    return base, feasible_set(base.model, wide.replace(**bounds))


CASES = {
    "a seven-axis arm": lambda: case(jid.robots.panda()),
    "coupled drives": lambda: case(
        jid.robots.tx40(), (*TERMS, jid.terms.CoupledDrives())
    ),
    "a rail": lambda: case(jid.robots.tx90l_on_rail()),
    "seven parameters": lambda: case(
        PLANAR, (jid.RigidBodies(principal_axes=True), *TERMS[1:])
    ),
    "all bounds": lambda: case(
        PLANAR,
        mass_min=1.0,
        mass_max=[30.0, 9.0],
        total_mass=12.0,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_optimum_is_a_conic_solvers(name):
    base, feasible = CASES[name]()
    data = arms.data(base, 3, 0.2)
    optimum = solver.solve_in_numpy(cone_program(feasible, data))
    value, p = conic.optimum(feasible, data)
    assert optimum.certified
    assert optimum.iterations <= 30
    assert abs(optimum.value - value) <= 1e-6 * value
    ours = feasible.standard_parameters(data, optimum.y)
    np.testing.assert_allclose(data.A @ ours, data.A @ p, atol=5e-3 * np.sqrt(value))


@pytest.mark.parametrize(
    ("name", "strength"), [("coupled drives", 0.0), ("all bounds", 3.0)]
)
def test_the_bound_holds_on_the_way(name, strength, monkeypatch):
    base, feasible = CASES[name]()
    prior = nominal_bodies(feasible.bounds) if strength else None
    program = cone_program(feasible, arms.data(base, 7, 0.3), strength, prior)

    def objective(y):
        S = program.slacks(y)[0][: program.bodies]
        away = program.A @ y - program.b
        along = np.einsum("kab,kab->k", program.prior, S)
        return 0.5 * away @ away + strength * np.sum(along - np.linalg.slogdet(S)[1])

    optimum = solver.solve_in_numpy(program)
    assert optimum.certified
    for most in (1, 3, 6):
        monkeypatch.setattr(solver, "MAX_ITERATIONS", most)
        early = solver.solve_in_numpy(program)
        gap = objective(early.y) - objective(optimum.y)
        assert -1e-6 <= gap <= early.error * (1 + 1e-9)
        assert not early.certified


def test_coupled_drives_in_jax_are_those_in_numpy():
    drives = jid.Drives(reduction=[[50.0, 0.0], [-50.0, 60.0]])
    base, feasible = case(
        PLANAR.replace(drives=drives), (*TERMS, jid.terms.CoupledDrives())
    )
    assert len(feasible.couplings) == 2
    R, z, rows = arms.factor(base, 3, 0.2, 100)
    one = jid.consistency.ConsistentSolver(base)
    compiled = one(R, z, rows)
    data, program = one.estimator.program(base, feasible, R, z, rows)
    optimum = solver.solve_in_numpy(program)
    p = feasible.standard_parameters(data, optimum.y)
    assert compiled.certified
    assert optimum.certified
    np.testing.assert_allclose(data.A @ compiled.standard, data.A @ p, atol=1e-3)
    np.testing.assert_allclose(
        compiled.parameters, base.from_standard(p), rtol=1e-3, atol=1e-4
    )
    for own, beside in (("Ia", "Iam"), ("fv", "fvm")):
        found = dict(zip(base.model.parameter_names, compiled.standard, strict=True))
        matrix = [
            [found[f"{own}1"], found[f"{beside}2"]],
            [found[f"{beside}2"], found[f"{own}2"]],
        ]
        assert np.linalg.eigvalsh(matrix)[0] >= 0


def test_a_batch_is_its_data_sets_one_by_one():
    """In NumPy, and compiled."""
    base, feasible = case(PLANAR, TERMS[:2])
    factors = [arms.factor(base, seed, 0.2, 100) for seed in range(2)]
    R, z, rows = (np.array([f[k] for f in factors]) for k in range(3))
    pull = jid.consistency.EntropicPull()
    estimator = jid.PhysicallyConsistent(pull=pull)
    many = jid.consistency.consistent_batch(base, R, z, rows, estimator)
    one = jid.consistency.ConsistentSolver(base, estimator)
    same = jid.PhysicallyConsistent(pull=jid.consistency.EntropicPull())
    assert one == jid.consistency.ConsistentSolver(base, same)
    assert one != jid.consistency.ConsistentSolver(base)
    alone = jax.jit(jax.vmap(one))(R, z, rows)
    np.testing.assert_allclose(alone.standard, many.standard, rtol=1e-6, atol=1e-9)
    assert (np.abs(alone.iterations - many.iterations) <= 2).all()
    for k in range(2):
        data, program = estimator.program(base, feasible, R[k], z[k], rows[k])
        optimum = solver.solve_in_numpy(program)
        p = feasible.standard_parameters(data, optimum.y)
        np.testing.assert_allclose(
            many.parameters[k], base.from_standard(p), rtol=1e-3, atol=1e-4
        )
    assert many.certified.all()
    assert (
        consistency_margin(np.asarray(many.standard)[:, :20].reshape(2, 2, 10)) > 0
    ).all()
    with pytest.raises(ValueError, match="`R`, `z` and `rows` must have the shapes"):
        jid.consistency.consistent_batch(base, R[:, :, :-1], z, rows)
