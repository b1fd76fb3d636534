"""Gravity of a fit beside gravity of the file's bodies, which no residual compares."""

from typing import NamedTuple

import numpy as np

from .descriptions import DescribedLog
from .filtered_log import Motion
from .row_fits import RowFit


class WitnessLimits(NamedTuple):
    """Limits between files whose bodies are 30 % wrong and logs without gravity.

    Where gravity was at least 10 % of the forces of 140 simulated clean logs, the
    difference was at most 0.45 and the multiple 0.75 to 1.45. Without gravity the
    difference was 0.8 to 1.1 and the multiple at most 0.16, with reversed or turned
    gravity below 0.2. Set on five machines, shown on the other five.
    """

    difference: float = 0.6
    absent: float = 0.25  # multiple below which there is hardly any gravity
    share: float = 0.15  # share of the forces from which gravity tells something


LIMITS = WitnessLimits()
CAUSES = (
    "the drive or the log has subtracted it (gravity alone or a model's prediction), "
    "`robot.gravity` does not suit the mount, or a link, an axis or a zero of the "
    "angles is wrong"
)
"""Usual causes of another gravity."""


class GravityWitness(NamedTuple):
    """Gravity of a fit against that of the file's bodies, both without their means.

    Attributes:
        difference: RMS of the difference over RMS of the file's.
        multiple: Multiple of the file's that is nearest to that of the fit.
        share: RMS of the file's over RMS of the forces.
    """

    difference: float
    multiple: float
    share: float

    @property
    def is_different(self) -> bool:
        """Whether the gravity of the fit is not that of the file's bodies."""
        return self.share > LIMITS.share and self.difference > LIMITS.difference

    @property
    def is_absent(self) -> bool:
        """Whether the forces hardly contain the gravity of the file's bodies."""
        return self.is_different and self.multiple < LIMITS.absent

    @property
    def sentence(self) -> str:
        """Say how much differs, and the usual causes."""
        difference = f"{100 * self.difference:.2g} %"
        return (
            f"gravity of the file's bodies is not in the forces ({difference} of it "
            f"differ): {CAUSES}, or the file's bodies are wrong."
        )


def gravity_witness(
    described_log: DescribedLog, fit: RowFit, bodies: np.ndarray
) -> GravityWitness:
    """Compare gravity of a fit with that of a file's bodies [bodies, 10].

    Each joint counts by its RMS force.
    """
    q, qd, _ = described_log.log.motion
    rest = np.zeros_like(qd)
    samples = described_log.samples_of_bodies(Motion(q, rest, rest))
    columns = described_log.log.rows_of(samples)
    forces = described_log.rows.forces
    force_sizes = np.sqrt(np.mean(forces**2, axis=0) + 1e-300)

    def gravity(parameters: np.ndarray) -> np.ndarray:
        rows = columns @ parameters
        return (rows - rows.mean(axis=0)) / force_sizes

    file_gravity = gravity(bodies.ravel())
    fit_gravity = gravity(fit.parameters[: columns.shape[2]])
    square = max(float(np.sum(file_gravity**2)), 1e-300)
    square_difference = float(np.sum((file_gravity - fit_gravity) ** 2))
    return GravityWitness(
        difference=np.sqrt(square_difference / square),
        multiple=float(np.sum(file_gravity * fit_gravity)) / square,
        share=np.sqrt(square / file_gravity.size),
    )
