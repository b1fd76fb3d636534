# %% [markdown]
# # 03 · Excitation: criteria compared
#
# A motion must make every parameter act on the forces. Most papers minimise the condition number of $\Lambda = \Theta_B^T\Theta_B$ (Eq. 36). This notebook designs
# motions by three criteria for one arm within the same limits, and answers the important question: *how far do the estimates scatter?*

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
# ## An arm, its limits, its noise
#
# Two joints, a waist and a shoulder with a link: small enough to design in seconds. Noise is 1 % of each motor's largest torque.

# %%
robot = jid.Robot(
    "two axes",
    revolute=(True, True),
    axis=[(0, 0, 1.0), (0, 1.0, 0)],
    rotation=np.tile(np.eye(3), (2, 1, 1)),
    offset=[(0, 0, 0.3), (0.1, 0, 0.1)],
    tip_offset=(0, 0, 0.5),
    limits=jid.Limits(
        2,
        position_min=[-2.6, -1.8],
        position_max=[2.6, 1.8],
        velocity=[2.5, 2.5],
        acceleration=[8.0, 8.0],
        force=[60.0, 60.0],
    ),
)
base = jid.base_parameters(jid.Model(robot))
noise = 0.01 * np.asarray(robot.max_forces)
print(f"{base.size} base parameters; noise {noise} N m")

# %% [markdown]
# ## Three designs
#
# Each starts from eight random motions that fill the limits; all are improved at once, and the best one is taken. Limits hold for all times, not only at
# samples. Small values of a criterion are good. The table shows all of them for each design, and the condition number a second time, with masses in
# grams instead of kilograms.

# %%
criteria = {
    "condition number (Eq. 36)": jid.criteria.ConditionNumber(),
    "A-optimal": jid.criteria.AOptimal(),
    "D-optimal": jid.criteria.DOptimal(),
}
plans = {
    name: jid.design_excitation(
        base,
        harmonics=4,
        omega=0.8,
        criterion=criterion,
        starts=8,
        generations=12,
        samples=400,
        key=jax.random.key(1),
    )
    for name, criterion in criteria.items()
}
grams = np.where([unit.startswith("kg") for unit in base.units], 1e-3, 1.0)
print(
    f"{'designed for':27}{'cond':>8}{'A':>8}{'D':>9}{'cond, grams':>14}{'use of limits':>16}"
)
for name, plan in plans.items():
    value = {c.name: c.after for c in plan.criteria}
    cond, a, d = (value[criterion.name] for criterion in criteria.values())
    other = np.linalg.cond(plan.information.plain * np.outer(grams, grams))
    print(
        f"{name:27}{cond:8.0f}{a:8.3f}{d:9.5f}{other / 1e6:10.2f}e6{np.nanmax(plan.use[:3]):16.3f}"
    )

# %% [markdown]
# Each design is the best one in its own column, and all use their limits to the full. But the result of the first one depends on the choice
# of units: in grams, it is no longer the best. The other two criteria do not depend on units.

# %%
t = np.linspace(0, 2 * np.pi / 0.8, 500)
figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), sharex=True, sharey=True)
for axes, (name, plan) in zip(panels, plans.items()):
    axes.plot(t, np.asarray(plan.trajectory.motion(t).q), label=("waist", "shoulder"))
    axes.set_title(name)
    axes.set_xlabel("time [s]")
panels[0].set_ylabel("angle [rad]")
panels[0].legend(loc="lower left", ncols=2, fontsize=8)
plt.show()

# %% [markdown]
# ## Condition number and standard deviations
#
# Sixty random motions beside the designs. *Standard deviations* are a geometric mean over all parameters, 1 for the median random motion. Among random
# motions the condition number is a fair guide: the points rise. A design that minimises it is different: it has half the condition number of the best random
# motion, but hardly smaller deviations. The deviations of the other two designs are far below those of all random motions.

# %%
measured = np.linspace(0, 2 * np.pi / 0.8, 400, endpoint=False)


def conditioned(trajectory):
    """Condition number of a motion, and the standard deviations it gives."""
    gram = jid.criteria.information(base, trajectory.motion(measured), 1.0 / noise)
    return np.linalg.cond(gram.plain), jid.criteria.standard_deviations(gram.weighted)


random = [
    conditioned(
        jid.trajectories.random_fourier_series(robot, omega=0.8, harmonics=4, seed=k)
    )
    for k in range(60)
]
unit = np.exp(np.median([np.log(s) for _, s in random], axis=0))


def mean_deviation(s):
    """Geometric mean over the parameters, in units of the median random motion."""
    return np.exp(np.mean(np.log(s / unit)))


figure, axes = plt.subplots(figsize=(11, 3.6))
axes.loglog(
    [c for c, _ in random],
    [mean_deviation(s) for _, s in random],
    ".",
    color="#9aa6b2",
    label="random motions",
)
best = min(random, key=lambda pair: mean_deviation(pair[1]))
print(
    f"{'best random motion':28} {best[0]:4.0f}, deviations {mean_deviation(best[1]):.2f}"
)
for (name, plan), marker in zip(plans.items(), "sDo"):
    c, s = conditioned(plan.trajectory)
    axes.loglog(c, mean_deviation(s), marker, ms=9, label=name)
    print(f"{name:28} {c:4.0f}, deviations {mean_deviation(s):.2f}")
axes.set_xlabel("condition number of $\\Lambda$")
axes.set_ylabel("standard deviations, relative")
axes.set_xticks([200, 300, 500, 1000, 2000], ["200", "300", "500", "1000", "2000"])
axes.set_yticks([0.5, 0.7, 1.0, 1.4], ["0.5", "0.7", "1", "1.4"])
axes.minorticks_off()
axes.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.17))
plt.show()

# %% [markdown]
# ## Are the predicted deviations right?
#
# A design predicts standard deviations before anything is measured. To check them, we identify with 200 noise draws on each designed motion, in one call,
# and compare the scatter of the estimates with the prediction.

# %%
truth = np.random.default_rng(2).uniform(0.5, 1.5, base.size)
motions = [plan.trajectory.motion(measured) for plan in plans.values()]
stacked = jid.Motion(
    *(
        np.stack([np.asarray(getattr(m, x)) for m in motions])
        for x in ("q", "qd", "qdd")
    )
)
exact = np.asarray(base.inverse_dynamics(truth, stacked))
draws = exact[:, None] + noise * np.random.default_rng(3).normal(
    size=(3, 200, *exact.shape[1:])
)
fits = jid.identify_batch(base, stacked, draws)
scatter = np.asarray(fits.parameters).std(axis=1)

figure, axes = plt.subplots(figsize=(11, 3.6))
place = np.arange(base.size)
for k, (name, plan) in enumerate(plans.items()):
    across = place + 0.22 * (k - 1)
    axes.semilogy(across, scatter[k], "sDo"[k], ms=6, label=f"{name}: scatter")
    axes.semilogy(
        across,
        plan.standard_deviations,
        "_",
        color="#22262b",
        ms=12,
        label="promised" if k == 2 else None,
    )
axes.set_xticks(
    place, [f"{n}\n[{u}]" for n, u in zip(base.names, base.units)], fontsize=8
)
axes.set_ylabel("standard deviation")
axes.grid(axis="x", visible=False)
axes.legend(ncols=4, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.14))
plt.show()
for k, (name, plan) in enumerate(plans.items()):
    print(
        f"{name:28} scatter over promise: {np.exp(np.mean(np.log(scatter[k] / plan.standard_deviations))):.2f}, "
        f"deviations against D-optimal: {np.exp(np.mean(np.log(scatter[k] / scatter[2]))):.2f}"
    )

# %% [markdown]
# Not every parameter gains. In SI units the least certain numbers are friction's, so the condition number looks at those: dry friction comes out best,
# at the expense of the moments of inertia, whose deviations are small numbers.
#
# ## What you learned
#
# * The condition number says how *round* the confidence ellipsoid is, in units that anyone may choose; D-optimality says how *small* it is.
# * Standard deviations can be predicted before the experiment, and the prediction holds if the noise is as assumed. On real robots the
#   friction model is not exact: trust ratios between designs more than their values.
# * All criteria are one line each: exchange them, or write your own ([how to choose](../docs/how_to_choose.md)).
#
# With seven joints, collisions and limits of forces it is the same call: [the guide](../docs/excitation.md). Next: [a real robot](04_real_robot.ipynb).
#
# ## Exercise
#
# Play the same motion twice as fast, with the same number of samples. By which factors do the standard deviations of moments of inertia, viscous friction,
# dry friction and first moments change? And what do four recordings of the slow motion give?
#
# <details markdown="1"><summary>Answer</summary>
#
# Accelerations become 4 times as large, so deviations of moments of inertia become 4 times smaller. Speeds become twice as large, so those of viscous friction
# become 2 times smaller. Dry friction and gravity do not depend on the speed: their deviations stay. Four recordings halve *all* deviations.
#
# </details>
