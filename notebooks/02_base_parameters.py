# %% [markdown]
# # 02 · Base parameters and their expressions
#
# The seven-axes manipulator of the paper has 91 standard parameters. Forces determine 57 numbers, which are *combinations* of them. This notebook shows
# which ones, and how they are found.

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
# ## The paper's count (Eq. 24)
#
# The paper keeps seven parameters of each body (without products of inertia). Then forces determine 44 combinations. Each is an expression with one
# symbol for every length of the geometry.

# %%
robot = jid.robots.tx90l_on_rail()
paper = jid.base_parameters(
    jid.Model(
        robot,
        (
            jid.RigidBodies(principal_axes=True),
            jid.ViscousFriction(),
            jid.CoulombFriction(),
            jid.RotorInertia(),
        ),
    )
)
print(f"{paper.model.size} standard parameters, {paper.size} base parameters")
for k in (0, 1, 2, 7, 10, 25):
    print(f"p_B({k + 1:2}) [{paper.units[k]:5}] = {paper.expressions[k]}")

# %% [markdown]
# ## All ten parameters of each body
#
# Products of inertia vanish for principal axes through the *centre of mass*. The model's axes go through the joint's origin, where they do not vanish:
# forces determine thirteen more parameters. This is the default.

# %%
base = jid.base_parameters(jid.Model(robot))
print(f"{base.model.size} standard parameters, {base.size} base parameters")

kinds = {
    "ALONE": 2,
    "COMBINED": 1,
    "NONE": 0,
}
verdict = np.array([kinds[v.name] for v in base.identifiability])
names = ["m", "mx", "my", "mz", "A", "B", "C", "D", "E", "F"]
figure, axes = plt.subplots(figsize=(11, 3.0))
shown = np.vstack([verdict[:70].reshape(7, 10).T])
colours = plt.matplotlib.colors.ListedColormap(["#d5dae0", "#E69F00", "#0072B2"])
picture = axes.pcolormesh(
    shown, cmap=colours, vmin=-0.5, vmax=2.5, edgecolors="white", linewidth=2
)
axes.set_yticks(np.arange(10) + 0.5, names)
axes.set_xticks(
    np.arange(7) + 0.5,
    [f"body {i + 1} ({name})" for i, name in enumerate(robot.joint_names)],
)
axes.invert_yaxis()
axes.grid(False)
axes.set_title("what forces can say about each parameter of each body")
bar = figure.colorbar(picture, ticks=[0, 1, 2])
bar.ax.set_yticklabels(["nothing", "in combination", "alone"])
plt.show()

# %% [markdown]
# Body 1 moves along the rail: only its mass has an effect, and only in combination with all that it carries. Body 2 turns about an upright axis: of its ten
# parameters one moment of inertia and two first moments have an effect. More parameters of the distal bodies can be determined.
#
# ## How the rank is decided
#
# The regressor is evaluated at random motions and stacked. Its columns are scaled to comparable size before anything is compared: a wrist's inertia makes
# small columns, a rail's mass large ones, and a tolerance on the raw matrix would mistake small for dependent. Then two independent methods must
# agree: Gram-Schmidt in column order, and the gap in the singular values.

# %%
rng = np.random.default_rng(0)
motion = jid.Motion(*rng.uniform(-3.0, 3.0, (3, 50, base.model.robot.joints)))
theta = np.asarray(base.model.regressor(motion)).reshape(-1, base.model.size)
sizes = np.linalg.norm(theta, axis=0)
scaled = np.linalg.svd(theta / np.where(sizes > 0, sizes, 1.0), compute_uv=False)
raw = np.linalg.svd(theta, compute_uv=False)
print(f"least independent column: {base.smallest_independent:.2g} of it is new")
print(f"most doubtful dependent column: {base.largest_dependent:.1g}")
print("doubts:", base.notes or "none")

figure, axes = plt.subplots(figsize=(11, 3.0))
for values, label in ((scaled, "columns scaled"), (raw, "as it is, SI units")):
    axes.semilogy(
        np.arange(1, 92), np.maximum(values / values[0], 1e-18), ".", label=label
    )
axes.axvline(base.size + 0.5, color="#5f6b78", ls="--", lw=0.8)
axes.annotate(f"{base.size} base parameters", (base.size - 0.5, 1e-8), ha="right")
axes.set_xlabel("singular value of the stacked regressor")
axes.set_ylabel("relative size")
axes.legend()
plt.show()

# %% [markdown]
# ## The same forces from fewer numbers (Eqs. 21-23)
#
# $p_B = p_1 + \kappa p_2$, and $\hat\Theta_1 p_B = \Theta p$ for *any* motion. The base parameters also determine the mass matrix completely.

# %%
random = np.random.default_rng(0)
p = random.normal(size=base.model.size)
p_B = np.asarray(base.from_standard(p))
motion = jid.trajectories.random_fourier_series(robot, omega=0.8, seed=3).motion(
    np.linspace(0, 7, 50)
)
full = np.asarray(base.model.regressor(motion)) @ p
fewer = np.asarray(base.regressor(motion)) @ p_B
print(
    "largest difference of the forces:",
    np.abs(full - fewer).max(),
    "of",
    np.abs(full).max().round(1),
)
M = np.asarray(base.model.mass_matrix(p, motion.q))
print(
    "of the mass matrix:", np.abs(M - np.asarray(base.mass_matrix(p_B, motion.q))).max()
)

figure, axes = plt.subplots(figsize=(11, 4.2))
kappa = np.abs(np.asarray(base.kappa))
axes.spy(kappa, markersize=4, color="#0072B2")
axes.set_xticks(
    range(len(base.dependent)),
    [base.model.parameter_names[k] for k in base.dependent],
    rotation=90,
    fontsize=7,
)
rows = np.flatnonzero(kappa.any(axis=1))
axes.set_yticks(rows, [base.names[k] for k in rows], fontsize=7)
axes.set_ylim(rows[-1] + 0.7, -0.7)
axes.set_aspect("auto")
axes.set_title(
    "kappa: into which base parameter (row) each dependent parameter (column) goes",
    pad=30,
)
plt.show()

# %% [markdown]
# ## What you learned
#
# * Forces determine combinations, never single masses of proximal bodies; `base.expressions` says which, `base.identifiability` for each parameter.
# * The count is decided in scaled columns and twice; a small gap is reported in `base.notes` ([base parameters](../docs/base_parameters.md)).
# * Base parameters contain everything that the dynamics need: forces and mass matrix follow from them exactly.
#
# Which of them *your* motion reveals is another question. Next: [excitation](03_excitation.ipynb).
#
# ## Exercise
#
# Take gravity away: `robot.replace(gravity=(0.0, 0.0, 0.0))`. Can the number of base parameters grow? Decide first, then count.
#
# <details markdown="1"><summary>Answer</summary>
#
# It cannot. A combination of parameters is invisible if it changes no force in any motion. With gravity it must be invisible in the poses at rest *and* in
# motion; without gravity the second alone is enough. So without gravity at least as many combinations are invisible, and the number stays or falls.
#
# </details>
