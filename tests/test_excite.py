"""`jaxid excite`: what it writes and says, that it survives a kill, what it refuses."""

import dataclasses
import html
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import mujoco
import numpy as np
import patience
import pytest

from jaxid.cli import app as cli
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation import search
from jaxid.excitation.coefficient_limits import JointLimits
from jaxid.excitation.criteria import CRITERIA, EOptimal
from jaxid.experiment.decoder import keys_of
from jaxid.experiment.experiment import load_experiment
from jaxid.report.excitation_page import plan_remarks
from jaxid.trajectory.controllers import CONTROLLERS
from jaxid.trajectory.files import load_trajectory
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.lead_in_and_out import LeadsBasis
from jaxid.trajectory.spline import RestToRestSplineBasis
from jaxid.workflow.excitation_settings import Excitation, Leads
from jaxid.workflow.motion_design import (
    design_motion,
    prepare_motion,
    write_design,
)
from jaxid.workflow.nominal_parameters import find_nominal, limit_forces

PENDULUM = """\
<robot name="pendulum">
  <link name="stand"/>
  <link name="rod">
    <inertial><origin xyz="0.4 0 0"/><mass value="2"/>
      <inertia ixx="0.01" iyy="0.11" izz="0.11" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="stand"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="1.5" velocity="2" effort="12"/>
  </joint>
</robot>
"""
EXPERIMENT = """\
[robot]
urdf = "pendulum.urdf"
[limits]
acceleration = [4]
[collision]
floor = false
fit = false
[excitation]
harmonics = 2
starts = 2
generations = 0
samples = 100
seed = 5
"""
FREE = EXPERIMENT.replace("[4]", "[4]\nforce = [inf]").replace(
    "seed", "noise = [0.12]\nseed"
)
STAGES = {
    "SCHEDULE": search.SCHEDULE,
    "CONSTRAINED_SCHEDULE": search.CONSTRAINED_SCHEDULE,
}
LINK = """<link name="l{k}"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
{shape}</link>"""
SHAPE = """<collision><origin xyz="0 0 0.2"/>
<geometry><cylinder radius="0.04" length="0.3"/></geometry></collision>"""
JOINT = """<joint name="j{k}" type="revolute"><parent link="l{p}"/><child link="l{k}"/>
<origin xyz="0 0 {z}"/><axis xyz="0 1 0"/><limit lower="-3.1" upper="3.1" velocity="2"
 effort="{effort}"/></joint>"""


def arm(folder, shape=SHAPE, effort=50.0, keys=""):
    """Write a robot that stands upright at zero, and its experiment file."""
    links = "".join(LINK.format(k=k, shape=shape if k else "") for k in range(4))
    joints = "".join(
        JOINT.format(k=k, p=k - 1, z=0.4 if k > 1 else 0.5, effort=effort)
        for k in range(1, 4)
    )
    (folder / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    path = folder / "arm.toml"
    text = '[robot]\nurdf = "arm.urdf"\n[excitation]\nharmonics = 2\nstarts = 4\n'
    path.write_text(text + "generations = 0\n" + keys)
    return path


@pytest.fixture(scope="module", autouse=True)
def last_stage_alone():
    """Designs without the stages before the last one."""
    with pytest.MonkeyPatch.context() as patch:
        for stages in STAGES:
            patch.setattr(search, stages, ())
        yield


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with a robot."""
    folder = tmp_path_factory.mktemp("excite")
    (folder / "pendulum.urdf").write_text(PENDULUM)
    (folder / "experiment.toml").write_text(EXPERIMENT)
    (folder / "free.toml").write_text(FREE)
    return folder


@pytest.fixture
def run(written, monkeypatch, capsys):
    """Runs a command line in this process: exit code, stdout and stderr."""
    monkeypatch.chdir(written)
    monkeypatch.setenv("COLUMNS", "100")

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["jaxid", *map(str, args)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        out, err = capsys.readouterr()
        return stopped.value.code, out, err

    return run


@pytest.fixture
def designed(written, run):
    """The folder with a finished design in `plan`, whichever test runs first."""
    if not (written / "plan" / "motion.json").exists():
        assert run("excite", "experiment.toml", "-o", "plan/motion.csv")[0] == 0
    return written


@pytest.fixture(scope="module")
def excited(written):
    """A motion as fast as it can be had, for what is said of it."""
    return designed_by(load_experiment(written / "free.toml"))


def task_of(experiment):
    """The motion that an experiment file asks for."""
    return prepare_motion(
        experiment.setup, experiment.excitation, experiment.surroundings
    )


def designed_by(experiment):
    return design_motion(task_of(experiment))


def nominal_of(experiment):
    return find_nominal(experiment.setup, experiment.excitation)


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes longer than all else where a motion is there already."""
    monkeypatch.setattr("jaxid.workflow.motion_design.write_excitation", lambda *_: [])


def listing(folder):
    """All that a user sees: a kill may leave a hidden folder with partial files."""
    paths = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))
    return [p for p in paths if not p.startswith(".jaxid-")]


def table(path):
    return np.loadtxt(path, delimiter=",", skiprows=1)


def with_keys(folder, name, *keys, text=EXPERIMENT):
    path = folder / name
    path.write_text(text + "\n".join(keys) + "\n")
    return path


def test_writes_the_motion_and_says_what_to_expect(written, run):
    code, out, err = run("excite", "experiment.toml", "-v", "-o", "plan/motion.csv")
    assert code == 0, err
    files = ["motion", "motion.csv", "motion.json", "motion.ros.yaml"]
    assert listing(written / "plan") == [*files, "motion/report.html"]
    t, q, qd, qdd = table(written / "plan" / "motion.csv").T
    np.testing.assert_allclose([qd[0], qdd[0], qd[-1], qdd[-1]], 0.0, atol=1e-9)
    rounding = 1 + 1e-14  # the start may lie on a limit, and is written in decimals
    assert -2 * rounding <= q.min() <= q.max() <= 1.5 * rounding
    assert 1.5 < np.abs(qd).max() <= 2
    assert np.abs(qdd).max() <= 4
    assert t[-1] > 2 * np.pi / 0.8
    for said in (
        "criteria; this motion was designed for",
        "expected standard deviations",
        "use of the limits",
        "follows the designed motion from",
        "for one run of 7.854 s (100 samples at 12.73 Hz)",
        "standard deviation of 0.120 N m",
        "give `noise` if it is known",
        "forces by the nominal parameters: 1 of 1 limits are kept",
        "not checked: floor, self-collision",
    ):
        assert said in " ".join(out.split())
    page = html.unescape((written / "plan" / "motion" / "report.html").read_text())
    for said in (
        "100 samples at 12.73 Hz",
        "jaxid excite experiment.toml -v -o plan/motion.csv",
        "generations = 0",
        "he robot starts at rest and follows the designed motion from",
    ):
        assert said in page


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_search_leaves_its_best_motion_and_another_goes_on(tmp_path, number):
    arm(tmp_path)
    command = [
        sys.executable,
        "-m",
        "jaxid",
        "excite",
        "arm.toml",
        "-o",
        "run/motion.csv",
    ]
    settings = {
        "cwd": tmp_path,
        "env": {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    }
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **settings
    )
    motion = tmp_path / "run" / "motion.json"
    until = time.monotonic() + patience.SECONDS
    while not motion.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)
    process.send_signal(number)
    _, err = process.communicate()
    files = listing(tmp_path / "run")
    assert files == ["motion.csv", "motion.json", "motion.ros.yaml"]
    if number is signal.SIGINT:
        assert process.returncode == 130
        # Busy machines print progress before it.
        assert err.splitlines()[-1].startswith(
            "jaxid: stopped: `run/motion.csv` and the files beside it hold the"
        )
        assert "`--resume` continues from" in err
        found, rows = load_trajectory(motion), table(tmp_path / "run" / "motion.csv")
        expected = np.concatenate(
            [getattr(found.motion(rows[:, 0]), x) for x in ("q", "qd")], 1
        )
        np.testing.assert_allclose(rows[:, 1:7], expected, atol=1e-9)
        return
    # What a killed process leaves is the harder case.
    before = load_trajectory(motion)
    done = subprocess.run(
        [*command, "--resume", "--time", "1"],
        capture_output=True,
        text=True,
        **settings,
    )
    # A second of search may not find a motion that determines all parameters.
    assert done.returncode in (0, 3), done.stderr
    assert "wrote" in done.stdout
    assert load_trajectory(motion).basis.lead == before.basis.lead


def test_floor_self_collision_and_forces_are_kept_by_default(tmp_path, run):
    arm(tmp_path)
    code, out, err = run("excite", tmp_path / "arm.toml", "-o", tmp_path / "motion.csv")
    assert code == 0, err
    said = " ".join(out.split())
    for words in (
        "floor: 3 of 3 limits",
        "self-collision: 1 of 1 limits",
        "forces by the nominal",
    ):
        assert f"✓ {words}" in said
    assert "less a margin of 30 %" in said
    assert said.startswith("✓ Record this motion: it keeps all limits")
    experiment = load_experiment(tmp_path / "arm.toml")
    q = table(tmp_path / "motion.csv")[:, 1:4]
    # The ends of all links in the plane in which they turn, from sums of angles.
    angles = np.cumsum(q, axis=1)
    up = np.cos(angles)
    ends = (
        0.5 + 0.4 * np.cumsum(np.pad(up, ((0, 0), (1, 0)))[:, :3], axis=1) + 0.35 * up
    )
    assert ends.min() >= 0.04 + 0.029
    assert np.ptp(q, axis=0).min() > 0.1
    gaps = np.asarray(
        experiment.surroundings.clearance.model.clearance(experiment.setup.robot, q)
    )
    assert gaps.min() >= 0.029
    # MuJoCo finds no contact between the cylinders of the file, but one where the arm
    # is folded.
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.urdf"))
    data, contacts = mujoco.MjData(model), []
    for pose in (*q, [0.0, 2.3, 2.3]):
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        contacts.append(data.ncon)
    assert not any(contacts[:-1])
    assert contacts[-1]


def test_friction_that_the_file_claims_counts_in_the_forces(tmp_path):
    arm(tmp_path)
    path = tmp_path / "arm.urdf"
    claim = '<axis xyz="0 1 0"/><dynamics damping="3" friction="2"/>'
    path.write_text(path.read_text().replace('<axis xyz="0 1 0"/>', claim))
    experiment = load_experiment(tmp_path / "arm.toml")
    found = nominal_of(experiment)
    limits = limit_forces(experiment.setup, experiment.excitation, found).limits
    # Upright, at 1 rad/s, with a margin of 30 %: MuJoCo's forces over what is left of
    # 50 N m.
    motion = Motion(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)))
    worst = np.asarray(limits(experiment.setup.robot, motion)).max(axis=0)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qvel[:] = motion.qd[0]
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    mujoco.mj_inverse(model, data)
    expected = data.qfrc_inverse[2] + model.dof_frictionloss[2]
    assert worst[2] == pytest.approx(expected / 35.0 - 1.0, rel=1e-3)


def test_an_impossible_link_leaves_the_check_of_forces(tmp_path, run):
    arm(tmp_path)
    path = tmp_path / "arm.urdf"
    possible = path.read_text()
    before, after = possible.split('name="l2"', 1)
    long_link = after.replace('iyy="0.1"', 'iyy="0.3"', 1)
    path.write_text(f'{before}name="l2"{long_link}')
    robot_file = load_experiment(tmp_path / "arm.toml").setup.robot_file
    bodies = robot_file.possible_bodies()
    # Second moments 0.15, -0.05, 0.15 become 0.15, 0.00015, 0.15; about the origin.
    moments = [0.15015 + 0.04, 0.3 + 0.04, 0.15015]
    np.testing.assert_allclose(bodies[1, :4], [1.0, 0.0, 0.0, 0.2], atol=1e-15)
    np.testing.assert_allclose(bodies[1, 4:7], moments, rtol=1e-12)
    code, out, err = run("excite", tmp_path / "arm.toml", "-o", tmp_path / "motion.csv")
    assert code == 0, err
    said = " ".join(out.split())
    assert "✓ forces by the nominal" in said
    assert "! link `l2`: the moments of inertia cannot belong to a real body" in said
    # What has no nearest value that can exist is named as the reason.
    path.write_text(possible.replace('<mass value="1"/>', '<mass value="-1"/>'))
    experiment = load_experiment(tmp_path / "arm.toml")
    assert nominal_of(experiment) is None
    fault = limit_forces(experiment.setup, experiment.excitation, None).fault
    assert "links `l1`, `l2`, `l3`: `mass` is -1 kg" in fault


def test_what_was_not_checked_is_said_first_and_ends_in_a_code(tmp_path, run):
    # Ahead of its base the arm cannot be held by 1 N m.
    ahead = (
        "[limits]\nposition_min = [1.2, -0.3, -0.3]\nposition_max = [1.9, 0.3, 0.3]\n"
    )
    arm(tmp_path, shape="", effort=1.0, keys=ahead)
    code, out, err = run("excite", tmp_path / "arm.toml", "-o", tmp_path / "motion.csv")
    assert code == 3, err
    said = " ".join(out.split())
    assert "Record this motion" not in said
    assert "✗ Do not record this motion yet" in said
    before = " ".join(err.split())
    for text in (before, said):
        assert "the shape of" in text
        assert "thick capsules" in text
        assert re.search(
            r"gravity exceeds a .* best pose the force of joint `j[12]` must be", text
        )
    keys = f"force_margin = 0.1\n{ahead}"
    code, out, err = run(
        "excite", arm(tmp_path, effort=1.0, keys=keys), "-o", tmp_path / "x.csv"
    )
    assert (code, out) == (2, "")
    assert "`force_margin`: in each of" in err


def test_capsules_of_the_user_replace_meshes_that_are_missing(tmp_path):
    mesh = '<collision><geometry><mesh filename="none.stl"/></geometry></collision>'
    capsule = "start = [0, 0, 0], end = [0, 0, 0.4], radius = 0.05 }"
    keys = "".join(f'{{ name = "c{k}", body = "j{k}", {capsule},' for k in (1, 2))
    path = arm(tmp_path, shape=mesh, keys=f"[collision]\ncapsules = [{keys}]\n")
    experiment = load_experiment(path)
    surroundings = experiment.surroundings
    # The third link still has no shape.
    assert [fault.split(":")[0] for fault in surroundings.faults[:1]] == ["link `l3`"]
    assert "give `capsules`" in surroundings.faults[0]
    # Links without their meshes share a sentence.
    fault, _ = load_experiment(arm(tmp_path, shape=mesh)).surroundings.faults
    assert fault.startswith("links `l1`, `l2`, `l3`: geometry not read (")
    assert "; 2 more like it); give `capsules`" in fault


def test_limits_forces_by_nominal_parameters(designed, run, no_pictures, monkeypatch):
    written = designed
    for (
        name,
        stages,
    ) in STAGES.items():  # a force that only few motions keep needs them all
        monkeypatch.setattr(search, name, stages)

    # The angle turns about y: the rod points ahead at zero, and holding it there takes
    # 7.8 N m.
    def largest_force(folder):
        _, q, _, qdd = table(written / folder / "motion.csv").T
        return np.abs((0.11 + 2 * 0.4**2) * qdd - 2 * 0.4 * 9.81 * np.cos(q)).max()

    path = with_keys(written, "weak.toml", "force_margin = 0.5")
    code, out, err = run("excite", path, "-o", "weak/motion.csv", "-v")
    assert code == 0, err
    assert largest_force("weak") <= 6.0 < 7.5 < largest_force("plan")
    assert "use of the other limits" in out
    use = r"[45]\.\d+ N m +≤ 6 N m +[89]\d\.\d +12 less a margin of"
    assert re.search(rf"force of joint `hinge` +{use}", out)
    assert "taken as zero in the forces: fv1" in " ".join(out.split())
    assert (
        "the robot starts at rest and follows the designed motion from 0.500 to" in out
    )


@pytest.mark.parametrize(
    ("key", "constrained", "expected"),
    [
        (
            "spline = { points = 6, duration = 5.0 }",
            True,
            RestToRestSplineBasis(6, 5.0),
        ),
        ("leads = false", True, FourierBasis(2, 0.8)),
        ("leads = { periods = 3 }", True, LeadsBasis(2, 0.8, lead=0.5, periods=3)),
        ("leads = { time = 0.3 }", False, LeadsBasis(2, 0.8, lead=0.3)),
    ],
)
def test_keys_choose_the_family_of_motions(written, key, constrained, expected):
    experiment = load_experiment(with_keys(written, "family.toml", key))
    assert eqx.tree_equal(experiment.excitation.basis(constrained), expected)


def test_earlier_results_are_nominal(written, excited, monkeypatch):
    experiment = load_experiment(with_keys(written, "after.toml", 'nominal = "report"'))
    path = with_keys(written, "kept.toml", 'nominal = "report"', "force_margin = 0.1")
    base = experiment.setup.base
    covariance, names = 0.01 * np.eye(base.size), [*base.names]

    class Earlier:
        parameters = 1.0 + np.arange(base.size)

        def __init__(self, folder):
            self.base = SimpleNamespace(names=tuple(names), size=len(names))
            self.covariance = covariance

    monkeypatch.setattr("jaxid.workflow.nominal_parameters.read_fit", Earlier)
    found = nominal_of(experiment)
    np.testing.assert_array_equal(found.covariance, covariance)
    assert found.undetermined == ()
    covariance = covariance.copy()
    covariance[0, 0] = np.inf
    found = nominal_of(experiment)
    assert found.undetermined == base.names[:1]
    np.testing.assert_array_equal(
        np.diag(found.covariance), 0.01 * (np.arange(base.size) > 0)
    )
    kept = load_experiment(path)
    # refuses a covariance that is not finite
    limit_forces(kept.setup, kept.excitation, found)
    names[0] = "other"
    with pytest.raises(ValueError, match="are not the"):
        nominal_of(experiment)


def test_tables_are_sampled_as_a_controller_wants_them(
    written, excited, no_pictures, monkeypatch
):
    monkeypatch.setattr(
        "jaxid.workflow.motion_design.design_excitation", lambda *_, **__: excited.plan
    )
    keys = ("sample_time = 0.03", "leads = { periods = 2 }")
    experiment = load_experiment(with_keys(written, "cycles.toml", *keys, text=FREE))
    found = designed_by(experiment)
    begin, end = found.playable.motion.window
    assert end - begin == pytest.approx(4 * np.pi / 0.8)
    files = write_design(task_of(experiment), found, written / "cycles" / "motion.csv")
    t, q, qd, qdd = table(files[0]).T
    np.testing.assert_allclose(t, 0.03 * np.arange(len(t)), atol=1e-12)
    assert 0.0 <= t[-1] - float(found.playable.motion.duration) < 0.03
    np.testing.assert_allclose(
        q[-1], found.playable.motion.motion(found.playable.motion.duration).q[0]
    )
    assert np.abs([qd[-1], qdd[-1]]).max() < 1e-9
    assert files[1].name == "motion.ros.yaml"
    assert files[1].read_text().count("time_from_start") == len(t)
    # Files of a controller come and go with the key.
    one = CONTROLLERS["universal_robots"]._replace(joints=1)
    monkeypatch.setitem(CONTROLLERS, "universal_robots", one)
    keys = ('controller = "universal_robots"', 'ros = "mcap"')
    played = load_experiment(with_keys(written, "script.toml", *keys, text=FREE))
    files = write_design(played, designed_by(played), written / "cycles" / "motion.csv")
    names = ["motion.csv", "motion.json", "motion.ros.mcap", "motion.script"]
    assert listing(written / "cycles") == names
    t = table(files[0])[:, 0]
    np.testing.assert_allclose(t, 0.008 * np.arange(len(t)), atol=1e-12)
    assert files[-1].read_text().count("  servoj(") == len(t)
    write_design(task_of(experiment), found, written / "cycles" / "motion.csv")
    assert listing(written / "cycles") == [
        "motion.csv",
        "motion.json",
        "motion.ros.yaml",
    ]
    said = [remark.text for remark in found.remarks]
    assert (
        "the motion runs through 2 periods; the deviations are for one period." in said
    )


def test_the_guide_shows_every_key():
    guide = Path(__file__).parent.parent / "docs" / "excitation.md"
    shown = (
        guide.read_text(encoding="utf-8").partition("```toml")[2].partition("```")[0]
    )
    for kind in (Excitation, Leads, RestToRestSplineBasis):
        for key in keys_of(kind):
            assert re.search(rf"\b{key} = ", shown), key


def test_limits_that_nobody_gave_are_named(written, excited):
    (written / "open.toml").write_text(EXPERIMENT.replace("acceleration = [4]", ""))
    robot = load_experiment(written / "open.toml").setup.robot
    limits = JointLimits(robot, excited.plan.trajectory.basis)
    plan = dataclasses.replace(
        excited.plan, limits=limits.limits, assumed=limits.assumed
    )
    said = [remark.text for remark in plan_remarks(plan)]
    assert (
        "The robot's description lacks these limits, so they are assumed: acceleration "
        "8 rad/s² of `hinge`."
    ) in said
    assert not any("ssumed" in remark.text for remark in plan_remarks(excited.plan))


def test_a_motion_without_a_way_into_it_is_written_with_a_warning(
    written, excited, monkeypatch
):
    def refuse(series, robot, periods):
        raise InputError("no lead is short enough.")

    monkeypatch.setattr("jaxid.workflow.motion_design.with_leads", refuse)
    monkeypatch.setattr(
        "jaxid.workflow.motion_design.design_excitation", lambda *_, **__: excited.plan
    )
    led = designed_by(load_experiment(written / "free.toml"))
    assert led.playable.motion is led.plan.trajectory
    text = " ".join(remark.text for remark in led.remarks)
    assert (
        "the motion has no lead in or out, so it starts and ends at full speed: "
        "no lead is" in text
    )


def test_a_criterion_is_chosen_by_its_name_whatever_the_order(written, monkeypatch):
    """One design with the members in reverse order, and the name of each member."""
    tables = "jaxid.workflow.excitation_settings.CRITERIA"
    monkeypatch.setattr(tables, dict(reversed(CRITERIA.items())))
    for name, criterion in CRITERIA.items():
        path = with_keys(written, "named.toml", f'criterion = "{name}"', text=FREE)
        experiment = load_experiment(path)
        assert experiment.excitation.objective is criterion
        if name == "e_optimal":
            assert isinstance(designed_by(experiment).plan.criterion, EOptimal)
    path = with_keys(written, "named.toml", 'criterion = "z_optimal"', text=FREE)
    with pytest.raises(InputError, match=r'`excitation\.criterion` must be .*"z_opt'):
        load_experiment(path)


def test_a_search_that_was_not_begun_cannot_go_on(run):
    code, out, err = run(
        "excite", "experiment.toml", "-o", "never/motion.csv", "--resume"
    )
    assert (code, out) == (2, "")
    assert "`never/motion.json` does not exist: `--resume` needs" in err


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("rests = true", "`excitation.rests` is not a known key: did you mean `rest`"),
        ("leads = false\nsample_time = 0.01", "choose `omega` = 0.79"),
        (
            'controller = "franka"',
            "`controller` moves robots of 7 revolute joints, but `pendulum`",
        ),
        ("rest = true", "`harmonics` must be at least"),
        ("rest = true\nspline = {}", "a `spline` starts and ends at rest anyway"),
        (
            "spline = { point = 9 }",
            "`excitation.spline.point` is not a known key: did you mean `po",
        ),
        ("noise = [1, 2]", "`noise` must hold one positive number for each joint"),
        ('nominal = "nowhere"', "holds no `model.json`"),
    ],
)
def test_refuses_what_does_not_fit(written, run, key, said):
    text = EXPERIMENT.replace("harmonics = 2", "harmonics = 1")
    (written / "wrong.toml").write_text(text + key + "\n")
    code, out, err = run("excite", "wrong.toml")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert said in err
    assert "trajectory.csv" not in listing(written)


def test_a_controller_gets_no_motion_that_starts_at_full_speed(written, monkeypatch):
    one = CONTROLLERS["universal_robots"]._replace(joints=1)
    monkeypatch.setitem(CONTROLLERS, "universal_robots", one)
    keys = ('controller = "universal_robots"', "leads = false", "sample_time = 0.008")
    experiment = load_experiment(with_keys(written, "jump.toml", *keys, text=FREE))
    with pytest.raises(InputError, match="`controller`"):
        task_of(experiment)


SLIDER = """<mujoco model="slider"><compiler angle="radian"/><worldbody>
<body name="crank"><joint name="crank" axis="0 -1 0" range="-1.5 2.5"/>
<inertial pos=".06 0 .01" mass="1.1" diaginertia=".002 .004 .004"/>
<body name="rod" pos=".1 0 0"><joint name="rod" axis="0 -1 0"/>
<inertial pos=".2 0 0" mass=".7" diaginertia=".001 .01 .01"/>
<site name="a" pos=".4 0 0"/></body></body>
<body name="piston"><joint name="piston" type="slide" axis="1 0 0" range=".35 .48"/>
<inertial pos="0 0 0" mass="2" diaginertia=".003 .003 .003"/><site name="b"/></body>
</worldbody><equality><connect name="pin" site1="a" site2="b"/></equality>
<actuator><motor joint="crank" ctrlrange="-8 8"/></actuator>
<keyframe><key qpos="0.9273 -1.1287 0.451918"/></keyframe></mujoco>"""


def test_a_closed_loop_keeps_its_limits_on_the_whole_way_and_it_is_said(tmp_path, run):
    (tmp_path / "slider.xml").write_text(SLIDER)
    file = tmp_path / "experiment.toml"
    settings = "leads = true\nharmonics = 2\nstarts = 2\ngenerations = 1\n"
    file.write_text(
        '[robot]\nmjcf = "slider.xml"\n[collision]\nfit = false\nfloor = false\n'
        f"[excitation]\n{settings}"
    )
    code, out, error = run("excite", file, "-o", tmp_path / "t.csv")
    assert code == 0, error
    assert "✓ closed loops: 4 of 4 limits are kept" in " ".join(out.split())
    table = np.genfromtxt(tmp_path / "t.csv", delimiter=",", skip_header=1)
    crank = table[:, 1]
    assert np.ptp(crank) > 0.5
    piston = 0.1 * np.cos(crank) + np.sqrt(0.16 - (0.1 * np.sin(crank)) ** 2)
    assert piston.min() >= 0.35 - 1e-6
    assert piston.max() <= 0.48 + 1e-6
