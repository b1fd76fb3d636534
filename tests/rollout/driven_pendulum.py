"""A pendulum of two links on MuJoCo, driven by torques, with perhaps noisy encoders."""

import functools

import mujoco
import numpy as np

import jaxid as jid

LATE = 0.006
DAMPING = (0.05, 0.03)
XML = """<mujoco><compiler angle="radian"/>
<option timestep="0.0005" integrator="implicitfast"/><worldbody>
<body name="a"><inertial pos="0 0 -0.15" mass="1" diaginertia="0.01 0.01 0.001"/>
<joint name="a" axis="0 1 0" damping="0.05"/>
<body name="b" pos="0 0 -0.3">
<inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.008 0.008 0.001"/>
<joint name="b" axis="0 1 0" damping="0.03"/></body></body></worldbody>
<actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/>
</actuator></mujoco>"""


@functools.cache
def log(seed, late=LATE, noise=0.0, samples=3000):
    """Return a recording at 500 Hz: torques act late [s], encoders have noise [rad]."""
    model, random = mujoco.MjModel.from_xml_string(XML), np.random.default_rng(seed)
    data, t = mujoco.MjData(model), 0.002 * np.arange(samples)
    phases, rates = random.uniform(0, 6, (5, 2)), random.uniform(1.5, 8.0, (5, 2))
    sent = np.sum(0.25 * np.sin(t[:, None, None] * rates + phases), axis=1)
    q = np.zeros_like(sent)
    for k in range(4 * len(t)):
        if k % 4 == 0:
            q[k // 4] = data.qpos
        data.ctrl[:] = sent[np.clip((k - round(late / 0.0005)) // 4, 0, samples - 1)]
        mujoco.mj_step(model, data)
    q += noise * random.normal(size=q.shape)
    return jid.Recording.of(q, sent, sample_time=0.002, name=f"log{seed}")
