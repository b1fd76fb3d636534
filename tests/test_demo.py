"""The demo in a short form: the paper's findings must come out, and be saved whole."""

import json

import numpy as np
import pytest
from golden_results import TOLERANCE, compare

import jaxid as jid
from jaxid.demo.results import DemoResult, error_table, paper_table, write_study
from jaxid.demo.study import run_study
from jaxid.identification.parameter_changes import Verdict


@pytest.fixture(scope="module")
def found():
    motion = jid.trajectories.random_fourier_series(
        jid.robots.tx90l_on_rail(), omega=0.8, reach=0.7, seed=1
    )
    return run_study(0, lambda name, fraction: None, periods=1, motion=motion)


def test_numbers_are_golden(found):
    fit = found.weighted_model.fit
    # A servo on quantised encoders with stiction amplifies rounding: a coefficient of
    # the motion changed by 4e-16 moves these parameters by 1e-4 (relative to the
    # largest of their kind).
    compare(
        "demo",
        {
            "parameters": dict(
                zip(fit.base.names, map(float, fit.parameters), strict=True)
            ),
            "deviations": list(map(float, fit.standard_deviations)),
            "errors": [found.weighted_model.mean_errors(k) for k in (0, 1)],
        },
        max(TOLERANCE, 2e-3),
    )


def test_base_parameters_are_those_of_the_paper(found):
    assert (found.base.model.size, found.base.size) == (70, 44)
    assert found.base.expressions[0] == "m1 + m2 + m3 - 20*mz4 + Ia1"
    assert found.base.expressions[1] == "mx2 + 0.05*m3 - mz4"


def test_weights_help_the_wrist_and_consistent_bodies_have_a_definite_mass_matrix(
    found,
):
    for recording in (0, 1):
        plain, weighted = (
            x.mean_errors(recording)
            for x in (found.unweighted_model, found.weighted_model)
        )
        assert weighted[6] < 0.5 * plain[6]
        assert max(weighted) < 0.5 * max(plain)
        assert max(found.consistent_model.mean_errors(recording)) < 1.2 * max(weighted)
    assert found.consistent_model.validation.definiteness.positive_definite


def test_friction_falls_with_temperature_and_masses_stay(found):
    cold, warm = (
        np.asarray(found.weighted_model.fit.parameters),
        np.asarray(found.warm_fit.parameters),
    )
    for k in (26, 27, 33, 34):
        assert warm[k] < 0.95 * cold[k]
        # Intervals include stiction, which both logs share.
        assert found.temperature.verdicts[k] in (Verdict.CHANGED, Verdict.PERHAPS)
    assert warm[0] == pytest.approx(cold[0], rel=0.03)
    np.testing.assert_allclose(
        cold[[26, 27, 33, 34]], found.truth[[26, 27, 33, 34]], rtol=0.15
    )


def test_tables_and_files_say_the_same(found, tmp_path):
    rows = {row[0]: row[1:] for row in paper_table(found).rows}
    assert rows["base parameters"] == ("44", "44")
    assert error_table(found, 1).rows[-1][0] == "worst"
    files = write_study(tmp_path / "demo", found)
    assert all(file.is_file() for file in files)
    record = json.loads((tmp_path / "demo" / "demo.json").read_text())
    assert record["base_parameters"] == 44
    weighted = record["estimates"]["weighted"]
    assert weighted["mean_percent_verification"] == found.weighted_model.mean_errors(1)
    said = "\n".join(map(str, DemoResult(found).tables()))
    assert "mx2 + 0.05*m3 - mz4" in said
    assert "predicts the torques of every axis" in said
