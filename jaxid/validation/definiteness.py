"""Whether an identified mass matrix is positive definite in every pose (Sec. 5)."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.compiled import mass_matrices
from jaxid.identification.fit import Fit
from jaxid.robot.robot import Robot

POSES = 2000


class Definiteness(eqx.Module):
    """Eigenvalues of the mass matrix over random poses.

    Attributes:
        smallest: Smallest eigenvalue over all poses, of the mass matrix in SI units.
        pose: Joint coordinates where it occurs [rad or m].
        indefinite: Share of the poses in which an eigenvalue is not positive, of 1.
        poses: Number of poses.
    """

    smallest: float
    pose: Float[AnyArray, " joints"]
    indefinite: float
    poses: int = eqx.field(static=True)

    @property
    def positive_definite(self) -> bool:
        """Whether every eigenvalue is positive in every pose."""
        return self.smallest > 0.0


def definiteness(fit: Fit, *, poses: int = POSES, seed: int = 0) -> Definiteness:
    """Looks for poses in which the identified mass matrix is not positive definite.

    Args:
        fit: The model.
        poses: Number of random poses over the range of the joints; a joint without limits turns
            once, a rail without limits stays within a metre of zero.
        seed: Of the poses.
    """
    robot = fit.base.model.robot
    low, high = position_range(robot)
    q = np.random.default_rng(seed).uniform(low, high, (poses, robot.joints))
    M = mass_matrices(fit.base, fit.parameters, q)
    smallest = np.linalg.eigvalsh(M)[:, 0]
    worst = int(np.argmin(smallest))
    return Definiteness(float(smallest[worst]), q[worst], float(np.mean(smallest <= 0.0)), poses)


def position_range(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the joints' ranges [rad or m]; a turn, or a metre to either side, where unlimited."""
    half = np.where(np.array(robot.revolute), np.pi, 1.0)
    low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
    return np.where(np.isfinite(low), low, -half), np.where(np.isfinite(high), high, half)
