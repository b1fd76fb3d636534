"""Contract of every criterion, and each against its textbook formula in NumPy."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.excitation import criteria as members
from jaxid.excitation.criteria import (
    CRITERIA,
    Information,
    information,
    standard_deviations,
)
from jaxid.excitation.criteria.functions_of_eigenvalues import log_condition, spectral
from jaxid.trajectory.fourier import FourierBasis

SIZE = 7


def sample(seed=0):
    random = np.random.default_rng(seed)
    A, B = random.standard_normal((2, 30, SIZE)) * np.geomspace(0.1, 10.0, SIZE)
    return Information(A.T @ A, B.T @ B, np.geomspace(2.0, 0.5, SIZE))


def changed(information, D, h):
    return Information(
        information.plain + h * D, information.weighted + h * D, information.sizes
    )


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_every_criterion_falls_with_information_and_uses_only_what_it_declares(
    criterion,
):
    """Contract of the family: a unique title, less for four times the information."""
    titles = [member.name for member in CRITERIA.values()]
    assert titles.count(criterion.name) == 1
    info = sample()
    value = criterion.value(info)
    assert np.isfinite(value)
    assert value > 0.0
    twice = Information(4.0 * info.plain, 4.0 * info.weighted, info.sizes)
    assert criterion.value(twice) <= value * (1.0 + 1e-9)
    stretch = np.diag(np.linspace(1.0, 3.0, SIZE))
    for field, is_used in (
        ("plain", not criterion.weighted),
        ("weighted", criterion.weighted),
    ):
        other = stretch @ getattr(info, field) @ stretch
        change = dataclasses.replace(info, **{field: other + np.eye(SIZE)})
        assert (criterion.value(change) != value) == is_used


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
@pytest.mark.parametrize("sharpness", [None, 8.0])
def test_gradients_are_central_differences(criterion, sharpness):
    info = jax.tree.map(jnp.asarray, sample())
    random, h = np.random.default_rng(1), 1e-5
    value = jax.jit(lambda i: criterion(i, sharpness))
    g = jax.jit(jax.grad(value))(info)
    total = np.asarray(g.plain + g.weighted)
    for _ in range(4):
        D = random.standard_normal((SIZE, SIZE))
        D = D + D.T
        up, down = (value(changed(info, D, s * h)) for s in (1, -1))
        slope = float(up - down) / (2 * h)
        assert abs(np.sum(total * D) - slope) <= 1e-6 * np.linalg.norm(
            total
        ) * np.linalg.norm(D)


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_smooth_values_lie_above_the_exact_ones_and_approach_them(criterion):
    info = jax.tree.map(jnp.asarray, sample())
    exact, blunt, sharp = (float(criterion(info, p)) for p in (None, 4.0, 100.0))
    assert blunt >= sharp - 1e-12 >= exact - 1e-9
    assert sharp - exact < 0.05


def test_every_criterion_is_in_the_documentation():
    page = (Path(__file__).parents[2] / "docs" / "excitation.md").read_text()
    for name in CRITERIA:
        assert f"`{name}`" in page, "add a row to the table of docs/excitation.md"


def test_values_are_the_textbooks():
    info = sample(2)
    V = info.weighted
    S = np.diag(info.sizes)
    scaled = V / np.sqrt(np.outer(np.diag(V), np.diag(V)))
    expected = {
        "condition number of Λ (Eq. 36)": np.linalg.cond(info.plain),
        "condition number, weighted": np.linalg.cond(V),
        "condition number, weighted, columns scaled": np.linalg.cond(scaled),
        members.DOptimal.name: np.linalg.det(V) ** (-0.5 / SIZE),
        members.AOptimal.name: np.sqrt(np.trace(np.linalg.inv(S @ V @ S)) / SIZE),
        members.EOptimal.name: np.sqrt(np.linalg.norm(np.linalg.inv(S @ V @ S), 2)),
    }
    found = {criterion.name: criterion.value(info) for criterion in CRITERIA.values()}
    assert found == pytest.approx(expected, rel=1e-8)


def test_own_sizes_replace_those_of_random_motions():
    info, sizes = sample(), np.full(SIZE, 3.0)
    for kind in (members.AOptimal, members.EOptimal):
        same = Information(info.plain, info.weighted, sizes)
        assert kind(sizes).value(info) == pytest.approx(kind().value(same))


def test_units_and_the_choice_of_base_parameters_do_not_move_the_d_optimum():
    one, two = sample(0), sample(1)
    T = np.random.default_rng(5).standard_normal((SIZE, SIZE))
    d = members.DOptimal()

    def log(information, T):
        w = jnp.asarray(T.T @ information.weighted @ T)
        return float(d(Information(w, w, information.sizes)))

    here = log(one, np.eye(SIZE)) - log(two, np.eye(SIZE))
    assert log(one, T) - log(two, T) == pytest.approx(here, rel=1e-9)


def test_equal_eigenvalues_are_differentiated():
    g = jax.grad(lambda L: spectral(log_condition, L, 8.0))(2.0 * jnp.eye(4))
    assert np.isfinite(g).all()


def test_information_is_that_of_all_samples(base, random):
    basis = FourierBasis(3, 1.2)
    weights, prior = np.array([0.1, 0.7]), 1e-3 * np.eye(base.size)
    for x in random.standard_normal((3, 2, basis.variables)):
        motion = basis.trajectory(x).motion(basis.times(50))
        theta = np.asarray(base.regressor(motion))
        plain = np.einsum("sji,sjk->ik", theta, theta)
        weighted = np.einsum("sji,j,sjk->ik", theta, weights**2, theta) + prior
        exact = information(base, motion, weights, prior)
        for got, asked in ((exact.plain, plain), (exact.weighted, weighted)):
            np.testing.assert_allclose(got, asked, atol=1e-10 * np.abs(asked).max())


def test_the_compiled_value_is_that_of_the_information(free):
    x = free.random(jax.random.key(8))
    exact = free.criterion(free.information(x))
    assert float(free.value(x)) == pytest.approx(float(exact), abs=1e-10)


def test_deviations_are_those_of_the_inverse_and_infinite_where_nothing_is_known():
    V = sample().weighted
    np.testing.assert_allclose(
        standard_deviations(V), np.sqrt(np.diag(np.linalg.inv(V))), rtol=1e-8
    )
    A = np.random.default_rng(0).standard_normal((30, 4))
    A[:, 2] = 0.0
    A[:, 1] = A[:, 0]
    found = standard_deviations(A.T @ A)
    np.testing.assert_array_equal(np.isinf(found), [True, True, True, False])
