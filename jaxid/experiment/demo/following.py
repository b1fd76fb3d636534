"""What identification is for: how well a path is followed with and without a model."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.identification.fit import Fit
from jaxid.robot.kinematics import tip_jacobian
from jaxid.simulation.experiment import Tracking
from jaxid.simulation.tx90l import cad_tx90l_on_rail
from jaxid.simulation.virtual import VirtualRobot
from jaxid.trajectory.tip_path import TipPath
from jaxid.trajectory.trajectory import PiecewisePolynomial

NO_MODEL, CAD, IDENTIFIED = "no model", "CAD values", "identified model"
"""What is fed forward."""

FeedForward = Callable[[Motion], np.ndarray]


class Followed(NamedTuple):
    """One run along the path.

    Attributes:
        name: What was fed forward.
        run: What happened.
        away: Distance of the end-effector from where it should be, at the samples [m].
        joints: RMS of the joints' errors [rad or m].
    """

    name: str
    run: Tracking
    away: np.ndarray
    joints: np.ndarray

    @property
    def rms(self) -> float:
        """Of the end-effector's distance [m]."""
        return float(np.sqrt(np.mean(self.away**2)))

    @property
    def largest(self) -> float:
        """Distance of the end-effector [m]."""
        return float(self.away.max())


def followed(
    virtual: VirtualRobot, path: TipPath, joints: PiecewisePolynomial, fit: Fit, seed: int
) -> tuple[Followed, ...]:
    """Runs the path by the servo alone, and with two models fed forward.

    Args:
        virtual: The robot.
        path: Of the end-effector.
        joints: The same of the joints.
        fit: The identified model.
        seed: Of the sensors' noise.
    """
    model, cad = virtual.model, cad_tx90l_on_rail()

    def from_cad(motion: Motion) -> np.ndarray:
        return np.asarray(model.inverse_dynamics(cad, motion))

    controllers: tuple[tuple[str, FeedForward | None], ...] = (
        (NO_MODEL, None),
        (CAD, from_cad),
        (IDENTIFIED, fit.predict),
    )
    runs = []
    for k, (name, feed_forward) in enumerate(controllers):
        run = virtual.track(joints, feed_forward=feed_forward, seed=100 + 10 * seed + k, name=name)
        place = tip_jacobian(model.robot, np.asarray(run.actual.q)).position
        away = np.linalg.norm(place - path.positions(np.asarray(run.time)), axis=1)
        rms = np.sqrt(np.mean(np.asarray(run.tracking_error) ** 2, axis=0))
        runs.append(Followed(name, run, away, rms))
    return tuple(runs)
