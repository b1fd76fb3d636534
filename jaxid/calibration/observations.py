"""Observations for kinematic calibration: measurements in poses of a robot.

Each compares the `tool`, a point or frame on the end-effector, with a `place`, a point
or frame in the room. Where both are is unknown.
"""

import abc
import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array
from jaxid.errors import InputError
from jaxid.robot.robot import as_rotations

from .frames import SHIFT, TURN, Frame, rotation_errors
from .place_estimates import (
    centre_of_distances,
    nearest_frame,
    nearest_plane,
    tool_and_place,
)

Freedoms = tuple[int, ...]
"""Numbers of a correction that move a frame; the others do not matter."""
FrameKey = tuple[str, str]
"""Session and name of an unknown frame; no session if it is the same in all."""
PLANE: Freedoms = (2, 3, 4)
FRAME: Freedoms = (*SHIFT, *TURN)
POINT: Freedoms = SHIFT


@dataclasses.dataclass(frozen=True, eq=False)
class AbstractObservation(abc.ABC):
    """Measurements in some poses of one session.

    A session is what is set up once: its poses share the errors of the setup.

    Attributes:
        session: Name of the session.
        q: Joint coordinates of the poses [rad or m].
        place: Name of the place; in another session it is another place.
        tool: Name of what the end-effector carries, the same in all sessions.
        place_stays: Whether the place is the same in all sessions.
        deviation: Standard deviation of a measurement [m]. It weights kinds of
            observations against each other and against the nominal geometry.
    """

    tool_freedoms: ClassVar[Freedoms] = POINT
    place_freedoms: ClassVar[Freedoms] = POINT
    errors_of_lengths: ClassVar[int] = 3
    errors_of_angles: ClassVar[int] = 0
    has_poses: ClassVar[bool] = True

    session: str
    q: Any
    _: dataclasses.KW_ONLY
    place: str = "place"
    tool: str = "tool"
    place_stays: bool = False
    deviation: float = 3e-4

    def __post_init__(self):
        q = np.asarray(as_array("q", self.q), np.float64)
        owner = f"`q` of the session `{self.session}`"
        if q.ndim != 2 or not len(q):
            raise InputError(
                f"{owner} must hold a row of joint coordinates for each pose, but has "
                f"the shape {q.shape}."
            )
        if not np.isfinite(q).all():
            raise InputError(f"{owner} must hold finite numbers: remove other poses.")
        if not self.deviation > 0.0:
            raise InputError(
                f"`deviation` must be positive, but is {self.deviation:g}."
            )
        object.__setattr__(self, "q", q)

    @property
    def tool_key(self) -> FrameKey:
        """Session and name of the frame that the robot moves."""
        return "", self.tool

    @property
    def place_key(self) -> FrameKey:
        """Session and name of the place."""
        return "" if self.place_stays else self.session, self.place

    @property
    def deviations(self) -> Float[np.ndarray, " errors"]:
        """Standard deviation of each error of a pose."""
        return np.full(self.errors_of_lengths, self.deviation)

    def measured_numbers(
        self, name: str, value: Numbers, size: tuple[int, ...]
    ) -> np.ndarray:
        """Return measurements with a row for each pose, or raise an error."""
        array = np.asarray(as_array(name, value), np.float64)
        shape = (len(self.q), *size)
        if array.shape != shape or not np.isfinite(array).all():
            raise InputError(
                f"`{name}` of the session `{self.session}` must hold finite numbers "
                f"in the shape {shape}, one row for each pose, but has the shape "
                f"{array.shape}."
            )
        return array

    @property
    @abc.abstractmethod
    def measured(self) -> Float[np.ndarray, "poses numbers"]:
        """Measurements of each pose."""

    @staticmethod
    @abc.abstractmethod
    def errors(tool: Frame, place: Frame, measured: AnyArray) -> AnyArray:
        """Return the errors of one pose: lengths [m], then angles [rad].

        Args:
            tool: Tool on the ground.
            place: Place on the ground.
            measured: Measurements of this pose.
        """

    @abc.abstractmethod
    def first_estimates(self, tips: Frame) -> tuple[Frame, Frame]:
        """Return roughly where the tool is on the end-effector, and where the place is.

        Args:
            tips: End-effector on the ground in all poses.
        """


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PointContact(AbstractObservation):
    """A point of the tool stays at one point of the room, like a ball in a socket."""

    @property
    def measured(self):
        """No numbers."""
        return np.zeros((len(self.q), 0))

    @staticmethod
    def errors(tool, place, measured):
        """Return the vector from the place to the tool."""
        return tool.position - place.position

    def first_estimates(self, tips):
        """Return the end-effector, and the mean of its positions."""
        return ORIGIN, Frame(np.eye(3), tips.position.mean(axis=0))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class KnownDistance(AbstractObservation):
    """A point of the tool has a known distance from a point of the room: a ball bar.

    Attributes:
        distance: Distance in each pose, or in all [m].
    """

    errors_of_lengths: ClassVar[int] = 1
    distance: Numbers

    def __post_init__(self):
        super().__post_init__()
        distances = np.broadcast_to(self.distance, len(self.q))
        numbers = self.measured_numbers("distance", distances, ())
        object.__setattr__(self, "distance", numbers)

    @property
    def measured(self):
        """Distances [m]."""
        return np.asarray(self.distance)[:, None]

    @staticmethod
    def errors(tool, place, measured):
        """Return how much the distance is too long."""
        ray = tool.position - place.position
        return jnp.sqrt(jnp.sum(ray * ray))[None] - measured

    def first_estimates(self, tips):
        """Return the end-effector, and the point with these distances from it."""
        positions = np.asarray(tips.position)
        centre = centre_of_distances(positions, np.asarray(self.distance))
        return ORIGIN, Frame(np.eye(3), centre)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class SocketDistance(KnownDistance):
    """Two points of the room have a known distance; the robot does not measure it.

    Attributes:
        other_place: Name of the second point.
    """

    has_poses: ClassVar[bool] = False
    q: Any = dataclasses.field(init=False, default=None)
    deviation: float = 1e-4
    other_place: str

    def __post_init__(self):
        object.__setattr__(self, "q", np.zeros((1, 0)))
        super().__post_init__()

    @property
    def tool_key(self):
        """Session and name of the second point."""
        return "" if self.place_stays else self.session, self.other_place


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PlaneContact(AbstractObservation):
    """A point of the tool lies in a plane, like a probe on a granite plate."""

    place_freedoms: ClassVar[Freedoms] = PLANE
    errors_of_lengths: ClassVar[int] = 1

    @property
    def measured(self):
        """No numbers."""
        return np.zeros((len(self.q), 0))

    @staticmethod
    def errors(tool, place, measured):
        """Return the height above the plane."""
        return (place.inverse @ tool).position[2:]

    def first_estimates(self, tips):
        """Return the end-effector, and the plane nearest to its positions."""
        return ORIGIN, nearest_plane(np.asarray(tips.position))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPosition(AbstractObservation):
    """An instrument, such as a laser tracker, measures a point of the tool.

    The place is that of the instrument.

    Attributes:
        positions: Measured positions in the instrument's frame [m].
    """

    place_freedoms: ClassVar[Freedoms] = FRAME
    positions: Numbers

    def __post_init__(self):
        super().__post_init__()
        numbers = self.measured_numbers("positions", self.positions, (3,))
        object.__setattr__(self, "positions", numbers)

    @property
    def measured(self):
        """Positions [m]."""
        return np.asarray(self.positions)

    @staticmethod
    def errors(tool, place, measured):
        """Return the vector from the measured position, along the instrument's axes."""
        return (place.inverse @ tool).position - measured

    def first_estimates(self, tips):
        """Return the end-effector, and the frame that suits its positions best."""
        return ORIGIN, nearest_frame(np.asarray(tips.position), self.measured)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPose(AbstractObservation):
    """A camera measures a pose: that of the `tool` in the frame of the `place`.

    For a camera in the room the tool is the board that the robot holds, and the place
    is the camera. For a camera on the robot the tool is the camera, and the place is
    the board; if the camera's pose on the board is not known, but the board's pose in
    the camera, use `eye_in_hand`.

    Attributes:
        rotations: Measured attitudes: columns are the tool's axes.
        positions: Measured positions of the tool [m].
        angle_deviation: Standard deviation of the attitudes [rad].
    """

    tool_freedoms: ClassVar[Freedoms] = FRAME
    place_freedoms: ClassVar[Freedoms] = FRAME
    errors_of_angles: ClassVar[int] = 3
    deviation: float = 1e-3
    rotations: Numbers
    positions: Numbers
    angle_deviation: float = 2e-3

    def __post_init__(self):
        super().__post_init__()
        rotations = self.measured_numbers("rotations", self.rotations, (3, 3))
        as_rotations("`rotations`", rotations, rotations.shape)
        positions = self.measured_numbers("positions", self.positions, (3,))
        object.__setattr__(self, "rotations", rotations)
        object.__setattr__(self, "positions", positions)

    @classmethod
    def eye_in_hand(cls, session, q, *, rotations, positions, **fields):
        """Return the observation of a camera on the robot, which looks at a board.

        Args:
            session: Name of the session.
            q: Joint coordinates of the poses [rad or m].
            rotations: Measured attitudes: columns are the board's axes in the camera.
            positions: Measured positions of the board in the camera [m].
            fields: Further attributes.
        """
        board = Frame(
            as_array("rotations", rotations), as_array("positions", positions)
        )
        camera = board.inverse
        return cls(
            session,
            q,
            rotations=camera.rotation,
            positions=camera.position,
            **fields,
        )

    @property
    def deviations(self):
        """Those of three lengths and three angles."""
        return np.repeat([self.deviation, self.angle_deviation], 3)

    @property
    def measured(self):
        """Positions and entries of the attitudes."""
        rotations = np.asarray(self.rotations).reshape(-1, 9)
        return np.concatenate([np.asarray(self.positions), rotations], axis=1)

    @staticmethod
    def errors(tool, place, measured):
        """Return the difference of positions and attitudes, along the place's axes."""
        seen = place.inverse @ tool
        measured_rotation = measured[3:].reshape(3, 3)
        turn = rotation_errors(seen.rotation @ measured_rotation.T)
        return jnp.concatenate([seen.position - measured[:3], turn])

    def first_estimates(self, tips):
        """Return tool and place for which measured poses suit those of the tips."""
        measured = Frame(np.asarray(self.rotations), np.asarray(self.positions))
        return tool_and_place(tips, measured)


ORIGIN = Frame(np.eye(3), np.zeros(3))
"""A frame that has not moved."""
OBSERVATIONS: dict[str, type[AbstractObservation]] = {
    "point_contact": PointContact,
    "known_distance": KnownDistance,
    "measured_position": MeasuredPosition,
    "measured_pose": MeasuredPose,
    "plane_contact": PlaneContact,
}
"""Kinds of observations, by their names in the experiment file."""
