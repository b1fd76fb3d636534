"""Designs of excitation motions: quality and cost, without and with constraints.

    python benchmarks/excitation.py [PART ...] [--quick] [--keys 3] ...

Robot: rail + TX90L, rigid bodies (seven parameters each: 44 base parameters; ten: 57),
viscous and Coulomb friction, rotors; joint limits of `jid.robots.tx90l_on_rail()`. Five
harmonics at 0.8 rad/s, 800 samples of one period without its end point, noise 1 % of
the largest forces, 32 starts. The violation is the largest relative excess of position,
velocity and acceleration on 8000 points. The gain of a motion is the geometric mean,
over the parameters, of the standard deviations of weighted least squares in a random
motion over those in this motion, and of that the mean over 15 random motions
(`random_fourier_series`, seeds 0 to 14, at full reach).

* cond: condition number of the unweighted information (Eq. 36). d7, d10: D-optimal
  designs for 44 and 57 parameters. panda: both criteria for the Panda.
* capsules-cond, capsules-d: at least 0.03 m between the robot's capsules and shapes; 8
  starts, 4 generations.
* rest: motions that start and stop at rest; 8 starts, 8 generations.
* forces: forces of the nominal parameters below, with a payload of 6 kg, at most 90 %
  of the limits; free: the same without this constraint.
* step: one value and gradient against forward differences of the same function, 800
  samples.
* batch: starts per second of a whole search.
* compiled: `CompiledSearch` with one generation, compiling and running apart, beside
  the search in NumPy from the same starts.

Median and best of the keys. CPU seconds are those of the process; the first key's
compile.
"""

import time

import jax
import numpy as np
import timing

import jaxid as jid

POINTS = 8000
MASSES = (250.0, 16.93, 14.35, 7.50, 6.42, 0.569, 0.031)
"""Masses of the carriage with its column (assumed) and of the six links (CAD) [kg]."""
RODS = (
    ((0.0, 0.0, 0.05), (0.0, 0.0, 0.45), 0.19),
    ((0.0, 0.0, -0.1), (0.0, 0.0, 0.1), 0.13),
    ((0.0, 0.0, 0.0), (0.0, -0.5, 0.0), 0.13),
    ((0.0, -0.05, 0.0), (0.0, 0.05, 0.0), 0.12),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.55), 0.12),
    ((0.0, -0.03, 0.0), (0.0, 0.03, 0.0), 0.05),
    ((0.0, 0.0, -0.02), (0.0, 0.0, 0.0), 0.03),
)
"""The bodies as uniform cylinders: ends of the axis and radius [m]."""
VISCOUS, COULOMB, ROTOR = 0.13, 0.05, 0.01
"""Friction and rotors as fractions of the largest force, per rad/s and per rad/s²."""
PAYLOAD = {"mass": 6.0, "centre_of_mass": (0.0, 0.0, 0.1)}
MARGIN, DISTANCE = 0.1, 0.03


def base_of(principal_axes, payload=False):
    """Return the TX90L's base parameters: 44 with principal axes, else 57."""
    robot = jid.robots.tx90l_on_rail()
    robot = robot.with_tool(**PAYLOAD) if payload else robot
    friction = (jid.ViscousFriction(), jid.CoulombFriction(), jid.RotorInertia())
    bodies = jid.RigidBodies(principal_axes=principal_axes)
    return jid.base_parameters(jid.Model(robot, (bodies, *friction)))


def nominal_parameters(robot):
    """Return standard parameters, seven for each body: cylinders, friction, rotors."""
    bodies = []
    for mass, (start, end, radius) in zip(MASSES, RODS, strict=True):
        start, end = np.array(start), np.array(end)
        centre, axis = 0.5 * (start + end), (end - start) / np.linalg.norm(end - start)
        along = np.diag(np.outer(axis, axis))
        across = radius**2 / 4 + np.sum((end - start) ** 2) / 12
        inertia = mass * (across + along * (radius**2 / 2 - across))
        inertia += mass * (centre @ centre - centre**2)
        bodies.append([mass, *(mass * centre), *inertia])
    force = np.asarray(robot.limits.force)
    return np.concatenate(
        [np.ravel(bodies), VISCOUS * force, COULOMB * force, ROTOR * force]
    )


class Evaluation:
    """Gains against random motions, and violations on a fine grid.

    Args:
        bases: Base parameters of one robot, which may differ in their terms.
    """

    def __init__(self, bases):
        self.robot, self.bases = bases[0].model.robot, bases
        random = (
            jid.trajectories.random_fourier_series(
                self.robot, omega=0.8, harmonics=5, reach=1.0, seed=seed
            )
            for seed in range(15)
        )
        self.random = [[self.deviations(base, t) for base in bases] for t in random]

    def motion(self, trajectory, points=800):
        """Return one period without its end point."""
        return trajectory.motion(
            np.arange(points) * float(trajectory.duration) / points
        )

    def deviations(self, base, trajectory):
        """Return the standard deviations of weighted least squares."""
        noise = 0.01 * np.asarray(self.robot.max_forces)
        theta = np.asarray(base.regressor(self.motion(trajectory))) / noise[:, None]
        theta = theta.reshape(-1, base.size)
        scale = np.linalg.norm(theta, axis=0)
        R = np.linalg.qr(theta / scale, mode="r")
        return np.linalg.norm(np.linalg.inv(R), axis=1) / scale

    def gains(self, trajectory):
        """Return the gain for each of the base parameters."""
        own = [self.deviations(base, trajectory) for base in self.bases]
        return [
            float(
                np.mean([np.exp(np.mean(np.log(r[k] / own[k]))) for r in self.random])
            )
            for k in range(len(own))
        ]

    def violation(self, trajectory):
        """Return the largest relative excess of a joint's limit."""
        m, limits = self.motion(trajectory, POINTS), self.robot.limits
        middle = 0.5 * (limits.position_max + limits.position_min)
        half = 0.5 * (limits.position_max - limits.position_min)
        uses = (np.abs(m.q - middle) / half, np.abs(m.qd) / limits.velocity)
        return float(
            max(np.max(use) for use in (*uses, np.abs(m.qdd) / limits.acceleration)) - 1
        )


def condition(plan):
    """Return the condition number of the unweighted information."""
    return float(np.linalg.cond(plan.information.plain))


def design(name, base, figures, keys, options, **settings):
    """Design a motion for each key; print its figures, and the median and best."""
    found = []
    settings = {"starts": options.starts, "generations": options.generations} | settings
    if options.quick:
        settings |= {"starts": 2, "generations": 0}
    for key in keys:
        wall, cpu = time.perf_counter(), time.process_time()
        plan = jid.design_excitation(
            base, key=jax.random.key(key), throw=False, **settings
        )
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        found.append(figures(plan) | {"wall": wall, "CPU": cpu})
        print(f"  key {key}: {words(found[-1])}", flush=True)
    medians = {k: np.median([f[k] for f in found]) for k in found[0]}
    print(f"{name}: median {words(medians)}")
    for best, function in (("least", min), ("most", max)):
        print(f"  {best} {words({k: function(f[k] for f in found) for k in found[0]})}")


def words(figures):
    """Return figures by name in words."""
    return ", ".join(f"{name} {value:.5g}" for name, value in figures.items())


def unconstrained(part, keys, options):
    """Design without constraints."""
    if part == "panda":
        base = jid.base_parameters(jid.Model(jid.robots.panda()))
        for criterion in (jid.criteria.DOptimal(), jid.criteria.ConditionNumber()):
            value = lambda plan, c=criterion: {c.name: c.value(plan.information)}  # noqa: E731
            design("Panda", base, value, keys, options, criterion=criterion)
        return
    base = base_of(part != "d10")
    evaluation = Evaluation([base])
    criteria = (
        jid.criteria.ConditionNumber() if part == "cond" else jid.criteria.DOptimal()
    )

    def figures(plan):
        found = {"cond": condition(plan), "gain": evaluation.gains(plan.trajectory)[0]}
        return found | {"violation": evaluation.violation(plan.trajectory)}

    design(part, base, figures, keys, options, criterion=criteria)


def constrained(part, keys, options):
    """Design with clearances, rest at the ends, or limited forces."""
    bases = [
        base_of(axes, payload=part in ("forces", "free")) for axes in (True, False)
    ]
    evaluation, robot = Evaluation(bases), bases[0].model.robot
    settings = {"starts": 8, "generations": 8 if part == "rest" else 4}
    p = nominal_parameters(robot)
    shapes = jid.robots.tx90l_on_rail_collision()
    if part.startswith("capsules"):
        settings["constraints"] = (jid.constraints.Clearance(shapes, DISTANCE),)
    if part == "capsules-cond":
        settings["criterion"] = jid.criteria.ConditionNumber()
    if part == "rest":
        settings["basis"] = jid.trajectories.RestToRestBasis(5, 0.8)
    if part == "forces":
        nominal = bases[0].from_standard(p)
        limits = jid.constraints.ForceLimits(bases[0], nominal, margin=MARGIN)
        settings["constraints"] = (limits,)

    def figures(plan):
        t = plan.trajectory
        m = evaluation.motion(t, POINTS)
        gains = dict(zip(("gain 44", "gain 57"), evaluation.gains(t), strict=True))
        found = gains | {"cond": condition(plan), "violation": evaluation.violation(t)}
        if part.startswith("capsules"):
            found["clearance"] = float(np.min(shapes.clearance(robot, m.q)))
        if part == "rest":
            ends = evaluation.motion(t)[np.array([0, -1])]
            found["speed at ends"] = float(np.abs(ends.qd[0]).max())
        if part in ("forces", "free"):
            model = bases[0].model
            forces = np.abs(
                np.asarray(model.inverse_dynamics(p, m) + model.tool_forces(m))
            )
            use = forces.max(axis=0) / ((1 - MARGIN) * np.asarray(robot.limits.force))
            found |= {
                "use of forces": use.max(),
                "joints over by 30 %": int((use > 1.3).sum()),
            }
        return found

    design(part, bases[0], figures, keys, options, **settings)


def step():
    """Time one value and gradient, and forward differences of the same function."""
    problem = jid.ExcitationProblem(
        base_of(True), criterion=jid.criteria.ConditionNumber()
    )
    x = problem.random(jax.random.key(1))
    gradient = jax.jit(jax.value_and_grad(lambda x: problem.value(x, 8.0)))
    value = jax.jit(lambda x: problem.value(x, 8.0))

    def forward():
        f = value(x)
        return [float(value(x.at[k].add(1e-6)) - f) for k in range(problem.size)]

    exact = lambda: jax.block_until_ready(gradient(x))  # noqa: E731
    times = timing.interleaved({"exact": exact, "forward": forward}, 7)
    a, b = (1e3 * times[k].median for k in ("exact", "forward"))
    print(f"step: exact {a:.2f} ms, forward differences {b:.1f} ms: {b / a:.0f}x")


def batch(sizes):
    """Time a whole search of several starts, without generations."""
    problem = jid.ExcitationProblem(base_of(True))
    for starts in sizes:
        for _ in range(2):  # the first one compiles
            wall, cpu = time.perf_counter(), time.process_time()
            jid.excitation.minimise(problem, starts=starts, generations=0)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        rate = f"{starts / wall:.2f} starts per second"
        print(f"batch of {starts}: {rate} ({wall:.2f} s, CPU {cpu:.2f} s)", flush=True)


def compiled(starts):
    """Time the search as one program, and compare it with the search in NumPy."""
    base = base_of(True)
    problem = jid.ExcitationProblem(base)
    search = jid.excitation.CompiledSearch(generations=1)
    x = problem.limits.random(jax.random.key(0), starts)
    program = jax.jit(search.program(problem, starts, np.random.default_rng(0)))

    def timed(function):
        cpu = time.process_time()
        result = jax.block_until_ready(function())
        return result, time.process_time() - cpu

    lowered, lowering = timed(lambda: program.lower(x))
    run, compiling = timed(lowered.compile)
    better, running = timed(lambda: run(x))
    ours, _ = timed(lambda: jid.excitation.minimise(problem, lambda *_: better))
    plan, numpy = timed(
        lambda: jid.excitation.minimise(problem, starts=starts, generations=1)
    )
    gains = [Evaluation([base]).gains(p.trajectory)[0] for p in (ours, plan)]
    print(
        f"compiled, {starts} starts: CPU {lowering + compiling:.1f} s to compile, "
        f"{running:.1f} s to run, gain {gains[0]:.3f}; "
        f"in NumPy {numpy:.1f} s, gain {gains[1]:.3f}",
        flush=True,
    )


FREE = ("cond", "d7", "d10", "panda")
SPEED = ("step", "batch", "compiled")
KEPT = ("capsules-cond", "capsules-d", "rest", "forces", "free")


def main():
    """Run the selected parts."""
    parser = timing.parser(__doc__, "d7 and rest with two starts, step")
    parser.add_argument("parts", nargs="*", default=[*FREE, *KEPT, *SPEED])
    parser.add_argument("--keys", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first key")
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--generations", type=int, default=12)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jid.enable_compilation_cache()
    if options.quick:
        options.parts, options.keys = ["d7", "rest", "step"], 1
    keys = range(options.first, options.first + options.keys)
    for part in options.parts:
        if part in FREE:
            unconstrained(part, keys, options)
        elif part in KEPT:
            constrained(part, keys, options)
        elif part == "step":
            step()
        elif part == "compiled":
            compiled(2 if options.quick else options.starts)
        else:
            batch((1, 8, 64) if jax.default_backend() == "cpu" else (64, 512, 4096))


if __name__ == "__main__":
    main()
