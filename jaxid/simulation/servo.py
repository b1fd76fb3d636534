"""The servo of a drive: spring and damper towards the desired motion, and what is fed forward."""

from collections.abc import Callable

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.machine import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError

POSES = 200
"""Over which the inertia of a joint is averaged."""

FeedForward = Callable[[Motion], Float[AnyArray, "samples joints"]]
"""From a desired motion to forces: `fit.predict`, or a model with its parameters (Eqs. 38, 39)."""


class Servo(eqx.Module):
    r"""A controller of every joint by itself, at a fixed rate.

    $u = Q_{m,d} + K_p e + K_d \dot e$ with the error $e$ of the encoder's angle, whose rate is a
    difference behind a first-order low-pass, and held until the next tick.

    Attributes:
        proportional: $K_p$ [N m/rad or N/m].
        derivative: $K_d$ [N m s/rad or N s/m].
        sample_time: Between two ticks [s].
        smoothing: Time constant of the low-pass [s].
    """

    proportional: Float[AnyArray, " joints"]
    derivative: Float[AnyArray, " joints"]
    sample_time: float = 1e-3
    smoothing: float = 2e-3

    def __check_init__(self):
        if not 0 < self.sample_time < np.inf:
            raise InputError(
                f"`sample_time` of the servo must be positive [s], but is {self.sample_time:g}."
            )
        if self.smoothing < 0:
            raise InputError(f"`smoothing` must not be negative [s], but is {self.smoothing:g}.")

    @classmethod
    def tuned(
        cls,
        model: Model,
        parameters: Float[AnyArray, " standard"],
        *,
        frequency: float = 8.0,
        damping: float = 1.0,
        sample_time: float = 1e-3,
    ) -> "Servo":
        """Gains that give every joint, taken by itself, an eigenfrequency and a damping.

        Args:
            model: Whose mass matrix counts: the mean of its diagonal over random poses.
            parameters: Its standard parameters, roughly.
            frequency: Of the joints' answer to a disturbance [Hz].
            damping: Of that answer, 1 for none of it beyond the goal.
            sample_time: Between two ticks [s].

        Raises:
            InputError: If frequency or damping are not positive.
        """
        if not (frequency > 0 and damping > 0):
            raise InputError(
                "`frequency` and `damping` must be positive, but are "
                f"{frequency:g} Hz and {damping:g}."
            )
        turns = np.array(model.robot.revolute)
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (POSES, model.robot.joints)) * turns
        M = in_numpy(model, model.inertia, q, shared=(np.asarray(parameters),))
        inertia = np.diagonal(M, axis1=1, axis2=2).mean(axis=0)
        w = 2.0 * np.pi * frequency
        return cls(w**2 * inertia, 2.0 * damping * w * inertia, sample_time)
