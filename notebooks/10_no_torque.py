# %% [markdown]
# # 10 · No torque in the log
#
# Many robots log their commands and their positions, but no torque. Such logs still suffice for a simulation that moves like the robot: the parameters for which the
# simulated joint, given the recorded commands, stays on the recorded positions. Here a joint with a position servo is simulated on MuJoCo, which shares no code with
# `jaxid`, with dry friction, delay and a 12-bit encoder.

# %%
# %matplotlib inline
# %config InlineBackend.print_figure_kwargs = {"dpi": 80, "bbox_inches": None}
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxid as jid

jax.config.update("jax_enable_x64", True)
np.set_printoptions(precision=4, suppress=True)
plt.style.use("notebook.mplstyle")

# %% [markdown]
# ## A robot that logs commands and positions
#
# One joint lifts 0.6 kg at 15 cm. Its servo has a stiffness of 15 N m/rad, its gear 0.2 N m of dry friction; commands arrive 12 ms late, fifty times a second.

# %%
import mujoco

XML = """<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/>
<worldbody><body name="lift"><inertial pos="0.15 0 0" mass="0.6" diaginertia="0.001 0.001 0.001"/>
<joint name="lift" axis="0 1 0" armature="0.04" damping="1.0" frictionloss="0.2" solreffriction="0.004 1"
 solimpfriction="0.99 0.9999 0.001"/></body></worldbody>
<actuator><position joint="lift" kp="15"/></actuator></mujoco>"""


def measured(sent):
    """Return the encoder's positions for some commands at 50 Hz."""
    model = mujoco.MjModel.from_xml_string(XML)
    data, positions = mujoco.MjData(model), np.zeros_like(sent)
    for k in range(20 * len(sent)):
        if k % 20 == 0:
            positions[k // 20] = data.qpos[0]
        data.ctrl[0] = sent[max(0, (k - 12) // 20)]
        mujoco.mj_step(model, data)
    return 2 * np.pi / 4096 * np.round(positions * 4096 / (2 * np.pi))


t = np.arange(1500) / 50.0
sines = 0.3 * np.sin(0.9 * t) + 0.1 * np.sin(5.1 * t) * np.clip(t, 0, 1)
steps = 0.3 * np.sign(np.sin(0.7 * t)) * (t > 1) + 0.1 * np.sin(0.3 * t)
chirp = 0.15 * np.sin(0.6 * t + 0.12 * t**2)
logs = [
    jid.Recording.of(
        measured(sent)[:, None], sent[:, None], sample_time=0.02, name=name
    )
    for name, sent in (("sines", sines), ("steps", steps), ("chirp", chirp))
]

figure, panels = plt.subplots(1, 3, figsize=(11, 2.6))
for axes, log in zip(panels, logs, strict=True):
    axes.plot(t, log.forces[:, 0], label="commanded")
    axes.plot(t, log.angles[:, 0], label="measured")
    axes.set_title(log.name)
    axes.set_xlabel("time [s]")
panels[0].set_ylabel("angle [rad]")
panels[0].legend()
plt.show()

# %% [markdown]
# Commands take the place of forces: a recording holds the input of a robot and the motion that follows from it.
#
# ## Identify
#
# The mass of the body is known, from a URDF file or a scale. Gravity makes the joint sag, and the sag determines the stiffness; all other parameters are ratios to it. Which
# effects the simulation needs is decided by its errors on motions that are left out of the fit.

# %%
robot = jid.Robot(
    "one joint",
    revolute=(True,),
    axis=[(0.0, 1.0, 0.0)],
    rotation=np.eye(3)[None],
    offset=np.zeros((1, 3)),
    tip_offset=(0.3, 0.0, 0.0),
)
own = 0.001 + 0.6 * 0.15**2
body = np.array([0.6, 0.6 * 0.15, 0.0, 0.0, 0.001, own, own, 0.0, 0.0, 0.0])
bodies = jid.rollout.Bodies(jid.Model(robot, (jid.RigidBodies(),)), body)
fit = jid.identify_rollout(logs, bodies, joint_names=["lift"])
print(fit)
print(jid.export.simulator_table(fit))

# %% [markdown]
# The robot has a stiffness of 15 N m/rad, damping 1.0 N m s/rad, an armature of 0.04 kg m² and 0.2 N m of friction. MuJoCo computes positions half a step late, so
# that the delay is 11.5 ms.
#
# ## A motion that the fit has not seen
#
# Free-running: the simulation sees the first position and the commands, nothing else.

# %%
sent = 0.25 * np.sin(1.3 * t) * np.sign(np.sin(0.4 * t)) + 0.1 * np.sin(2.9 * t)
unseen = jid.Recording.of(
    measured(sent)[:, None], sent[:, None], sample_time=0.02, name="unseen"
)
errors = fit.validate(unseen)
print(errors)

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.2))
left.plot(t, sent, label="commanded")
left.plot(t, unseen.angles[:, 0], label="measured")
left.plot(t, errors.simulated[0][0], "--", label="simulated")
left.set_xlim(8, 16)
left.set_xlabel("time [s]")
left.set_ylabel("angle [rad]")
left.legend()
paths = {"linear": errors.baselines["linear"], "simulated": errors.simulated}
for kind, path in paths.items():
    right.plot(t, 1e3 * (path[0][0] - unseen.angles[:, 0]), label=kind)
right.set_xlabel("time [s]")
right.set_ylabel("error [mrad]")
right.legend()
plt.show()

# %% [markdown]
# After the first half second the error is the rounding of the encoder, 0.44 mrad: every sample counts, also those in which the arm sags from an unknown
# state. A linear joint cannot stick and does not sag.
#
# ## What a log cannot determine
#
# A slow ramp in one direction leaves the joint behind its command by delay and by dry friction, and no one can say which. The fit does not split them
# arbitrarily: it reports the sum that the log determines. Inertia and damping hardly show: the arm never accelerates.

# %%
slow = 0.03 * t
log = jid.Recording.of(
    measured(slow)[:, None], slow[:, None], sample_time=0.02, name="slow"
)
slow_fit = jid.identify_rollout(log, bodies, joint_names=["lift"])
print(slow_fit)

# %% [markdown]
# ## What you learned
#
# * Commands and encoders determine a simulation, in units of the servo's stiffness.
# * A known gravity torque determines the stiffness itself.
# * Parameters that a log determines only in combination are reported in combination.
# * `jid.export.export_servo_mjcf` writes the robot for MuJoCo, with as many draws from the estimates' distribution as you wish.
#
# The guide: [my robot logs no torque](../docs/rollout.md). Next: [a force sensor](11_force_sensor.ipynb).
#
# ## Exercise
#
# Suppose that the weight of the body is unknown: identify the three logs with `bodies=None`. Which row of the table disappears, and which values stay the same?
#
# <details markdown="1"><summary>Answer</summary>
#
# `jid.identify_rollout(logs, joint_names=["lift"])` has no row of `1 / stiffness`, and the stiffness is not determined: no known gravity torque acts on the
# joint any more, and a bias replaces it. The delay stays the same, and so do damping and dry friction, which are ratios to the stiffness. The inertia is then that of
# the rotor and the body together. Errors grow from 0.4 to 2 mrad, since a bias
# is the same at every angle and the gravity torque is not. A remark says that an effect is missing.
#
# </details>
