"""`jaxid payload` with a force sensor: tables, page, model, refusals."""

import json

import jax
import numpy as np
import pytest
from test_cli import refused, run  # noqa: F401
from wrench_logs import BIAS, LOAD, ROBOT, TURN, noisy, poses, wrench

import jaxid as jid
from jaxid.robot.forward_kinematics import tip_placement

URDF = "".join(
    f"""<link name="l{i}"/><joint name="j{i + 1}" type="continuous">
    <parent link="l{i}"/><child link="l{i + 1}"/>
    <origin xyz="{" ".join(map(str, ROBOT.offset[i]))}"/>
    <axis xyz="{" ".join(map(str, ROBOT.axis[i]))}"/></joint>"""
    for i in range(3)
)
FILE = """
[robot]
urdf = "arm.urdf"
[recording]
time = "t"
angles = "q{}"
[filter]
kind = "butterworth"
cutoff = 8.0
[rows]
step = 5
[sensor]
wrench = ["fx", "fy", "fz", "tx", "ty", "tz"]
sign = -1
"""
HEADER = "t,q1,q2,q3,fx,fy,fz,tx,ty,tz"


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """Logs of the load; its wrench is written with the sign of most drivers."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "arm.urdf").write_text(
        f'<robot name="arm">{URDF}<link name="l3"/></robot>'
    )
    (folder / "e.toml").write_text(FILE)
    t = np.arange(0.0, 130.0, 0.01)
    drift = np.where(t < 65.0, 0.0, 0.5)[:, None]
    measured = -(noisy(wrench(t), 0) + drift)
    rows = np.column_stack([t, poses(t, 1.0), measured])
    for name, part in (("short", rows[:1500]), ("long", rows)):
        np.savetxt(
            folder / f"{name}.csv", part, delimiter=",", header=HEADER, comments=""
        )
    return folder


def report_on(cell, file, log):
    experiment = jid.experiment.load_experiment(cell / file)
    return jid.workflow.identify_payload_from_logs(
        experiment.setup,
        [],
        [cell / log],
        experiment.columns,
        sensor=experiment.sensor,
    )


def test_a_payload_behind_a_sensor_needs_one_log(cell, run, tmp_path, monkeypatch):  # noqa: F811
    for path in cell.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    code, out, err = run("payload", "e.toml", "--loaded", "short.csv")
    assert code == 0, err
    found = json.loads((tmp_path / "payload" / "payload.json").read_text("utf-8"))
    assert abs(found["mass"] / LOAD.mass - 1.0) < 0.01
    rows = {row["name"]: row for row in found["parameters"]}
    assert abs(rows["rz4"]["estimate"] - TURN[2]) < 0.01
    assert abs(rows["bfz4"]["estimate"] - BIAS[2]) < 0.2
    page = (tmp_path / "payload" / "report.html").read_text("utf-8")
    assert "The payload at the sensor has a mass" in page
    assert "torque error" not in page
    assert "rotation of the force sensor" in page
    assert "sensor fz" in page
    # The exported model compensates the wrench of the load.
    assert run("export", "payload", "--to", "c", "-o", "arm.c")[0] == 0
    assert "arm_wrench" in (tmp_path / "arm.h").read_text()
    # The table that subtracts the load is that of the end-effector.
    assert "[robot.tool]" in out
    assert "body =" not in out


def test_a_wrench_along_the_axes_of_the_ground_is_turned(cell):
    time, *columns = np.loadtxt(cell / "short.csv", delimiter=",", skiprows=1).T
    angles = np.array(columns[:3]).T
    R = jax.vmap(lambda q: tip_placement(ROBOT, q)[0])(angles)
    parts = np.array(columns[3:]).T.reshape(-1, 2, 3)
    turned = np.einsum("nij,nkj->nki", R, parts).reshape(-1, 6)
    rows = np.column_stack([time, angles, turned])
    path = cell / "ground.csv"
    np.savetxt(path, rows, delimiter=",", header=HEADER, comments="")
    (cell / "g.toml").write_text(FILE + "in_ground = true\n")
    found = []
    for file, log in (("e.toml", "short.csv"), ("g.toml", "ground.csv")):
        report = report_on(cell, file, log)
        assert not report.findings
        found.append(report.result.parameters)
    np.testing.assert_allclose(*found, rtol=1e-6, atol=1e-8)


def test_a_bias_that_drifts_is_named(cell):
    report = report_on(cell, "e.toml", "long.csv")
    assert "drifts" in str(report.result)
    assert abs(report.result.mass / LOAD.mass - 1.0) < 0.005
    assert abs(report.result.sensor.bias[0] - BIAS[0] - 0.5) < 0.2


def test_refusals(cell, run, monkeypatch, tmp_path):  # noqa: F811
    for path in cell.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    changes = {
        "sign": ("sign = -1", "sign = 2"),
        "wrench": (', "tz"]', "]"),
        "forces": (FILE[FILE.index("[sensor]") :], ""),
        "column": ('"fx"', '"force_x"'),
    }
    words = {"column": "force_x", "forces": "`recording.forces`"}
    for name, (old, new) in changes.items():
        (tmp_path / f"{name}.toml").write_text(FILE.replace(old, new))
        result = run("payload", f"{name}.toml", "--loaded", "short.csv")
        assert refused(result, words.get(name, f"`{name}`"))
    command = ("payload", "e.toml", "--loaded", "short.csv", "--body", "j1")
    assert refused(run(*command), "`--body`")


def test_a_wrong_sign_is_named_without_its_consequences(cell):
    (cell / "n.toml").write_text(FILE.replace("sign = -1", "sign = 1"))
    report = report_on(cell, "n.toml", "short.csv")
    (finding,) = report.findings
    assert "opposite sign" in finding.text
    assert report.verdict == finding
    assert not report.result.summary().remarks


def test_clean_poses_at_rest_are_no_fault(cell):
    rng = np.random.default_rng(5)
    pose_times = np.repeat(np.arange(24.0), 400)
    angles = poses(pose_times, 1.0) + 1e-5 * rng.normal(size=(len(pose_times), 3))
    # At a hundredth of the speed only gravity is left.
    static = wrench(100.0 * pose_times, 0.01)
    measured = -noisy(static, 6)
    # Moves between the poses are not recorded.
    time = np.arange(len(angles)) / 100 + 10.0 * pose_times
    rows = np.column_stack([time, angles, measured])
    np.savetxt(cell / "rest.csv", rows, delimiter=",", header=HEADER, comments="")
    report = report_on(cell, "e.toml", "rest.csv")
    assert report.findings == []
    assert abs(report.result.mass / LOAD.mass - 1.0) < 0.01
    (remark,) = report.result.summary().remarks
    assert "do not determine the moments" in remark.text
