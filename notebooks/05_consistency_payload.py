# %% [markdown]
# # 05 · Physical consistency and payload
#
# Least squares ignore that masses are positive. This notebook shows a good fit that is *physically impossible*, how physical bounds help, what data cannot
# determine, and how the ten parameters of a payload are identified.

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
# ## A virtual arm and a short, noisy log
#
# The truth: bodies of known mass along the links of a Panda. The log: eight seconds of a random motion, noise of 5 % of the largest torques.

# %%
robot = jid.robots.panda()
terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
base = jid.base_parameters(jid.Model(robot, terms))
largest = np.asarray(robot.max_forces)

masses = np.array([3.4, 2.9, 2.9, 2.5, 1.9, 1.5, 0.6])
ends = [*robot.offset[1:], robot.tip_offset]
bodies = np.array(
    [
        jid.Tool(
            i,
            mass=m,
            centre_of_mass=0.5 * end + 0.02,
            inertia=m
            * (
                np.dot(end, end) / 12 * np.eye(3)
                - np.outer(end, end) / 12
                + 0.003 * np.eye(3)
            ),
        ).parameters
        for i, (m, end) in enumerate(zip(masses, ends))
    ]
)
truth = np.concatenate([bodies.ravel(), 0.02 * largest, 0.03 * largest])


def observations(p, seed, noise=0.05, duration=8.0):
    """A log of a random motion of the arm with the parameters p."""
    t = np.arange(0.0, duration, 0.004)
    motion = jid.trajectories.random_fourier_series(
        robot, omega=2 * np.pi / 8.0, seed=seed
    ).motion(t)
    forces = np.asarray(base.model.inverse_dynamics(p, motion))
    forces = forces + noise * largest * np.random.default_rng(seed).normal(
        size=forces.shape
    )
    log = jid.Recording.of(motion.q, forces, time=t, name=f"log {seed}")
    return jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10))


short = observations(truth, seed=4)
other = observations(truth, seed=7)

# %% [markdown]
# ## A good fit that is physically impossible
#
# Three estimators on the same log. Important for a simulation or a controller is the smallest eigenvalue of the mass matrix over the whole workspace.

# %%
fits = {
    "least squares": jid.identify(base, short, jid.estimators.LeastSquares()),
    "weighted": jid.identify(base, short),
    "consistent": jid.identify(base, short, jid.PhysicallyConsistent()),
}
poses = np.random.default_rng(0).uniform(
    robot.limits.position_min, robot.limits.position_max, (1000, 7)
)
figure, axes = plt.subplots(figsize=(11, 3.0))
edges = np.linspace(-0.06, 0.06, 80)
for name, fit in fits.items():
    least = np.linalg.eigvalsh(np.asarray(base.mass_matrix(fit.parameters, poses)))[
        :, 0
    ]
    check = jid.validate(fit, other)
    axes.hist(
        np.clip(least, -0.06, 0.06),
        edges,
        histtype="stepfilled",
        alpha=0.45,
        label=name,
    )
    print(
        f"{name:14} residual {fit.residual:.2%}, unseen motion {check.errors[0].relative:.2%}, "
        f"M not positive definite in {check.definiteness.indefinite:.0%} of the poses"
    )
exact = np.linalg.eigvalsh(np.asarray(base.model.mass_matrix(truth, poses)))[:, 0]
axes.hist(exact, edges, histtype="step", color="#22262b", lw=1.4, label="truth")
axes.axvline(0.0, color="#D55E00", lw=1)
axes.set_xlabel("smallest eigenvalue of the mass matrix [kg m²]")
axes.set_ylabel("poses of 1000")
axes.legend(ncols=4)
plt.show()

# %% [markdown]
# A negative eigenvalue means that some joint, pushed, accelerates *backwards*: a simulation explodes. The residual of the consistent fit is hardly larger, and
# this cannot happen, because each of its bodies is a distribution of positive mass: its pseudo-inertia is positive semidefinite.

# %%
consistent = fits["consistent"].consistency
print(f"the weighted residual grows by {consistent.residual_increase:.2%}")
print(
    f"within {consistent.error_bound:.0e} of the optimum, {consistent.iterations} iterations"
)
print("active bounds:", "; ".join(consistent.active) or "none")
print(
    "masses that reflect bounds, not data:",
    [f"m{k + 1}" for k in consistent.masses_from_bounds],
)

# %% [markdown]
# ## What the data cannot determine
#
# The masses of the first bodies have no effect of their own on the forces. Bounds only limit them; other knowledge, from a CAD model or a scale, can
# fill the gap: an *entropic pull* towards nominal bodies, and the total mass.

# %%
cad = bodies * np.random.default_rng(5).uniform(0.8, 1.2, (7, 1))
bounds = jid.consistency.BodyBounds.from_geometry(robot).replace(
    total_mass=float(masses.sum())
)
pulled = jid.identify(
    base,
    short,
    jid.PhysicallyConsistent(
        bounds=bounds, pull=jid.consistency.EntropicPull(cad, strength=1.0)
    ),
)
figure, panels = plt.subplots(1, 2, figsize=(11, 3.2))
place = np.arange(7)
ways = {
    "truth": bodies,
    "bounds alone": consistent.bodies,
    "with CAD and a scale": pulled.consistency.bodies,
}
for k, (name, some) in enumerate(ways.items()):
    colour = "#9aa6b2" if k == 0 else None
    panels[0].bar(place + 0.27 * (k - 1), some[:, 0], 0.25, color=colour, label=name)
panels[0].set_xticks(place, [f"m{k + 1}" for k in place])
panels[0].set_ylabel("mass [kg]")
panels[0].legend()
panels[0].set_title("masses: data say little")
exact_base = np.asarray(base.from_standard(truth))
sizes = fits["weighted"].standard_deviations
for name, fit in (
    ("weighted", fits["weighted"]),
    ("bounds alone", fits["consistent"]),
    ("with CAD and a scale", pulled),
):
    error = np.sort(np.abs(np.asarray(fit.parameters) - exact_base) / sizes)
    panels[1].plot(error, np.linspace(0, 1, len(error)), label=name)
panels[1].set_xlabel("error of the base parameters [standard deviations]")
panels[1].set_ylabel("fraction of the parameters")
panels[1].set_title("base parameters: data say much")
panels[1].legend()
plt.show()

# %% [markdown]
# ## A payload
#
# The arm now carries a tool of 2 kg. One log without it and one with it, fitted together, determine all ten parameters of the *tool*, although those
# of the link that carries it stay unknown: only the difference counts. Friction may have changed meanwhile (here by 20 %).
# Of ten intervals of 95 % one may well miss.

# %%
tool = jid.Tool(
    6,
    mass=2.0,
    centre_of_mass=(0.02, -0.03, 0.16),
    inertia=np.diag([0.012, 0.011, 0.006]),
)
loaded = truth.copy()
loaded[60:70] += tool.parameters
loaded[70:] *= 1.2
empty_fit, loaded_fit = (
    jid.identify(base, [observations(p, seed, noise=0.01) for seed in seeds], name=name)
    for p, seeds, name in ((truth, (11, 12), "empty"), (loaded, (13, 14), "loaded"))
)
payload = jid.identify_payload(empty_fit, loaded_fit)
print(payload)
values, uncertainty = payload.central
half = uncertainty.half_widths(0.95)
names, units = (column.values for column in payload.summary().columns[::3])
exact = [2.0, 0.02, -0.03, 0.16, 0.012, 0.011, 0.006, 0.0, 0.0, 0.0]
figure, axes = plt.subplots(figsize=(11, 2.8))
axes.axhspan(-1, 1, color="#d5dae0", lw=0)
axes.plot(np.arange(10), (values - exact) / half, "o")
axes.set_xticks(range(10), [f"{n}\n{u}" for n, u in zip(names, units)])
axes.set_ylabel("error / half of the 95 % interval")
axes.set_ylim(-2, 2)
axes.grid(axis="x", visible=False)
plt.show()
heavier = robot.replace(tool=payload.tool)
print(f"\nthe robot with its tool: {float(heavier.tool.mass):.3f} kg")

# %% [markdown]
# ## What you learned
#
# * A small residual does not make a model physically possible: check the definiteness of $M$ (`jid.validate`), and use `PhysicallyConsistent` for models that simulate or control.
# * Base parameters and forces follow from data; masses of the first bodies reflect bounds and priors, and the fit says so.
# * A payload is identified as a difference between two runs, with intervals, and goes back into the robot as a known tool.
#
# Details: [consistency](../docs/consistency.md), [several runs](../docs/uncertainty.md). Next: [batches](06_batches.ipynb).
#
# ## Exercise
#
# Multiply all forces of the log by 1.1 and identify by least squares again. Which estimates change, and by how much? Can this log reveal the mistake?
#
# <details markdown="1"><summary>Answer</summary>
#
# Least squares are linear in the forces: every estimate becomes 1.1 times as large, and so do all errors. Their ratio stays, so nothing in the log reveals it. A
# known mass does: the payload of this notebook would come out 10 % too heavy. That is how `jid.identify_drive_gains` finds the factor.
#
# </details>
