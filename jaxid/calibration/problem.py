"""Errors of all observations, and their derivatives by all unknowns.

Unknown are a correction of each joint's origin, a compliance of each joint, and the
frames of tools and places. The deflection of a joint is its compliance times the torque
of gravity, for which rough masses suffice.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import Float, Matrix, Texts, Vector
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import RigidBodies
from jaxid.program.sample_methods import in_numpy
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot

from .error_derivatives import PoseErrors, Poses, Unknowns, pose_errors
from .frames import Frame
from .observations import AbstractObservation, FrameKey

NEWTON_STEPS = 5
"""Steps to coordinates without errors, which double the digits."""
RANDOM_POSES = 200
"""Number of poses in which the largest torque of gravity is sought."""
MIN_TORQUE = 1.0
"""Torque of gravity that arms with less are taken to have [N m]."""


class Linearisation(NamedTuple):
    """Errors in units of their deviations, and derivatives by all unknowns."""

    errors: Float[np.ndarray, "poses 6"]
    jacobian: Float[np.ndarray, "poses 6 unknowns"]


class ErrorSizes(NamedTuple):
    """Sizes of the errors of each pose."""

    lengths: Vector  # [m]
    angles: Vector  # [rad]; NaN where no angles were measured


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """Observations of a robot, with everything that does not change in the search.

    Attributes:
        robot: Nominal robot.
        sessions: Names of the sessions.
        frame_keys: Session and name of each unknown frame.
        starts: First estimates of the frames.
        freedoms: For each frame which numbers of its correction are unknown.
        poses: Poses of all observations.
        bodies: Inertial parameters of the bodies; None if joints do not deflect.
    """

    robot: Robot
    sessions: Texts
    frame_keys: tuple[FrameKey, ...]
    starts: Frame
    freedoms: np.ndarray
    poses: Poses
    bodies: BodyParameters | None

    @property
    def nominal(self) -> Unknowns:
        """Unknowns of the nominal robot."""
        return Unknowns(
            np.zeros((self.robot.bodies, 6)),
            np.zeros(self.robot.joints),
            np.zeros((len(self.frame_keys), 6)),
        )

    @property
    def reach(self) -> float:
        """Length of the stretched robot, without joints that slide [m]."""
        offsets = np.linalg.norm(self.robot.offset, axis=1)
        return float(offsets.sum() + np.linalg.norm(self.robot.tip_offset))

    @cached_property
    def largest_torque(self) -> float:
        """Largest torque of gravity in random poses of the robot [N m].

        Recorded poses do not change it, so that those of a session that is held out
        have no effect.
        """
        angles = np.random.default_rng(0).uniform(
            -np.pi, np.pi, (RANDOM_POSES, self.robot.joints)
        )
        q = np.where(self.robot.revolute, angles, 0.0)
        torques = np.abs(gravity_torques(self.robot, self.bodies, q))
        return float(torques[:, self.robot.revolute].max(initial=MIN_TORQUE))

    @property
    def frame_scales(self) -> Vector:
        """Scales of unknowns that leave the geometry nominal."""
        return self.nominal._replace(frames=self.freedoms.astype(float)).vector

    @property
    def poses_of_sessions(self) -> list[np.ndarray]:
        """Indices of the poses of each session."""
        is_pose = self.poses.is_pose
        return [
            np.flatnonzero(is_pose & (self.poses.session == session))
            for session in range(len(self.sessions))
        ]

    @cached_property
    def session_columns(self) -> list[np.ndarray]:
        """Columns of the frames that belong to each session alone."""
        owners = np.array([owner for owner, _ in self.frame_keys])
        return [self.frame_columns[owners == name].ravel() for name in self.sessions]

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
    def place_names(self) -> np.ndarray:
        """Session and place of each pose."""
        pairs = zip(self.poses.session, self.poses.place, strict=True)
        return np.array(
            [f"{self.sessions[x]}, {self.frame_keys[place][1]}" for x, place in pairs]
        )

    @property
    def pose_names(self) -> list[str]:
        """Session, place and number of each pose."""
        pairs = zip(self.place_names, self.poses.number, strict=True)
        return [f"{place}, pose {number}" for place, number in pairs]

    def error_sizes(self, errors: Float[np.ndarray, "poses 6"]) -> ErrorSizes:
        """Return the lengths and angles of the errors of each pose.

        Args:
            errors: Errors in units of their deviations.
        """
        deviations = self.poses.deviations
        is_measured = np.isfinite(deviations)
        values = errors * np.where(is_measured, deviations, 0.0)
        lengths, sines = np.linalg.norm(values.reshape(-1, 2, 3), axis=2).T
        angles = np.arcsin(np.minimum(sines, 1.0))
        has_angles = is_measured[:, 3:].any(axis=1)
        return ErrorSizes(lengths, np.where(has_angles, angles, np.nan))

    def pose_errors(self, vector: Vector) -> PoseErrors:
        """Return the errors of all poses at the unknowns."""
        unknowns = self.nominal.of(vector)
        return pose_errors(self.robot, unknowns, self.starts, self.poses)

    def linearise(self, vector: Vector) -> Linearisation:
        """Return errors at the unknowns and their derivatives by all of them."""
        errors = self.pose_errors(vector)
        jacobian = np.zeros((*errors.values.shape, len(vector)))
        jacobian[..., : errors.by_geometry.shape[2]] = errors.by_geometry
        poses = self.poses
        for frames, slopes in (
            (poses.tool, errors.by_tool),
            (poses.place, errors.by_place),
        ):
            columns = self.frame_columns[frames][:, None]
            columns = np.broadcast_to(columns, slopes.shape)
            np.put_along_axis(jacobian, columns, slopes, axis=2)
        return Linearisation(errors.values, jacobian)

    def without_errors(self, vector: Vector) -> "CalibrationProblem":
        """Return the problem with the joints moved so that poses have no errors.

        Errors disturb what is the same for all poses: a turn of the whole robot has no
        effect on a ball in a socket, unless the ball is beside it.

        Args:
            vector: Unknowns; joints do not deflect.
        """
        unknowns = self.nominal.of(vector)
        rigid = unknowns._replace(compliances=np.zeros(self.robot.joints)).vector
        # Derivatives by compliances are those by coordinates times torques.
        torques = np.ones_like(self.poses.torques)
        problem = self.with_poses(torques=torques)
        for _ in range(NEWTON_STEPS):
            errors = problem.pose_errors(rigid)
            slopes = errors.by_geometry[..., 6 * self.robot.bodies :]
            inverses = np.linalg.pinv(slopes, rcond=1e-3)
            steps = np.einsum("pje,pe->pj", inverses, errors.values)
            problem = problem.with_poses(q=problem.poses.q - steps)
        return problem.with_poses(torques=self.poses.torques)

    def with_poses(self, **fields: Any) -> "CalibrationProblem":
        """Return the problem with other numbers of its poses."""
        poses = dataclasses.replace(self.poses, **fields)
        return dataclasses.replace(self, poses=poses)


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
    sessions = list(dict.fromkeys(x.session for x in observations))
    starts: dict[FrameKey, Frame] = {}
    freedoms: dict[FrameKey, set[int]] = {}
    for observation in observations:
        keys = (observation.tool_key, observation.place_key)
        kinds_of_freedom = (observation.tool_freedoms, observation.place_freedoms)
        for key, numbers in zip(keys, kinds_of_freedom, strict=True):
            freedoms.setdefault(key, set()).update(numbers)
        # Distances between places tell nothing of where these are.
        if observation.has_poses:
            tips = tip_jacobian(robot, observation.q)
            estimates = observation.first_estimates(Frame(tips.rotation, tips.position))
            for key, estimate in zip(keys, estimates, strict=True):
                starts.setdefault(key, estimate)
    frame_keys = list(starts)
    parts: dict[str, list[np.ndarray]] = {}
    for x in observations:
        q = x.q if x.has_poses else np.zeros((1, robot.joints))
        numbers = {
            "is_distance": x.is_distance,
            "is_pose": x.has_poses,
            "tool": frame_keys.index(x.tool_key),
            "place": frame_keys.index(x.place_key),
            "session": sessions.index(x.session),
            "deviations": x.deviations,
        }
        columns = {name: np.array([value] * len(q)) for name, value in numbers.items()}
        columns["q"] = q
        columns["number"] = np.arange(1, len(q) + 1)
        columns |= x.measured._asdict()
        for name, column in columns.items():
            parts.setdefault(name, []).append(column)
    fields = {name: np.concatenate(columns) for name, columns in parts.items()}
    measured = Frame(fields.pop("rotation"), fields.pop("position"))
    torques = gravity_torques(robot, bodies, fields["q"])
    return CalibrationProblem(
        robot,
        tuple(sessions),
        tuple(frame_keys),
        Frame(*map(np.stack, zip(*starts.values(), strict=True))),
        np.array([[k in freedoms[key] for k in range(6)] for key in frame_keys]),
        Poses(torques=torques, measured=measured, **fields),
        bodies,
    )


def gravity_torques(robot: Robot, bodies: BodyParameters | None, q: Matrix) -> Matrix:
    """Return the torques with which gravity turns the joints [N m or N]."""
    if bodies is None:
        return np.zeros((len(q), robot.joints))
    model = Model(robot, (RigidBodies(),))
    rest = np.zeros_like(q)
    parameters = np.ravel(bodies)
    return -np.asarray(
        in_numpy(model, model.forces, q, rest, rest, shared=(parameters,))
    )
