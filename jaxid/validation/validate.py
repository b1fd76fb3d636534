"""Validation of an identified model on recordings that it has not seen (Eq. 37, Sec. 5)."""

from collections.abc import Sequence

import equinox as eqx

from jaxid.identification.fit import Fit
from jaxid.identification.streaming import Progress
from jaxid.measurement.observations import Observations
from jaxid.validation.definiteness import Definiteness, definiteness
from jaxid.validation.errors import TorqueErrors, torque_errors


class Validation(eqx.Module):
    """What a model is worth.

    Attributes:
        errors: Torque errors on each recording.
        definiteness: Of the mass matrix.
    """

    errors: tuple[TorqueErrors, ...]
    definiteness: Definiteness


def validate(
    fit: Fit,
    observations: Observations | Sequence[Observations],
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> Validation:
    """Checks a model: torque errors on recordings, and the definiteness of its mass matrix.

    Args:
        fit: The model.
        observations: One or several recordings, best some that the fit has not seen.
        seed: Of the poses in which the mass matrix is looked at.
        progress: Is told now and then which share of each long log is done, of 1.
    """
    single = isinstance(observations, Observations)
    recordings = (observations,) if single else tuple(observations)
    return Validation(
        tuple(torque_errors(fit, o, progress) for o in recordings), definiteness(fit, seed=seed)
    )
