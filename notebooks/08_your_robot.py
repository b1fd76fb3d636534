# %% [markdown]
# # 08 · Your own robot: from URDF to controller
#
# A URDF file in, feed-forward code for a controller and a better URDF file out. On the way: which motion to record, a log (of a virtual arm that stands in for
# yours), a model that could exist, and the test that matters to a user: how much better the robot follows its path.

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
# ## 1. What is known
#
# `load_urdf` reads joints, limits and geometry, and reports its decisions. The file's inertials are *not* part of the robot: they are estimates of
# unknown parameters, which `urdf_parameters` returns.

# %%
import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

robot = jid.load_urdf("arm.urdf")
print(f"{robot.name}: {', '.join(robot.joint_names)}")
for note in robot.notes:
    print("  note:", note)
base = jid.base_parameters(jid.Model(robot))
print(
    f"{base.model.size} standard parameters, {base.size} base parameters: {', '.join(base.names)}"
)

# %% [markdown]
# ## 2. Which motion
#
# The motion begins and ends at rest, stays within the limits, and is designed for these parameters. `jid.trajectories.write_csv` writes it for the controller.

# %%
limits = jid.Limits(
    3,
    position_min=robot.limits.position_min,
    position_max=robot.limits.position_max,
    velocity=robot.limits.velocity,
    acceleration=[10.0, 10.0, 15.0],
)
plan = jid.design_excitation(
    base,
    limits=limits,
    basis=jid.trajectories.RestToRestBasis(5, 0.8),
    starts=8,
    generations=4,
    key=jax.random.key(2),
)
print(
    f"standard deviations {plan.mean_gain:.2f} times smaller than those of a random motion"
)
time, motion = plan.trajectory.sample(0.01)
jid.plot.joints(robot, limits, time, motion)

# %% [markdown]
# ## 3. The log
#
# A virtual arm stands in for your robot. It is an arm whose bodies are 10 to 25 % off the CAD, with gear friction that sticks, encoders with 17 bits and noisy torques. Its
# servo uses no model. The log ends with the motion: at standstill friction can have any value up to stiction, which
# this model does not describe.

# %%
cad = jid.robots.urdf_parameters("arm.urdf").reshape(3, 10)
rotors = np.array([0.4, 0.5, 0.15])
yours = jid.VirtualRobot(
    robot=robot,
    terms=(jid.RigidBodies(), jid.RotorInertia()),
    values=np.concatenate(
        [(cad * np.array([1.1, 1.25, 0.8])[:, None]).ravel(), rotors]
    ),
    friction=jid.simulation.LuGreFriction(
        viscous=np.array([1.5, 2.0, 0.8]),
        coulomb=np.array([1.2, 1.8, 0.7]),
        breakaway=np.array([1.6, 2.4, 1.0]),
    ),
    sensors=jid.simulation.Sensors(
        encoder_step=2 * np.pi / 2**17,
        white_noise=0.01 * np.asarray(robot.limits.force),
        coloured_noise=np.zeros(3),
    ),
)
run = yours.track(plan.trajectory, seed=1)
log = run.recording
observations = jid.observe(
    log, robot, jid.ZeroPhaseButterworth(12.0), jid.Subsample(25)
)
print(
    f"{log.samples} samples at {1 / log.sample_time:.0f} Hz; the arm missed the motion by up to "
    f"{np.rad2deg(np.abs(run.tracking_error).max()):.2f} degrees"
)

# %% [markdown]
# ## 4. The model
#
# A controller needs physically possible bodies, so we use the physically consistent estimator. Then the questions of [is my fit good?](../docs/is_my_fit_good.md), on a
# motion that is not in the fit.

# %%
fit = jid.identify(base, observations, jid.PhysicallyConsistent())
other = jid.trajectories.random_fourier_series(robot, omega=1.0, seed=5, reach=0.8)
unseen = jid.observe(
    yours.track(other, seed=2).recording,
    robot,
    jid.ZeroPhaseButterworth(12.0),
    jid.Subsample(25),
)
check = jid.validate(fit, [observations, unseen])
print(f"residual {fit.residual:.1%}; unseen motion {check.errors[1].relative:.1%}")
print("mean error [% of the largest torque]:", check.errors[1].mean_percent.round(2))
print(
    "not determined:",
    "; ".join(d.sentence(base) for d in fit.undetermined) or "nothing",
)
print(
    f"mass matrix: smallest eigenvalue {check.definiteness.smallest:.3f} kg m² of {check.definiteness.poses} poses"
)
jid.plot.torques(check.errors[1], robot, title="a motion that the fit has not seen")

# %% [markdown]
# ## 5. What it is for
#
# The same servo follows that motion three times: without a model, with the CAD's bodies, with the identified model fed forward.

# %%
claimed = np.concatenate([cad.ravel(), np.zeros(6), np.zeros(3)])
ways = {
    "no model": None,
    "CAD": lambda m: np.asarray(base.model.inverse_dynamics(claimed, m)),
    "identified": fit.predict,
}
figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), sharex=True)
for name, feed_forward in ways.items():
    followed = yours.track(other, seed=3, feed_forward=feed_forward)
    error = 1e3 * followed.tracking_error
    print(
        f"{name:11} RMS tracking error [mrad]:",
        np.sqrt(np.mean(error**2, axis=0)).round(3),
    )
    for j, axes in enumerate(panels):
        axes.plot(followed.time, error[:, j], label=name, lw=1)
        axes.set_title(robot.joint_names[j])
        axes.set_xlabel("time [s]")
panels[0].set_ylabel("tracking error [mrad]")
panels[0].legend()
plt.show()

# %% [markdown]
# The CAD model helps where gravity is large. Its remaining errors come from friction and from wrong masses; the identified model describes both.
#
# ## 6. To the controller, and back into the URDF
#
# The model is saved; written as C, one file without dependencies; and put into the robot's own URDF, for simulators. If a compiler is at hand, the
# compiled file is compared with the package.

# %%
with tempfile.TemporaryDirectory() as folder:
    fit.save(Path(folder) / "arm.json")
    again = jid.load_fit(Path(folder) / "arm.json")
    print(
        "saved and loaded, bit by bit:",
        np.array_equal(again.parameters, fit.parameters),
    )

    better = jid.export_urdf(fit, "arm.urdf", Path(folder) / "identified.urdf")
    bodies = jid.robots.urdf_parameters(better).reshape(3, 10)
    same = np.allclose(bodies, fit.consistency.bodies, atol=1e-6)
    print("the new URDF file holds the identified bodies:", same)

    source = jid.export_c(fit, Path(folder) / "c")
    print(
        f"{source.name}: {len(source.read_text().splitlines())} lines, with the functions"
    )
    for line in source.with_suffix(".h").read_text().splitlines():
        if line.startswith("void"):
            print("  ", line)
    if shutil.which("cc"):
        library = Path(folder) / "arm.so"
        subprocess.run(
            ["cc", "-O2", "-shared", "-fPIC", source, "-o", library, "-lm"], check=True
        )
        pointer = np.ctypeslib.ndpointer(float, flags="C")
        torque = ctypes.CDLL(str(library))[f"{source.stem}_torque"]
        torque.argtypes = [pointer] * 4
        check_motion = jid.Motion(
            *(np.asarray(x)[::50] for x in (motion.q, motion.qd, motion.qdd))
        )
        torques = np.zeros(check_motion.q.shape)
        for k, Q in enumerate(torques):
            torque(
                check_motion.q[k].copy(),
                check_motion.qd[k].copy(),
                check_motion.qdd[k].copy(),
                Q,
            )
        # `fit.predict` takes axes within 1e-4 rad for parallel, as base parameters do;
        # the code keeps the geometry of the file, as the model does.
        expected_torques = fit.base.model.inverse_dynamics(
            fit.full_parameters, check_motion.q, check_motion.qd, check_motion.qdd
        )
        difference = np.abs(torques - expected_torques).max()
        print(f"compiled code agrees with the package: {difference < 1e-10}")

# %% [markdown]
# ## What you learned
#
# * From a URDF file to a controller in six steps; only the log and the last test need the robot.
# * The masses of the CAD model help, but the identified model, with friction and corrected masses, follows the path best.
# * Masses in the new URDF file are *one* set of possible bodies with the identified forces: data cannot distinguish such sets
#   ([consistency](05_consistency_payload.ipynb)).
# * The same on the command line: `jaxid init`, `excite`, `inspect`, `identify`, `export` ([README](../README.md#the-same-in-the-shell)).
#
# Where to go on: [how to choose](../docs/how_to_choose.md), [is my fit good?](../docs/is_my_fit_good.md). Next: [your own solver](09_solvers.ipynb).
#
# ## Exercise
#
# In the file of the robot, the mass of one link is 30 % too large. Which of these change: the base parameters' expressions, the estimates by `jid.identify` without a prior, the
# estimates by `jaxid identify`?
#
# <details markdown="1"><summary>Answer</summary>
#
# Expressions depend on the geometry alone: no change. `jid.identify` without a prior does not use the masses of the file, since a `Robot` holds none: no change.
# `jaxid identify` takes them as a prior where the log is silent: masses that forces cannot separate move, the forces hardly do.
#
# </details>
