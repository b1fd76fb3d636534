"""Several motions one after the other."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.trajectory.trajectory import AbstractTrajectory, each_time

LARGEST_JUMP = 1e-6
"""Jump of a coordinate or its derivatives between two motions that counts as rounding."""


class Segments(AbstractTrajectory):
    """Motions that follow one another without a pause.

    `Segments.of` checks that each one starts as the one before it ends. Before its start and after
    its end the whole goes on as its first and its last member do.

    Attributes:
        members: In the order in which they are run.
    """

    members: tuple[AbstractTrajectory, ...]

    @classmethod
    def of(cls, *members: AbstractTrajectory, largest_jump: float = LARGEST_JUMP) -> "Segments":
        """Puts motions together.

        Args:
            members: In the order in which they are run.
            largest_jump: Of coordinates, velocities or accelerations where two of them meet, in the
                joint's unit and its rates [rad or m, per s, per s²].

        Raises:
            InputError: If there is none, or one does not start as the one before it ends.
        """
        if not members:
            raise InputError("`members` must hold at least one trajectory, but is empty.")
        whole = cls(tuple(members))
        for k, (before, after) in enumerate(itertools.pairwise(members)):
            end, start = before.motion(before.duration), after.motion(0.0)
            if end.joints != start.joints:
                raise InputError(
                    f"trajectories {k + 1} and {k + 2} must move the same joints, but have "
                    f"{end.joints} and {start.joints}."
                )
            for what, x, y in (
                ("coordinate", end.q, start.q),
                ("velocity", end.qd, start.qd),
                ("acceleration", end.qdd, start.qdd),
            ):
                jump = np.abs(np.asarray(y) - np.asarray(x))
                if jump.max() > largest_jump:
                    raise InputError(
                        f"the {what} of joint {int(jump.argmax()) + 1} jumps by {jump.max():.3g} "
                        f"between trajectories {k + 1} and {k + 2}: start the second as the first "
                        "ends, put a `Spline` between them, or raise `largest_jump`."
                    )
        return whole

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """Of all members together [s]."""
        return sum(member.duration for member in self.members)

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many [s]."""
        return each_time(self._at, t)

    def _at(self, time: Float[Array, ""]) -> Motion:
        begin, whole = 0.0, self.members[0].motion(time)
        for before, member in itertools.pairwise(self.members):
            begin = begin + before.duration
            now, later = member.motion(time - begin), time >= begin
            whole = jax.tree.map(lambda x, y, later=later: jnp.where(later, y, x), whole, now)
        return whole
