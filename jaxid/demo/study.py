"""The paper's experiments, one after the other, on the virtual TX90L on its rail."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

import jaxid as jid
from jaxid.excitation.design import DesignProgress
from jaxid.identification.parameter_changes import Comparison
from jaxid.validation.torque_errors import Validation

HARMONICS = 5
"""Order of the Fourier series of the paper."""
OMEGA = 0.8
"""Its fundamental frequency [rad/s]."""
SAMPLES = 800
"""Samples of a period at which limits are checked."""
SAMPLE_TIME = 1e-3
"""Sample time of servo and log [s] (not published)."""
STEP = 20
"""Samples of the log for each row."""
CENTRE = (0.3, 0.5, 0.8)
"""Centre of the cube of the verification path [m]."""
EDGE = 0.6
"""Edge of this cube [m]."""
SPEED = 1.05
"""Limit of the end-effector along that path [m/s]: nearly all that the joints allow."""
ACCELERATION = 4.0
"""Limit of its acceleration [m/s²]."""
TOOL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Orientation of the tool on that path: it points along the rail (Fig. 8)."""
POSTURE = (0.0, 1.57, -0.3, 1.8, 0.0, 0.0, 0.0)
"""Joint angles to which the redundant robot stays near on that path [m, rad]."""
SHOULDER = 2
"""Index of the joint whose drive cannot hold and move the arm within all its limits."""


class Model(NamedTuple):
    """Parameters by one estimator, validated on both logs.

    The first log is for identification (0), the second one for verification (1).
    """

    name: str
    fit: jid.Fit
    validation: Validation

    def mean_errors(self, recording: int) -> list[float]:
        """Return the mean errors of all axes [% of the largest torque] (Eq. 37)."""
        return [float(x) for x in self.validation.errors[recording].mean_percent]


class Study(NamedTuple):
    """Results of the demo, with and without the weights of the joints (Eq. 30)."""

    seed: int  # seed of all random numbers
    base: jid.BaseParameters  # base parameters of the robot
    truth: np.ndarray  # base parameters of the cold robot
    # design with the least condition number (Eq. 36); None if a motion was given
    plan: jid.ExcitationPlan | None
    # motion of the identification, from standstill to standstill
    played_motion: jid.trajectories.WithLeads
    joint_path: (
        jid.trajectories.AbstractTrajectory
    )  # path of the verification in joint coordinates
    # filtered recordings: identification cold, identification warm, verification
    observations: tuple[jid.Observations, ...]
    unweighted_model: Model  # least squares without weights
    weighted_model: Model  # least squares with the weights of Eq. 30
    consistent_model: Model  # estimate of physically consistent bodies
    # parameters of the robot itself: their errors are all due to disturbances
    true_model: Model
    warm_fit: jid.Fit  # fit of the warm robot
    temperature: Comparison  # comparison of the cold with the warm robot

    @property
    def models(self) -> tuple[Model, ...]:
        """All sets of parameters whose errors are compared."""
        return (
            self.unweighted_model,
            self.weighted_model,
            self.consistent_model,
            self.true_model,
        )

    @property
    def tip_maxima(self) -> tuple[float, float]:
        """Largest speed [m/s] and acceleration [m/s²] of the end-effector.

        They are those of the motion for identification.
        """
        series = self.played_motion.inner
        times = np.linspace(0.0, float(series.duration), 4000, endpoint=False)
        _, *rates = jid.constraints.tip_motion(
            self.base.model.robot, series.motion(times)
        )
        speed, acceleration = (float(np.linalg.norm(x, axis=1).max()) for x in rates)
        return speed, acceleration


def run_study(
    seed: int,
    progress: Callable[[str, float], None],
    *,
    periods: int = 2,
    motion: jid.trajectories.AbstractTrajectory | None = None,
) -> Study:
    """Repeat the experiments of the paper.

    Progress is that of the whole study, by the measured time of its stages.
    """
    progress("finding base parameters", 0.05)
    cold_robot = jid.simulation.virtual_tx90l_on_rail()
    warm_robot = jid.simulation.virtual_tx90l_on_rail(warm=True)
    robot = cold_robot.robot
    base = jid.base_parameters(cold_robot.model)
    plan = None
    if motion is None:
        plan = _design(base, seed, progress)
        motion = plan.trajectory
    progress("adding the leads", 0.55)
    played_motion = jid.trajectories.with_leads(motion, robot, periods=periods)
    progress("inverse kinematics of the verification path", 0.57)
    tip_path = jid.trajectories.iso9283_path(
        CENTRE, EDGE, TOOL, leans_along=1, speed=SPEED, acceleration=ACCELERATION
    )
    joint_path = jid.trajectories.joint_path(robot, tip_path, posture=POSTURE)

    runs = (
        (cold_robot, played_motion, "identification, cold"),
        (warm_robot, played_motion, "identification, warm"),
        (cold_robot, joint_path, "verification"),
    )
    observations = []
    for number, (virtual_robot, trajectory, name) in enumerate(runs, 10 * seed):
        progress(f"measuring: {name}", 0.6 + 0.06 * len(observations))
        observations.append(_measure(virtual_robot, trajectory, name, number))
    cold_log, warm_log, verification_log = observations

    progress("identifying", 0.78)
    rows = jid.RegressionProblem(base, [cold_log])
    truth = np.asarray(base.from_standard(cold_robot.parameters))
    weighted_fit = jid.identify(base, rows, jid.WeightedLeastSquares())
    warm_fit = jid.identify(base, warm_log, jid.WeightedLeastSquares())
    fits = {
        "without weights": jid.identify(base, rows, jid.estimators.LeastSquares()),
        "weighted": weighted_fit,
        "consistent": jid.identify(base, rows, jid.PhysicallyConsistent()),
        "true parameters": eqx.tree_at(lambda fit: fit.parameters, weighted_fit, truth),
    }
    progress("predicting torques", 0.83)
    models = [
        Model(name, fit, jid.validate(fit, [cold_log, verification_log]))
        for name, fit in fits.items()
    ]
    progress("comparing cold and warm", 0.94)
    return Study(
        seed,
        base,
        truth,
        plan,
        played_motion,
        joint_path,
        tuple(observations),
        *models,
        warm_fit=warm_fit,
        temperature=jid.compare(weighted_fit, warm_fit),
    )


def _measure(
    virtual_robot: jid.simulation.VirtualRobot,
    trajectory: jid.trajectories.AbstractTrajectory,
    name: str,
    seed: int,
) -> jid.Observations:
    """Return the filtered recording of a robot that tracks a trajectory."""
    run = virtual_robot.track(trajectory, sample_time=SAMPLE_TIME, seed=seed, name=name)
    return jid.observe(
        run.recording,
        virtual_robot.robot,
        jid.filters.PaperFilter(),
        jid.Subsample(STEP),
    )


def _design(
    base: jid.BaseParameters, seed: int, progress: Callable[[str, float], None]
) -> jid.ExcitationPlan:
    """Return the motion with the least condition number within all limits (Eq. 36)."""
    limits = base.model.robot.limits
    position_min = np.array(limits.position_min)
    position_max = np.array(limits.position_max)
    acceleration = np.array(limits.acceleration)
    position_min[SHOULDER] = -0.4
    position_max[SHOULDER] = 0.4
    acceleration[SHOULDER] = 3.0

    def report(search: DesignProgress) -> None:
        progress("designing the motion", 0.08 + 0.47 * search.fraction)

    shapes = jid.robots.tx90l_on_rail_collision()
    return jid.design_excitation(
        base,
        criterion=jid.criteria.ConditionNumber(),
        basis=jid.trajectories.FourierBasis(HARMONICS, OMEGA),
        limits=dataclasses.replace(
            limits,
            position_min=position_min,
            position_max=position_max,
            acceleration=acceleration,
        ),
        constraints=(jid.constraints.Clearance(shapes),),
        starts=2,
        generations=0,
        samples=SAMPLES,
        key=jax.random.key(seed),
        progress=report,
        throw=False,
    )
