"""What is known of a robot before it moves: from CAD, from a data sheet, from an earlier fit."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import pseudo_inertia, share_of_a_body


class EntropicPull(eqx.Module):
    r"""Pulls bodies towards those of a prior, along what the data cannot see.

    It adds $\gamma \sum_k \left( \mathrm{tr}(\Pi_{0k}^{-1} \Pi_k) - \ln \det \Pi_k \right)$ to half
    the squares in units of the noise: the Bregman divergence of pseudo-inertias, which does not
    depend on frames or units, and which keeps bodies away from the boundary of what can exist.

    Attributes:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ of the prior's bodies; balls of middling
            size if None.
        strength: The $\gamma$: 1 is weak, and already gives the mass matrix a margin.
    """

    bodies: Float[AnyArray, "bodies 10"] | None = None
    strength: float = 1.0

    def __check_init__(self):
        if not 0.0 < self.strength < np.inf:
            raise InputError(f"`strength` must be positive, but is {self.strength}.")
        if self.bodies is not None and not (share_of_a_body(self.bodies) > 0.0).all():
            k = int(np.argmin(share_of_a_body(self.bodies))) + 1
            raise InputError(
                f"`bodies` of a prior must be bodies that could exist, with some extent in all "
                f"directions, but body {k} is not: give it a mass and an inertia."
            )

    def pseudo_inertias(
        self, nominal: Float[np.ndarray, "bodies 4 4"]
    ) -> Float[np.ndarray, "bodies 4 4"]:
        """Of the prior's bodies.

        Args:
            nominal: Of the bodies that are taken where none are given.

        Raises:
            InputError: If there is not one for each body.
        """
        if self.bodies is None:
            return nominal
        if len(self.bodies) != len(nominal):
            raise InputError(
                f"`bodies` of a prior must be one for each body of the robot ({len(nominal)}), but "
                f"are {len(self.bodies)}."
            )
        return pseudo_inertia(self.bodies)


class ParameterPrior(eqx.Module):
    r"""Standard parameters that are known roughly, each with its own standard deviation (a ridge).

    It adds $\frac12 \sum_i (p_i - p_{0i})^2 / \sigma_i^2$ to half the squares in units of noise.

    Attributes:
        parameters: The standard parameters.
        deviations: Their standard deviations; infinite where nothing is known.
    """

    parameters: Float[AnyArray, " standard"]
    deviations: Float[AnyArray, " standard"]

    def __check_init__(self):
        if np.shape(self.parameters) != np.shape(self.deviations):
            raise InputError(
                "`parameters` and `deviations` of a prior must be as many, but are "
                f"{np.shape(self.parameters)} and {np.shape(self.deviations)}."
            )
        if not (np.asarray(self.deviations) > 0.0).all():
            raise InputError("`deviations` of a prior must be positive.")

    def rows(self, size: int) -> tuple[Float[np.ndarray, "rows standard"], np.ndarray]:
        """Rows of least squares, in units of the standard deviations.

        Raises:
            InputError: If there is not one for each standard parameter.
        """
        if len(self.parameters) != size:
            raise InputError(
                f"`parameters` of a prior must be the {size} standard parameters of the model, but "
                f"are {len(self.parameters)}."
            )
        inverse = 1.0 / np.asarray(self.deviations, np.float64)
        known = inverse > 0.0
        return np.diag(inverse)[known], (inverse * np.asarray(self.parameters))[known]
