"""MuJoCo's position actuators lack what some servos have: files say how to cure it."""

import dataclasses

import mujoco
import numpy as np
import pytest

import jaxid as jid
from jaxid.export.servo_actuators import simulator_table, simulator_values
from jaxid.rollout import PARAMETERS

INDEX = {parameter.symbol: k for k, parameter in enumerate(PARAMETERS)}
STEP = 0.001


@pytest.fixture(scope="module")
def fed_fit(fit):
    """Return servos that feed the velocity of their commands forward."""
    parameters = fit.parameters.copy()
    parameters[:, INDEX["f"]] = (0.03, 0.05)
    parameters[:, INDEX["d"]] = 0.0
    return dataclasses.replace(fit, parameters=parameters, hold=False, time_step=STEP)


def test_a_feed_forward_is_named(fit, fed_fit, tmp_path):
    values = simulator_values(fed_fit)
    np.testing.assert_allclose(
        values["feed_forward"], values["stiffness"] * [0.03, 0.05]
    )
    assert "feed-forward" in str(simulator_table(fed_fit))
    assert "feed-forward" not in str(simulator_table(fit))
    for servos, count in ((fit, 0), (fed_fit, 1)):
        (path,) = jid.export.export_servo_mjcf(servos, tmp_path / "arm.xml")
        assert path.read_text().count("feed-forward") == count


def test_mujoco_moves_alike_if_the_rate_is_added_to_the_command(fed_fit, tmp_path):
    path = tmp_path / "arm.xml"
    jid.export.export_servo_mjcf(fed_fit, path, timestep=STEP)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    time = STEP * np.arange(3000)[:, None]
    frequencies = np.array([4.0, 6.0])
    commands = 0.2 * (1.0 - np.cos(frequencies * time))
    rates = 0.2 * frequencies * np.sin(frequencies * time)
    feed_forward, offset = (model.numeric(x).data for x in ("feed_forward", "offset"))
    positions = np.zeros_like(commands)
    for k, (command, rate) in enumerate(zip(commands, rates, strict=True)):
        positions[k] = data.qpos
        data.ctrl[:] = command + feed_forward * rate + offset
        mujoco.mj_step(model, data)
    log = jid.Recording.of(positions, commands, sample_time=STEP)
    # The velocity at the start is a guess from positions: the arm sags at once.
    settled = slice(1000, None)
    (simulated,) = fed_fit.simulate(log)
    assert np.abs(simulated - positions)[settled].max() < 1e-3
    plain_parameters = fed_fit.parameters.copy()
    plain_parameters[:, INDEX["f"]] = 0.0
    plain_fit = dataclasses.replace(fed_fit, parameters=plain_parameters)
    (plain,) = plain_fit.simulate(log)
    assert np.abs(plain - positions)[settled].max() > 2e-2


def test_servos_move_the_joints_of_the_model_whatever_their_names(fit, tmp_path):
    named_fit = dataclasses.replace(fit, joint_names=("first", "second"))
    (path,) = jid.export.export_servo_mjcf(named_fit, tmp_path / "arm.xml")
    assert mujoco.MjModel.from_xml_path(str(path)).nu == 2
