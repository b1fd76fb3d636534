"""A servo arm on MuJoCo: position servos, delay, dry friction, encoders of 12 bits."""

import functools

import mujoco
import numpy as np

import jaxid as jid
from jaxid.dynamics.terms import RigidBodies

KP, DAMPING, ARMATURE, FRICTION = (12.0, 15.0), (0.9, 1.0), (0.05, 0.04), (0.15, 0.2)
DELAY = 0.012
MASS, CENTRE = 0.6, 0.15
ENCODER = 2 * np.pi / 4096

XML = """<mujoco><compiler angle="radian"/>
<extension><plugin plugin="mujoco.pid"/></extension>
<option timestep="{step}" gravity="0 0 -9.81" integrator="implicitfast"/>
<worldbody><body name="turn">
<inertial pos="0 0 0" mass="1" diaginertia="0.002 0.002 0.002"/>
<joint name="turn" axis="0 0 1" armature="{I[0]}" damping="{D[0]}" frictionloss="{F[0]}"
 solreffriction="{soft} 1" solimpfriction="0.99 0.9999 0.001"/>
<body name="lift"><inertial pos="{c} 0 0" mass="{m}" diaginertia="0.001 0.001 0.001"/>
<joint name="lift" axis="0 1 0" armature="{I[1]}" damping="{D[1]}" frictionloss="{F[1]}"
 solreffriction="{soft} 1" solimpfriction="0.99 0.9999 0.001"/>
</body></body></worldbody><actuator>
<plugin name="turn" joint="turn" plugin="mujoco.pid" actdim="{n}" forcerange="-{u} {u}">
<config key="kp" value="{K[0]}"/><config key="ki" value="{Ki[0]}"/></plugin>
<plugin name="lift" joint="lift" plugin="mujoco.pid" actdim="{n}" forcerange="-{u} {u}">
<config key="kp" value="{K[1]}"/><config key="ki" value="{Ki[1]}"/></plugin>
</actuator></mujoco>"""


def model_text(step=0.001, ki=0.0, limit=1e3):
    """Return the arm as MJCF; `ki` is the integral gain over the stiffness."""
    return XML.format(
        step=step,
        soft=2.0 * step,
        I=ARMATURE,
        D=DAMPING,
        F=FRICTION,
        K=KP,
        Ki=tuple(ki * k for k in KP),
        n=int(ki > 0.0),
        u=limit,
        c=CENTRE,
        m=MASS,
    )


@functools.cache
def bodies(coupled=True):
    """Return the bodies of the arm, as `identify_rollout` takes them.

    They are made once: what is compiled for them serves all tests.
    """
    robot = jid.Robot(
        "servo arm",
        revolute=(True, True),
        axis=[(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)],
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        offset=np.zeros((2, 3)),
        tip_offset=(0.3, 0.0, 0.0),
    )
    model = jid.Model(robot, (RigidBodies(),))
    own = 0.001 + MASS * CENTRE**2
    turn = [1.0, 0.0, 0.0, 0.0, 0.002, 0.002, 0.002, 0.0, 0.0, 0.0]
    lift = [MASS, MASS * CENTRE, 0.0, 0.0, 0.001, own, own, 0.0, 0.0, 0.0]
    return jid.rollout.Bodies(model, np.array([*turn, *lift]), coupled)


def commands(seed, duration, rate=50.0):
    """Return sums of sines, with rests between them [samples, joints]."""
    random, t = np.random.default_rng(seed), np.arange(round(duration * rate)) / rate
    q = np.zeros((len(t), 2))
    for j in range(2):
        for f in (0.1, 0.23, 0.5, 0.9, 1.6):
            q[:, j] += (
                0.25 / (1 + 2 * f) * np.sin(2 * np.pi * (f * t + random.uniform()))
            )
    envelope = np.clip(np.minimum(t, 2.0) / 2.0, 0.0, 1.0)[:, None]
    held = (t % 6.0) > 5.0
    for k in np.flatnonzero(held):
        q[k] = q[k - 1]
    return envelope * q


@functools.cache
def log(
    seed=0,
    duration=8.0,
    step=0.001,
    block=None,
    rounding=ENCODER,
    ki=0.0,
    limit=1e3,
    feed=None,
):
    """Return a log of 50 Hz; commands are held until the next and reach servos late.

    Args:
        seed: Seed of the commands.
        duration: Length [s].
        step: Step of MuJoCo [s].
        block: Angle of the second joint above which a table holds it [rad].
        rounding: Step of the encoders [rad].
        ki: Integral gain over the stiffness [1/s].
        limit: Largest torque of the servos [N m].
        feed: Torque for each rad/s of the commands, which are then interpolated; none
            without [N m s/rad].
    """
    model = mujoco.MjModel.from_xml_string(model_text(step, ki, limit))
    data = mujoco.MjData(model)
    sent = commands(seed, duration)
    stride = round(0.02 / step)
    measured = np.zeros_like(sent)
    if ki > 0.0:
        # Integral action carries the weight from the beginning.
        mujoco.mj_forward(model, data)
        data.act[:] = data.qfrc_bias / (ki * np.array(KP))
    # The first command is zero, where the servos have settled before the log begins.
    mujoco.mj_step(model, data, round(1.0 / step))
    for k in range(stride * len(sent)):
        if k % stride == 0:
            measured[k // stride] = data.qpos
        samples = max(0.0, (k - round(DELAY / step)) / stride)
        index = int(samples)
        command = sent[index]
        if feed is not None:
            slope = sent[min(index + 1, len(sent) - 1)] - command
            command = command + (samples - index) * slope
            data.qfrc_applied[:] = feed * slope / 0.02
        data.ctrl[:] = command
        if block is not None:
            # A stiff one-sided spring stands in for a table.
            data.qfrc_applied[1] = min(0.0, 400.0 * (block - data.qpos[1]))
        mujoco.mj_step(model, data)
    measured = rounding * np.round(measured / rounding)
    return jid.Recording.of(measured, sent, sample_time=0.02, name=f"motion {seed}")
