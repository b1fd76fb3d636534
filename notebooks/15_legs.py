# %% [markdown]
# # 15 · A robot on legs
#
# A quadruped stands on nothing that holds it. Six rows of its equations of motion have no drive, those of its trunk, and they tell all masses. The log needs an IMU and the
# flags of contact, but no contact force. Here a Go2 is simulated with MuJoCo, which shares no code with `jaxid`.

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
# ## The robot
#
# The file is that of the package `example-robot-data` (`pip install example-robot-data`). `floating=True` lets the trunk move; `contacts` names the links of the feet, in the order of the flags, with the radius
# of each ball. Only the geometry of the file is used, no mass.

# %%
import re
import tempfile
from importlib.metadata import distribution
from pathlib import Path

import mujoco

SHARE = "cmeel.prefix/share/example-robot-data/robots/"
data_files = distribution("example-robot-data")
path = data_files.locate_file(SHARE + "go2_description/urdf/go2.urdf")
LEGS = ["FL", "FR", "RL", "RR"]
feet = {f"{leg}_foot": jid.Sphere(0.022) for leg in LEGS}
robot = jid.load_urdf(path, floating=True, imu="imu", contacts=feet)
setup = jid.Setup(robot)
print(setup.base.size, "base parameters of", setup.base.model.size)

# %% [markdown]
# ## A robot and a floor in MuJoCo
#
# Every joint gets a rotor, viscous and dry friction, the same ones on each leg. The sensors are a gyroscope and an accelerometer at the IMU, and a switch in each foot.

# %%
ROTOR, VISCOUS, DRY = 0.012, 0.15, 0.2
text = re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", Path(path).read_text())
spec = mujoco.MjSpec.from_string(text)
spec.compiler.fusestatic = False
spec.option.timestep = 0.001
spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
spec.option.impratio = 10
spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], condim=4)
spec.body("base").add_freejoint()
spec.body("imu").add_site(name="imu")
SENSORS = mujoco.mjtSensor
SITE = {"objtype": mujoco.mjtObj.mjOBJ_SITE}
spec.add_sensor(type=SENSORS.mjSENS_GYRO, objname="imu", **SITE)
spec.add_sensor(type=SENSORS.mjSENS_ACCELEROMETER, objname="imu", **SITE)
for foot in feet:
    spec.body(foot).add_geom(size=[0.022, 0, 0], mass=0, condim=4)
    spec.body(foot).add_site(name=foot, size=[0.03, 0, 0])
    spec.add_sensor(type=SENSORS.mjSENS_TOUCH, objname=foot, **SITE)
names = [f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf")]
for name in names:
    motor = spec.add_actuator(name=name, target=name)
    motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
model = spec.compile()
model.dof_armature[6:] = ROTOR
model.dof_damping[6:] = VISCOUS
model.dof_frictionloss[6:] = DRY

# %% [markdown]
# ## A motion that lifts each foot
#
# For the first 4 s all feet stand and the trunk moves. Then the trunk leans away from one foot after another, and the leg that is lifted moves in the air for two seconds. A
# controller of the joint angles follows these references. The torques of the log are those of the motors. `None` in place of a leg lifts none.

# %%
PHASE = 4.0  # time for each leg [s]
STAND = np.tile([0.0, 0.8, -1.6], 4)
FOLD = np.array([0.0, 0.35, -0.7])
SWAY = np.array([0.01, 0.01, 0.012, 0.06, 0.06, 0.08])
sites = [model.site(foot).id for foot in feet]


def smooth_step(t, start, stop):
    """Return a step from 0 to 1 without a jump of the velocity."""
    x = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def feet_of(data):
    """Return the places of the feet."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data.site_xpos[sites].copy()


def simulate(seed, lifted_legs, motion=None):
    """Return angles, torques, gyroscope, accelerometer and flags of a motion."""
    random = np.random.default_rng(seed)
    sway_rates, sway_phases = random.uniform(
        [[[0.2]], [[0]]], [[[1.6]], [[6]]], (2, 6, 4)
    )
    leg_rates, leg_phases = random.uniform(
        [[[0.5]], [[0]]], [[[2.5]], [[6]]], (2, 12, 4)
    )
    data, reference = mujoco.MjData(model), mujoco.MjData(model)
    count, planned = int(1000 * PHASE * (1 + len(lifted_legs))), [STAND]
    if motion is not None:
        count = int(1000 * motion.duration)
        planned = np.asarray(motion.motion(0.001 * np.arange(count)).q)
    data.qpos[7:] = reference.qpos[7:] = planned[0]
    stand = feet_of(data)
    data.qpos[2] = 0.022 - stand[0, 2]
    angles, samples = STAND, []

    def follow(t):
        """Return the reference of the angles."""
        phase, t_phase = int(t // PHASE), t % PHASE
        leg = lifted_legs[phase - 1] if phase else None
        sway = np.sin(2 * np.pi * sway_rates * t + sway_phases).sum(1) / 1.5
        sway *= SWAY * smooth_step(t, 0, 2)
        if leg is not None:
            lean = smooth_step(t_phase, 0, 0.8) - smooth_step(t_phase, 3.2, 4)
            sway = (1 - 0.7 * lean) * sway
            sway[:2] -= lean * np.sign(stand[leg, :2]) * [0.065, 0.055]
        reference.qpos[:3] = sway[:3]
        mujoco.mju_euler2Quat(reference.qpos[3:7], sway[3:], "XYZ")
        for _ in range(2):
            errors = stand - feet_of(reference)
            for k, site in enumerate(sites):
                J = np.zeros((3, model.nv))
                mujoco.mj_jacSite(model, reference, J, None, site)
                step = np.linalg.lstsq(J[:, 6 + 3 * k :][:, :3], errors[k], rcond=1e-3)
                reference.qpos[7 + 3 * k :][:3] += step[0]
        angles = reference.qpos[7:].copy()
        if leg is not None:
            lift = smooth_step(t_phase, 0.8, 1.1) - smooth_step(t_phase, 2.9, 3.2)
            swing = np.sin(2 * np.pi * leg_rates * t + leg_phases).sum(1) / 2
            joints = slice(3 * leg, 3 * leg + 3)
            angles[joints] += lift * (FOLD + 0.22 * swing[joints])
        return angles

    for k in range(count):
        if k % 5 == 0:
            angles = follow(0.001 * k) if motion is None else planned[k]
        torques = 120.0 * (angles - data.qpos[7:]) - 2.5 * data.qvel[6:]
        data.ctrl[:] = np.clip(torques, -40.0, 40.0)
        q = data.qpos[7:].copy()
        mujoco.mj_step(model, data)
        # Sensors are those at the begin of the step.
        if k % 4 == 0:
            flags = data.sensordata[6:] > 2.0
            samples.append(np.r_[q, data.ctrl, data.sensordata[:6], flags])
    return np.array(samples)


NOISE = np.repeat([2e-4, 0.1, 0.01, 0.1, 0.0], [12, 12, 3, 3, 4])
KEYS = {"q": 12, "tau": 12, "gyro": 3, "acc": 3, "contact": 4}
HEADER = ",".join(f"{key}{k + 1}" for key, n in KEYS.items() for k in range(n))
folder = Path(tempfile.mkdtemp())


def record(seed, lifted_legs, name, motion=None):
    """Write a log with noise as a file, and return its place."""
    samples = simulate(seed, lifted_legs, motion)
    samples = samples + NOISE * np.random.default_rng(seed).normal(size=samples.shape)
    np.savetxt(folder / name, samples, delimiter=",", header=HEADER, comments="")
    return folder / name


log = record(1, [0, 1, 2, 3], "steps.csv")
other = record(2, [3, 1], "other.csv")

# %%
samples = np.loadtxt(log, delimiter=",", skiprows=1)
t = 0.004 * np.arange(len(samples))
figure, (upper, lower) = plt.subplots(
    2, 1, figsize=(11, 3.8), sharex=True, height_ratios=[1, 3]
)
for k, leg in enumerate(LEGS):
    upper.fill_between(
        t, 3.1 - k, 3.9 - k, where=samples[:, 30 + k] > 0.5, color=f"C{k}"
    )
    lower.plot(t, samples[:, 14 + 3 * k], color=f"C{k}", lw=0.7, label=leg)
upper.set_yticks([3.5, 2.5, 1.5, 0.5], LEGS)
upper.set_title("stands")
lower.set_ylabel("torque of the knee [N m]")
lower.set_xlabel("time [s]")
lower.legend(ncols=4)
plt.show()

# %% [markdown]
# ## Identify
#
# Settings are the defaults. Another log, with another motion, is predicted. The torque errors of a row of the trunk are relative to a small force, except those of `base fz`:
# that is the row of the weight.

# %%
columns = jid.Columns(
    angles="q{}",
    forces="tau{}",
    gyro="gyro{}",
    accelerometer="acc{}",
    contact="contact{}",
    sample_time=0.004,
)
report = jid.identify_logs(setup, [log], columns, verify=[other])
print(report)

# %% [markdown]
# The masses of single bodies are no base parameters, but that of all bodies together is a combination of them.

# %%
base, fit = setup.base, report.fit
all_masses = np.zeros(base.model.size)
all_masses[: 10 * len(robot.solid_bodies) : 10] = 1.0
all_masses = all_masses[np.array(base.indices)]


def total_mass(fit):
    """Return the mass of all bodies, and half of its 95 % interval [kg]."""
    variance = all_masses @ fit.uncertainty.covariance @ all_masses
    return all_masses @ fit.parameters, 2.0 * np.sqrt(variance)


print("total mass: {:.3f} ± {:.3f} kg".format(*total_mass(fit)))
print(f"in MuJoCo:  {mujoco.mj_getTotalmass(model):.3f} kg")

# %% [markdown]
# ## Are the four legs alike?
#
# They usually are, so that a drive which differs is worth a look. The report compares them, and here they are with their intervals. Grey lines are the truth.

# %%
half_widths = fit.uncertainty.half_widths()
DRIVES = {
    "fv": ("viscous friction [N m s/rad]", VISCOUS),
    "fc": ("dry friction [N m]", DRY),
    "Ia": ("rotor [kg m²]", ROTOR),
}
figure, panels = plt.subplots(1, 3, figsize=(11, 3))
for panel, (symbol, (label, truth)) in zip(panels, DRIVES.items(), strict=True):
    panel.axhline(truth, color="0.5")
    for k, leg in enumerate(LEGS):
        places = [base.names.index(f"{symbol}{3 * k + j}") for j in (1, 2, 3)]
        joints = np.arange(3) + 0.12 * (k - 1.5)
        values, widths = fit.parameters[np.array(places)], half_widths[places]
        panel.errorbar(joints, values, widths, fmt="o", ms=4, color=f"C{k}", label=leg)
    panel.set_xticks(range(3), ["hip", "thigh", "calf"])
    panel.set_ylabel(label)
panels[0].legend(ncols=2)
plt.show()

# %% [markdown]
# ## What a lifted leg tells
#
# A foot that stands carries an unknown force, and the torques of its leg are used up to find it. A mass at this foot does not move, and the ground carries it: nothing in the log
# tells it. Here is a log of the same length in which all feet stand.

# %%
standing = record(1, [None] * 4, "standing.csv")
stance = jid.identify_logs(setup, [standing], columns, verify=[other])
print(*(x.text for x in stance.judgement.faults), sep="\n\n", end="\n\n")

numbers = [int(re.findall("[0-9]+", name)[-1]) for name in base.names]
parts = (np.array(numbers) + 2) // 3  # 0 is the trunk
for name, result in (("each foot lifted", fit), ("all feet stand", stance.fit)):
    is_trusted = np.array([status.name == "GOOD" for status in result.trust])
    counts = [f"{is_trusted[parts == k].sum()}/{sum(parts == k)}" for k in range(5)]
    print(
        f"{name:16}",
        *counts,
        "total mass {:.2f} ± {:.2f} kg".format(*total_mass(result)),
    )

# %% [markdown]
# Each fraction is the number of base parameters that can be trusted, first of the trunk and then of each leg.
#
# ## A designed motion
#
# `jaxid excite` designs the motion from nominal parameters, here the masses of the file: the trunk moves on all feet, then one foot after another is lifted. It keeps the
# zero-moment point inside the feet that stand. Random motions of each phase are changed as long as they determine the parameters better.

# %%
bodies = np.asarray(jid.robots.urdf_parameters(path, floating=True))
nominal = np.zeros(base.model.size)
nominal[: len(bodies)] = bodies
standing = jid.excitation.Standing(base.from_standard(nominal), force_margin=0.3)
plan = jid.design_excitation(
    base, standing=standing, harmonics=20, omega=0.8, starts=20, generations=3
)
motion = plan.trajectory
print(*plan.findings[:3], *plan.remarks, sep="\n")

# %%
t = np.arange(0, float(motion.duration), 0.01)
figure, (upper, lower) = plt.subplots(
    2, 1, figsize=(11, 3.8), sharex=True, height_ratios=[1, 3]
)
for k, leg in enumerate(LEGS):
    upper.fill_between(t, 3.1 - k, 3.9 - k, where=motion.stands(t)[:, k], color=f"C{k}")
    lower.plot(t, motion.motion(t).q[:, 3 * k + 2], color=f"C{k}", lw=0.7, label=leg)
upper.set_yticks([3.5, 2.5, 1.5, 0.5], LEGS)
upper.set_title("planned to stand")
lower.set_ylabel("knee [rad]")
lower.set_xlabel("time [s]")
lower.legend(ncols=4)
plt.show()

# %% [markdown]
# Played by the same controllers, it makes the intervals smaller than the motion made by hand. It takes twice as long, which alone makes them 1.4 times smaller.

# %%
designed = record(1, [], "designed.csv", motion)
better = jid.identify_logs(setup, [designed], columns, verify=[other]).fit
print("total mass: {:.3f} ± {:.3f} kg".format(*total_mass(better)))
ratios = fit.uncertainty.half_widths() / better.uncertainty.half_widths()
print(f"intervals, by hand over designed: {np.exp(np.log(ratios).mean()):.2f} (mean)")

# %% [markdown]
# ## What you learned
#
# * Gyroscope, accelerometer and flags of contact replace the force sensors of a fixed base: no contact force, attitude or velocity is needed.
# * Move the trunk while all feet stand, and lift one foot after another.
# * The report says whether the drives of the legs agree.
# * `jaxid excite` designs such a motion, with limits and balance.
#
# The guide: [robots on legs](../docs/floating_base.md).
#
# ## Exercise
#
# Lift the front legs only: `record(1, [0, 1, None, None], "front.csv")`. Of which legs can the estimates be trusted, and what happened to the total mass?
#
# <details markdown="1"><summary>Answer</summary>
#
# Of the front legs most can be trusted, of the rear legs less than half. The total mass is as open as before: a mass at one foot that always stands is enough.
#
# </details>
