"""Physically consistent fits: optima of a conic solver, proofs, times, definiteness.

    python benchmarks/consistency.py [--quick] [--only optimum proofs stress times
        weights]

* `optimum`: the objective against CLARABEL's (through cvxpy, tolerances 1e-9; the same
  problem as written in `references/conic.py`). Data: whole logs of TX40, UR10, KR300,
  prepared by the files in `tests/real_data` (skipped where `../shared/data` is
  missing), and 50 simulated arms (Panda, UR10, TX40 with coupled drives, TX90L on its
  rail, in turn) with noise from 0 to 20 % of each joint's RMS force. Statistic:
  difference over max(objective, rows / 2).
* `proofs`: 1000 simulated fits of these arms, noise uniform from 0 to 20 %, compiled.
  Statistics: fits whose error bound stays above 2.5e-7 of objective + rows / 2,
  iterations, and the smallest eigenvalue of M over 2000 random poses of every fit.
* `stress`: 400 more in NumPy: in turn bounds divided by 100, bounds times 100, ten
  samples, 100 % noise, and bounds that exclude the truth.
* `times`: Panda, 98 parameters, 5 % noise: one warm compiled fit against the time that
  CLARABEL reports for its own work, in turn, medians; and 256 data sets in one call,
  set-up included.

Bodies are clouds of points along the links; columns are those of ten parameters per
body, viscous and Coulomb friction, rotors and offsets, of one random Fourier motion
with 500 samples; joints weigh by their RMS force; noise is white. Keys: [trial, 1]
truth, [trial, 2] noise, [trial, 3] its strength, [number of standard parameters, 4]
poses. Bounds are those of `BodyBounds.from_geometry`.

* `weights`: effect of weights and bounds on the mass matrix (paper, Figs. 6 and 7),
  over 100 trials of the virtual TX90L on its rail with seven parameters per body and
  its disturbances. Each trial has two random Fourier motions of 20 s at 100 Hz, of the
  seeds 2 trial and 2 trial + 1: one to identify with, one to verify with. Statistics:
  trials with a positive definite mass matrix in 2000 random poses; RMS error over RMS
  force on the other motion, axes 1, 5 and 7, median.
"""

import statistics
from functools import partial

import timing
from timing import DATA, EXPERIMENTS, Row, hand_over

ROBOTS = ("panda", "ur10", "tx40", "tx90l_on_rail")
LOGS = {
    "tx40": ("tx40_100hz.toml", "tx40/motor_position.csv"),
    "ur10": ("ur10.toml", "ur10/exciting_measured.csv"),
    "kr300": ("kr300.toml", "kr300/traj_A.csv"),
}
SAMPLES = 500
WAYS = (
    "bounds / 100",
    "bounds x 100",
    "ten samples",
    "100 % noise",
    "bounds exclude the truth",
)


class Arm:
    """Robot with one random motion, whose columns are those of all trials."""

    def __init__(self, name):
        import numpy as np

        import jaxid as jid

        robot = getattr(jid.robots, name)()
        terms = [
            jid.RigidBodies(),
            jid.ViscousFriction(),
            jid.CoulombFriction(),
            jid.RotorInertia(),
            jid.ConstantOffset(),
        ]
        if name == "tx40":
            terms.append(jid.terms.CoupledDrives())
        self.model = jid.Model(robot, tuple(terms))
        self.base = jid.base_parameters(self.model)
        motion = jid.trajectories.random_fourier_series(
            robot, omega=0.8, seed=0
        ).motion(np.linspace(0, 7.8, SAMPLES, endpoint=False))
        self.theta = np.asarray(self.base.regressor(motion))

    def truth(self, trial):
        """Return standard parameters of possible bodies and of drives that brake."""
        import numpy as np

        import jaxid as jid

        rng = np.random.default_rng([trial, 1])
        robot = self.model.robot
        heavy = np.geomspace(8.0, 1.0, robot.joints) * rng.uniform(
            0.7, 1.3, robot.joints
        )
        bodies = jid.simulation.random_bodies(robot, heavy, rng).ravel()
        scales = {"fv": 4.0, "fc": 6.0, "Ia": 1.0, "fo": 1.0}
        p = np.array(
            [
                0.05
                if name[2:3] == "m"
                else scales.get(name[:2], 0.1) * rng.uniform(0.2, 1.0)
                for name in self.model.parameter_names
            ]
        )
        p[: len(bodies)] = bodies
        return p

    def factor(self, trial, noise, samples=None):
        """Return triangle, right-hand side and number of rows of one trial."""
        import numpy as np

        theta = (
            self.theta if samples is None else self.theta[:: len(self.theta) // samples]
        )
        truth = np.asarray(self.base.from_standard(self.truth(trial)))
        scale = np.sqrt(np.mean((self.theta @ truth) ** 2, axis=0))
        forces = theta @ truth / scale
        forces += noise * np.random.default_rng([trial, 2]).standard_normal(
            forces.shape
        )
        rows = (theta / scale[:, None]).reshape(-1, self.base.size)
        R = np.linalg.qr(np.column_stack([rows, forces.ravel()]), mode="r")
        return R[:, :-1], R[:, -1], len(rows)

    def stressed(self, trial):
        """Return a data set and an estimator of a hard fit, in one of five ways."""
        import jaxid as jid

        robot, way = self.model.robot, trial % 5
        bounds = jid.consistency.BodyBounds.from_geometry(robot)
        if way < 2:
            factor = (0.01, 100.0)[way]
            bounds = bounds.replace(
                mass_max=factor * bounds.mass_max, radius=factor * bounds.radius
            )
        if way == 4:
            truth = self.truth(trial)[: 10 * robot.joints].reshape(-1, 10)
            bounds = bounds.replace(mass_max=0.5 * truth[:, 0])
        noise, samples = (1.0 if way == 3 else 0.05), (10 if way == 2 else None)
        return self.factor(trial, noise, samples), jid.PhysicallyConsistent(
            bounds=bounds
        )


def program(base, factor, estimator):
    """Return feasible set, data and program of one fit."""
    feasible = estimator.feasible_set(base)
    data, one = estimator.program(base, feasible, *factor)
    return feasible, data, one


def measured(name):
    """Return base parameters and weighted factor of a measured robot's log."""
    import jaxid as jid

    file, log = LOGS[name]
    loaded = jid.experiment.load_experiment(EXPERIMENTS / file)
    setup = loaded.setup
    recording = jid.workflow.read_log(setup, DATA / log, loaded.columns)
    factors = jid.RegressionProblem(setup.base, (setup.observe(recording),)).factors
    weights = 1.0 / (factors.force_squares / factors.rows) ** 0.5
    return setup.base, (*factors.weighted(weights), int(factors.rows.sum()))


def optimum(arms, quick):
    """Compare objectives with those of the conic solver."""
    from references import conic

    import jaxid as jid

    estimator, cases = jid.PhysicallyConsistent(), {}
    if DATA.is_dir():
        cases = {
            f"{name}'s log": measured(name) for name in (("ur10",) if quick else LOGS)
        }
    count = 4 if quick else 50
    simulated = f"{count} simulated arms"
    found = {name: [] for name in (*cases, simulated)}
    for k in range(count):
        arm = arms[k % len(arms)]
        cases[f"{k}"] = arm.base, arm.factor(k, 0.2 * k / (count - 1))
    for name, case in cases.items():
        feasible, data, one = program(*case, estimator)
        ours = jid.consistency.solve_in_numpy(one)
        value, _ = conic.optimum(feasible, data)
        apart = abs(float(ours.value) - value) / max(value, float(data.scale))
        found[name if name in found else simulated].append((apart, ours))
    recipe = "CLARABEL through cvxpy, tolerances 1e-9"
    rows = []
    for name, results in found.items():
        worst = max(apart for apart, _ in results)
        proved = sum(bool(ours.certified) for _, ours in results)
        most = max(int(ours.iterations) for _, ours in results)
        said = (
            f"{worst:.1e}; {proved} of {len(results)} proved, at most {most} iterations"
        )
        holds = worst <= 1e-6 and proved == len(results) and most <= 30
        rows.append(
            Row(
                "P1",
                f"objective, {name}",
                recipe,
                "<= 1e-6, proved, <= 30",
                said,
                holds,
            )
        )
    return rows


def inertias(arm, poses):
    """Return the part of each base parameter in mass matrices of random poses."""
    import jax
    import numpy as np

    limits = arm.model.robot.limits
    low = np.where(np.isfinite(limits.position_min), limits.position_min, -np.pi)
    high = np.where(np.isfinite(limits.position_max), limits.position_max, np.pi)
    q = np.random.default_rng([arm.model.size, 4]).uniform(low, high, (poses, len(low)))
    units = jax.numpy.eye(arm.base.size)
    return np.moveaxis(
        np.asarray(jax.vmap(lambda u: arm.base.mass_matrix(u, q))(units)), 0, -1
    )


def proofs(arms, quick):
    """Count fits without proof and iterations; find the mass matrix's eigenvalues."""
    import numpy as np

    import jaxid as jid

    simulated, poses = (6, 100) if quick else (1000, 2000)
    iterations, unproved, smallest = [], 0, np.inf
    for place, arm in enumerate(arms):
        trials = range(place, simulated, len(arms))
        noises = [0.2 * np.random.default_rng([k, 3]).random() for k in trials]
        factors = [
            arm.factor(k, noise) for k, noise in zip(trials, noises, strict=True)
        ]
        R, z, rows = (np.array([f[k] for f in factors]) for k in range(3))
        found = jid.consistency.consistent_batch(arm.base, R, z, rows)
        iterations += np.asarray(found.iterations).tolist()
        unproved += int(np.sum(~np.asarray(found.certified)))
        parts = inertias(arm, poses)
        for p in np.asarray(found.parameters):
            smallest = min(smallest, float(np.linalg.eigvalsh(parts @ p).min()))
    good = unproved == 0 and max(iterations) <= 30
    recipe = f"noise uniform from 0 to 20 %, {len(arms)} arms in turn"
    return [
        Row(
            "P2",
            "simulated fits without proof",
            recipe,
            "0, <= 30 iterations",
            counted(unproved, iterations),
            good,
        ),
        Row(
            "P3",
            "smallest eigenvalue of M [SI]",
            f"{poses} random poses, each of the {simulated} simulated fits",
            "> 0",
            f"{smallest:.2g}",
            smallest > 0,
        ),
    ]


def stress(arms, quick):
    """Count fits without proof, and iterations, where fits are hard."""
    import jaxid as jid

    iterations, failures = [], dict.fromkeys(WAYS, 0)
    for k in range(10 if quick else 400):
        arm = arms[(k // len(WAYS)) % len(arms)]
        found = jid.consistency.solve_in_numpy(program(arm.base, *arm.stressed(k))[2])
        iterations.append(int(found.iterations))
        failures[WAYS[k % len(WAYS)]] += not found.certified
    lost = sum(failures.values())
    detail = "; ".join(f"{way}: {bad}" for way, bad in failures.items() if bad)
    said = counted(lost, iterations) + (f" ({detail})" if detail else "")
    return [
        Row(
            "P4",
            "stressed fits without proof",
            ", ".join(WAYS),
            "0, <= 30 iterations",
            said,
            lost == 0 and max(iterations) <= 30,
        )
    ]


def counted(lost, iterations):
    """Return fits without proof, and iterations, in words."""
    median = int(statistics.median(iterations))
    return (
        f"{lost} of {len(iterations)}; iterations median {median}, most "
        f"{max(iterations)}"
    )


def times(arms, quick):
    """Time one fit, the conic solver's, and many."""
    import jax
    import numpy as np
    from references import conic

    import jaxid as jid

    arm, estimator = arms[0], jid.PhysicallyConsistent()
    count, turns, many = (2, 2, 8) if quick else (10, 15, 256)
    factors = [arm.factor(k, 0.05) for k in range(many)]
    cases = [program(arm.base, f, estimator) for f in factors[:count]]
    programs = [jax.tree.map(jax.numpy.asarray, one) for _, _, one in cases]
    problems = [conic.problem(feasible, data)[0] for feasible, data, _ in cases]
    solve = jax.jit(jid.consistency.ConsistentSolver(arm.base, estimator).__call__)

    def finished(work, *arguments):
        return jax.block_until_ready(work(*arguments))

    def timed(work, *arguments):
        return timing.elapsed(partial(finished, work, *arguments))[1]

    solve_compiled = jid.consistency.solve_compiled
    finished(solve_compiled, programs[0])
    finished(solve, *factors[0])

    def conic_time(problem):
        problem.solve("CLARABEL")
        return problem.solver_stats.solve_time

    # A turn takes all data sets with one solver, then with the next: each runs warm.
    ways = (
        [partial(timed, solve_compiled, one) for one in programs],
        [partial(timed, solve, *factor) for factor in factors[:count]],
        [partial(conic_time, problem) for problem in problems],
    )
    found = np.array([[[run() for run in way] for way in ways] for _ in range(turns)])
    R, z, rows = (np.array([f[k] for f in factors]) for k in range(3))

    def batch():
        return finished(
            jid.consistency.consistent_batch, arm.base, R, z, rows, estimator
        )

    many_fits = batch()
    spent = [timing.elapsed(batch)[1] for _ in range(3 if quick else 9)]
    one, whole, reference = np.median(found, axis=(0, 2))
    by_turn = np.median(found, axis=2)
    ratios = by_turn[:, 2] / by_turn[:, 0]
    ratio, all_of_them = np.median(ratios), np.median(spent)
    lost = int(np.sum(~np.asarray(many_fits.certified)))
    recipe = (
        f"Panda, {arm.model.size} parameters, 5 % noise, {count} data sets one after "
        f"another, {turns} turns of both solvers; medians"
    )
    return [
        Row(
            "P5",
            "one fit, warm",
            recipe,
            "<= 2.5 ms",
            f"{1e3 * one:.2f} ms (best {1e3 * found[:, 0].min():.2f}); from triangle "
            f"to parameters {1e3 * whole:.2f} ms",
            one <= 2.5e-3,
        ),
        Row(
            "P6",
            "against CLARABEL's own time",
            recipe,
            ">= 3x",
            f"{ratio:.1f}x, turns {ratios.min():.1f} to {ratios.max():.1f} "
            f"({1e3 * reference:.2f} ms)",
            ratio >= 3,
        ),
        Row(
            "P7",
            f"{many} fits in one call",
            "two cores, set-up included",
            "<= 0.5 s",
            f"{all_of_them:.2f} s (best {min(spent):.2f}), {lost} without proof",
            all_of_them <= 0.5 and lost == 0,
        ),
    ]


def weights(_, quick):
    """Count trials with a positive definite mass matrix, by estimator."""
    import numpy as np

    import jaxid as jid

    virtual, count = jid.simulation.virtual_tx90l_on_rail(), 1 if quick else 100
    base, robot = jid.base_parameters(virtual.model), virtual.robot
    estimators = {
        "unweighted": jid.estimators.LeastSquares(),
        "weighted": jid.WeightedLeastSquares(),
        "physically consistent": jid.PhysicallyConsistent(),
    }
    indefinite, errors = ({name: [] for name in estimators} for _ in range(2))
    smooth = jid.ZeroPhaseButterworth(8.0), jid.Subsample(5)
    for trial in range(count):
        logs = []
        for seed in (2 * trial, 2 * trial + 1):
            motion = jid.trajectories.random_fourier_series(
                robot, omega=0.6, reach=0.9, seed=seed
            )
            recording = virtual.measure(
                motion, duration=20.0, sample_time=0.01, seed=seed
            )
            logs.append(jid.observe(recording, robot, *smooth))
        for name, estimator in estimators.items():
            check = jid.validate(jid.identify(base, logs[0], estimator), [logs[1]])
            indefinite[name].append(check.definiteness.indefinite)
            errors[name].append(np.asarray(check.errors[0].rms_relative))
    rows = []
    for name, fractions in indefinite.items():
        good = sum(fraction == 0.0 for fraction in fractions)
        typical = 100 * np.median(errors[name], axis=0)
        said = ", ".join(
            f"{typical[axis]:.0f} % (axis {axis + 1})" for axis in (0, 4, 6)
        )
        holds = good == count if name == "physically consistent" else None
        recipe = (
            f"TX90L on its rail, {count} trials, 2000 poses each; errors on "
            "another motion"
        )
        said = f"{good} of {count} trials; errors {said}"
        rows.append(Row("W", f"M positive definite, {name}", recipe, "-", said, holds))
    return rows


STUDIES = {
    "optimum": optimum,
    "proofs": proofs,
    "stress": stress,
    "times": times,
    "weights": weights,
}


def main():
    """Run the selected studies."""
    parser = timing.parser(__doc__, "few trials of two arms")
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES))
    options = parser.parse_args()
    timing.pin_to(2)
    names = ROBOTS[:: 2 if options.quick else 1]
    arms = [Arm(name) for name in (names[:1] if options.only == ["times"] else names)]
    hand_over(
        [row for name in options.only for row in STUDIES[name](arms, options.quick)],
        options.json,
    )


if __name__ == "__main__":
    main()
