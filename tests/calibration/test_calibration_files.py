"""Sessions in files become a report, and the robot's file with other origins."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

pinocchio = pytest.importorskip("pinocchio", reason="Pinocchio is not installed")
mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from true_arm import TrueArm, random_poses, true_origins
from typer.testing import CliRunner

import jaxid as jid
from jaxid.cli.app import app

URDF = """\
<robot name="arm">
  <link name="base"/>
  {links}
</robot>
"""
LINK = """\
<link name="link{i}"><inertial><origin xyz="0 0 {half}"/><mass value="{mass}"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="link{i}"/>
<origin xyz="0.02 0 {length}" rpy="0.3 {tilt} 0"/><axis xyz="0 {y} {z}"/>
<limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
"""
MASSES = (4.0, 3.0, 2.0, 1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An arm of four joints, and three sessions in which a tracker measured its tip."""
    folder = tmp_path_factory.mktemp("calibration")
    links = [
        LINK.format(
            i=i,
            parent=f"link{i - 1}" if i else "base",
            mass=MASSES[i],
            half=0.15,
            length=0.3,
            tilt=0.2 * i,
            y=i % 2,
            z=1 - i % 2,
        )
        for i in range(4)
    ]
    (folder / "arm.urdf").write_text(URDF.format(links="".join(links)))
    robot = jid.load_urdf(folder / "arm.urdf")
    arm = TrueArm(robot, true_origins(robot), masses=np.array(MASSES))
    rng = np.random.default_rng(0)
    for session in range(3):
        q = random_poses(robot, 20, session)
        points = arm.placements(q, (0.0, 0.1, 0.2))[1]
        measured = 1e3 * (points + rng.normal(size=3)) + 0.05 * rng.normal(size=(20, 3))
        table = np.column_stack([np.rad2deg(q), measured])
        place = folder / "sessions" / f"day {session}"
        place.mkdir(parents=True)
        header = "q1,q2,q3,q4,x,y,z"
        np.savetxt(
            place / "tracker.csv", table, delimiter=",", header=header, comments=""
        )
    (folder / "experiment.toml").write_text(
        '[robot]\nurdf = "arm.urdf"\n[calibration]\nobservation = "measured_position"\n'
        'joints = "q{}"\nposition = ["x", "y", "z"]\n'
        'length_unit = "mm"\nangle_unit = "deg"\n'
    )
    return folder


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def report(folder):
    output = folder / "calibrated"
    result = run(
        "calibrate", folder / "experiment.toml", folder / "sessions", "-o", output
    )
    assert result.exit_code == 0, result.output
    return output


def test_a_report_has_page_numbers_and_robot(report):
    names = {path.name for path in report.iterdir()}
    poses = "poses_to_record.csv"
    results = {"report.html", "calibration.json", "calibration.csv", "robot.urdf"}
    assert names == {*results, poses}
    # Angles are in the unit of the files.
    table = np.genfromtxt(report / poses, delimiter=",", names=True)
    assert table.dtype.names == ("session", "j0", "j1", "j2", "j3")
    assert len(table) == 60
    assert 57 < max(np.abs(table[name]).max() for name in table.dtype.names[1:]) < 115
    content = json.loads((report / "calibration.json").read_text())
    assert content["schema"] == "jaxid-calibration/1"
    held_out = np.mean(content["held_out_errors"]["lengths"])
    assert held_out < 0.3 * np.mean(content["nominal_errors"]["lengths"])
    row = content["parameters"][0]
    keys = {"name", "unit", "kind", "estimate", "standard_deviation", "dof"}
    assert keys <= set(row)
    page = (report / "report.html").read_text(encoding="utf-8")
    for words in ("day 1", "from above", "largest corrections", "zero of"):
        assert words in page


def test_the_written_urdf_is_the_calibrated_robot(report, folder):
    """It differs in the origins alone, and moves like the calibrated robot."""
    content = json.loads((report / "calibration.json").read_text())
    nominal = jid.load_urdf(folder / "arm.urdf")
    written = jid.load_urdf(report / "robot.urdf")
    q = random_poses(nominal, 5, 9)
    expected = TrueArm(nominal, np.array(content["origins"])).placements(q)
    found = TrueArm(written).placements(q)
    assert found[0] == pytest.approx(expected[0], abs=1e-9)
    assert found[1] == pytest.approx(expected[1], abs=1e-9)
    assert np.abs(found[1] - TrueArm(nominal).placements(q)[1]).max() > 1e-3
    before, after = (
        [line for line in Path(x).read_text().splitlines() if "<origin" not in line]
        for x in (folder / "arm.urdf", report / "robot.urdf")
    )
    assert [x.strip() for x in before if "mass" in x or "limit" in x] == [
        x.strip() for x in after if "mass" in x or "limit" in x
    ]


JOINT = '<joint name="j{i}" pos="0.02 0.03 0.{i}" axis="0 {y} {z}"/>'
BODY = '<body name="b{i}" pos="0.1 0 0.3" euler="10 20 0">{joints}<geom size="0.1"/>'


@pytest.mark.parametrize("joints_of_bodies", [((0,), (1,), (2,)), ((0, 1), (2,))])
def test_a_written_mjcf_is_the_calibrated_robot(tmp_path, joints_of_bodies):
    """Joints beside the origins of their bodies move the tip as they should."""
    text = ""
    for numbers in joints_of_bodies:
        joints = [JOINT.format(i=i, y=i % 2, z=1 - i % 2) for i in numbers]
        text += BODY.format(i=numbers[-1], joints="".join(joints))
    text += "</body>" * len(joints_of_bodies)
    text = f"<mujoco><worldbody>{text}</worldbody></mujoco>"
    source = tmp_path / "arm.xml"
    source.write_text(text)
    robot = jid.load_mjcf(source)
    arm = TrueArm(robot, true_origins(robot), masses=np.ones(3))
    observations = []
    for session in range(3):
        q = np.random.default_rng(session).uniform(-1.5, 1.5, (15, 3))
        points = arm.placements(q, (0.1, 0.0, 0.2))[1]
        observations.append(
            jid.calibration.MeasuredPosition(f"s{session}", q, positions=points)
        )
    fit = jid.calibrate(robot, observations, compliance=False)
    path = jid.export.export_origins(fit, tmp_path / "calibrated.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for x in q[:3]:
        data.qpos[:] = x
        mujoco.mj_forward(model, data)
        rotation, _ = TrueArm(fit.robot).placement(x)
        assert data.body("b2").xmat.reshape(3, 3) == pytest.approx(rotation, abs=1e-9)
        origin = data.body("b2").xpos + data.body("b2").xmat.reshape(3, 3) @ (
            0.02,
            0.03,
            0.2,
        )
        expected = TrueArm(fit.robot.replace(tip_offset=np.zeros(3)))
        expected.tip.translation[:] = 0.0
        assert origin == pytest.approx(expected.placement(x)[1], abs=1e-9)


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ('position = ["x", "y", "w"]', "position"),
        ('observation = "measured_pose"', "calibration.attitude"),
        ('observation = "ball"', "calibration.observation"),
        ("masses = [1.0, 2.0]", "masses"),
        ("parts = 0", "calibration.parts"),
        ("parts = 3", "calibration.parts"),
    ],
)
def test_wrong_experiments_are_refused(folder, line, name):
    key = line.split(" ")[0]
    text = (folder / "experiment.toml").read_text()
    lines = [x for x in text.splitlines() if not x.startswith(key)]
    path = folder / f"wrong {name}.toml"
    path.write_text("\n".join([*lines, line]))
    output = folder / "refused"
    result = run("calibrate", path, folder / "sessions", "-o", output)
    message = result.output or str(result.exception)
    assert f"`{name}`" in message
    assert not output.exists()


def test_files_are_sessions_of_columns_that_no_log_has(folder):
    text = (folder / "experiment.toml").read_text()
    path = folder / "with log.toml"
    path.write_text(text + '[recording]\nangles = "a{}"\nforces = "tau{}"\n')
    files = []
    for session in range(3):
        files.append(folder / f"day {session}.csv")
        shutil.copy(folder / "sessions" / f"day {session}" / "tracker.csv", files[-1])
    result = run("calibrate", path, *files, "-o", folder / "from files")
    assert result.exit_code == 0, result.output
    assert "On sessions held out in turn" in " ".join(result.output.split())


def test_parts_share_the_distance_of_two_places(folder):
    """The distance counts in each fit, so that it is not judged as if held out."""
    robot = jid.load_urdf(folder / "arm.urdf")
    arm = TrueArm(robot, true_origins(robot), masses=np.array(MASSES))
    tool = np.array([0.0, 0.1, 0.2])
    session = folder / "plate"
    session.mkdir()
    middle = arm.placement(np.array([0.3, 0.8, 0.5, 0.9]), tool)[1]
    for place, x in (("left", -0.025), ("right", 0.025)):
        points = np.tile(middle + np.array([x, 0.0, 0.0]), (40, 1))
        q = arm.touching(random_poses(robot, 40, 1), tool, points)
        is_reached = np.linalg.norm(arm.placements(q, tool)[1] - points, axis=1) < 1e-6
        q = q[is_reached & (np.abs(q) < 2.0).all(axis=1)]
        np.savetxt(session / f"{place}.csv", q[:12], delimiter=",")
    path = folder / "parts.toml"
    path.write_text(
        '[robot]\nurdf = "arm.urdf"\n[calibration]\nparts = 3\ndistance = 0.05\n'
    )
    result = run("calibrate", path, session, "-o", folder / "parts")
    assert result.exit_code == 0, result.output
    words = " ".join(result.output.split())
    assert "On sessions held out in turn" in words
    assert "Known distances" not in words


def test_better_geometry_explains_torques_better(folder):
    """Torques of the true arm, by Pinocchio, need its geometry."""
    nominal = jid.load_urdf(folder / "arm.urdf")
    origins = true_origins(nominal, shift=5e-3, turn=2e-2)
    arm = TrueArm(nominal, origins, masses=np.array(MASSES))
    time = 0.02 * np.arange(400)
    phases = np.outer(time, [1.1, 1.7, 2.3, 2.9])
    rates = np.array([1.1, 1.7, 2.3, 2.9])
    motion = (np.sin(phases), rates * np.cos(phases), -(rates**2) * np.sin(phases))
    torques = [
        pinocchio.rnea(arm.model, arm.data, *sample)
        for sample in zip(*motion, strict=True)
    ]
    log = folder / "torques.csv"
    header = "time,q1,q2,q3,q4,tau1,tau2,tau3,tau4"
    table = np.column_stack([time, motion[0], torques])
    np.savetxt(log, table, delimiter=",", header=header, comments="")
    setup = jid.Setup(nominal)
    columns = jid.Columns(angles="q{}", forces="tau{}", time="time")
    logs = jid.workflow.TorqueLogs([log], columns)
    better = jid.calibration.corrected_robot(nominal, origins)
    remark = jid.workflow.geometry_calibration.compare_torques(setup, better, logs)
    before, after = map(float, re.findall(r"([\d.]+) % with", remark.text))
    assert after < 0.5 * before
    assert "better geometry helps" in remark.text


def test_two_reports_can_be_compared(report, tmp_path):
    other = shutil.copytree(report, tmp_path / "other")
    agreement = jid.workflow.agree_reports([report, other])
    assert not agreement.content["odd_runs"]


def test_reports_that_cannot_be_compared_are_refused(report, tmp_path):
    other = shutil.copytree(report, tmp_path / "other")
    with pytest.raises(jid.InputError, match="different folders"):
        jid.workflow.agree_reports([report, report.parent / "." / report.name])
    content = json.loads((other / "calibration.json").read_text())
    # One session alone has no intervals.
    for row in content["parameters"]:
        row["standard_deviation"] = None
    (other / "calibration.json").write_text(json.dumps(content))
    with pytest.raises(jid.InputError, match="`other` must have intervals"):
        jid.workflow.agree_reports([report, other])
    (other / "calibration.json").rename(other / "rollout.json")
    with pytest.raises(jid.InputError, match="one command"):
        jid.workflow.agree_reports([report, other])


def test_files_of_sessions_are_named_in_refusals(folder, tmp_path):
    sessions = shutil.copytree(folder / "sessions", tmp_path / "sessions")
    (sessions / "day 2" / "tracker.csv").write_text("q1,q2\n1.0,2.0\n")
    output = tmp_path / "refused"
    words = ["calibrate", folder / "experiment.toml"]
    result = run(*words, sessions, "-o", output)
    assert "session `day 2`" in str(result.exception)
    twice = [folder / "sessions", folder / "sessions"]
    result = run(*words, *twice, "-o", output)
    assert "given twice" in str(result.exception)
    result = run("calibrate", sessions, sessions, "-o", output)
    assert "is a folder; the experiment file comes first" in str(result.exception)
    assert not output.exists()
