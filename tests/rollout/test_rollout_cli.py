"""`jaxid rollout`: from an experiment file and logs without torque to a report."""

import json

import mujoco
import numpy as np
import polars as pl
import pytest
import servo_arm
from typer.testing import CliRunner

from jaxid.cli.app import app

FILE = """
[robot]
mjcf = "arm.xml"
[recording]
angles = "position{}"
commands = "command{}"
time = "time"
[rollout]
friction = false
saturation = false
samples = 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rollout")
    (folder / "arm.xml").write_text(servo_arm.model_text())
    (folder / "experiment.toml").write_text(FILE)
    for name, seed in (("a", 0), ("b", 1), ("unseen", 5)):
        log = servo_arm.log(seed, duration=30.0)
        columns = {"time": log.time}
        for j in range(2):
            columns[f"command{j + 1}"] = log.forces[:, j]
            columns[f"position{j + 1}"] = log.angles[:, j]
        pl.DataFrame(columns).write_csv(folder / f"{name}.csv")
    return folder


def test_a_report_without_torques(folder, monkeypatch):
    monkeypatch.chdir(folder)
    words = ["rollout", "experiment.toml", "a.csv", "b.csv", "--verify", "unseen.csv", "-o", "out"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    found = json.loads((folder / "out" / "rollout.json").read_text())
    assert found["errors"]["unseen"]
    assert np.max(found["errors"]["simulated"]) < 1e-3
    assert np.min(found["errors"]["linear"]) > 2e-3
    assert set(found["files"]) <= {p.name for p in (folder / "out").iterdir()}
    assert len(list((folder / "out").glob("robot*.xml"))) == 3
    mujoco.MjModel.from_xml_path(str(folder / "out" / "robot.xml"))
    page = (folder / "out" / "rollout.html").read_text()
    assert "lift" in page
    assert "free-running" in page


def test_the_columns_of_commands_are_needed(folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = FILE.replace('commands = "command{}"', 'forces = "command{}"')
    (folder / "other.toml").write_text(text)
    done = CliRunner().invoke(app, ["rollout", "other.toml", "a.csv"])
    assert done.exit_code != 0
    assert "`recording.commands`" in str(done.exception)
