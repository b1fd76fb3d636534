"""Golden results of the example, of exported models, and of a design with a fixed key.

Those of measured robots are compared in `tests/real_data`, those of the demo in
`test_demo.py`.
"""

import ctypes
import shutil
import subprocess
from xml.etree import ElementTree

import jax
import numpy as np
import pytest
from golden_results import TOLERANCE, command, compare, golden, numbers_of_report

import jaxid as jid


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("golden") / "example"
    command("example", folder)
    return folder


def test_example(example, tmp_path):
    logs = (example / "identification.csv", "--verify", example / "verification.csv")
    command("identify", example / "experiment.toml", *logs, "-o", tmp_path / "report")
    compare("example", numbers_of_report(tmp_path / "report"))


@pytest.fixture(scope="module")
def consistent(example):
    """Return the report of the example identified with possible bodies."""
    text = (example / "experiment.toml").read_text(encoding="utf-8")
    changed = text.replace('kind = "weighted"', 'kind = "consistent"\npull = 0')
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
        torque(
            *(
                ctypes.c_void_p(x.ctypes.data)
                for x in (*np.ascontiguousarray(sample), forces)
            )
        )
        found.append(list(forces))
    compare("export_c", {"torques": found}, max(TOLERANCE, 1e-7))


@pytest.mark.parametrize("target", ["urdf", "mjcf"])
def test_export_of_bodies(target, consistent, tmp_path):
    path = tmp_path / f"arm.{target}"
    extra = ()
    if target == "urdf":
        chain = "".join(
            f'<link name="l{k + 1}"/><joint name="joint{k + 1}" type="revolute">'
            f'<parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy} 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-3" upper="3" velocity="2" effort="80"/></joint>'
            for k, (xyz, rpy) in enumerate(PANDA)
        )
        (tmp_path / "own.urdf").write_text(
            f'<robot name="a"><link name="l0"/>{chain}</robot>'
        )
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
    base = jid.base_parameters(
        jid.Model(jid.robots.planar_arm(2).replace(limits=limits))
    )
    settings = {
        "harmonics": 3,
        "omega": 1.1,
        "starts": 3,
        "generations": 2,
        "samples": 200,
    }
    plan = jid.design_excitation(base, key=jax.random.key(3), **settings)
    assert plan.feasible
    # A search ends in one of several optima that are nearly equal: its value is what
    # counts.
    (designed,) = [c for c in plan.criteria if c.name == plan.criterion.name]
    assert designed.after <= golden("design")["value"] * 1.02
