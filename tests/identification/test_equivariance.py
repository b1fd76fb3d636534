"""What estimates do when their data are scaled, moved, reordered, divided or padded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual import observations, standard_parameters

import jaxid as jid
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.identification.factors import Factors

TERMS = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(), jid.ConstantOffset())
ROBOT = jid.robots.planar_arm(2, 0.4).replace(limits=jid.Limits(2, force=[40.0, 5.0]))
BASE = jid.base_parameters(jid.Model(ROBOT, TERMS))
NOISE = np.array([0.5, 0.1])
LINEAR = (
    jid.estimators.LeastSquares(),
    jid.WeightedLeastSquares(),
    jid.estimators.LeastSquares(solution=jid.estimators.Truncated(1e-6)),
    jid.WeightedLeastSquares(solution=jid.estimators.Ridge(0.1)),
)
"""Estimates that are linear in the forces."""
few = settings(max_examples=3)
seeds = st.integers(0, 1000)


def observed(seed, samples=150, **options):
    p = standard_parameters(BASE.model, seed)
    return observations(
        BASE.model, p, samples=samples, noise=NOISE, seed=seed % 7, noise_seed=seed, **options
    )


def close(found, expected, rtol=1e-9):
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * size)


@pytest.mark.parametrize("estimator", LINEAR)
@few
@given(first=seeds, second=seeds, c=st.floats(-3.0, 3.0))
def test_forces_that_add_up_give_parameters_that_do(estimator, first, second, c):
    a, b = observed(first), observed(second)
    b = a.replace(forces=np.asarray(b.forces))
    both = a.replace(forces=np.asarray(a.forces) + c * np.asarray(b.forces))
    p, q, sum_ = (jid.identify(BASE, x, estimator).parameters for x in (a, b, both))
    np.testing.assert_allclose(sum_, p + c * q, rtol=1e-8, atol=1e-8 * np.abs(p).max())


@few
@given(seed=seeds, weights=st.tuples(*[st.floats(1e-3, 1e3)] * 2), power=st.integers(-40, 40))
def test_only_the_ratio_of_weights_counts(seed, weights, power):
    o, w = observed(seed), np.array(weights)
    given = (jid.estimators.GivenWeights(x) for x in (w, 2.0**power * w))
    one, other = (jid.identify(BASE, o, jid.WeightedLeastSquares(x)) for x in given)
    close(other.parameters, one.parameters)
    close(other.standard_deviations, one.standard_deviations)


@few
@given(seed=seeds, order=seeds)
def test_the_order_of_rows_is_rounding(seed, order):
    """Of the observation matrix, whose rows of one joint become one triangle."""
    o = observed(seed)
    chosen = np.random.default_rng(order).permutation(len(o.time))
    motion = jid.Motion(*(np.asarray(x)[chosen] for x in (o.motion.q, o.motion.qd, o.motion.qdd)))
    # Not filtered, so that rows are samples.
    mixed = o.replace(motion=motion, forces=np.asarray(o.forces)[chosen])
    a, b = (jid.identify(BASE, x, jid.WeightedLeastSquares()) for x in (o, mixed))
    close(b.parameters, a.parameters, 1e-10)
    assert b.rows == a.rows
    close(b.residual_rms, a.residual_rms, 1e-10)


@few
@given(seed=seeds, added=st.integers(1, 50), blocks=st.integers(1, 10))
def test_rows_of_zeros_and_the_number_of_blocks_change_nothing(seed, added, blocks):
    o = observed(seed)
    total = jid.RegressionProblem(BASE, [o]).blocks.total
    padded = [j.append(np.zeros((added, len(j.columns) + 1))) for j in total.joints]
    divided = jid.RegressionProblem(BASE, [o], divisions=blocks).blocks.total
    expected, *others = (
        solved(factors) for factors in (total, Factors(tuple(padded), BASE.size), divided)
    )
    for found in others:
        close(found, expected, 1e-11)


def solved(factors):
    return Decomposition.of(*factors.weighted(np.array([0.025, 0.2]))).solve()


@few
@given(seed=seeds, share=st.floats(0.3, 0.7))
def test_an_update_is_the_joint_fit(seed, share):
    parts = observed(seed, samples=400).split(share)
    runs = [jid.identify(BASE, part) for part in parts]
    joint = jid.identify(BASE, parts, jid.WeightedLeastSquares())
    close(jid.update(*runs).parameters, joint.parameters)
    close(jid.update(*runs[::-1]).parameters, joint.parameters)
    swapped = jid.identify(BASE, parts[::-1], jid.WeightedLeastSquares())
    close(swapped.parameters, joint.parameters)
    close(swapped.standard_deviations, joint.standard_deviations)


@few
@given(seed=seeds)
def test_rows_that_do_not_count_may_hold_anything(seed):
    rng = np.random.default_rng(seed)
    mask = rng.uniform(size=(150, 2)) > 0.2
    o = observed(seed, mask=mask)
    spoilt = o.replace(forces=np.where(mask, o.forces, 1e6 * rng.standard_normal((150, 2))))
    a, b = (jid.identify(BASE, x, jid.WeightedLeastSquares()) for x in (o, spoilt))
    close(b.parameters, a.parameters, 1e-12)
    assert b.rows == a.rows == tuple(mask.sum(axis=0))
