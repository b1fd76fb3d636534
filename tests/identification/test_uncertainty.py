"""The spectral sandwich against its definition, and the scatter of many draws."""

import itertools

import numpy as np
import pytest
from scipy import signal, special
from virtual import (
    dense,
    left_out_in_turn,
    observations,
    planar_base,
    standard_parameters,
)

import jaxid as jid
from jaxid.identification.uncertainty import UNCERTAINTIES, spectra_of_rows
from jaxid.identification.uncertainty.blocks import block_covariance
from jaxid.identification.uncertainty.slow_rows import HeldFriction
from jaxid.identification.uncertainty.spectral import (
    SpectralTable,
    sandwich,
    white_variances,
)
from jaxid.program.sample_methods import in_numpy

ESTIMATOR = jid.WeightedLeastSquares(jid.estimators.ResidualVariances(0))


@pytest.fixture(scope="module")
def base():
    return planar_base()


def row_spectra(base, recordings):
    problem = jid.RegressionProblem(base, recordings)
    estimate = ESTIMATOR(problem)
    return spectra_of_rows.row_spectra(problem, estimate), estimate


def by_definition(base, o, weights):
    """The prototype's formulas written out with dense matrices, for one recording."""
    theta, forces, _ = dense(base, o)
    n = base.model.robot.joints
    A = (weights[:, None] * theta.reshape(-1, n, base.size)).reshape(-1, base.size)
    y = (forces.reshape(-1, n) * weights).ravel()
    inverse = np.linalg.inv(A.T @ A)
    P, r = (
        (A @ inverse).reshape(-1, n, base.size),
        (y - A @ (inverse @ A.T @ y)).reshape(-1, n),
    )
    N = len(r)
    f = np.fft.rfftfreq(N, o.row_time)
    # Lines and their mirror images.
    m = np.unique(np.abs(np.fft.fftfreq(N).round(12)), return_counts=True)[1]
    Pf, Af = np.fft.rfft(P, axis=0), np.fft.rfft(A.reshape(-1, n, base.size), axis=0)
    h = np.real(np.sum(Pf.conj() * Af, axis=2)) / N
    power = np.abs(np.fft.rfft(r, axis=0)) ** 2 / N
    half = np.maximum(max(0.25, 4 / (N * o.row_time)), 0.3 * f)
    within = (np.abs(f[:, None] - f) <= half[:, None] * (1 + 1e-9)) * m / 2
    phi = (within @ power) / (within @ (1 - h))
    weighted = Pf * np.sqrt(m / N)[:, None, None]
    covariance = np.einsum("fji,fj,fjk->ik", weighted, phi, weighted.conj()).real
    C = np.einsum(
        "fji,fg,fj->ijg", np.abs(weighted) ** 2, within, 1 / (within @ (1 - h))
    )
    x = C * power.T
    scatter = np.sum(x**2 * 2 / m, axis=(1, 2))
    return covariance, 4 * np.sum(x, axis=(1, 2)) ** 2 / scatter


@pytest.mark.parametrize("samples", [400, 401])
def test_the_sandwich_is_its_definition(base, samples):
    o = observations(
        base.model, standard_parameters(base.model), samples=samples, noise=0.4
    )
    found, e = row_spectra(base, [o])
    covariance, dof = by_definition(base, o, np.asarray(e.weights))
    got, got_dof = sandwich(found)
    np.testing.assert_allclose(np.diag(got), np.diag(covariance), rtol=1e-8)
    np.testing.assert_allclose(got_dof, dof, rtol=1e-8)
    size = np.sqrt(np.diag(covariance))
    # Pairs of parameters see the spectrum in bins.
    correlation = got / size / size[:, None]
    np.testing.assert_allclose(
        correlation, covariance / size / size[:, None], atol=0.03
    )
    assert np.linalg.eigvalsh(correlation)[0] > 0


def coloured(random, shape, memory, dt):
    kept = np.exp(-dt / memory)
    start = kept * random.standard_normal((shape[0], 1, shape[2]))
    white = random.standard_normal(shape)
    return signal.lfilter([np.sqrt(1 - kept**2)], [1, -kept], white, axis=1, zi=start)[
        0
    ]


def coverage(base, recordings, memory, draws, seed=0):
    """Share of draws whose 95 % interval holds the truth, by parameter; naive too."""
    random = np.random.default_rng(seed)
    spectra, e = row_spectra(base, recordings)
    lines = spectra.lines
    w, inverse = np.asarray(e.weights), np.asarray(e.inverse)
    columns = [np.zeros((o.rows, len(w), base.size)) for o in recordings]
    for chunk in jid.RegressionProblem(base, recordings).chunks():
        for j, own in enumerate(chunk.indices):
            weighted = w[j] * chunk.mask[:, j, None] * chunk.columns[j]
            columns[chunk.recording][chunk.rows, j, list(own)] = weighted
    parts = []
    for o, A in zip(recordings, columns, strict=True):
        noise = w * coloured(random, (draws, o.rows, len(w)), memory, o.row_time)
        parts.append((o, A, noise * np.asarray(o.mask)))
    error = sum(np.einsum("dtj,tjk->dk", noise, A) for _, A, noise in parts) @ inverse
    count = sum(np.asarray(o.mask).sum(axis=0) for o in recordings)
    power = naive = 0.0
    for o, A, noise in parts:
        r = (noise - np.einsum("tjk,dk->dtj", A, error)) * np.asarray(o.mask)
        naive = naive + np.sum(r**2, axis=1) / count
        for a, b in o.row_segments:
            spectrum = np.abs(np.fft.rfft(r[:, a:b], axis=1)) ** 2 / (b - a)
            power = power + np.moveaxis(spectrum, 1, 2)
    variance, dof = SpectralTable.of(lines)(power)
    quantile = special.stdtrit(np.maximum(dof, 1), 0.975)
    honest = np.mean(np.abs(error) <= quantile * np.sqrt(variance), axis=0)
    squares = sum(np.einsum("tjk->jk", (A @ inverse) ** 2) for _, A, _ in parts)
    return honest, np.mean(np.abs(error) <= 1.96 * np.sqrt(naive @ squares), axis=0)


def moved(samples, seed=0):
    """Sinusoids of 0.17 to 0.61 Hz, at 50 Hz."""
    w = 2 * np.pi * np.array([0.17, 0.29, 0.47, 0.61])[:, None]
    a, phase = np.random.default_rng(seed).uniform(
        [[[0.2]], [[0]]], [[[0.6]], [[6]]], (2, 4, 2)
    )
    z = a * np.exp(1j * (w * 0.02 * np.arange(samples)[:, None, None] + phase))
    return jid.Motion(*(np.sum((1j * w) ** k * z, axis=1).imag for k in range(3)))


def long_one(base, *, segments=None, mask=None, seed=0, samples=1000):
    """20 s at 50 Hz: what is left of a fast log."""
    m, p = moved(samples, seed), standard_parameters(base.model)
    forces = in_numpy(base.model, base.model.forces, m.q, m.qd, m.qdd, shared=(p,))
    return jid.Observations.of(
        *(m.q, m.qd, m.qdd, forces),
        sample_time=0.02,
        filter=jid.ZeroPhaseButterworth(20.0, force_cutoff=np.inf, margin=0.0),
        segments=((0, samples),) if segments is None else segments,
        mask=mask,
    )


SLOW = np.abs(moved(1000).qd) > 0.3


@pytest.mark.parametrize(
    "options",
    [
        [{}],
        [{"seed": 1}, {"seed": 2}],
        [{"segments": ((0, 500), (500, 1000))}],
        [{"mask": SLOW}],
    ],
    ids=["one", "two recordings", "a gap", "slow rows left out"],
)
@pytest.mark.parametrize("memory", [1e-6, 0.3])
def test_intervals_hold_the_truth_as_often_as_they_say(base, options, memory):
    recordings = [long_one(base, **x) for x in options]
    honest, naive = coverage(base, recordings, memory, 1000)
    assert abs(honest.mean() - 0.95) < 0.015
    assert honest.min() > 0.9
    assert honest.max() < 0.99
    if memory == 0.3:
        assert naive.mean() < 0.6


def test_long_logs_in_stretches_agree_with_the_whole(base, monkeypatch):
    o = long_one(base, samples=24000)
    noise = coloured(np.random.default_rng(3), (1, 24000, 2), 0.3, 0.02)[0]
    o = o.replace(forces=o.forces + noise)
    whole = jid.identify(base, o, ESTIMATOR)
    monkeypatch.setattr(spectra_of_rows, "MAX_ROWS", 1500)
    divided = jid.identify(base, o, ESTIMATOR)
    np.testing.assert_allclose(
        divided.standard_deviations, whole.standard_deviations, rtol=0.06
    )
    monkeypatch.setattr(spectra_of_rows, "MAX_SAMPLES", 8000)
    some = jid.identify(base, o, ESTIMATOR)
    np.testing.assert_allclose(
        some.standard_deviations, whole.standard_deviations, rtol=0.15
    )
    assert np.median(whole.uncertainty.ratios) > 2


def test_errors_in_the_part_that_decides_make_intervals_wider(base):
    """A quick part at the start with larger errors decides a slow log's inertias."""
    random, p = np.random.default_rng(5), standard_parameters(base.model)
    quick = np.where(np.arange(2000) < 100, 10.0, 1.0)[:, None]
    q, qd, qdd = (
        random.standard_normal((3, 2000, 2)) * quick * [[[1.0]], [[0.1]], [[1.0]]]
    )
    forces = np.asarray(base.model.inverse_dynamics(p, jid.Motion(q, qd, qdd)))
    held, alone = [], []
    for _ in range(30):
        noisy = forces + 0.1 * quick**2 * random.standard_normal(forces.shape)
        o = jid.Observations.of(q, qd, qdd, noisy, sample_time=0.01)
        fit = jid.identify(base, o, ESTIMATOR)
        errors = np.abs(fit.parameters - base.from_standard(p))
        held.append(errors <= fit.uncertainty.half_widths())
        covariance, _ = sandwich(row_spectra(base, [o])[0])
        alone.append(errors <= 1.96 * np.sqrt(np.diag(covariance)))
    assert np.mean(alone) < 0.75
    assert 0.88 < np.mean(held) < 0.99


def test_friction_that_lacks_near_rest_is_part_of_the_intervals():
    """Joints without dry friction below a speed: slow rows disagree with the others."""
    base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4)))
    parameters = standard_parameters(base.model)
    exact = observations(base.model, parameters, samples=2000)
    speeds = np.abs(exact.motion.qd)
    slow_rows = speeds < 0.04 * speeds.max(axis=0)
    lacking_forces = np.where(slow_rows, 0.5 * np.sign(exact.motion.qd), 0.0)
    friction = [x[:2] in ("fv", "fc") for x in base.names]
    random = np.random.default_rng(3)
    held, alone, widening = [], [], []
    for _ in range(12):
        noisy = exact.forces + 0.1 * random.standard_normal(exact.forces.shape)
        noise_only = exact.replace(forces=noisy)
        fit = jid.identify(base, noise_only, ESTIMATOR)
        widening.append(fit.standard_deviations / sandwich_alone(base, noise_only))

        sticking = exact.replace(forces=noisy - lacking_forces)
        fit = jid.identify(base, sticking, ESTIMATOR)
        errors = np.abs(fit.parameters - base.from_standard(parameters))[friction]
        held.append(errors <= fit.uncertainty.half_widths()[friction])
        alone.append(errors <= 1.96 * sandwich_alone(base, sticking)[friction])
        assert "`rows.min_speed`" in " ".join(fit.notes)
    assert np.mean(alone) < 0.7
    assert np.mean(held) > 0.9
    assert np.mean(widening) < 1.05


def test_a_direction_of_one_block_alone_does_not_spoil_the_jackknife():
    """Only the first block tells the first unknown from the third."""
    random = np.random.default_rng(6)
    rows = random.normal(size=(10, 50, 3))
    rows[1:, :, 2] = rows[1:, :, 0] + 1e-6 * rows[1:, :, 2]
    every_row = rows.reshape(-1, 3)
    forces = random.normal(size=500)
    inverse = np.linalg.inv(every_row.T @ every_row)
    residuals = (forces - every_row @ inverse @ every_row.T @ forces).reshape(10, 50)
    blocks = list(zip(rows, residuals, strict=True))
    covariance, _ = block_covariance(blocks, inverse)
    ratios = np.sqrt(np.diag(covariance) / np.diag(inverse))
    assert 0.5 < ratios[1] < 2.0
    assert (ratios < 4.0).all()


def test_held_friction_changes_estimates_as_columns_of_a_larger_fit():
    random = np.random.default_rng(5)
    rows = random.normal(size=(300, 6))
    columns = np.column_stack([random.normal(size=(300, 3)), np.zeros(300)])
    columns[:, 0] += rows[:, 1]
    forces = random.normal(size=300)
    inverse = np.linalg.inv(rows.T @ rows)
    p = inverse @ rows.T @ forces
    half = 0.5  # share of the rows that were looked at: the products are smaller
    held = HeldFriction(
        half * rows.T @ columns,
        half * columns.T @ columns,
        half * columns.T @ (forces - rows @ p),
        half,
    )
    changes, growth = held.changes(inverse)

    every_column = np.column_stack([rows, columns[:, :3]])
    larger_inverse = np.linalg.inv(every_column.T @ every_column)
    larger_fit = (larger_inverse @ every_column.T @ forces)[:6]
    assert np.allclose(changes, larger_fit - p)
    variances = np.diag(larger_inverse)[:6] / np.diag(inverse)
    assert np.allclose(half * growth, variances - 1.0)


def sandwich_alone(base, o):
    """Deviations without the jackknife's word and that of slow rows."""
    covariance, _ = sandwich(row_spectra(base, [o])[0])
    return np.sqrt(np.diag(covariance))


def test_intervals_and_whiteness_of_a_fit(base):
    o = long_one(base)
    white = np.random.default_rng(0).standard_normal((1000, 2))
    slow = coloured(np.random.default_rng(1), (1, 1000, 2), 0.3, 0.02)[0]
    fit = jid.identify(base, o.replace(forces=o.forces + white), ESTIMATOR)
    half = special.stdtrit(fit.uncertainty.dof, 0.95) * fit.standard_deviations
    expected = np.stack([fit.parameters - half, fit.parameters + half], axis=1)
    np.testing.assert_allclose(fit.intervals(0.9), expected)
    # Rows that are independent: all three methods say about the same.
    assert 0.8 < np.median(fit.uncertainty.ratios) < 1.2
    assert 0.6 < np.median(fit.uncertainty.jackknife / fit.standard_deviations) < 1.6
    with pytest.raises(ValueError, match="`level`"):
        fit.intervals(95.0)
    noise = np.stack([white[:, 0], slow[:, 1]], axis=1)
    found = jid.identify(
        base, o.replace(forces=o.forces + noise), ESTIMATOR
    ).residual_spectra
    assert found.white == (True, False)
    assert found.low_frequency[1] > 0.5 > 0.2 > found.low_frequency[0]
    # One-sided densities: their area is the variance.
    area = np.trapezoid(found.density, found.frequency, axis=1)
    np.testing.assert_allclose(area, [1.0, 0.8], rtol=0.1)


@pytest.mark.parametrize("name", UNCERTAINTIES)
def test_every_uncertainty_knows_white_noise_and_what_is_undetermined(base, name):
    """White errors are independent: all methods agree, each as well as it can."""
    p = standard_parameters(base.model)
    o = observations(base.model, p, noise=np.array([0.5, 0.1]), samples=2000)
    method = UNCERTAINTIES[name]()
    errors = jid.identify(base, o, ESTIMATOR, uncertainty=method).uncertainty
    assert 0.6 < np.median(errors.ratios) < 1.6
    assert np.linalg.eigvalsh(errors.covariance)[0] > 0
    assert (errors.dof >= 1.0).all()
    half_widths = errors.half_widths()
    assert (half_widths > 1.9 * errors.standard_deviations).all()
    still = observations(base.model, p, noise=0.1, still=(1,))
    fit = jid.identify(base, still, ESTIMATOR, uncertainty=method)
    assert np.isinf(fit.standard_deviations[base.names.index("fv2")])


def from_factors(base, o, divisions):
    blocks = jid.RegressionProblem(base, [o], divisions=divisions).blocks
    problem = jid.RegressionProblem(base, blocks=blocks)
    return blocks, jid.identification.identify.fit_problem(problem, ESTIMATOR)


def test_draws_have_the_intervals_and_correlations_of_the_fit(base):
    truth = standard_parameters(base.model)
    log = observations(base.model, truth, noise=np.full(2, 0.1))
    fit = jid.identify(base, log)
    draws = fit.draws(20_000, seed=3)
    np.testing.assert_array_equal(draws[:5], fit.draws(20_000, seed=3)[:5])
    deviations = fit.standard_deviations
    ends = np.quantile(draws, [0.025, 0.975], axis=0)
    error = (ends - fit.intervals(0.95).T) / deviations
    assert np.abs(error).max() < 0.1
    correlation = fit.covariance / np.outer(deviations, deviations)
    # Errors of 20,000 draws are 0.007; heavy tails take little of a correlation.
    assert np.abs(np.corrcoef(draws.T) - correlation).max() < 0.06


def test_frames_hold_what_the_fit_says(base):
    log = observations(base.model, standard_parameters(base.model))
    fit = jid.identify(base, log)
    frame = fit.to_polars()
    assert frame.height == base.size
    np.testing.assert_array_equal(frame["estimate"], fit.parameters)
    np.testing.assert_array_equal(frame["high_95"], fit.intervals(0.95)[:, 1])
    assert tuple(frame["expression"]) == base.expressions
    try:
        import pandas
    except ImportError:
        with pytest.raises(jid.InputError, match=r"pip install.*pandas"):
            fit.to_pandas()
    else:
        pandas.testing.assert_series_equal(
            fit.to_pandas()["unit"], pandas.Series(base.units, name="unit")
        )


def test_factors_alone_are_judged_by_blocks(base):
    o = observations(base.model, standard_parameters(base.model), noise=0.3)
    blocks, fit = from_factors(base, o, 12)
    left_out = left_out_in_turn(blocks, fit.weights)
    expected = np.sqrt(
        11 / 12 * np.sum((left_out - left_out.mean(axis=0)) ** 2, axis=0)
    )
    np.testing.assert_allclose(fit.standard_deviations, expected, rtol=1e-7)
    assert (fit.uncertainty.dof == 11).all()
    assert any("block jackknife" in note for note in fit.notes)
    _, one = from_factors(base, o, 1)
    np.testing.assert_array_equal(
        one.standard_deviations, one.naive_standard_deviations
    )
    assert any("only one block of time" in note for note in one.notes)


def test_many_gaps_cost_no_memory_and_change_little(base, monkeypatch):
    """Stretches of many lengths share lines, filled up with rows that do not count."""
    ends = np.cumsum([0, *range(110, 150, 5)])
    segments = tuple((int(a), int(b)) for a, b in itertools.pairwise(ends))
    o = long_one(base, segments=segments, samples=int(ends[-1]))
    noise = coloured(np.random.default_rng(8), (1, o.rows, 2), 0.1, o.row_time)[0]
    o = o.replace(forces=o.forces + noise)
    shared, _ = row_spectra(base, [o])
    assert [x.stretches for x in shared.lines] == [8]
    monkeypatch.setattr(spectra_of_rows, "MAX_LENGTHS", 8)
    apart, _ = row_spectra(base, [o])
    assert len(apart.lines) == 8
    (one, _), (other, _) = sandwich(shared), sandwich(apart)
    ratio = np.sqrt(np.diag(one) / np.diag(other))
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)
    white = [white_variances(spectra.lines) for spectra in (shared, apart)]
    np.testing.assert_allclose(*white, rtol=1e-9)
