# %% [markdown]
# # 14 · Which method, on which robot?
#
# `benchmarks/arms` identifies measured and simulated robots with this package and with other tools, and judges all on motions that none has seen. This notebook
# reads its figures. It needs no logs and takes seconds.

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

# %%
import json
from pathlib import Path

content = json.loads(Path("../benchmarks/arms/results.json").read_text())
results = content["results"]
print(f"measured on {content['date']} with jaxid {content['version']}")
print(f"this is jaxid {jid.__version__}")
errors = {
    robot: {name: row["error"] for name, row in rows.items() if "error" in row}
    for robot, rows in results.items()
}
for robot, by_method in errors.items():
    print(f"{robot:15s} best: {min(by_method, key=by_method.get)}")

# %% [markdown]
# ## Against the best rival
#
# `error` is the RMS torque error over the RMS torque, the error of free-running simulations [rad], or the error of held-out positions [m]: each robot has one of
# them. Relative to the best rival, all robots fit into one picture. Left of the line this package is better, right of it the rival.

# %%
rivals = {
    robot: min(x for name, x in by_method.items() if not name.startswith("jaxid"))
    for robot, by_method in errors.items()
}
rows = np.arange(len(errors))
figure, panel = plt.subplots(figsize=(9, 4))
for name, marker in (("jaxid", "o"), ("jaxid choose", "D")):
    ratios = [
        by_method.get(name, np.nan) / rivals[x] for x, by_method in errors.items()
    ]
    panel.plot(ratios, rows, marker, label=name, linestyle="none")
panel.axvline(1.0, color="0.5")
panel.set_yticks(rows, list(errors))
panel.invert_yaxis()
panel.set(xlabel="error over that of the best rival", xscale="log")
panel.set_xticks([0.4, 0.6, 0.8, 1.0], ["0.4", "0.6", "0.8", "1"])
panel.minorticks_off()
panel.legend()

# %% [markdown]
# ## A low torque error is not yet a good model
#
# A model also has to *move* like the robot. Each point is one method on one robot: its torque error, and the error of positions after half a second of simulation
# under the recorded torques. Crosses at the top diverge, often since the mass matrix is not positive definite.

# %%
figure, panel = plt.subplots(figsize=(9, 4))
top = 3e3
COLOURS = 5  # the next robots have the same colours and another shape
robots_of_torques = []
for robot, by_method in results.items():
    models = [x for x in by_method.values() if x.get("simulations")]
    if not models or models[0]["kind"] != "torques":
        continue
    torque_errors = np.array([100 * x["error"] for x in models])
    distances = np.array([1e3 * x["simulations"][1] for x in models])
    moves = distances < top
    number = len(robots_of_torques)
    robots_of_torques.append(robot)
    colour = f"C{number % COLOURS}"
    shape = "os"[number // COLOURS]
    panel.loglog(
        torque_errors[moves], distances[moves], shape, color=colour, label=robot
    )
    count = np.count_nonzero(~moves)
    panel.loglog(torque_errors[~moves], np.full(count, top), "x", color=colour)
panel.set(xlabel="torque error [%]", ylabel="position error after 0.5 s [mrad or mm]")
panel.set_xticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
panel.minorticks_off()
panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

# %% [markdown]
# ## Do the intervals hold?
#
# Of simulated robots the truth is known. Of measured ones two logs should agree within the intervals of both. Naive intervals, which take all rows as
# independent, are far too narrow.

# %%
for robot, by_method in results.items():
    shares = by_method.get("coverage", {})
    for kind in ("truth", "pairs"):
        if kind in shares:
            own, naive = 100 * np.array(shares[kind])
            print(f"{robot:15s} {kind:6s} {own:5.1f} %   naive {naive:5.1f} %")

# %% [markdown]
# ## What you learned
#
# * One number does not rank methods: torques, simulations and bodies tell different faults.
# * Above the frequencies in which a robot moves, accelerations from encoders are noise. A model that is judged there looks better the less inertia it has.
# * Intervals are honest about noise. What the model lacks differs from motion to motion and is in none of them: use several logs and `jid.agreement`.
#
# The page: [one table for the field](../benchmarks/arms/README.md); it says how to add your robot and your method.
#
# Next: [a robot on legs](15_legs.ipynb).
#
# ## Exercise
#
# Which method has the largest gap between torque error and simulation?
#
# <details markdown="1"><summary>Answer</summary>
#
# Rank the methods of each robot by both columns: least squares on columns that a QR picks has small torque errors, but where logs determine little its mass
# matrix is indefinite, and simulations diverge.
#
# </details>
