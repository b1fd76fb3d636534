"""Validation: torque errors, and definiteness of the mass matrix (Eq. 37, Sec. 5)."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Joints,
    JointSamples,
    Matrix,
    Texts,
    Vector,
    relative_norm,
)
from jaxid.identification.estimators import ResidualVariances, WeightedLeastSquares
from jaxid.identification.fit_result import Fit
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import Observations, ObservedLogs, Progress
from jaxid.program.sample_methods import in_numpy
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    percent,
)
from jaxid.robot.loop_closing import reachable

POSES = 2000
"""Random poses in which the mass matrix is evaluated."""
MAX_ROWS = 2**18
"""Largest number of rows that are compared."""
REST_SHARE = 0.01
"""Fraction of a joint's largest speed up to which it stands."""
OCTAVES = 6
"""Number of times that a joint's largest speed is halved for classes of its speed."""
BLOCKS = 12
"""Blocks of time whose errors are compared."""
MIN_DUTY = 0.2
"""Share of its largest force that a joint is expected to do at least."""


class TorqueErrors(eqx.Module):
    """Measured and predicted forces of one recording, and their differences.

    Attributes:
        name: Name of the recording.
        time: Times of the rows [s].
        measured: Measured forces, filtered and decimated [N m or N].
        predicted: Forces of the model, filtered and decimated alike [N m or N].
        counted: Rows that count, for each joint.
        max_forces: Largest force of each joint [N m or N]; NaN where not known.
        speeds: Velocities, filtered and decimated alike [rad/s or m/s].
        unexplained: Errors of the same model fitted to this recording alone: what no
            parameters of it explain; NaN where a row does not count [N m or N].
        positions: Coordinates, filtered and decimated alike [rad or m].
        band: Cut-off frequency of the filter of all forces [Hz]: errors of different
            bands cannot be compared.
    """

    name: str = eqx.field(static=True)
    time: AnyArray
    measured: JointSamples
    predicted: JointSamples
    counted: AnyArray
    max_forces: Joints
    speeds: JointSamples
    unexplained: JointSamples
    positions: JointSamples
    band: float = eqx.field(static=True, default=np.inf)

    @property
    def band_words(self) -> str:
        """The band in words for the end of a sentence; nothing without a filter."""
        return f" below {self.band:.3g} Hz" if np.isfinite(self.band) else ""

    @property
    def errors(self) -> Matrix:
        """Predicted minus measured forces [N m or N] (Eq. 27).

        NaN where a row does not count.
        """
        return np.asarray(self.predicted) - self.counted_forces

    @property
    def mean(self) -> Vector:
        """Mean absolute error of each joint [N m or N] (Eq. 37)."""
        return _means(np.abs(self.errors))

    @property
    def rms(self) -> Vector:
        """RMS error of each joint [N m or N]."""
        return np.sqrt(_means(self.errors**2))

    @property
    def mean_percent(self) -> Vector:
        """Mean absolute errors in percent of the largest force (Eq. 37)."""
        return 100.0 * self.mean / np.asarray(self.max_forces)

    @property
    def depend_on_speed(self) -> tuple[bool, ...]:
        """Whether errors of each joint depend on its speed: friction of another shape.

        Then means of unexplained errors over classes of speed agree between blocks of
        time: more than after nearly any change of the blocks' signs, which leaves noise
        as it is (randomisation test, Fisher). They make up a tenth of the squared
        errors at least.
        """
        # One log of a hundred gives a false alarm.
        limit = 0.01 / self.errors.shape[1]
        pairs = zip(
            *(np.asarray(x).T for x in (self.unexplained, self.speeds)), strict=True
        )
        return tuple(_chance(e, v) <= limit for e, v in pairs)

    @property
    def force_rms(self) -> Vector:
        """RMS of the measured forces of each joint [N m or N]."""
        return np.sqrt(_means(self.counted_forces**2))

    @property
    def rms_relative(self) -> Vector:
        """RMS errors over the RMS of the measured forces; NaN without any force."""
        return _ratio(self.rms, self.force_rms)

    @property
    def relative(self) -> float:
        r"""Norm of all errors over the norm of all forces, $|Wp - Q| / |Q|$."""
        return relative_norm([self.errors], [self.counted_forces])

    @property
    def counted_forces(self) -> np.ndarray:
        """Measured forces [N m or N]; NaN where a row does not count."""
        return np.where(self.counted, np.asarray(self.measured), np.nan)


def _means(values: np.ndarray) -> Vector:
    """Return the means of columns over rows that count; NaN where none does."""
    counts = np.isfinite(values).sum(axis=0)
    return _ratio(np.nansum(values, axis=0), counts)


def _chance(errors: Vector, speeds: Vector) -> float:
    """Return the probability of errors whose means over classes of speed agree as much.

    It is one if these means make up less than a tenth of the squared errors.
    """
    row_mask = np.isfinite(errors)
    counted_errors = errors[row_mask]
    counted_speeds = speeds[row_mask]
    if (
        len(counted_errors) < BLOCKS
        or not counted_speeds.any()
        or not counted_errors.any()
    ):
        return 1.0
    octave = np.log2(
        np.maximum(np.abs(counted_speeds) / np.abs(counted_speeds).max(), 0.5**OCTAVES)
    )
    classes = (2 * np.round(octave + OCTAVES) + (counted_speeds < 0)).astype(int)
    sums = np.zeros((BLOCKS, 2 * OCTAVES + 2))
    np.add.at(
        sums,
        (np.arange(len(counted_errors)) * BLOCKS // len(counted_errors), classes),
        counted_errors,
    )
    sums /= np.sqrt(np.maximum(np.bincount(classes, minlength=sums.shape[1]), 1))
    products = np.triu(sums @ sums.T, 1)
    if 2.0 * products.sum() * BLOCKS / (BLOCKS - 1) < 0.1 * np.sum(counted_errors**2):
        return 1.0
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=BLOCKS - 1)))
    signs = np.column_stack([np.ones(len(signs)), signs])
    agreement = np.sum((signs @ products) * signs, axis=1)
    return float(np.mean(agreement >= agreement[0] - 1e-9 * np.abs(products).sum()))


def _ratio(
    numerator: np.ndarray | float, denominator: np.ndarray | float
) -> np.ndarray:
    """Return a ratio; NaN where the denominator is zero."""
    denominator = np.asarray(denominator, np.float64)
    return np.asarray(numerator / np.where(denominator > 0, denominator, np.nan))


class Definiteness(eqx.Module):
    """Eigenvalues of the mass matrix over random poses.

    Attributes:
        smallest: Smallest eigenvalue over all poses, of the mass matrix in SI units.
        pose: Joint coordinates where it occurs [rad or m].
        indefinite: Fraction (0 to 1) of the poses in which an eigenvalue is not
            positive.
        poses: Number of poses.
    """

    smallest: float
    pose: Joints
    indefinite: float
    poses: int = eqx.field(static=True)

    @property
    def positive_definite(self) -> bool:
        """Whether every eigenvalue is positive in every pose."""
        return self.smallest > 0.0

    def __str__(self) -> str:
        if self.positive_definite:
            return f"The mass matrix is positive definite in all of {self.poses} poses."
        return (
            f"The mass matrix is indefinite in {percent(self.indefinite)} % of "
            f"{self.poses} poses; its smallest eigenvalue is {self.smallest:.2g}."
        )


class Validation(Summarised, eqx.Module):
    """Torque errors on recordings, and definiteness of the mass matrix.

    Attributes:
        errors: Torque errors on each recording.
        definiteness: Definiteness of the mass matrix.
        joint_names: Names of the joints.
        units: Unit of each joint's force.
    """

    errors: tuple[TorqueErrors, ...]
    definiteness: Definiteness
    joint_names: Texts = eqx.field(static=True)
    units: Texts = eqx.field(static=True)

    def summary(self) -> Table:
        """Return a table: RMS errors, a row for each joint, a column for each log."""
        status = Status.GOOD if self.definiteness.positive_definite else Status.BAD
        return Table(
            "torque errors (RMS)",
            Column("joint", self.joint_names),
            *(Column(log.name, log.rms) for log in self.errors),
            Column("unit", self.units),
            remarks=[Remark(str(self.definiteness), status)],
        )

    def tables(self) -> list[Table]:
        """Return the errors, also relative to the forces."""
        groups = {log.name: [log] for log in self.errors}
        return [error_table(groups, self.joint_names), self.summary()]


def error_table(
    groups: Mapping[str, Sequence[TorqueErrors]], joint_names: Texts
) -> Table:
    """Return relative errors: a row for each joint, a column for each group of logs."""
    columns = []
    for name, logs in groups.items():
        errors_of_joints = relative_joint_errors(logs)
        has_rows = np.any([np.any(log.counted, axis=0) for log in logs], axis=0)
        shown_errors = np.where(has_rows, errors_of_joints, np.nan)
        errors = [*shown_errors, relative_error(logs)]
        columns.append(Column(name, errors, "%", percent))
    return Table(
        "torque errors (RMS) over torques (RMS)",
        Column("joint", [*joint_names, "all joints"]),
        *columns,
        rules=[len(joint_names)],
    )


def validate(
    fit: Fit,
    observations: ObservedLogs,
    *,
    progress: Progress | None = None,
) -> Validation:
    """Check a model: torque errors on recordings, and a definite mass matrix.

    Args:
        fit: Fit of the model.
        observations: One or several recordings, preferably not used for the fit.
        progress: Callback, called with the completed fraction (0 to 1) of each
            recording.
    """
    recordings = (
        (observations,) if isinstance(observations, Observations) else observations
    )
    robot = fit.base.model.robot
    return Validation(
        errors=tuple(torque_errors(fit, o, progress) for o in recordings),
        definiteness=definiteness(fit),
        joint_names=robot.joint_names,
        units=tuple(robot.force_unit(j) for j in range(robot.joints)),
    )


def torque_errors(
    fit: Fit, observations: Observations, progress: Progress | None = None
) -> TorqueErrors:
    """Compare the forces that a model predicts with measured ones (Eqs. 27, 37).

    The prediction is filtered and decimated like the measurement, in parts. Of more
    than `MAX_ROWS` rows every n-th is compared.
    """
    max_forces = fit.base.model.robot.known_max_forces
    observations = with_memory(observations, fit.base.model.memory)
    step = comparison_step(observations)
    mask = np.asarray(observations.mask)
    estimator = WeightedLeastSquares(ResidualVariances())
    problem = RegressionProblem(fit.base, [observations])
    refitted_parameters = estimator(problem).parameters
    # Measured, predicted and refitted forces, speeds and positions.
    compared_rows = np.zeros((5, len(mask[::step]), observations.joints))
    for chunk in observations.chunks(65536):
        start, stop = chunk.rows
        # Masked parts are not evaluated.
        if mask[start:stop].any():
            motion, forces = observations.read(slice(*chunk.samples))
            tool = fit.base.tool_forces(motion)
            predicted_forces = fit.predict(motion) + tool
            refitted_forces = fit.base.forces_in_numpy(refitted_parameters, motion)
            refitted_forces = refitted_forces + tool
            # Rows 0, step, 2 step, ... of the log, as far as they lie in the chunk.
            rows = slice(-(-start // step), -(-stop // step))
            chunk_rows = slice(rows.start * step - start, None, step)
            samples = (forces, predicted_forces, refitted_forces, motion.qd, motion.q)
            for number, x in enumerate(samples):
                compared_rows[number, rows] = chunk.reduce(x)[chunk_rows]
        if progress is not None:
            progress(stop / observations.rows)
    measured_forces, predicted_forces, refitted_forces, speeds, positions = (
        compared_rows
    )
    return TorqueErrors(
        name=observations.name,
        time=observations.reduced_time[::step],
        measured=measured_forces,
        predicted=predicted_forces,
        counted=mask[::step],
        max_forces=np.where(np.isfinite(max_forces), max_forces, np.nan),
        speeds=speeds,
        unexplained=np.where(mask[::step], refitted_forces - measured_forces, np.nan),
        positions=positions,
        band=observations.filter.low_pass(observations.sample_time).cutoff,
    )


def errors_of_parameters(
    fit: Fit, parameters: AnyArray, logs: Sequence[Observations]
) -> tuple[TorqueErrors, ...]:
    """Return torque errors of other parameters of the model of a fit."""
    other_fit = dataclasses.replace(fit, parameters=parameters)
    return tuple(torque_errors(other_fit, log) for log in logs)


def relative_error(logs: Sequence[TorqueErrors]) -> float:
    """Return the RMS error over the RMS force of some logs, as if they were one."""
    return _relative([log.errors for log in logs], logs)


def error_words(fit: Fit) -> str:
    """Return what the errors of all rows are: on legs the weight is most of it."""
    is_on_legs = fit.base.model.robot.floating
    return "error of forces on trunk and joints" if is_on_legs else "torque error"


def unexplained_error(logs: Sequence[TorqueErrors]) -> float:
    """Return the relative error that remains if the model is fitted to each log."""
    return _relative([log.unexplained for log in logs], logs)


def _relative(errors: Sequence[AnyArray], logs: Sequence[TorqueErrors]) -> float:
    """Return the norm of errors over that of the forces of all logs; 0 without any."""
    ratio = relative_norm(errors, [log.counted_forces for log in logs])
    return float(np.nan_to_num(ratio))


def relative_joint_errors(logs: Sequence[TorqueErrors]) -> Vector:
    """Return each joint's RMS error over its RMS force, as if some logs were one."""
    errors = _pooled_rms([log.errors for log in logs])
    forces = _pooled_rms([log.counted_forces for log in logs])
    return np.nan_to_num(_ratio(errors, forces))


def joint_errors(logs: Sequence[TorqueErrors]) -> Vector:
    """Return each joint's RMS error over what it must do, as if some logs were one.

    A joint must do its RMS force, and a fifth of its largest force at least: errors of
    a joint that hardly works matter little. The largest force is the limit of the
    joint, or that of the logs where no limit is known.
    """
    limits = np.asarray(logs[0].max_forces)
    forces = [log.counted_forces for log in logs]
    peaks = np.abs(np.nan_to_num(np.concatenate(forces))).max(axis=0)
    max_forces = np.where(np.isfinite(limits), limits, peaks)
    duties = np.maximum(_pooled_rms(forces), MIN_DUTY * max_forces)
    errors = _pooled_rms([log.errors for log in logs])
    return np.nan_to_num(_ratio(errors, duties))


def _pooled_rms(logs: Sequence[np.ndarray]) -> Vector:
    """Return the RMS of each joint over the rows that count of some logs; 0 without."""
    return np.nan_to_num(np.sqrt(_means(np.concatenate(logs) ** 2)))


def comparison_step(observations: Observations) -> int:
    """Return the n of the observations of which every n-th row is compared."""
    return -(-observations.rows // MAX_ROWS)


def definiteness(fit: Fit, poses: int = POSES) -> Definiteness:
    """Look for random poses with a mass matrix that is not positive definite (Sec. 5).

    They are spread over the range of the joints. A joint without limits turns once, a
    rail without limits stays within a metre of zero.
    """
    robot = fit.base.model.robot
    half_range = np.where(np.array(robot.revolute), np.pi, 1.0)
    lower_limits = np.asarray(robot.limits.position_min)
    upper_limits = np.asarray(robot.limits.position_max)
    lower_limits = np.where(np.isfinite(lower_limits), lower_limits, -half_range)
    upper_limits = np.where(np.isfinite(upper_limits), upper_limits, half_range)
    q = np.random.default_rng(0).uniform(
        lower_limits, upper_limits, (poses, robot.joints)
    )
    q = reachable(robot, q)
    M = in_numpy(fit.base, fit.base.inertia, q, shared=(fit.parameters,))
    if robot.has_base_sensor:
        # Base parameters describe a base that stands still.
        M = M[:, robot.driven][:, :, robot.driven]
    min_eigenvalues = np.linalg.eigvalsh(M)[:, 0]
    worst_pose = int(np.argmin(min_eigenvalues))
    return Definiteness(
        float(min_eigenvalues[worst_pose]),
        q[worst_pose],
        float(np.mean(min_eigenvalues <= 0.0)),
        poses,
    )
