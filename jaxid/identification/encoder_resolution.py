"""Effect of the encoders' resolution on estimates, found by rounding angles once more."""

import dataclasses

import numpy as np

from jaxid.arrays import Float
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.recording import Recording

from .estimators import GivenWeights, WeightedLeastSquares
from .fit_result import Fit
from .problem import RegressionProblem

FEWEST = 100
"""Changes of an angle from which its steps are looked for."""


def encoder_steps(recording: Recording) -> Float[np.ndarray, " joints"]:
    """Return the step of each angle [rad or m]; zero where the values lie on no grid."""
    angles = np.asarray(recording.angles)
    changes = np.concatenate(
        [np.diff(angles[a:b], axis=0) for a, b in recording.segments]
    )
    return np.array([_step(np.abs(x)) for x in changes.T])


def _step(changes: np.ndarray) -> float:
    # What is left after adding and subtracting in binary is no change.
    real = np.sort(changes[changes > 1e-12 * max(changes.max(initial=0.0), 1e-300)])
    if len(real) < FEWEST:
        return 0.0
    counts = real / real[0]
    # Of more steps rounded text does not tell that their number is whole.
    counts = counts[counts < 20.0]
    whole = np.abs(counts - np.round(counts)) < 0.1
    if len(counts) < FEWEST or whole.mean() < 0.99:
        return 0.0
    return float(np.sum(real[: len(counts)]) / np.sum(np.round(counts)))


def resolution_bias(
    fit: Fit, recording: Recording, observations: Observations
) -> Float[np.ndarray, " base"]:
    """Return the bias of base parameters that the encoders' resolution causes, in their units.

    The filtered motion is taken for the true one, and the fitted model's forces for the
    true ones. The angles are rounded as the encoders do, filtered, and the parameters
    estimated again: by how much they change is the bias. Angles on no grid are not
    rounded.
    """
    robot, motion = fit.base.model.robot, observations.motion
    steps = encoder_steps(recording)
    forces = fit.predict(motion) + fit.base.tool_forces(motion)
    exact = np.asarray(motion.q)
    if recording.angles_on_motor_side:
        exact = np.asarray(robot.drives.motor_angles(exact))
    grid = np.where(steps > 0, steps, 1.0)
    rounded = np.where(steps > 0, np.round(exact / grid) * grid, exact)

    def estimate(angles: np.ndarray) -> np.ndarray:
        log = dataclasses.replace(
            recording,
            angles=angles,
            velocities=None,
            forces=forces,
            forces_on_motor_side=False,
        )
        o = observe(log, robot, observations.filter, observations.decimation)
        o = o.replace(mask=observations.mask)
        estimator = WeightedLeastSquares(GivenWeights(np.asarray(fit.weights)))
        return np.asarray(estimator(RegressionProblem(fit.base, o)).parameters)

    return estimate(rounded) - estimate(exact)


def resolution_note(
    fit: Fit, recording: Recording, observations: Observations
) -> tuple[str, ...]:
    """Return a sentence about parameters whose intervals the resolution makes wrong, or nothing."""
    # Biases grow with the square of the steps: small ones cannot matter.
    matters = encoder_steps(recording) > 1e-5 * np.std(
        np.asarray(recording.angles), axis=0
    )
    if recording.velocities is not None or not matters.any():
        return ()
    bias = np.abs(resolution_bias(fit, recording, observations))
    ratio = bias / np.where(
        fit.standard_deviations > 0, fit.standard_deviations, np.inf
    )
    # From half a deviation on an interval of 95 % holds clearly less often.
    worst = np.argsort(-ratio)[: np.count_nonzero(ratio > 0.5)]
    if not len(worst):
        return ()
    names = ", ".join(f"{fit.base.names[k]} by {ratio[k]:.1f}" for k in worst[:4])
    more = f", and {len(worst) - 4} more" if len(worst) > 4 else ""
    return (
        "the encoders are so coarse that parameters are shifted, in standard "
        "deviations: "
        f"{names}{more}. Their intervals are too narrow: move faster, lower the "
        "cut-off of the "
        "filter, or leave slow rows out (`rows.min_speed`).",
    )
