# %% [markdown]
# # 06 · Batches: Monte-Carlo, bootstrap, a thousand robots
#
# One identification is a number with an error bar. Thousands of them, in one compiled call, show whether the error bar is right, and which robot of a fleet
# differs from the others. The code is the same on a CPU and on a GPU.

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
# ## A small arm
#
# A waist and a shoulder with a link: seven joints work in the same way, but take longer.

# %%
from scipy import stats

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
largest = np.asarray(robot.max_forces)
truth = np.random.default_rng(1).uniform(0.5, 1.5, base.model.size)
p_base = np.asarray(base.from_standard(truth))
print(f"{base.size} base parameters: {', '.join(base.names)}")

# %% [markdown]
# ## Monte-Carlo: are 95 % intervals right 95 times in a hundred?
#
# One motion, 2000 draws of noise with 30 ms of memory, as after the filter of a drive. Standard deviations from the textbook assume that every row
# is independent; those of the spectral sandwich look at the residuals' spectrum (`row_time`). Columns are evaluated once for all draws.

# %%
step = 0.01
t = np.arange(0.0, 8.0, step)
motion = jid.trajectories.random_fourier_series(
    robot, omega=2 * np.pi / 8.0, seed=2
).motion(t)
exact = np.asarray(base.model.inverse_dynamics(truth, motion))
kept = np.exp(-step / 0.03)
noise = np.random.default_rng(3).normal(size=(2000, len(t) + 20, 2))
for k in range(1, noise.shape[1]):
    noise[:, k] = kept * noise[:, k - 1] + np.sqrt(1 - kept**2) * noise[:, k]
forces = exact + 0.01 * largest * noise[:, 20:]
one = jid.Motion(*(np.asarray(x)[None] for x in (motion.q, motion.qd, motion.qdd)))
fits = jid.identify_batch(base, one, forces[None], row_time=step)
estimates, dof = np.asarray(fits.parameters)[0], np.asarray(fits.dof)[0]
scatter = estimates.std(axis=0)
error = np.abs(estimates - p_base)
covered = {}
for label, deviations, quantile in (
    ("spectral sandwich", fits.standard_deviations, stats.t.ppf(0.975, dof)),
    ("independent rows", fits.naive_standard_deviations, 1.96),
):
    deviations = np.asarray(deviations)[0]
    covered[label] = 100 * np.mean(error <= quantile * deviations, axis=0)
    print(
        f"{label:18} 95 % intervals contain the true value in {covered[label].mean():.1f} % of all cases; "
        f"median deviation {np.median(deviations / scatter):.2f} of the scatter"
    )

figure, panels = plt.subplots(1, 2, figsize=(11, 3.2), width_ratios=(2, 1))
place = np.arange(base.size)
panels[0].axhline(95, color="#22262b", lw=1)
for marker, (label, percent) in zip("os", covered.items()):
    panels[0].plot(place, percent, marker, label=label)
panels[0].set_xticks(place, base.names, rotation=90)
panels[0].set_ylabel("intervals with the true value [%]")
panels[0].set_ylim(0, 105)
panels[0].legend(loc="lower left", ncols=2)
k = base.names.index("fc2")
panels[1].hist(estimates[:, k], 50, color="#9aa6b2", density=True)
x = np.linspace(*np.quantile(estimates[:, k], [0.0005, 0.9995]), 200)
for s, label in (
    (fits.standard_deviations, "spectral sandwich"),
    (fits.naive_standard_deviations, "independent rows"),
):
    panels[1].plot(
        x, stats.norm.pdf(x, p_base[k], np.median(np.asarray(s)[0, :, k])), label=label
    )
panels[1].set_xlabel(f"{base.names[k]} [{base.units[k]}], 2000 estimates")
panels[1].set_yticks([])
panels[1].set_ylabel("density")
panels[1].set_ylim(0, 1.35 * panels[1].get_ylim()[1])
panels[1].legend(fontsize=8, loc="upper left")
plt.show()

# %% [markdown]
# If neighbouring rows are taken as independent, the standard deviations are less than half their true size. The sandwich estimates the correlation of the
# noise from the residuals of each single log.
#
# ## Bootstrap: error bars from one log
#
# On a real robot there is one log. Blocks of time, drawn with replacement, replace further logs: each draw counts how often every block occurs, and
# nothing is evaluated again. Blocks must be many, and longer than the correlation time of the noise: here 32 of a quarter of a second.

# %%
log = jid.Recording.of(motion.q, forces[0], sample_time=step, name="one log")
seen = jid.observe(log, robot, jid.ZeroPhaseButterworth(12.0), jid.Subsample(3))
fit = jid.identify(base, seen)
blocks = jid.RegressionProblem(base, [seen], divisions=32).blocks
draws = np.asarray(
    jid.uncertainty.bootstrap(blocks, fit.weights, 2000, jax.random.key(0))
)

figure, axes = plt.subplots(figsize=(11, 3.0))
axes.axhline(1.0, color="#22262b", lw=1)
for k, (values, label) in enumerate(
    (
        (fit.standard_deviations, "spectral sandwich"),
        (draws.std(axis=0), "bootstrap"),
        (fit.naive_standard_deviations, "independent rows"),
    )
):
    axes.plot(place + 0.16 * (k - 1), values / scatter, "oDs"[k], ms=5, label=label)
    print(
        f"{label:18} {np.min(values / scatter):.2f} to {np.max(values / scatter):.2f}"
    )
axes.set_xticks(place, base.names, rotation=90)
axes.set_ylim(0, None)
axes.set_ylabel("deviation from one log / scatter")
axes.grid(axis="x", visible=False)
axes.legend(ncols=3, loc="lower left")
plt.show()

# %% [markdown]
# 1 is the scatter of the 2000 logs above. One log of eight seconds does not know its own uncertainty to better than some tens of percent, by either way. But
# both err in both directions, while independent rows give too small deviations for every parameter.
#
# ## A thousand robots
#
# A fleet of one type: the links of every arm differ by some 5 mm from the drawing and have been measured; thirty gears are worn. Geometry becomes an *input*
# of the compiled computation, so one call identifies all of them, each with its own lengths.

# %%
fleet = np.random.default_rng(4)
count = 1000
short = np.arange(0.0, 8.0, 0.04)
asked = jid.trajectories.random_fourier_series(
    robot, omega=2 * np.pi / 8.0, seed=5
).motion(short)
asked = jid.Motion(
    *(np.broadcast_to(x, (count, *x.shape)) for x in (asked.q, asked.qd, asked.qdd))
)
lengths = robot.offset + 5e-3 * fleet.normal(size=(count, 2, 3)) * (
    np.asarray(robot.offset) != 0
)
arms = [robot.replace(offset=x) for x in lengths]
p = np.tile(truth, (count, 1))
worn = fleet.choice(count, 30, replace=False)
p[worn, base.model.parameter_names.index("fv2")] *= 2


def forces_of(offset, p, *state):
    """Forces of one arm of the fleet."""
    return jid.Model(robot.replace(offset=offset)).inverse_dynamics(
        p, jid.Motion(*state)
    )


forces = np.asarray(
    jax.jit(jax.vmap(forces_of))(lengths, p, asked.q, asked.qd, asked.qdd)
)
forces = forces + 0.005 * largest * fleet.normal(size=forces.shape)
ways = {
    "own geometry": jid.identify_batch(base, asked, forces, robots=arms),
    "drawing's geometry": jid.identify_batch(base, asked, forces),
}

figure, panels = plt.subplots(1, 2, figsize=(11, 3.2), width_ratios=(1, 2))
k = base.names.index("C1")
for name, some in ways.items():
    values = np.asarray(some.parameters)[:, k]
    promised = np.median(np.asarray(some.standard_deviations)[:, k])
    print(
        f"C1, {name:18} scatters {values.std() / promised:.2f} times as much as it should"
    )
    bins = np.median(values) + np.linspace(-0.06, 0.06, 41)
    panels[0].hist(values, bins, histtype="stepfilled", alpha=0.5, label=name)
panels[0].set_xlabel(f"C1 [{base.units[k]}]")
panels[0].set_ylabel("robots")
panels[0].set_ylim(0, 1.4 * panels[0].get_ylim()[1])
panels[0].legend(loc="upper left", fontsize=8)

k = base.names.index("fv2")
own = ways["own geometry"]
value, deviation = (
    np.asarray(own.parameters)[:, k],
    np.asarray(own.standard_deviations)[:, k],
)
middle = np.median(value)
suspect = np.flatnonzero((value - middle) / deviation > 5)
print(
    f"worn gears found: {len(set(suspect) & set(worn))} of {len(worn)}, "
    f"false alarms: {len(set(suspect) - set(worn))}"
)
panels[1].plot(value, ".", ms=3, color="#9aa6b2")
panels[1].plot(worn, value[worn], "o", ms=5, mfc="none", label="gears that are worn")
limit = middle + 5 * np.median(deviation)
panels[1].axhline(limit, color="#D55E00", lw=1, label="five standard deviations")
panels[1].set_xlabel("robot")
panels[1].set_ylabel(f"fv2 [{base.units[k]}]")
panels[1].set_ylim(0, 1.25 * value.max())
panels[1].legend(ncols=2, loc="upper right")
plt.show()

# %% [markdown]
# With the drawing's lengths for all, what differs in length appears as a moment of inertia: C1 scatters more than its standard deviation. With the robots' own geometry
# the scatter agrees with it.
#
# ## On a GPU
#
# Where JAX finds a GPU (`pip install "jax[cuda12]"`), its arrays live there and the calls above run there. Called as above, a batch is computed in groups, so that
# memory does not grow with its size; under `jax.jit` it is one computation for the device, without a step on the host in between:

# %%
device = jax.devices()[0]  # a GPU, where there is one
whole = jax.jit(lambda motion, forces: jid.identify_batch(base, motion, forces))
again = whole(*jax.device_put((asked, forces), device)).parameters
difference = (
    np.abs(again - ways["drawing's geometry"].parameters).max() / np.abs(again).max()
)
print(
    f"on this {device.platform}, in one computation: the same parameters, {difference < 1e-9}"
)

# %% [markdown]
# The amount of work decides: a single log of a few seconds leaves a GPU idle, thousands of data sets do not. All computations are in double precision,
# which is slow on consumer graphics cards. This notebook was executed on a CPU; `benchmarks/gpu.py` says what your GPU does. Several devices and several hosts
# can share the work on long logs: [many devices and processes](../docs/cluster.md).
#
# ## What you learned
#
# * `identify_batch` takes data sets, draws of noise, masks, geometries: leading axes, one compiled call.
# * Intervals are right only if they account for the correlation of neighbouring rows; one log suffices for that, by the spectrum of its residuals or by bootstrap.
# * What differs between robots of one type can be an input: each gets its own geometry, and outliers of a fleet stand out in units of their own uncertainty.
#
# Next: [what temperature does](07_temperature.ipynb).
#
# ## Exercise
#
# You want to know the coverage of 95 % intervals to ± 1 % (two standard deviations). How many independent data sets do you need for one parameter?
#
# <details markdown="1"><summary>Answer</summary>
#
# The share that is counted scatters with $\sqrt{0.95 \cdot 0.05 / n}$. Twice that is 0.01 for $n$ = 1900. The batches of this notebook make such numbers cheap.
#
# </details>
