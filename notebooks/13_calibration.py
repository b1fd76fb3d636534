# %% [markdown]
# # 13 · The true geometry of an arm
#
# The lengths and joint zeros of a robot differ from its file by millimetres and milliradians, and gravity bends its joints. A tracker that measures a point of the tool in
# some poses tells the difference. The arm here is a Panda whose geometry is drawn at random, in plain NumPy; the tracker stands at another place in each session.

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
# ## An arm that is not nominal
#
# Each joint's origin is shifted by about 0.5 mm and turned by about 2 mrad, along its own axes.

# %%
from scipy.spatial.transform import Rotation

robot = jid.robots.panda()
rng = np.random.default_rng(0)
shifts = 0.5e-3 * rng.normal(size=(7, 3))
turns = 2e-3 * rng.normal(size=(7, 3))
tool = np.array([0.05, 0.0, 0.1])


def tool_point(q):
    """Return where the true arm puts the tool, in the frame of its base [m]."""
    R, r = Rotation.identity(), np.zeros(3)
    for j in range(7):
        r = r + R.apply(robot.offset[j] + robot.rotation[j] @ shifts[j])
        R = R * Rotation.from_matrix(robot.rotation[j]) * Rotation.from_rotvec(turns[j])
        R = R * Rotation.from_rotvec(q[j] * robot.axis[j])
    return r + R.apply(robot.tip_offset + robot.tip_rotation @ tool)


# %% [markdown]
# ## Four sessions of a tracker
#
# A *session* is what is set up once: here one place of the tracker, 25 random poses, 0.05 mm of noise.

# %%
low, high = robot.limits.position_min, robot.limits.position_max
observations = []
for day in ("monday", "tuesday", "wednesday", "thursday"):
    q = low + rng.uniform(0.1, 0.9, (25, 7)) * (high - low)
    tracker = Rotation.random(random_state=rng)
    positions = tracker.apply([tool_point(x) for x in q]) + rng.normal(size=3)
    positions = positions + 5e-5 * rng.normal(size=positions.shape)
    observations.append(jid.calibration.MeasuredPosition(day, q, positions=positions))

# %% [markdown]
# ## Calibrate
#
# Errors are those of **sessions that were held out**, each in turn: the calibration has not seen them. Joints do not bend here, so that no masses are needed.

# %%
fit = jid.calibrate(robot, observations, compliance=False)
fit

# %% [markdown]
# Some corrections move the tool alike in all poses, such as a shift of joint 3 along its axis and one of joint 4: the poses tell only combinations, which the
# first column names after one of their members. The intervals take the session as the unit. Do they hold the truth?

# %%
truth = np.zeros(len(fit.corrections))
truth[:42] = np.concatenate([shifts, turns], axis=1).ravel()
truth[-6:-3] = tool
combinations = fit.combinations
errors = combinations.of(fit.values - truth)
half_widths = fit.uncertainty.half_widths()
inside = np.abs(errors) <= half_widths
print(f"{inside.sum()} of {len(inside)} intervals contain the truth")

# %%
lengths = np.array([fit.corrections[k].unit == "m" for k in combinations.leaders])
figure, panels = plt.subplots(1, 2, figsize=(10, 3.2))
for panel, rows, unit in ((panels[0], lengths, "mm"), (panels[1], ~lengths, "mrad")):
    numbers = np.arange(rows.sum())
    panel.errorbar(numbers, 1e3 * errors[rows], 1e3 * half_widths[rows], fmt="o")
    panel.axhline(0.0, color="0.5")
    panel.set(xlabel="combination", ylabel=f"error [{unit}]")

# %% [markdown]
# ## How far is the tool from where the file says?
#
# Every pose before and after, held out.

# %%
before, after = (
    1e3 * x.lengths for x in (fit.held_out.nominal, fit.held_out.calibrated)
)
figure, panel = plt.subplots(figsize=(10, 2.6))
panel.semilogy(before, "o", color="0.6", label="nominal")
panel.semilogy(after, "o", label="calibrated")
panel.set(xlabel="pose", ylabel="error [mm]")
panel.legend()
print(f"mean error {before.mean():.2f} mm -> {after.mean():.3f} mm")

# %% [markdown]
# ## What you learned
#
# * Poses in several sessions tell joint origins and zeros; `fit.robot` is the robot with them, `jid.export.export_origins` writes its file.
# * Errors count on sessions that were held out, and intervals take the session as the unit: poses of one session share the errors of its setup.
# * Poses determine combinations. Table and page name what they cannot tell.
#
# The guide: [kinematic calibration](../docs/calibration.md), with balls in sockets, cameras and planes, and which poses to record next.
#
# Next: [which method, on which robot](14_table.ipynb).
#
# ## Exercise
#
# Calibrate with the first two sessions only. Why do the intervals become so wide?
#
# <details markdown="1"><summary>Answer</summary>
#
# `jid.calibrate(robot, observations[:2], compliance=False)`: two sessions leave one degree of freedom, for which the factor of a 95 % interval is 12.7 instead of
# 3.2 with four sessions. With less than three sessions none can be held out, which the verdict says.
#
# </details>
