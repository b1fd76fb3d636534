"""Evidence that something held the robot: a height at which it stops.

A difference between measured and simulated positions is an error of the model, unless
the geometry shows a contact. On a table, a point of the robot stays at one height while
the simulation goes on below it, and elsewhere the simulation is right. The evidence
only names a place: every sample counts in all errors.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Vector
from jaxid.result_table import Remark, Status
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.robot import Robot

from .errors import RolloutErrors

HEIGHT_COUNT = 200
"""Heights that are tried for the table."""


class ContactThresholds(NamedTuple):
    """Bounds within which errors are those of a contact.

    They were set on arms of three and four joints on MuJoCo. In 26 contacts with a
    table, in half of them with masses that are wrong by 20 %, the share unexplained was
    0 to 0.72, the flatness 0.01 to 0.25, and the errors elsewhere 0.02 to 0.27 (with
    fits to the same logs up to 0.55). In 86 draws with errors of the model (masses,
    gains, friction, saturation, a joint that sticks), of 4 to 150 mrad RMS, the share
    unexplained was above 0.9, but for two: 0.87 and 0.85, with a flatness of 0.62 and
    0.48.

    Attributes:
        unexplained: Share of the squared errors of the height that a table leaves.
        flatness: Deviation of the measured height while the simulation is below the
            table, relative to the depth of the simulation.
        errors_elsewhere: Errors of the joints elsewhere, relative to those there.
        min_depth: Depth of the simulation below the table (RMS) [m].
        min_samples: Number of samples below the table.
        share: Share of the samples below the table: a height that the robot hardly
            leaves may be that of a joint that is stuck.
    """

    unexplained: float = 0.85
    flatness: float = 0.4
    errors_elsewhere: float = 0.6
    min_depth: float = 0.003
    min_samples: int = 20
    share: float = 0.9


THRESHOLDS = ContactThresholds()


class TableContact(NamedTuple):
    """A height below which a point of the robot does not move.

    Attributes:
        point: Name of the point.
        height: Height above the origin of the ground [m].
        below: Whether the simulation is below it, for the samples of all motions.
        depth: Depth of the simulation below it (RMS) [m].
        unexplained: Share of the squared errors of the height that it leaves.
    """

    point: str
    height: float
    below: np.ndarray
    depth: float
    unexplained: float


def contact_findings(robot: Robot, errors: RolloutErrors) -> list[Remark]:
    """Return where something held the robot; nothing without evidence.

    Args:
        robot: The robot, whose coordinates are the joints of the errors.
        errors: Measured and simulated positions.
    """
    table = find_table(robot, errors)
    if table is None:
        return []
    sizes = [len(time) for time in errors.time]
    motions = np.repeat(np.arange(len(sizes)), sizes)[errors.is_counted]
    times = np.concatenate(errors.time)[errors.is_counted]
    motion = np.bincount(motions[table.below]).argmax()
    span = times[table.below & (motions == motion)]
    text = (
        f"Something seems to support {table.point} at a height of {table.height:.3f} "
        f"m: the simulation goes {1e3 * table.depth:.0f} mm below it, most often in "
        f"{errors.motions[motion]} between {span[0]:.1f} and {span[-1]:.1f} s. These "
        "samples are included in all errors: leave them out of the logs"
    )
    return [Remark(text, Status.DOUBTFUL)]


def find_table(robot: Robot, errors: RolloutErrors) -> TableContact | None:
    """Return the table that explains most errors; None without evidence."""
    # Contacts that were given are known.
    is_counted = errors.is_counted
    measured = np.concatenate(errors.measured, axis=1).T[is_counted]
    simulated = np.concatenate(errors.simulated, axis=1).T[is_counted]
    squares = np.sum((measured - simulated) ** 2, axis=1)
    up = -np.asarray(robot.gravity)
    up /= max(np.linalg.norm(up), 1e-9)
    points = {"the end-effector": robot}
    for body, name in enumerate(robot.body_names):
        points[f"the origin of `{name}`"] = dataclasses.replace(
            robot, tip_body=body, tip_offset=np.zeros(3)
        )
    tables = []
    for point, carrier in points.items():
        measured_heights = tip_jacobian(carrier, measured).position @ up
        simulated_heights = tip_jacobian(carrier, simulated).position @ up
        table = _fit_table(point, measured_heights, simulated_heights, squares)
        if table is not None:
            tables.append(table)
    return min(tables, key=lambda x: x.unexplained, default=None)


def _fit_table(
    point: str, measured: Vector, simulated: Vector, squares: Vector
) -> TableContact | None:
    """Return the table that explains most errors of a point's height.

    Args:
        point: Name of the point.
        measured: Measured heights of all samples [m].
        simulated: Simulated heights.
        squares: Squared errors, summed over the joints.
    """
    heights = np.linspace(measured.min(), np.median(measured), HEIGHT_COUNT)
    # On a table, the height is the simulated one as far as it is above.
    remaining_squares = [
        np.sum((measured - np.maximum(simulated, height)) ** 2) for height in heights
    ]
    height = heights[np.argmin(remaining_squares)]
    below = simulated < height
    limits = THRESHOLDS
    if not limits.min_samples <= below.sum() <= limits.share * len(below):
        return None
    depth = np.sqrt(np.mean((height - simulated[below]) ** 2))
    unexplained = min(remaining_squares) / np.sum((measured - simulated) ** 2)
    errors_elsewhere = np.sqrt(squares[~below].mean() / squares[below].mean())
    is_contact = (
        unexplained < limits.unexplained
        and measured[below].std() < limits.flatness * depth
        and errors_elsewhere < limits.errors_elsewhere
        and depth > limits.min_depth
    )
    if not is_contact:
        return None
    return TableContact(point, height, below, depth, unexplained)
