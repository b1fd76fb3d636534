"""What a physically consistent estimate has cost, and where bounds have decided."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.interior_point import Outcome


class Consistency(eqx.Module):
    """How a physically consistent estimate came about.

    Attributes:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ of all bodies.
        shares: How far each body is from the boundary of what can exist, of 1.
        bounds: What the bodies had to stay within.
        price: By how much the norm of the weighted residuals exceeds that without bounds, of 1.
        error_bound: Bound of the objective's distance to the optimum, as a share of it.
        outcome: How the search ended.
        iterations: How many it took.
        decided: Which standard parameters the data determine alone: the others also reflect bounds.
        active: Bounds that hold parameters where they are, in words.
    """

    bodies: Float[AnyArray, "bodies 10"]
    shares: Float[AnyArray, " bodies"]
    bounds: BodyBounds
    price: float
    error_bound: float
    outcome: Outcome = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    decided: Bool[np.ndarray, " standard"]
    active: tuple[str, ...] = eqx.field(static=True)

    @property
    def masses_from_bounds(self) -> tuple[int, ...]:
        """Bodies (0 is the first) whose masses reflect bounds or priors rather than data."""
        width = self.bodies.shape[1]
        return tuple(k for k in range(len(self.bodies)) if not self.decided[k * width])

    @property
    def tabulated(self) -> tuple[str, ...]:
        """Price, and where bounds have decided, in sentences: the report's table says it too."""
        said = [f"the weighted residuals are {100 * self.price:.2g} % larger than without bounds."]
        loose = self.masses_from_bounds
        if loose:
            names = ", ".join(f"m{k + 1}" for k in loose)
            said.append(
                f"forces do not determine the masses {names} alone: their values, and what goes "
                "with them, reflect the bounds; base parameters and forces do not depend on that."
            )
        if self.active:
            said.append(f"bounds that decide: {'; '.join(self.active)}.")
        return tuple(said)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know, in sentences."""
        said = [
            f"physically consistent: {self.bounds.sentence}.",
            *self.tabulated,
            "standard deviations are those of the estimate without bounds: where bounds decide, "
            "estimates scatter less.",
        ]
        if self.outcome is not Outcome.CERTIFIED:
            said.append(self.outcome.value)
        return tuple(said)
