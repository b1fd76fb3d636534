"""What designs of excitation motions reach, and what they cost.

Robot: rail + TX90L, rigid bodies (seven parameters each: 44 base parameters; ten: 57), viscous and
Coulomb friction, rotors; joint limits as in `jid.robots.tx90l_on_rail()`. Five harmonics at
0.8 rad/s, 800 samples of one period without its end point, noise 1 % of the largest forces, 32
starts. Violation: largest relative excess of position, velocity and acceleration on 8000 points.

* cond: the condition number of the unweighted information (Eq. 36), by JAX alone and polished.
* gain: standard deviations of weighted least squares of random motions over those of the designed
  one: geometric mean over the parameters, mean over 15 random motions (`random_fourier_series`,
  seeds 0 to 14, at full reach).
* panda: D-optimal designs of the Panda, limits of its library entry.
* gradients, constraints: by scaled numbers at a random motion, against central differences of
  fourth order of values that NumPy computes from singular values (criteria, at the step of 1e-4,
  5e-5, 2.5e-5 and 1.25e-5 that agrees best with the one before it) or of the same values
  (constraints, each value by itself at 7 instants): norm of the difference over the gradient's.
  Values whose quotients of two steps disagree have a kink there, and are counted apart.
* step: one value and gradient against forward differences of the same function, 800 samples.
* batch: starts per second of one evaluation of value and gradient, and of a whole search.

Statistics over the keys: median and best. CPU seconds are those of the process; the first key's
compile, the others find what was compiled.

    python benchmarks/excitation.py cond d7 d10 panda gradients constraints step batch [--quick]
"""

import argparse
import itertools
import time

import jax
import numpy as np

import jaxid as jid
from jaxid.dynamics.compiled import acting_columns, regressor_rows
from jaxid.excitation.information import information
from jaxid.excitation.limits import JointLimits
from jaxid.excitation.plan import CRITERIA, deviations
from jaxid.excitation.problem import CHECKED, Context, Problem
from jaxid.excitation.search import LAST, LEGS, Search, random_starts
from jaxid.excitation.spectral import log_condition, log_largest_inverse
from jaxid.trajectory.basis import FourierBasis

RANDOM = range(15)
H = 1e-4
"""Step of difference quotients, in scaled numbers."""
STEPS = (H, H / 2, H / 4, H / 8)
"""Of criteria: the smaller of the two neighbours that agree best is taken."""
KINK = 1e-4
"""Relative difference of the quotients of two steps from which there is no derivative."""


def base_of(principal_axes):
    terms = (
        jid.RigidBodies(principal_axes=principal_axes),
        jid.ViscousFriction(),
        jid.CoulombFriction(),
        jid.RotorInertia(),
    )
    return jid.base_parameters(jid.Model(jid.robots.tx90l_on_rail(), terms=terms))


def violation(plan):
    own, duration = plan.limits.limits, plan.limits.basis.duration
    motion = plan.trajectory.motion(np.arange(8000) * duration / 8000)
    q, qd, qdd = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd))
    half = (own.position_max - own.position_min) / 2
    return max(
        ((q - own.position_max) / half).max(),
        ((own.position_min - q) / half).max(),
        (np.abs(qd) / own.velocity - 1).max(),
        (np.abs(qdd) / own.acceleration - 1).max(),
    )


def gain_over_random(plan):
    base, weights = plan.base, 1 / np.asarray(plan.noise)
    logs = []
    for seed in RANDOM:
        series = jid.random_fourier_series(base.model.robot, omega=0.8, reach=1.0, seed=seed)
        motion = series.motion(plan.limits.basis.times(plan.samples))
        random = deviations(information(base, motion, weights).weighted)
        logs.append(np.mean(np.log(random / plan.standard_deviations)))
    return float(np.exp(np.mean(logs)))


def designed(base, criterion, keys, measure, polish, asked):
    found = []
    for key in keys:
        wall, cpu = time.perf_counter(), time.process_time()
        plan = jid.design_excitation(
            base,
            criterion=criterion,
            starts=asked.starts,
            generations=asked.generations,
            polish=polish,
            key=jax.random.key(key),
        )
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        found.append(measure(plan))
        print(
            f"  key {key}, polish {polish}: {found[-1]:.6g}, "
            f"criterion {criterion.value(plan.information):.5g}, violation {violation(plan):.1e}, "
            f"wall {wall:.1f} s, CPU {cpu:.1f} s",
            flush=True,
        )
    return found


def report(name, found, best):
    print(f"{name}: median {np.median(found):.5g}, best {best(found):.5g}", flush=True)


def cond(keys, asked):
    base = base_of(True)
    for polish in asked.polish:
        found = designed(
            base,
            jid.ConditionNumber(),
            keys,
            lambda p: np.linalg.cond(p.information.plain),
            polish,
            asked,
        )
        report(f"cond, {asked.generations} generations, polish {polish}", found, min)


def d_optimal(principal_axes, keys, asked):
    base = base_of(principal_axes)
    for polish in asked.polish:
        found = designed(base, jid.DOptimal(), keys, gain_over_random, polish, asked)
        what = f"D gain, {base.size} base parameters, {asked.generations} generations"
        report(f"{what}, polish {polish}", found, max)


def panda(keys, asked):
    base = jid.base_parameters(jid.Model(jid.robots.panda()))
    for criterion in (jid.DOptimal(), jid.ConditionNumber()):
        found = designed(
            base, criterion, keys, lambda p, c=criterion: c.value(p.information), 0, asked
        )
        report(f"Panda, {criterion.name}, JAX alone", found, min)


def problem_of(base, criterion, constraints=()):
    robot = base.model.robot
    limits = JointLimits.of(robot, FourierBasis(5, 0.8))
    random = limits.numbers(np.asarray(random_starts(limits, jax.random.key(0), 1))[0])
    motion = limits.basis.trajectory(random).motion(limits.basis.times(800))
    weights = 100 / np.asarray(robot.max_forces)
    return Problem(
        base,
        limits,
        criterion,
        constraints,
        weights=weights,
        prior=np.zeros((base.size, base.size)),
        sizes=1 / np.sqrt(np.diag(information(base, motion, weights).weighted)),
        measured=800,
    )


def differences(value, y, h):
    """Central differences of fourth order: neither rounding nor truncation matters."""
    slopes = []
    for k in range(len(y)):
        e = np.zeros_like(y)
        e[k] = h
        near, far = (value(y + m * e) - value(y - m * e) for m in (1, 2))
        slopes.append((8 * near - far) / (12 * h))
    return np.array(slopes).T


def steadiest(value, y):
    """Quotients of the step at which truncation and rounding matter least, by themselves."""
    found = [differences(value, y, h) for h in STEPS]
    changes = [np.linalg.norm(b - a) for a, b in itertools.pairwise(found)]
    best = int(np.argmin(changes))
    return found[best + 1], changes[best] / np.linalg.norm(found[best + 1])


def logs_of(problem, criterion, y, samples):
    """Logarithms of the eigenvalues that a criterion looks at: from singular values, in NumPy.

    The information has the square of the regressor's condition number, so that differences of its
    own eigenvalues would drown in rounding.
    """
    motion = problem.basis.trajectory(problem.limits.numbers(y)).motion(
        problem.basis.times(samples)
    )
    rows = regressor_rows(problem.base, motion)
    theta = np.zeros((len(rows), samples, problem.base.size))
    for joint, (own, part) in enumerate(zip(acting_columns(problem.base), rows, strict=True)):
        theta[joint, :, list(own)] = part.T
    if criterion.weighted:
        theta = problem.weights[:, None, None] * theta
    theta = np.sqrt(problem.measured / samples) * theta.reshape(-1, problem.base.size)
    lengths = np.ones(problem.base.size)
    if criterion in (jid.ScaledConditionNumber(), jid.DOptimal()):
        lengths = np.linalg.norm(theta, axis=0)
        theta = theta / lengths
    if criterion in (jid.AOptimal(), jid.EOptimal()):
        theta = theta * problem.sizes
    logs = 2 * np.log(np.linalg.svd(theta, compute_uv=False)[::-1])
    # The determinant factors, and keeps more digits without the columns' lengths.
    return logs + 2 * np.mean(np.log(lengths)) if criterion == jid.DOptimal() else logs


def of_logs(criterion, logs, sharpness):
    if criterion == jid.DOptimal():
        return -0.5 * np.mean(logs)
    if criterion == jid.AOptimal():
        return 0.5 * np.log(np.mean(np.exp(-logs)))
    if criterion == jid.EOptimal():
        return 0.5 * float(log_largest_inverse(logs, sharpness))
    return float(log_condition(logs, sharpness))


def gradients():
    base, worst = base_of(True), 0.0
    for criterion in CRITERIA:
        for sharpness in (8.0, None) if criterion.extreme else (None,):
            problem = problem_of(base, criterion)
            evaluate = jax.jit(problem.objective(64))
            y = np.asarray(random_starts(problem.limits, jax.random.key(1), 1))
            context = Context(sharpness, np.zeros((1, 0), int))
            g = np.asarray(evaluate(y, context)[1])[0]

            def value(z, problem=problem, criterion=criterion, sharpness=sharpness):
                return of_logs(criterion, logs_of(problem, criterion, z, 64), sharpness)

            slopes, unsteady = steadiest(value, y[0])
            error = np.linalg.norm(slopes - g) / np.linalg.norm(g)
            worst = max(worst, error)
            print(
                f"{criterion.name}, sharpness {sharpness}: {error:.1e}, quotients of two steps "
                f"differ by {unsteady:.1e}",
                flush=True,
            )
    print(f"worst: {worst:.1e}")


def constraint_gradients():
    base = base_of(True)
    nominal = jid.NominalForces.of(base, np.random.default_rng(0).uniform(0.5, 2.0, base.size))
    for constraint in (
        jid.Clearance(jid.robots.tx90l_on_rail_collision()),
        jid.TipSpeed(1.0),
        jid.TipAcceleration(5.0),
        jid.Workspace.of([-1.0, -1.0, 0.0], [1.0, 1.0, 1.5]),
        jid.JointForces(nominal),
    ):
        problem = problem_of(base, jid.DOptimal(), (constraint,))
        y = np.asarray(random_starts(problem.limits, jax.random.key(1), 1))[0]
        evaluate, instants = jax.jit(problem.constrained), np.arange(0, CHECKED, CHECKED // 7)
        exact = np.asarray(evaluate(y, instants)[1]).reshape(-1, len(y))

        def value(z, f=evaluate, t=instants):
            return np.asarray(f(z, t)[0]).ravel()

        found, closer = differences(value, y, H), differences(value, y, H / 4)
        sizes = np.linalg.norm(exact, axis=1)
        # What a motion does not change has no gradient to compare with.
        sizes = np.maximum(sizes, 1e-6 * sizes.max())
        # Where quotients of two steps disagree there is a kink between them: axes that cross.
        smooth = np.linalg.norm(found - closer, axis=1) < KINK * sizes
        errors = (np.linalg.norm(found - exact, axis=1) / sizes)[smooth]
        print(
            f"{type(constraint).__name__}, {len(errors)} values, {np.sum(~smooth)} more at kinks: "
            f"{errors.max():.1e}",
            flush=True,
        )


def step():
    problem = problem_of(base_of(True), jid.ConditionNumber())
    evaluate = jax.jit(problem.objective(800))
    context = Context(8.0, np.zeros((1, 0), int))
    value = jax.jit(lambda y: problem.objective(800)(y, context)[0])
    y = random_starts(problem.limits, jax.random.key(1), 1)
    size = y.shape[1]

    def exact():
        return jax.block_until_ready(evaluate(y, context))

    def forward():
        f = value(y)
        return [float((value(y.at[0, k].add(1e-6)) - f)[0]) for k in range(size)]

    times = {}
    for run in (exact, forward):
        run()
        times[run.__name__] = []
    for _ in range(7):
        for run in (exact, forward):
            start = time.perf_counter()
            run()
            times[run.__name__].append(time.perf_counter() - start)
    a, b = (np.median(times[k]) for k in ("exact", "forward"))
    print(f"step: exact {1e3 * a:.2f} ms, forward differences {1e3 * b:.1f} ms: {b / a:.0f}x")


def batch(sizes):
    problem = problem_of(base_of(True), jid.DOptimal())
    iterations = sum(leg.stage.iterations for leg in (*LEGS, LAST))
    for starts in sizes:
        search = Search(problem, starts, 0)
        for _ in range(2):  # the first one compiles
            wall, cpu = time.perf_counter(), time.process_time()
            state = search.begin(jax.random.key(0))
            while state.leg < search.legs:
                state = search.advance(state, jax.random.key(0))
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(
            f"batch of {starts}: {starts / wall:.2f} starts per second of {iterations} iterations "
            f"({wall:.2f} s, CPU {cpu:.2f} s)",
            flush=True,
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["cond", "d7"])
    parser.add_argument("--keys", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first key")
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--generations", type=int, default=12)
    parser.add_argument("--polish", type=int, nargs="+", default=[0, 4], help="0: JAX alone")
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jid.keep_compiled()
    if asked.quick:
        asked.parts, asked.keys = ["d7"], 1
        asked.starts, asked.generations, asked.polish = 2, 1, [0, 1]
    keys = range(asked.first, asked.first + asked.keys)
    sizes = (1, 8, 64) if jax.default_backend() == "cpu" else (64, 512, 4096)
    parts = {
        "cond": lambda: cond(keys, asked),
        "d7": lambda: d_optimal(True, keys, asked),
        "d10": lambda: d_optimal(False, keys, asked),
        "panda": lambda: panda(keys, asked),
        "gradients": gradients,
        "constraints": constraint_gradients,
        "step": step,
        "batch": lambda: batch(sizes),
    }
    for part in asked.parts:
        parts[part]()


if __name__ == "__main__":
    main()
