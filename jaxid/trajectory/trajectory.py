"""What a trajectory is: a motion that is known for every time."""

from abc import abstractmethod

import equinox as eqx

from jaxid.dynamics.motion import Motion
from jaxid.types import AnyArray, Float


class AbstractTrajectory(eqx.Module):
    """A motion of all joints as a function of time, with exact derivatives."""

    @abstractmethod
    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many.

        Args:
            t: Times [s].
        """
