"""Kinematic calibration from files: sessions become a report."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Vector
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.excitation.constraints import Clearance
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.columns import Columns
from jaxid.measurement.log_files import READERS, open_log_file
from jaxid.result_table import Remark, Status, percent
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import validate

from .log_identification import split_logs
from .log_loading import load_logs
from .setup import Paths, Progress, Setup, ignore_progress

if TYPE_CHECKING:
    from jaxid.calibration import AbstractObservation
    from jaxid.report.calibration_report import CalibrationReport

ColumnNames = str | int | list[str | int]
"""One column, several, or a pattern with `{}` for numbers."""
ATTITUDE_SIZES = {3: "from_rotvec", 4: "from_quat"}
"""How many columns hold an attitude, and how SciPy reads it."""
MEASUREMENTS = {
    "measured_position": ("position",),
    "measured_pose": ("position", "attitude"),
    "eye_in_hand": ("position", "attitude"),
}
"""Keys of the columns that hold measurements, by the kind of observation."""
HELD_OUT_SHARE = 0.4
"""Last part of each log of torques that is kept for their errors."""
MIN_CHANGE = 0.02
"""Relative change of the torques' errors that is worth a word."""


@dataclasses.dataclass(frozen=True)
class CalibrationSettings:
    """Settings of `jaxid calibrate`.

    Attributes:
        observation: What was measured. `point_contact`: a point of the tool stayed at
            one place, like a ball in a socket; `plane_contact`: it touched a plane;
            `known_distance`: it had a known distance from a fixed point;
            `measured_position` and `measured_pose`: an instrument measured the tool, or
            the pose of a camera on the robot is known in the frame of a board;
            `eye_in_hand`: such a camera measured the pose of the board.
        joints: Columns of the joint coordinates, like `"q{}"`; by default the first
            ones.
        position: Columns of a measured position, like `["x", "y", "z"]`.
        attitude: Columns of a measured attitude, like `["rx", "ry", "rz"]`: a rotation
            vector [rad], or a quaternion (x, y, z, w).
        angle_unit: Unit of the joint coordinates.
        length_unit: Unit of measured positions and distances.
        distance: Distance from the fixed point, in the length unit; for point contacts
            that of the two places of each session, if it is known.
        parts: Number of random parts into which all poses are divided, as sessions, if
            everything was set up only once; 1 for sessions of their own.
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
        "eye_in_hand",
    ] = "point_contact"
    joints: ColumnNames | None = None
    position: ColumnNames | None = None
    attitude: ColumnNames | None = None
    angle_unit: Literal["rad", "deg"] = "rad"
    length_unit: Literal["m", "mm"] = "m"
    distance: float | None = None
    parts: int = 1
    compliance: bool = True
    masses: list[float] | None = None

    @property
    def metres(self) -> float:
        """Length unit [m]."""
        return 1e-3 if self.length_unit == "mm" else 1.0

    def radians(self, robot: Robot) -> Vector:
        """Return the unit of each joint's coordinate [rad or m]."""
        angle = np.deg2rad(1.0) if self.angle_unit == "deg" else 1.0
        return np.where(robot.revolute, angle, 1.0)


class TorqueLogs(NamedTuple):
    """Logs of torques, which better geometry may explain better."""

    paths: Paths
    columns: Columns


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
    clearance: Callable[[], Clearance | None] = lambda: None,
    logs: TorqueLogs | None = None,
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
        clearance: Function that returns the distance that shapes keep in poses to
            record, or None; called after the calibration.
        logs: Logs whose torques are compared with both geometries.
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
    findings = []
    if logs is not None:
        progress("comparing torques", 0.3)
        findings.append(compare_torques(setup, fit.robot, logs))
    progress("holding sessions out", 0.6)
    sources: dict[str, list[Path]] = {}
    for file in files:
        sources.setdefault(file.session, []).append(file.path)
    units = settings.radians(setup.robot)
    return calibration_report(fit, sources, clearance(), units, findings)


def compare_torques(setup: Setup, calibrated: Robot, logs: TorqueLogs) -> Remark:
    """Return whether a model with calibrated geometry predicts torques better."""
    paths = [Path(path) for path in logs.paths]
    parts = split_logs(
        load_logs(setup, paths, logs.columns), len(paths), HELD_OUT_SHARE
    )
    better_setup = dataclasses.replace(
        setup, unknowns=Model(calibrated, setup.model.terms)
    )
    before, after = (
        _torque_error(geometry, parts.training_logs, parts.unseen_logs)
        for geometry in (setup, better_setup)
    )
    change = after / before - 1.0
    words = "this changes little"
    if abs(change) > MIN_CHANGE:
        words = "better geometry helps" if change < 0.0 else "look at the corrections"
    text = (
        f"Torques of {', '.join(path.name for path in paths)}, last "
        f"{100 * HELD_OUT_SHARE:g} % of each log held out: the error is "
        f"{percent(before, 3)} % with the nominal geometry and {percent(after, 3)} % "
        f"with the calibrated one; {words}"
    )
    return Remark(text, Status.DOUBTFUL if change > MIN_CHANGE else Status.GOOD)


def _torque_error(setup: Setup, fitted_logs: list, unseen_logs: list) -> float:
    """Return the mean relative error of the torques of logs that are not fitted."""
    fit = setup.fit(RegressionProblem(setup.base, fitted_logs))
    return float(np.mean([x.relative for x in validate(fit, unseen_logs).errors]))


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
    from jaxid.calibration import OBSERVATIONS, MeasuredPose, SocketDistance

    kinds = {**OBSERVATIONS, "eye_in_hand": MeasuredPose.eye_in_hand}
    observations: list[Any] = []
    places: dict[str, list[str]] = {}
    is_divided = settings.parts > 1
    if is_divided:
        _require_one_session(files)
    for file in files:
        try:
            arrays = _read(setup.robot, file.path, settings)
        except InputError as error:
            # Sessions have files of the same names.
            owner = f"session `{file.session}`, {setup.robot.joints} joints"
            raise InputError(f"{owner}: {error}") from None
        places.setdefault(file.session, []).append(file.place)
        poses = len(arrays["q"])
        order = np.random.default_rng(0).permutation(poses)
        for number, rows in enumerate(np.array_split(order, settings.parts), 1):
            observations.append(
                kinds[settings.observation](
                    f"part {number}" if is_divided else file.session,
                    **{name: x[np.sort(rows)] for name, x in arrays.items()},
                    place=file.place,
                    place_stays=is_divided,
                )
            )
    if settings.observation != "point_contact" or settings.distance is None:
        return observations
    for session, names in places.items():
        if len(names) != 2:
            raise InputError(
                "`calibration.distance` is that of two places in each session, but "
                f"session `{session}` has {len(names)}: leave it out."
            )
        owners = [f"part {k + 1}" for k in range(settings.parts)]
        # Each part holds the distance, and all parts together count as one.
        observations += [
            SocketDistance(
                owner,
                distance=settings.metres * settings.distance,
                place=names[0],
                other_place=names[1],
                place_stays=is_divided,
                deviation=SocketDistance.deviation * settings.parts**0.5,
            )
            for owner in (owners if is_divided else [session])
        ]
    return observations


def _require_one_session(files: list[SessionFile]) -> None:
    """Reject several sessions, whose places parts would take for the same."""
    count = len({file.session for file in files})
    if count > 1:
        raise InputError(
            "`calibration.parts` divides the poses of one session, but there are "
            f"{count} sessions: leave it out."
        )


def _read(
    robot: Robot, path: Path, settings: CalibrationSettings
) -> dict[str, np.ndarray]:
    """Return the joint coordinates of a file and its measurements, as observations."""
    first_columns = list(range(robot.joints))
    selections: dict[str, Any] = {"joints": settings.joints or first_columns}
    for name in MEASUREMENTS.get(settings.observation, ()):
        selections[name] = getattr(settings, name)
    for name, columns in selections.items():
        if columns is None:
            raise InputError(
                f"`calibration.{name}` is missing: name the columns of `{path.name}` "
                f"for `{settings.observation}`."
            )
        if isinstance(columns, list):
            selections[name] = tuple(columns)
    file = open_log_file(path, selections, robot.joint_names)
    channels = file.channels()
    table = file.table(channels, False, None).read(channels)
    blocks = {
        name: np.concatenate([table.numbers(x) for x in columns], axis=1)
        for name, columns in channels.items()
    }
    joints = blocks["joints"]
    arrays = {"q": joints * settings.radians(robot)[: joints.shape[1]]}
    if "position" in blocks:
        arrays["positions"] = settings.metres * blocks["position"]
    if "attitude" in blocks:
        arrays["rotations"] = _rotations(blocks["attitude"], path)
    if settings.observation == "known_distance":
        if settings.distance is None:
            raise InputError("`calibration.distance` is missing: give the distance.")
        distance = settings.metres * settings.distance
        arrays["distance"] = np.full(len(joints), distance)
    return arrays


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
