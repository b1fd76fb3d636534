"""Prior knowledge about bodies: bounds of masses and sizes, a CAD model, a data sheet."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, Numbers, given, optional
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

from .pseudo_inertia import consistency_margin


class BodyBounds(eqx.Module):
    """Bounds of masses, sizes and centres of mass; without them the best masses are infinite.

    Attributes:
        mass_max: Largest mass of each body [kg], like `50.0`.
        radius: Radius of the sphere about the origin of each body's frame that holds it
            [m], like `0.6`.
        mass_min: Smallest mass of each body [kg], like `0.5`.
        centre_min: Lower corners of boxes for the centres of mass [m], like `[-0.2,
            -0.2, 0.0]`; -inf for none.
        centre_max: Upper corners [m], like `[0.2, 0.2, 0.5]`; inf for none.
        ellipsoid_centre: Centres of ellipsoids that hold the centres of mass [m], like
            `[0.0, 0.0, 0.2]`.
        ellipsoid_axes: Their half axes, along the axes of the body's frame [m], like
            `[0.2, 0.2, 0.4]`; inf for none.
        total_mass: Mass of all bodies together [kg], like `120.0`; None if unknown.
    """

    mass_max: Float[np.ndarray, " bodies"] = eqx.field(converter=given)
    radius: Float[np.ndarray, " bodies"] = eqx.field(converter=given)
    mass_min: Float[np.ndarray, " bodies"] = eqx.field(converter=given, default=0.0)
    centre_min: Float[np.ndarray, "bodies 3"] = eqx.field(
        converter=given, default=-np.inf
    )
    centre_max: Float[np.ndarray, "bodies 3"] = eqx.field(
        converter=given, default=np.inf
    )
    ellipsoid_centre: Float[np.ndarray, "bodies 3"] = eqx.field(
        converter=given, default=0.0
    )
    ellipsoid_axes: Float[np.ndarray, "bodies 3"] = eqx.field(
        converter=given, default=np.inf
    )
    total_mass: float | None = eqx.field(converter=optional, default=None)

    def __post_init__(self):
        bodies = max(np.size(self.mass_max), np.size(self.radius))
        for name in ("mass_max", "radius", "mass_min"):
            setattr(self, name, _of_each(name, getattr(self, name), bodies))
        for name in ("centre_min", "centre_max", "ellipsoid_centre", "ellipsoid_axes"):
            setattr(self, name, _of_each(name, getattr(self, name), bodies, 3))
        low, high, radius = self.mass_min, self.mass_max, self.radius
        rules = (
            ("mass_max", "positive and finite", (high > 0) & np.isfinite(high)),
            ("radius", "positive and finite", (radius > 0) & np.isfinite(radius)),
            ("ellipsoid_axes", "positive", self.ellipsoid_axes > 0),
            ("mass_min", "at least 0 and below `mass_max`", (low >= 0) & (low < high)),
            ("centre_min", "below `centre_max`", self.centre_min < self.centre_max),
        )
        for name, rule, good in rules:
            if not good.all():
                k = np.argwhere(~good)[0, 0]
                value = getattr(self, name)[k]
                raise InputError(
                    f"`{name}` must be {rule}, but body {k + 1} has {value}."
                )
        total = self.total_mass
        if total is not None and not low.sum() < total < high.sum():
            span = f"{low.sum():g} to {high.sum():g} kg"
            raise InputError(f"`total_mass` must be from {span}, but is {total:g} kg.")
        _ = self.inner_centres

    @classmethod
    def from_geometry(cls, robot: Robot) -> "BodyBounds":
        """Return wide bounds for a robot of which only the geometry is known.

        A body extends beyond its neighbouring joints by at most a quarter of the
        robot's reach, and weighs at most 100 kg times the square of the reach in
        metres.

        Args:
            robot: Robot whose bodies are bounded.
        """
        offset = np.linalg.norm(np.asarray(robot.offset), axis=1)
        tip = float(np.linalg.norm(np.asarray(robot.tip_offset)))
        chains = [offset[list(chain)].sum() for chain in robot.ancestors]
        chains[robot.tip_body] += tip
        reach = float(max(chains)) or 1.0
        farthest = offset.copy()
        farthest[robot.tip_body] = max(farthest[robot.tip_body], tip)
        for body, parent in enumerate(robot.parent):
            if parent >= 0:
                farthest[parent] = max(farthest[parent], offset[body])
        return cls(100.0 * reach**2, farthest + 0.25 * reach)

    def replace(self, **fields: Any) -> "BodyBounds":
        """Return a copy with some bounds replaced; scalars count for all bodies.

        Raises:
            InputError: If shapes do not fit, or no body satisfies all bounds.
        """
        return dataclasses.replace(self, **fields)

    def __str__(self):
        def span(values: AnyArray) -> str:
            low, high = float(np.min(values)), float(np.max(values))
            return f"{high:.3g}" if low == high else f"{low:.3g} to {high:.3g}"

        boxes = np.isfinite(self.centre_min) | np.isfinite(self.centre_max)
        parts = [
            f"masses up to {span(self.mass_max)} kg",
            f"bodies within {span(self.radius)} m of the origins of their frames",
            f"masses from {span(self.mass_min)} kg" if np.any(self.mass_min) else "",
            "centres of mass in boxes" if boxes.any() else "",
            "centres of mass in ellipsoids" if self.has_ellipsoid.any() else "",
            "" if self.total_mass is None else f"{self.total_mass:.4g} kg together",
        ]
        return ", ".join(filter(None, parts))

    @property
    def has_ellipsoid(self) -> Bool[np.ndarray, " bodies"]:
        """Whether bodies have an ellipsoid for their centre of mass."""
        return np.asarray(np.isfinite(self.ellipsoid_axes).all(axis=1))

    @property
    def inner_centres(self) -> Float[np.ndarray, "bodies 3"]:
        """Centres of mass well inside all bounds [m].

        Raises:
            InputError: If there are none for some body.
        """
        radius, known = self.radius[:, None], self.has_ellipsoid[:, None]
        low = np.maximum(self.centre_min, -radius)
        high = np.minimum(self.centre_max, radius)
        middle = np.where(known, self.ellipsoid_centre, 0.0)
        axes = np.where(known, self.ellipsoid_axes, radius)
        regions = (middle, axes), (0.0, radius)
        point, edge = 0.5 * (low + high), 0.1 * (high - low)
        # Alternating projections onto the ellipsoid, the sphere and the box, each a
        # little smaller.
        for _ in range(200):
            for middle, axes in regions:
                away = point - middle
                size = np.linalg.norm(away / axes, axis=1, keepdims=True) / 0.9
                point = middle + away / np.maximum(size, 1.0)
            point = np.clip(point, low + edge, high - edge)
        inside = ((low < point) & (point < high)).all(axis=1)
        for middle, axes in regions:
            inside &= np.linalg.norm((point - middle) / axes, axis=1) < 0.99
        if not inside.all():
            k = int(np.argmin(inside))
            raise InputError(
                f"no centre of mass of body {k + 1} fits its bounds: widen them."
            )
        return point


def _of_each(name: str, value: Numbers, bodies: int, *shape: int) -> np.ndarray:
    """Return numbers of each body, given for each or for all."""
    array = np.array(value, np.float64)
    if np.isnan(array).any() or array.shape not in ((), shape, (bodies, *shape)):
        raise InputError(
            f"`{name}` must be for all or each of {bodies} bodies: {value}."
        )
    return np.broadcast_to(array, (bodies, *shape)).copy()


class EntropicPull(eqx.Module):
    r"""Pull of the bodies towards those of a prior, along directions that the data do not see.

    It adds $\gamma \sum_k \left( \mathrm{tr}(\Pi_{0k}^{-1} \Pi_k) - \ln \det \Pi_k
    \right)$ to half the squared residuals in units of the noise: the Bregman divergence
    of pseudo-inertias, which does not depend on frames or units, and which keeps bodies
    away from the boundary of physical consistency.

    Attributes:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ of the prior's bodies; None
            for balls of medium size.
        strength: Factor $\gamma$: 1 is weak, and already gives the mass matrix a
            margin.
    """

    bodies: Float[AnyArray, "bodies 10"] | None = None
    strength: float = 1.0

    def __check_init__(self):
        if not 0.0 < self.strength < np.inf:
            raise InputError(f"`strength` must be positive, but is {self.strength}.")
        if (
            self.bodies is not None
            and not (consistency_margin(self.bodies) > 0.0).all()
        ):
            k = int(np.argmin(consistency_margin(self.bodies))) + 1
            raise InputError(
                f"body {k} of the prior's `bodies` needs a mass and an inertia."
            )


class ParameterPrior(eqx.Module):
    r"""Standard parameters that are known roughly, each with its own standard deviation (a ridge).

    It adds $\frac12 \sum_i (p_i - p_{0i})^2 / \sigma_i^2$ to half the squares in units
    of noise.

    Attributes:
        parameters: Standard parameters.
        deviations: Their standard deviations; infinite where nothing is known.
    """

    parameters: Float[AnyArray, " standard"]
    deviations: Float[AnyArray, " standard"]

    def __check_init__(self):
        deviations = np.asarray(self.deviations)
        if (
            np.shape(self.parameters) != deviations.shape
            or not (deviations > 0.0).all()
        ):
            raise InputError(
                "`deviations` must be positive and as many as `parameters`."
            )
