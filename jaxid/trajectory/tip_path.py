"""Paths of the end-effector in space: lines and circles, each from standstill to standstill."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array
from jaxid.errors import InputError

PEAK_SPEED, PEAK_ACCELERATION = 15.0 / 8.0, 10.0 / np.sqrt(3.0)
"""Of the speed profile, over mean speed, and over way by time squared."""


class AbstractPiece(eqx.Module):
    """A curve from one place to another."""

    @property
    @abstractmethod
    def length(self) -> float:
        """Way along the curve [m]."""

    @property
    @abstractmethod
    def radius(self) -> float:
        """Of its curvature; infinite of a line [m]."""

    @abstractmethod
    def at(self, share: Float[AnyArray, " samples"]) -> Float[np.ndarray, "samples 3"]:
        """Places along the curve [m].

        Args:
            share: Of the way, from 0 to 1.
        """


class Line(AbstractPiece):
    """A straight line.

    Attributes:
        start: Where it begins [m].
        end: Where it ends [m].
    """

    start: Float[AnyArray, "3"]
    end: Float[AnyArray, "3"]

    @property
    def length(self) -> float:
        """Way along the line [m]."""
        return float(np.linalg.norm(np.asarray(self.end) - np.asarray(self.start)))

    @property
    def radius(self) -> float:
        """Infinite."""
        return np.inf

    def at(self, share: Float[AnyArray, " samples"]) -> Float[np.ndarray, "samples 3"]:
        """Places along the line [m]."""
        start = np.asarray(self.start)
        return start + np.asarray(share)[:, None] * (np.asarray(self.end) - start)


class Circle(AbstractPiece):
    """A whole circle, once or several times round.

    Attributes:
        centre: Of the circle [m].
        first: From the centre to where it begins and ends [m].
        second: From the centre to where a quarter of it lies: as long, at a right angle [m].
        rounds: How often it is run without a stop.
    """

    centre: Float[AnyArray, "3"]
    first: Float[AnyArray, "3"]
    second: Float[AnyArray, "3"]
    rounds: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if self.rounds < 1:
            raise InputError(f"`rounds` of a circle must be at least 1, but is {self.rounds}.")

    @property
    def length(self) -> float:
        """Way round the circle, all rounds [m]."""
        return 2 * np.pi * self.rounds * self.radius

    @property
    def radius(self) -> float:
        """Of the circle [m]."""
        return float(np.linalg.norm(np.asarray(self.first)))

    def at(self, share: Float[AnyArray, " samples"]) -> Float[np.ndarray, "samples 3"]:
        """Places round the circle [m]."""
        angle = 2 * np.pi * self.rounds * np.asarray(share)[:, None]
        first, second = np.asarray(self.first), np.asarray(self.second)
        return np.asarray(self.centre) + np.cos(angle) * first + np.sin(angle) * second


class TipPath(eqx.Module):
    """Pieces one after the other, the end-effector at rest where they meet, its attitude held.

    Along a piece the way is the polynomial $10 u^3 - 15 u^4 + 6 u^5$ of the share $u$ of its time:
    speed and acceleration are zero at both ends and smooth between.

    Attributes:
        pieces: In the order in which they are run.
        rotation: Attitude of the end-effector: columns are its axes on the ground.
        speed: Largest speed [m/s].
        acceleration: Largest acceleration along the way, and largest across it [m/s²].
    """

    pieces: tuple[AbstractPiece, ...]
    rotation: Float[AnyArray, "3 3"]
    speed: float
    acceleration: float

    @classmethod
    def of(
        cls,
        pieces: tuple[AbstractPiece, ...],
        rotation: Numbers,
        *,
        speed: float = 1.0,
        acceleration: float = 4.0,
    ) -> "TipPath":
        """Puts pieces together.

        Args:
            pieces: In the order in which they are run.
            rotation: Attitude of the end-effector on the ground.
            speed: Largest speed [m/s].
            acceleration: Largest acceleration along the way, and largest across it [m/s²].

        Raises:
            InputError: If there is no piece, one has no length or does not start where the one
                before it ends, or a limit is not positive.
        """
        for name, limit in (("speed", speed), ("acceleration", acceleration)):
            if not 0 < limit < np.inf:
                raise InputError(f"`{name}` must be positive, but is {limit:g}.")
        if not pieces:
            raise InputError("`pieces` must hold at least one piece, but is empty.")
        ends = [piece.at(np.array([0.0, 1.0])) for piece in pieces]
        for k, piece in enumerate(pieces):
            gap = float(np.linalg.norm(ends[k][0] - ends[k - 1][1])) if k else 0.0
            if gap > 1e-9:
                raise InputError(
                    f"piece {k + 1} must start where the one before it ends, but lies {gap:.3g} m "
                    "from it."
                )
            if not 0 < piece.length < np.inf:
                raise InputError(f"piece {k + 1} must have a length, but it is {piece.length:g} m.")
        return cls(tuple(pieces), as_array("rotation", rotation), float(speed), float(acceleration))

    @property
    def durations(self) -> tuple[float, ...]:
        """Time of each piece [s]: the shortest that keeps speed and acceleration."""
        return tuple(
            max(
                PEAK_SPEED * p.length / min(self.speed, np.sqrt(self.acceleration * p.radius)),
                np.sqrt(PEAK_ACCELERATION * p.length / self.acceleration),
            )
            for p in self.pieces
        )

    @property
    def duration(self) -> float:
        """Of all pieces together [s]."""
        return float(sum(self.durations))

    @property
    def length(self) -> float:
        """Of all pieces together [m]."""
        return float(sum(piece.length for piece in self.pieces))

    def positions(self, t: Float[AnyArray, " samples"]) -> Float[np.ndarray, "samples 3"]:
        """Where the end-effector is at some times [m]; before and after it stands still.

        Args:
            t: Times [s].
        """
        t = np.asarray(t)
        begins = np.concatenate([[0.0], np.cumsum(self.durations)[:-1]])
        piece = np.clip(np.searchsorted(begins, t, side="right") - 1, 0, len(begins) - 1)
        places = np.empty((len(t), 3))
        for k, (one, begin, time) in enumerate(
            zip(self.pieces, begins, self.durations, strict=True)
        ):
            own = piece == k
            u = np.clip((t[own] - begin) / time, 0.0, 1.0)
            places[own] = one.at(u**3 * (10.0 + u * (6.0 * u - 15.0)))
        return places
