"""Rows of the regression and the triangular factors to which they are reduced.

The rows of a joint depend only on the bodies beyond it. Columns and forces of a chunk
of samples are filtered and decimated alike, and reduced to the R factor of a QR
decomposition for each joint. Weights of the joints are applied to the factors
afterwards, and recordings are added by stacking factors. The observation matrix is
never held in memory.
"""

import functools
import itertools
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, BaseVector, Float, Indices, Joints, Matrices, Matrix
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.measurement.observations import Observations

Columns = Sequence[Indices]
"""Indices of the base parameters that can act on each joint."""


Ranges = Sequence[tuple[int, int]] | None
"""Half-open ranges of rows; None for all rows."""
LinearSystem = tuple[Matrix, BaseVector]
"""Matrix and right-hand side of linear equations of the base parameters."""


class RowChunk(NamedTuple):
    """Consecutive rows of one block of time, filtered and decimated."""

    recording: int  # index of the recording
    block: int  # index of the block of time, counted over all recordings
    rows: slice  # range of the recording's rows
    indices: Columns  # base parameters that can act on each joint
    columns: Matrices  # columns of each joint [rows, indices of the joint]
    # measured forces less those of a known tool [rows, joints], in [N m] or [N]
    forces: Matrix
    mask: np.ndarray  # rows that count for each joint [rows, joints]

    def part(self, rows: slice) -> "RowChunk":
        """Return the rows of a range of the recording, which lies within the chunk."""
        offset = self.rows.start
        selection = slice(rows.start - offset, rows.stop - offset)
        return self._replace(
            rows=rows,
            columns=[x[selection] for x in self.columns],
            forces=self.forces[selection],
            mask=self.mask[selection],
        )

    def divide(self, edges: Sequence[int]) -> "Iterator[RowChunk]":
        """Yield the parts in each block of time, by the first rows of the blocks."""
        for block, rows in divide_rows(edges, self.rows):
            yield self.part(rows)._replace(block=self.block + block)

    def residuals(self, p: BaseVector) -> Matrix:
        """Return measured less predicted forces [N m or N]."""
        predicted_forces = [
            theta @ p[list(indices)]
            for theta, indices in zip(self.columns, self.indices, strict=True)
        ]
        return self.forces - np.stack(predicted_forces, axis=1)

    def equations(self) -> Matrices:
        """Return the rows `[columns, force]` of each joint that count."""
        joints = zip(self.columns, self.forces.T, self.mask.T, strict=True)
        return [np.column_stack([theta, force])[mask] for theta, force, mask in joints]


def join_chunks(chunks: Sequence[RowChunk]) -> RowChunk:
    """Return the rows of chunks that follow each other in one recording."""
    columns = [
        np.concatenate(x) for x in zip(*(c.columns for c in chunks), strict=True)
    ]
    return chunks[0]._replace(
        rows=slice(chunks[0].rows.start, chunks[-1].rows.stop),
        columns=columns,
        forces=np.concatenate([chunk.forces for chunk in chunks]),
        mask=np.concatenate([chunk.mask for chunk in chunks]),
    )


def row_chunks(
    base: BaseParameters,
    observations: Observations,
    samples: int,
    ranges: Ranges = None,
) -> Iterator[RowChunk]:
    """Yield the rows of a recording by chunks of samples, not yet divided (Eq. 26).

    Only some ranges of rows are made, or all.
    """
    mask = observations.mask
    for chunk in observations.chunks(samples, ranges):
        motion, forces = observations.read(slice(*chunk.samples))
        forces = without_tool(base, motion, forces)
        rows = slice(*chunk.rows)
        yield RowChunk(
            recording=0,
            block=0,
            rows=rows,
            indices=base.acting_columns,
            columns=[chunk.reduce(theta) for theta in base.regressor_rows(motion)],
            forces=chunk.reduce(forces),
            mask=mask[rows],
        )


def without_tool(base: BaseParameters, motion: Motion, forces: AnyArray) -> Matrix:
    """Return measured forces less those of a known tool [N m or N]."""
    forces = np.asarray(forces)
    if base.model.robot.tool is None:
        return forces
    return forces - base.tool_forces(motion)


def divide_rows(edges: Sequence[int], rows: slice) -> Iterator[tuple[int, slice]]:
    """Yield each block of time that some rows reach into, with its part of the rows."""
    for block, (first_row, end_row) in enumerate(itertools.pairwise(edges)):
        start = max(first_row, rows.start)
        stop = min(end_row, rows.stop)
        if start < stop:
            yield block, slice(start, stop)


class JointFactor(eqx.Module):
    r"""The R factor of $[\Theta_j \; Q_j]$, the rows of one joint and their forces."""

    # base parameters that can act on the joint
    columns: Indices = eqx.field(static=True)
    # upper triangle, or fewer rows; its last column belongs to the forces
    R: Float[AnyArray, "height width"]
    rows: int = eqx.field(static=True)  # number of rows that were reduced to R

    def append(self, rows: Float[AnyArray, "height width"]) -> "JointFactor":
        """Return the factor after more rows `[columns, force]`."""
        R = np.asarray(np.linalg.qr(np.vstack([self.R, rows]), mode="r"))
        return JointFactor(self.columns, R, self.rows + len(rows))


class Factors(eqx.Module):
    """The factors of all joints."""

    joints: tuple[JointFactor, ...]  # factor of each joint
    size: int = eqx.field(static=True)  # number of base parameters

    def append(self, rows: Matrices) -> "Factors":
        """Return the factors after more rows `[columns, force]` of each joint."""
        pairs = zip(self.joints, rows, strict=True)
        return Factors(tuple(joint.append(x) for joint, x in pairs), self.size)

    def __add__(self, other: "Factors") -> "Factors":
        """Return the factors of both sets of rows together."""
        joints = []
        for joint, other_joint in zip(self.joints, other.joints, strict=True):
            R = joint.append(other_joint.R).R
            joints.append(JointFactor(joint.columns, R, joint.rows + other_joint.rows))
        return Factors(tuple(joints), self.size)

    @property
    def rows(self) -> np.ndarray:
        """Number of rows of each joint."""
        return np.array([joint.rows for joint in self.joints])

    def weighted(self, weights: Joints) -> LinearSystem:
        r"""Return the system with the norms of $W \Theta_B p$, $W Q$ (Eq. 29)."""
        blocks = []
        for joint, weight in zip(self.joints, weights, strict=True):
            block = np.zeros((len(joint.R), self.size + 1))
            block[:, [*joint.columns, -1]] = weight * joint.R
            blocks.append(block)
        R = np.asarray(np.linalg.qr(np.vstack(blocks), mode="r"))
        return R[:, :-1], R[:, -1]

    def residual_squares(self, p: BaseVector) -> Joints:
        """Return the sum of the squared residuals of each joint [N² m² or N²]."""
        # The factors hold columns and forces: `columns @ p - forces`.
        coefficients = np.append(p, -1.0)
        squares = []
        for joint in self.joints:
            residuals = joint.R @ coefficients[[*joint.columns, -1]]
            squares.append(np.sum(residuals**2))
        return np.array(squares)

    @property
    def force_squares(self) -> Joints:
        """Sum of the squared forces of each joint [N² m² or N²]."""
        return np.array([np.sum(joint.R[:, -1] ** 2) for joint in self.joints])


def empty_factors(columns: Columns, size: int) -> Factors:
    """Return factors of no rows, from each joint's columns and the number of all."""
    joints = []
    for indices in columns:
        no_rows = np.zeros((0, len(indices) + 1))
        joints.append(JointFactor(tuple(indices), no_rows, 0))
    return Factors(tuple(joints), size)


class Blocks(eqx.Module):
    """Factors of contiguous blocks of time, which together hold all rows."""

    parts: tuple[Factors, ...]  # factors of each block

    @property
    def total(self) -> Factors:
        """The factors of all rows."""
        return functools.reduce(operator.add, self.parts)

    def select(self, numbers: Iterable[int | np.integer]) -> "Blocks":
        """Return some of the blocks."""
        return Blocks(tuple(self.parts[k] for k in numbers))

    def scale_joints(self, factors: Joints) -> "Blocks":
        """Return the factors of rows multiplied by one factor for each joint."""
        parts = []
        for part in self.parts:
            joints = [
                JointFactor(joint.columns, factor * joint.R, joint.rows)
                for joint, factor in zip(part.joints, np.asarray(factors), strict=True)
            ]
            parts.append(Factors(tuple(joints), part.size))
        return Blocks(tuple(parts))
