"""How well a model predicts forces that were measured (Eq. 37)."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.dynamics.compiled import tool_forces
from jaxid.dynamics.motion import Motion
from jaxid.identification.fit import Fit
from jaxid.identification.streaming import Progress
from jaxid.measurement.observations import Observations

ROWS = 2**18
"""Rows of a long log that are compared at most."""


class TorqueErrors(eqx.Module):
    """Measured and predicted forces of one recording, and their differences.

    Attributes:
        name: Of the recording.
        time: Of the rows [s].
        measured: Forces, filtered and decimated [N m or N].
        predicted: By the model, filtered and decimated alike [N m or N].
        counted: Which rows count for which joint.
        max_forces: Largest force of each joint [N m or N]; NaN where not known.
    """

    name: str = eqx.field(static=True)
    time: Float[AnyArray, " rows"]
    measured: Float[AnyArray, "rows joints"]
    predicted: Float[AnyArray, "rows joints"]
    counted: Bool[AnyArray, "rows joints"]
    max_forces: Float[AnyArray, " joints"]

    @property
    def errors(self) -> Float[np.ndarray, "rows joints"]:
        """Predicted less measured forces (Eq. 27); NaN where a row does not count [N m or N]."""
        return np.where(
            self.counted, np.asarray(self.predicted) - np.asarray(self.measured), np.nan
        )

    @property
    def mean(self) -> Float[np.ndarray, " joints"]:
        """Mean of the absolute errors of each joint [N m or N] (Eq. 37)."""
        return np.nanmean(np.abs(self.errors), axis=0)

    @property
    def rms(self) -> Float[np.ndarray, " joints"]:
        """Root of the mean of the squared errors of each joint [N m or N]."""
        return np.sqrt(np.nanmean(self.errors**2, axis=0))

    @property
    def mean_percent(self) -> Float[np.ndarray, " joints"]:
        """Mean of the absolute errors in percent of the largest force (Eq. 37)."""
        return 100.0 * self.mean / np.asarray(self.max_forces)

    @property
    def rms_percent(self) -> Float[np.ndarray, " joints"]:
        """RMS errors in percent of the largest force."""
        return 100.0 * self.rms / np.asarray(self.max_forces)

    @property
    def force_rms(self) -> Float[np.ndarray, " joints"]:
        """Root of the mean of the squared measured forces of each joint [N m or N]."""
        measured = np.where(self.counted, np.asarray(self.measured), np.nan)
        return np.sqrt(np.nanmean(measured**2, axis=0))

    @property
    def rms_relative(self) -> Float[np.ndarray, " joints"]:
        """RMS errors relative to the RMS of the measured forces, of 1; NaN without any force."""
        return _share(self.rms, self.force_rms)

    @property
    def relative(self) -> float:
        r"""Norm of all errors relative to the norm of all forces, $|Wp - Q| / |Q|$, of 1."""
        measured = np.where(self.counted, np.asarray(self.measured), np.nan)
        return float(np.sqrt(_share(np.nansum(self.errors**2), np.nansum(measured**2))))

    @property
    def explained(self) -> Float[np.ndarray, " joints"]:
        """Share of each joint's variance that the model explains ($R^2$), of 1."""
        measured = np.where(self.counted, np.asarray(self.measured), np.nan)
        return 1.0 - _share(np.nanmean(self.errors**2, axis=0), np.nanvar(measured, axis=0))


def _share(part: np.ndarray | float, whole: np.ndarray | float) -> np.ndarray:
    """A part of a whole, of 1; NaN where there is no whole."""
    whole = np.asarray(whole, np.float64)
    return np.asarray(part / np.where(whole > 0, whole, np.nan))


def torque_errors(
    fit: Fit, observations: Observations, progress: Progress | None = None
) -> TorqueErrors:
    """Compares the forces that a model predicts with measured ones (Eqs. 27, 37).

    The prediction is filtered and decimated like the measurement. Long logs are gone through part
    by part; of more than `ROWS` rows every n-th is compared.

    Args:
        fit: The model.
        observations: Of any recording of the same robot.
        progress: Is told now and then which share of a long log is done, of 1.
    """
    robot = fit.base.model.robot
    known = robot.known_max_forces
    known = np.where(np.isfinite(known), known, np.nan)
    every = compared_rows(observations)
    measured, predicted = _by_parts(fit, observations, every, progress)
    return TorqueErrors(
        name=observations.name,
        time=observations.reduced_time[::every],
        measured=measured,
        predicted=predicted,
        counted=np.asarray(observations.mask)[::every],
        max_forces=known,
    )


def compared_rows(log: Observations) -> int:
    """The n of a long log of which every n-th row is compared."""
    return -(-log.rows // ROWS)


def _predicted(fit: Fit, motion: Motion) -> np.ndarray:
    return fit.predict(motion) + tool_forces(fit.base, motion)


def _by_parts(
    fit: Fit, log: Observations, every: int, progress: Progress | None
) -> tuple[np.ndarray, np.ndarray]:
    """Measured and predicted forces of every n-th row; nothing is computed for masked parts."""
    mask = np.asarray(log.mask)
    kept = len(range(0, log.rows, every))
    measured, predicted = np.zeros((2, kept, log.joints))
    for chunk in log.chunks(65536):
        first, stop = chunk.rows
        own = slice(-(-first // every), -(-stop // every))
        if mask[first:stop].any():
            motion, forces = log.read(slice(*chunk.samples))
            away = slice(own.start * every - first, None, every)
            measured[own] = chunk.reduce(forces)[away]
            predicted[own] = chunk.reduce(_predicted(fit, motion))[away]
        if progress is not None:
            progress(stop / log.rows)
    return measured, predicted
