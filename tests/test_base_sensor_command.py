"""`jaxid identify` with a force sensor under the base: wrenches are those of MuJoCo."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_cli import refused, run  # noqa: F401

import jaxid as jid
from jaxid.result_table import Status
from jaxid.validation.wrench_checks import wrench_remarks
from jaxid.workflow.log_loading import read_log

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

ROTATION = (10.0, -20.0, 30.0)
"""Roll, pitch and yaw of the sensor [deg]."""
POSITION = (0.02, -0.01, 0.05)
ARM = """
<mujoco model="arm"><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>
 <body name="base"><inertial pos="0 0 0.1" mass="2" diaginertia="1 1 1"/>
  {site}
  <body name="a" pos="0 0.05 0.2"><joint name="a" axis="0 0 1" damping="0.7"/>
   <inertial pos="0.1 0.2 0.1" mass="3" diaginertia="0.1 0.12 0.15"/>
   <body name="b" pos="0.2 0 0.1"><joint name="b" axis="0 1 0" damping="0.4"/>
    <inertial pos="0 0.05 0.2" mass="2" diaginertia="0.04 0.05 0.03"/>
    <body name="c" pos="0 0 0.4"><joint name="c" axis="1 0 0" damping="0.2"/>
     <inertial pos="0.01 0 0.1" mass="1" diaginertia="0.01 0.02 0.01"/>
 </body></body></body></body></worldbody>
 {sensor}</mujoco>
"""
FILE = f"""
[robot]
mjcf = "arm.xml"
[recording]
time = "t"
angles = "q{{}}"
[filter]
kind = "butterworth"
cutoff = 8.0
[rows]
step = 5
[sensor]
wrench = ["fx", "fy", "fz", "tx", "ty", "tz"]
rotation = {list(ROTATION)}
position = {list(POSITION)}
under_base = true
"""
HEADER = "t,q1,q2,q3,tau1,tau2,tau3,fx,fy,fz,tx,ty,tz"
BIAS = np.array([3.0, -2.0, 6.0, 0.1, -0.3, 0.05])


def simulated(t, seed):
    """Return angles, torques, and wrenches at the sensor, of a smooth motion."""
    quaternion = Rotation.from_euler("xyz", ROTATION, degrees=True).as_quat(
        scalar_first=True
    )
    site = f'<site name="s" pos="{"{} {} {}".format(*POSITION)}" '
    site += f'quat="{"{} {} {} {}".format(*quaternion)}"/>'
    sensor = '<sensor><force site="s"/><torque site="s"/></sensor>'
    model = mujoco.MjModel.from_xml_string(ARM.format(site=site, sensor=sensor))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * np.array([0.15, 0.35, 0.6])[:, None]
    phase = rng.uniform(0.0, 6.0, (3, 3))
    rows = []
    for time in t:
        angle = w * time + phase
        data.qpos[:] = (0.4 * np.sin(angle)).sum(0)
        data.qvel[:] = (0.4 * w * np.cos(angle)).sum(0)
        data.qacc[:] = -(0.4 * w**2 * np.sin(angle)).sum(0)
        mujoco.mj_inverse(model, data)
        rows.append(np.concatenate([data.qpos, data.qfrc_inverse, data.sensordata]))
    rows = np.array(rows)
    rows[:, 6:] += BIAS
    return rows + rng.normal(size=rows.shape) * ([0] * 3 + [0.02] * 6 + [0.003] * 3)


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cell")
    (folder / "arm.xml").write_text(ARM.format(site="", sensor=""))
    (folder / "e.toml").write_text(FILE)
    with_torques = FILE.replace("[filter]", 'forces = "tau{}"\n[filter]')
    with_torques = with_torques.replace(
        "[rows]", "[rows]\nmin_speed = [0.02, 0.02, 0.02]"
    )
    with_torques += "[model.coulomb]\nepsilon = [0.01, 0.01, 0.02]\n"
    (folder / "f.toml").write_text(with_torques)
    t = np.arange(0.0, 15.0, 0.01)
    clean = simulated(t, 1)
    other = simulated(t, 2)
    turn = {
        "turned": Rotation.from_euler("z", 90, degrees=True).as_matrix(),
        "tilted": Rotation.from_rotvec([0.035, 0.0, 0.0]).as_matrix(),
    }
    both = np.eye(2)
    maps = {name: np.kron(both, R.T) for name, R in turn.items()}
    maps["opposite"] = -np.eye(6)
    maps["exchanged"] = np.kron([[0, 1], [1, 0]], np.eye(3))
    maps["columns"] = np.kron(both, np.eye(3)[[1, 0, 2]])
    maps["units"] = np.diag([1, 1, 1, 1000, 1000, 1000])
    # The origin is 3 cm along x, and 4 cm along y, from where it is described.
    maps["displaced"] = np.eye(6)
    maps["displaced"][3:, :3] = [[0, 0, -0.04], [0, 0, 0.03], [0.04, -0.03, 0]]
    logs = {"a": clean, "b": other}
    for name, matrix in maps.items():
        logs[name] = np.hstack([clean[:, :6], clean[:, 6:] @ matrix.T])
    for name, rows in logs.items():
        path = folder / f"{name}.csv"
        table = np.column_stack([t, rows])
        np.savetxt(path, table, delimiter=",", header=HEADER, comments="")
    return folder


@pytest.fixture
def here(cell, tmp_path, monkeypatch):
    for path in cell.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def torques_of_file(path, motion):
    """Return the torques that the bodies of an MJCF file need in MuJoCo."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.dof_damping[:] = 0.0
    data = mujoco.MjData(model)
    torques = []
    for q, qd, qdd in zip(*motion, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        torques.append(data.qfrc_inverse.copy())
    return np.array(torques)


def test_the_arm_is_identified_without_torques(here, run):  # noqa: F811
    code, out, err = run("identify", "e.toml", "a.csv", "--verify", "b.csv")
    assert code == 0, err
    assert "✗" not in out
    fit = jid.load_fit("report/model.json")
    assert {"bfx0", "bmx0"} <= set(fit.base.names)
    assert not {"m0", "fv1"} & set(fit.base.model.parameter_names)
    assert run("export", "report", "--to", "mjcf", "-o", "found.xml")[0] == 0
    motion = np.random.default_rng(4).normal(size=(3, 20, 3))
    found, true = (torques_of_file(here / x, motion) for x in ("found.xml", "arm.xml"))
    assert np.abs(found - true).max() < 0.02 * np.abs(true).max()
    # The robot's own file gets the same bodies; its base is not identified.
    assert run("export", "report", "--to", "urdf", "-o", "found.urdf")[0] == 0
    bodies = jid.robots.urdf_parameters(here / "found.urdf").reshape(-1, 10)
    expected = np.asarray(fit.full_parameters)[:30].reshape(-1, 10)
    np.testing.assert_allclose(bodies, expected, atol=1e-9)


def test_torques_tell_friction_beside_the_wrench(here, run):  # noqa: F811
    code, out, err = run("identify", "f.toml", "a.csv", "--split", "0.6")
    assert code == 0, err
    assert "✗" not in out
    rows = json.loads((here / "report" / "result.json").read_text())["base_parameters"]
    values = {row["name"]: row["estimate"] for row in rows}
    for number, damping in enumerate((0.7, 0.4, 0.2), 1):
        assert abs(values[f"fv{number}"] - damping) < 0.05


def test_speeds_in_a_list_are_those_of_the_driven_joints(cell):
    """A sensor at the end-effector adds virtual joints behind, not before them."""
    experiment = jid.experiment.load_experiment(cell / "f.toml")
    sensor = jid.workflow.ForceSensor(["fx", "fy", "fz", "tx", "ty", "tz"])
    model = sensor.beside(experiment.setup, experiment.columns).model
    qd = np.zeros(9)
    qd[:3] = 0.01, 0.02, -0.03
    regressor = np.asarray(model.regressor(jid.Motion(0.3 * qd, qd, 0 * qd)))
    places = [model.parameter_names.index(f"fc{joint}") for joint in (1, 2, 3)]
    shares = qd[:3] / [0.01, 0.01, 0.02]
    np.testing.assert_allclose(
        regressor[:3, places], np.diag(np.tanh(shares)), rtol=1e-6
    )


def test_a_wrong_frame_is_named(cell):
    experiment = jid.experiment.load_experiment(cell / "e.toml")
    setup, columns = experiment.identification([cell / "a.csv"])
    words = {
        "a": (),
        "b": (),
        "opposite": ("opposite sign",),
        "exchanged": ("exchanged",),
        "turned": ("by 90 degrees",),
        "tilted": ("by 2.0 degrees",),
        "columns": ("left-handed", "by 180 degrees"),
        "units": ("N mm",),
        "displaced": ("by 50 mm",),
    }
    small = ("tilted", "displaced")
    for name, texts in words.items():
        log = setup.observe(read_log(setup, cell / f"{name}.csv", columns))
        remarks = wrench_remarks(setup.model, log)
        assert len(remarks) == len(texts), (name, remarks)
        for remark, text in zip(remarks, texts, strict=True):
            assert text in remark.text
            assert (remark.status is Status.BAD) == (name not in small)


def test_the_attitude_that_is_named_is_the_cure(cell, tmp_path):
    for path in ("arm.xml", "turned.csv"):
        (tmp_path / path).symlink_to(cell / path)
    described = Rotation.from_euler("xyz", ROTATION, degrees=True)
    right = described * Rotation.from_euler("z", 90, degrees=True)
    experiment = jid.experiment.load_experiment(cell / "e.toml")
    setup, columns = experiment.identification([cell / "turned.csv"])
    log = setup.observe(read_log(setup, cell / "turned.csv", columns))
    (remark,) = wrench_remarks(setup.model, log)
    numbers = remark.text.partition("about [")[2].partition("]")[0]
    named = Rotation.from_euler("xyz", json.loads(f"[{numbers}]"), degrees=True)
    assert (named.inv() * right).magnitude() < np.deg2rad(1.0)


def test_the_place_that_is_named_is_the_cure(cell):
    experiment = jid.experiment.load_experiment(cell / "e.toml")
    setup, columns = experiment.identification([cell / "displaced.csv"])
    log = setup.observe(read_log(setup, cell / "displaced.csv", columns))
    (remark,) = wrench_remarks(setup.model, log)
    numbers = remark.text.partition("about [")[2].partition("]")[0]
    described = Rotation.from_euler("xyz", ROTATION, degrees=True)
    right = POSITION + described.apply([0.03, 0.04, 0.0])
    np.testing.assert_allclose(json.loads(f"[{numbers}]"), right, atol=0.002)


def test_refusals(here, run):  # noqa: F811
    (here / "g.toml").write_text(FILE + "in_ground = true\n")
    assert refused(run("identify", "g.toml", "a.csv"), "`in_ground`")
    load = FILE.replace("[filter]", "[model]\nload = true\n[filter]")
    (here / "l.toml").write_text(load)
    assert refused(run("identify", "l.toml", "a.csv"), "`load`")
    (here / "w.toml").write_text(FILE.replace("under_base = true", ""))
    assert refused(run("identify", "w.toml", "a.csv"), "`under_base = true`")
