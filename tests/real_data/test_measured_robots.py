"""Measured robots, each identified by one command; the numbers are those of published pipelines.

`tests/golden` runs the other commands and keeps their numbers, which are compared here.
"""

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


def golden(case):
    return json.loads((HERE.parent / "golden" / f"{case}.json").read_text(encoding="utf-8"))


def test_tx40_as_a_whole():
    found = golden("tx40_100hz")
    assert len(found["parameters"]) == 61
    assert found["condition_numbers"]["raw"] == pytest.approx(1031, rel=0.02)
    assert found["residual"] <= 0.052
    (rms,) = found["errors"].values()
    np.testing.assert_allclose(rms, [1.52, 1.49, 1.06, 0.50, 0.98, 0.52], rtol=0.05)
    viscous = [found["parameters"][f"fv{i}"] for i in range(1, 7)]
    np.testing.assert_allclose(viscous, [8.05, 5.53, 1.97, 1.11, 1.86, 0.65], rtol=0.05)


def test_tx40_split_in_time(identify):
    found, _ = identify("tx40.toml", "tx40/motor_position.csv", "--split", "0.6")
    train, test = (
        np.array([joint["mean_percent"] for joint in found["errors"][role][0]["joints"]])
        for role in ("identification", "verification")
    )
    assert train.mean() <= 1.15
    assert test.mean() <= 1.65
    assert (train <= 1.05 * np.array([0.90, 0.90, 0.86, 1.00, 1.98, 1.48])).all()
    assert (test <= 1.05 * np.array([1.20, 2.33, 1.00, 1.01, 1.65, 2.85])).all()
    assert found["mass_matrix"]["positive_definite"]
    assert found["fit"]["undetermined"] == []


def test_ur10():
    found = golden("ur10")
    assert len(found["parameters"]) == 58
    assert found["residual"] <= 0.053
    assert found["condition_numbers"]["raw"] == pytest.approx(133, rel=0.02)
    train, test = golden("ur10_split")["relative_errors"].values()
    assert train <= 0.046
    assert test <= 0.077


def test_kr300_is_said_to_be_undetermined_and_a_ridge_transfers(identify):
    verify = ("--verify", "kr300/traj_B.csv", "--verify", "kr300/traj_C.csv")
    found, printed = identify("kr300.toml", "kr300/traj_A.csv", *verify)
    assert len(found["base_parameters"]) == 58
    assert len(found["fit"]["undetermined"]) >= 5
    pairs = [set(direction["parameters"]) for direction in found["fit"]["undetermined"]]
    assert {"my2", "fo2"} in pairs
    assert "NOT DETERMINED by these logs" in printed
    ridge, plain = found["errors"]["verification"], found["beside"]["errors"][1:]
    assert [e["recording"] for e in ridge] == ["traj_B", "traj_C"]
    assert found["beside"]["solution"] == "Complete()"
    assert all(e["relative"] < 0.20 for e in ridge)
    assert all(a["relative"] > 1.3 * b["relative"] for a, b in zip(plain, ridge, strict=True))
    rms = [[np.mean([j["rms_relative"] for j in e["joints"]]) for e in x] for x in (plain, ridge)]
    np.testing.assert_allclose(rms, [[0.50, 0.39], [0.26, 0.25]], atol=0.005)  # as in the README
    assert "plain least squares" in printed
