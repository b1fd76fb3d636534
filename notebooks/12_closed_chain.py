# %% [markdown]
# # 12 · A closed chain
#
# A five-bar has four moving bars and two motors: the tips of two arms are pinned together, and two joints have no motor. Its logs hold two angles and two torques. Here it is
# simulated with MuJoCo, which shares no code with `jaxid`, and identified from these logs alone.

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
# ## The mechanism
#
# The loop is cut at the pin, and a `connect` holds the two points together. Joints with an actuator are the motors. The keyframe is a pose in which the loop closes.

# %%
import tempfile
from pathlib import Path

import mujoco

BAR = '<inertial pos="{} 0 .01" mass="{}" diaginertia=".002 {} {}"/>'
XML = """<mujoco model="five-bar"><compiler angle="radian"/><worldbody>
<body name="a1" pos="-.1 0 0"><joint name="a1" axis="0 -1 0" damping="1" range="1 3"/>{a1}
 <body name="a2" pos=".25 0 0"><joint name="a2" axis="0 -1 0"/>{a2}<site name="ea" pos=".3 0 0"/></body></body>
<body name="b1" pos=".1 0 0"><joint name="b1" axis="0 -1 0" damping="1" range="0 2"/>{b1}
 <body name="b2" pos=".25 0 0"><joint name="b2" axis="0 -1 0"/>{b2}<site name="eb" pos=".3 0 0"/></body></body>
</worldbody><equality><connect name="pin" site1="ea" site2="eb"/></equality>
<actuator><motor joint="a1" ctrlrange="-30 30"/><motor joint="b1" ctrlrange="-30 30"/></actuator>
<keyframe><key qpos="2.2 -1.634 0.9 1.651"/></keyframe></mujoco>"""
BARS = {"a1": 1.0, "a2": 0.8, "b1": 1.1, "b2": 0.7}
XML = XML.format(
    **{k: BAR.format(0.13, m, 0.01 * m, 0.01 * m) for k, m in BARS.items()}
)
path = Path(tempfile.mkdtemp()) / "five_bar.xml"
path.write_text(XML)
robot = jid.load_mjcf(path)
print(robot.joint_names, "move", robot.body_names)

# %% [markdown]
# `close` gives the coordinates of all joints from those of the motors. The branch is that of the keyframe: the elbows do not flip.

# %%
motors = np.array([2.2, 0.9]) + 0.2 * np.linspace(-1, 1, 5)[:, None] * np.array([1, -1])
print(robot.close(motors))


def corners(q):
    """Return the corners of both arms in the plane of the mechanism."""
    arms = []
    for x, (first, second) in ((-0.1, q[[0, 2]]), (0.1, q[[1, 3]])):
        angles = np.array([first, first + second])
        steps = np.array([0.25, 0.3])[:, None] * np.c_[np.cos(angles), np.sin(angles)]
        arms.append(np.array([x, 0.0]) + np.r_[np.zeros((1, 2)), np.cumsum(steps, 0)])
    return arms


figure, axes = plt.subplots(figsize=(5, 3.4))
for k, q in enumerate(robot.close(motors)):
    for arm in corners(q):
        axes.plot(*arm.T, "o-", color=f"C{k}")
axes.set_aspect("equal")
axes.set_xlabel("x [m]")
axes.set_ylabel("z [m]")
plt.show()

# %% [markdown]
# ## What can be identified
#
# The four bars have 40 inertial parameters, of which two motors feel 11 combinations. The open tree has 12: the loop adds a relation.

# %%
terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
base = jid.base_parameters(jid.Model(robot, terms))
print(base)

# %% [markdown]
# ## A log
#
# The motors follow a motion, and MuJoCo computes the torques: inverse dynamics of the tree without the pin, projected on the motors by MuJoCo's own Jacobians.

# %%
tree = mujoco.MjModel.from_xml_string(
    XML.replace("<connect", "<connect active='false'")
)
data = mujoco.MjData(tree)
order = [robot.body_names.index(tree.joint(k).name) for k in range(4)]
MOTORS, OTHERS = [0, 2], [1, 3]


def pin_jacobian(jacobian_of):
    """Return the difference of the Jacobians of both points in the plane."""
    a, b = np.zeros((2, 3, 4))
    jacobian_of(a, "ea")
    jacobian_of(b, "eb")
    return (b - a)[[0, 2]]


def torques(q, qd, qdd):
    """Return MuJoCo's torques of the motors at one sample."""
    data.qpos[:], data.qvel[:] = q, 0.0
    mujoco.mj_forward(tree, data)
    J = pin_jacobian(
        lambda x, site: mujoco.mj_jacSite(tree, data, x, None, tree.site(site).id)
    )
    ratios = np.zeros((4, 2))
    ratios[MOTORS] = np.eye(2)
    ratios[OTHERS] = -np.linalg.solve(J[:, OTHERS], J[:, MOTORS])
    data.qvel[:] = ratios @ qd
    mujoco.mj_forward(tree, data)
    rate = pin_jacobian(
        lambda x, site: mujoco.mj_jacDot(
            tree,
            data,
            x,
            None,
            data.site(site).xpos,
            tree.site_bodyid[tree.site(site).id],
        )
    )
    data.qacc[:] = ratios @ qdd
    data.qacc[OTHERS] -= np.linalg.solve(J[:, OTHERS], rate @ data.qvel)
    mujoco.mj_inverse(tree, data)
    return ratios.T @ data.qfrc_inverse


t = np.arange(0.0, 20.0, 0.005)


def record(seed, name):
    """Return a log of both motors, with noise of 0.1 N m."""
    random = np.random.default_rng(seed)
    w = 2 * np.pi * np.arange(1, 6) / 5.0
    a, b = 0.06 * random.normal(size=(2, 2, 5)) / np.arange(1, 6)
    phase = w * t[:, None, None]
    y = np.array([2.2, 0.9]) + (a * np.sin(phase) + b * (np.cos(phase) - 1)).sum(2)
    yd = (w * (a * np.cos(phase) - b * np.sin(phase))).sum(2)
    ydd = (-(w**2) * (a * np.sin(phase) + b * np.cos(phase))).sum(2)
    samples = zip(robot.close(y)[:, order], yd, ydd, strict=True)
    forces = np.array([torques(*sample) for sample in samples])
    forces += 0.5 * np.tanh(yd / 0.01) + random.normal(0.0, 0.1, forces.shape)
    return jid.Recording.of(y, forces, sample_time=0.005, name=name)


log, unseen = record(1, "log"), record(2, "unseen")

# %% [markdown]
# ## Identify, and predict another motion

# %%
smooth = jid.ZeroPhaseButterworth(15.0)
fit = jid.identify(base, jid.observe(log, robot, smooth, jid.Subsample(4)))
truth = jid.robots.urdf_parameters(path)
truth = base.from_standard(np.r_[truth, 1.0, 1.0, 0.5, 0.5])
low, high = np.asarray(fit.intervals()).T
print(
    f"{np.sum((low < truth) & (truth < high))} of {base.size} intervals hold the truth"
)

seen = jid.observe(unseen, robot, smooth, jid.Subsample(4))
predicted = fit.predict(seen.reduced_motion)
measured = seen.reduced_forces
error = np.sqrt(np.mean((predicted - measured) ** 2) / np.mean(measured**2))
print(f"torque error on another motion: {100 * error:.2f} %")

figure, panels = plt.subplots(1, 2, figsize=(11, 2.8))
for j, axes in enumerate(panels):
    axes.plot(seen.reduced_time, measured[:, j], label="measured")
    axes.plot(seen.reduced_time, predicted[:, j], "--", label="predicted")
    axes.set_title(robot.joint_names[j])
    axes.set_xlabel("time [s]")
    axes.set_xlim(2, 8)
panels[0].set_ylabel("torque [N m]")
panels[0].legend()
plt.show()

# %% [markdown]
# ## What you learned
#
# * A closed chain is described in the coordinates of its motors: logs need no angle and no torque of the other joints.
# * `robot.close(y)` gives the coordinates of all joints, on the branch of the file's pose.
# * Base parameters, intervals and predictions work as for any other robot.
#
# Next: [the true geometry](13_calibration.ipynb).
#
# ## Exercise
#
# Give `b1` a range in which the arms become straight, and look at what `robot.close` says.
