"""Kinematic calibration from files: sessions become a report."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import scipy

from jaxid.errors import InputError
from jaxid.measurement.log_files import READERS, open_log_file

from .setup import Paths, Progress, Setup, ignore_progress

if TYPE_CHECKING:
    from jaxid.calibration import AbstractObservation
    from jaxid.report.calibration_report import CalibrationReport

Columns = str | int | list[str | int]
"""One column, several, or a pattern with `{}` for numbers."""
ATTITUDE_SIZES = {3: "from_rotvec", 4: "from_quat"}
"""How many columns hold an attitude, and how SciPy reads it."""


@dataclasses.dataclass(frozen=True)
class CalibrationSettings:
    """Settings of `jaxid calibrate`.

    Attributes:
        observation: What was measured. `point_contact`: a point of the tool stayed at
            one place, like a ball in a socket; `plane_contact`: it touched a plane;
            `known_distance`: it had a known distance from a fixed point;
            `measured_position` and `measured_pose`: an instrument measured it.
        joints: Columns of the joint coordinates, like `"q{}"`; by default the first
            ones.
        position: Columns of a measured position, like `["x", "y", "z"]`.
        attitude: Columns of a measured attitude, like `["rx", "ry", "rz"]`: a rotation
            vector [rad], or a quaternion (x, y, z, w).
        angle_unit: Unit of the joint coordinates.
        length_unit: Unit of measured positions and distances.
        eye_in_hand: Whether a measured pose is that of a board in a camera on the
            robot. Otherwise it is that of the tool in the frame of the instrument, or
            that of a camera on the robot in the frame of a board.
        distance: Distance from the fixed point, in the length unit; for point contacts
            that of the two places of each session, if it is known.
        place_stays: Whether all sessions have the same place (instrument, board).
        parts: Number of random parts into which all poses are divided, as sessions, if
            everything was set up only once; 1 for sessions of their own.
        deviation: Standard deviation of measured lengths [m].
        angle_deviation: Standard deviation of measured attitudes [rad].
        compliance: Whether joints deflect under gravity.
        masses: Rough masses of the bodies [kg], like `[5.0, 0.6, 3.2]`; by default the
            bodies of the robot's file.
    """

    observation: Literal[
        "point_contact",
        "plane_contact",
        "known_distance",
        "measured_position",
        "measured_pose",
    ] = "point_contact"
    joints: Columns | None = None
    position: Columns | None = None
    attitude: Columns | None = None
    angle_unit: Literal["rad", "deg"] = "rad"
    length_unit: Literal["m", "mm"] = "m"
    eye_in_hand: bool = False
    distance: float | None = None
    place_stays: bool = False
    parts: int = 1
    deviation: float | None = None
    angle_deviation: float | None = None
    compliance: bool = True
    masses: list[float] | None = None

    @property
    def metres(self) -> float:
        """Length unit [m]."""
        return 1e-3 if self.length_unit == "mm" else 1.0


class SessionFile(NamedTuple):
    """File with the poses of one place in one session."""

    session: str
    place: str
    path: Path


def calibrate_from_files(
    setup: Setup,
    paths: Paths,
    settings: CalibrationSettings,
    progress: Progress = ignore_progress,
) -> "CalibrationReport":
    """Calibrate the geometry of a robot from the files of several sessions.

    Args:
        setup: Setup, whose robot is the nominal one.
        paths: Files, each a session of one place, or folders. A folder that holds
            folders has one for each session, with a file for each place; other folders
            are one session.
        settings: Columns of the files, and what was measured.
        progress: Callback, called with a stage and its completed fraction (0 to 1) of
            all stages.
    """
    # Other commands do not wait for calibrations.
    from jaxid.calibration import rough_bodies
    from jaxid.calibration.calibrate import calibrate
    from jaxid.report.calibration_report import calibration_report

    files = list(session_files([Path(path) for path in paths]))
    if len({file.path.resolve() for file in files}) < len(files):
        raise InputError("`sessions` must be different, but some are given twice.")
    progress("reading the sessions", 0.0)
    observations = read_observations(setup, files, settings)
    bodies = None
    if settings.masses is not None:
        bodies = rough_bodies(setup.robot, settings.masses)
    progress("calibrating", 0.1)
    fit = calibrate(
        setup.robot, observations, bodies=bodies, compliance=settings.compliance
    )
    progress("holding sessions out", 0.6)
    sources: dict[str, list[Path]] = {}
    for file in files:
        sources.setdefault(file.session, []).append(file.path)
    return calibration_report(fit, sources)


def session_files(paths: list[Path]) -> Iterator[SessionFile]:
    """Yield the files of all sessions.

    Raises:
        InputError: If there is no file.
    """
    for path in paths:
        if not path.is_dir():
            yield SessionFile(path.stem, "place", path)
            continue
        folders = sorted(x for x in path.iterdir() if x.is_dir())
        count = 0
        for folder in folders or [path]:
            for file in sorted(folder.iterdir()):
                if file.suffix.lower() in READERS:
                    count += 1
                    yield SessionFile(folder.name, file.stem, file)
        if not count:
            raise InputError(
                f"`{path}` must hold files with poses, or a folder of them for each "
                f"session, but has none that ends in {', '.join(READERS)}."
            )


def read_observations(
    setup: Setup, files: list[SessionFile], settings: CalibrationSettings
) -> "list[AbstractObservation]":
    """Return the observations of all sessions."""
    from jaxid.calibration import SocketDistance

    observations: list[Any] = []
    places: dict[str, list[str]] = {}
    for file in files:
        try:
            q, measurements = _read(setup, file.path, settings)
        except InputError as error:
            # Sessions have files of the same names.
            owner = f"session `{file.session}`, {setup.robot.joints} joints"
            raise InputError(f"{owner}: {error}") from None
        fields = {
            **measurements,
            "place": file.place,
            "place_stays": settings.place_stays or settings.parts > 1,
        }
        places.setdefault(file.session, []).append(file.place)
        for name in ("deviation", "angle_deviation"):
            if getattr(settings, name) is not None:
                fields[name] = getattr(settings, name)
        for session, rows in _parts(file.session, len(q), settings.parts):
            part = {k: x[rows] if k in measurements else x for k, x in fields.items()}
            observations.append(_observation(settings, session, q[rows], part))
    if settings.observation == "point_contact" and settings.distance is not None:
        for session, names in places.items():
            if len(names) != 2:
                raise InputError(
                    "`calibration.distance` is that of two places in each session, but "
                    f"session `{session}` has {len(names)}: leave it out."
                )
            observations.append(
                SocketDistance(
                    session,
                    distance=settings.metres * settings.distance,
                    place=names[0],
                    other_place=names[1],
                )
            )
    return observations


def _parts(session: str, poses: int, count: int) -> list[tuple[str, np.ndarray]]:
    """Return a session, or random parts of it, with the rows of their poses."""
    if count == 1:
        return [(session, np.arange(poses))]
    order = np.random.default_rng(0).permutation(poses)
    rows = np.array_split(order, count)
    return [(f"part {number}", x) for number, x in enumerate(rows, 1) if len(x)]


def _observation(
    settings: CalibrationSettings, session: str, q: np.ndarray, fields: dict[str, Any]
) -> "AbstractObservation":
    """Return the observation of one place."""
    from jaxid.calibration import OBSERVATIONS, MeasuredPose

    if settings.observation == "measured_pose" and settings.eye_in_hand:
        return MeasuredPose.eye_in_hand(session, q, **fields)
    return OBSERVATIONS[settings.observation](session, q, **fields)


def _read(
    setup: Setup, path: Path, settings: CalibrationSettings
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the joint coordinates of a file, and its measurements by their names."""
    robot = setup.robot
    joints = settings.joints
    if joints is None:
        joints = list(range(robot.joints))
    selections: dict[str, Any] = {"joints": joints}
    if settings.observation in ("measured_position", "measured_pose"):
        selections["position"] = settings.position
    if settings.observation == "measured_pose":
        selections["attitude"] = settings.attitude
    for name, columns in selections.items():
        if columns is None:
            raise InputError(
                f"`calibration.{name}` is missing: name the columns of `{path.name}` "
                f"for `{settings.observation}`."
            )
        is_list = isinstance(columns, list)
        selections[name] = tuple(columns) if is_list else columns
    file = open_log_file(path, selections, robot.joint_names)
    channels = file.channels()
    table = file.table(channels, False, None).read(channels)
    blocks = {
        name: np.concatenate([table.numbers(x) for x in columns], axis=1)
        for name, columns in channels.items()
    }
    q = blocks["joints"]
    if settings.angle_unit == "deg":
        q = q * np.where(robot.revolute, np.pi / 180.0, 1.0)[: q.shape[1]]
    measurements = {}
    if "position" in blocks:
        measurements["positions"] = settings.metres * blocks["position"]
    if "attitude" in blocks:
        measurements["rotations"] = _rotations(blocks["attitude"], path)
    if settings.observation == "known_distance":
        if settings.distance is None:
            raise InputError("`calibration.distance` is missing: give the distance.")
        distances = np.full(len(q), settings.metres * settings.distance)
        measurements["distance"] = distances
    return q, measurements


def _rotations(numbers: np.ndarray, path: Path) -> np.ndarray:
    """Return rotations from rotation vectors or quaternions."""
    method = ATTITUDE_SIZES.get(numbers.shape[1])
    if method is None or (method == "from_quat" and not numbers.any(axis=1).all()):
        raise InputError(
            "`calibration.attitude` must name the 3 columns of a rotation vector, or "
            f"the 4 of a quaternion other than zero, but `{path.name}` has "
            f"{numbers.shape[1]} of them."
        )
    return getattr(scipy.spatial.transform.Rotation, method)(numbers).as_matrix()
