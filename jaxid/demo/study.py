"""The paper's experiments, one after the other, on the virtual TX90L on its rail."""

import ctypes
import dataclasses
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

import jaxid as jid
from jaxid.arrays import Float
from jaxid.identification.comparison import Comparison
from jaxid.simulation.virtual import Tracking
from jaxid.validation import Validation

HARMONICS, OMEGA, SAMPLES = 5, 0.8, 800
"""Fourier series of the paper: order, fundamental frequency [rad/s], samples of a period."""
SAMPLE_TIME, STEP = 1e-3, 20
"""Sample time of servo and log [s] (not published), and samples for each row."""
CUBE, EDGE = (0.3, 0.5, 0.8), 0.6
"""Centre and edge of the cube of the verification path [m]."""
SPEED, ACCELERATION = 1.05, 4.0
"""Limits of the end-effector along that path [m/s, m/s²]: nearly all that the joints can do."""
AT_REST = 0.02
"""Speed below which a joint counts as resting, twice the width of the model's dry friction
[rad/s or m/s]."""


class Model(NamedTuple):
    """Parameters by one estimator, validated on identification (0) and verification (1)."""

    name: str
    fit: jid.Fit
    validation: Validation

    def mean_errors(self, recording: int) -> list[float]:
        """Return the mean errors of all axes [% of the largest torque] (Eq. 37)."""
        return [float(x) for x in self.validation.errors[recording].mean_percent]


class PathRun(NamedTuple):
    """Run with a model fed forward, and the distance of the end-effector from its path [m]."""

    name: str
    run: Tracking
    distance: Float[np.ndarray, " samples"]

    @property
    def rms(self) -> float:
        """RMS distance of the end-effector [m]."""
        return float(np.sqrt(np.mean(self.distance**2)))


class Study(NamedTuple):
    """Results of the demo.

    Attributes:
        seed: Seed of all random numbers.
        base: Base parameters of the robot.
        truth: Base parameters of the cold robot.
        plans: Motions with the least condition number (Eq. 36), and D-optimal; none if a motion
            was given.
        played: Motion of the identification, from standstill to standstill.
        joint_path: Path of the verification in joint coordinates.
        observations: Filtered recordings: identification cold, identification warm, verification.
        unweighted: Least squares without weights.
        weighted: Least squares with the weights of Eq. 30.
        consistent: Estimate of physically consistent bodies.
        true: Parameters of the robot itself: their errors are all due to disturbances.
        warm: Fit of the warm robot.
        temperature: Comparison of the cold with the warm robot.
        coverage: Where nothing but noise disturbs: a filter in words, the number of 95 % intervals
            that hold the true parameter, and the number of all.
        followed: Runs along the path with no model, CAD values, and the identified model.
        timing: Compiler, and cost of a feed-forward torque [s]; a sentence where it was not
            measured.
    """

    seed: int
    base: jid.BaseParameters
    truth: Float[np.ndarray, " base"]
    plans: tuple[jid.ExcitationPlan, ...]
    played: jid.trajectories.WithLeads
    joint_path: jid.trajectories.AbstractTrajectory
    observations: tuple[jid.Observations, ...]
    unweighted: Model
    weighted: Model
    consistent: Model
    true: Model
    warm: jid.Fit
    temperature: Comparison
    coverage: tuple[tuple[str, int, int], ...]
    followed: tuple[PathRun, ...]
    timing: dict[str, Any] | str

    @property
    def models(self) -> tuple[Model, ...]:
        """All sets of parameters whose errors are compared."""
        return self.unweighted, self.weighted, self.consistent, self.true

    def moving_errors(self, model: Model, recording: int) -> list[float]:
        """Return the mean errors of all axes while they move [% of the largest torque]."""
        errors = model.validation.errors[recording]
        moving = np.abs(self.observations[2 * recording].reduced_motion.qd) > AT_REST
        sums = np.where(moving, np.abs(np.asarray(errors.errors)), 0.0).sum(axis=0)
        mean = sums / np.maximum(moving.sum(axis=0), 1)
        return [float(x) for x in 100.0 * mean / np.asarray(errors.max_forces)]

    @property
    def tip_maxima(self) -> tuple[float, float]:
        """Largest speed [m/s] and acceleration [m/s²] of the end-effector in the identification."""
        series = self.played.inner
        times = np.linspace(0.0, float(series.duration), 4000, endpoint=False)
        _, *rates = jid.constraints.tip_motion(self.base.model.robot, series.motion(times))
        speed, acceleration = (float(np.linalg.norm(x, axis=1).max()) for x in rates)
        return speed, acceleration


def run_study(
    seed: int,
    progress: Callable[[str, float], None],
    *,
    draws: int = 4,
    periods: int = 2,
    motion: jid.trajectories.AbstractTrajectory | None = None,
) -> Study:
    """Repeat the experiments of the paper.

    Args:
        seed: Seed of all random numbers.
        progress: Callback, called with the name of a stage and its completed fraction (0 to 1).
        draws: Number of recordings with which intervals are checked.
        periods: Number of periods of the excitation that are measured.
        motion: Motion to identify with; designed if None.
    """
    progress("finding base parameters", 0.0)
    cold = jid.simulation.virtual_tx90l_on_rail()
    hot = jid.simulation.virtual_tx90l_on_rail(warm=True)
    robot, base = cold.robot, jid.base_parameters(cold.model)
    _ = base.expressions
    plans: tuple[jid.ExcitationPlan, ...] = ()
    if motion is None:
        plans = _design(base, seed, progress)
        basis = jid.trajectories.FourierBasis(HARMONICS, OMEGA)
        motion = basis.trajectory(plans[0].trajectory.coefficients)
    progress("adding the leads", 0.0)
    played = jid.trajectories.with_leads(motion, robot, periods=periods)
    progress("inverse kinematics of the verification path", 0.0)
    forward = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    path = jid.trajectories.iso9283_path(  # the tool points along the rail (Fig. 8)
        CUBE, EDGE, forward, leans_along=1, speed=SPEED, acceleration=ACCELERATION
    )
    joints = jid.trajectories.joint_path(robot, path, posture=(0.0, 1.57, -0.3, 1.8, 0.0, 0.0, 0.0))
    observations = []
    for virtual, trajectory, name in (
        (cold, played, "identification, cold"),
        (hot, played, "identification, warm"),
        (cold, joints, "verification"),
    ):
        progress(f"measuring: {name}", 0.0)
        number = 10 * seed + len(observations)
        run = virtual.track(trajectory, sample_time=SAMPLE_TIME, seed=number, name=name)
        observations.append(_observe(run.recording, robot, jid.filters.PaperFilter()))
    progress("identifying", 0.0)
    rows = jid.RegressionProblem(base, [observations[0]])
    truth = np.asarray(base.from_standard(cold.parameters))
    fits = {
        "without weights": jid.identify(base, rows, jid.estimators.LeastSquares()),
        "weighted": jid.identify(base, rows, jid.WeightedLeastSquares()),
        "consistent": jid.identify(base, rows, jid.PhysicallyConsistent()),
    }
    fits["true parameters"] = eqx.tree_at(lambda f: f.parameters, fits["weighted"], truth)
    progress("predicting torques", 0.0)
    recordings = [observations[0], observations[2]]
    models = [Model(name, fit, jid.validate(fit, recordings)) for name, fit in fits.items()]
    progress("comparing cold and warm", 0.0)
    warm = jid.identify(base, observations[1], jid.WeightedLeastSquares())
    progress("checking intervals", 0.0)
    coverage = _check_coverage(base, played, seed, draws)
    progress("following the path with three controllers", 0.0)
    followed = _follow(cold, path, joints, fits["consistent"], seed)
    progress("timing the feed-forward", 0.0)
    return Study(
        seed,
        base,
        truth,
        plans,
        played,
        joints,
        tuple(observations),
        *models,
        warm=warm,
        temperature=jid.compare(fits["weighted"], warm),
        coverage=coverage,
        followed=followed,
        timing=time_feed_forward(fits["consistent"], joints),
    )


def _observe(
    log: jid.Recording, robot: jid.Robot, filter: jid.filters.AbstractFilter
) -> jid.Observations:
    return jid.observe(log, robot, filter, jid.Subsample(STEP))


def _design(
    base: jid.BaseParameters, seed: int, progress: Callable[[str, float], None]
) -> tuple[jid.ExcitationPlan, ...]:
    """Return a motion with the least condition number, and a D-optimal one."""
    limits = base.model.robot.limits
    low, high, most = (
        np.array(x) for x in (limits.position_min, limits.position_max, limits.acceleration)
    )
    # The drive of the shoulder could not hold and move the arm in all that its limits allow.
    low[2], high[2], most[2] = -0.4, 0.4, 3.0
    limits = dataclasses.replace(limits, position_min=low, position_max=high, acceleration=most)

    def design(criterion: jid.criteria.AbstractCriterion) -> jid.ExcitationPlan:
        name = f"designing the motion: {criterion.name}"
        progress(name, 0.0)
        return jid.design_excitation(
            base,
            criterion=criterion,
            basis=jid.trajectories.FourierBasis(HARMONICS, OMEGA),
            limits=limits,
            constraints=(jid.constraints.Clearance(jid.robots.tx90l_on_rail_collision()),),
            starts=2,
            generations=0,
            polish=0,
            samples=SAMPLES,
            key=jax.random.key(seed),
            progress=lambda now: progress(name, now.fraction),
            throw=False,
        )

    return design(jid.criteria.ConditionNumber()), design(jid.criteria.DOptimal())


def _check_coverage(
    base: jid.BaseParameters, excitation: jid.trajectories.WithLeads, seed: int, draws: int
) -> tuple[tuple[str, int, int], ...]:
    """Count the intervals that hold the truth, for a robot with noise and encoders only."""
    quiet = jid.simulation.virtual_tx90l_on_rail(disturbed=False)
    truth = np.asarray(base.from_standard(quiet.parameters))
    seeds = range(1000 * (seed + 1), 1000 * (seed + 1) + draws)
    logs = [
        quiet.measure(
            excitation, duration=float(excitation.duration), sample_time=SAMPLE_TIME, seed=k
        )
        for k in seeds
    ]
    filters = {
        "the paper's filter, which lags and smooths accelerations twice": jid.filters.PaperFilter(),
        "a zero-phase Butterworth filter of 15 Hz": jid.ZeroPhaseButterworth(15.0),
    }
    counts = []
    for name, filter in filters.items():
        inside = 0
        for log in logs:
            fit = jid.identify(base, _observe(log, quiet.robot, filter))
            low, high = fit.intervals(0.95).T
            inside += int(np.count_nonzero((low <= truth) & (truth <= high)))
        counts.append((name, inside, draws * base.size))
    return tuple(counts)


def _follow(
    virtual: jid.VirtualRobot,
    path: jid.trajectories.TipPath,
    joints: jid.trajectories.AbstractTrajectory,
    fit: jid.Fit,
    seed: int,
) -> tuple[PathRun, ...]:
    """Run the path by the servo alone, and with two models fed forward."""
    cad = jid.simulation.cad_tx90l_on_rail()
    controllers = {
        "no model": None,
        "CAD values": lambda motion: np.asarray(virtual.model.inverse_dynamics(cad, motion)),
        "identified model": fit.predict,
    }
    runs = []
    for k, (name, feed_forward) in enumerate(controllers.items()):
        number = 100 + 10 * seed + k
        run = virtual.track(joints, feed_forward=feed_forward, seed=number, name=name)
        tip = np.asarray(jid.constraints.tip_motion(virtual.robot, run.actual)[0])
        distance = np.linalg.norm(tip - path.positions(np.asarray(run.time)), axis=1)
        runs.append(PathRun(name, run, distance))
    return tuple(runs)


_LOOPS = """#include "arm.c"
#define LOOP(form) \\
void loop_##form(long calls, long states, const double *q, const double *qd, const double *qdd, \\
                 double *tau) \\
{ \\
    long k; \\
    for (k = 0; k < calls; ++k) { \\
        const long row = k % states * ARM_JOINTS; \\
        arm_##form(q + row, qd + row, qdd + row, MORE_##form tau + row); \\
    } \\
}
#define MORE_torque
#define MORE_torque_of_masses
#define MORE_torque_of_parameters arm_parameters,
LOOP(torque)
LOOP(torque_of_parameters)
LOOP(torque_of_masses)
"""


def time_feed_forward(
    fit: jid.Fit, trajectory: jid.trajectories.AbstractTrajectory
) -> dict[str, Any] | str:
    """Return the cost of a feed-forward torque in C on states of a motion [s] (Sec. 7).

    `literal` is the base regressor times the base parameters, as printed (Eq. 39), `factored` the
    same as a recursion on base parameters, `full` mass matrix and bias forces (Eq. 38). A sentence
    is returned where they cannot be measured.

    Args:
        fit: Model with a complete set of standard parameters.
        trajectory: Trajectory whose torques are computed.
    """
    compiler = os.environ.get("CC", "cc")
    motion = trajectory.motion(np.linspace(0.0, float(trajectory.duration), 256))
    states = [np.ascontiguousarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
    forms = {"literal": "torque_of_parameters", "factored": "torque", "full": "torque_of_masses"}
    with tempfile.TemporaryDirectory(prefix="jaxid-") as folder:
        jid.export_c(fit, folder, name="arm")
        (Path(folder) / "loops.c").write_text(_LOOPS, encoding="ascii")
        words = [compiler, "-O2", "-shared", "-fPIC", "loops.c", "-o", "loops.so", "-lm"]
        try:
            subprocess.run(words, cwd=folder, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as failure:
            return f"feed-forward torques were not timed: {failure}"
        library = ctypes.CDLL(str(Path(folder) / "loops.so"))
    # All forms in turn, so that other work on the machine disturbs them alike.
    turns = [[_cost(library, form, states) for form in forms.values()] for _ in range(21)]
    medians = (statistics.median(column) for column in zip(*turns, strict=True))
    return {"where": f"C, {compiler} -O2", **dict(zip(forms, medians, strict=True))}


def _cost(library: ctypes.CDLL, form: str, states: list[np.ndarray], calls: int = 4096) -> float:
    """Return the time of one call [s]."""
    loop = getattr(library, f"loop_{form}")
    loop.restype = None
    arrays = (*states, np.empty_like(states[0]))
    places = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
    begin = time.perf_counter()
    loop(ctypes.c_long(calls), ctypes.c_long(len(states[0])), *places)
    return (time.perf_counter() - begin) / calls
