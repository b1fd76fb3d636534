"""Rows of a log under other descriptions of it: signs, units, geometry, gravity."""

from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import Indices, Matrix3
from jaxid.dynamics import projection_equation
from jaxid.dynamics.model import Model
from jaxid.program.sample_methods import in_numpy
from jaxid.robot.robot import Robot

from .filtered_log import GRID_RATE, FilteredLog, Motion
from .row_fits import Judge, RowFit, Rows

WIDTH_SHARES = np.array([0.003, 0.01, 0.03, 0.1])
"""Speeds of transitions of dry friction, over the largest speed of each joint.

Their columns together have all transitions between; one alone could not be chosen from
a log that is described wrongly.
"""
MAX_FRICTION_SHARE = 0.85
"""Share of the squared forces with the sign of the speed: more is friction alone."""
BRAKING = slice(0, 6)
"""Columns of friction that take power: viscous, dry and by load."""


class Geometry(NamedTuple):
    """Numbers of a robot that a mistake may have changed, as `Robot` has them."""

    axis: np.ndarray
    rotation: np.ndarray
    offset: np.ndarray
    gravity: np.ndarray

    @classmethod
    def of(cls, robot: Robot) -> "Geometry":
        """Return the geometry of a robot."""
        return cls(*(np.asarray(getattr(robot, name)) for name in cls._fields))

    def turned(self, joint: int, rotation: Matrix3) -> "Geometry":
        """Return the geometry with a body that is turned in its parent."""
        rotations = self.rotation.copy()
        rotations[joint] = rotations[joint] @ rotation
        return self._replace(rotation=rotations)

    def moved(self, joint: int, shift: np.ndarray) -> "Geometry":
        """Return the geometry with a body that is moved in its parent."""
        offsets = self.offset.copy()
        offsets[joint] = offsets[joint] + self.rotation[joint] @ shift
        return self._replace(offset=offsets)


class _BodyColumns(eqx.Module):
    """Regressor of the bodies with the geometry as input: it is traced once."""

    robot: Robot

    def columns(self, axis, rotation, offset, gravity, q, qd, qdd):
        """Return the columns of a sample, and the forces of the known tool."""
        robot = self.robot.replace(
            axis=axis, rotation=rotation, offset=offset, gravity=gravity
        )
        theta = projection_equation.rigid_body_regressor(robot, q, qd, qdd)
        return theta.reshape(robot.joints, -1)


class DescribedLog:
    """A log, and the rows that it has under other descriptions.

    Attributes:
        log: Filtered log.
        geometry: Geometry of the robot.
        has_force: Whether the force of each joint is not 0 throughout.
        judge: Rows that count, and the score of a description.
        rows: Rows of the log as it is described.
    """

    def __init__(self, model: Model, log: FilteredLog, is_strict: bool = False):
        """Describe a log.

        Args:
            model: Model of the robot.
            log: Filtered log.
            is_strict: Whether forces that are friction alone have no friction by load,
                which would be the force itself, whatever its sign.
        """
        robot = model.robot
        self.robot = robot
        self._has_springs = "ks1" in model.parameter_names
        self.log = log
        self.geometry = Geometry.of(robot)
        # A column of zeros is judged by what the other joints say of it.
        self.has_force = np.any(log.forces != 0, axis=0)
        self.judge = Judge(log.is_moving & self.has_force, log.folds)
        self._body_columns = _BodyColumns(robot)
        self._body_rows = log.rows_of(self.samples_of_bodies(log.motion))
        is_friction_alone = log.friction_shares > MAX_FRICTION_SHARE
        self._has_load_friction = ~(is_friction_alone & is_strict)
        self.rows = self.with_forces(log.forces)

    def samples_of_bodies(
        self, motion: Motion, geometry: Geometry | None = None
    ) -> np.ndarray:
        """Return the columns of the bodies [samples, joints, columns]."""
        owner = self._body_columns
        shared = self.geometry if geometry is None else geometry
        return in_numpy(owner, owner.columns, *motion, shared=tuple(shared))

    def samples_of_friction(self, motion: Motion, forces: np.ndarray) -> np.ndarray:
        """Return the columns of rotor and friction [samples, joints, shapes].

        The derivative of the dry friction imitates what a joint yields before it slips.
        """
        widths = WIDTH_SHARES[:, None] * np.abs(motion.qd).max(axis=0) + 1e-9
        dry = np.tanh(motion.qd / widths[:, None])
        sharp_dry = dry[1]
        shapes = [
            motion.qd,
            *dry,
            sharp_dry * np.abs(forces) * self._has_load_friction,
            motion.qdd,
            np.ones_like(sharp_dry),
            *(self.log.derivative(x) for x in (sharp_dry, dry[-1])),
        ]
        if self._has_springs:
            shapes.append(motion.q)
        return np.stack(shapes, axis=-1)

    def _joined(self, body_rows: np.ndarray, friction: np.ndarray) -> np.ndarray:
        """Return columns of bodies, then those of each joint's own friction."""
        friction_rows = self.log.rows_of(friction)
        row_count, joints, shapes = friction_rows.shape
        own_columns = np.zeros((row_count, joints, joints, shapes))
        diagonal = np.arange(joints)
        own_columns[:, diagonal, diagonal] = friction_rows
        flat_columns = own_columns.reshape(row_count, joints, -1)
        return np.concatenate([body_rows, flat_columns], axis=2)

    def with_motion(self, motion: Motion, geometry: Geometry | None = None) -> Rows:
        """Return the rows with another motion, and perhaps another geometry."""
        body_rows = self.log.rows_of(self.samples_of_bodies(motion, geometry))
        return self._rows(body_rows, motion, self.log.forces)

    def with_geometry(self, geometry: Geometry) -> Rows:
        """Return the rows with another geometry."""
        return self.with_motion(self.log.motion, geometry)

    def with_forces(self, forces: np.ndarray) -> Rows:
        """Return the rows with other forces on the grid."""
        return self._rows(self._body_rows, self.log.motion, forces)

    def with_motion_and_forces(self, motion: Motion, forces: np.ndarray) -> Rows:
        """Return the rows with another motion and other forces."""
        body_rows = self.log.rows_of(self.samples_of_bodies(motion))
        return self._rows(body_rows, motion, forces)

    def _rows(self, body_rows: np.ndarray, motion: Motion, forces: np.ndarray) -> Rows:
        """Return rows of a motion and forces, with the RMS forces of the log.

        The errors of small forces would be small whatever the description.
        """
        columns = self._joined(body_rows, self.samples_of_friction(motion, forces))
        force_rows = self.log.rows_of(forces)
        log_sizes = np.sqrt(np.mean(self.log.force_rows**2, axis=0))
        sizes = np.sqrt(np.mean(force_rows**2, axis=0))
        # A column without forces has no size to keep.
        ratios = np.ones_like(sizes)
        np.divide(log_sizes, sizes, out=ratios, where=(sizes > 0) & (log_sizes > 0))
        return Rows(columns * ratios[:, None], force_rows * ratios)

    def without_gravity_and_coriolis(self) -> Rows:
        """Return the rows if the forces contain neither gravity nor Coriolis terms."""
        q, qd, qdd = self.log.motion
        geometry = self.geometry._replace(gravity=np.zeros(3))
        resting = Motion(q, np.zeros_like(qd), qdd)
        body_rows = self.log.rows_of(self.samples_of_bodies(resting, geometry))
        return self._rows(body_rows, self.log.motion, self.log.forces)

    def with_added_forces(self, force_rows: np.ndarray) -> Rows:
        """Return the rows with something added to the forces that was taken out."""
        return self.rows._replace(forces=self.rows.forces + force_rows)

    def friction_powers(self, rows: Rows, fit: RowFit) -> np.ndarray:
        """Return the mean power of each joint's friction over RMS force and RMS speed.

        It is positive, unless the sign of the joint's force or angle is wrong.
        """
        row_count, joints = rows.forces.shape
        body_count = self._body_rows.shape[2]
        columns = rows.columns[:, :, body_count:]
        diagonal = np.arange(joints)
        square_columns = columns.reshape(row_count, joints, joints, -1)
        own_columns = square_columns[:, diagonal, diagonal]
        parameters = fit.parameters[body_count:].reshape(joints, -1)
        speeds = own_columns[..., 0]
        braking_forces = np.sum((own_columns * parameters)[..., BRAKING], axis=2)
        powers = np.mean(braking_forces * speeds, axis=0)
        sizes = np.mean(rows.forces**2, axis=0) * np.mean(speeds**2, axis=0)
        return powers / np.sqrt(sizes + 1e-300)

    @cached_property
    def _sample_columns(self) -> np.ndarray:
        """All columns on the grid [samples, joints, columns]."""
        bodies = self.samples_of_bodies(self.log.motion)
        friction = self.samples_of_friction(self.log.motion, self.log.forces)
        return np.concatenate([bodies, friction], axis=2)

    def predictions(self, parameters: np.ndarray) -> np.ndarray:
        """Return the forces of the columns on the grid [samples, joints]."""
        samples = self._sample_columns
        body_count = self._body_rows.shape[2]
        joints = samples.shape[1]
        friction_parameters = parameters[body_count:].reshape(joints, -1)
        friction = np.sum(samples[:, :, body_count:] * friction_parameters, axis=2)
        return samples[:, :, :body_count] @ parameters[:body_count] + friction

    def with_low_pass(self, joints: Indices, cutoff: float) -> Rows:
        """Return the rows if a filter made the forces of some joints late."""
        order = 2 if len(joints) == 1 else 1
        sections = scipy.signal.butter(order, cutoff, fs=GRID_RATE, output="sos")

        def filtered(x: np.ndarray) -> np.ndarray:
            return np.asarray(scipy.signal.sosfilt(sections, x, axis=0))

        columns = self.rows.columns.copy()
        body_count = self._body_rows.shape[2]
        shapes = self._sample_columns.shape[2] - body_count
        for joint in joints:
            samples = self._sample_columns[:, joint]
            late_rows = self.log.rows_of(self.log.by_segment(filtered, samples))
            start = body_count + shapes * joint
            columns[:, joint, :body_count] = late_rows[:, :body_count]
            columns[:, joint, start : start + shapes] = late_rows[:, body_count:]
        return self.rows._replace(columns=columns)

    def with_earlier_forces(self, joints: Indices, delay: float) -> Rows:
        """Return the rows with forces of some joints that stand later in the log."""

        def earlier(x: np.ndarray) -> np.ndarray:
            times = np.arange(len(x)) / GRID_RATE
            instants = np.clip(times + delay, times[0], times[-1])
            return scipy.interpolate.CubicSpline(times, x)(instants)

        forces = self.log.forces.copy()
        columns = list(joints)
        forces[:, columns] = self.log.by_segment(earlier, forces[:, columns])
        return self.with_forces(forces)
