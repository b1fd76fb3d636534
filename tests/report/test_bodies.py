"""Physically consistent estimates in table and result file."""

import io
import json

import numpy as np
import pytest
from rich.console import Console

import jaxid as jid
from jaxid.experiment.terminal import show_consistency
from jaxid.report.bodies import body_table, consistency_content, consistency_facts
from jaxid.report.content import plain


@pytest.fixture(scope="module")
def consistent():
    robot = jid.robots.planar_arm(2, 0.4)
    model = jid.Model(robot, (jid.RigidBodies(), jid.ViscousFriction()))
    base = jid.base_parameters(model)
    t = np.arange(0.0, 6.0, 0.01)
    motion = jid.random_fourier_series(robot, omega=1.5, seed=0).motion(t)
    p = np.zeros(model.size)
    p[[0, 1, 6, 5, 10, 11, 16, 15]] = [2.0, 0.4, 0.11, 0.11, 1.0, 0.2, 0.06, 0.06]
    # Friction that drives: the bound at zero decides.
    p[-2:] = [0.3, -0.3]
    forces = np.array(model.inverse_dynamics(p, motion))
    forces += np.random.default_rng(0).normal(0.0, 0.05, forces.shape)
    log = jid.Recording.of(np.asarray(motion.q), forces, time=t)
    o = jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0))
    return jid.identify(base, o, jid.PhysicallyConsistent(jid.MeasuredForces()))


def test_the_result_file_holds_complete_bodies(consistent):
    text = json.dumps(plain(consistency_content(consistent)), allow_nan=False)
    found = json.loads(text)
    values = [p["estimate"] for p in found["standard_parameters"]]
    np.testing.assert_array_equal(values, consistent.full_parameters)
    assert found["standard_parameters"][1]["unit"] == "kg m"
    assert found["proved"]
    assert found["price"] > 0.1
    assert found["masses_from_bounds"] == ["m1", "m2"]
    assert "fv2 at 0" in " ".join(found["active_bounds"])


def test_the_terminal_shows_bodies_and_bounds(consistent):
    out = io.StringIO()
    robot = consistent.base.model.robot
    show_consistency(Console(file=out, width=120), robot, consistent)
    text = out.getvalue()
    for name in robot.joint_names:
        row = next(line for line in text.splitlines() if line.startswith(name))
        assert "bounds too" in row
    assert "fv2 at 0" in text
    assert "above those without bounds" in text
    table = body_table(consistent.consistency, robot.joint_names)
    assert table.row_count == 2
    assert dict(consistency_facts(consistent.consistency))["price"].split()[2] != "0"


def test_other_estimates_have_none(fit):
    assert consistency_content(fit) is None
    out = io.StringIO()
    show_consistency(Console(file=out), fit.base.model.robot, fit)
    assert out.getvalue() == ""
