"""Motion and forces of a log at the full rate, in memory or on disk."""

import abc
import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, JointSamples
from jaxid.dynamics.motion import Motion
from jaxid.robot.limits_and_drives import of_joints
from jaxid.robot.robot import Robot

from .time_grid import Range

MotionAndForces = tuple[Motion, JointSamples]
"""Motion, and forces [N m or N], at the same samples."""


class AbstractSamples(eqx.Module):
    """Motion and forces at the full rate, joint side, in memory or on disk."""

    @abc.abstractmethod
    def read(self, samples: slice) -> MotionAndForces:
        """Return motion and forces of some samples of one segment."""

    @abc.abstractmethod
    def read_all(self) -> MotionAndForces:
        """Return motion and forces of all segments."""


class SamplesInMemory(AbstractSamples):
    """Filtered motion and unfiltered forces [N m or N] as arrays."""

    motion: Motion
    forces: JointSamples

    def read(self, samples):  # noqa: D102
        return self.motion[samples], np.asarray(self.forces)[samples]

    def read_all(self):  # noqa: D102
        return self.motion, self.forces


class Chunk(NamedTuple):
    """Part of the observations whose columns fit into memory."""

    # half-open range of samples whose columns are needed (rows and overlap)
    samples: Range
    rows: Range  # half-open range of the resulting rows
    # function that turns columns at these samples into these rows
    reduce: Callable[[AnyArray], np.ndarray]


class Overlap(NamedTuple):
    """Samples that filters need beside those of the rows."""

    edge: int  # samples to drop at both ends of a segment
    smoothing: int  # memory of the filter of columns
    step: int  # samples for each row

    def chunk(
        self,
        segment: Range,
        first_row: int,
        rows: Range,
        reduce: Callable[..., Any],
    ) -> Chunk:
        """Return the part of a segment for some rows.

        Args:
            segment: Samples of the segment.
            first_row: First row of the segment.
            rows: Rows.
            reduce: Function of the samples between the edges, and columns, that returns
                the rows.
        """
        first_sample = segment[0] + self.edge
        start = first_sample + (rows[0] - first_row) * self.step
        stop = first_sample + (rows[1] - 1 - first_row) * self.step + 1
        begin = max(segment[0], start - self.smoothing)
        end = min(segment[1], stop + self.smoothing)
        samples = slice(start - begin, stop - begin)
        return Chunk((begin, end), rows, functools.partial(reduce, samples))


def joined(parts: Iterable[Any]) -> Any:
    """Return trees of arrays, such as motions and forces, one behind the other."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def joint_side(
    robot: Robot,
    log: Any,
    angles: AnyArray,
    velocities: AnyArray | None,
    forces: AnyArray,
) -> Any:
    """Convert angles, velocities and forces to the joints' side.

    `log` is a recording, or `Columns`.
    """
    drives = of_joints(robot.drives, robot.driven)
    q = np.asarray(angles)
    qd = None if velocities is None else np.asarray(velocities)
    forces = np.asarray(forces)
    if log.angles_on_motor_side:
        q = drives.joint_angles(q)
        qd = None if qd is None else drives.joint_velocities(qd)
    if log.forces_on_motor_side:
        forces = drives.joint_forces(forces)
    return q, qd, forces
