"""`jaxid excite`: what it writes and says, that it can be killed, and what it refuses."""

import dataclasses
import html
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

from jaxid.cli import app as cli
from jaxid.errors import InputError
from jaxid.excitation import search
from jaxid.excitation.coefficient_limits import JointLimits
from jaxid.excitation.criteria import CRITERIA
from jaxid.experiment.decoder import keys_of
from jaxid.experiment.excitation import (
    design_motion,
    find_constraints,
    find_nominal,
    force_remarks,
    write_design,
)
from jaxid.experiment.excitation_tables import Excitation, Leads
from jaxid.experiment.experiment import load_experiment
from jaxid.report.excitation import plan_remarks
from jaxid.result_table import Status
from jaxid.trajectory.files import save_trajectory
from jaxid.trajectory.fourier import FourierBasis, fourier_series
from jaxid.trajectory.leads import LeadsBasis
from jaxid.trajectory.spline import RestToRestSplineBasis

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
[excitation]
harmonics = 2
starts = 2
generations = 0
polish = 1
samples = 100
seed = 5
"""
FAST = EXPERIMENT.replace("polish = 1", "polish = 0")
STAGES = {"SCHEDULE": search.SCHEDULE, "SETTLING": search.SETTLING}
LAST_STAGE_ALONE = """
import jaxid.excitation.search as search
search.SCHEDULE = search.SETTLING = ()
from jaxid.cli.app import main
main()
"""


@pytest.fixture(scope="module", autouse=True)
def last_stage_alone():
    """Designs without the stages before the last one, whose programs take long to compile."""
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
    (folder / "fast.toml").write_text(FAST)
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
    experiment = load_experiment(written / "fast.toml")
    return design_motion(experiment, lambda _: None, written / "fast.npz", False)


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes longer than all else where a motion is there already."""
    monkeypatch.setattr("jaxid.experiment.excitation.write_excitation", lambda *_: [])


def listing(folder):
    """All that a user sees: a kill may leave a hidden folder with what was being written."""
    paths = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))
    return [p for p in paths if not p.startswith(".jaxid-")]


def table(path):
    return np.loadtxt(path, delimiter=",", skiprows=1)


def with_keys(folder, name, *keys):
    path = folder / name
    path.write_text(FAST + "\n".join(keys) + "\n")
    return path


def test_writes_the_motion_and_says_what_to_expect(written, run):
    code, out, err = run("excite", "experiment.toml", "-o", "plan/motion.csv")
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
        "criteria: smaller is better",
        "expected standard deviations",
        "use of the limits",
        "is in the designed motion from",
        "of 100 samples in 7.854 s (12.73 Hz), of one run",
        "standard deviation 0.120 N m",
        "give `noise` if it is known",
        "by the nominal parameters they stay within their limits",
    ):
        assert said in " ".join(out.split())
    page = html.unescape((written / "plan" / "motion" / "report.html").read_text())
    for said in (
        "100 samples in 7.854 s",
        "jaxid excite experiment.toml -o plan/motion.csv",
        "polish = 1",
        "he robot starts at rest and is in the designed motion from",
    ):
        assert said in page


def test_a_killed_design_goes_on_to_the_same_motion(designed, run):
    written = designed
    arguments = ["excite", "experiment.toml", "-o", "killed/motion.csv"]
    process = subprocess.Popen(
        [sys.executable, "-c", LAST_STAGE_ALONE, *arguments],
        cwd=written,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    state = written / "killed" / "motion.state.npz"
    until = time.monotonic() + 120
    while not state.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert listing(written / "killed") == ["motion.state.npz"]
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert "to begin anew, remove the file" in err
    code, _, err = run(*arguments, "--resume")
    assert code == 0, err
    assert not state.exists()
    same = [(written / folder / "motion.json").read_text() for folder in ("plan", "killed")]
    assert same[0] == same[1]


def test_limits_forces_by_nominal_parameters_and_adds_to_earlier_motions(
    designed, run, no_pictures, monkeypatch
):
    written = designed
    for name, stages in STAGES.items():  # a force that only few motions keep needs them all
        monkeypatch.setattr(search, name, stages)

    # The angle turns about y: the rod points ahead at zero, and holding it there takes 7.8 N m.
    def largest_force(folder):
        _, q, _, qdd = table(written / folder / "motion.csv").T
        return np.abs((0.11 + 2 * 0.4**2) * qdd - 2 * 0.4 * 9.81 * np.cos(q)).max()

    keys = ("force_margin = 0.5", 'earlier = ["plan/motion.json"]')
    path = with_keys(written, "weak.toml", *keys)
    code, out, err = run("excite", path, "-o", "weak/motion.csv")
    assert code == 0, err
    assert largest_force("weak") <= 6.0 < 7.5 < largest_force("plan")
    assert "use of the other limits" in out
    assert re.search(
        r"force of joint `hinge` +5\.\d+ N m +≤ 6 N m +9\d\.\d +12 less a margin of", out
    )
    assert "counted as zero in the forces: fv1" in " ".join(out.split())
    assert "the robot starts at rest and is in the designed motion from 0.500 to" in out


@pytest.mark.parametrize(
    ("key", "constrained", "expected"),
    [
        ("spline = { points = 6, duration = 5.0 }", True, RestToRestSplineBasis(6, 5.0)),
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
    base = experiment.base
    covariance, names = 0.01 * np.eye(base.size), [*base.names]

    class Earlier:
        parameters = 1.0 + np.arange(base.size)

        def __init__(self, folder):
            self.base = SimpleNamespace(names=tuple(names), size=len(names))
            self.covariance = covariance

    monkeypatch.setattr("jaxid.experiment.excitation.read_fit", Earlier)
    found = find_nominal(experiment)
    np.testing.assert_array_equal(found.covariance, covariance)
    assert found.undetermined == ()
    covariance = covariance.copy()
    covariance[0, 0] = np.inf
    found = find_nominal(experiment)
    assert found.undetermined == base.names[:1]
    np.testing.assert_array_equal(np.diag(found.covariance), 0.01 * (np.arange(base.size) > 0))
    find_constraints(load_experiment(path), found)  # refuses a covariance that is not finite
    names[0] = "other"
    with pytest.raises(ValueError, match="are not the"):
        find_nominal(experiment)


def test_forces_that_the_design_has_not_limited_are_looked_at(written, excited):
    def remarks(force, known=True):
        text = EXPERIMENT.replace("[4]", f"[4]\nforce = [{force}]")
        (written / "forces.toml").write_text(text)
        experiment = load_experiment(written / "forces.toml")
        nominal = find_nominal(experiment) if known else None
        return force_remarks(experiment, nominal, excited.played)

    # Holding the rod where it points ahead takes 7.8 N m.
    within, zero = remarks(50.0)
    assert within.status is Status.NEUTRAL
    assert re.search(r"hinge` with (1[4-9]|2\d)(\.\d)? % of 50 N m", within.text)
    assert zero.text == "not known, and counted as zero in the forces: fv1, fc1, fo1."
    beyond, _ = remarks(5.0)
    assert beyond.status is Status.BAD
    assert re.search(
        r"joint `hinge` with 1[4-9]\d\.\d % of 5 N m; give `force_margin`", beyond.text
    )
    (unknown,) = remarks(5.0, known=False)
    assert unknown.text.startswith("forces were not checked, although they have limits")


def test_tables_are_sampled_as_a_controller_wants_them(written, excited, no_pictures, monkeypatch):
    monkeypatch.setattr(
        "jaxid.experiment.excitation.design_excitation", lambda *_, **__: excited.plan
    )
    keys = ("sample_time = 0.03", "leads = { periods = 2 }", 'ros = "json"')
    experiment = load_experiment(with_keys(written, "cycles.toml", *keys))
    found = design_motion(experiment, lambda _: None, written / "no.npz", False)
    begin, end = found.played.window
    assert end - begin == pytest.approx(4 * np.pi / 0.8)
    files = write_design(experiment, found, written / "cycles" / "motion.csv")
    t, q, qd, qdd = table(files[0]).T
    np.testing.assert_allclose(t, 0.03 * np.arange(len(t)), atol=1e-12)
    assert 0.0 <= t[-1] - float(found.played.duration) < 0.03
    np.testing.assert_allclose(q[-1], found.played.motion(found.played.duration).q[0])
    assert np.abs([qd[-1], qdd[-1]]).max() < 1e-9
    assert files[2].name == "motion.ros.json"
    assert len(json.loads(files[2].read_text())["points"]) == len(t)
    said = [remark.text for remark in found.remarks]
    assert "the motion runs through 2 periods; the deviations are of one." in said


def test_the_guide_shows_every_key():
    guide = Path(__file__).parent.parent / "docs" / "excitation.md"
    shown = guide.read_text(encoding="utf-8").partition("```toml")[2].partition("```")[0]
    for kind in (Excitation, Leads, RestToRestSplineBasis):
        for key in keys_of(kind):
            assert re.search(rf"\b{key} = ", shown), key


def test_limits_that_nobody_gave_are_named(written, excited):
    (written / "open.toml").write_text(EXPERIMENT.replace("acceleration = [4]", ""))
    robot = load_experiment(written / "open.toml").robot
    limits = JointLimits(robot, excited.plan.limits.basis)
    plan = dataclasses.replace(excited.plan, limits=limits)
    said = [remark.text for remark in plan_remarks(plan)]
    assert "Assumed, because not given: acceleration of `hinge` (8 rad/s²)." in said
    assert not any("ssumed" in remark.text for remark in plan_remarks(excited.plan))


def test_a_motion_without_a_way_into_it_is_written_with_a_warning(written, excited, monkeypatch):
    def refuse(series, robot, periods):
        raise InputError("no lead is short enough.")

    monkeypatch.setattr("jaxid.experiment.excitation.with_leads", refuse)
    monkeypatch.setattr(
        "jaxid.experiment.excitation.design_excitation", lambda *_, **__: excited.plan
    )
    led = design_motion(
        load_experiment(written / "fast.toml"), lambda _: None, written / "no.npz", False
    )
    assert led.played is led.plan.trajectory
    text = " ".join(remark.text for remark in led.remarks)
    assert "the motion is without leads, and starts and ends at full speed: no lead is" in text


def test_ctrl_c_among_the_criteria_shows_those_that_are_done(
    excited, run, no_pictures, monkeypatch
):
    asked = []

    def one_design(*args, **settings):
        asked.append(settings["criterion"].name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return excited.plan

    monkeypatch.setattr("jaxid.cli.commands.design_motion", lambda *_: excited)
    monkeypatch.setattr("jaxid.experiment.excitation.design_excitation", one_design)
    arguments = ["excite", "experiment.toml", "-o", "some/motion.csv", "--all-criteria", "--resume"]
    code, out, err = run(*arguments)
    assert code == 0, err
    assert "`some/motion.state.npz` is not there: the design begins anew" in out
    assert asked == [c.name for c in CRITERIA[:2]]
    assert "motions that minimise one of the criteria each" in out
    assert "stopped after 1 of 6 criteria" in out


@pytest.mark.parametrize(
    ("kept", "said"), [(True, "`--resume` goes on with `early/"), (False, "start again")]
)
def test_ctrl_c_before_a_motion_keeps_all_limits(written, run, monkeypatch, kept, said):
    def stopped(loaded, tell, state, resume):
        if kept:
            state.parent.mkdir()
            state.touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxid.cli.commands.design_motion", stopped)
    folder = "early" if kept else "never"
    code, out, err = run("excite", "experiment.toml", "-o", f"{folder}/motion.csv")
    assert (code, out) == (130, "")
    assert err.startswith("jaxid: the design was stopped before a motion kept all limits")
    assert said in err


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("rests = true", "`excitation.rests` is no known key: did you mean `rest`"),
        ("leads = false\nsample_time = 0.01", "choose `omega` = 0.79"),
        ("rest = true", "`harmonics` must be at least"),
        ("rest = true\nspline = {}", "a `spline` rests at its ends"),
        ("spline = { point = 9 }", "`excitation.spline.point` is no known key: did you mean `po"),
        ("noise = [1, 2]", "`noise` must hold one positive number for each joint"),
        ('nominal = "nowhere"', "holds no `model.json`"),
        ('earlier = ["nowhere.json"]', "nowhere.json"),
        ('earlier = ["arm.json"]', "the motion of `arm.json` moves 2 joint(s), but the robot"),
        (
            'earlier = ["arm.json"]\ncriterion = "condition_number"',
            '`earlier` and `criterion = "condition_number"` do not go together',
        ),
    ],
)
def test_refuses_what_does_not_fit(written, run, key, said):
    text = EXPERIMENT.replace("harmonics = 2", "harmonics = 1")
    (written / "wrong.toml").write_text(text + key + "\n")
    arm = fourier_series(np.zeros(2), np.zeros((2, 1)), np.ones((2, 1)), 1.0)
    save_trajectory(arm, written / "arm.json")
    code, out, err = run("excite", "wrong.toml")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert said in err
    assert "trajectory.csv" not in listing(written)
