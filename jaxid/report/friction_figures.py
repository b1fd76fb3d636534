"""Figures of a model's view of its robot: friction, and errors along a motion."""

from collections.abc import Sequence

import numpy as np

from jaxid.arrays import Matrix, Vector
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.identification.fit_result import Fit
from jaxid.program.sample_methods import in_numpy
from jaxid.result_table import significant
from jaxid.robot.collision_geometry import BodyShape
from jaxid.robot.loop_closing import reachable
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import BLUE, GREY, MEASUREMENT_COLOUR, Curve, Panel
from .motion_figures import pose_figure, surface_points

SPEED_CLASSES = 24
"""Classes of speed whose mean friction is shown."""
MIN_CLASS_ROWS = 5
"""Smallest number of rows whose mean friction is shown."""


def friction_figure(fit: Fit, logs: Sequence[TorqueErrors]) -> Figure:
    """Return friction against speed for every joint, with 95 % bands.

    Points are measured: means over classes of speed of all forces that the model does
    not explain by anything but friction.

    Args:
        fit: Identified parameters.
        logs: Errors on some recordings.
    """
    robot = fit.base.model.robot
    max_speeds = np.max([np.max(np.abs(log.speeds), axis=0) for log in logs], axis=0)
    # Denser near standstill, where friction changes most.
    grid = np.linspace(-1.0, 1.0, 81)
    speeds = np.outer(np.sign(grid) * grid**2, max_speeds)
    columns = _friction_columns(fit.base, speeds)
    friction = columns @ fit.parameters
    half_widths = _half_widths(fit, columns)

    measured_speeds = np.concatenate([log.speeds for log in logs])
    errors = np.concatenate([log.errors for log in logs])
    panels = []
    for j in robot.driven:
        if max_speeds[j] == 0.0:
            continue
        model = Curve(speeds[:, j], friction[:, j], "model", BLUE, width=1.4)
        curves = [model, _measured_friction(model, measured_speeds[:, j], errors[:, j])]
        if np.isfinite(half_widths[:, j]).all():
            curves.insert(0, _confidence_band(model, half_widths[:, j]))
        unit = robot.force_unit(j)
        force_text = significant(friction[-1, j], 2)
        panels.append(
            Panel(
                curves,
                title=robot.joint_names[j],
                value=f"{force_text} {unit} at full speed",
                x=f"speed [{robot.joint_unit(j)}/s]",
                y="friction",
                unit=unit,
                levels=[("y", 0.0, GREY)],
            )
        )
    return Figure(f"{robot.name}: friction of the joints", panels, min(3, len(panels)))


def _friction_columns(base: BaseParameters, speeds: Matrix) -> np.ndarray:
    """Return the columns of the friction of joints that move alone."""
    count, joints = speeds.shape
    # Each joint moves alone at each speed; in the last sample all stand still.
    moving_joints = np.arange(joints)
    qd = np.zeros((count + 1, joints, joints))
    qd[:-1, moving_joints, moving_joints] = speeds
    samples = qd.reshape(-1, joints)
    q = reachable(base.model.robot, np.zeros_like(samples))
    theta = _steady_columns(base, q, samples)
    # In closed loops a joint that moves alone moves bodies in curves.
    theta[..., _is_of_body(base)] = 0.0
    blocks = theta.reshape(count + 1, joints, joints, -1)
    columns = blocks[:, moving_joints, moving_joints]
    # At standstill there is gravity only.
    return columns[:-1] - columns[-1]


def _half_widths(fit: Fit, columns: np.ndarray) -> Matrix:
    """Return half the widths of 95 % intervals; NaN where they are undetermined."""
    covariance = np.nan_to_num(fit.covariance, posinf=0.0)
    variances = np.einsum("vjk,kl,vjl->vj", columns, covariance, columns)
    half_widths = 1.96 * np.sqrt(np.maximum(variances, 0.0))
    is_undetermined = ~np.isfinite(np.diag(fit.covariance))
    is_affected = np.any(columns[..., is_undetermined] != 0.0, axis=(0, 2))
    half_widths[:, is_affected] = np.nan
    return half_widths


def _confidence_band(model: Curve, half_widths: Vector) -> Curve:
    """Return the band of 95 % around the friction of the model."""
    low = model.y - half_widths
    high = model.y + half_widths
    return Curve(
        model.x, model.y, "95 % band", MEASUREMENT_COLOUR, "band", low=low, high=high
    )


def _measured_friction(model: Curve, speeds: Vector, errors: Vector) -> Curve:
    """Return means of measured friction over classes of speed.

    Measured friction is that of the model less the torque errors.
    """
    is_counted = np.isfinite(errors)
    speeds = speeds[is_counted]
    friction = np.interp(speeds, model.x, model.y) - errors[is_counted]
    max_speed = model.x[-1]
    edges = np.linspace(-max_speed, max_speed, SPEED_CLASSES + 1)
    classes = np.digitize(speeds, edges[1:-1])

    counts = np.bincount(classes, minlength=SPEED_CLASSES)
    is_shown = counts >= MIN_CLASS_ROWS
    speed_sums = np.bincount(classes, speeds, SPEED_CLASSES)
    friction_sums = np.bincount(classes, friction, SPEED_CLASSES)
    mean_speeds = speed_sums[is_shown] / counts[is_shown]
    mean_friction = friction_sums[is_shown] / counts[is_shown]
    name = "measured, mean in a range of speeds"
    return Curve(mean_speeds, mean_friction, name, GREY, "points")


def _is_of_body(base: BaseParameters) -> np.ndarray:
    """Return which base parameters are led by one of a body."""
    model = base.model
    is_of_body = [
        np.full(len(term.parameters(model.robot)), bool(term.body_parameters))
        for term in model.terms
    ]
    return np.concatenate(is_of_body)[list(base.indices)]


def _steady_columns(base: BaseParameters, q: Matrix, qd: Matrix) -> np.ndarray:
    """Return the base regressor at constant speeds, with settled friction."""
    law = base.model.memory
    state = None if law is None else np.asarray(law.settled(qd))
    motion = Motion(q, qd, np.zeros_like(q), state)
    return in_numpy(base, base.columns, *base.model.arguments(motion))


def error_scene(
    fit: Fit, log: TorqueErrors, shapes: Sequence[BodyShape] = ()
) -> Figure:
    """Return the robot along a recording, coloured by its joints' torque errors."""
    robot = fit.base.model.robot
    scale = log.max_forces
    reference = "largest torque"
    if not np.isfinite(scale).all():
        scale = np.maximum(log.force_rms, np.finfo(float).tiny)
        reference = "RMS torque"
    clouds = [(body, surface_points(shape)) for body, shape in shapes]
    return pose_figure(
        robot,
        log.positions,
        title=f"{robot.name} along {log.name}",
        time=log.time,
        values=100.0 * log.errors / scale,
        label=f"torque error [% of {reference}]",
        # A hull needs four points.
        clouds=[cloud for cloud in clouds if len(cloud[1]) > 3],
    )
