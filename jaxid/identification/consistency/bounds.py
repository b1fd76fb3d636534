"""What every body of a robot stays within: masses, and how far matter reaches."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.errors import InputError
from jaxid.robot.limits import Numbers
from jaxid.robot.robot import Robot

MASS_OF_A_METRE = 100.0
"""Largest mass of a body of a robot that reaches one metre [kg]; it grows with the square."""
MARGIN = 0.25
"""How far matter reaches beyond the neighbouring joints, as a share of the robot's reach."""


class BodyBounds(eqx.Module):
    """Bounds of the bodies, without which the best bodies would be infinitely heavy.

    Attributes:
        mass_min: Smallest mass of each body [kg].
        mass_max: Largest mass of each body [kg].
        radius: Radius of the sphere about the origin of each body's frame that holds it [m].
        centre_min: Lower corners of boxes for the centres of mass [m]; -inf for none.
        centre_max: Upper corners [m]; inf for none.
        ellipsoid_centre: Centres of ellipsoids that hold the centres of mass [m].
        ellipsoid_axes: Their half axes, along the axes of the body's frame [m]; inf for none.
        total_mass: Mass of all bodies together [kg], or None.
    """

    mass_min: Float[AnyArray, " bodies"]
    mass_max: Float[AnyArray, " bodies"]
    radius: Float[AnyArray, " bodies"]
    centre_min: Float[AnyArray, "bodies 3"]
    centre_max: Float[AnyArray, "bodies 3"]
    ellipsoid_centre: Float[AnyArray, "bodies 3"]
    ellipsoid_axes: Float[AnyArray, "bodies 3"]
    total_mass: float | None = None

    @classmethod
    def of(
        cls,
        bodies: int,
        *,
        mass_max: Numbers,
        radius: Numbers,
        mass_min: Numbers | None = None,
        centre_min: Numbers | None = None,
        centre_max: Numbers | None = None,
        ellipsoid_centre: Numbers | None = None,
        ellipsoid_axes: Numbers | None = None,
        total_mass: float | int | None = None,
    ) -> "BodyBounds":
        """Builds bounds and checks them: one number for all bodies, or one for each.

        Args:
            bodies: Number of bodies.
            mass_max: Largest masses [kg].
            radius: Radii of the spheres about the origins of the bodies' frames [m].
            mass_min: Smallest masses [kg]; 0 if None.
            centre_min: Lower corners of boxes for the centres of mass [m]; None for no box.
            centre_max: Upper corners [m].
            ellipsoid_centre: Centres of ellipsoids for the centres of mass [m]; origins if None.
            ellipsoid_axes: Half axes of the ellipsoids [m]; None for no ellipsoids.
            total_mass: Mass of all bodies together [kg], if it is known.

        Raises:
            InputError: If shapes do not fit, or no body could satisfy all bounds.
        """

        def each(name: str, value: Numbers | None, unknown: float, *shape: int) -> np.ndarray:
            array = np.array(unknown if value is None else value, np.float64)
            if np.isnan(array).any() or (
                array.shape and array.shape not in (shape, (bodies, *shape))
            ):
                raise InputError(
                    f"`{name}` must hold numbers for all bodies or for each of the {bodies}, but "
                    f"has shape {array.shape}."
                )
            return np.broadcast_to(array, (bodies, *shape)).copy()

        bounds = cls(
            mass_min=each("mass_min", mass_min, 0.0),
            mass_max=each("mass_max", mass_max, np.inf),
            radius=each("radius", radius, np.inf),
            centre_min=each("centre_min", centre_min, -np.inf, 3),
            centre_max=each("centre_max", centre_max, np.inf, 3),
            ellipsoid_centre=each("ellipsoid_centre", ellipsoid_centre, 0.0, 3),
            ellipsoid_axes=each("ellipsoid_axes", ellipsoid_axes, np.inf, 3),
            total_mass=None if total_mass is None else float(total_mass),
        )
        bounds._check()
        return bounds

    @classmethod
    def from_geometry(cls, robot: Robot) -> "BodyBounds":
        """Wide bounds from a robot's geometry, for a robot of which nothing else is known.

        A body reaches a quarter of the robot's reach beyond its neighbouring joints, and weighs at
        most 100 kg times the square of the reach in metres.

        Args:
            robot: Whose bodies they are.
        """
        reach, neighbours = _reach(robot)
        return cls.of(
            robot.joints, mass_max=MASS_OF_A_METRE * reach**2, radius=neighbours + MARGIN * reach
        )

    def replace(self, **fields: Numbers | float | None) -> "BodyBounds":
        """A copy with some bounds replaced, as `of` takes them.

        Raises:
            InputError: If shapes do not fit, or no body could satisfy all bounds.
        """
        return type(self).of(len(self.radius), **{**vars(self), **fields})

    @property
    def sentence(self) -> str:
        """What was assumed, in one sentence."""

        def span(values: AnyArray) -> str:
            low, high = float(np.min(values)), float(np.max(values))
            return f"{high:.3g}" if low == high else f"{low:.3g} to {high:.3g}"

        said = (
            f"masses up to {span(self.mass_max)} kg, bodies within {span(self.radius)} m of the "
            "origins of their frames"
        )
        if np.any(self.mass_min):
            said += f", masses from {span(self.mass_min)} kg"
        if np.isfinite(self.centre_min).any() or np.isfinite(self.centre_max).any():
            said += ", centres of mass in boxes"
        if np.isfinite(self.ellipsoid_axes).any():
            said += ", centres of mass in ellipsoids"
        if self.total_mass is not None:
            said += f", {self.total_mass:.4g} kg together"
        return said

    @property
    def has_ellipsoid(self) -> Bool[np.ndarray, " bodies"]:
        """Which bodies have an ellipsoid for their centre of mass."""
        return np.asarray(np.isfinite(np.asarray(self.ellipsoid_axes)).all(axis=1))

    @property
    def interior(self) -> Float[np.ndarray, "bodies 3"]:
        """Centres of mass that satisfy all bounds, and not barely [m].

        Raises:
            InputError: If there are none for some body.
        """
        radius = np.asarray(self.radius)[:, None]
        low = np.maximum(self.centre_min, -radius)
        high = np.minimum(self.centre_max, radius)
        axes = np.where(self.has_ellipsoid[:, None], self.ellipsoid_axes, radius)
        centre = np.where(self.has_ellipsoid[:, None], self.ellipsoid_centre, 0.0)
        point = 0.5 * (low + high)
        # Alternating between the box and the two ellipsoids, both drawn together a little.
        inner_low, inner_high = low + 0.1 * (high - low), high - 0.1 * (high - low)
        for _ in range(200):
            away = point - centre
            point = (
                centre + away / np.maximum(np.linalg.norm(away / axes, axis=1) / 0.9, 1.0)[:, None]
            )
            point = point / np.maximum(np.linalg.norm(point / radius, axis=1) / 0.9, 1.0)[:, None]
            point = np.clip(point, inner_low, inner_high)
        inside = (
            (np.linalg.norm((point - centre) / axes, axis=1) < 0.99)
            & (np.linalg.norm(point / radius, axis=1) < 0.99)
            & (low < point).all(axis=1)
            & (point < high).all(axis=1)
        )
        if not inside.all():
            k = int(np.flatnonzero(~inside)[0]) + 1
            raise InputError(
                f"no centre of mass of body {k} lies well within its box, its ellipsoid and its "
                f"sphere of {float(self.radius[k - 1]):.3g} m: widen one of them."
            )
        return point

    def _check(self) -> None:
        n = len(self.radius)
        for name in ("mass_max", "radius", "ellipsoid_axes"):
            values = np.asarray(getattr(self, name)).reshape(n, -1)
            good = (values > 0) & ((name == "ellipsoid_axes") | np.isfinite(values))
            if not good.all():
                k, which = np.argwhere(~good)[0]
                rule = "positive" if name == "ellipsoid_axes" else "positive and finite"
                raise InputError(
                    f"`{name}` must be {rule}, but body {k + 1} has {values[k, which]:g}."
                )
        low, high = np.asarray(self.mass_min), np.asarray(self.mass_max)
        if not ((low >= 0) & (low < high)).all():
            k = int(np.flatnonzero(~((low >= 0) & (low < high)))[0])
            raise InputError(
                f"`mass_min` must lie between 0 and `mass_max`, but body {k + 1} has {low[k]:g} "
                f"and {high[k]:g} kg."
            )
        if not (np.asarray(self.centre_min) < np.asarray(self.centre_max)).all():
            raise InputError("`centre_min` must be below `centre_max` for every body and axis.")
        total = self.total_mass
        if total is not None and not low.sum() < total < high.sum():
            raise InputError(
                f"`total_mass` must lie between the sums of the bodies' bounds, {low.sum():g} and "
                f"{high.sum():g} kg, but is {total:g} kg."
            )
        _ = self.interior


def _reach(robot: Robot) -> tuple[float, np.ndarray]:
    """Length of the longest chain [m], and the distance of each body to its farthest neighbour."""
    offset = np.linalg.norm(np.asarray(robot.offset), axis=1)
    tip = float(np.linalg.norm(np.asarray(robot.tip_offset)))
    chains = [offset[list(chain)].sum() for chain in robot.ancestors]
    chains[robot.tip_body] += tip
    neighbours = offset.copy()
    for body, parent in enumerate(robot.parent):
        if parent >= 0:
            neighbours[parent] = max(neighbours[parent], offset[body])
    neighbours[robot.tip_body] = max(neighbours[robot.tip_body], tip)
    reach = float(max(chains))
    return (reach if reach > 0 else 1.0), neighbours
