# %% [markdown]
# # 07 · Temperature
#
# A robot that has just been switched on is not the robot of half an hour later: the lubricant in its gears warms up, and friction falls, viscous friction
# by a third and more. The paper identifies both states (Sec. 6). Here a virtual TX90L on its rail, whose rail and first joint have the published friction,
# cold and warm, shows what changes, what must not change, and how large the errors of a model without temperature are.

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
# ## Friction falls with temperature
#
# Friction turns the drives' work into heat, which stays in the gears for some ten minutes; after half an hour of motion little changes. The virtual robot has
# published friction at two temperatures, here taken as 20 and 45 °C.

# %%
cold = jid.simulation.virtual_tx90l_on_rail()
robot = cold.robot
motions = [
    jid.trajectories.random_fourier_series(robot, omega=0.8, seed=k, reach=0.9)
    for k in (1, 2, 3)
]
temperatures = np.linspace(20.0, 50.0, 31)
fallen = [cold.at(T).parameters for T in temperatures]
kept = [list(cold.model.parameter_names).index(f"fv{j + 1}") for j in range(7)]

figure, panel = plt.subplots(figsize=(7, 3.0))
panel.plot(
    temperatures,
    100 * np.array(fallen)[:, kept] / cold.parameters[kept],
    label=robot.joint_names,
)
panel.set_xlabel("temperature of the gear [°C]")
panel.set_ylabel("viscous friction [% of the cold one]")
panel.set_ylim(0, 105)
panel.legend(ncols=2, fontsize=7)
plt.show()

# %% [markdown]
# ## The same experiment, cold and warm
#
# Two logs of 15.7 s (two periods) in each state, warm with all gears at 45 °C, with encoders, torque noise and ripple, and with more friction near standstill
# than elsewhere (Stribeck). The model that is identified knows viscous and Coulomb friction only. Which of its 44 parameters have *changed*? An estimate outside
# of the other's 95 % interval is not yet a sign: without any change this happens to one parameter in six. The test below keeps the chance of *any* false alarm at 5 %.

# %%
base = jid.base_parameters(cold.model)
smooth, thin = jid.ZeroPhaseButterworth(10.0), jid.Subsample(20)


def observed(virtual, k, seed, name="log"):
    """A log of the k-th motion."""
    log = virtual.measure(
        motions[k], duration=15.7, sample_time=0.002, seed=seed, name=name
    )
    return jid.observe(log, virtual.robot, smooth, thin)


warm = cold.at(45.0)
robots = {"cold": cold, "warm": warm}
states = {
    name: [observed(virtual, k, 10 * s + k, f"{name} {k + 1}") for k in (0, 1)]
    for s, (name, virtual) in enumerate(robots.items())
}
fits = {name: jid.identify(base, some) for name, some in states.items()}
comparison = jid.compare(fits["cold"], fits["warm"])
verdicts = comparison.verdicts
kinds = {"fv": "viscous friction", "fc": "Coulomb friction", "Ia": "rotors"}
for kind in (*kinds.values(), "bodies"):
    members = [
        k for k, n in enumerate(base.names) if kinds.get(n[:2], "bodies") == kind
    ]
    changed = sum(verdicts[k].value == "changed" for k in members)
    print(f"{kind:17} {changed} of {len(members)} changed")

print(f"\n{'':12}{'cold':>16}{'truth':>9}{'warm':>20}{'truth':>9}")
exact = {
    name: np.asarray(base.from_standard(v.parameters)) for name, v in robots.items()
}
for parameter in ("fv1", "fv2", "fc1", "fc2"):
    k = base.names.index(parameter)
    line = f"{parameter:5}{base.units[k]:7}"
    for name, fit in fits.items():
        half = fit.uncertainty.half_widths(0.95)[k]
        line += f"{fit.parameters[k]:9.2f} ± {half:4.2f}{exact[name][k]:9.2f}    "
    print(line.rstrip())

# %% [markdown]
# Friction has changed in all gears; bodies and rotors have not. This is true of the simulated robot.

# %%
jid.plot.comparison(comparison)

# %% [markdown]
# ## Errors at the wrong temperature
#
# The cold model predicts the torques of the warm robot, on a motion that is in neither of the fits.

# %%
new = observed(warm, 2, 99)
errors = {name: jid.validate(fit, new).errors for name, fit in fits.items()}
for name, one in errors.items():
    print(f"{name} model: relative error {one[0].relative:.1%}")
jid.plot.bars({f"{name} model": one for name, one in errors.items()}, robot)

# %% [markdown]
# ## A law instead of two states
#
# Friction at several temperatures gives its law: $f_v(T) = f_v(T_0)\, e^{-a (T - T_0)}$, with an interval for each rate: the logarithms of the estimates lie on a
# line, and the deviation of each logarithm is the relative deviation of its estimate. Two more logs in between are enough: the picture shows the first four axes,
# their points a little apart sideways. `law` is a friction term for models at any temperature.

# %%
steps = (20.0, 28.0, 36.0, 45.0)
several = [
    fits["cold"],
    *(jid.identify(base, observed(cold.at(T), 0, int(T))) for T in steps[1:-1]),
    fits["warm"],
]
places = [base.names.index(f"fv{j + 1}") for j in range(7)]
values = np.array([f.parameters for f in several])[:, places]
deviations = np.array([f.standard_deviations for f in several])[:, places]
rates, rate_deviations, values_at_20 = np.empty((3, 7))
for j in range(7):
    line, covariance = np.polyfit(
        np.array(steps) - 20.0,
        np.log(values[:, j]),
        deg=1,
        w=values[:, j] / deviations[:, j],
        cov="unscaled",
    )
    rates[j] = -line[0]
    rate_deviations[j] = np.sqrt(covariance[0, 0])
    values_at_20[j] = np.exp(line[1])
law = jid.terms.TemperatureScaled(jid.ViscousFriction(), rates, 20.0, 20.0)

figure, axes = plt.subplots(figsize=(11, 3.4))
T = np.linspace(15, 50, 50)
for j in range(4):
    (curve,) = axes.plot(T, 100 * np.exp(-rates[j] * (T - 20)), lw=1)
    axes.errorbar(
        np.array(steps) + 0.25 * (j - 1.5),
        100 * values[:, j] / values_at_20[j],
        196 * deviations[:, j] / values_at_20[j],
        fmt="o",
        ms=4,
        color=curve.get_color(),
        label=robot.joint_names[j],
    )
axes.set_xlabel("temperature of the gear [°C]")
axes.set_ylabel("viscous friction [% of that at 20 °C]")
axes.legend()
plt.show()
true = np.asarray(cold.heating.viscous_rate)
for j, name in enumerate(robot.joint_names):
    print(
        f"{name:7} falls by {100 * rates[j]:.2f} ± {196 * rate_deviations[j]:.2f} % per degree "
        f"(truth {100 * true[j]:.2f})"
    )

# %% [markdown]
# ## What you learned
#
# * Identify the robot in the state in which it works: the errors of the cold model on the warm robot are many times larger than those of the warm model.
# * Bodies must *not* change between the two states. If they do, something else is wrong, and `jid.compare` reports it with few false alarms.
# * A few logs at known temperatures give a law with intervals, and models that follow the temperature. Details: [several runs](../docs/uncertainty.md).
#
# Next: [your own robot](08_your_robot.ipynb).
#
# ## Exercise
#
# Viscous friction falls by 2 % for each degree. At which temperature is it half of its value at 20 °C? And how large is the error of a model of 20 °C there?
#
# <details markdown="1"><summary>Answer</summary>
#
# $e^{-0.02\,\Delta T} = 1/2$ gives $\Delta T$ = 34.7 °C, so at 54.7 °C. The model of 20 °C then promises twice the viscous friction: an error as large as
# the friction itself.
#
# </details>
