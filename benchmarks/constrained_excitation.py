"""Excitation within collisions, standstill and torque limits: what is kept, and what it costs.

    python benchmarks/constrained_excitation.py [--only capsules rest torques] [--seeds 0 1 ...]
    python benchmarks/constrained_excitation.py --quick

Robot and columns: `jid.robots.tx90l_on_rail()`, seven parameters for each body, viscous and Coulomb
friction, rotor inertias: 44 base parameters. Limits are the robot's (positions, velocities,
accelerations). Motions: 5 harmonics, 0.8 rad/s, 800 samples of one period without its end; rest to
rest by `RestToRestBasis`. Starts, generations and polished ones: 8, 4, 2 (capsules, torques) or
8, 8, 2 (rest); seed k is `jax.random.key(k)`.

Noise is 1 % of (3000 N, 318, 130, 65, 34, 29, 11 N m). The gain of a motion is the geometric mean,
over parameters, of the standard deviations of weighted least squares in a random motion over those
in this motion, and of that the mean over the random motions of the seeds 0 to 14 (a, b normal over
their order, each joint enlarged to its tightest limit, offset uniform in what is left). It is given
for the 44 parameters that were designed for and for the 57 of ten parameters for each body, on the
same motion.

capsules: `jid.robots.tx90l_on_rail_collision()`, at least 0.03 m; for cond (Eq. 36) and for D.
rest: starts and stops at rest, D.
torques: D; forces of the nominal parameters below (`nominal_parameters`) with a payload of 6 kg, at
    most 90 % of the limits. The design without this constraint stands beside it.

Everything is checked on 8000 points of the period; the largest violation is relative to the limit.
"""

import argparse
import json
import time

import numpy as np

CHECKED, RANDOM = 8000, 15
MASSES = (250.0, 16.93, 14.35, 7.50, 6.42, 0.569, 0.031)
"""Of the carriage with its column (assumed) and of the six links (CAD) [kg]."""
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
"""Friction and rotors as shares of the largest force, per rad/s, and per rad/s²: the paper's joint
1 has 0.13 and 0.06."""
PAYLOAD = {"mass": 6.0, "centre_of_mass": (0.0, 0.0, 0.1)}
MARGIN, DISTANCE = 0.1, 0.03


def robot_and_bases(payload=False):
    """The robot and its base parameters, 44 and 57."""
    import jaxid as jid

    robot = jid.robots.tx90l_on_rail()
    robot = robot.with_tool(**PAYLOAD) if payload else robot
    rest = (jid.ViscousFriction(), jid.CoulombFriction(), jid.RotorInertia())
    return robot, [
        jid.base_parameters(jid.Model(robot, (jid.RigidBodies(principal_axes=axes), *rest)))
        for axes in (True, False)
    ]


def nominal_parameters(robot):
    """Standard parameters of the model with 44 base parameters: cylinders, friction, rotors."""
    bodies = []
    for mass, (start, end, radius) in zip(MASSES, RODS, strict=True):
        start, end = np.array(start), np.array(end)
        centre, axis = 0.5 * (start + end), (end - start) / np.linalg.norm(end - start)
        along = np.diag(np.outer(axis, axis))
        length = np.linalg.norm(end - start)
        across = radius**2 / 4 + length**2 / 12
        inertia = mass * (across + along * (radius**2 / 2 - across))
        inertia += mass * (centre @ centre - centre**2)
        bodies.append([mass, *(mass * centre), *inertia])
    force = np.asarray(robot.limits.force)
    return np.concatenate([np.ravel(bodies), VISCOUS * force, COULOMB * force, ROTOR * force])


def deviations(base, motion, noise):
    """Standard deviations of weighted least squares."""
    theta = np.asarray(base.regressor(motion)) / noise[:, None]
    theta = theta.reshape(-1, base.size)
    scale = np.linalg.norm(theta, axis=0)
    _, R = np.linalg.qr(theta / scale)
    return np.linalg.norm(np.linalg.inv(R), axis=1) / scale


class Judge:
    """Gains against random motions, and violations on a fine grid."""

    def __init__(self, robot, bases):
        import jaxid as jid

        self.robot, self.bases = robot, bases
        self.noise = 0.01 * np.asarray(robot.limits.force)
        self.random = []
        for seed in range(RANDOM):
            series = jid.random_fourier_series(robot, omega=0.8, harmonics=5, reach=1.0, seed=seed)
            motion = series.motion(np.arange(800) * series.period / 800)
            self.random.append([deviations(b, motion, self.noise) for b in bases])

    def gains(self, trajectory):
        """How many times smaller deviations are than in random motions, for both models."""
        motion = trajectory.motion(np.arange(800) * float(trajectory.duration) / 800)
        own = [deviations(b, motion, self.noise) for b in self.bases]
        return [
            float(np.mean([np.exp(np.mean(np.log(r[k] / own[k]))) for r in self.random]))
            for k in range(len(own))
        ]

    def condition(self, trajectory):
        """The condition number of the unweighted information (Eq. 36)."""
        motion = trajectory.motion(np.arange(800) * float(trajectory.duration) / 800)
        theta = np.asarray(self.bases[0].regressor(motion)).reshape(-1, self.bases[0].size)
        return float(np.linalg.cond(theta) ** 2)

    def fine(self, trajectory):
        """The motion on many points."""
        return trajectory.motion(np.arange(CHECKED) * float(trajectory.duration) / CHECKED)

    def violation(self, trajectory):
        """The largest relative excess of a joint's limit."""
        m, lim = self.fine(trajectory), self.robot.limits
        q, qd, qdd = (np.asarray(x) for x in (m.q, m.qd, m.qdd))
        half = 0.5 * (lim.position_max - lim.position_min)
        return float(
            max(
                ((q - lim.position_max) / half).max(),
                ((lim.position_min - q) / half).max(),
                (np.abs(qd) / lim.velocity).max() - 1,
                (np.abs(qdd) / lim.acceleration).max() - 1,
            )
        )


def designed(base, seed, quick, starts, generations, polish, **settings):
    """A plan, and the wall and CPU seconds that it took, compiling included for the first seed."""
    import jax

    import jaxid as jid

    wall, cpu = time.perf_counter(), time.process_time()
    plan = jid.design_excitation(
        base,
        key=jax.random.key(seed),
        starts=2 if quick else starts,
        generations=1 if quick else generations,
        polish=0 if quick else polish,
        throw=False,
        **settings,
    )
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return plan, {"wall": round(wall, 1), "cpu": round(cpu, 1)}


def capsules(criterion):
    """Designs that keep 0.03 m of clearance."""
    import jaxid as jid

    robot, bases = robot_and_bases()
    judge, shapes = Judge(robot, bases), jid.robots.tx90l_on_rail_collision()
    kept = (jid.Clearance(shapes, DISTANCE),)

    def one(seed, quick):
        plan, cost = designed(bases[0], seed, quick, 8, 4, 2, criterion=criterion, constraints=kept)
        t = plan.trajectory
        gap = float(np.min(shapes.clearance(robot, judge.fine(t).q)))
        return {
            "cond": judge.condition(t),
            "gains": judge.gains(t),
            "violation": judge.violation(t),
            "clearance": gap,
            "feasible": gap >= DISTANCE and judge.violation(t) <= 0,
            **cost,
        }

    return one


def rest():
    """Designs that start and stop at rest."""
    import jaxid as jid

    robot, bases = robot_and_bases()
    judge = Judge(robot, bases)

    def one(seed, quick):
        plan, cost = designed(bases[0], seed, quick, 8, 8, 2, basis=jid.RestToRestBasis(5, 0.8))
        t = plan.trajectory
        inner = t.series.motion(np.array([0.0, float(t.duration)]))
        return {
            "cond": judge.condition(t),
            "gains": judge.gains(t),
            "violation": judge.violation(t),
            "speed at ends": float(np.abs(inner.qd).max()),
            "acceleration at ends": float(np.abs(inner.qdd).max()),
            "feasible": judge.violation(t) <= 0,
            **cost,
        }

    return one


def torques(limited):
    """Designs without or with limits of the joints' forces."""
    import jaxid as jid

    robot, bases = robot_and_bases(payload=True)
    judge = Judge(robot, bases)
    p = nominal_parameters(robot)
    nominal = jid.NominalForces.of(bases[0], bases[0].from_standard(p))
    kept = (jid.JointForces(nominal, margin=MARGIN),) if limited else ()

    def one(seed, quick):
        plan, cost = designed(bases[0], seed, quick, 8, 4, 2, constraints=kept)
        t = plan.trajectory
        m = judge.fine(t)
        forces = np.asarray(bases[0].model.inverse_dynamics(p, m) + bases[0].model.tool_forces(m))
        use = np.abs(forces).max(axis=0) / ((1 - MARGIN) * np.asarray(robot.limits.force))
        return {
            "gains": judge.gains(t),
            "violation": judge.violation(t),
            "use of forces": use.round(4).tolist(),
            "joints over by 30 %": int((use > 1.3).sum()),
            "feasible": bool(use.max() <= 1.0) and judge.violation(t) <= 0,
            **cost,
        }

    return one


FIGURES = ("capsules-cond", "capsules-d", "rest", "torques-free", "torques")


def study(name):
    """What measures one figure for one seed."""
    import jaxid as jid

    if name.startswith("capsules"):
        return capsules(jid.ConditionNumber() if "cond" in name else jid.DOptimal())
    return rest() if name == "rest" else torques(name == "torques")


def summary(name, rows):
    """The figure in one line: how many are feasible, medians and extremes."""
    parts = [f"{name}: feasible {sum(row['feasible'] for row in rows)} of {len(rows)}"]
    for k, size in enumerate((44, 57)):
        gains = [row["gains"][k] for row in rows]
        parts.append(f"gain {size}: {np.min(gains):.2f} / {np.median(gains):.2f}")
    if "cond" in rows[0]:
        conds = [row["cond"] for row in rows]
        parts.append(f"cond {np.median(conds):.0f} / {np.max(conds):.0f}")
    for key in ("wall", "cpu"):
        parts.append(f"{key} {np.median([row[key] for row in rows]):.0f} s")
    return ", ".join(parts)


def main():
    import jax

    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="*", default=list(FIGURES), choices=FIGURES)
    parser.add_argument("--seeds", nargs="*", type=int, default=list(range(10)))
    parser.add_argument("--quick", action="store_true", help="rest: one seed, two starts")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.only = ["rest"]
    for name in arguments.only:
        one, rows = study(name), []
        for seed in arguments.seeds[:1] if arguments.quick else arguments.seeds:
            rows.append(one(seed, arguments.quick))
            print(json.dumps({"figure": name, "seed": seed, **rows[-1]}), flush=True)
        print(summary(name, rows), flush=True)


if __name__ == "__main__":
    main()
