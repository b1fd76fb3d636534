# %% [markdown]
# # 11 · A force sensor at the wrist
#
# A six-axis sensor between flange and gripper measures what the load asks for, without friction of the joints in between. One log tells mass, centre and moments of
# the load, the bias of the sensor, and by how many degrees it is mounted otherwise than you think.

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
# ## An arm with a load behind a sensor
#
# MuJoCo, which shares no code with `jaxid`, simulates three joints and the sensor. The load has 1.35 kg; the sensor is turned by 2 degrees about its x axis. MuJoCo
# reports what the arm exerts on the load: at rest the force points up. Most drivers report the opposite.

# %%
import tempfile
from pathlib import Path

import mujoco

XML = """<mujoco><compiler angle="radian"/><worldbody>
<body name="a" pos="0 0 0.3"><joint name="a" axis="0 0 1"/><inertial pos="0 0 0.1" mass="3" diaginertia="0.1 0.1 0.1"/>
<body name="b" pos="0 0 0.2"><joint name="b" axis="0 1 0"/><inertial pos="0 0 0.2" mass="2" diaginertia="0.1 0.1 0.1"/>
<body name="c" pos="0 0 0.4"><joint name="c" axis="1 0 0"/><inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>
<body name="load" pos="0 0 0.1"><inertial pos="0.012 -0.02 0.09" mass="1.35" diaginertia="0.013 0.0125 0.0045"/>
<site name="sensor" euler="0.0349 0 0"/></body></body></body></body></worldbody>
<sensor><force site="sensor"/><torque site="sensor"/></sensor></mujoco>"""
model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)

t = np.arange(0.0, 20.0, 0.005)
w = np.array([0.9, 1.3, 1.7])
phases = np.array([0.0, 1.0, 2.0])
size = np.array([1.2, 1.0, 1.4])
q = size * np.sin(w * t[:, None] + phases)
qd = size * w * np.cos(w * t[:, None] + phases)
qdd = -(w**2) * q
wrench = np.empty((len(t), 6))
for k in range(len(t)):
    data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
    mujoco.mj_inverse(model, data)
    wrench[k] = data.sensordata

random = np.random.default_rng(0)
bias = np.array([3.0, -2.0, 6.0, 0.1, -0.3, 0.05])
noise = [0.3, 0.3, 0.3, 0.01, 0.01, 0.01] * random.normal(size=wrench.shape)
log = jid.Recording.of(q, None, wrench=wrench + bias + noise, time=t, name="loaded")

figure, panels = plt.subplots(1, 2, figsize=(11, 2.6))
for axes, part, unit in zip(panels, (slice(3), slice(3, 6)), ("N", "N m"), strict=True):
    axes.plot(t, log.wrench[:, part], lw=0.7)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"measured [{unit}]")
plt.show()

# %% [markdown]
# ## Load, bias and rotation
#
# `with_sensor` puts six virtual joints behind the end-effector. Their forces are the wrench. Logs of the wrench alone hold nothing of the arm, so the model has the
# load, the bias and the rotation, and nothing else.

# %%
path = Path(tempfile.mkdtemp()) / "arm.xml"
path.write_text(XML)
robot = jid.load_urdf(path, tip="c")
robot = robot.replace(tip_offset=(0.0, 0.0, 0.1)).with_sensor()
terms = jid.terms
effects = (terms.SensorLoad(), terms.SensorBias(), terms.SensorRotation())
base = jid.base_parameters(jid.Model(robot, effects))
observations = jid.observe(
    log, robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10)
)
base = jid.identify_sensor_rotation(base, observations)
fit = jid.identify(base, observations)
payload = jid.identify_payload(None, fit)
print(payload)

# %% [markdown]
# ## What the rotation costs if it is not modelled
#
# Without `SensorRotation` the fit takes the sensor to be mounted as described. The mass hardly changes, but the centre moves.

# %%
plain_base = jid.base_parameters(jid.Model(robot, effects[:2]))
plain = jid.identify_payload(None, jid.identify(plain_base, observations))
centre = np.array([0.012, -0.02, 0.09])
for name, found in (("rotation estimated", payload), ("rotation ignored", plain)):
    print(f"{name}: errors of the centre {1e3 * (found.centre_of_mass - centre)} mm")

figure, axes = plt.subplots(figsize=(11, 2.6))
for name, found in (("rotation estimated", payload), ("rotation ignored", plain)):
    axes.plot(["x", "y", "z"], 1e3 * (found.centre_of_mass - centre), "o", label=name)
axes.set_ylabel("error of the centre [mm]")
axes.legend()
plt.show()

# %% [markdown]
# ## What you learned
#
# * A wrist sensor tells the load from one log, with intervals, and needs no torques.
# * Bias and mounting are unknowns beside the load. Gravity tells both, if the log has many attitudes.
# * `jid.export_c(fit, ...)` writes the wrench of load and bias as C: what is measured beyond it is contact.
#
# Details: [force sensors](../docs/force_sensors.md). Next: [a closed chain](12_closed_chain.ipynb).
#
# ## Exercise
#
# Use only the first 2 s of the log. Which intervals grow most, and why?
#
# <details markdown="1"><summary>Answer</summary>
#
# `jid.observe(log.crop(0, 2), ...)`: those of the bias and of the rotation. In 2 s gravity points along few directions of the sensor, and a constant force can
# then hardly be told from a weight.
#
# </details>
