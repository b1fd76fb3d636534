"""Measured robots, each identified by the README's command.

The numbers are compared with golden results, and with those of published pipelines.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from golden_results import command, compare, numbers_of_report

import jaxid as jid
from jaxid.experiment.experiment import load_experiment

HERE = Path(__file__).resolve().parent


@pytest.fixture
def identify(shared_data, tmp_path, capsys):
    """Run `jaxid identify` on logs, compare with golden results, return the results."""

    def identify(case, experiment, *words):
        words = [
            shared_data / word if word.endswith(".csv") else word for word in words
        ]
        command("identify", HERE / experiment, *words, "-o", tmp_path / "report")
        compare(case, numbers_of_report(tmp_path / "report"))
        found = json.loads(
            (tmp_path / "report" / "result.json").read_text(encoding="utf-8")
        )
        return found, " ".join(capsys.readouterr().out.split())

    return identify


def test_tx40_as_a_whole(identify):
    found, _ = identify("tx40_100hz", "tx40_100hz.toml", "tx40/motor_position.csv")
    assert len(found["base_parameters"]) == 61
    assert found["fit"]["condition_numbers"]["raw"] == pytest.approx(1031, rel=0.02)
    assert found["fit"]["residual"] <= 0.052
    rms = [joint["rms"] for joint in found["errors"]["identification"][0]["joints"]]
    np.testing.assert_allclose(rms, [1.52, 1.49, 1.06, 0.50, 0.98, 0.52], rtol=0.05)
    estimates = {p["name"]: p["estimate"] for p in found["base_parameters"]}
    viscous = [estimates[f"fv{i}"] for i in range(1, 7)]
    np.testing.assert_allclose(viscous, [8.05, 5.53, 1.97, 1.11, 1.86, 0.65], rtol=0.05)


def test_tx40_split_in_time(identify):
    found, _ = identify(
        "tx40", "tx40.toml", "tx40/motor_position.csv", "--split", "0.6"
    )
    train, test = (
        np.array(
            [joint["mean_percent"] for joint in found["errors"][role][0]["joints"]]
        )
        for role in ("identification", "verification")
    )
    assert train.mean() <= 1.15
    assert test.mean() <= 1.65
    assert (train <= 1.05 * np.array([0.90, 0.90, 0.86, 1.00, 1.98, 1.48])).all()
    assert (test <= 1.05 * np.array([1.20, 2.33, 1.00, 1.01, 1.65, 2.85])).all()
    assert found["mass_matrix"]["positive_definite"]
    assert found["fit"]["undetermined"] == []


def test_ur10(identify):
    found, _ = identify("ur10", "ur10.toml", "ur10/exciting_measured.csv")
    assert len(found["base_parameters"]) == 58
    assert found["fit"]["residual"] <= 0.053
    assert found["fit"]["condition_numbers"]["raw"] == pytest.approx(133, rel=0.02)


def test_ur10_split_in_time(identify):
    log = ("ur10/exciting_measured.csv", "--split", "0.6")
    found, _ = identify("ur10_split", "ur10.toml", *log)
    assert found["errors"]["identification"][0]["relative"] <= 0.046
    assert found["errors"]["verification"][0]["relative"] <= 0.077


def test_kr300_is_said_to_be_undetermined_and_a_ridge_transfers(identify, shared_data):
    verify = ("--verify", "kr300/traj_B.csv", "--verify", "kr300/traj_C.csv")
    found, printed = identify("kr300", "kr300.toml", "kr300/traj_A.csv", *verify)
    assert len(found["base_parameters"]) == 58
    assert len(found["fit"]["undetermined"]) >= 5
    pairs = [set(direction["parameters"]) for direction in found["fit"]["undetermined"]]
    assert {"my2", "fo2"} in pairs
    assert "NOT DETERMINED by these logs" in printed
    ridge = found["errors"]["verification"]
    assert [e["recording"] for e in ridge] == ["traj_B", "traj_C"]
    assert all(e["relative"] < 0.20 for e in ridge)
    described = load_experiment(HERE / "kr300.toml")
    paths = [shared_data / "kr300" / f"traj_{name}.csv" for name in "ABC"]
    setup = described.setup
    first, *others = (
        setup.observe(jid.workflow.read_log(setup, path, described.columns))
        for path in paths
    )
    weights = setup.least_squares.weights
    plain = jid.identify(setup.base, first, jid.WeightedLeastSquares(weights))
    errors = jid.validate(plain, others).errors
    assert all(
        a.relative > 1.3 * b["relative"] for a, b in zip(errors, ridge, strict=True)
    )
    rms = [np.mean([j["rms_relative"] for j in e["joints"]]) for e in ridge]
    rms += [float(e.rms_relative.mean()) for e in errors]
    np.testing.assert_allclose(
        rms, [0.22, 0.22, 0.50, 0.39], atol=0.005
    )  # as in the README
