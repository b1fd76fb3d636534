"""Many data sets together."""

import arms
import jax
import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.consistency.estimator import PhysicallyConsistent
from jaxid.identification.consistency.pseudo_inertia import consistency_margin
from jaxid.identification.consistency.solver import solve_in_numpy

TERMS = (jid.RigidBodies(), jid.ViscousFriction(), jid.RotorInertia(), jid.ConstantOffset())


def test_a_batch_is_its_data_sets_one_by_one():
    base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.5), TERMS))
    factors = [arms.factor(base, seed, 0.2, 100) for seed in range(3)]
    R, z, rows = (np.array([f[k] for f in factors]) for k in range(3))
    many = jid.consistency.consistent_batch(base, R, z, rows)
    estimator = PhysicallyConsistent()
    feasible = estimator.feasible_set(base)
    for k in range(3):
        data, program = estimator.program(np, base, feasible, R[k], z[k], rows[k])
        optimum = solve_in_numpy(program)
        p = feasible.standard_parameters(np, data.A, data.b, optimum.y)
        np.testing.assert_allclose(many.parameters[k], base.from_standard(p), rtol=1e-3, atol=1e-4)
        free = np.linalg.norm(data.b[base.size :])
        price = np.sqrt(2.0 * optimum.value) / free - 1.0
        np.testing.assert_allclose(many.residual_increases[k], price, atol=1e-6)
    assert many.certified.all()
    bodies = np.asarray(many.standard)[:, :20].reshape(3, 2, 10)
    assert (consistency_margin(bodies) > 0).all()
    with pytest.raises(ValueError, match="`R`, `z` and `rows` must have the shapes"):
        jid.consistency.consistent_batch(base, R[:, :, :-1], z, rows)


def test_a_solver_is_a_function_of_arrays():
    base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.5), TERMS))
    R, z, rows, _ = arms.factor(base, 0, 0.2, 100)
    estimator = PhysicallyConsistent(margin=0.1)
    solver = jid.consistency.ConsistentSolver(base, estimator)
    assert solver == jid.consistency.ConsistentSolver(base, PhysicallyConsistent(margin=0.1))
    assert solver != jid.consistency.ConsistentSolver(base)
    one = jax.jit(solver)(R, z, rows)
    many = jid.consistency.consistent_batch(base, R[None], z[None], np.array([rows]), estimator)
    np.testing.assert_allclose(one.standard, many.standard[0], rtol=1e-6, atol=1e-9)
    assert one.parameters.shape == (base.size,)
