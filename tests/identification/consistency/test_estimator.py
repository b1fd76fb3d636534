"""The estimator: definite mass matrices, bounds and priors that hold, and its notes."""

import dataclasses
from types import SimpleNamespace

import arms
import numpy as np
import pytest
from arms import TERMS
from virtual import observations

import jaxid as jid
from jaxid.identification.consistency import solver
from jaxid.identification.consistency.feasible_set import feasible_set

WEIGHTS = jid.estimators.ResidualVariances(0)


def case(robot, terms=TERMS, noise=3.0, samples=150):
    base = jid.base_parameters(jid.Model(robot, terms))
    p = arms.truth(base.model, 1)
    return base, p, observations(base.model, p, samples=samples, noise=noise, seed=1)


@pytest.fixture(scope="module")
def panda():
    return case(jid.robots.panda())


@pytest.fixture(scope="module")
def consistent(panda):
    base, _, o = panda
    return jid.identify(base, o, jid.PhysicallyConsistent(WEIGHTS))


def test_the_mass_matrix_is_definite_where_least_squares_fail(panda, consistent):
    base, _, o = panda
    free = jid.identify(base, o, jid.WeightedLeastSquares(WEIGHTS))
    assert not jid.validate(free, o).definiteness.positive_definite
    assert jid.validate(consistent, o).definiteness.positive_definite
    found = consistent.consistency
    assert (found.margins > 0).all()
    assert (found.bodies[:, 0] > 0).all()
    assert (found.bodies[:, 0] < found.bounds.mass_max).all()
    assert found.iterations < solver.MAX_ITERATIONS
    weigh = consistent.weights**2 * np.array(consistent.rows)
    squares = [weigh @ fit.residual_rms**2 for fit in (consistent, free)]
    increase = np.sqrt(squares[0] / squares[1]) - 1
    np.testing.assert_allclose(found.residual_increase, increase, rtol=1e-6)
    assert 0 < increase < 0.1
    full = consistent.full_parameters
    np.testing.assert_allclose(
        base.from_standard(full), consistent.parameters, rtol=1e-9
    )
    names = base.model.parameter_names
    drives = [k for k, name in enumerate(names) if name[:2] in ("fv", "fc", "Ia")]
    assert (full[drives] >= 0).all()
    assert (full[[k for k, n in enumerate(names) if n[:2] == "fo"]] < 0).any()


def test_masses_have_the_numbers_of_their_parameters(consistent):
    """The trunk of a robot on legs is body 0, whose first five joints move no mass."""
    numbers = (*(0,) * 6, 1, 2)
    dog = SimpleNamespace(numbers=numbers, solid_bodies=(5, 6, 7))
    found = dataclasses.replace(consistent.consistency, masses_from_bounds=(0, 2))
    assert "the masses m0, m2:" in " ".join(found.findings(dog))


def test_without_noise_the_truth_is_found():
    base, p, o = case(jid.robots.planar_arm(2, 0.5), noise=0.0)
    fit = jid.identify(base, o, jid.PhysicallyConsistent(WEIGHTS))
    truth = np.asarray(base.from_standard(p))
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-4, atol=1e-4)
    assert fit.consistency.active == ()


def test_coupled_drives_are_definite():
    terms = (*TERMS, jid.terms.CoupledDrives())
    base, _, o = case(jid.robots.tx40(), terms, noise=6.0)
    fit = jid.identify(base, o, jid.PhysicallyConsistent(WEIGHTS))
    p = dict(zip(base.model.parameter_names, fit.full_parameters, strict=True))
    for own, beside in (("Ia", "Iam"), ("fv", "fvm")):
        matrix = [[p[f"{own}5"], p[f"{beside}6"]], [p[f"{beside}6"], p[f"{own}6"]]]
        assert np.linalg.eigvalsh(matrix)[0] >= 0
    assert jid.validate(fit, o).definiteness.positive_definite


def test_bounds_hold_and_are_named(panda):
    base, _, o = panda
    bounds = jid.consistency.BodyBounds.from_geometry(base.model.robot).replace(
        mass_max=[8, 8, 8, 2, 8, 8, 8],
        mass_min=0.2,
        total_mass=20,
    )
    fit = jid.identify(base, o, jid.PhysicallyConsistent(WEIGHTS, bounds))
    m = fit.consistency.bodies[:, 0]
    np.testing.assert_allclose(m.sum(), 20.0, rtol=1e-9)
    assert (m >= 0.2).all()
    assert m[3] <= 2.0
    notes = " ".join(fit.notes)
    assert "20 kg together" in notes
    assert "masses m1, m2" in notes
    assert "largest mass of body 4" in " ".join(fit.consistency.active)


def test_a_strong_pull_leads_to_its_bodies(panda, consistent):
    base, p, o = panda
    bodies = p[:70].reshape(7, 10)
    gaps = []
    for strength in (1e-2, 1.0, 1e4):
        pull = jid.consistency.EntropicPull(bodies, strength)
        fit = jid.identify(base, o, jid.PhysicallyConsistent(WEIGHTS, pull=pull))
        gaps.append(np.abs(fit.consistency.bodies - bodies).max())
        if strength == 1.0:
            smallest = [
                jid.validate(x, o).definiteness.smallest for x in (consistent, fit)
            ]
            assert smallest[1] > smallest[0] > 0
    assert gaps[0] > gaps[1] > gaps[2]
    assert gaps[2] < 0.05 * gaps[0]


def bounds(**change):
    return lambda: jid.consistency.BodyBounds.from_geometry(jid.robots.panda()).replace(
        **change
    )


def coupled_without_rotors():
    model = jid.Model(jid.robots.tx40(), (jid.RigidBodies(), jid.terms.CoupledDrives()))
    return feasible_set(model, jid.consistency.BodyBounds.from_geometry(model.robot))


FLAT = np.array([[1.0, 0, 0, 0, 1, 1, 3.0, 0, 0, 0]])
REFUSALS = [
    (bounds(mass_min=500.0), "`mass_min`"),
    (bounds(total_mass=5000.0), "`total_mass`"),
    (bounds(radius=[1.0, 2.0]), "`radius`"),
    (lambda: jid.consistency.EntropicPull(FLAT), "`bodies`"),
    (coupled_without_rotors, r"`RotorInertia\(\)`"),
]


@pytest.mark.parametrize(("refused", "message"), REFUSALS)
def test_invalid_knowledge_is_rejected(refused, message):
    with pytest.raises(ValueError, match=message):
        refused()


def test_a_search_without_proof_is_a_note(panda, monkeypatch):
    base, _, o = panda
    monkeypatch.setattr(solver, "MAX_ITERATIONS", 3)
    fit = jid.identify(base, o, jid.PhysicallyConsistent(WEIGHTS))
    assert not fit.consistency.certified
    assert "may exceed the smallest" in fit.notes[-1]
    assert fit.consistency.error_bound > 1e-6
