"""Runs of one robot: odd ones are named, and pooled intervals hold between runs."""

import dataclasses

import numpy as np
import pytest
from virtual import observations, standard_parameters

import jaxid as jid
from jaxid.identification.agreement import ALL_FORCES, FRICTION, GAIN, LOAD
from jaxid.identification.run_to_run import (
    KindFactors,
    Run,
    drifts,
    pooled_estimate,
)

RUNS = 7
NOISE = 0.05


def run_of(base, name, parameters, seed, gains=1.0):
    """Identify one run: its own motion, and white noise."""
    model = base.model
    log = observations(model, parameters, noise=NOISE, seed=seed, noise_seed=seed)
    log = log.replace(forces=np.asarray(log.forces) * gains)
    return dataclasses.replace(jid.identify(base, log), name=name)


@pytest.fixture(scope="module")
def fleet(base):
    """Return runs of an arm that does not change."""
    p = standard_parameters(base.model)
    return [run_of(base, f"run{k}", p, seed=k) for k in range(RUNS)]


def changed_parameters(base, cause):
    """Return standard parameters after a change: a load, or warm joints."""
    model = base.model
    p = standard_parameters(model)
    names = list(model.parameter_names)
    if cause == LOAD:
        # A point of 0.4 kg at 0.1 m of the last body.
        p[names.index("m2")] += 0.4
        p[names.index("mx2")] += 0.04
        p[names.index("C2")] += 0.004
    if cause == FRICTION:
        for name in ("fv1", "fv2"):
            p[names.index(name)] *= 0.7
    return p


def test_runs_that_do_not_differ_agree(fleet):
    result = jid.agreement(fleet)
    assert not result.odd
    assert not result.drifts
    assert result.verdict.status.name == "GOOD"
    assert result.excess < 2.0


@pytest.mark.parametrize("cause", [LOAD, FRICTION, "joint1", ALL_FORCES])
def test_an_odd_run_is_named_with_its_cause(base, fleet, cause):
    gains = {"joint1": np.array([1.1, 1.0]), ALL_FORCES: 1.1}.get(cause, 1.0)
    name = base.model.robot.joint_names[0]
    odd_fit = run_of(base, "odd", changed_parameters(base, cause), 50, gains)
    result = jid.agreement([*fleet[:3], odd_fit, *fleet[3:]])
    assert [x.run for x in result.odd] == ["odd"]
    expected_cause = f"{GAIN}`{name}`" if cause == "joint1" else cause
    assert result.odd[0].cause.name == expected_cause
    text = " ".join(remark.text for remark in result.findings)
    assert "`odd`" in text
    assert result.verdict.text.startswith(f"{RUNS} of {RUNS + 1} runs agree")


def test_the_size_of_a_load_and_of_a_gain_is_told(base, fleet):
    loaded = run_of(base, "loaded", changed_parameters(base, LOAD), 50)
    stronger = run_of(base, "strong", standard_parameters(base.model), 51, [1.1, 1.0])
    result = jid.agreement([*fleet, loaded, stronger])
    causes = {x.run: x.cause for x in result.odd}
    load = causes["loaded"]
    assert abs(load.sizes[0] - 0.4) < load.half_widths[0] < 0.1
    gain = causes["strong"]
    # It is relative to the run's own forces.
    assert abs(gain.sizes[0] - (1 - 1 / 1.1)) < gain.half_widths[0] < 0.02
    sentence = next(x.text for x in result.findings if "`strong`" in x.text)
    assert "larger" in sentence


def test_a_pool_is_the_weighted_mean_where_runs_agree(fleet):
    runs = jid.agreement(fleet).runs
    means, uncertainty, _ = pooled_estimate(runs, runs[0].kinds)
    variances = np.array([np.diag(run.covariance) for run in runs])
    estimates = np.array([run.parameters for run in runs])
    weighted_means = (estimates / variances).sum(axis=0) / (1 / variances).sum(axis=0)
    deviations = uncertainty.standard_deviations
    assert np.all(np.abs(means - weighted_means) < deviations)
    truth = 1.0 / np.sqrt((1 / variances).sum(axis=0))
    assert np.all((0.4 * truth < deviations) & (deviations < 2.5 * truth))


def simulated_runs(rng, count, between):
    """Return runs of twenty parameters of two kinds with known intervals."""
    size = 20
    kinds = ("a",) * 10 + ("b",) * 10
    scale = 10 ** rng.uniform(-2, 1, size)
    names = tuple(f"p{k}" for k in range(size))
    runs = []
    for k in range(count):
        own = rng.uniform(0.5, 2.0) * scale
        total = np.hypot(own, between * scale)
        values = 1.0 + total * rng.normal(size=size)
        covariance = np.diag(own**2)
        runs.append(Run(f"{k}", names, names, kinds, values, covariance, 100.0))
    return runs


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("between", [0.0, 1.0, 3.0])
def test_pooled_intervals_hold_whatever_runs_differ(count, between):
    rng = np.random.default_rng(count)
    inside = []
    for _ in range(150):
        runs = simulated_runs(rng, count, between)
        means, uncertainty, _ = pooled_estimate(runs, runs[0].kinds)
        inside.append(np.abs(means - 1.0) < uncertainty.half_widths())
    assert 0.92 < np.mean(inside) < 0.98


def test_a_drift_is_told_and_scatter_is_not():
    rng = np.random.default_rng(0)
    changes = 1.0 + np.stack(
        [0.1 * np.linspace(0, 1, 8), 0.05 * rng.normal(size=8)], axis=1
    )
    factors = changes + 0.003 * rng.normal(size=changes.shape)
    found = drifts(KindFactors(("warm", "other"), factors, np.full((8, 2), 0.003)))
    assert [drift.kind for drift in found] == ["warm"]
    assert abs(found[0].change - 0.1) < found[0].half_width < 0.03


def test_runs_must_belong_together(base, fleet):
    with pytest.raises(jid.InputError, match="two or more runs with different names"):
        jid.agreement(fleet[:1])
    with pytest.raises(jid.InputError, match="different names"):
        jid.agreement([fleet[0], fleet[0]])
    rng = np.random.default_rng(0)
    first, second = simulated_runs(rng, 2, 0.0)
    with pytest.raises(jid.InputError, match="different parameters"):
        jid.agreement([first, second._replace(names=(*second.names[:-1], "x"))])
