"""Motion of a robot on its feet: its driven joints, its trunk, and which feet stand."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.robot.virtual_joints import GROUP

from .spline import PiecewisePolynomial
from .trajectory import AbstractTrajectory


class MotionOnFeet(AbstractTrajectory):
    """Motion of the driven joints of a robot on its feet, phase by phase.

    Attributes:
        path: Motion of all coordinates: of the trunk on the ground, then of the joints.
        feet: Names of the feet.
        lifts: Times between which each foot is in the air [s].
        coefficients: Numbers from which the motion was made, for each phase.
        forces: Forces of the driven joints by nominal parameters at equidistant times
            from begin to end [N m or N].
    """

    path: PiecewisePolynomial
    feet: tuple[str, ...] = eqx.field(static=True)
    lifts: Float[AnyArray, "feet 2"]
    coefficients: Float[AnyArray, "phases coordinates variables"]
    forces: Float[AnyArray, "times joints"]

    @property
    def duration(self):
        """Time from standstill to standstill [s]."""
        return self.path.duration

    def states(self, t):
        """Return the motion of the driven joints."""
        return tuple(x[:, GROUP:] for x in self.path.states(t))

    def stands(self, t: AnyArray) -> np.ndarray:
        """Return whether each foot stands at times [s] [samples feet]."""
        time = np.asarray(t)[:, None]
        start, stop = np.asarray(self.lifts).T
        return ~((time > start) & (time < stop))

    def columns(self, t):
        """Return whether each foot is to stand, 1 or 0."""
        flags = self.stands(t).T.astype(float)
        names = [f"contact_{foot}" for foot in self.feet]
        return dict(zip(names, flags, strict=True))

    def feed_forward(self, t):
        """Return the forces of the driven joints by nominal parameters [N m or N]."""
        times = np.linspace(0.0, float(self.duration), len(self.forces))
        columns = [np.interp(t, times, column) for column in np.transpose(self.forces)]
        return np.transpose(columns)
