"""Effect of encoder resolution on estimates, found by rounding angles once more."""

import dataclasses

import numpy as np

from jaxid.arrays import Float, Joints, Texts
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.recording import Recording

from .estimators import GivenWeights, WeightedLeastSquares
from .fit_result import Fit
from .problem import RegressionProblem

MIN_CHANGES = 100
"""Changes of an angle from which its steps are looked for."""
MAX_COUNT = 20.0
"""Steps of one change up to which text that is rounded tells that they are whole."""
MIN_RATIO = 0.5
"""Bias, in deviations, from which a 95 % interval holds clearly less often."""
MAX_NAMES = 4
"""Parameters that a note names."""


def encoder_steps(recording: Recording) -> Joints:
    """Return the step of each angle [rad or m]; zero for values on no grid."""
    angles = recording.angles
    segments = [np.diff(angles[a:b], axis=0) for a, b in recording.segments]
    changes = np.abs(np.concatenate(segments))
    return np.array([_step(column) for column in changes.T])


def _step(changes) -> float:
    """Return the common divisor of some changes; zero if there is none."""
    # Adding and subtracting in binary leaves tiny numbers that are no change.
    rounding = 1e-12 * max(changes.max(initial=0.0), 1e-300)
    changes = np.sort(changes[changes > rounding])
    if len(changes) < MIN_CHANGES:
        return 0.0
    # The smallest change is taken as one step.
    counts = changes / changes[0]
    is_small = counts < MAX_COUNT
    counts = counts[is_small]
    is_whole = np.abs(counts - np.round(counts)) < 0.1
    if len(counts) < MIN_CHANGES or is_whole.mean() < 0.99:
        return 0.0
    return float(np.sum(changes[is_small]) / np.sum(np.round(counts)))


def resolution_bias(
    fit: Fit, recording: Recording, observations: Observations
) -> Float[np.ndarray, " base"]:
    """Return the bias of base parameters due to encoder resolution, in their units.

    The filtered motion is taken for the true one, and the fitted model's forces for the
    true ones. The angles are rounded as the encoders do, filtered, and the parameters
    estimated again: by how much they change is the bias. Angles on no grid are not
    rounded.
    """
    robot = fit.base.model.robot
    motion = observations.motion
    # A log has the forces of a known tool in it.
    forces = fit.predict(motion) + fit.base.tool_forces(motion)
    angles = motion.q
    if recording.angles_on_motor_side:
        angles = robot.drives.motor_angles(angles)
    steps = encoder_steps(recording)
    grid = np.where(steps > 0, steps, 1.0)
    rounded_angles = np.where(steps > 0, np.round(angles / grid) * grid, angles)
    estimator = WeightedLeastSquares(GivenWeights(fit.weights))

    def estimate(angles):
        log = dataclasses.replace(
            recording,
            angles=angles,
            velocities=None,
            forces=forces,
            forces_on_motor_side=False,
        )
        o = observe(log, robot, observations.filter, observations.decimation)
        o = o.replace(mask=observations.mask)
        return estimator(RegressionProblem(fit.base, o)).parameters

    return estimate(rounded_angles) - estimate(angles)


def resolution_note(
    fit: Fit, recording: Recording, observations: Observations
) -> Texts:
    """Return a sentence on parameters whose intervals the resolution makes wrong.

    It is empty if there are none.
    """
    # Biases grow with the square of the steps: small ones cannot matter.
    ranges = np.std(recording.angles, axis=0)
    is_coarse = encoder_steps(recording) > 1e-5 * ranges
    if recording.velocities is not None or not is_coarse.any():
        return ()
    bias = np.abs(resolution_bias(fit, recording, observations))
    deviations = fit.standard_deviations
    ratio = bias / np.where(deviations > 0, deviations, np.inf)
    worst_parameters = np.argsort(-ratio)[: np.count_nonzero(ratio > MIN_RATIO)]
    if not len(worst_parameters):
        return ()
    names = [
        f"{fit.base.names[k]} by {ratio[k]:.1f}" for k in worst_parameters[:MAX_NAMES]
    ]
    if len(worst_parameters) > MAX_NAMES:
        names.append(f"and {len(worst_parameters) - MAX_NAMES} more")
    return (
        "the encoders are so coarse that they shift parameters. In standard "
        f"deviations: {', '.join(names)}. Their intervals are too narrow: move faster, "
        "lower the cut-off of the filter, or leave slow rows out (`rows.min_speed`).",
    )
