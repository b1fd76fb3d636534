"""Mass, centre of mass and inertia tensor of a body, in several parametrisations."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Matrix3,
    Numbers,
    Vector,
    Vector3,
    as_array,
    as_finite_array,
    given,
    is_traced,
    namespace,
)
from jaxid.errors import InputError

from .limits_and_drives import DOUBTFUL_LENGTH
from .rotations import Rotations, Vectors

AXES = "xyz"
INERTIAL_NAMES = ("m", *(f"m{a}" for a in AXES), *"ABCDEF")
"""Inertial parameters of a body in the paper's order (Eq. 9)."""
INERTIAL_UNITS = ("kg", *("kg m",) * 3, *("kg m²",) * 6)
TenParameters = Float[AnyArray, "*batch 10"]
"""Ten inertial parameters, with any leading axes."""
BodyParameters = Float[AnyArray, "joints 10"]
"""Ten inertial parameters of each body of a robot."""
SQUARES = ((0, 1, 2), (0, 1, 2))
"""Rows and columns of A, B and C in the inertia tensor (Eq. 9)."""
PRODUCTS = ((1, 0, 0), (2, 2, 1))
"""Rows and columns of D, E and F, whose signs are opposite."""
URDF_ORDER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of xx, xy, xz, yy, yz, zz."""
PINOCCHIO_ORDER = ((0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2))
"""Rows and columns of xx, xy, yy, xz, yz, zz."""
IMPOSSIBLE = "cannot belong to a real body"
"""Words of notes on bodies that cannot exist."""
MIN_THICKNESS = 1e-3
"""Smallest second moment of a corrected body, relative to the largest."""
MAX_MASS = 1e5
"""Largest mass of a body of a robot [kg]."""
MAX_DISTANCE = 20.0
"""Largest distance of a centre of mass from the frame of its body [m]."""
MAX_DENSITY = 25_000.0
"""Density above that of all materials [kg/m³]; osmium has 22,600."""


class Inertia(eqx.Module):
    r"""Mass, centre of mass and inertia tensor, with any leading axes.

    The same body in other parametrisations: `parameters` are the ten numbers of the
    paper, `pinocchio` those of Pinocchio, `moments` the six attributes of URDF's
    `<inertia>`.

    Attributes:
        mass: Mass [kg].
        centre: Centre of mass in the frame of the body [m].
        tensor: Inertia tensor about the centre of mass, along the axes of the frame [kg
            m²].
    """

    mass: AnyArray
    centre: Vectors
    tensor: Rotations

    def __init__(self, mass: Numbers, centre: Numbers, tensor: Numbers):
        self.mass = as_array("mass", mass)
        self.centre = as_array("centre", centre)
        self.tensor = as_array("tensor", tensor)

    @classmethod
    def from_parameters(cls, p: TenParameters) -> "Inertia":
        """Return the inertia of ten parameters, centred at 0 without mass (Eq. 9)."""
        xp = namespace(p)
        mass = p[..., :1]
        first_moments = p[..., 1:4]
        has_mass = mass != 0
        divisor = xp.where(has_mass, mass, 1.0)
        centre = xp.where(has_mass, first_moments / divisor, 0.0)
        point_masses = mass[..., None] * _moments_of_points(centre)
        tensor = inertia_tensor(p[..., 4:])
        return cls(mass[..., 0], centre, tensor - point_masses)

    @property
    def parameters(self) -> TenParameters:
        """Parameters $(m, m r_c, A, B, C, D, E, F)$ about the origin (Eqs. 8, 9)."""
        mass = self.mass[..., None]
        first_moments = mass * self.centre
        point_mass = mass[..., None] * _moments_of_points(self.centre)
        tensor = self.tensor + point_mass
        squares = tensor[..., *SQUARES]
        products = -tensor[..., *PRODUCTS]
        parts = [mass, first_moments, squares, products]
        return namespace(mass, tensor).concatenate(parts, axis=-1)

    @property
    def pinocchio(self) -> TenParameters:
        """Parameters $(m, m r_c, I_{xx}, I_{xy}, I_{yy}, I_{xz}, I_{yz}, I_{zz})$."""
        p = self.parameters
        tensor = inertia_tensor(p[..., 4:])
        moments = tensor[..., *PINOCCHIO_ORDER]
        return namespace(p).concatenate([p[..., :4], moments], axis=-1)

    @property
    def moments(self) -> AnyArray:
        """Entries xx, xy, xz, yy, yz, zz of the tensor, the order of URDF [kg m²]."""
        return self.tensor[..., *URDF_ORDER]

    def moved(self, rotation: Matrix3, position: Vector3) -> "Inertia":
        """Return the same body in the frame in which its present frame is placed."""
        R = rotation
        centre = position + self.centre @ R.T
        tensor = R @ self.tensor @ R.T
        return Inertia(self.mass, centre, tensor)

    def nearest_possible(self) -> "Inertia":
        """Return the nearest body of this mass and centre whose moments can exist.

        They can if mass is nowhere negative: no second moment of it is, which are the
        eigenvalues of half the trace less the tensor. A body that is flat up to
        rounding stays as it is.
        """
        tensor = np.asarray(self.tensor)
        second_moments = 0.5 * np.trace(tensor) * np.eye(3) - tensor
        values, axes = np.linalg.eigh(second_moments)
        largest_moment = max(values[-1], 0.0)
        if values[0] >= -1e-9 * largest_moment:
            return self
        possible_values = np.maximum(values, MIN_THICKNESS * largest_moment)
        possible_moments = axes * possible_values @ axes.T
        possible_tensor = possible_values.sum() * np.eye(3) - possible_moments
        return Inertia(self.mass, self.centre, possible_tensor)

    def fault(self, rounding: float = 1e-9) -> str:
        """Return why this single body cannot exist; an empty text if it can.

        Of a body that JAX traces nothing is known. An error of the moments is no fault
        up to a fraction `rounding` of the largest.
        """
        if is_traced(self):
            return ""
        mass = float(self.mass)
        centre = np.asarray(self.centre)
        tensor = np.asarray(self.tensor)
        if not all(np.isfinite(part).all() for part in (mass, centre, tensor)):
            return "`mass`, `centre_of_mass` or `inertia` is not finite"
        if not 0.0 <= mass <= MAX_MASS:
            return f"`mass` is {mass:g} kg, but must be from 0 to {MAX_MASS:g} kg"
        distance = np.abs(centre).max()
        if distance > MAX_DISTANCE:
            return f"`centre_of_mass` is {distance:g} m away: is it in millimetres?"
        moment = np.abs(tensor).max()
        if moment > DOUBTFUL_LENGTH**2 * max(mass, 1.0):
            return (
                f"`inertia` is {moment:g} kg m² "
                f"at a mass of {mass:g} kg: is it in kg mm²?"
            )
        if np.abs(tensor - tensor.T).max() > rounding * moment:
            return "`inertia` is not symmetric"
        low, middle, high = np.linalg.eigvalsh(tensor)
        # Files round away a millimetre's worth of a point mass.
        slack = rounding * max(abs(low), abs(high)) + 1e-4 * rounding * mass
        if low < -slack or high > low + middle + slack:
            return (
                f"the moments of inertia {IMPOSSIBLE}: `inertia` has the principal "
                f"moments {low:.3g}, {middle:.3g}, {high:.3g} kg m², of which one is "
                "negative, or larger than the sum of the others"
            )
        return ""


def ball_densities(bodies: BodyParameters) -> Vector:
    """Return the densities of balls with the bodies' masses and moments [kg/m³].

    No body of even density with the same mass and sum of moments is less dense.
    """
    inertia = Inertia.from_parameters(bodies)
    moments = np.trace(inertia.tensor, axis1=-2, axis2=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Half the sum of the moments is 3/5 m r².
        radii = np.sqrt(5.0 / 6.0 * np.abs(moments) / inertia.mass)
        return inertia.mass / (4.0 / 3.0 * np.pi * radii**3)


def inertia_tensor(j: AnyArray) -> Rotations:
    """Return the tensor $J^o$ of the moments $(A, B, C, D, E, F)$ [kg m²] (Eq. 9)."""
    A, B, C, D, E, F = (j[..., k] for k in range(6))
    xp = namespace(j)
    first_row = xp.stack([A, -F, -E], axis=-1)
    second_row = xp.stack([-F, B, -D], axis=-1)
    third_row = xp.stack([-E, -D, C], axis=-1)
    return xp.stack([first_row, second_row, third_row], axis=-2)


def _moments_of_points(r: Vectors):
    """Return the inertia tensors of unit masses at points, about the origin [m²]."""
    xp = namespace(r)
    squares = xp.sum(r * r, axis=-1)[..., None, None]
    products = r[..., :, None] * r[..., None, :]
    identity = np.broadcast_to(np.eye(3), products.shape)
    return squares * identity - products


class Tool(eqx.Module):
    """Load of known mass on a body: its forces are subtracted, not identified.

    Args:
        body: Index of the body that carries it (0 is the first).
        mass: Mass [kg].
        centre_of_mass: Centre of mass in the frame of the body [m].
        inertia: Inertia tensor about the centre of mass, along the body's axes [kg m²];
            a point mass if None.

    Raises:
        InputError: If the mass is not positive, or no body has such an inertia.
    """

    body: int = eqx.field(static=True)
    _: dataclasses.KW_ONLY
    mass: AnyArray = eqx.field(converter=given)
    centre_of_mass: Vector3 = eqx.field(converter=given)
    inertia: Matrix3 = eqx.field(converter=given, default=None)

    def __post_init__(self):
        self.mass = as_finite_array("`mass` of the tool", self.mass, ())
        self.centre_of_mass = as_finite_array(
            "`centre_of_mass` of the tool",
            self.centre_of_mass,
            (3,),
        )
        tensor = np.zeros((3, 3)) if self.inertia is None else self.inertia
        self.inertia = as_finite_array("`inertia` of the tool", tensor, (3, 3))
        if not is_traced(self.mass) and self.mass <= 0:
            raise InputError(
                f"`mass` of the tool must be positive, but is {self.mass:g} kg."
            )
        if reason := self.body_inertia.fault():
            raise InputError(f"the tool cannot exist: {reason}.")

    @property
    def body_inertia(self) -> Inertia:
        """Mass, centre of mass and tensor in the frame of the body."""
        return Inertia(self.mass, self.centre_of_mass, self.inertia)

    @property
    def parameters(self) -> AnyArray:
        """Parameters $(m, m r_c, A, B, C, D, E, F)$ about the origin (Eqs. 8, 9)."""
        return self.body_inertia.parameters
