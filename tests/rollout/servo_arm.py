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


def model_text(stiffer=1.0, step=0.001, friction=FRICTION, ki=0.0, limit=1e3):
    """Return the arm as MJCF; `ki` is the integral gain over the stiffness."""
    gains = tuple(stiffer * k for k in KP)
    integral = tuple(ki * k for k in gains)
    soft = 2.0 * step
    return XML.format(
        step=step,
        soft=soft,
        I=ARMATURE,
        D=DAMPING,
        F=friction,
        K=gains,
        Ki=integral,
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


def commands(seed, duration=40.0, rate=50.0):
    """Return sums of sines, with rests between them [samples, joints]."""
    random, t = np.random.default_rng(seed), np.arange(round(duration * rate)) / rate
    q = np.zeros((len(t), 2))
    for j in range(2):
        for f in (0.1, 0.23, 0.5, 0.9, 1.6):
            q[:, j] += (
                0.25 / (1 + 2 * f) * np.sin(2 * np.pi * (f * t + random.uniform()))
            )
    envelope = np.clip(np.minimum(t, 2.0) / 2.0, 0.0, 1.0)[:, None]
    held = (t % 12.0) > 10.0
    for k in np.flatnonzero(held):
        q[k] = q[k - 1]
    return envelope * q


@functools.cache
def log(
    seed=0,
    stiffer=1.0,
    duration=40.0,
    step=0.001,
    friction=FRICTION,
    block=None,
    rounding=ENCODER,
    ki=0.0,
    limit=1e3,
):
    """Return a log of 50 Hz; commands are held until the next and reach servos late."""
    model = mujoco.MjModel.from_xml_string(
        model_text(stiffer, step, friction, ki, limit)
    )
    data, sent = mujoco.MjData(model), commands(seed, duration)
    every, late, measured = round(0.02 / step), round(DELAY / step), np.zeros_like(sent)
    data.qpos[:] = sent[0]
    for k in range(every * len(sent)):
        if k % every == 0:
            measured[k // every] = data.qpos
        data.ctrl[:] = sent[max(0, (k - late) // every)]
        if block is not None:
            # A stiff one-sided spring stands in for a table.
            data.qfrc_applied[1] = min(0.0, 400.0 * (block - data.qpos[1]))
        mujoco.mj_step(model, data)
    measured = rounding * np.round(measured / rounding)
    return jid.Recording.of(measured, sent, sample_time=0.02, name=f"motion {seed}")
