# %% [markdown]
# # 04 · A real robot
#
# A Stäubli TX40: six axes, nine seconds of motor angles and motor torques at 5 kHz, published with the FIGAROH examples. From its log to parameters
# with uncertainties, and to the question whether to trust them. If the data are not in `../shared/data`, the log of a virtual arm is used instead:
# then the remarks about the TX40 do not apply to the figures.

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
# ## What is known, and what is in the log
#
# The sixth motor of the TX40 turns with the *fifth* joint as well: its drives are a matrix, not a list of gear ratios, and the wrist has a term of its own
# (`CoupledDrives`, for what the two drives share). The log is of the motors; everything below happens at the joints.

# %%
import json
import tempfile
from pathlib import Path

data = Path("../../shared/data/tx40")
real = data.is_dir()
if real:
    robot = jid.robots.tx40()
    columns = jid.Columns(
        angles="Joint_{}",
        forces="Joint_{}",
        sample_time=2e-4,
        angles_on_motor_side=True,
        forces_on_motor_side=True,
    )
    log = jid.read_recording(
        data / "motor_position.csv",
        columns,
        "TX40",
        forces_path=data / "motor_torque.csv",
    )
    friction = (
        jid.ViscousFriction(),
        jid.CoulombFriction(),
        jid.RotorInertia(),
        jid.terms.CoupledDrives(),
    )
    cutoff, step = 20.0, 50
    published = {
        "fv": (8.05, 5.53, 1.97, 1.11, 1.86, 0.65),
        "fc": (7.14, 8.26, 6.34, 2.48, 3.03, 0.28),
        "Ia": (0.362, 0.362, 0.0988, 0.0313, 0.0468, 0.0105),
    }
    known = {
        f"{kind}{j + 1}": value
        for kind, six in published.items()
        for j, value in enumerate(six)
    }
else:
    robot = jid.robots.panda()
    with tempfile.TemporaryDirectory() as folder:
        jid.simulation.write_example(Path(folder))
        columns = jid.Columns(time="time", angles="q{}", forces="tau{}")
        log = jid.read_recording(
            Path(folder) / "identification.csv", columns, "virtual arm"
        )
        truth = json.loads((Path(folder) / "truth.json").read_text())[
            "standard_parameters"
        ]
    friction = (
        jid.ViscousFriction(),
        jid.CoulombFriction(),
        jid.RotorInertia(),
        jid.ConstantOffset(),
    )
    cutoff, step = 10.0, 20
    known = {
        row["name"]: row["value"]
        for row in truth
        if row["name"][:2] in ("fv", "fc", "Ia")
    }

print(
    f"{log.name}: {log.samples} samples of {log.joints} axes, {log.duration:.1f} s at {1 / log.sample_time:.0f} Hz"
)
print("motor angle for joint angle:")
print(robot.drives.reduction)

# %% [markdown]
# ## From samples to rows
#
# Angles are differentiated behind a zero-phase filter; the regressor's columns and the torques pass the *same* filter, and both are thinned out
# alike. The first 60 % of the log are for identification, the rest for validation.

# %%
model = jid.Model(robot, (jid.RigidBodies(), *friction))
base = jid.base_parameters(model)
smooth, thin = jid.ZeroPhaseButterworth(cutoff), jid.Subsample(step)
seen, unseen = (jid.observe(part, robot, smooth, thin) for part in log.split(0.6))
fit = jid.identify(base, seen)

print(f"{base.size} base parameters from {sum(fit.rows)} rows")
print(
    f"condition number {fit.condition_number:.0f}; {fit.condition_numbers.scaled:.0f} with columns of length one"
)
print(f"residual: {fit.residual:.1%} of the forces")
print(
    "not determined:",
    "; ".join(d.sentence(base) for d in fit.undetermined) or "nothing",
)

# %% [markdown]
# ## How well is each parameter known?
#
# Standard deviations come from the spectrum of the residuals: rows behind a filter are not independent, and the textbook formula gives values that are too small by
# the factor printed here. What counts is the torque that an interval leaves open on other motions: a small parameter may be uncertain.

# %%
print(
    "honest over naive standard deviations:",
    np.median(fit.uncertainty.ratios).round(1),
    "(median)",
)
count = (fit.open_shares <= 0.1).sum()
print(f"{count} of {base.size} parameters leave at most 10 % of the torques open")

# %% [markdown]
# ## Comparison with known values
#
# Friction and rotors of the TX40's drives have been published (of the virtual arm the truth is known). Where such a number is a base parameter by itself, it
# can be compared. Parameters that the log hardly excites have wide intervals.

# %%
alone = [
    k
    for k, name in enumerate(base.names)
    if base.expressions[k] == name and name in known
]
others = np.array([known[base.names[k]] for k in alone])
ratio = np.asarray(fit.parameters)[alone] / others
half = fit.uncertainty.half_widths(0.95)[alone] / others
figure, axes = plt.subplots(figsize=(11, 3.0))
axes.axhline(1.0, color="#22262b", lw=1)
axes.errorbar(range(len(alone)), ratio, half, fmt="o", ms=4, lw=1.2, capsize=3)
axes.set_xticks(
    range(len(alone)), [f"{base.names[k]}\n{known[base.names[k]]:.3g}" for k in alone]
)
axes.set_xlabel("parameter, and its known value [N m s, N m, kg m²]")
axes.set_ylabel("estimate / known value")
axes.grid(axis="x", visible=False)
plt.show()
inside = np.abs(ratio - 1) <= half
print(f"{inside.sum()} of {len(alone)} intervals of 95 % hold the known value")

# %% [markdown]
# ## Does it predict new data?

# %%
check = jid.validate(fit, [seen, unseen])
for errors, part in zip(check.errors, ("first 60 %", "rest")):
    print(
        f"{part:11} relative error {errors.relative:6.1%}, mean error [% of the largest force]:",
        errors.mean_percent.round(2),
    )
jid.plot.torques(check.errors[1], robot, title=f"{log.name}, the rest of the log")

# %% [markdown]
# In the last second and a half of its log the TX40 stands still: there the torques depend on stiction, which the model does not have, and the
# relative error is large because the torques are small. Absolute errors stay below 3 % of the largest torques in every joint.
#
# ## What is left?
#
# If residuals were noise and nothing else, their spectra would follow the dashed lines. Those of the TX40 lie above them at low frequencies: the errors are
# slow and repeat with the motion, as errors of the friction law do. This is why the standard deviations are larger than those of the textbook formula.

# %%
white = sum(fit.residual_spectra.white)
print(f"white residuals: {white} of {robot.joints} joints")
jid.plot.residuals(fit.residual_spectra, robot)

# %% [markdown]
# ## Would another estimator do better?
#
# On the TX40's log their errors differ by a few percent, much less than errors on the motion of the fit differ from errors on other motion: a better log, or a
# better friction law, is worth more than another estimator ([how to choose](../docs/how_to_choose.md)).

# %%
estimators = {
    "least squares": jid.estimators.LeastSquares(),
    "weighted": jid.WeightedLeastSquares(),
    "residual variances": jid.WeightedLeastSquares(jid.estimators.ResidualVariances()),
    "consistent": jid.PhysicallyConsistent(),
}
figure, axes = plt.subplots(figsize=(11, 3.0))
for k, estimator in enumerate(estimators.values()):
    one = jid.validate(jid.identify(base, seen, estimator), [seen, unseen])
    percent = [100 * e.relative for e in one.errors]
    axes.barh(
        k - 0.18, percent[0], 0.34, color="#0072B2", label="seen" if k == 0 else None
    )
    axes.barh(
        k + 0.18,
        percent[1],
        0.34,
        color="#E69F00",
        label="not seen" if k == 0 else None,
    )
    least = one.definiteness.smallest
    axes.annotate(
        f"smallest eigenvalue of M: {least:.2g}",
        (percent[1], k + 0.18),
        (4, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
    )
axes.set_yticks(range(len(estimators)), estimators)
axes.set_xlim(0, 1.35 * max(percent))
axes.set_xlabel("RMS error of all joints [% of the RMS forces]")
axes.invert_yaxis()
axes.legend(ncols=2, loc="upper right", bbox_to_anchor=(1.0, 1.16))
plt.show()

# %% [markdown]
# ## What you learned
#
# * A log, a geometry and six lines give parameters, honest standard deviations and what the log leaves open.
# * Judge a model by a part of the log that it has not seen, in all and per joint, in percent of the RMS torque.
# * [Is my fit good?](../docs/is_my_fit_good.md) lists the questions in order, with thresholds. On the command line all of this is
#   `jaxid identify experiment.toml log.csv --split 0.6 -o report/`.
#
# Next: [physically possible bodies](05_consistency_payload.ipynb).
#
# ## Exercise
#
# Keep twice as many rows of the same log (half the step of the decimation). Do the standard deviations become smaller by $\sqrt 2$?
#
# <details markdown="1"><summary>Answer</summary>
#
# The naive ones do, the reported ones hardly change. Neighbouring rows behind a low-pass hold the same noise, so more rows are no more information. The
# spectral deviations know that, which is why they are larger than the naive ones.
#
# </details>
