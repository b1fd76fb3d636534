# %% [markdown]
# # 09 · Your own solver
#
# The design of a motion is an `ExcitationProblem`: functions of one vector that run under `jit`, `vmap`, `grad` and `jvp`. This notebook puts five solvers of
# other packages around the same problem, and compares what they find with `jid.excitation.minimise`.

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
# ## The problem
#
# The arm of [notebook 03](03_excitation.ipynb), and a tip that stays below 1 m/s. The unknown `x` holds scaled Fourier coefficients; `value(x)` is the logarithm
# of the criterion, `inequalities(x)` must not be positive, and `violation(x)` is the largest excess at any time.

# %%
import time
import warnings

import jax.numpy as jnp
import jaxopt
import optax
import optimistix as optx
import scipy.optimize

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
problem = jid.ExcitationProblem(
    base,
    jid.trajectories.FourierBasis(4, 0.8),
    constraints=(jid.constraints.TipLimits(speed=1.0),),
    samples=400,
)
x = problem.random(jax.random.key(0))
print(f"{problem.size} unknowns, {len(problem.inequalities(x))} inequalities")
print(
    f"a random motion: criterion {np.exp(problem.value(x)):.5f}, excess {problem.violation(x):.3f}"
)

# %% [markdown]
# ## Five solvers
#
# A solver is a function of the problem and of random motions, and returns better ones. SciPy's SLSQP and trust-constr take the inequalities as they are, with
# Jacobians from JAX. The others do not support inequalities: they minimise the value with a penalty for the excess, which grows from round to round.


# %%
def penalised(problem, weight):
    """Return the value with a penalty for what exceeds the limits."""

    def cost(x):
        excess = jnp.maximum(problem.inequalities(x), 0.0)
        return problem.value(x) + weight * jnp.sum(excess**2)

    return cost


WEIGHTS = (1.0, 30.0, 1e3)


def scipy_solver(method, options):
    """Return a solver that starts SciPy's from each motion in turn."""

    def solve(problem, starts):
        value = jax.jit(jax.value_and_grad(problem.value))
        excess, jacobian = (
            jax.jit(problem.inequalities),
            jax.jit(jax.jacfwd(problem.inequalities)),
        )
        limits = scipy.optimize.NonlinearConstraint(excess, -np.inf, 0.0, jac=jacobian)

        def one(x):
            return scipy.optimize.minimize(
                lambda y: jax.device_get(value(y)),
                x,
                jac=True,
                method=method,
                constraints=[limits],
                options=options,
            ).x

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.array([one(x) for x in np.asarray(starts)])

    return solve


def optax_solver(problem, starts):
    """Adam from all starts at once."""
    x = starts
    for weight in WEIGHTS:
        adam = optax.adam(optax.cosine_decay_schedule(0.03, 400))
        slope = jax.vmap(jax.grad(penalised(problem, weight)))

        def step(carry, _, adam=adam, slope=slope):
            x, state = carry
            change, state = adam.update(slope(x), state)
            return (optax.apply_updates(x, change), state), None

        run = jax.jit(
            lambda x, step=step, adam=adam: jax.lax.scan(
                step, (x, adam.init(x)), None, 400
            )
        )
        x = run(x)[0][0]
    return x


def optimistix_solver(problem, starts):
    """BFGS from all starts at once."""
    x = starts
    for weight in WEIGHTS:
        cost = penalised(problem, weight)

        def one(x, cost=cost):
            solver = optx.BFGS(rtol=1e-8, atol=1e-8)
            return optx.minimise(
                lambda y, _: cost(y), solver, x, max_steps=300, throw=False
            ).value

        x = jax.jit(jax.vmap(one))(x)
    return x


def jaxopt_solver(problem, starts):
    """L-BFGS from all starts at once."""
    x = starts
    for weight in WEIGHTS:
        solver = jaxopt.LBFGS(
            penalised(problem, weight), maxiter=300, linesearch="backtracking"
        )
        x = jax.jit(jax.vmap(lambda x, solver=solver: solver.run(x).params))(x)
    return x


solvers = {
    "SciPy SLSQP": scipy_solver("SLSQP", {"maxiter": 100}),
    "SciPy trust-constr": scipy_solver("trust-constr", {"maxiter": 100}),
    "optax Adam": optax_solver,
    "optimistix BFGS": optimistix_solver,
    "jaxopt L-BFGS": jaxopt_solver,
}

# %% [markdown]
# ## What they find
#
# All begin from the same four random motions. `jid.excitation.minimise(problem, solver)` makes what a solver returns keep all limits for all times, and takes the best: the
# numbers below are those of motions that can be recorded. Without a solver it takes its own: interior points and generations.


# %%
def seconds(run):
    """Return a result and how long it took."""
    begun = time.perf_counter()
    return run(), time.perf_counter() - begun


effort = {"starts": 4, "key": jax.random.key(1)}
plans, times = {}, {}
for name, solver in solvers.items():
    plans[name], times[name] = seconds(
        lambda solver=solver: jid.excitation.minimise(
            problem, solver, throw=False, **effort
        )
    )
ours = "jid.excitation.minimise"
plans[ours], times[ours] = seconds(lambda: jid.excitation.minimise(problem, **effort))
for name, plan in plans.items():
    kept = "keeps all limits" if plan.feasible else "exceeds a limit"
    print(
        f"{name:20} {plan.history[0]:.5f} -> {plan.history[-1]:.5f}, {kept}; {plan.status.name.lower()}"
    )

# %%
figure, axes = plt.subplots(figsize=(11, 3.2))
names = list(plans)
values = [plans[name].history[-1] / plans[ours].history[-1] for name in names]
colours = ["#2a6f97" if plans[name].feasible else "#d9a5a0" for name in names]
axes.barh(names[::-1], values[::-1], color=colours[::-1])
for k, value in enumerate(values[::-1]):
    axes.text(value + 0.005, k, f"{value:.3f}", va="center", fontsize=8)
axes.set_xlim(0.9, None)
axes.set_xlabel(
    "mean axis of the confidence ellipsoid, relative to jid.excitation.minimise"
)
axes.grid(axis="y", visible=False)
plt.show()

# %% [markdown]
# The plan keeps the criterion after each step: most is gained in the first stages, and the generations find motions that no single start finds.

# %%
figure, panels = plt.subplots(1, 2, figsize=(11, 3.2))
panels[0].plot(plans[ours].history, ".-")
panels[0].set_xlabel("step of jid.excitation.minimise")
panels[0].set_ylabel("mean axis of the ellipsoid")
t = np.linspace(0, 2 * np.pi / 0.8, 400)
for name, style in ((ours, "-"), ("SciPy SLSQP", "--")):
    panels[1].plot(
        t, np.asarray(plans[name].trajectory.motion(t).q)[:, 1], style, label=name
    )
panels[1].set_xlabel("time [s]")
panels[1].set_ylabel("angle of the shoulder [rad]")
panels[1].legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Forward and reverse mode
#
# The criterion has derivative rules of its own, so both modes and their combinations work: here the value's gradient by both, and Newton's matrix.

# %%
x = problem.random(jax.random.key(2))
forward, reverse = (
    jax.jit(jax.jacfwd(problem.value))(x),
    jax.jit(jax.grad(problem.value))(x),
)
print("largest difference of both modes:", f"{np.abs(forward - reverse).max():.1e}")
print("shape of the Hessian:", jax.jit(jax.hessian(problem.value))(x).shape)

# %% [markdown]
# ## What you learned
#
# * An `ExcitationProblem` is four functions of one vector; any solver fits around them.
# * `jid.excitation.minimise(problem, solver)` turns what a solver finds into a motion that keeps its limits for all times, with tables and files like any other design.
# * From four starts, SLSQP and BFGS come within some percent of ours; the remaining difference is due to the generations.
#
# The guide: [excitation](../docs/excitation.md). Next: [no torque in the log](10_no_torque.ipynb).
#
# ## Exercise
#
# Your optimiser does not support constraints. Write one line that makes the problem free of them, and say how you know that its result keeps the limits.
#
# <details markdown="1"><summary>Answer</summary>
#
# `lambda x: problem.value(x) + weight * problem.violation(x)` is such a line. If `weight` is larger than every multiplier of the constraints, the minimum keeps
# all of them. You do not know the multipliers, so double `weight` until `problem.violation` of the result is zero.
#
# </details>
