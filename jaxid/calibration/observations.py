"""Observations for kinematic calibration: measurements in poses of a robot.

Each compares the `tool`, a point or frame on the end-effector, with a `place`, a point
or frame in the room. Where both are is unknown. Measured are some of the six numbers of
the tool's pose in the place: a ball in a socket is at zero, a camera measures all.
"""

import abc
import dataclasses
from typing import Any, ClassVar

import numpy as np

from jaxid.arrays import Float, Numbers, as_array
from jaxid.errors import InputError
from jaxid.robot.robot import as_rotations

from .frames import ORIGIN, SHIFT, TURN, Frame
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
    measured_numbers: ClassVar[Freedoms] = POINT
    measurements: ClassVar[dict[str, Freedoms]] = {}
    is_distance: ClassVar[bool] = False
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
        for name, size in self.measurements.items():
            self._set_measurement(name, (len(q), *size))

    def _set_measurement(self, name: str, shape: tuple[int, ...]) -> None:
        """Check measurements, of which each pose has its own or all the same."""
        array = np.asarray(as_array(name, getattr(self, name)), np.float64)
        if array.shape not in (shape, shape[1:]) or not np.isfinite(array).all():
            raise InputError(
                f"`{name}` of the session `{self.session}` must hold finite numbers "
                f"in the shape {shape}, one row for each pose, but has the shape "
                f"{array.shape}."
            )
        object.__setattr__(self, name, np.broadcast_to(array, shape))

    @property
    def tool_key(self) -> FrameKey:
        """Session and name of the frame that the robot moves."""
        return "", self.tool

    @property
    def place_key(self) -> FrameKey:
        """Session and name of the place."""
        return "" if self.place_stays else self.session, self.place

    @property
    def deviations(self) -> Float[np.ndarray, "6"]:
        """Standard deviations of a pose's numbers; infinite if they are not measured.

        A distance is the first number.
        """
        deviations = np.full(6, np.inf)
        deviations[list(self.measured_numbers)] = self.deviation
        return deviations

    @property
    def measured(self) -> Frame:
        """Measured poses of the tool in the place; zero where it is in contact."""
        poses = len(self.q)
        return Frame(np.tile(np.eye(3), (poses, 1, 1)), np.zeros((poses, 3)))

    @abc.abstractmethod
    def first_estimates(self, tips: Frame) -> tuple[Frame, Frame]:
        """Return roughly where the tool is on the end-effector, and where the place is.

        Args:
            tips: End-effector on the ground in all poses.
        """


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PointContact(AbstractObservation):
    """A point of the tool stays at one point of the room, like a ball in a socket."""

    def first_estimates(self, tips):
        """Return the end-effector, and the mean of its positions."""
        return ORIGIN, Frame(np.eye(3), tips.position.mean(axis=0))


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PlaneContact(AbstractObservation):
    """A point of the tool lies in a plane, like a probe on a granite plate."""

    place_freedoms: ClassVar[Freedoms] = (2, 3, 4)
    measured_numbers: ClassVar[Freedoms] = (2,)

    def first_estimates(self, tips):
        """Return the end-effector, and the plane nearest to its positions."""
        return ORIGIN, nearest_plane(tips.position)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class KnownDistance(AbstractObservation):
    """A point of the tool has a known distance from a point of the room: a ball bar.

    Attributes:
        distance: Distance in each pose, or in all [m].
    """

    measured_numbers: ClassVar[Freedoms] = (0,)
    is_distance: ClassVar[bool] = True
    measurements: ClassVar[dict[str, Freedoms]] = {"distance": ()}
    distance: Numbers

    @property
    def measured(self):
        """Points at these distances along the first axis."""
        return super().measured._replace(position=np.outer(self.distance, np.eye(3)[0]))

    def first_estimates(self, tips):
        """Return the end-effector, and the point with these distances from it."""
        centre = centre_of_distances(tips.position, np.asarray(self.distance))
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
class MeasuredPosition(AbstractObservation):
    """An instrument, such as a laser tracker, measures a point of the tool.

    The place is that of the instrument.

    Attributes:
        positions: Measured positions in the instrument's frame [m].
    """

    place_freedoms: ClassVar[Freedoms] = FRAME
    measurements: ClassVar[dict[str, Freedoms]] = {"positions": (3,)}
    positions: Numbers

    @property
    def measured(self):
        """Positions, without attitudes."""
        return super().measured._replace(position=np.asarray(self.positions))

    def first_estimates(self, tips):
        """Return the end-effector, and the frame that suits its positions best."""
        return ORIGIN, nearest_frame(tips.position, np.asarray(self.positions))


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
    measured_numbers: ClassVar[Freedoms] = FRAME
    measurements: ClassVar[dict[str, Freedoms]] = {
        "positions": (3,),
        "rotations": (3, 3),
    }
    deviation: float = 1e-3
    rotations: Numbers
    positions: Numbers
    angle_deviation: float = 2e-3

    def __post_init__(self):
        super().__post_init__()
        as_rotations("`rotations`", self.rotations, np.shape(self.rotations))

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
        board = cls(session, q, rotations=rotations, positions=positions, **fields)
        camera = board.measured.inverse
        return dataclasses.replace(
            board, rotations=camera.rotation, positions=camera.position
        )

    @property
    def deviations(self):
        """Those of three lengths and three angles."""
        return np.repeat([self.deviation, self.angle_deviation], 3)

    @property
    def measured(self):
        """Attitudes and positions."""
        return Frame(np.asarray(self.rotations), np.asarray(self.positions))

    def first_estimates(self, tips):
        """Return tool and place for which measured poses suit those of the tips."""
        return tool_and_place(tips, self.measured)


OBSERVATIONS: dict[str, type[AbstractObservation]] = {
    "point_contact": PointContact,
    "known_distance": KnownDistance,
    "measured_position": MeasuredPosition,
    "measured_pose": MeasuredPose,
    "plane_contact": PlaneContact,
}
"""Kinds of observations, by their names in the experiment file."""
