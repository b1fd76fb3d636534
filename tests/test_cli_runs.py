"""Several runs on the command line: added, with a payload, a known load, a delay."""

import csv
import dataclasses
import html
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from arm_files import HALF_PI, urdf_of_arm
from golden_results import require_same_results
from test_cli import (  # noqa: F401
    EXPERIMENT,
    first,
    folder,
    material,
    refused,
    result,
    run,
    words,
    write_log,
)

import jaxid as jid
from jaxid.experiment.experiment import load_experiment
from jaxid.program.sample_methods import in_numpy
from jaxid.simulation.virtual import random_bodies
from jaxid.workflow.log_loading import read_log

SPATIAL_ARM = urdf_of_arm(
    (0.0, 0.0, 0.3, 0.0), (0.1, 0.0, 0.0, -HALF_PI), (0.4, 0.1, 0.0, -HALF_PI)
)
SPATIAL = """\
[robot]
name = "spatial"
urdf = "spatial.urdf"
[limits]
force = [60, 80, 20]
velocity = [3, 3, 3]
[model]
rotor_inertia = false
[recording]
angles = "q{}"
forces = "tau{}"
time = "t"
[filter]
kind = "butterworth"
cutoff = 10
[rows]
step = 4
"""
LOAD = """\
[load]
mass = 3
centre_of_mass = [0.02, -0.03, 0.12]
body = "joint3"
inertia = { xx = 0.012, yy = 0.015, zz = 0.008, xy = 0.001, yz = -0.0005 }
"""
GAINS = np.array([1.2, 0.85, 1.05])


def write(path, model, p, seed, gains=1.0, late=0.0):
    """Ten seconds of a random motion with a little noise."""
    trajectory = jid.trajectories.random_fourier_series(
        model.robot, omega=1.2, seed=seed
    )
    t = np.arange(0.0, 10.0, 0.005)
    felt = trajectory.motion(t - late)
    forces = in_numpy(model, model.forces, felt.q, felt.qd, felt.qdd, shared=(p,))
    forces = forces + np.random.default_rng(seed).normal(
        0.0, [0.1, 0.1, 0.03], forces.shape
    )
    table = np.column_stack([t, trajectory.motion(t).q, forces / gains])
    header = "t,q1,q2,q3,tau1,tau2,tau3"
    np.savetxt(path, table, "%.7f", ",", header=header, comments="")


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """Logs without and with a load, by true and by nominal gains."""
    place = tmp_path_factory.mktemp("workshop")
    (place / "spatial.urdf").write_text(SPATIAL_ARM)
    (place / "experiment.toml").write_text(SPATIAL)
    (place / "load.toml").write_text(SPATIAL + LOAD)
    described = load_experiment(place / "load.toml")
    model = described.setup.model
    random = np.random.default_rng(0)
    p = random.uniform(0.2, 1.0, model.size)
    loaded = p.copy()
    loaded[20:30] += described.load.parameters
    loaded[[model.parameter_names.index(f"fv{j}") for j in (1, 2, 3)]] *= 1.3
    for k, (name, own) in enumerate((("empty", p), ("loaded", loaded))):
        write(place / f"{name}.csv", model, own, k + 1)
        write(place / f"{name}_nominal.csv", model, own, k + 1, GAINS)
    write(place / "late.csv", model, p, 1, late=0.012)
    return place


@pytest.fixture
def shop(workshop, tmp_path, monkeypatch):
    """A folder to write into beside the logs."""
    for path in workshop.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


def read(path, log):
    """The recording of a log, as an experiment file says."""
    experiment = load_experiment(path)
    return read_log(experiment.setup, Path(log), experiment.columns)


def pasted(out, title):
    """The lines for the experiment file that a command has printed, from one on."""
    lines = out.splitlines()
    start = lines.index(title)
    return "\n".join(lines[start : lines.index("", start)]) + "\n"


def page_text(name):
    """The text of a page, without tags, in one line."""
    page = Path(name, "report.html").read_text(encoding="utf-8")
    _, body = page.split("<body>")
    text = re.sub(r"<[^>]*>", " ", body)
    return " ".join(html.unescape(text).split())


def test_a_payload_is_found_and_can_be_subtracted(shop, run):  # noqa: F811
    code, out, err = run(
        "payload", "experiment.toml", "empty.csv", "--loaded", "loaded.csv"
    )
    assert code == 0, err
    assert set(os.listdir("payload")) == {"payload.json", "payload.csv", "report.html"}
    found = json.loads((shop / "payload" / "payload.json").read_text(encoding="utf-8"))
    assert found["body"] == "joint3"
    assert abs(found["mass"] / 3.0 - 1.0) < 0.01
    np.testing.assert_allclose(found["centre_of_mass"], [0.02, -0.03, 0.12], atol=3e-3)
    assert [row["name"] for row in found["parameters"]][10:13] == ["m", "x", "y"]
    assert "possible body" in out
    page = page_text("payload")
    assert "✓ The payload on joint3 has" in page
    assert "moment of inertia about x" in page
    assert "model without the payload" in page
    assert "the payload as an aluminium ball of" in page
    assert " ".join(pasted(out, "[robot.tool]").split()) in page
    (shop / "tool.toml").write_text(SPATIAL + pasted(out, "[robot.tool]"))
    tool = load_experiment("tool.toml").setup.robot.tool
    np.testing.assert_allclose(tool.inertia, found["inertia"], rtol=1e-4)
    # Of forces that are wrong by their gains, the mass matrix may be indefinite.
    assert run("identify", "experiment.toml", "empty.csv", "-o", "a")[0] in (0, 3)
    assert run("identify", "tool.toml", "loaded.csv", "-o", "b")[0] in (0, 3)
    code, out, _ = run("compare", "a", "b")
    changed = [line for line in out.splitlines() if line.rstrip().endswith("  changed")]
    assert any("viscous friction" in line for line in changed)
    assert not any("rigid bodies" in line for line in changed)


def test_a_tool_that_was_taken_off_ends_with_a_code_and_no_table(shop, run):  # noqa: F811
    code, out, err = run(
        "payload", "experiment.toml", "loaded.csv", "--loaded", "empty.csv"
    )
    assert code == 3, err
    assert "lighter by 3.0 kg" in out
    assert "are the logs exchanged" in " ".join(out.split())
    assert "[robot.tool]" not in out
    found = json.loads((shop / "payload" / "payload.json").read_text(encoding="utf-8"))
    assert abs(found["mass"] / -3.0 - 1.0) < 0.01


def test_true_forces_are_found_and_can_be_used(shop, run):  # noqa: F811
    logs = ("empty_nominal.csv", "--loaded", "loaded_nominal.csv")
    code, out, err = run("gains", "load.toml", *logs)
    assert code == 0, err
    found = json.loads((shop / "gains" / "gains.json").read_text(encoding="utf-8"))
    np.testing.assert_allclose(found["force_gains"], GAINS, rtol=0.02)
    line = pasted(out, "[recording]").splitlines()[1]
    text = SPATIAL.replace('time = "t"', f'time = "t"\n{line}')
    (shop / "true.toml").write_text(text)
    forces = read("true.toml", "empty_nominal.csv").forces
    expected = read("experiment.toml", "empty.csv").forces
    np.testing.assert_allclose(forces, expected, rtol=0.02, atol=1e-3)
    (shop / "tool.toml").write_text(
        SPATIAL + LOAD + LOAD.replace("[load]", "[robot.tool]")
    )
    assert refused(run("gains", "tool.toml", *logs), "has a known tool")
    page = page_text("gains")
    assert "✓ The logs determine 3 of 3 gains" in page
    assert line in page


def test_a_load_that_does_not_fit_is_refused(shop, run):  # noqa: F811
    (shop / "wrong.toml").write_text(SPATIAL + LOAD.replace("0.12]", "0.01]"))
    code, out, _ = run(
        "gains", "wrong.toml", "empty_nominal.csv", "--loaded", "loaded_nominal.csv"
    )
    assert code == 3
    assert "[recording]" not in out
    assert "✗ The load does not fit" in page_text("gains")
    assert "force_gains =" not in page_text("gains")
    logs = ("empty.csv", "--loaded", "loaded.csv")
    code, _, _ = run("payload", "experiment.toml", *logs, "--body", "joint1")
    assert code == 3
    assert "✗ No load explains the forces" in page_text("payload")


def test_a_delay_is_seen_and_removed(shop, run):  # noqa: F811
    _, out, _ = run("inspect", "experiment.toml", "late.csv", "-o", "look")
    page = page_text("look")
    assert "! Look at what is marked before you identify" in page
    assert "positions and forces (dashed: limits)" in page
    with open("look/inspection.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    speeds = np.abs(np.diff(np.loadtxt("late.csv", delimiter=",", skiprows=1), axis=0))
    speeds = speeds[:, 1:4].max(axis=0) / 0.005
    np.testing.assert_allclose([float(x["speed"]) for x in rows], speeds, rtol=0.05)
    found = re.search(r"force_delay = ([0-9.]+)`", " ".join(out.split()))
    assert found, out
    assert abs(float(found[1]) - 0.012) < 3e-4
    cured = SPATIAL.replace('time = "t"', f'time = "t"\nforce_delay = {found[1]}')
    (shop / "cured.toml").write_text(cured)
    code, out, _ = run("inspect", "cured.toml", "late.csv", "-v")
    assert code == 0
    assert "a delay of the forces of 12" in " ".join(out.split())
    assert "force_delay" not in out


FOREIGN = [
    ("", "identify e.toml first b.csv", "is not a file or a ROS 2 bag"),
    (
        "",
        "payload e.toml a.csv --loaded b.csv --body elbow",
        "`--body` must be the name of the jo",
    ),
    ("", "states e.toml a.csv", "one log for each of two or more states"),
    ("", "gains e.toml a.csv --loaded b.csv", "the table `[load]` is missing"),
]


@pytest.mark.parametrize(("table", "command", "said"), FOREIGN, ids=range(len(FOREIGN)))
def test_what_does_not_go_together(folder, first, run, table, command, said):  # noqa: F811
    (folder / "other").mkdir()
    (folder / "e.toml").write_text(f"{EXPERIMENT}{table}\n")
    assert refused(run(*command.split()), said)


def test_what_is_not_seen_or_not_used_is_said(folder, words):  # noqa: F811
    (folder / "huber.toml").write_text(EXPERIMENT + '[estimator]\nkind = "huber"\n')
    said = words("payload", "huber.toml", "a.csv", "--loaded", "b.csv", ends=3)
    assert "this command always uses weighted least squares" in said
    assert "do not determine mass and centre of the payload" in said


def test_states_share_inertia(folder, words):  # noqa: F811
    write_log(folder / "warm.csv", 7)
    assert "fv1 (warm)" in words("states", "experiment.toml", "a.csv", "warm.csv")
    found = json.loads((folder / "states" / "states.json").read_text(encoding="utf-8"))
    assert found["states"] == ["a", "warm"]
    described = load_experiment(folder / "experiment.toml")
    base, estimator = described.setup.base, described.setup.least_squares
    runs = []
    for name in ("a", "warm"):
        log = described.setup.observe(read(described.path, folder / f"{name}.csv"))
        if not runs:
            base = jid.identify_transition_speeds(base, log)
        runs.append(jid.identify(base, log, estimator=estimator, name=name))
    expected = jid.identify_states(runs)
    estimates = {row["name"]: row["estimate"] for row in found["parameters"]}
    assert tuple(estimates) == expected.names
    np.testing.assert_allclose(
        list(estimates.values()), expected.parameters, rtol=1e-9, atol=1e-12
    )
    assert set(found["shared"]) == {base.names[k] for k in expected.shared}
    page = page_text("states")
    assert "parameters of friction and offsets have changed from a to warm" in page
    assert "warm, measured" in page


def test_a_model_is_chosen_and_its_file_identifies(shop, run):  # noqa: F811
    code, out, _ = run("choose", "experiment.toml", "empty.csv", "-v")
    assert code == 0
    assert "Chosen: " in out
    assert "is kept if it lowers the error" in out
    chosen = load_experiment("chosen.toml")
    # The truth has no springs.
    names = [type(term).__name__ for term in chosen.setup.model.terms]
    assert "LinearSpring" not in names
    page = Path("chosen.html").read_text(encoding="utf-8")
    assert "path of the search" in page
    assert "chosen model" in page
    assert run("identify", "chosen.toml", "empty.csv", "-o", "c")[0] in (0, 3)
    again = run("choose", "experiment.toml", "empty.csv")
    assert refused(again, "`chosen.toml` already exists")
    same = run("choose", "experiment.toml", "empty.csv", "-o", "experiment.toml")
    assert refused(same, "`experiment.toml` already exists")


PRESLIDING = SPATIAL.replace(
    "[recording]", "[model.coulomb]\npresliding = true\n[recording]"
)


def test_friction_with_memory_from_the_log_to_the_report(shop, run, words):  # noqa: F811
    (shop / "memory.toml").write_text(PRESLIDING)
    model = load_experiment("memory.toml").setup.model.with_memory(length=0.05)
    p, t = (
        np.random.default_rng(0).uniform(0.2, 1.0, model.size),
        np.arange(0.0, 20.0, 0.005),
    )
    p[:30] = random_bodies(
        model.robot, np.array([3.0, 2.0, 1.0]), np.random.default_rng(0)
    ).ravel()
    motion = jid.trajectories.random_fourier_series(
        model.robot, omega=1.2, seed=8
    ).motion(t)
    forces = model.inverse_dynamics(
        p, jid.Motion(*map(np.asarray, (motion.q, motion.qd, motion.qdd)))
    )
    forces = forces + np.random.default_rng(1).normal(0.0, 0.03, forces.shape)
    table, header = np.column_stack([t, motion.q, forces]), "t,q1,q2,q3,tau1,tau2,tau3"
    np.savetxt("memory.csv", table, "%.7f", ",", header=header, comments="")
    said = words(
        "identify", "memory.toml", "memory.csv", "-o", "report", "--split", "0.6"
    )
    fit = jid.load_fit("report/model.json")
    np.testing.assert_allclose(fit.base.model.memory.length, 0.05, rtol=0.1)
    shown = re.findall(
        r"joint\d (0\.\d+) rad", said[said.index("lengths of presliding") :]
    )
    np.testing.assert_allclose([float(x) for x in shown[:3]], 0.05, rtol=0.12)
    for errors in result(shop, "report")["errors"].values():
        assert all(joint["rms"] < 0.05 for joint in errors[0]["joints"])
    words("export", "report", "--to", "c", "-o", "arm.c")
    assert "arm_advance" in (shop / "arm.h").read_text()


def test_python_and_the_command_line_have_the_same_defaults(folder, words):  # noqa: F811
    Path("plain.toml").write_text(EXPERIMENT[: EXPERIMENT.index("[filter]")])
    printed = words(
        "identify", "plain.toml", "a.csv", "--split", "0.6", "-o", "command"
    )
    terms = (
        jid.RigidBodies(),
        jid.ViscousFriction(),
        jid.CoulombFriction(),
        jid.RotorInertia(),
        jid.ConstantOffset(),
    )
    arm = jid.robots.planar_arm()
    limits = dataclasses.replace(arm.limits, joints=2, force=np.array([80.0, 20.0]))
    setup = jid.Setup(jid.Model(arm.replace(limits=limits), terms))
    columns = jid.Columns(angles="q{}", forces="tau{}", time="t")
    report = jid.identify_logs(setup, [Path("a.csv")], columns, held_out=0.4)
    report.save("python")
    require_same_results(Path("command"), Path("python"))
    assert report.verdict.text in printed
