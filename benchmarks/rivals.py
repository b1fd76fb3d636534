"""Other optimizers on the design problem, in the time that a whole design takes.

    python benchmarks/rivals.py [--seconds 30] [--only slsqp cma evolution] [--quick]

Problem: condition number of Eq. 36, robot, series, limits and samples as in `excitation.py`. The
budget of each optimizer is the CPU time of a whole design (32 starts, 8 generations, 4 polished,
one key; its second run, so that nothing is compiled); compile time is not counted for anybody.

* SLSQP with forward differences, 800 samples, from the best of 15 random motions.
* CMA-ES (`pip install cma`) and differential evolution (SciPy): populations evaluated in one
  compiled call on 64 samples; every candidate is scaled into the limits, without penalties.

All results are scaled into their limits at all times and evaluated on 800 samples.
"""

import contextlib
import time

import jax
import numpy as np
import scipy.optimize
import timing
from excitation import base_of

import jaxid as jid

SEED = 0


class OutOfTimeError(Exception):
    """The budget is used up."""


class Rivals:
    """Functions of the problem for other optimizers."""

    def __init__(self, starts):
        self.problem = jid.ExcitationProblem(base_of(True), None, None, CRITERION)
        grid = self.problem.limits.grid()
        self.restore = jax.jit(jax.vmap(grid.scale_into_limits))
        self.starts = np.asarray(self.problem.limits.random(jax.random.key(SEED), starts))
        self.restored = jax.jit(lambda x: self.problem.values(self.restore(x), None, 64))
        self.value = jax.jit(self.problem.value)
        self.limits = jax.jit(self.problem.inequalities)
        self.slopes = np.asarray(jax.jacfwd(self.problem.inequalities)(self.starts[0]))

    def condition(self, x):
        """Return the condition number on 800 samples, within all limits."""
        return float(np.exp(self.value(self.restore(np.asarray(x)[None])[0])))

    def best_start(self):
        """Return the best of the random motions."""
        return self.starts[int(np.argmin([self.condition(x) for x in self.starts]))]


CRITERION = jid.criteria.ConditionNumber()


class Watch:
    """Budget that stops an optimizer, and its best candidate."""

    def __init__(self, seconds):
        self.end, self.last, self.calls = time.process_time() + seconds, None, 0

    def __call__(self, x, calls=1):
        """Count evaluations."""
        self.last, self.calls = np.array(x), self.calls + calls
        if time.process_time() > self.end:
            raise OutOfTimeError


def slsqp(rivals, watch, start):
    """Run SLSQP with forward differences."""

    def value(x):
        watch(x)
        return float(rivals.value(x))

    # Limits of the joints are linear in the scaled coefficients.
    kept = {"fun": lambda x: -np.asarray(rivals.limits(x)), "jac": lambda _: -rivals.slopes}
    options = {"maxiter": 10_000, "ftol": 1e-9}
    constraints = [{"type": "ineq"} | kept]
    scipy.optimize.minimize(value, start, method="SLSQP", constraints=constraints, options=options)


def population(rivals, watch):
    """Return a function of a population that remembers the best candidate."""
    best = [np.inf, None]

    def values(x):
        found = np.asarray(rivals.restored(np.ascontiguousarray(x)))
        k = int(np.argmin(found))
        if found[k] < best[0]:
            best[:] = found[k], np.array(x[k])
        watch(best[1], len(x))
        return found

    return values


def evolution(rivals, watch, start):
    """Run differential evolution."""
    members = 96
    first = np.random.default_rng(SEED).uniform(-1, 1, (members, len(start)))
    first[: len(rivals.starts)] = rivals.starts[:members]
    values = population(rivals, watch)
    scipy.optimize.differential_evolution(
        lambda x: values(x.T),
        [(-1, 1)] * len(start),
        init=first,
        vectorized=True,
        updating="deferred",
        polish=False,
        maxiter=10**6,
        tol=0.0,
        rng=SEED,
    )


def cma(rivals, watch, start):
    """Run CMA-ES."""
    import cma as package

    search = package.CMAEvolutionStrategy(start, 0.2, {"seed": SEED + 1, "verbose": -9})
    values = population(rivals, watch)
    while True:
        x = np.array(search.ask())
        search.tell(list(x), values(x).tolist())


RIVALS = {"slsqp": slsqp, "cma": cma, "evolution": evolution}


def own_seconds():
    """Return the CPU seconds of a whole design, compiled before."""
    base, settings = base_of(True), {"starts": 32, "generations": 8, "polish": 4}
    for _ in range(2):
        cpu = time.process_time()
        plan = jid.design_excitation(
            base, criterion=CRITERION, key=jax.random.key(SEED), **settings
        )
        cpu = time.process_time() - cpu
    print(f"whole design: cond {np.linalg.cond(plan.information.plain):.5g}, {cpu:.1f} CPU s")
    return cpu


def main():
    """Run the selected optimizers."""
    parser = timing.parser(__doc__, "SLSQP, for one second")
    parser.add_argument("--only", nargs="*", default=list(RIVALS), choices=list(RIVALS))
    parser.add_argument("--seconds", type=float, help="CPU seconds of each; those of our design")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jid.keep_compiled()
    if options.quick:
        options.only, options.seconds = ["slsqp"], 1.0
    seconds = own_seconds() if options.seconds is None else options.seconds
    rivals = Rivals(15)
    start = rivals.best_start()
    print(f"best of 15 random motions: cond {rivals.condition(start):.5g}", flush=True)
    for name in options.only:
        if name == "cma" and timing.missing("cma"):
            print(timing.missing("cma"))
            continue
        rivals.value(start), rivals.restored(rivals.starts), rivals.limits(start)
        watch = Watch(seconds)
        with contextlib.suppress(OutOfTimeError):
            RIVALS[name](rivals, watch, start)
        said = f"cond {rivals.condition(watch.last):.5g}, {watch.calls} evaluations"
        print(f"{name}: {said} in {seconds:.1f} CPU seconds", flush=True)


if __name__ == "__main__":
    main()
