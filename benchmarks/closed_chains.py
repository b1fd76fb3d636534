"""Closed chains: forces against MuJoCo, base parameters, coverage, speed.

    python benchmarks/closed_chains.py [--quick] [--json FILE]

The mechanisms are those of `tests/mechanisms.py`: a five-bar and a palletiser with a
parallelogram, on which the rules were set, and a slider and a delta, on which nothing
was set. The oracle is MuJoCo's `mj_inverse` of the tree without the constraint,
projected with MuJoCo's own Jacobians of the points (its constraints are soft).

Coverage: 10 s at 200 Hz, five harmonics of 0.1 Hz as large as the reach allows, viscous
friction of 2 N m s and dry friction of 3 N m at the motors (N s/m and N at a slide),
white noise of 0.5 N m, angles exact; `jid.identify` with default settings, and the
share of all base parameters whose 95 % interval holds the truth. With friction of the
joints without a motor, they have MuJoCo's damping of 0.4 N m s and `frictionloss` of
0.6 N m (N s/m and N at a slide), and the fit predicts another motion. Times are CPU
times of one process, without compiling.
"""

import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
import timing
from timing import Row, hand_over

import jaxid as jid

sys.path.insert(0, str(timing.REPOSITORY / "tests"))
from mechanisms import DELTA, MECHANISMS, projection

jax.config.update("jax_enable_x64", True)

RATE, DURATION, NOISE = 200.0, 10.0, 0.5
VISCOUS, DRY = 2.0, 3.0
PASSIVE_VISCOUS, PASSIVE_DRY = 0.4, 0.6
ASKED = {"five-bar": (11, 15), "palletiser": (20, 26)}
REPEATS = 7


class Case:
    """A mechanism here and in MuJoCo."""

    def __init__(self, mechanism):
        import mujoco

        self.mechanism = mechanism
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mechanism.xml"
            path.write_text(mechanism.text)
            self.robot = jid.load_mjcf(path)
            self.bodies = jid.robots.urdf_parameters(path)
            path.write_text(
                mechanism.text.replace("<connect", "<connect active='false'")
            )
            self.tree = jid.load_mjcf(path)
        self.mujoco = mujoco
        self.model = mechanism.tree()
        names = [self.model.joint(k).name for k in range(self.model.njnt)]
        self.order = [self.robot.body_names.index(name) for name in names]
        self.motors = [names.index(name) for name in self.robot.joint_names]

    def model_of(self, friction):
        """Return the model of the motors, with or without their friction."""
        terms = (jid.RigidBodies(),)
        if friction:
            terms += (jid.ViscousFriction(), jid.CoulombFriction(jid.terms.Tanh(0.02)))
        return jid.Model(self.robot, terms)

    def motion(self, seed, samples, spread=None):
        """Return random motions of the motors near the pose of the file."""
        random = np.random.default_rng(seed)
        q, qd, qdd = random.uniform(-1.0, 1.0, (3, samples, self.robot.joints))
        middle = np.asarray(self.robot.loop_pose)[: self.robot.joints]
        spread = self.mechanism.spread if spread is None else spread
        return jid.Motion(middle + spread * q, 2.0 * qd, 5.0 * qdd)

    def forces(self, motion):
        """Return MuJoCo's forces of the motors."""
        data = self.mujoco.MjData(self.model)
        closed = self.robot.close(np.asarray(motion.q))
        forces = []
        for q, qd, qdd in zip(closed, motion.qd, motion.qdd, strict=True):
            tree = projection(self.model, data, q[self.order], self.motors, qd, qdd)
            data.qacc[:] = tree.qdd
            self.mujoco.mj_inverse(self.model, data)
            forces.append(tree.ratios.T @ data.qfrc_inverse)
        return np.array(forces)

    def series(self, seed):
        """Return a periodic motion that fills the reach of the mechanism."""
        random = np.random.default_rng(seed)
        times = np.arange(0, DURATION, 1 / RATE)
        orders = np.arange(1, 6) * 2 * np.pi / DURATION
        waves = random.normal(size=(2, self.robot.joints, 5)) / orders**0.3
        phases = times[:, None, None] * orders
        sines, cosines = np.sin(phases), np.cos(phases)
        a, b = waves
        path = (a * sines + b * (cosines - 1)).sum(2)
        rate = (orders * (a * cosines - b * sines)).sum(2)
        change = (-(orders**2) * (a * sines + b * cosines)).sum(2)
        middle = np.asarray(self.robot.loop_pose)[: self.robot.joints]
        size = 2 * self.mechanism.spread / np.abs(path).max()
        while True:
            try:
                self.robot.close(middle + 1.3 * size * path)
            except jid.InputError:
                size *= 0.8
                continue
            return jid.Motion(middle + size * path, size * rate, size * change)


def forces_row(name, case, samples):
    """Compare forces with MuJoCo's."""
    motion = case.motion(1, samples)
    expected = case.forces(motion)
    model = case.model_of(friction=False)
    forces = model.inverse_dynamics(case.bodies, motion)
    rows = np.asarray(model.regressor(motion)) @ case.bodies
    error = max(np.abs(forces - expected).max(), np.abs(rows - expected).max())
    error /= np.abs(expected).max()
    what = "largest error of forces and regressor, over the largest force"
    return Row(name, what, "MuJoCo, projected", "1e-10", f"{error:.1e}", error <= 1e-10)


def base_row(name, case):
    """Count base parameters, and show how clear the rank is."""
    bodies = jid.base_parameters(case.model_of(friction=False))
    all_terms = jid.base_parameters(case.model_of(friction=True))
    gap = bodies.smallest_independent / bodies.largest_dependent
    asked = " and ".join(map(str, ASKED.get(name, ("as many as the rank",))))
    counts = f"{bodies.size} of {bodies.model.size} and {all_terms.size}"
    measured = f"{counts}, gap {gap:.0e}"
    what = "base parameters of bodies, and with friction; gap from 1e6"
    return Row(name, what, "base_parameters", asked, measured, gap >= 1e6)


def coverage_row(name, case, draws):
    """Count the intervals that hold the truth."""
    base = jid.base_parameters(case.model_of(friction=True))
    motion = case.series(3)
    joints = case.robot.joints
    friction = np.repeat([VISCOUS, DRY], joints)
    truth = base.from_standard(np.concatenate([case.bodies, friction]))
    forces = case.forces(motion)
    forces += VISCOUS * motion.qd + DRY * np.tanh(motion.qd / 0.02)
    fits = fits_of_draws(base, motion, forces, draws)
    inside = [holds_truth(fit, truth) for fit in fits]
    share = 100 * float(np.mean(inside))
    what = "95 % intervals that hold the truth"
    holds = 93 <= share <= 97
    return Row(name, what, f"{draws} draws", "93 to 97 %", f"{share:.1f} %", holds)


def fits_of_draws(base, motion, forces, draws):
    """Yield a fit for each draw of the forces' noise."""
    random = np.random.default_rng(4)
    for _ in range(draws):
        noisy = forces + random.normal(0.0, NOISE, forces.shape)
        yield jid.identify(
            base,
            jid.Observations.of(
                motion.q, motion.qd, motion.qdd, noisy, sample_time=1 / RATE
            ),
        )


def holds_truth(fit, truth):
    """Return whether the interval of each parameter holds its true value."""
    low, high = np.asarray(fit.intervals()).T
    return (low < truth) & (truth < high)


def passive_friction_row(name, case, draws):
    """Compare models with and without the friction of joints without a motor."""
    passive = [k for k in range(case.model.nv) if k not in case.motors]
    motion, unseen = case.series(3), case.series(8)
    try:
        case.model.dof_damping[passive] = PASSIVE_VISCOUS
        case.model.dof_frictionloss[passive] = PASSIVE_DRY
        forces, expected = (
            case.forces(x) + VISCOUS * x.qd + DRY * np.tanh(x.qd / 0.02)
            for x in (motion, unseen)
        )
    finally:
        case.model.dof_damping[passive] = 0.0
        case.model.dof_frictionloss[passive] = 0.0
    plain = case.model_of(friction=True)
    models = {
        "without": plain,
        "with": jid.Model(case.robot, (*plain.terms, jid.terms.PassiveFriction())),
    }
    friction = np.repeat([VISCOUS, DRY], case.robot.joints)
    friction_of_all = np.repeat([PASSIVE_VISCOUS, PASSIVE_DRY], len(passive))
    texts = []
    for key, model in models.items():
        base = jid.base_parameters(model)
        parameters = np.concatenate([case.bodies, friction, friction_of_all])
        truth = base.from_standard(parameters[: model.size])
        squares, inside = [], []
        for fit in fits_of_draws(base, motion, forces, draws):
            inside.append(holds_truth(fit, truth))
            squares.append(np.sum((fit.predict(unseen) - expected) ** 2))
        error = 100 * np.sqrt(np.mean(squares) / np.sum(expected**2))
        share = 100 * float(np.mean(inside))
        texts.append(f"{key} {error:.1f} %, coverage {share:.1f} %")
    what = "friction of joints without a motor: error on another motion"
    return Row(name, what, f"{draws} draws", "-", "; ".join(texts))


def speed_row(name, case, samples):
    """Compare the time of the regressor with that of the tree's."""
    motion = case.motion(5, samples)
    closed = case.robot.close(motion.q)[:, case.order]
    zeros = np.zeros_like(closed)
    tree_motion = jid.Motion(closed, zeros + 0.3, zeros + 0.4)
    tree = jid.Model(case.tree, (jid.RigidBodies(),))
    model = case.model_of(friction=False)
    given = jid.Motion(case.robot.close(motion.q), motion.qd, motion.qdd)
    compiled = jax.jit(model.regressor), jax.jit(tree.regressor)
    cases = {
        "NumPy": (model.regressor, tree.regressor, motion),
        "NumPy, q from `close`": (model.regressor, tree.regressor, given),
        "jit": (*compiled, motion),
    }
    ratios = {kind: [] for kind in cases}
    for kind, (closed_regressor, tree_regressor, motion) in cases.items():
        for turn in range(REPEATS + 1):
            start = time.process_time()
            jax.block_until_ready(closed_regressor(motion))
            middle = time.process_time()
            jax.block_until_ready(tree_regressor(tree_motion))
            end = time.process_time()
            if turn:
                ratios[kind].append((middle - start) / (end - middle))
    medians = {kind: float(np.median(values)) for kind, values in ratios.items()}
    measured = ", ".join(f"{kind} {value:.2f}" for kind, value in medians.items())
    what = "time of the regressor over the tree's, loops closed in it or before"
    holds = max(medians.values()) <= 3
    return Row(name, what, f"{samples} samples", "3", measured, holds)


def main():
    """Print the rows."""
    given = timing.parser(__doc__, "few samples and draws").parse_args()
    samples = 10 if given.quick else 200
    draws = 2 if given.quick else 100
    rows = []
    for name, mechanism in (*MECHANISMS.items(), ("delta", DELTA)):
        case = Case(mechanism)
        rows.append(forces_row(name, case, samples))
        rows.append(base_row(name, case))
        rows.append(coverage_row(name, case, draws))
        if name in MECHANISMS:
            rows.append(passive_friction_row(name, case, max(2, draws // 4)))
        rows.append(speed_row(name, case, 100 if given.quick else 4000))
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
