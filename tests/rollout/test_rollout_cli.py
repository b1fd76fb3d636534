"""`jaxid rollout`: from experiment files and logs, with torques or not, to reports."""

import json
import re

import driven_pendulum
import mujoco
import numpy as np
import polars as pl
import pytest
import servo_arm
from typer.testing import CliRunner

from jaxid.cli.app import app
from jaxid.workflow.report_agreement import agree_reports

FILE = """
[robot]
mjcf = "arm.xml"
[recording]
angles = "position{}"
commands = "command{}"
time = "time"
[rollout]
samples = 2
alike = []
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rollout")
    (folder / "arm.xml").write_text(servo_arm.model_text())
    (folder / "experiment.toml").write_text(FILE)
    # As many and as long as in `test_servo`: their programs are compiled once.
    logs = {name: servo_arm.log(k) for k, name in enumerate("abcd")}
    logs |= {f"short_{k}": servo_arm.log(k, duration=20.0) for k in (0, 1)}
    logs["unseen"] = servo_arm.log(9, duration=20.0)
    for name, log in logs.items():
        columns = {"time": log.time}
        for j in range(2):
            columns[f"command{j + 1}"] = log.forces[:, j]
            columns[f"position{j + 1}"] = log.angles[:, j]
        pl.DataFrame(columns).write_csv(folder / f"{name}.csv")
    return folder


def test_a_report_without_torques(folder, monkeypatch):
    monkeypatch.chdir(folder)
    words = [
        "rollout",
        "experiment.toml",
        *(f"{name}.csv" for name in "abcd"),
        "--verify",
        "unseen.csv",
        "-o",
        "out",
    ]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    found = json.loads((folder / "out" / "rollout.json").read_text())
    assert found["errors"]["unseen"]
    assert np.max(found["errors"]["simulated"]) < 1e-3
    assert np.min(found["errors"]["linear"]) > 2e-3
    assert found["verdict"][0]["status"] == "good"
    models = [
        folder / "out" / "robot.xml",
        *(folder / "out" / "robot_samples").iterdir(),
    ]
    assert len(models) == 3
    for path in models:
        mujoco.MjModel.from_xml_path(str(path))
    page = (folder / "out" / "report.html").read_text()
    for words in ("lift", "free-running", "RMS", "measured and simulated robot"):
        assert words in page
    for text in (page, done.output):
        assert "mrad" in text
        assert "[mrad or mm]" not in text


def test_known_gains_beside_what_the_logs_tell(folder, monkeypatch):
    monkeypatch.chdir(folder)
    gains = """
stiffness = [12.0, 11.0]
damping = [0.5, 1.3]
feed_forward = [nan, 0.1]
contacts = { short_1 = [[4.0, 6.0]] }"""
    text = FILE.replace("samples = 2", gains)
    (folder / "known.toml").write_text(text)
    words = [
        "rollout",
        "known.toml",
        "short_0.csv",
        "short_1.csv",
        "-o",
        "known",
    ]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "not validated on another log" in done.output
    found = json.loads((folder / "known" / "rollout.json").read_text())
    assert found["verdict"][0]["status"] == "doubtful"
    assert found["simulators"]["stiffness"] == [12.0, 11.0]
    findings = {x["text"]: x["status"] for x in found["verdict"]}
    (text,) = [x for x in findings if x.startswith("Given gains: ")]
    assert findings[text] == "doubtful"
    stiffness, *others = text.removeprefix("Given gains: ").split(". ")
    # No weight acts on the first joint.
    assert (
        stiffness
        == "stiffness of turn 12 N m/rad, which cannot be determined from the logs"
    )
    # The second joint has 15.
    assert re.match(
        r"stiffness of lift 11 N m/rad, estimated 1[45]\.\d+ ± 0\.\d+: differs, or "
        r"the controller cancels 2\d % of the gravity",
        others[0],
    )
    assert re.match(r"damping of turn 0.5 N m s/rad, .*: agrees", others[1])
    assert re.match(r"damping of lift 1.3 N m s/rad, .*: differs", others[2])
    assert others[3].endswith("which cannot be determined from the logs.")


def test_contacts_of_a_log_that_is_not_there_are_refused(folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = FILE.replace("samples = 2", "contacts = { short_9 = [[4.0, 6.0]] }")
    (folder / "wrong.toml").write_text(text)
    words = ["rollout", "wrong.toml", "short_1.csv", "-o", "none"]
    done = CliRunner().invoke(app, words)
    assert "(`short_1`), but names `short_9`" in str(done.exception)


def test_a_missing_column_of_commands_is_named(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "wrong.toml").write_text(FILE.replace("command{}", "cmd{}"))
    done = CliRunner().invoke(app, ["rollout", "wrong.toml", "a.csv", "-o", "none"])
    assert "no column `cmd1` for `commands`" in str(done.exception)


TORQUES = """
[robot]
mjcf = "pendulum.xml"
[model]
coulomb = false
rotor_inertia = false
offset = false
[recording]
angles = "q{}"
forces = "tau{}"
time = "time"
[filter]
kind = "butterworth"
cutoff = 30.0
[rollout]
horizon = 0.1
"""


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    folder = tmp_path_factory.mktemp("torques")
    (folder / "pendulum.xml").write_text(driven_pendulum.XML)
    (folder / "experiment.toml").write_text(TORQUES)
    for seed in range(2):
        log = driven_pendulum.log(seed)
        columns = {"time": log.time}
        for j in range(2):
            columns[f"q{j + 1}"], columns[f"tau{j + 1}"] = (
                log.angles[:, j],
                log.forces[:, j],
            )
        pl.DataFrame(columns).write_csv(folder / f"log{seed}.csv")
    return folder


def test_a_report_with_torques(driven, monkeypatch):
    monkeypatch.chdir(driven)
    words = [
        "rollout",
        "experiment.toml",
        "log0.csv",
        "--verify",
        "log1.csv",
        "-o",
        "out",
    ]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "The simulation is closer to the robot" in done.output
    found = json.loads((driven / "out" / "rollout.json").read_text())
    assert (found["kind"], found["horizon"]) == ("torques", 0.1)
    assert found["errors"]["unseen"]
    errors = found["errors"]
    ratio = np.array(errors["simulated"]) / np.array(errors["fit_of_torques"])
    assert (ratio < 0.3).all()
    delay = next(x for x in found["parameters"] if x["name"] == "delay")
    assert delay["estimate"] == pytest.approx(driven_pendulum.LATE + 0.001, abs=5e-4)
    page = (driven / "out" / "report.html").read_text()
    assert "log1: measured, and simulated in windows of 0.1 s" in page


def test_settings_of_the_other_kind_of_logs_are_rejected(driven, folder, monkeypatch):
    for place, text, key in (
        (driven, TORQUES, "samples = 2"),
        (folder, FILE, "horizon = 0.1"),
    ):
        monkeypatch.chdir(place)
        (place / "other.toml").write_text(f"{text}{key}\n")
        log = "log0.csv" if place is driven else "a.csv"
        done = CliRunner().invoke(app, ["rollout", "other.toml", log, "-o", "none"])
        assert done.exit_code != 0
        assert f"`rollout.{key.split()[0]}` is for logs" in str(done.exception)
        assert not (place / "none").exists()


@pytest.mark.parametrize("key", ["friction = false", "integral = true"])
def test_keys_of_effects_that_are_always_tried_are_unknown(folder, monkeypatch, key):
    monkeypatch.chdir(folder)
    (folder / "former.toml").write_text(f"{FILE}{key}\n")
    done = CliRunner().invoke(app, ["rollout", "former.toml", "a.csv", "-o", "none"])
    assert f"`rollout.{key.split()[0]}` is not a known key" in str(done.exception)


def test_dry_friction_with_torques_must_be_smooth(driven, monkeypatch):
    monkeypatch.chdir(driven)
    (driven / "hard.toml").write_text(
        TORQUES.replace("coulomb = false", "coulomb.hard = true")
    )
    done = CliRunner().invoke(app, ["rollout", "hard.toml", "log0.csv", "-o", "none"])
    assert done.exit_code != 0
    assert "epsilon = 0.1" in str(done.exception)
    assert not (driven / "none").exists()


def test_reports_of_two_rollouts_are_compared(tmp_path):
    """Their estimates are independent: pooled ones are means, weighed by variances."""
    row = {"name": "B", "joint": "lift", "unit": "s", "kind": "damping / stiffness"}
    for name, estimate, deviation in (("first", 0.05, 0.001), ("second", 0.053, 0.002)):
        errors = {"standard_deviation": deviation, "dof": 40.0}
        delay = {"name": "delay", "unit": "s", "kind": "delay", "estimate": 0.01}
        rows = [{**row, "estimate": estimate, **errors}, {**delay, **errors}]
        (tmp_path / name).mkdir()
        text = json.dumps({"parameters": rows})
        (tmp_path / name / "rollout.json").write_text(text)
    report = agree_reports([tmp_path / "first", tmp_path / "second"])
    assert report.result.names == ("B (lift)", "delay")
    assert report.result.kinds == ("damping / stiffness", "delay")
    assert not report.result.odd
    np.testing.assert_allclose(report.result.parameters, [0.0506, 0.01], rtol=0.02)
