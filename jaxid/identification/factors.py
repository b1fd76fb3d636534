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
import scipy

from jaxid.arrays import (
    AnyArray,
    BaseVector,
    Float,
    Indices,
    Joints,
    Matrices,
    Matrix,
    on_cores,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.measurement.observations import Observations

SAMPLES_PER_CHUNK = 4096
"""Samples whose columns a core evaluates at once."""
MAX_GROWTH = 1e4
"""Squared size of rows, in units of a triangle, up to which products lose no digits."""
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
    # Columns of each joint, followed by its measured force less that of a known tool
    # [N m or N], stand one after the other in memory.
    values: Matrix
    mask: np.ndarray  # rows that count for each joint [rows, joints]

    @property
    def systems(self) -> Matrices:
        """Columns and force of each joint [rows, indices of the joint and force]."""
        ends = np.cumsum([len(indices) + 1 for indices in self.indices])
        return np.split(self.values, ends[:-1], axis=1)

    @property
    def columns(self) -> Matrices:
        """Columns of each joint [rows, indices of the joint]."""
        return [system[:, :-1] for system in self.systems]

    @property
    def forces(self) -> Matrix:
        """Measured forces less those of a known tool [rows, joints], in [N m or N]."""
        return np.stack([system[:, -1] for system in self.systems], axis=1)

    def part(self, rows: slice) -> "RowChunk":
        """Return the rows of a range of the recording, which lies within the chunk."""
        offset = self.rows.start
        selection = slice(rows.start - offset, rows.stop - offset)
        return self._replace(
            rows=rows,
            values=self.values[selection],
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

    def equations(self) -> Iterator[Matrix]:
        """Yield the rows `[columns, force]` of each joint that count."""
        for system, mask in zip(self.systems, self.mask.T, strict=True):
            yield system if mask.all() else system.T[:, mask].T


def join_chunks(chunks: Sequence[RowChunk]) -> RowChunk:
    """Return the rows of chunks that follow each other in one recording."""
    return chunks[0]._replace(
        rows=slice(chunks[0].rows.start, chunks[-1].rows.stop),
        values=np.concatenate([chunk.values for chunk in chunks]),
        mask=np.concatenate([chunk.mask for chunk in chunks]),
    )


def row_chunks(
    base: BaseParameters,
    observations: Observations,
    samples: int = SAMPLES_PER_CHUNK,
    ranges: Ranges = None,
) -> Iterator[RowChunk]:
    """Yield the rows of a recording by chunks of samples, not yet divided (Eq. 26).

    Only some ranges of rows are made, or all.
    """
    mask = np.asarray(observations.mask)
    low_pass = observations.filter.low_pass(observations.sample_time)
    memory = low_pass.memory() + observations.decimation.memory()
    # Parts that are shorter than what filters add to them would take far longer.
    samples = max(samples, 4 * memory)
    regressor = base.joint_regressor

    def parts() -> Iterator[tuple]:
        for chunk in observations.chunks(samples, ranges):
            yield chunk, *observations.read(slice(*chunk.samples))

    def rows_of(part: tuple) -> RowChunk:
        chunk, motion, forces = part
        rows = slice(*chunk.rows)
        arguments = base.model.arguments(motion)
        columns = regressor.evaluate(*(np.asarray(x, float).T for x in arguments))
        joint_forces = without_tool(base, motion, forces).T
        pairs = zip(columns, joint_forces, strict=True)
        values = np.vstack([array for pair in pairs for array in pair])
        return RowChunk(
            recording=0,
            block=0,
            rows=rows,
            indices=regressor.columns,
            values=chunk.reduce(values.T),
            mask=mask[rows],
        )

    # One core makes the rows of a chunk; the next ones are read meanwhile.
    yield from on_cores(rows_of, parts())


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


def triangle_with_rows(R: Matrix, rows: Matrix) -> Matrix:
    """Return the R factor of a triangle above more rows.

    Products of many rows take a third of the time of their decomposition. In units of
    a triangle that knows all directions they lose no digits.
    """
    size = R.shape[1]
    if len(R) == size < len(rows) and np.diag(R).all():
        # An inverse of the triangle would lose digits where it is almost singular.
        relative_rows = scipy.linalg.blas.dtrsm(1.0, R, rows, side=1)
        products = np.eye(size) + relative_rows.T @ relative_rows
        if np.trace(products) < MAX_GROWTH:
            return np.linalg.cholesky(products).T @ R
    return np.asarray(np.linalg.qr(np.vstack([R, rows]), mode="r"))


class Factors(eqx.Module):
    """The factors of all joints."""

    joints: tuple[JointFactor, ...]  # factor of each joint
    size: int = eqx.field(static=True)  # number of base parameters

    def __add__(self, other: "Factors") -> "Factors":
        """Return the factors of both sets of rows together."""
        joints = []
        for joint, other_joint in zip(self.joints, other.joints, strict=True):
            R = triangle_with_rows(np.asarray(joint.R), np.asarray(other_joint.R))
            joints.append(JointFactor(joint.columns, R, joint.rows + other_joint.rows))
        return Factors(tuple(joints), self.size)

    @property
    def rows(self) -> np.ndarray:
        """Number of rows of each joint."""
        return np.array([joint.rows for joint in self.joints])

    def weighted(self, weights: Joints) -> LinearSystem:
        r"""Return the system with the norms of $W \Theta_B p$, $W Q$ (Eq. 29)."""
        blocks = []
        for joint, weight in zip(self.joints, np.asarray(weights), strict=True):
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


class GrowingFactors:
    """Factors of rows that come one after another.

    Args:
        columns: Base parameters that can act on each joint.
        size: Number of base parameters.
    """

    def __init__(self, columns: Columns, size: int):
        self._columns = columns
        self._size = size
        self._triangles = [np.zeros((0, len(indices) + 1)) for indices in columns]
        self._counts = [0 for _ in columns]

    def append(self, rows: Iterable[Matrix]) -> None:
        """Add more rows `[columns, force]` of each joint."""
        for joint, joint_rows in enumerate(rows):
            R = triangle_with_rows(self._triangles[joint], joint_rows)
            self._triangles[joint] = R
            self._counts[joint] += len(joint_rows)

    def result(self) -> Factors:
        """Return the factors of all rows so far."""
        columns = map(tuple, self._columns)
        joints = map(JointFactor, columns, self._triangles, self._counts)
        return Factors(tuple(joints), self._size)


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
