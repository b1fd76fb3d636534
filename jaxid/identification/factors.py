"""What least squares need of the observations: one triangular factor for each joint.

The rows of a joint see only the bodies beyond it. Their columns and forces are reduced, chunk by
chunk, to the R factor of a QR decomposition; weights of the joints are applied afterwards, for
free, and recordings are added by stacking factors. The observation matrix is never held.
"""

import functools
import itertools
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.compiled import acting_columns
from jaxid.identification.kernel import CHUNK as SAMPLES
from jaxid.identification.reduction import reduced
from jaxid.identification.sharded import StreamOnDevices, devices
from jaxid.identification.streaming import Progress, Stream, suits
from jaxid.measurement.observations import Observations

CHUNK = 65536
"""Samples whose columns are held at once."""
BLOCKS = 10
"""Blocks of time into which a recording is divided, for cross-validation."""


class JointFactor(eqx.Module):
    r"""The R factor of $[\Theta_j \; Q_j]$, the rows of one joint and their forces.

    Attributes:
        columns: The base parameters that can act on this joint.
        R: Upper triangle, or fewer rows; its last column belongs to the forces.
        rows: Number of rows that it stands for.
    """

    columns: tuple[int, ...] = eqx.field(static=True)
    R: Float[AnyArray, "height width"]
    rows: int = eqx.field(static=True)

    def joined(self, rows: Float[AnyArray, "height width"]) -> "JointFactor":
        """The factor after more rows `[columns, forces]`."""
        R = np.asarray(np.linalg.qr(np.vstack([self.R, rows]), mode="r"))
        return JointFactor(self.columns, R, self.rows + len(rows))

    def residual_square(self, p: Float[AnyArray, " base"]) -> float:
        """Sum of the squared residuals of this joint's rows [N² m² or N²]."""
        x = np.append(np.asarray(p)[list(self.columns)], -1.0)
        return float(np.sum((np.asarray(self.R) @ x) ** 2))

    @property
    def force_square(self) -> float:
        """Sum of the squared forces of this joint's rows [N² m² or N²]."""
        return float(np.sum(np.asarray(self.R)[:, -1] ** 2))


class Factors(eqx.Module):
    """The factors of all joints.

    Attributes:
        joints: One for each joint.
        size: Number of base parameters.
    """

    joints: tuple[JointFactor, ...]
    size: int = eqx.field(static=True)

    def __add__(self, other: "Factors") -> "Factors":
        """The factors of both sets of rows together."""
        pairs = zip(self.joints, other.joints, strict=True)
        joined = [a.joined(b.R) for a, b in pairs]
        rows = [a.rows + b.rows for a, b in zip(self.joints, other.joints, strict=True)]
        return Factors(
            tuple(JointFactor(j.columns, j.R, n) for j, n in zip(joined, rows, strict=True)),
            self.size,
        )

    @property
    def rows(self) -> np.ndarray:
        """Number of rows of each joint."""
        return np.array([j.rows for j in self.joints])

    def weighted(
        self, weights: Float[AnyArray, " joints"]
    ) -> tuple[Float[np.ndarray, "height base"], Float[np.ndarray, " height"]]:
        r"""Matrix and right-hand side with the norms of $W \Theta_B p$ and $W Q$ (Eq. 29)."""
        blocks, forces = [], []
        for joint, w in zip(self.joints, np.asarray(weights), strict=True):
            R = w * np.asarray(joint.R)
            block = np.zeros((len(R), self.size))
            block[:, list(joint.columns)] = R[:, :-1]
            blocks.append(block)
            forces.append(R[:, -1])
        stacked = np.column_stack([np.vstack(blocks), np.concatenate(forces)])
        R = np.asarray(np.linalg.qr(stacked, mode="r"))
        return R[:, :-1], R[:, -1]

    def residual_squares(self, p: Float[AnyArray, " base"]) -> Float[np.ndarray, " joints"]:
        """Sum of the squared residuals of each joint [N² m² or N²]."""
        return np.array([j.residual_square(p) for j in self.joints])

    @property
    def force_squares(self) -> Float[np.ndarray, " joints"]:
        """Sum of the squared forces of each joint [N² m² or N²]."""
        return np.array([j.force_square for j in self.joints])


def condensed(parts: Sequence[Factors], most: int) -> list[Factors]:
    """At most so many factors that stand for the same rows: neighbours are joined in pairs."""
    parts = list(parts)
    while len(parts) > most:
        pairs = (parts[k : k + 2] for k in range(0, len(parts), 2))
        parts = [functools.reduce(lambda x, y: x + y, pair) for pair in pairs]
    return parts


class Blocks(eqx.Module):
    """Factors of contiguous blocks of time, which together are all observations.

    Attributes:
        parts: One for each block.
    """

    parts: tuple[Factors, ...]

    @property
    def total(self) -> Factors:
        """The factors of all rows."""
        return functools.reduce(lambda x, y: x + y, self.parts)

    def without(self, block: int) -> Factors:
        """The factors of all rows but those of one block."""
        others = (*self.parts[:block], *self.parts[block + 1 :])
        return functools.reduce(lambda x, y: x + y, others)


def empty(base: BaseParameters) -> Factors:
    """Factors of no rows at all."""
    return Factors(
        tuple(
            JointFactor(columns, np.zeros((0, len(columns) + 1)), 0)
            for columns in acting_columns(base)
        ),
        base.size,
    )


def factorise(
    base: BaseParameters,
    recordings: Sequence[Observations],
    blocks: int = BLOCKS,
    progress: Progress | None = None,
) -> Blocks:
    """Reduces observations to the factors of their joints, by blocks of time (Eq. 26).

    Columns are evaluated at the full rate and filtered like the forces, chunk by chunk: in NumPy,
    or for long logs by a compiled loop, with the same result up to rounding.

    Args:
        base: The base parameters.
        recordings: Observations of the same robot.
        blocks: Number of blocks into which the counted rows of each recording are divided.
        progress: Is told now and then which share of a long log is done, of 1.
    """
    parts, done = [], 0
    whole = sum(observations.samples for observations in recordings)
    for observations in recordings:
        edges, samples = block_edges(observations, blocks), observations.samples
        told = None if progress is None else _share_of(progress, done / whole, samples / whole)
        if suits(observations):
            parts += streamed(base, observations, edges, progress=told)
        else:
            parts += _in_numpy(base, observations, edges)
        done += samples
    return Blocks(tuple(parts))


def _share_of(progress: Progress, done: float, share: float) -> Progress:
    """The progress of one recording among several."""
    return lambda own: progress(min(1.0, done + share * own))


def block_edges(observations: Observations, blocks: int = BLOCKS) -> list[int]:
    """Rows at which blocks of time with equally many counted rows begin, and the last one ends."""
    counted = np.flatnonzero(np.asarray(observations.mask).any(axis=1))
    edges = [int(part[0]) for part in np.array_split(counted, blocks) if len(part)]
    return [0, *edges[1:], observations.rows]


def _in_numpy(
    base: BaseParameters, observations: Observations, edges: Sequence[int]
) -> list[Factors]:
    """The factors of blocks of time, without compiling."""
    mask = np.asarray(observations.mask)
    factors = [empty(base) for _ in edges[1:]]
    for rows, columns, forces in reduced_rows(base, observations):
        for k, (first, last) in enumerate(itertools.pairwise(edges)):
            low, high = max(first, rows.start), min(last, rows.stop)
            if low < high:
                part = slice(low - rows.start, high - rows.start)
                factors[k] = _joined(factors[k], columns, forces, mask[rows], part)
    return factors


def streamed(
    base: BaseParameters,
    observations: Observations,
    edges: Sequence[int],
    chunk: int = SAMPLES,
    progress: Progress | None = None,
) -> list[Factors]:
    """The factors of blocks of time by the compiled loop, for logs of any length.

    All devices of this process share the log; with one, nothing is shared.

    Args:
        base: The base parameters.
        observations: What was measured.
        edges: Rows at which the blocks begin, and the last one ends.
        chunk: Samples of an iteration of the loop.
        progress: Is told now and then which share of the log is done, of 1.
    """
    mask = np.asarray(observations.mask)
    acting = acting_columns(base)
    kind = StreamOnDevices if len(devices()) > 1 else Stream
    triangles = kind(base, observations, edges, chunk, progress).triangles()
    found = []
    for R, (first, last) in zip(triangles, itertools.pairwise(edges), strict=True):
        rows = mask[first:last].sum(axis=0)
        joints = zip(acting, R, rows, strict=True)
        found.append(Factors(tuple(JointFactor(c, r, int(n)) for c, r, n in joints), base.size))
    return found


def _joined(
    factors: Factors, columns: list[np.ndarray], forces: np.ndarray, mask: np.ndarray, part: slice
) -> Factors:
    joints = []
    for j, (joint, theta) in enumerate(zip(factors.joints, columns, strict=True)):
        kept = mask[part, j]
        joints.append(joint.joined(np.column_stack([theta[part], forces[part, j]])[kept]))
    return Factors(tuple(joints), factors.size)


def reduced_rows(
    base: BaseParameters,
    observations: Observations,
    samples: int = CHUNK,
    wanted: Sequence[tuple[int, int]] | None = None,
):
    """Goes through observations by chunks: row range, columns of each joint, and forces.

    A known tool's forces are taken off the measured ones.

    Args:
        base: The base parameters.
        observations: What was measured.
        samples: Size of a chunk.
        wanted: Ranges of rows; chunks without any of them are left out. All if None.

    Yields:
        Slice of the rows; for each joint its columns [rows, columns of the joint]; forces
        [rows, joints] in [N m] or [N].
    """
    for chunk in observations.chunks(samples):
        first, last = chunk.rows
        if wanted is not None and not any(a < last and first < b for a, b in wanted):
            continue
        yield slice(*chunk.rows), *reduced(base, *observations.read(slice(*chunk.samples)), chunk)
