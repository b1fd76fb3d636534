"""Torques of bodies on the joints of a robot along a path."""

import dataclasses

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Matrix, Vector
from jaxid.dynamics.model import Model
from jaxid.program.sample_methods import in_numpy

CUTOFF = 8.0
"""Frequency below which measured positions tell accelerations [Hz]."""


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies that load the joints: a model with its parameters, often from a URDF file.

    Attributes:
        model: Model of the robot.
        parameters: Standard parameters.
        coupled: Whether inertial torques count, beside those of gravity.
    """

    model: Model
    parameters: AnyArray
    coupled: bool = False

    def loads(
        self, paths: np.ndarray, velocities: np.ndarray, step_times: Vector
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the torques between two points of paths, and inertias of the joints.

        The inertia of a joint acts on its own acceleration, and the torque contains all
        else.

        Args:
            paths: Positions [motions, joints, points].
            velocities: Their velocities.
            step_times: Time between two points of each motion [s].

        Returns:
            Torques [N m or N] and inertias [kg m² or kg], both [motions, joints,
            points - 1].
        """
        motion_loads = [
            self._path_loads(path.T, velocity.T, float(dt))
            for path, velocity, dt in zip(paths, velocities, step_times, strict=True)
        ]
        torques, inertias = (np.stack(x) for x in zip(*motion_loads, strict=True))
        return torques, inertias

    def measured_loads(
        self, positions: np.ndarray, sample_times: Vector
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the loads of measured positions, whose noise is filtered out."""
        smooth_positions = [
            _filter_positions(x, float(dt))
            for x, dt in zip(positions, sample_times, strict=True)
        ]
        paths = np.stack(smooth_positions)
        velocities = [
            np.gradient(path, float(dt), axis=-1)
            for path, dt in zip(paths, sample_times, strict=True)
        ]
        return self.loads(paths, np.stack(velocities), sample_times)

    def _path_loads(
        self, path: Matrix, velocity: Matrix, dt: float
    ) -> tuple[Matrix, Matrix]:
        """Return torques and inertias [joints, points - 1] of one path."""
        q = 0.5 * (path[1:] + path[:-1])
        zeros = np.zeros_like(q)
        model = self.model
        parameters = self.parameters
        if not self.coupled:
            gravity = in_numpy(
                model, model.forces, q, zeros, zeros, shared=(parameters,)
            )
            return gravity.T, zeros.T

        qd = np.diff(path, axis=0) / dt
        # Not of positions: their second differences smear the jumps of accelerations.
        qdd = np.diff(velocity, axis=0) / dt
        M = in_numpy(model, model.inertia, q, shared=(parameters,))
        inertias = np.diagonal(M, axis1=1, axis2=2)
        torques = in_numpy(model, model.forces, q, qd, qdd, shared=(parameters,))
        return (torques - inertias * qdd).T, inertias.T


def _filter_positions(positions: Matrix, dt: float) -> Matrix:
    """Return positions below `CUTOFF`."""
    if 0.4 / dt < CUTOFF:
        return positions
    sections = scipy.signal.butter(2, 2.0 * CUTOFF * dt, output="sos")
    return scipy.signal.sosfiltfilt(sections, positions, axis=-1)
