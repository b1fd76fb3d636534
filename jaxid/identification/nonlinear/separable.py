"""Factors of rows some of whose columns depend on shapes: the others are evaluated only once."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.machine import program_of
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks, Factors, JointFactor, RowChunk
from jaxid.identification.nonlinear.shapes import Shapes
from jaxid.identification.problem import RegressionProblem
from jaxid.program import evaluate_packed

MOST = 2**28
"""Numbers (two gigabytes) of columns that are held."""


class ShapedColumns(eqx.Module):
    """The columns of the base regressor that depend on shapes, and their derivatives.

    Attributes:
        base: The base parameters.
        shapes: On which the columns depend.
        varying: Positions of these columns among the base parameters.
        own: Positions of these columns among those of the shaped terms.
    """

    base: BaseParameters
    shapes: Shapes
    varying: tuple[int, ...] = eqx.field(static=True)
    own: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, base: BaseParameters, shapes: Shapes) -> "ShapedColumns":
        """Those of a model."""
        robot = base.model.robot
        sizes = [len(term.parameters(robot)) for term in base.model.terms]
        starts = np.cumsum([0, *sizes])
        shaped = [k for i in shapes.terms for k in range(starts[i], starts[i + 1])]
        varying = tuple(place for place, k in enumerate(base.indices) if k in shaped)
        return cls(base, shapes, varying, tuple(shaped.index(base.indices[k]) for k in varying))

    def columns(self, x, q, qd, qdd) -> tuple[jax.Array, jax.Array]:
        """Columns [joints, varying] of one sample, and derivatives [joints, varying, shapes]."""
        model = self.base.model

        def own(x):
            terms = self.shapes.set_in(model.terms, x)
            parts = [terms[i].columns(model.robot, q, qd, qdd) for i in self.shapes.terms]
            return jnp.concatenate(parts, axis=1)[:, np.array(self.own, int)]

        return own(x), jax.jacfwd(own)(x)


class Piece(NamedTuple):
    """Rows of one chunk: for each joint what of its columns does not depend on shapes.

    Attributes:
        recording: Number of the recording.
        block: Number of the block of time.
        rows: Which of the recording's rows.
        counted: For each joint which of them count.
        Q: For each joint an orthonormal basis of its fixed columns.
        R: For each joint the triangle of fixed columns and forces.
        rest: For each joint what fixed columns leave of the forces.
    """

    recording: int
    block: int
    rows: slice
    counted: np.ndarray
    Q: list[np.ndarray]
    R: list[np.ndarray]
    rest: list[np.ndarray]


class SeparableRows:
    r"""The rows $[A \; \Phi(x) \; \partial\Phi(x) \; Q]$ of recordings, as factors for any $x$.

    Columns come in this order: the base parameters in theirs; then for each pair of a varying
    column and a shape that moves it the derivative. The fixed columns $A$ are evaluated and
    factored once. For new shapes only friction is evaluated, at the full rate, filtered and
    decimated like all columns, and joined to the factor that is there.

    Args:
        rows: With the base parameters of the model.
        shapes: To be found.

    Raises:
        InputError: If only factors are known, or the rows are too many to be held.
    """

    def __init__(self, rows: RegressionProblem, shapes: Shapes):
        rows.require_samples("nonlinear friction")
        base = rows.base
        self._rows, self.base, self.shapes = rows, base, shapes
        self._owner = ShapedColumns.of(base, shapes)
        self.varying = self._owner.varying
        n = (base.model.robot.joints,)
        self._program = program_of(self._owner, self._owner.columns, (shapes.size,), n, n, n)
        moved, slopes = self._program.nonzeros
        self.pairs = tuple((int(v), int(k)) for v, k in np.argwhere(slopes.any(axis=0)))
        entries = []
        for j in range(n[0]):
            own = [(self.varying[v], j * moved.shape[1] + v) for v in np.flatnonzero(moved[j])]
            for place, (v, k) in enumerate(self.pairs):
                if slopes[j, v, k]:
                    flat = np.ravel_multi_index((j, v, k), slopes.shape)
                    own.append((base.size + place, moved.size + int(flat)))
            entries.append(own)
        self._needed = sorted({entry for own in entries for _, entry in own})
        position = {entry: i for i, entry in enumerate(self._needed)}
        self._columns = [[column for column, _ in own] for own in entries]
        self._chosen = [[position[entry] for _, entry in own] for own in entries]
        self._pieces = self._held(rows)

    @property
    def size(self) -> int:
        """Number of columns of the factors."""
        return self.base.size + len(self.pairs)

    def _held(self, rows: RegressionProblem) -> list[Piece]:
        varying, pieces, size = set(self.varying), [], 0
        self._fixed = []
        for chunk in rows.chunks():
            if not pieces:
                self._fixed = [[k for k in own if k not in varying] for own in chunk.indices]
            pieces.append(self._factored(chunk))
            size += sum(Q.size for Q in pieces[-1].Q)
            if size > MOST:
                raise InputError(
                    f"nonlinear friction holds the columns of all rows, but these are more than "
                    f"{MOST:.0e} numbers: decimate, or take a part of the log."
                )
        return pieces

    def _factored(self, chunk: RowChunk) -> Piece:
        bases, triangles, rests = [], [], []
        for j, fixed in enumerate(self._fixed):
            counted = chunk.mask[:, j]
            kept = [chunk.indices[j].index(k) for k in fixed]
            Q, R = np.linalg.qr(chunk.columns[j][counted][:, kept])
            forces = chunk.forces[counted, j]
            along = Q.T @ forces
            bases.append(Q)
            triangles.append(np.column_stack([R, along]))
            rests.append(forces - Q @ along)
        return Piece(chunk.recording, chunk.block, chunk.rows, chunk.mask, bases, triangles, rests)

    def blocks(self, x: Float[np.ndarray, " shapes"]) -> Blocks:
        """The factors by blocks of time for some shapes."""
        shaped = [self._shaped(number, x) for number in range(len(self._rows.recordings))]
        parts: dict[int, list[Factors]] = {}
        for piece in self._pieces:
            columns = shaped[piece.recording][piece.rows]
            joints = []
            for j, (Q, R, rest) in enumerate(zip(piece.Q, piece.R, piece.rest, strict=True)):
                own = columns[piece.counted[:, j]][:, self._chosen[j]]
                along = Q.T @ own
                beside = np.column_stack([own - Q @ along, rest])
                below = np.linalg.qr(beside, mode="r")
                above = np.column_stack([R[:, :-1], along, R[:, -1]])
                left = np.zeros((len(below), R.shape[1] - 1))
                whole = np.vstack([above, np.column_stack([left, below])])
                names = (*self._fixed[j], *self._columns[j])
                joints.append(JointFactor(names, whole, len(own)))
            parts.setdefault(piece.block, []).append(Factors(tuple(joints), self.size))
        return Blocks(tuple(functools.reduce(lambda a, b: a + b, parts[k]) for k in sorted(parts)))

    def _shaped(self, number: int, x: Float[np.ndarray, " shapes"]) -> np.ndarray:
        """The rows of everything that depends on shapes, for one recording."""
        observations = self._rows.recordings[number]
        found = np.empty((observations.rows, len(self._needed)))
        for chunk in observations.chunks(RegressionProblem.samples_per_chunk):
            motion, _ = observations.read(slice(*chunk.samples))
            arrays = (np.asarray(a, np.float64).T for a in (motion.q, motion.qd, motion.qdd))
            packed = evaluate_packed(self._program, np.asarray(x), *arrays)
            wide = np.empty((len(motion.q), len(self._needed)), order="F")
            for place, entry in enumerate(self._needed):
                wide[:, place] = packed[entry]
            found[slice(*chunk.rows)] = chunk.reduce(wide)
        return found


def joined(blocks: Blocks, chosen: Sequence[int]) -> Factors:
    """The factors of some blocks together."""
    return Blocks(tuple(blocks.parts[k] for k in chosen)).total
