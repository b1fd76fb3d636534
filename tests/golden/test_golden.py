"""Golden results: numbers of whole runs that no change of the code may move.

Each case runs a command of the README, or a design with a fixed key, and compares its numbers with
those in the JSON file beside this one. The tolerance is 1e-9 relative; `JAXID_GOLDEN_TOLERANCE`
widens it for machines with other instruction sets. To record new values after an intended change,
delete the file of that case, run the test, and say in CHANGELOG.md what changed and why.
"""

import ctypes
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import jax
import numpy as np
import pytest

import jaxid as jid
from jaxid import cli
from jaxid.demo.study import run_study

pytestmark = pytest.mark.usefixtures("blank_figures")

HERE = Path(__file__).resolve().parent
TOLERANCE = float(os.environ.get("JAXID_GOLDEN_TOLERANCE", "1e-9"))
LOGS = {
    "tx40_100hz": ("tx40_100hz.toml", "tx40/motor_position.csv"),
    "tx40": ("tx40.toml", "tx40/motor_position.csv", "--split", "0.6"),
    "ur10": ("ur10.toml", "ur10/exciting_measured.csv"),
    "ur10_split": ("ur10.toml", "ur10/exciting_measured.csv", "--split", "0.6"),
    "kr300": (
        "kr300.toml",
        "kr300/traj_A.csv",
        "--verify",
        "kr300/traj_B.csv",
        "--verify",
        "kr300/traj_C.csv",
    ),
}


def command(*words):
    """Run a command line in this process; fail unless it ends well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["jaxid", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
    assert stopped.value.code == 0


def numbers_of_report(folder):
    """Return the numbers of a report that belong to the estimates."""
    found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    errors = found["errors"]["identification"] + found["errors"]["verification"]
    return {
        "parameters": {p["name"]: p["estimate"] for p in found["base_parameters"]},
        "deviations": {p["name"]: p["standard_deviation"] for p in found["base_parameters"]},
        "condition_numbers": found["fit"]["condition_numbers"],
        "residual": found["fit"]["residual"],
        "residual_rms": found["fit"]["residual_rms"],
        "errors": {e["recording"]: [j["rms"] for j in e["joints"]] for e in errors},
        "relative_errors": {e["recording"]: e["relative"] for e in errors},
    }


def compare(case, found, tolerance=TOLERANCE):
    """Compare numbers with the golden file of a case; write it and fail where there is none."""
    path = HERE / f"{case}.json"
    if not path.exists():
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        pytest.fail(f"`{path.name}` was missing and has been recorded: check it, then run again.")
    _compare(case, json.loads(json.dumps(found)), golden(case), tolerance)


def golden(case):
    """Return the golden values of a case."""
    return json.loads((HERE / f"{case}.json").read_text(encoding="utf-8"))


def _compare(place, found, golden, tolerance):
    assert type(found) is type(golden), place
    if isinstance(golden, dict):
        assert list(found) == list(golden), place
        # Values of one kind share a scale: a parameter near zero is compared with the largest.
        flat = all(isinstance(x, float | int) for x in golden.values())
        if flat and golden and "condition" not in place:
            _close(place, list(found.values()), list(golden.values()), tolerance)
            return
        for key in golden:
            _compare(f"{place}.{key}", found[key], golden[key], tolerance)
    else:
        _close(place, found, golden, tolerance)


def _close(place, found, golden, tolerance):
    found, golden = np.asarray(found, float), np.asarray(golden, float)
    scale = np.maximum(np.abs(golden), 1e-3 * np.abs(golden).max(initial=0.0))
    worst = np.max(np.abs(found - golden) / np.where(scale > 0, scale, 1.0), initial=0.0)
    assert worst <= tolerance, f"{place}: {worst:.1e}"


@pytest.mark.parametrize("case", LOGS)
def test_measured_robots(case, shared_data, tmp_path):
    experiment, *words = LOGS[case]
    words = [shared_data / w if w.endswith(".csv") else w for w in words]
    place = HERE.parent / "real_data" / experiment
    command("identify", place, *words, "-o", tmp_path / "report")
    compare(case, numbers_of_report(tmp_path / "report"))


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("golden") / "example"
    command("example", folder)
    return folder


@pytest.mark.usefixtures("blank_figures")
def test_example(example, tmp_path):
    logs = (example / "identification.csv", "--verify", example / "verification.csv")
    command("identify", example / "experiment.toml", *logs, "-o", tmp_path / "report")
    compare("example", numbers_of_report(tmp_path / "report"))


@pytest.fixture(scope="module")
def consistent(example):
    """Return the report of the example identified with possible bodies."""
    text = (example / "experiment.toml").read_text(encoding="utf-8")
    changed = text.replace('kind = "weighted"', 'kind = "consistent"')
    assert changed != text
    (example / "consistent.toml").write_text(changed, encoding="utf-8")
    logs = (example / "consistent.toml", example / "identification.csv")
    command("identify", *logs, "-o", example / "consistent")
    return example / "consistent"


def test_consistent_estimate(consistent):
    compare("consistent", numbers_of_report(consistent), max(TOLERANCE, 1e-7))


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")
def test_export_to_c(consistent, tmp_path):
    command("export", consistent, "--to", "c", "-o", tmp_path / "arm.c")
    words = ["cc", "-O2", "-shared", "-fPIC", "arm.c", "-o", "arm.so", "-lm"]
    subprocess.run(words, cwd=tmp_path, check=True)
    torque = ctypes.CDLL(str(tmp_path / "arm.so")).arm_torque
    torque.restype = None
    found = []
    for sample in np.random.default_rng(0).uniform(-1.5, 1.5, (5, 3, 7)):
        forces = np.empty(7)
        torque(*(ctypes.c_void_p(x.ctypes.data) for x in (*np.ascontiguousarray(sample), forces)))
        found.append(list(forces))
    compare("export_c", {"torques": found}, max(TOLERANCE, 1e-7))


@pytest.mark.parametrize("target", ["urdf", "mjcf"])
def test_export_of_bodies(target, consistent, tmp_path):
    path = tmp_path / f"arm.{target}"
    extra = ()
    if target == "urdf":
        chain = "".join(
            f'<link name="l{k + 1}"/><joint name="joint{k + 1}" type="revolute">'
            f'<parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="{xyz}" rpy="{rpy} 0 0"/>'
            '<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="80"/></joint>'
            for k, (xyz, rpy) in enumerate(PANDA)
        )
        (tmp_path / "own.urdf").write_text(f'<robot name="a"><link name="l0"/>{chain}</robot>')
        extra = ("--urdf", tmp_path / "own.urdf")
    command("export", consistent, "--to", target, "-o", path, *extra)
    bodies = [
        float(word)
        for element in ElementTree.parse(path).iter()
        if element.tag in ("inertial", "mass", "inertia", "origin")
        for key, value in sorted(element.attrib.items())
        if key not in ("xyz", "rpy", "name") or element.tag == "origin"
        for word in value.split()
    ]
    compare(f"export_{target}", {"bodies": bodies}, max(TOLERANCE, 1e-6))


HALF = "1.5707963267948966"
PANDA = (
    ("0 0 0.333", "0"),
    ("0 0 0", f"-{HALF}"),
    ("0 -0.316 0", HALF),
    ("0.0825 0 0", HALF),
    ("-0.0825 0.384 0", f"-{HALF}"),
    ("0 0 0", HALF),
    ("0.088 0 0", HALF),
)
"""Offsets and roll angles of the Panda's joints."""


def test_design():
    limits = jid.Limits(
        2,
        position_min=[-2.0, -1.0],
        position_max=[1.0, 2.5],
        velocity=[2.0, 3.0],
        acceleration=[4.0, 9.0],
        force=[80.0, 20.0],
    )
    base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2).replace(limits=limits)))
    settings = {"harmonics": 3, "omega": 1.1, "starts": 3, "generations": 2, "samples": 200}
    plan = jid.design_excitation(base, key=jax.random.key(3), **settings)
    assert plan.feasible
    # A search ends in one of several optima that are nearly equal: its value is what counts.
    (designed,) = [c for c in plan.criteria if c.name == plan.criterion.name]
    assert designed.after <= golden("design")["value"] * 1.02


def test_identification_of_the_demo():
    robot = jid.robots.tx90l_on_rail()
    motion = jid.random_fourier_series(robot, omega=0.8, reach=0.7, seed=1)
    study = run_study(0, lambda name, fraction: None, draws=1, periods=1, motion=motion)
    fit = study.weighted.fit
    # A servo on quantised encoders with stiction amplifies rounding: a coefficient of the motion
    # changed by 4e-16 moves these parameters by 1e-4 (relative to the largest of their kind).
    compare(
        "demo",
        {
            "parameters": dict(zip(fit.base.names, map(float, fit.parameters), strict=True)),
            "deviations": list(map(float, fit.standard_deviations)),
            "errors": [study.weighted.mean_errors(k) for k in (0, 1)],
        },
        max(TOLERANCE, 2e-3),
    )
