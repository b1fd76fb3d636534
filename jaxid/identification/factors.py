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

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.measurement.observations import Observations

Columns = Sequence[tuple[int, ...]]
"""Indices of the base parameters that can act on each joint."""


class RowChunk(NamedTuple):
    """Consecutive rows of one block of time, filtered and decimated."""

    recording: int  # index of the recording
    block: int  # index of the block of time, counted over all recordings
    rows: slice  # range of the recording's rows
    indices: Columns  # base parameters that can act on each joint
    columns: list[np.ndarray]  # columns of each joint [rows, indices of the joint]
    forces: (
        np.ndarray
    )  # measured forces less those of a known tool [rows, joints], in [N m] or [N]
    mask: np.ndarray  # rows that count for each joint [rows, joints]

    def part(self, selection: slice) -> "RowChunk":
        """Return some of the rows, counted from the first of the chunk."""
        start = self.rows.start
        return self._replace(
            rows=slice(start + selection.start, start + selection.stop),
            columns=[x[selection] for x in self.columns],
            forces=self.forces[selection],
            mask=self.mask[selection],
        )

    def divide(self, edges: Sequence[int]) -> "Iterator[RowChunk]":
        """Yield the parts that lie in each block of time, by the first rows of the blocks."""
        start = self.rows.start
        for block, own in divide_rows(edges, self.rows):
            part = self.part(slice(own.start - start, own.stop - start))
            yield part._replace(block=self.block + block)

    def residuals(self, p: np.ndarray) -> Float[np.ndarray, "rows joints"]:
        """Return measured less predicted forces [N m or N]."""
        pairs = zip(self.columns, self.indices, strict=True)
        return self.forces - np.stack(
            [theta @ p[list(own)] for theta, own in pairs], axis=1
        )

    def equations(self) -> list[np.ndarray]:
        """Return the masked rows `[columns, force]` of each joint."""
        joints = zip(self.columns, self.forces.T, self.mask.T, strict=True)
        return [np.column_stack([theta, force])[kept] for theta, force, kept in joints]


def row_chunks(
    base, observations: Observations, samples: int, wanted=None
) -> Iterator[RowChunk]:
    """Yield the rows of a recording by chunks of so many samples, not yet divided (Eq. 26).

    Only the `wanted` ranges of rows are made, or all.
    """
    mask, indices = np.asarray(observations.mask), base.acting_columns
    for chunk in observations.chunks(samples, wanted):
        motion, forces = observations.read(slice(*chunk.samples))
        forces = without_tool(base, motion, forces)
        columns = [chunk.reduce(theta) for theta in base.regressor_rows(motion)]
        rows = slice(*chunk.rows)
        yield RowChunk(0, 0, rows, indices, columns, chunk.reduce(forces), mask[rows])


def without_tool(base: BaseParameters, motion: Motion, forces: AnyArray) -> np.ndarray:
    """Return measured forces less those of a known tool [N m or N]."""
    forces = np.asarray(forces)
    return (
        forces if base.model.robot.tool is None else forces - base.tool_forces(motion)
    )


def divide_rows(edges: Sequence[int], rows: slice) -> Iterator[tuple[int, slice]]:
    """Yield each block of time that some rows reach into, with its part of the rows."""
    for block, (low, high) in enumerate(itertools.pairwise(edges)):
        a, b = max(low, rows.start), min(high, rows.stop)
        if a < b:
            yield block, slice(a, b)


class JointFactor(eqx.Module):
    r"""The R factor of $[\Theta_j \; Q_j]$, the rows of one joint and their forces."""

    columns: tuple[int, ...] = eqx.field(
        static=True
    )  # base parameters that can act on the joint
    # upper triangle, or fewer rows; its last column belongs to the forces
    R: Float[AnyArray, "height width"]
    rows: int = eqx.field(static=True)  # number of rows that it stands for

    def append(self, rows: Float[AnyArray, "height width"]) -> "JointFactor":
        """Return the factor after more rows `[columns, force]`."""
        R = np.asarray(np.linalg.qr(np.vstack([self.R, rows]), mode="r"))
        return JointFactor(self.columns, R, self.rows + len(rows))


class Factors(eqx.Module):
    """The factors of all joints."""

    joints: tuple[JointFactor, ...]  # factor of each joint
    size: int = eqx.field(static=True)  # number of base parameters

    def append(self, rows: Sequence[np.ndarray]) -> "Factors":
        """Return the factors after more rows `[columns, force]` of each joint."""
        pairs = zip(self.joints, rows, strict=True)
        return Factors(tuple(joint.append(x) for joint, x in pairs), self.size)

    def __add__(self, other: "Factors") -> "Factors":
        """Return the factors of both sets of rows together."""
        pairs = zip(self.joints, other.joints, strict=True)
        joints = (
            JointFactor(a.columns, a.append(b.R).R, a.rows + b.rows) for a, b in pairs
        )
        return Factors(tuple(joints), self.size)

    @property
    def rows(self) -> np.ndarray:
        """Number of rows of each joint."""
        return np.array([j.rows for j in self.joints])

    def weighted(
        self, weights: Float[AnyArray, " joints"]
    ) -> tuple[np.ndarray, np.ndarray]:
        r"""Return matrix and right-hand side with the norms of $W \Theta_B p$, $W Q$ (Eq. 29)."""
        blocks = []
        for joint, w in zip(self.joints, np.asarray(weights), strict=True):
            block = np.zeros((len(joint.R), self.size + 1))
            block[:, [*joint.columns, -1]] = w * joint.R
            blocks.append(block)
        R = np.asarray(np.linalg.qr(np.vstack(blocks), mode="r"))
        return R[:, :-1], R[:, -1]

    def residual_squares(
        self, p: Float[AnyArray, " base"]
    ) -> Float[np.ndarray, " joints"]:
        """Return the sum of the squared residuals of each joint [N² m² or N²]."""
        whole = np.append(p, -1.0)
        rests = [joint.R @ whole[[*joint.columns, -1]] for joint in self.joints]
        return np.array([np.sum(rest**2) for rest in rests])

    @property
    def force_squares(self) -> Float[np.ndarray, " joints"]:
        """Sum of the squared forces of each joint [N² m² or N²]."""
        return np.array([np.sum(joint.R[:, -1] ** 2) for joint in self.joints])


def empty_factors(columns: Columns, size: int) -> Factors:
    """Return the factors of no rows, with the columns of each joint and the number of all."""
    joints = (
        JointFactor(tuple(own), np.zeros((0, len(own) + 1)), 0) for own in columns
    )
    return Factors(tuple(joints), size)


class Blocks(eqx.Module):
    """Factors of contiguous blocks of time, which together hold all rows."""

    parts: tuple[Factors, ...]  # factors of each block

    @property
    def total(self) -> Factors:
        """The factors of all rows."""
        return functools.reduce(operator.add, self.parts)

    def select(self, chosen: Iterable[int | np.integer]) -> "Blocks":
        """Return some of the blocks."""
        return Blocks(tuple(self.parts[k] for k in chosen))

    def scale_joints(self, factors: Float[AnyArray, " joints"]) -> "Blocks":
        """Return the factors of rows that are multiplied by one factor for each joint."""
        parts = []
        for part in self.parts:
            pairs = zip(part.joints, np.asarray(factors), strict=True)
            joints = (JointFactor(j.columns, x * j.R, j.rows) for j, x in pairs)
            parts.append(Factors(tuple(joints), part.size))
        return Blocks(tuple(parts))

    def condense(self, most: int) -> "Blocks":
        """Return the same rows in at most so many blocks; neighbours are joined in pairs."""
        parts = self.parts
        while len(parts) > most:
            pairs = (parts[k : k + 2] for k in range(0, len(parts), 2))
            parts = tuple(Blocks(pair).total for pair in pairs)
        return Blocks(parts)
