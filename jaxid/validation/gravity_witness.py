"""Gravity of a fit beside gravity of the file's bodies, which no residual compares."""

from typing import NamedTuple

import numpy as np

from jaxid.result_table import percent

from .descriptions import DescribedLog
from .filtered_log import Motion
from .row_fits import RowFit


class WitnessLimits(NamedTuple):
    """Limits between files whose bodies are 30 % wrong and logs without gravity.

    In 113 simulated clean logs with gravity of at least 10 % of the forces, the
    difference was at most 0.45 and the multiple 0.75 to 1.45. Where a drive that knows
    its robot takes gravity out, they were 0.93 to 1.0 and at most 0.08; where the
    gravity of the file's bodies or all their forces are taken out, 0.57 to 1.15 and at
    most 0.44: a file that is 40 % too light is not always told. With reversed or turned
    gravity the multiple was at most 0.45. The multiple was chosen after all ten
    machines had been seen, the inertia after real logs of a passive joint (up to 0.07).
    """

    difference: float = 0.6
    absent: float = 0.25  # multiple below which there is hardly any gravity
    share: float = 0.15  # share of the forces from which gravity tells something
    inertia: float = 0.12  # below which the robot swings without drives


LIMITS = WitnessLimits()
CAUSES = (
    "the drive or the log has subtracted it (gravity alone or a model's prediction), "
    "`robot.gravity` does not match the mount, the columns stand in another "
    "order, or a link, an axis or a zero of the angles is wrong"
)
"""Usual causes of another gravity."""


class GravityWitness(NamedTuple):
    """Gravity of a fit against that of the file's bodies, both without their means.

    Attributes:
        difference: RMS of the difference over RMS of the file's.
        multiple: Multiple of the file's that is nearest to that of the fit.
        share: RMS of the file's over RMS of the forces.
        inertia: RMS of the other forces of the bodies over that of the file's.
    """

    difference: float
    multiple: float
    share: float
    inertia: float

    @property
    def is_different(self) -> bool:
        """Whether the gravity of the fit is not that of the file's bodies."""
        is_telling = self.share > LIMITS.share and self.inertia > LIMITS.inertia
        return is_telling and self.difference > LIMITS.difference

    @property
    def is_absent(self) -> bool:
        """Whether the forces hardly contain the gravity of the file's bodies."""
        return self.is_different and self.multiple < LIMITS.absent

    @property
    def sentence(self) -> str:
        """Say how much differs, and the usual causes."""
        difference = f"{percent(self.difference)} %"
        text = "gravity in the forces differs"
        if self.is_absent:
            text = "the forces seem to lack gravity: what they contain differs"
        text = f"{text} by {difference} from that of"
        return f"{text} the file's bodies: {CAUSES}, or the file's bodies are wrong."


def gravity_witness(
    described_log: DescribedLog, fit: RowFit, bodies: np.ndarray
) -> GravityWitness:
    """Compare gravity of a fit with that of a file's bodies [bodies, 10].

    Each joint counts by its RMS force.
    """
    q, qd, _ = described_log.log.motion
    rest = np.zeros_like(qd)
    samples = described_log.samples_of_bodies(Motion(q, rest, rest))
    gravity_columns = described_log.log.rows_of(samples)
    body_count = gravity_columns.shape[2]
    body_columns = described_log.rows.columns[:, :, :body_count]
    other_columns = body_columns - gravity_columns
    forces = described_log.rows.forces
    force_sizes = np.sqrt(np.mean(forces**2, axis=0) + 1e-300)

    def relative_forces(columns: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        rows = columns @ parameters
        return (rows - rows.mean(axis=0)) / force_sizes

    file_bodies = bodies.ravel()
    fit_bodies = fit.parameters[:body_count]
    file_gravity = relative_forces(gravity_columns, file_bodies)
    fit_gravity = relative_forces(gravity_columns, fit_bodies)
    file_inertia = relative_forces(other_columns, file_bodies)
    fit_inertia = relative_forces(other_columns, fit_bodies)
    inertia_norm = max(float(np.linalg.norm(file_inertia)), 1e-300)
    gravity_square = max(float(np.sum(file_gravity**2)), 1e-300)
    square_difference = float(np.sum((file_gravity - fit_gravity) ** 2))
    return GravityWitness(
        difference=np.sqrt(square_difference / gravity_square),
        multiple=float(np.sum(file_gravity * fit_gravity)) / gravity_square,
        share=np.sqrt(gravity_square / file_gravity.size),
        inertia=float(np.linalg.norm(fit_inertia)) / inertia_norm,
    )
