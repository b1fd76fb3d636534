"""Inertia of a body: mass, centre of mass and inertia tensor, and their other parametrisations."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array, is_traced, namespace
from jaxid.errors import InputError
from jaxid.robot.plausibility import FAR, FARTHEST, HEAVIEST

AXES = "xyz"
INERTIAL_NAMES = ("m", *(f"m{a}" for a in AXES), *"ABCDEF")
"""Inertial parameters of a body in the paper's order (Eq. 9)."""
INERTIAL_UNITS = ("kg", *("kg m",) * 3, *("kg m²",) * 6)

_PINOCCHIO = (0, 1, 2, 3, 4, 9, 5, 8, 7, 6)
"""Places of Pinocchio's (m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) in the paper's order."""
_SIGNS = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0])


class Inertia(eqx.Module):
    r"""Mass, centre of mass and inertia tensor of a body, or of many along leading axes.

    The same body in other parametrisations: `parameters` are the ten numbers of the paper,
    `pinocchio` those of Pinocchio, `moments` the six attributes of URDF's `<inertia>`,
    `pseudo_inertia` the matrix that is positive semidefinite if and only if the body can exist.
    Classmethods named `from_…` convert back.

    Attributes:
        mass: Mass [kg].
        centre: Centre of mass in the frame of the body [m].
        tensor: Inertia tensor about the centre of mass, along the axes of the frame [kg m²].
    """

    mass: Float[AnyArray, "*batch"]
    centre: Float[AnyArray, "*batch 3"]
    tensor: Float[AnyArray, "*batch 3 3"]

    def __init__(self, mass: Numbers, centre: Numbers, tensor: Numbers):
        self.mass = as_array("mass", mass)
        self.centre = as_array("centre", centre)
        self.tensor = as_array("tensor", tensor)

    @classmethod
    def from_parameters(cls, p: Float[AnyArray, "*batch 10"]) -> "Inertia":
        """Return the inertia of ten parameters (Eq. 9); its centre is zero where its mass is.

        Args:
            p: Parameters $(m, m r_c, A, B, C, D, E, F)$ about the origin of the frame.
        """
        m, h = p[..., 0], p[..., 1:4]
        xp = namespace(p)
        r = xp.where((m != 0)[..., None], h / xp.where(m != 0, m, 1.0)[..., None], 0.0)
        J = inertia_tensor(p[..., 4:])
        return cls(m, r, J - m[..., None, None] * _moments_of_points(r))

    @classmethod
    def from_pinocchio(cls, p: Float[AnyArray, "*batch 10"]) -> "Inertia":
        """Return the inertia of Pinocchio's ten dynamic parameters."""
        return cls.from_parameters((p * _signs(p))[..., np.argsort(_PINOCCHIO)])

    @classmethod
    def from_pseudo_inertia(cls, pseudo: Float[AnyArray, "*batch 4 4"]) -> "Inertia":
        """Return the inertia of a pseudo-inertia about the origin of the frame."""
        xp = namespace(pseudo)
        S = pseudo[..., :3, :3]
        J = xp.trace(S, axis1=-2, axis2=-1)[..., None, None] * _eye(S) - S
        m, h = pseudo[..., 3, 3], pseudo[..., :3, 3]
        return cls.from_parameters(xp.concatenate([m[..., None], h, _moments(J)], axis=-1))

    @classmethod
    def from_log_cholesky(cls, x: Float[AnyArray, "*batch 10"]) -> "Inertia":
        r"""Return the inertia of log-Cholesky coordinates: every vector is a body that can exist.

        Args:
            x: Coordinates $(\alpha, d_1, d_2, d_3, s_{12}, s_{23}, s_{13}, t_1, t_2, t_3)$ of the
                pseudo-inertia $e^{2 \alpha} U U^T$ with the upper triangular matrix $U$ of
                diagonal $(e^{d_1}, e^{d_2}, e^{d_3}, 1)$ (Rucker and Wensing, 2022).
        """
        xp = namespace(x)
        scale = xp.exp(x[..., 0])
        d = xp.exp(x[..., 1:4]) * scale[..., None]
        s, t = x[..., 4:7] * scale[..., None], x[..., 7:] * scale[..., None]
        zero = xp.zeros_like(scale)
        rows = [
            [d[..., 0], s[..., 0], s[..., 2], t[..., 0]],
            [zero, d[..., 1], s[..., 1], t[..., 1]],
            [zero, zero, d[..., 2], t[..., 2]],
            [zero, zero, zero, scale],
        ]
        U = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
        return cls.from_pseudo_inertia(U @ xp.swapaxes(U, -1, -2))

    @property
    def about_origin(self) -> Float[AnyArray, "*batch 3 3"]:
        """Inertia tensor about the origin of the frame [kg m²]."""
        return self.tensor + self.mass[..., None, None] * _moments_of_points(self.centre)

    @property
    def parameters(self) -> Float[AnyArray, "*batch 10"]:
        """Ten parameters $(m, m r_c, A, B, C, D, E, F)$ about the frame's origin (Eqs. 8, 9)."""
        J, m = self.about_origin, self.mass[..., None]
        parts = [m, m * self.centre, _moments(J)]
        return namespace(self.mass, self.centre, self.tensor).concatenate(parts, axis=-1)

    @property
    def pinocchio(self) -> Float[AnyArray, "*batch 10"]:
        """Dynamic parameters $(m, m r_c, I_{xx}, I_{xy}, I_{yy}, I_{xz}, I_{yz}, I_{zz})$."""
        p = self.parameters[..., np.array(_PINOCCHIO)]
        return p * _signs(p)

    @property
    def moments(self) -> Float[AnyArray, "*batch 6"]:
        """Entries xx, xy, xz, yy, yz, zz of the tensor, the order of URDF [kg m²]."""
        return self.tensor[..., (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]

    @property
    def pseudo_inertia(self) -> Float[AnyArray, "*batch 4 4"]:
        r"""The matrix $\int (r; 1)(r; 1)^T \rho\, dV$ about the frame's origin."""
        xp = namespace(self.mass, self.centre, self.tensor)
        J, h = self.about_origin, (self.mass[..., None] * self.centre)[..., None]
        trace = xp.trace(J, axis1=-2, axis2=-1)[..., None, None]
        upper = xp.concatenate([0.5 * trace * _eye(J) - J, h], axis=-1)
        m = self.mass[..., None, None]
        lower = xp.concatenate([xp.swapaxes(h, -1, -2), m], axis=-1)
        return xp.concatenate([upper, lower], axis=-2)

    @property
    def log_cholesky(self) -> Float[AnyArray, "*batch 10"]:
        """Log-Cholesky coordinates; not finite where the body cannot exist."""
        xp = namespace(self.mass, self.centre, self.tensor)
        reverse = np.arange(3, -1, -1)
        turned = self.pseudo_inertia[..., reverse[:, None], reverse]
        U = xp.linalg.cholesky(turned)[..., reverse[:, None], reverse]
        scale = U[..., 3, 3][..., None]
        U = U / scale[..., None]
        diagonal = xp.log(U[..., (0, 1, 2), (0, 1, 2)])
        beside = U[..., (0, 1, 0, 0, 1, 2), (1, 2, 2, 3, 3, 3)]
        return xp.concatenate([xp.log(scale), diagonal, beside], axis=-1)

    def moved(self, rotation: Float[AnyArray, "3 3"], position: Float[AnyArray, "3"]) -> "Inertia":
        """Return the same body in the frame in which its present frame is placed.

        Args:
            rotation: Attitude of the present frame in the other.
            position: Origin of the present frame in the other [m].
        """
        R = rotation
        return Inertia(self.mass, position + self.centre @ R.T, R @ self.tensor @ R.T)

    def fault(self, rounding: float = 1e-9) -> str:
        """Return why this single body cannot exist; an empty text if it can, or if JAX traces it.

        Args:
            rounding: Error of the moments, as a fraction of the largest, that is not a fault.
        """
        if is_traced(self):
            return ""
        m, r, J = float(self.mass), np.asarray(self.centre), np.asarray(self.tensor)
        if not (np.isfinite(m) and np.isfinite(r).all() and np.isfinite(J).all()):
            return "its `mass`, `centre_of_mass` or `inertia` is not finite"
        if not 0.0 <= m <= HEAVIEST:
            return f"its `mass` is {m:g} kg, but must be from 0 to {HEAVIEST:g} kg"
        if np.abs(r).max() > FARTHEST:
            return f"its `centre_of_mass` is {np.abs(r).max():g} m away: is it in millimetres?"
        largest = np.abs(J).max()
        if largest > FAR**2 * max(m, 1.0):
            return f"its `inertia` is {largest:g} kg m² at a mass of {m:g} kg: is it in kg mm²?"
        if np.abs(J - J.T).max() > rounding * largest:
            return "its `inertia` is not symmetric"
        low, middle, high = np.linalg.eigvalsh(J)
        # A millimetre's worth of a point mass is what files round away.
        slack = rounding * max(abs(low), abs(high)) + 1e-4 * rounding * m
        if low < -slack or high > low + middle + slack:
            return (
                f"its `inertia` has the principal moments {low:.3g}, {middle:.3g}, {high:.3g} "
                "kg m², but none may be negative or larger than the sum of the others: is it about "
                "the centre of mass?"
            )
        return ""

    def check(self, owner: str) -> None:
        """Reject a single body that cannot exist.

        Args:
            owner: Name of the body as the subject of a sentence, such as "the tool".

        Raises:
            InputError: If no body has this inertia.
        """
        if reason := self.fault():
            raise InputError(f"{owner} cannot exist: {reason}.")


def inertia_tensor(j: Float[AnyArray, "*batch 6"]) -> Float[AnyArray, "*batch 3 3"]:
    """Return the tensor $J^o$ of the moments $(A, B, C, D, E, F)$ [kg m²] (Eq. 9)."""
    A, B, C, D, E, F = (j[..., k] for k in range(6))
    xp = namespace(j)
    rows = ([A, -F, -E], [-F, B, -D], [-E, -D, C])
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def _moments(J: Float[AnyArray, "*batch 3 3"]) -> Float[AnyArray, "*batch 6"]:
    entries = [(0, 0, 1), (1, 1, 1), (2, 2, 1), (1, 2, -1), (0, 2, -1), (0, 1, -1)]
    return namespace(J).stack([sign * J[..., i, k] for i, k, sign in entries], axis=-1)


def _moments_of_points(r: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch 3 3"]:
    """Return the inertia tensors of unit masses at points, about the origin [m²]."""
    xp = namespace(r)
    squares = xp.sum(r * r, axis=-1)[..., None, None]
    products = r[..., :, None] * r[..., None, :]
    return squares * _eye(products) - products


def _signs(like: AnyArray) -> np.ndarray:
    return np.broadcast_to(_SIGNS, like.shape)


def _eye(like: AnyArray) -> np.ndarray:
    return np.broadcast_to(np.eye(3), like.shape)
