"""Errors of all observations, and their derivatives by all unknowns.

Unknown are a correction of each joint's origin, a compliance of each joint, and the
frames of tools and places. The deflection of a joint is its compliance times the torque
of gravity, for which rough masses suffice.
"""

import dataclasses
import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, Vector, double_precision
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import RigidBodies
from jaxid.program.sample_methods import in_numpy
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot

from .error_derivatives import Kind, PoseErrors, Poses, Unknowns, pose_errors
from .frames import Frame, stacked
from .observations import AbstractObservation, FrameKey

BLOCK = 64
"""Poses are computed in multiples of this number, so that few programs are compiled."""
NEWTON_STEPS = 5
"""Steps to coordinates without errors, which double the digits."""


class Linearisation(NamedTuple):
    """Errors in units of their deviations, and derivatives by all unknowns."""

    errors: Float[np.ndarray, " rows"]
    jacobian: Float[np.ndarray, "rows unknowns"]


class ErrorSizes(NamedTuple):
    """Sizes of the errors of each pose."""

    lengths: Vector  # [m]
    angles: Vector  # [rad]; NaN where no angles were measured


class Rows(NamedTuple):
    """Origin of each row of a linearisation."""

    session: np.ndarray  # index of its session
    pose: np.ndarray  # index of its pose, in the order of the groups


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """Observations of a robot, with everything that does not change in the search.

    Attributes:
        robot: Nominal robot.
        sessions: Names of the sessions.
        frame_keys: Session and name of each unknown frame.
        starts: First estimates of the frames.
        freedoms: For each frame which numbers of its correction are unknown.
        groups: Poses of each kind of observation.
        bodies: Inertial parameters of the bodies; None if joints do not deflect.
    """

    robot: Robot
    sessions: tuple[str, ...]
    frame_keys: tuple[FrameKey, ...]
    starts: Frame
    freedoms: np.ndarray
    groups: dict[Kind, Poses]
    bodies: BodyParameters | None

    @property
    def nominal(self) -> Unknowns:
        """Unknowns of the nominal robot."""
        return Unknowns(
            np.zeros((self.robot.bodies, 6)),
            np.zeros(self.robot.joints),
            np.zeros((len(self.frame_keys), 6)),
        )

    @cached_property
    def rows(self) -> Rows:
        """Session and pose of each row."""
        sessions = []
        poses = []
        first_pose = 0
        for group in self.groups.values():
            count, errors = group.deviations.shape
            sessions.append(np.repeat(group.session, errors))
            poses.append(np.repeat(first_pose + np.arange(count), errors))
            first_pose += count
        return Rows(np.concatenate(sessions), np.concatenate(poses))

    @cached_property
    def row_deviations(self) -> np.ndarray:
        """Standard deviation of the error of each row [m or rad]."""
        return np.concatenate([x.deviations.ravel() for x in self.groups.values()])

    @cached_property
    def pose_sessions(self) -> np.ndarray:
        """Index of the session of each pose."""
        return np.concatenate([group.session for group in self.groups.values()])

    @cached_property
    def is_pose(self) -> np.ndarray:
        """For each pose whether it is one, and no distance of two places."""
        return np.concatenate(
            [
                np.full(len(group.q), kind.has_poses)
                for kind, group in self.groups.items()
            ]
        )

    @property
    def poses_of_sessions(self) -> list[np.ndarray]:
        """Indices of the poses of each session."""
        return [
            np.flatnonzero(self.is_pose & (self.pose_sessions == session))
            for session in range(len(self.sessions))
        ]

    @cached_property
    def session_rows(self) -> list[np.ndarray]:
        """Rows of each session."""
        return [
            np.flatnonzero(self.rows.session == session)
            for session in range(len(self.sessions))
        ]

    @cached_property
    def session_columns(self) -> list[np.ndarray]:
        """Columns of the frames that belong to each session alone."""
        columns = self.frame_columns
        owners = [owner for owner, _ in self.frame_keys]
        return [
            np.concatenate(
                [columns[k] for k, owner in enumerate(owners) if owner == session]
                or [np.zeros(0, int)]
            )
            for session in self.sessions
        ]

    @property
    def frame_columns(self) -> np.ndarray:
        """Columns of the corrections of each frame [frames, 6]."""
        first_column = 6 * self.robot.bodies + self.robot.joints
        size = 6 * len(self.frame_keys)
        return (first_column + np.arange(size)).reshape(-1, 6)

    @cached_property
    def common_columns(self) -> np.ndarray:
        """Columns of everything that all sessions share."""
        session_columns = np.concatenate(self.session_columns)
        return np.setdiff1d(np.arange(self.nominal.vector.size), session_columns)

    @property
    def pose_names(self) -> list[str]:
        """Session, place and number of each pose."""
        names = []
        for group in self.groups.values():
            for session, place, number in zip(
                group.session, group.place, group.number, strict=True
            ):
                _, place_name = self.frame_keys[place]
                names.append(f"{self.sessions[session]}, {place_name}, pose {number}")
        return names

    def error_sizes(self, errors: Vector) -> ErrorSizes:
        """Return the lengths and angles of the errors of each pose.

        Args:
            errors: Errors in units of their deviations.
        """
        lengths = []
        angles = []
        first_row = 0
        for kind, group in self.groups.items():
            rows = first_row + np.arange(group.deviations.size)
            first_row += len(rows)
            values = errors[rows].reshape(group.deviations.shape) * group.deviations
            length_part, sines = np.split(values, [kind.errors_of_lengths], axis=1)
            lengths.append(np.linalg.norm(length_part, axis=1))
            sine = np.minimum(np.linalg.norm(sines, axis=1), 1.0)
            angle = np.arcsin(sine) if kind.errors_of_angles else sine + np.nan
            angles.append(angle)
        return ErrorSizes(np.concatenate(lengths), np.concatenate(angles))

    def linearise(self, vector: Vector) -> Linearisation:
        """Return errors at the unknowns and their derivatives by all of them."""
        unknowns = self.nominal.of(vector)
        errors = []
        blocks = []
        for kind, group in self.groups.items():
            errors_of_kind = self._linearise_group(kind, group, unknowns)
            errors.append(errors_of_kind.values.ravel())
            blocks.append(self._jacobian(group, errors_of_kind))
        return Linearisation(np.concatenate(errors), np.concatenate(blocks))

    def without_errors(self, vector: Vector) -> "CalibrationProblem":
        """Return the problem with the joints moved so that poses have no errors.

        Errors disturb what is the same for all poses: a turn of the whole robot has no
        effect on a ball in a socket, unless the ball is beside it.

        Args:
            vector: Unknowns; joints do not deflect.
        """
        unknowns = self.nominal.of(vector)
        unknowns = unknowns._replace(compliances=np.zeros(self.robot.joints))
        groups = dict(self.groups)
        for kind in groups:
            for _ in range(NEWTON_STEPS):
                # Derivatives by compliances are those by coordinates times torques.
                group = groups[kind]
                unit_group = group._replace(torques=np.ones_like(group.torques))
                errors = self._linearise_group(kind, unit_group, unknowns)
                inverses = np.linalg.pinv(errors.by_compliances, rcond=1e-3)
                steps = np.einsum("pje,pe->pj", inverses, errors.values)
                groups[kind] = group._replace(q=group.q - steps)
        return dataclasses.replace(self, groups=groups)

    def _linearise_group(
        self, kind: Kind, group: Poses, unknowns: Unknowns
    ) -> PoseErrors:
        """Return errors and derivatives of one kind, in whole blocks of poses."""
        count = len(group.q)
        padded_count = BLOCK * math.ceil(count / BLOCK)
        padded_group = Poses(
            *(np.resize(x, (padded_count, *x.shape[1:])) for x in group)
        )
        with double_precision():
            errors = pose_errors(kind, self.robot, unknowns, self.starts, padded_group)
            return PoseErrors(*(np.asarray(x)[:count] for x in errors))

    def _jacobian(self, group: Poses, errors: PoseErrors) -> np.ndarray:
        """Return derivatives by each unknown in its column."""
        shape = errors.values.shape
        jacobian = np.zeros((*shape, self.nominal.vector.size))
        bodies = 6 * self.robot.bodies
        jacobian[..., :bodies] = errors.by_origins.reshape(*shape, bodies)
        jacobian[..., bodies : bodies + self.robot.joints] = errors.by_compliances
        by_frames = ((group.tool, errors.by_tool), (group.place, errors.by_place))
        for frames, slopes in by_frames:
            columns = self.frame_columns[frames][:, None, :]
            columns = np.broadcast_to(columns, slopes.shape)
            np.put_along_axis(jacobian, columns, slopes, axis=2)
        return jacobian.reshape(-1, jacobian.shape[-1])


def build_problem(
    robot: Robot,
    observations: Sequence[AbstractObservation],
    bodies: BodyParameters | None,
) -> CalibrationProblem:
    """Return the problem of some observations.

    Args:
        robot: Nominal robot.
        observations: Observations.
        bodies: Inertial parameters of its bodies, which need to be rough only; None if
            joints do not deflect.
    """
    sessions = tuple(dict.fromkeys(x.session for x in observations))
    starts: dict[FrameKey, Frame] = {}
    freedoms: dict[FrameKey, set[int]] = {}
    for observation in observations:
        keys = (observation.tool_key, observation.place_key)
        kinds_of_freedom = (observation.tool_freedoms, observation.place_freedoms)
        for key, numbers in zip(keys, kinds_of_freedom, strict=True):
            freedoms.setdefault(key, set()).update(numbers)
        # Distances between places tell nothing of where these are.
        if observation.has_poses:
            estimates = observation.first_estimates(_tips(robot, observation))
            for key, estimate in zip(keys, estimates, strict=True):
                starts.setdefault(key, estimate)
    frame_keys = tuple(starts)
    is_free = [[k in freedoms[key] for k in range(6)] for key in frame_keys]
    return CalibrationProblem(
        robot,
        sessions,
        frame_keys,
        stacked([starts[key] for key in frame_keys]),
        np.array(is_free),
        _groups(robot, observations, bodies, sessions, frame_keys),
        bodies,
    )


def _tips(robot: Robot, observation: AbstractObservation) -> Frame:
    """Return the placements of the nominal end-effector in all poses."""
    tips = tip_jacobian(robot, observation.q)
    return Frame(tips.rotation, tips.position)


def _groups(robot, observations, bodies, sessions, frame_keys) -> dict[Kind, Poses]:
    """Return the poses of each kind of observation."""
    parts: dict[Kind, list[Poses]] = {}
    for x in observations:
        q = x.q if x.has_poses else np.zeros((1, robot.joints))
        poses = len(q)

        def repeated(value, poses=poses):
            return np.full(poses, value)

        part = Poses(
            q,
            gravity_torques(robot, bodies, q),
            x.measured,
            np.tile(x.deviations, (poses, 1)),
            repeated(frame_keys.index(x.tool_key)),
            repeated(frame_keys.index(x.place_key)),
            repeated(sessions.index(x.session)),
            np.arange(1, poses + 1),
        )
        parts.setdefault(type(x), []).append(part)
    return {
        kind: Poses(*map(np.concatenate, zip(*group, strict=True)))
        for kind, group in parts.items()
    }


def gravity_torques(
    robot: Robot, bodies: BodyParameters | None, q: np.ndarray
) -> np.ndarray:
    """Return the torques with which gravity turns the joints [N m or N]."""
    if bodies is None:
        return np.zeros((len(q), robot.joints))
    model = Model(robot, (RigidBodies(),))
    rest = np.zeros_like(q)
    parameters = np.ravel(bodies)
    return -np.asarray(
        in_numpy(model, model.forces, q, rest, rest, shared=(parameters,))
    )
