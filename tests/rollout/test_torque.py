"""Open-loop rollouts of a pendulum with two links, whose motion MuJoCo simulates."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxid as jid
from jaxid.rollout.torque import TorqueRollout, Windows

LATE = 0.006
XML = """<mujoco><compiler angle="radian"/>
<option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body name="a"><inertial pos="0 0 -0.15" mass="1" diaginertia="0.01 0.01 0.001"/>
<joint name="a" axis="0 1 0" damping="0.05"/>
<body name="b" pos="0 0 -0.3"><inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.008 0.008 0.001"/>
<joint name="b" axis="0 1 0" damping="0.03"/></body></body></worldbody>
<actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/></actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.xml"
    path.write_text(XML)
    robot = jid.load_mjcf(path)
    return robot, mujoco.MjModel.from_xml_path(str(path))


def _observed(pendulum, seed):
    robot, model = pendulum
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    t = 0.002 * np.arange(3000)
    phases, rates = random.uniform(0, 6, (5, 2)), random.uniform(1.5, 8.0, (5, 2))
    sent = np.sum(0.25 * np.sin(t[:, None, None] * rates + phases), axis=1)
    q = np.zeros_like(sent)
    for k in range(4 * len(t)):
        if k % 4 == 0:
            q[k // 4] = data.qpos
        data.ctrl[:] = sent[max(0, (k - round(LATE / 0.0005)) // 4)]
        mujoco.mj_step(model, data)
    log = jid.Recording.of(q, sent, sample_time=0.002)
    return jid.observe(log, robot, jid.ZeroPhaseButterworth(30.0))


@pytest.fixture(scope="module")
def base(pendulum):
    return jid.base_parameters(jid.Model(pendulum[0], (jid.RigidBodies(), jid.ViscousFriction())))


def test_late_torques_are_found_and_the_simulation_is_closer(pendulum, base):
    found = jid.rollout.identify_torque_rollout(base, _observed(pendulum, 0))
    other = _observed(pendulum, 1)
    assert found.errors_at(other, 0.2).max() < 2e-3
    assert (found.errors_at(other, 0.2) < 0.2 * found.errors_at(other, 0.2, found.start)).all()
    delay = float(found.unknowns[base.size])
    # A held torque is half a sample later than an interpolated one.
    assert delay == pytest.approx(LATE + 0.001, abs=5e-4)
    damping = found.parameters[[base.names.index(x) for x in ("fv1", "fv2")]]
    np.testing.assert_allclose(damping, [0.05, 0.03], rtol=0.1)
    assert "delay" in str(found)


def test_derivatives_of_windows_agree_with_differences(pendulum, base):
    log = _observed(pendulum, 0)
    rollout = TorqueRollout(base, log.sample_time)
    windows = Windows.of([log], 0.1, 1.0)._replace(blocks=None)
    x = rollout.start(np.asarray(jid.identify(base, log).parameters))
    x[base.size] = 0.0041
    J = jax.jacfwd(lambda x: rollout.errors(x, windows))(jnp.asarray(x))
    for k in range(len(x)):
        step = np.zeros_like(x)
        step[k] = 1e-6
        ends = [rollout.errors(jnp.asarray(x + s * step), windows) for s in (1, -1)]
        difference = np.asarray(ends[0] - ends[1]) / 2e-6
        scale = max(np.abs(difference).max(), 1e-3)
        np.testing.assert_allclose(np.asarray(J)[..., k], difference, atol=1e-6 * scale)


def test_windows_need_room(pendulum, base):
    with pytest.raises(jid.InputError, match="`observations`"):
        jid.rollout.identify_torque_rollout(base, _observed(pendulum, 0), horizon=100.0)
