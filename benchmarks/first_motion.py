"""The first motion of a design, and what a minute gives, for arms with grippers.

    python benchmarks/first_motion.py [ARM ...] [--time 60] [--quick]

The descriptions are those of the package `example-robot-data`. For each arm `jaxid
init` and `jaxid excite --time 60` run with default settings and an empty cache of
compiled functions. Seconds are those of the processor, also for the limit of the
time: other programs on the machine do not matter.

* first: time from the start of the command to the first motion that keeps all limits.
* total: time of the whole command, with its page.
* gain: median of D over 200 random motions that keep all limits, over D of the design,
  where D is the mean axis of the confidence ellipsoid; above 1 the design is better.
  "first gain" is that of the first motion.

A random motion has random coefficients (normal) about a random pose (uniform) in which
the robot may stand still. Each joint is scaled to 95 % of its limits, then all joints
are made smaller alike, to the largest size (by bisection) at which the motion keeps the
limits of forces and clearances at 200 instants. Where no pose of 100,000 keeps them,
there is no such motion.
"""

import os
import subprocess
import tempfile
from pathlib import Path

import jax
import numpy as np
import safe_motions
import timing

import jaxid as jid

jax.config.update("jax_enable_x64", True)
ARMS = {
    "panda": ("panda_description/urdf/panda.urdf",),
    "xarm7": ("xarm_description/urdf/xarm7.urdf",),
    "z1": ("z1_description/urdf/z1.urdf",),
    "kinova": ("kinova_description/robots/kinova.urdf",),
    "ur3": ("ur_description/urdf/ur3_gripper.urdf",),
    "ur5": ("ur_description/urdf/ur5_gripper.urdf",),
    "baxter": (
        "baxter_description/urdf/baxter.urdf",
        *("--base", "torso", "--tip", "left_gripper"),
    ),
    "talos": (
        "talos_data/robots/talos_left_arm.urdf",
        *("--tip", "gripper_left_base_link"),
    ),
    "tiago_pro": (
        "tiago_pro_description/robots/tiago_pro.urdf",
        *("--base", "torso_lift_link", "--tip", "gripper_left_base_link"),
    ),
}
"""Descriptions, and options that select the arm."""
MOTIONS, POSES, INSTANTS, HALVINGS = 200, 100_000, 200, 8
BLOCK = 2000
"""Poses or instants that are checked together."""


class RandomMotions:
    """Random motions that keep all limits of a design problem.

    Args:
        problem: Problem of the design.
        random: Generator of poses and coefficients.
    """

    def __init__(self, problem, random):
        self.problem, self.random = problem, random
        self.grid = problem.limits.grid()
        times = np.linspace(0.0, float(problem.basis.duration), INSTANTS)
        self.rows = [np.asarray(part) for part in problem.basis.rows(times)[:3]]

    def excess(self, motions):
        """Return the largest excess of each motion over forces and clearances."""
        x = self.problem.limits.coefficients(np.asarray(motions))
        found = np.full(len(x), -np.inf)
        for first in range(0, len(x), BLOCK // INSTANTS):
            part = x[first : first + BLOCK // INSTANTS]
            states = [np.einsum("sk,bjk->bsj", rows, part) for rows in self.rows]
            motion = jid.Motion(*(each.reshape(-1, x.shape[1]) for each in states))
            for constraint in self.problem.constraints:
                values = np.asarray(constraint(self.problem.robot, motion))
                worst = values.reshape(len(part), -1).max(axis=1)
                place = slice(first, first + len(part))
                found[place] = np.maximum(found[place], worst)
        return found

    def poses(self):
        """Return places in the ranges at which the robot may stand still."""
        limits = self.problem.limits.limits
        middle = 0.5 * (limits.position_min + limits.position_max)
        half = 0.5 * (limits.position_max - limits.position_min)
        found = np.zeros((0, len(half)))
        for _ in range(0, POSES, BLOCK):
            places = self.random.random((BLOCK, len(half)))
            q = middle + 0.95 * (2 * places - 1) * half
            rest = jid.Motion(q, 0 * q, 0 * q)
            values = [
                np.asarray(c(self.problem.robot, rest)).max(axis=1)
                for c in self.problem.constraints
            ]
            found = np.concatenate([found, places[np.max(values, axis=0) <= 0]])
            if len(found) >= MOTIONS:
                break
        return found[:MOTIONS]

    def draw(self):
        """Return the motions, as large as the limits allow."""
        places = self.poses()
        if not len(places):
            return []
        places = np.resize(places, (MOTIONS, places.shape[1]))
        shapes = self.random.standard_normal((MOTIONS, self.problem.size))
        low, high = np.full(MOTIONS, 1e-4), np.ones(MOTIONS)

        def fill(sizes):
            draws = zip(shapes, places, sizes, strict=True)
            return np.array([self.grid.fill(*draw) for draw in draws])

        for _ in range(HALVINGS):
            middle = np.sqrt(low * high)
            kept = self.excess(fill(middle)) <= 0.0
            low, high = np.where(kept, middle, low), np.where(kept, high, middle)
        return fill(low)


def mean_axis(problem, x):
    """Return the mean axis of the confidence ellipsoid of one run."""
    return jid.criteria.DOptimal().value(problem.information(x))


def measure(arm, seconds):
    """Return the figures of one arm."""
    urdf, *options = ARMS[arm]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["JAXID_CACHE_DIR"] = str(folder / "cache")
        command = [*safe_motions.JAXID, "init", safe_motions.robots() / urdf, *options]
        text = subprocess.run(command, capture_output=True, check=True, cwd=name)
        (folder / "experiment.toml").write_bytes(text.stdout)
        figures = safe_motions.design(folder, seconds)
        experiment = jid.experiment.load_experiment(folder / "experiment.toml")
        task = jid.workflow.prepare_motion(
            experiment.setup, experiment.excitation, experiment.surroundings
        )
        problem = jid.ExcitationProblem(
            experiment.setup.base,
            experiment.excitation.basis(True),
            constraints=task.constraints,
        )

        def value_of(file):
            trajectory = jid.trajectories.load_trajectory(folder / file)
            return mean_axis(problem, problem.limits.scaled(trajectory.coefficients))

        first, final = value_of("first.json"), value_of("motion.json")
        motions = RandomMotions(problem, np.random.default_rng(0)).draw()
    found = {"first": figures["first CPU"], "total": figures["CPU"], "D": final}
    if len(motions):
        random = np.median([mean_axis(problem, x) for x in motions])
        found |= {"first gain": random / first, "gain": random / final}
    return found


def main():
    """Measure the arms."""
    parser = timing.parser(__doc__, "one arm, for ten seconds")
    parser.add_argument("arms", nargs="*", default=[*ARMS])
    parser.add_argument("--time", type=float, default=60.0)
    options = parser.parse_args()
    if options.quick:
        options.arms, options.time = ["ur3"], 10.0
    os.environ["PYTHONPATH"] = str(timing.REPOSITORY)
    for arm in options.arms:
        found = measure(arm, options.time)
        words = ", ".join(f"{name} {value:.4g}" for name, value in found.items())
        print(f"{arm}: {words}", flush=True)


if __name__ == "__main__":
    main()
