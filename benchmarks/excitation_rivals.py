"""What other optimizers reach in the time that a whole design takes, on the same problem.

Robot, series, limits, samples and criterion (the condition number of Eq. 36) as in `excitation.py`.
The budget of each rival is the CPU time of the whole design (32 starts, 8 generations, 4 polished,
one key; its second run, so that nothing is compiled); compile time is not counted for anybody.

* SLSQP with forward differences, 800 samples, limits on 64 times for each order: what toolboxes do.
  From the best of 15 random motions.
* CMA-ES (`pip install cma`) and differential evolution (SciPy), the genetic alternative of the
  paper: populations evaluated in one compiled call on 64 samples; every candidate is put within the
  limits by the smallest change that the design uses too, so nothing is spent on penalties.
* IPOPT with exact gradients, limits on the same 64 times, from the same start, as CasADi brings it
  (`pip install casadi`).

All results are scaled into their limits at all times and judged on 800 samples.

    python benchmarks/excitation_rivals.py [--seconds 30] [--only slsqp cma ipopt] [--quick]
"""

import argparse
import contextlib
import importlib.util
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from excitation import base_of, problem_of

import jaxid as jid
from jaxid.excitation.limits import CERTIFIED, held_within
from jaxid.excitation.problem import Context
from jaxid.excitation.search import GRID, random_starts

SEED = 0


class OutOfTimeError(Exception):
    """The budget is used up."""


class Rivals:
    """The problem as other optimizers take it: a value, its limits, and the best so far."""

    def __init__(self, starts: int):
        self.problem = problem_of(base_of(True), jid.ConditionNumber())
        limits = self.problem.limits
        fine = limits.grid(CERTIFIED)
        within = partial(held_within, fine, limits.still, bound=fine.bound)
        self.restore = jax.jit(jax.vmap(lambda y: within(y)))
        self.starts = np.asarray(random_starts(limits, jax.random.key(SEED), starts))
        none = Context(None, np.zeros((1, 0), int))
        coarse, exact = self.problem.objective(64), self.problem.objective(800)
        self.repaired = jax.jit(lambda y: coarse(jax.vmap(within)(y), none)[0])
        self.value = jax.jit(lambda y: exact(y[None], none)[0][0])
        self.slope = jax.jit(lambda y: exact(y[None], none)[1][0])
        grid = limits.grid(GRID)
        joints, rows, k = grid.R.shape
        G = np.zeros((joints, rows, joints, k))
        G[range(joints), :, range(joints)] = grid.R
        self.G = G.reshape(joints * rows, -1)
        self.low, self.high = (sign * grid.bound + grid.c.ravel() for sign in (-1, 1))

    def judged(self, y: np.ndarray) -> float:
        """The condition number of 800 samples, within all limits."""
        x = self.problem.limits.numbers(np.asarray(self.restore(jnp.asarray(y)[None]))[0])
        return float(np.exp(self.problem.value(x)))

    def best_start(self) -> np.ndarray:
        """The best of the random motions."""
        return self.starts[int(np.argmin([self.judged(y) for y in self.starts]))]


class Watch:
    """Stops an optimizer when its CPU seconds are used up."""

    def __init__(self, seconds: float):
        self.end, self.last, self.calls = time.process_time() + seconds, None, 0

    def __call__(self, y: np.ndarray) -> None:
        """Counts an evaluation."""
        self.last, self.calls = np.array(y), self.calls + 1
        if time.process_time() > self.end:
            raise OutOfTimeError


def slsqp(rivals: Rivals, seconds: float) -> tuple[np.ndarray, int]:
    start = rivals.best_start()
    rivals.value(start)
    best, watch = start, Watch(seconds)
    limits = {"type": "ineq", "fun": None, "jac": None}
    G = np.vstack([rivals.G, -rivals.G])
    h = np.concatenate([rivals.high, -rivals.low])
    limits = {"type": "ineq", "fun": lambda y: h - G @ y, "jac": lambda y: -G}
    try:
        found = scipy.optimize.minimize(
            lambda y: (watch(y), float(rivals.value(y)))[1],
            start,
            method="SLSQP",
            constraints=[limits],
            options={"maxiter": 10_000, "ftol": 1e-9},
        )
        best = found.x
    except OutOfTimeError:
        best = watch.last
    return best, watch.calls


def evolution(rivals: Rivals, seconds: float) -> tuple[np.ndarray, int]:
    size, members = rivals.starts.shape[1], 96
    rng = np.random.default_rng(SEED)
    first = rng.uniform(-1, 1, (members, size))
    first[: len(rivals.starts)] = rivals.starts[:members]
    rivals.repaired(first)
    watch, best = Watch(seconds), [np.inf, first[0]]

    def values(y: np.ndarray) -> np.ndarray:
        found = np.asarray(rivals.repaired(np.ascontiguousarray(y.T)))
        k = int(np.argmin(found))
        if found[k] < best[0]:
            best[:] = found[k], np.array(y[:, k])
        watch(best[1])
        return found

    with contextlib.suppress(OutOfTimeError):
        scipy.optimize.differential_evolution(
            values,
            [(-1, 1)] * size,
            init=first,
            vectorized=True,
            updating="deferred",
            polish=False,
            maxiter=10**6,
            tol=0.0,
            rng=SEED,
        )
    return best[1], watch.calls * members


def cma(rivals: Rivals, seconds: float) -> tuple[np.ndarray, int]:
    import cma as package

    start = rivals.best_start()
    search = package.CMAEvolutionStrategy(start, 0.2, {"seed": SEED + 1, "verbose": -9})
    rivals.repaired(np.array(search.ask()))
    end, calls, best = time.process_time() + seconds, 0, (np.inf, start)
    while time.process_time() < end:
        asked = np.array(search.ask())
        found = np.asarray(rivals.repaired(asked))
        search.tell(list(asked), found.tolist())
        k, calls = int(np.argmin(found)), calls + len(asked)
        best = min(best, (float(found[k]), asked[k]), key=lambda pair: pair[0])
    return best[1], calls


def ipopt(rivals: Rivals, seconds: float) -> tuple[np.ndarray, int]:
    import casadi

    n, calls = rivals.starts.shape[1], [0]

    class Slope(casadi.Callback):
        def __init__(self):
            casadi.Callback.__init__(self)
            self.construct("slope", {})

        def get_n_in(self):
            return 2

        def get_sparsity_in(self, i):
            return casadi.Sparsity.dense(n if i == 0 else 1, 1)

        def get_sparsity_out(self, i):
            return casadi.Sparsity.dense(1, n)

        def eval(self, arguments):
            return [np.asarray(rivals.slope(np.array(arguments[0]).ravel()))[None]]

    slope = Slope()

    class Value(casadi.Callback):
        def __init__(self):
            casadi.Callback.__init__(self)
            self.construct("value", {})

        def get_sparsity_in(self, i):
            return casadi.Sparsity.dense(n, 1)

        def eval(self, arguments):
            calls[0] += 1
            return [float(rivals.value(np.array(arguments[0]).ravel()))]

        def has_jacobian(self):
            return True

        def get_jacobian(self, name, inputs, outputs, options):
            return slope

    value, y = Value(), casadi.MX.sym("y", n)
    start = rivals.best_start()
    rivals.value(start), rivals.slope(start)
    options = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.max_cpu_time": seconds,
        "ipopt.max_iter": 100_000,
    }
    posed = {"x": y, "f": value(y), "g": casadi.DM(rivals.G) @ y}
    solver = casadi.nlpsol("solver", "ipopt", posed, options)
    found = solver(x0=start, lbg=rivals.low, ubg=rivals.high)
    return np.array(found["x"]).ravel(), calls[0]


RIVALS = {"slsqp": slsqp, "cma": cma, "evolution": evolution, "ipopt": ipopt}
NEEDS = {"cma": "cma", "ipopt": "casadi"}


def own(starts: int, generations: int, polish: int) -> float:
    """CPU seconds of a whole design, compiled before."""
    base = base_of(True)
    for _ in range(2):
        cpu = time.process_time()
        plan = jid.design_excitation(
            base,
            criterion=jid.ConditionNumber(),
            starts=starts,
            generations=generations,
            polish=polish,
            key=jax.random.key(SEED),
        )
        cpu = time.process_time() - cpu
    cond = np.linalg.cond(plan.information.plain)
    print(f"whole design: cond {cond:.5g} in {cpu:.1f} CPU seconds", flush=True)
    return cpu


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=list(RIVALS), choices=list(RIVALS))
    parser.add_argument("--seconds", type=float, help="CPU seconds of each; those of our design")
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jid.keep_compiled()
    seconds = 1.0 if asked.quick else asked.seconds
    if seconds is None:
        seconds = own(32, 8, 4)
    rivals = Rivals(15)
    print(f"best of 15 random motions: cond {rivals.judged(rivals.best_start()):.5g}", flush=True)
    for name in ["slsqp"] if asked.quick else asked.only:
        if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
            print(f"{name}: not measured, `{NEEDS[name]}` is not installed", flush=True)
            continue
        y, calls = RIVALS[name](rivals, seconds)
        print(
            f"{name}: cond {rivals.judged(y):.5g} after {seconds:.1f} CPU seconds, "
            f"{calls} evaluations",
            flush=True,
        )


if __name__ == "__main__":
    main()
