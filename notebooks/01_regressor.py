# %% [markdown]
# # 01 · The regressor and the Projection Equation
#
# The forces $Q_m$ that a robot's drives exert are *linear* in its unknown parameters $p$, however wildly the robot moves:
#
# $$\Theta(q, \dot q, \ddot q)\, p = Q_m .$$
#
# The whole package rests on this equation. This notebook shows where $\Theta$ comes from, what its zeros mean, and how it is checked.

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
# ## What is known and what is not
#
# A `Robot` holds what is known: axes, offsets, limits. It never holds a mass. A `Model` adds what is linear in unknown numbers: bodies (ten parameters
# each: mass, three first moments, six second moments), viscous and Coulomb friction, and rotors felt through the gears.

# %%
robot = jid.robots.tx90l_on_rail()
model = jid.Model(robot)
print(robot.name, "with", robot.joints, "joints:", ", ".join(robot.joint_names))
print(model.size, "standard parameters")
for kind in ("RigidBodies", "ViscousFriction", "CoulombFriction", "RotorInertia"):
    term = next(t for t in model.terms if type(t).__name__ == kind)
    names = [f"{name} [{unit}]" for name, unit in term.parameters(robot)]
    print(f"{kind:16} {len(names):3}: {', '.join(names[:4])}, …")

# %% [markdown]
# ## One free body (Eq. 10)
#
# Take one free body. With $a$ the acceleration of its reference point less gravity, and $\omega, \dot\omega$ its rotation, the force and
# moment on it are $\bar\Theta\, p$: six rows, ten columns. A body at rest in gravity shows its mass (first column, force 9.81 N per kg) and its first
# moments (they cause moments); its moments of inertia have no effect until it rotates.

# %%
at_rest = jid.dynamics.body_regressor(
    a=np.array([0, 0, 9.81]), w=np.zeros(3), wd=np.zeros(3)
)
turning = jid.dynamics.body_regressor(
    a=np.array([0, 0, 9.81]), w=np.array([0, 0, 2.0]), wd=np.array([1.0, 0, 0])
)
print("columns that act at rest:  ", np.flatnonzero(np.any(at_rest != 0, axis=0)))
print("columns that act in motion:", np.flatnonzero(np.any(turning != 0, axis=0)))

# %% [markdown]
# ## All bodies, projected on the joints (Eq. 11)
#
# A joint feels a body only along the directions in which it can move it. The *projection* with the Jacobians $\partial v/\partial \dot q$,
# $\partial\omega/\partial\dot q$ turns six rows per body into one row per joint, and constraint forces between the bodies drop out. Joint $j$
# does not move the bodies before it: their columns are zero in its row. Below is one sample of $\Theta$.

# %%
series = jid.trajectories.random_fourier_series(robot, omega=0.8, seed=1)
t = np.linspace(0.0, series.duration, 400)
motion = series.motion(t)
theta = np.asarray(model.regressor(motion))
print("regressor of", len(t), "samples:", theta.shape)

one = np.abs(theta[100])
figure, axes = plt.subplots(figsize=(11, 2.7))
picture = axes.imshow(
    np.log10(np.where(one > 0, one, np.nan)), aspect="auto", vmin=-3, vmax=1.5
)
axes.set_yticks(range(7), robot.joint_names)
edges = [10 * i for i in range(8)] + [77, 84, 91]
axes.set_xticks(
    [0.5 * (a + b) - 0.5 for a, b in zip(edges, edges[1:])],
    [*(f"body {i}" for i in range(1, 8)), "viscous", "dry", "rotors"],
)
axes.vlines(np.array(edges) - 0.5, -0.5, 6.5, color="white", lw=1.5)
axes.grid(False)
axes.set_title(
    "size of each entry of the regressor at one instant: empty means exactly zero, by structure"
)
figure.colorbar(picture, label="log10 |entry| [SI]")
plt.show()

# %% [markdown]
# ## Three ways to the same forces
#
# With a set of plausible bodies the forces come from $\Theta p$, from inverse dynamics that never forms $\Theta$, and from $M(q)\ddot q + h(q, \dot q)$
# (Eq. 38). They agree to rounding. All of it is compiled from *one* definition.

# %%
masses = [200.0, 45.0, 30.0, 15.0, 20.0, 4.0, 1.5]
ends = [*robot.offset[1:], robot.tip_offset]
bodies = [
    jid.Tool(
        i, mass=m, centre_of_mass=0.5 * end, inertia=0.01 * m * np.eye(3)
    ).parameters
    for i, (m, end) in enumerate(zip(masses, ends))
]
viscous = [250.0, 41.0, 30.0, 16.0, 4.0, 5.0, 2.0]
dry = [310.0, 18.0, 15.0, 9.0, 3.0, 3.0, 1.5]
rotors = [60.0, 5.0, 5.0, 2.0, 0.5, 0.4, 0.2]
p = np.concatenate([*bodies, viscous, dry, rotors])

forces = np.asarray(model.inverse_dynamics(p, motion))
M = np.asarray(model.mass_matrix(p, motion.q))
h = np.asarray(model.bias_forces(p, motion.q, motion.qd))
print("largest force of each joint [N, N m]:", np.abs(forces).max(axis=0))
print("theta p   - inverse dynamics:", np.abs(theta @ p - forces).max())
print(
    "M qdd + h - inverse dynamics:",
    np.abs(np.einsum("nij,nj->ni", M, motion.qdd) + h - forces).max(),
)

# %% [markdown]
# Which effects does a torque consist of? Set parts of the motion or of the parameters to zero to see each of them.

# %%
still = np.zeros_like(motion.q)
frictionless = np.concatenate([*bodies, np.zeros(14), rotors])
gravity = np.asarray(
    model.inverse_dynamics(frictionless, jid.Motion(motion.q, still, still))
)
slow = np.asarray(model.bias_forces(frictionless, motion.q, motion.qd)) - gravity
inertia = np.einsum("nij,nj->ni", M, motion.qdd)
friction = forces - gravity - slow - inertia

figure, panels = plt.subplots(1, 2, figsize=(11, 3.2))
for axes, j in zip(panels, (0, 2)):
    axes.plot(t, forces[:, j], color="#22262b", lw=2.2, label="all")
    for part, label in (
        (gravity, "gravity"),
        (inertia, "inertia"),
        (slow, "centrifugal, Coriolis"),
        (friction, "friction"),
    ):
        axes.plot(t, part[:, j], label=label)
    axes.set_title(robot.joint_names[j])
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"force [{robot.force_unit(j)}]")
panels[1].legend(ncols=2, fontsize=8)
plt.show()

# %% [markdown]
# ## An independent check: power
#
# The power of the drives, minus that of friction, must equal the rate of change of kinetic and potential energy. The energy is computed from $M$ and from
# heights, the forces from $\Theta$: if a sign or a Coriolis term were wrong, the two lines would differ.

# %%
energy = np.asarray(
    model.kinetic_energy(frictionless, motion.q, motion.qd)
) + np.asarray(model.potential_energy(frictionless, motion.q))
fine = np.linspace(0.0, series.duration, 4000)
along = series.motion(fine)
E = np.asarray(model.kinetic_energy(frictionless, along.q, along.qd)) + np.asarray(
    model.potential_energy(frictionless, along.q)
)
power = np.sum(np.asarray(motion.qd) * (forces - friction), axis=1)
figure, axes = plt.subplots(figsize=(11, 2.6))
axes.plot(fine, np.gradient(E, fine), lw=3, color="#9aa6b2", label="rate of the energy")
axes.plot(t, power, lw=1.2, label="power of the drives, without friction's")
axes.set_xlabel("time [s]")
axes.set_ylabel("power [W]")
axes.legend()
plt.show()
print(
    f"largest difference: {np.abs(np.interp(t[2:-2], fine, np.gradient(E, fine)) - power[2:-2]).max():.2g} W "
    f"of {np.abs(power).max():.0f} W"
)

# %% [markdown]
# ## Everything is differentiable
#
# $\Theta$ is a JAX function. How much does the torque change if a link is one millimetre longer? One `jvp` with respect to the *geometry* says it:


# %%
def forces_of(offset):
    """Forces of the same bodies on a robot with other link lengths."""
    return jid.Model(robot.replace(offset=offset)).inverse_dynamics(p, motion[100])


longer = np.zeros((7, 3))
longer[3, 1] = 1e-3
_, change = jax.jvp(forces_of, (robot.offset,), (longer,))
print(
    "one millimetre more between the joints 2 and 3 changes the forces by",
    np.asarray(change),
    "[N, N m]",
)

# %% [markdown]
# ## What you learned
#
# * A `Robot` holds what is known, a `Model` what is unknown. $\Theta$ connects both; it is linear in $p$ for any motion.
# * Row $j$ has zeros for every body that joint $j$ does not move. Estimation here uses that, joint by joint.
# * Inverse dynamics, mass matrix, bias forces and energies are one definition, checked against each other to $10^{-12}$, and differentiable with
#   respect to everything, geometry included.
#
# Which of these 91 parameters can forces determine at all? Next: [base parameters](02_base_parameters.ipynb).
#
# ## Exercise
#
# How many entries of the columns of bodies can be non-zero at all? $\Theta$ has 7 rows, and 70 such columns. Count by hand first; then count with
# `np.count_nonzero(model.regressor(motion[100])[:, :70])`.
#
# <details markdown="1"><summary>Answer</summary>
#
# Row $j$ sees the bodies $j$ to 7: that is 7 + 6 + … + 1 = 28 blocks of ten, so 280 of 490 entries at most. The count is smaller, because some
# entries vanish for a reason of their own: a rail, for instance, feels no moment of inertia of the body that it pushes without turning it.
#
# </details>
