"""Prior knowledge about bodies: bounds of mass and size, or bodies of a CAD model."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, Vector, given, optional
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

from .pseudo_inertia import consistency_margin

OfBodies = Float[np.ndarray, " bodies"]
"""A number for each body."""

MASS_PER_SQUARED_REACH = 100.0
"""Largest mass of a body, relative to the square of the robot's reach [kg/m²]."""
OVERHANG = 0.25
"""How far bodies extend beyond their joints, relative to the robot's reach."""
WEAK_PULL = 1.0
"""Strength of a weak pull, which already gives the mass matrix a margin."""


class BodyBounds(eqx.Module):
    """Bounds of masses and sizes.

    Without them the best masses are infinite.

    Attributes:
        mass_max: Largest mass of each body [kg], like `50.0`.
        radius: Radius of the sphere about the origin of each body's frame that contains
            the body [m], like `0.6`.
        mass_min: Smallest mass of each body [kg], like `0.5`.
        total_mass: Mass of all bodies together [kg], like `120.0`; None if unknown.
    """

    mass_max: OfBodies = eqx.field(converter=given)
    radius: OfBodies = eqx.field(converter=given)
    mass_min: OfBodies = eqx.field(converter=given, default=0.0)
    total_mass: float | None = eqx.field(converter=optional, default=None)

    def __post_init__(self):
        bodies = max(np.size(self.mass_max), np.size(self.radius))
        for name in ("mass_max", "radius", "mass_min"):
            setattr(self, name, _of_each_body(name, getattr(self, name), bodies))
        mass_min = self.mass_min
        mass_max = self.mass_max
        radius = self.radius
        self._require(
            "mass_max", "positive and finite", (mass_max > 0) & (mass_max < np.inf)
        )
        self._require("radius", "positive and finite", (radius > 0) & (radius < np.inf))
        self._require(
            "mass_min",
            "at least 0 and below `mass_max`",
            (mass_min >= 0) & (mass_min < mass_max),
        )
        total = self.total_mass
        if total is not None and not mass_min.sum() < total < mass_max.sum():
            raise InputError(
                f"`total_mass` must be from {mass_min.sum():g} "
                f"to {mass_max.sum():g} kg, but is {total:g} kg."
            )

    def _require(self, name: str, rule: str, is_good: np.ndarray) -> None:
        """Check the rule of a field, and name the first body that breaks it."""
        if not is_good.all():
            body = np.argwhere(~is_good)[0, 0]
            raise InputError(
                f"`{name}` must be {rule}, but body "
                f"{body + 1} has {getattr(self, name)[body]}."
            )

    @classmethod
    def from_geometry(cls, robot: Robot) -> "BodyBounds":
        """Return wide bounds for a robot of which only the geometry is known.

        A body extends beyond its neighbouring joints by at most a quarter of the
        robot's reach, and weighs at most 100 kg times the square of the reach in
        metres.

        Args:
            robot: Robot whose bodies are bounded.
        """
        lengths = np.linalg.norm(robot.offset, axis=1)
        tip_length = float(np.linalg.norm(robot.tip_offset))
        chains = [lengths[list(chain)].sum() for chain in robot.ancestors]
        chains[robot.tip_body] += tip_length
        # A robot whose joints all lie in one point gets bounds of one metre.
        reach = float(max(chains)) or 1.0
        # Distance of each body's origin to the farthest of its neighbouring joints.
        extents = lengths.copy()
        extents[robot.tip_body] = max(extents[robot.tip_body], tip_length)
        for body, parent in enumerate(robot.parent):
            if parent >= 0:
                extents[parent] = max(extents[parent], lengths[body])
        return cls(
            mass_max=MASS_PER_SQUARED_REACH * reach**2,
            radius=extents[list(robot.solid_bodies)] + OVERHANG * reach,
        )

    def replace(self, **fields: Any) -> "BodyBounds":
        """Return a copy with some bounds replaced; scalars count for all bodies.

        Raises:
            InputError: If shapes do not fit, or bounds contradict each other.
        """
        return dataclasses.replace(self, **fields)

    def __str__(self):
        parts = [
            f"masses up to {_span(self.mass_max)} kg",
            f"bodies within {_span(self.radius)} m of the origins of their frames",
        ]
        if np.any(self.mass_min):
            parts.append(f"masses from {_span(self.mass_min)} kg")
        if self.total_mass is not None:
            parts.append(f"{self.total_mass:.4g} kg together")
        return ", ".join(parts)


def _span(values) -> str:
    """Return the range of some numbers in words."""
    minimum = f"{np.min(values):.3g}"
    maximum = f"{np.max(values):.3g}"
    return maximum if np.ptp(values) == 0 else f"{minimum} to {maximum}"


def _of_each_body(name: str, value: Numbers, bodies: int) -> Vector:
    """Return numbers of each body, from numbers for each or for all."""
    array = np.array(value, np.float64)
    if np.isnan(array).any() or array.shape not in ((), (bodies,)):
        raise InputError(
            f"`{name}` must be one for all bodies, or one for each of {bodies}, but is "
            f"{value}."
        )
    return np.broadcast_to(array, (bodies,)).copy()


class EntropicPull(eqx.Module):
    r"""Pull of the bodies towards a prior, along directions that the data do not see.

    It adds $\gamma \sum_k \left( \mathrm{tr}(\Pi_{0k}^{-1} \Pi_k) - \ln \det \Pi_k
    \right)$ to half the squared residuals in units of the noise: the Bregman divergence
    of pseudo-inertias, which does not depend on frames or units, and which keeps bodies
    away from the boundary of physical consistency.

    Attributes:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ of the prior's bodies; None
            for balls of medium size.
        strength: Factor $\gamma$; 1 is weak. The prior is then used as it is. None:
            `identify` bounds the pull, and chooses its strength by blocks of the logs;
            all else takes 1.
    """

    bodies: Float[AnyArray, "bodies 10"] | None = None
    strength: float | None = None

    def __check_init__(self):
        if self.strength is not None and not 0.0 < self.strength < np.inf:
            raise InputError(f"`strength` must be positive, but is {self.strength}.")
        if self.bodies is None:
            return
        margins = consistency_margin(self.bodies)
        if not (margins > 0.0).all():
            raise InputError(
                f"body {np.argmin(margins) + 1} of the prior's "
                "`bodies` needs a mass and an inertia."
            )
