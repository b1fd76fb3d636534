"""Rows at rest, where dry friction takes any value and hides how good a model is."""

import numpy as np

from jaxid.arrays import Texts
from jaxid.result_table import significant

from .descriptions import DescribedLog
from .filtered_log import REST_SPEED
from .row_fits import Judge

MIN_ERROR = 0.1
"""RMS error of a joint over its RMS force, on unseen parts, from which rest is told.

On clean logs of the setting machines with pauses it was at most 0.07, on others less.
"""
MAX_REMAINDER = 0.5
"""Share of that error that remains if rows at rest are left out."""


def rest_remarks(described_log: DescribedLog) -> Texts:
    """Return a sentence if the rows at rest are most of what a model misses."""
    moving_judge = described_log.judge
    judge = Judge(np.ones_like(moving_judge.mask), moving_judge.folds)
    rows = described_log.rows
    errors = rows.relative_errors(judge.unseen_squares(rows))
    moving_errors = rows.relative_errors(moving_judge.unseen_squares(rows))
    is_halved = moving_errors < MAX_REMAINDER * errors
    is_told = (errors > MIN_ERROR) & is_halved & moving_judge.is_judged
    if not is_told.any():
        return ()
    worst_joint = int(np.argmax(errors * is_told))
    robot = described_log.robot
    joint_names = np.array(robot.joint_names)
    names = ", ".join(f"`{name}`" for name in joint_names[is_told])
    speeds = REST_SPEED * np.abs(described_log.log.motion.qd).max(axis=0)
    texts = ", ".join(f"{speeds[joint]:.2g}" for joint in robot.driven)
    return (
        f"the motion does not determine friction at rest: on unseen parts of {names} "
        f"the errors are up to {significant(100 * errors[worst_joint], 2)} % of the "
        f"forces, and {significant(100 * moving_errors[worst_joint], 2)} % without "
        f"rows at rest: leave these rows out by `min_speed = [{texts}]` in `[rows]`.",
    )
