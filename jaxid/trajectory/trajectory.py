"""What a trajectory is: a motion that is known for every time."""

from abc import abstractmethod

from jaxid.arrays import Hashable
from jaxid.dynamics.motion import Motion
from jaxid.types import AnyArray, Float


class AbstractTrajectory(Hashable):
    """A motion of all joints as a function of time, with exact derivatives."""

    @abstractmethod
    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many.

        Args:
            t: Times [s].
        """
