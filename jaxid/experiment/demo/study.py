"""The paper's experiments, one after the other, on the virtual TX90L on its rail."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.excitation.constraints.clearance import Clearance
from jaxid.excitation.constraints.tip import tip_motion
from jaxid.excitation.criteria import AbstractCriterion, ConditionNumber, DOptimal
from jaxid.excitation.design import design_excitation
from jaxid.excitation.plan import ExcitationPlan
from jaxid.experiment.demo.feed_forward import Timing, timing
from jaxid.experiment.demo.following import Followed, followed
from jaxid.experiment.progress import Stages
from jaxid.identification.consistency import PhysicallyConsistent
from jaxid.identification.estimators import LeastSquares, WeightedLeastSquares
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_rows
from jaxid.identification.rows import Rows
from jaxid.identification.runs.comparison import Comparison, compare
from jaxid.measurement.decimation import Subsample
from jaxid.measurement.filters import AbstractFilter, PaperFilter, ZeroPhaseButterworth
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.recording import Recording
from jaxid.robot.library import tx90l_on_rail_collision
from jaxid.robot.limits import Limits
from jaxid.robot.robot import Robot
from jaxid.simulation.experiment import Tracking
from jaxid.simulation.tx90l import virtual_tx90l_on_rail
from jaxid.simulation.virtual import VirtualRobot
from jaxid.trajectory.basis import LinearTrajectory
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.leads import WithLeads, with_leads
from jaxid.trajectory.tip_path import TipPath, iso9283_path, joint_path
from jaxid.trajectory.trajectory import PiecewisePolynomial
from jaxid.validation import Validation, validate

HARMONICS, OMEGA, SAMPLES = 5, 0.8, 800
"""Of the Fourier series: order, ground frequency [rad/s], samples of a period (the paper's)."""
SHOULDER, LEAN, SHOULDER_ACCELERATION = 2, 0.4, 3.0
"""Joint whose torque would not suffice for all that its limits allow, and what is asked of it in
the designed motions: to either side of upright [rad], and [rad/s²]."""
SAMPLE_TIME = 1e-3
"""Of the servo and the log [s]; the paper's is not published."""
EVERY = 20
"""Samples for each row: 50 Hz, where the filter lets pass 16 Hz."""
CUBE, EDGE = (0.3, 0.5, 0.8), 0.6
"""Centre and edge of the cube of the verification path [m]."""
FORWARD = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Attitude of the end-effector along that path: it points along the rail."""
POSTURE = (0.0, 1.57, -0.3, 1.8, 0.0, 0.0, 0.0)
"""Preferred joint coordinates along that path: the elbow bent [m, rad]."""
ROUNDS = 2
"""Of each circle of that path."""
SPEED, ACCELERATION = 1.05, 4.0
"""Largest of the end-effector along that path [m/s, m/s²]: nearly all that the joints can do."""
LEVEL = 0.95
"""Of intervals, of 1."""
CUTOFF = 15.0
"""Of the filter without lag beside the paper's [Hz]."""
AT_REST = 0.02
"""Speed below which a joint counts as resting, twice the width of the model's dry friction
[rad/s or m/s]."""
FINE = 4000
"""Instants at which the largest speed and acceleration of the end-effector are looked for."""


class Effort(NamedTuple):
    """How much is computed.

    Attributes:
        starts: Random motions from which a design starts.
        draws: Recordings with which intervals are checked.
        periods: Of the excitation that are measured.
    """

    starts: int = 2
    draws: int = 4
    periods: int = 2


EFFORT = Effort()


class Excitation(NamedTuple):
    """The motions to identify with.

    Attributes:
        plans: With the least condition number (Eq. 36), and D-optimal; none of a given motion.
        played: The first of them, from standstill to standstill.
        speed: Largest of the end-effector along it [m/s].
        acceleration: The same [m/s²].
    """

    plans: tuple[ExcitationPlan, ...]
    played: WithLeads
    speed: float
    acceleration: float


class Measured(NamedTuple):
    """Experiments of the robot.

    Attributes:
        cold: Identification right after the start.
        warm: The same when the robot is warm.
        verification: The path of ISO 9283, cold.
        filtered: Observations of the three, in this order.
    """

    cold: Tracking
    warm: Tracking
    verification: Tracking
    filtered: tuple[Observations, Observations, Observations]


class Judged(NamedTuple):
    """An estimate, and what it is worth on identification and verification.

    Attributes:
        name: Of the estimator.
        fit: The estimate.
        validation: Torque errors on both, and definiteness of the mass matrix.
    """

    name: str
    fit: Fit
    validation: Validation


class Coverage(NamedTuple):
    """How often intervals hold the truth.

    Attributes:
        filter: Of the recordings, in words.
        inside: Parameters within their 95 % intervals, over all recordings.
        of: Parameters times recordings.
    """

    filter: str
    inside: int
    of: int

    @property
    def share(self) -> float:
        """Of 1."""
        return self.inside / self.of


class Study(NamedTuple):
    """Everything that the demo finds.

    Attributes:
        seed: Of all that is random.
        virtual: The robot, cold.
        base: Its base parameters.
        excitation: The motions.
        path: Of the end-effector, for verification.
        verification: The same of the joints.
        measured: The experiments.
        unweighted: Least squares without weights.
        weighted: With the weights of Eq. 30.
        consistent: Of bodies that could exist.
        true: The parameters that the robot has: what disturbs is all of their errors.
        temperature: Cold against warm.
        warm: The estimate of the warm robot.
        coverage: Of intervals, where nothing but noise disturbs, by filters.
        followed: The path run with different feed-forwards.
        timing: Of feed-forward torques; a sentence where they were not timed.
    """

    seed: int
    virtual: VirtualRobot
    base: BaseParameters
    excitation: Excitation
    path: TipPath
    verification: PiecewisePolynomial
    measured: Measured
    unweighted: Judged
    weighted: Judged
    consistent: Judged
    true: Judged
    temperature: Comparison
    warm: Fit
    coverage: tuple[Coverage, ...]
    followed: tuple[Followed, ...]
    timing: Timing | str

    def moving(self, recording: int) -> np.ndarray:
        """Which rows count where joints that rest are left out [rows, joints].

        Args:
            recording: 0 for identification, 1 for verification.
        """
        seen = self.measured.filtered[2 * recording]
        return np.abs(np.asarray(seen.reduced_motion.qd)) > AT_REST

    @property
    def truth(self) -> np.ndarray:
        """Base parameters of the cold robot."""
        return np.asarray(self.base.from_standard(self.virtual.parameters))


STAGES = 14
"""Stages of the study."""


def study(
    seed: int, stage: Stages, effort: Effort = EFFORT, motion: LinearTrajectory | None = None
) -> Study:
    """Does everything that the paper does.

    Args:
        seed: Of all that is random.
        stage: Is told what begins.
        effort: How much is computed.
        motion: To identify with; designed if None.
    """
    stage("finding base parameters")
    cold, warm = virtual_tx90l_on_rail(), virtual_tx90l_on_rail(warm=True)
    base = base_parameters(cold.model)
    _ = base.expressions
    plans = () if motion is not None else _designed(base, seed, stage, effort)
    stage("leading into the motion")
    excitation = _excitation(base, plans, motion, effort.periods)
    stage("inverse kinematics of the verification path")
    path = verification_path()
    joints = joint_path(base.model.robot, path, posture=POSTURE)
    measured = _measured(cold, warm, excitation.played, joints, seed, stage)
    stage("identifying")
    identification, hot, other = measured.filtered
    rows = Rows.of(base, [identification])
    fits = {
        "without weights": fit_rows(rows, LeastSquares()),
        "weighted": fit_rows(rows, WeightedLeastSquares()),
        "consistent": fit_rows(rows, PhysicallyConsistent()),
    }
    truth = np.asarray(base.from_standard(cold.parameters))
    fits["true parameters"] = eqx.tree_at(lambda f: f.parameters, fits["weighted"], truth)
    stage("predicting torques")
    judged = [
        Judged(name, fit, validate(fit, [identification, other])) for name, fit in fits.items()
    ]
    stage("comparing cold and warm")
    weighted = judged[1].fit
    warm_fit = fit_rows(Rows.of(base, [hot]), WeightedLeastSquares())
    stage("checking intervals")
    coverage = _coverage(base, excitation.played, seed, effort.draws)
    stage("following the path with three controllers")
    through = followed(cold, path, joints, judged[2].fit, seed)
    stage("timing the feed-forward")
    return Study(
        seed=seed,
        virtual=cold,
        base=base,
        excitation=excitation,
        path=path,
        verification=joints,
        measured=measured,
        unweighted=judged[0],
        weighted=judged[1],
        consistent=judged[2],
        true=judged[3],
        temperature=compare(weighted, warm_fit),
        warm=warm_fit,
        coverage=coverage,
        followed=through,
        timing=timing(judged[2].fit, joints),
    )


def verification_path() -> TipPath:
    """The path of ISO 9283 that the demo runs (Fig. 8)."""
    return iso9283_path(CUBE, EDGE, FORWARD, leans_along=1, speed=SPEED, acceleration=ACCELERATION)


def observed(recording: Recording, robot: Robot) -> Observations:
    """A recording filtered as the paper does (Eq. 25).

    Args:
        recording: Of the robot.
        robot: With its gears.
    """
    return observe(recording, robot, PaperFilter(), Subsample(EVERY))


def _designed(
    base: BaseParameters, seed: int, stage: Stages, effort: Effort
) -> tuple[ExcitationPlan, ...]:
    kept = (Clearance(tx90l_on_rail_collision()),)
    limits = _within_torques(base.model.robot.limits)

    def designed(criterion: AbstractCriterion) -> ExcitationPlan:
        stage(f"designing the motion: {criterion.name}")
        tell = stage.part()
        return design_excitation(
            base,
            criterion=criterion,
            basis=FourierBasis(HARMONICS, OMEGA),
            limits=limits,
            constraints=kept,
            starts=effort.starts,
            generations=0,
            polish=0,
            samples=SAMPLES,
            key=jax.random.key(seed),
            progress=lambda now: tell(now.share),
            throw=False,
        )

    return designed(ConditionNumber()), designed(DOptimal())


def _within_torques(limits: Limits) -> Limits:
    """Limits of the joints, the shoulder's narrowed so that its drive can hold and move the arm."""
    low, high, most = (
        np.array(x) for x in (limits.position_min, limits.position_max, limits.acceleration)
    )
    low[SHOULDER], high[SHOULDER], most[SHOULDER] = -LEAN, LEAN, SHOULDER_ACCELERATION
    return dataclasses.replace(limits, position_min=low, position_max=high, acceleration=most)


def _excitation(
    base: BaseParameters,
    plans: tuple[ExcitationPlan, ...],
    motion: LinearTrajectory | None,
    periods: int,
) -> Excitation:
    robot = base.model.robot
    if motion is None:
        motion = FourierBasis(HARMONICS, OMEGA).trajectory(plans[0].numbers)
    times = np.linspace(0.0, float(motion.duration), FINE, endpoint=False)
    tip = tip_motion(robot, motion.motion(times))
    speed, acceleration = (
        float(np.linalg.norm(np.asarray(x), axis=1).max()) for x in (tip.velocity, tip.acceleration)
    )
    return Excitation(plans, with_leads(motion, robot, periods=periods), speed, acceleration)


def _measured(
    cold: VirtualRobot,
    warm: VirtualRobot,
    excitation: WithLeads,
    verification: PiecewisePolynomial,
    seed: int,
    stage: Stages,
) -> Measured:
    runs = []
    for k, (name, robot, trajectory) in enumerate(
        (
            ("identification, cold", cold, excitation),
            ("identification, warm", warm, excitation),
            ("verification", cold, verification),
        )
    ):
        stage(f"measuring: {name}")
        runs.append(robot.track(trajectory, sample_time=SAMPLE_TIME, seed=10 * seed + k, name=name))
    filtered = tuple(observed(run.recording, cold.robot) for run in runs)
    return Measured(runs[0], runs[1], runs[2], (filtered[0], filtered[1], filtered[2]))


def _coverage(
    base: BaseParameters, excitation: WithLeads, seed: int, draws: int
) -> tuple[Coverage, ...]:
    """Parameters within their intervals, of a robot that noise and encoders alone disturb."""
    quiet = virtual_tx90l_on_rail(disturbed=False)
    truth = np.asarray(base.from_standard(quiet.parameters))
    logs = [
        quiet.measure(
            excitation,
            duration=float(excitation.duration),
            sample_time=SAMPLE_TIME,
            seed=1000 * (seed + 1) + k,
        )
        for k in range(draws)
    ]

    def inside(filter: AbstractFilter) -> int:
        count = 0
        for log in logs:
            rows = Rows.of(base, [observe(log, quiet.robot, filter, Subsample(EVERY))])
            low, high = fit_rows(rows, WeightedLeastSquares()).intervals(LEVEL).T
            count += int(np.count_nonzero((low <= truth) & (truth <= high)))
        return count

    filters = (
        ("the paper's filter, which lags and smooths accelerations twice", PaperFilter()),
        (f"a zero-phase Butterworth filter of {CUTOFF:g} Hz", ZeroPhaseButterworth(CUTOFF)),
    )
    return tuple(Coverage(name, inside(f), draws * base.size) for name, f in filters)
