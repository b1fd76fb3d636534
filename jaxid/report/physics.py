"""Figures of what a model says of its robot: friction, weight, and what its file claimed."""

from collections.abc import Sequence

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.motion import Motion
from jaxid.identification.fit_result import Fit
from jaxid.result_table import Column, Table, percent, shortened, significant
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import BLUE, CYCLE, GREY, MEASURED, Curve, Panel
from .motion import pose_figure

ROWS = 2000
"""Largest number of poses whose weight is computed."""
CLASSES = 24
"""Classes of speed whose mean friction is shown."""


def friction_figure(fit: Fit, logs: Sequence[TorqueErrors]) -> Figure:
    """Return friction against speed for every joint, with 95 % bands.

    Points are measured: means over classes of speed of all forces that the model does
    not explain by anything but friction.

    Args:
        fit: Identified parameters.
        logs: Errors on some recordings.
    """
    robot = fit.base.model.robot
    fastest = np.max([np.max(np.abs(e.speeds), axis=0) for e in logs], axis=0)
    shape = np.linspace(-1.0, 1.0, 81)
    # Denser near standstill, where friction changes most.
    speeds = (np.sign(shape) * shape**2)[:, None] * fastest
    values, halves = _friction(fit, speeds)

    def panel(j: int) -> Panel:
        v, y = speeds[:, j], values[:, j]
        curves = [Curve(v, y, "model", BLUE, width=1.4)]
        if np.isfinite(halves[:, j]).all():
            low, high = y - halves[:, j], y + halves[:, j]
            curves.insert(
                0, Curve(v, y, "95 % band", MEASURED, "band", low=low, high=high)
            )
        places, means = _classes(logs, j, v, y)
        curves.append(
            Curve(places, means, "measured, mean of a class of speed", GREY, "points")
        )
        unit = robot.force_unit(j)
        return Panel(
            curves,
            title=shortened(robot.joint_names[j], 26),
            value=f"{significant(float(np.interp(fastest[j], v, y)), 2)} {unit} at "
            "full speed",
            x=f"speed [{robot.joint_unit(j)}/s]",
            y="friction",
            unit=unit,
            levels=[("y", 0.0, GREY)],
        )

    panels = [panel(j) for j in range(robot.joints) if fastest[j] > 0]
    return Figure(f"{robot.name}: friction of the joints", panels, min(3, len(panels)))


def _friction(
    fit: Fit, speeds: Float[np.ndarray, "speeds joints"]
) -> tuple[np.ndarray, ...]:
    """Return friction of joints that move alone, and half the widths of its 95 % intervals."""
    base, n = fit.base, speeds.shape[1]
    moving = np.zeros((len(speeds) + 1, n, n))
    moving[:-1, np.arange(n), np.arange(n)] = speeds
    qd = moving.reshape(-1, n)
    theta = _steady_columns(base, np.zeros_like(qd), qd)
    own = theta.reshape(len(speeds) + 1, n, n, -1)[:, np.arange(n), np.arange(n)]
    # Without speed there is weight only.
    own = own[:-1] - own[-1]
    variances = np.einsum(
        "vjk,kl,vjl->vj", own, np.nan_to_num(fit.covariance, posinf=0.0), own
    )
    unknown = ~np.isfinite(np.diag(fit.covariance))
    halves = 1.96 * np.sqrt(np.maximum(variances, 0.0))
    halves[:, np.any(own[..., unknown] != 0.0, axis=(0, 2))] = np.nan
    return own @ np.asarray(fit.parameters), halves


def _classes(
    logs: Sequence[TorqueErrors], j: int, v: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean speeds of classes, and the means of measured friction in them."""
    speeds = np.concatenate([np.asarray(e.speeds)[:, j] for e in logs])
    errors = np.concatenate([e.errors[:, j] for e in logs])
    kept = np.isfinite(errors)
    speeds, friction = speeds[kept], np.interp(speeds[kept], v, y) - errors[kept]
    place = np.clip(
        (CLASSES * (speeds / v[-1] + 1.0) / 2.0).astype(int), 0, CLASSES - 1
    )
    counts = np.bincount(place, minlength=CLASSES)
    shown = counts >= 5
    sums = (np.bincount(place, x, CLASSES)[shown] for x in (speeds, friction))
    speed, force = (x / counts[shown] for x in sums)
    return speed, force


def gravity_figure(fit: Fit, log: TorqueErrors) -> Figure:
    """Return the torque that carries the weight of the robot along a recording.

    Args:
        fit: Identified parameters.
        log: Errors on the recording, with its positions.
    """
    robot, rows = fit.base.model.robot, _some(log)
    values = gravity_forces(fit, np.asarray(log.positions)[rows])
    curves = [
        Curve(
            np.asarray(log.time)[rows],
            values[:, j],
            shortened(name, 26),
            CYCLE[j % len(CYCLE)],
        )
        for j, name in enumerate(robot.joint_names)
    ]
    unit = " or ".join(dict.fromkeys(robot.force_unit(j) for j in range(robot.joints)))
    panel = Panel(curves, y="force of the weight", unit=unit)
    return Figure(
        f"Torque that carries the weight, along {shortened(log.name, 40)}",
        [panel],
        height=3.2,
    )


def gravity_forces(
    fit: Fit, q: Float[np.ndarray, "rows joints"]
) -> Float[np.ndarray, "rows joints"]:
    """Return the forces of the drives against gravity at standstill [N m or N]."""
    base, model = fit.base, fit.base.model
    bodies = [
        bool(t.body_parameters) for t in model.terms for _ in t.parameters(model.robot)
    ]
    p = np.where([bodies[k] for k in base.indices], fit.parameters, 0.0)
    return _steady_columns(base, q, np.zeros_like(q)) @ p


def _steady_columns(base: BaseParameters, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the base regressor at constant speeds, with settled friction."""
    law = base.model.memory
    state = None if law is None else np.asarray(law.settled(qd))
    motion = Motion(q, qd, np.zeros_like(q), state)
    return in_numpy(base, base.columns, *base.model.arguments(motion))


def _some(log: TorqueErrors) -> np.ndarray:
    """Return rows of a recording in which its slow changes are seen."""
    rows = len(log.time)
    return np.unique(np.linspace(0, rows - 1, min(rows, ROWS)).round().astype(int))


def gravity_table(fit: Fit, log: TorqueErrors) -> Table:
    """Return the largest force against gravity of each joint along a recording."""
    robot = fit.base.model.robot
    most = np.max(
        np.abs(gravity_forces(fit, np.asarray(log.positions)[_some(log)])), axis=0
    )
    # What is rounding is zero.
    most[most < 1e-9 * np.max(most)] = 0.0
    columns = [
        Column("joint", robot.joint_names),
        Column("largest torque\nof the weight", most),
        Column("unit", [robot.force_unit(j) for j in range(robot.joints)]),
    ]
    share = most / np.asarray(log.max_forces)
    if np.isfinite(share).all():
        columns.append(Column("of the largest\nthe drive has", share, "%", percent))
    return Table("", *columns)


def error_scene(fit: Fit, log: TorqueErrors) -> Figure:
    """Return the robot along a recording, coloured by the torque errors of its joints."""
    robot, largest = fit.base.model.robot, np.asarray(log.max_forces)
    known = bool(np.isfinite(largest).all())
    scale = largest if known else np.maximum(log.force_rms, 1e-300)
    what = "largest torque" if known else "RMS torque"
    return pose_figure(
        robot,
        np.asarray(log.positions),
        title=f"{robot.name} along {shortened(log.name, 40)}",
        time=np.asarray(log.time),
        values=100.0 * log.errors / scale,
        label=f"torque error [% of {what}]",
    )
