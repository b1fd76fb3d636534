"""Measured robots, each identified by one command; the numbers are those of published pipelines."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid import cli

pytestmark = pytest.mark.usefixtures("blank_figures")

HERE = Path(__file__).resolve().parent


@pytest.fixture
def identify(shared_data, tmp_path, monkeypatch, capsys):
    """Runs `jaxid identify` on the logs of a robot and reads its result."""

    def identify(experiment, *args):
        words = [str(shared_data / a) if a.endswith(".csv") else a for a in args]
        command = ["identify", str(HERE / experiment), *words, "-o", str(tmp_path / "report")]
        monkeypatch.setattr(sys, "argv", ["jaxid", *command])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        printed = capsys.readouterr()
        assert stopped.value.code == 0, printed.err
        found = json.loads((tmp_path / "report" / "result.json").read_text(encoding="utf-8"))
        return found, " ".join(printed.out.split())

    return identify


def percents(errors):
    return np.array([joint["mean_percent"] for joint in errors["joints"]])


def test_tx40_as_a_whole(identify):
    found, printed = identify("tx40_100hz.toml", "tx40/motor_position.csv")
    assert len(found["base_parameters"]) == 61
    assert found["fit"]["condition_numbers"]["raw"] == pytest.approx(1031, rel=0.02)
    assert found["fit"]["residual"] <= 0.052
    assert found["mass_matrix"]["positive_definite"]
    assert found["fit"]["undetermined"] == []
    rms = [joint["rms"] for joint in found["errors"]["identification"][0]["joints"]]
    np.testing.assert_allclose(rms, [1.52, 1.49, 1.06, 0.50, 0.98, 0.52], rtol=0.05)
    assert "61 base parameters" in printed
    by_name = {p["name"]: p["estimate"] for p in found["base_parameters"]}
    viscous = [by_name[f"fv{i}"] for i in range(1, 7)]
    np.testing.assert_allclose(viscous, [8.05, 5.53, 1.97, 1.11, 1.86, 0.65], rtol=0.05)


def test_tx40_split_in_time(identify):
    found, _ = identify("tx40.toml", "tx40/motor_position.csv", "--split", "0.6")
    train = percents(found["errors"]["identification"][0])
    test = percents(found["errors"]["verification"][0])
    assert train.mean() <= 1.15
    assert test.mean() <= 1.65
    assert (train <= 1.05 * np.array([0.90, 0.90, 0.86, 1.00, 1.98, 1.48])).all()
    assert (test <= 1.05 * np.array([1.20, 2.33, 1.00, 1.01, 1.65, 2.85])).all()


def test_ur10(identify):
    found, _ = identify("ur10.toml", "ur10/exciting_measured.csv")
    assert len(found["base_parameters"]) == 58
    assert found["fit"]["residual"] <= 0.053
    assert found["fit"]["condition_numbers"]["raw"] == pytest.approx(133, rel=0.02)


def test_ur10_split_in_time(identify):
    found, _ = identify("ur10.toml", "ur10/exciting_measured.csv", "--split", "0.6")
    assert found["errors"]["identification"][0]["relative"] <= 0.046
    assert found["errors"]["verification"][0]["relative"] <= 0.077


def test_kr300_is_said_to_be_undetermined_and_a_ridge_transfers(identify):
    verify = ("--verify", "kr300/traj_B.csv", "--verify", "kr300/traj_C.csv")
    logs = ("kr300/traj_A.csv", *verify)
    found, printed = identify("kr300.toml", *logs)
    assert len(found["base_parameters"]) == 58
    assert len(found["fit"]["undetermined"]) >= 5
    assert "NOT DETERMINED by these logs" in printed
    assert [e["recording"] for e in found["errors"]["verification"]] == ["traj_B", "traj_C"]
    assert all(e["relative"] < 0.20 for e in found["errors"]["verification"])
    assert found["beside"]["solution"] == "Complete()"
    plain = found["beside"]["errors"][1:]
    pairs = zip(plain, found["errors"]["verification"], strict=True)
    assert all(a["relative"] > 1.3 * b["relative"] for a, b in pairs)
    assert "plain least squares" in printed
