"""A payload's ten parameters from a run without it and a run with it."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.consistency import BodyBounds, consistency_margin, consistent_body
from jaxid.identification.fit import Fit
from jaxid.identification.runs.estimates import Estimates
from jaxid.identification.runs.least_squares import least_squares_of, require_same_base
from jaxid.identification.runs.states import own_parameters, state_maps
from jaxid.identification.runs.tied import tied
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.robot.robot import Robot, Tool
from jaxid.table import Remark, Status, Table

TEN = len(INERTIAL_NAMES)
LOOSE = 1e-2
"""Bound of the error of half a squared distance, relative to it, that is good enough."""
CENTRAL_NAMES = ("m", "x", "y", "z", "A_c", "B_c", "C_c", "D_c", "E_c", "F_c")
CENTRAL_UNITS = ("kg", "m", "m", "m", *("kg m²",) * 6)


class Payload(eqx.Module):
    """Mass, centre of mass and inertia of a load on a body.

    Attributes:
        body: Index of the body that carries it (0 is the first).
        parameters: $(m, m r_c, A, B, C, D, E, F)$ about the origin of the body's frame: the
            estimate, or the body nearest to it, in units of its uncertainty, that could exist.
        estimate: What the forces say, whether such a body could exist or not.
        covariance: Covariance of the estimate.
        freedom: Degrees of freedom of its standard deviations.
        distance: From the estimate to the parameters, in standard deviations: below 4 nothing
            unusual; NaN where the runs do not determine all ten.
    """

    body: int = eqx.field(static=True)
    parameters: Float[AnyArray, "10"]
    estimate: Float[AnyArray, "10"]
    covariance: Float[AnyArray, "10 10"]
    freedom: Float[AnyArray, "10"]
    distance: float

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.parameters[0])

    @property
    def centre_of_mass(self) -> Float[np.ndarray, "3"]:
        """In the frame of the body [m]."""
        return np.asarray(self.parameters)[1:4] / self.mass

    @property
    def inertia(self) -> Float[np.ndarray, "3 3"]:
        """Inertia tensor about the centre of mass, along the body's axes [kg m²]."""
        A, B, C, D, E, F = np.asarray(_central(jnp.asarray(self.parameters)))[4:]
        return np.array([[A, -F, -E], [-F, B, -D], [-E, -D, C]])

    def summary(self) -> Table:
        """Return a table of mass, centre of mass and moments about it, and of their consistency."""
        title = "payload in the frame of its body; moments about the centre of mass"
        return self.central.summary(title, [self._consistency()])

    def __str__(self) -> str:
        return str(self.summary())

    def _consistency(self) -> Remark:
        if not np.isfinite(self.distance):
            text = (
                "the logs do not determine all ten parameters of the payload: move the joints that "
                "carry it in more poses, faster, and alike in both runs."
            )
            return Remark(text, Status.BAD)
        if self.distance == 0:
            return Remark("the payload is a body that could exist.", Status.GOOD)
        text = (
            "the estimate itself belongs to no body: these are the parameters of the nearest one "
            f"that could exist, {self.distance:.2g} standard deviations away."
        )
        return Remark(text, Status.NEUTRAL if self.distance < 4.0 else Status.DOUBTFUL)

    @property
    def tool(self) -> Tool:
        """The payload as a known load: `robot.replace(tool=payload.tool)`.

        Raises:
            InputError: If it is no body that could exist.
        """
        return Tool(
            self.body, mass=self.mass, centre_of_mass=self.centre_of_mass, inertia=self.inertia
        )

    @property
    def estimates(self) -> Estimates:
        """The ten parameters about the body's origin, with the uncertainty of the estimate."""
        return self._named(INERTIAL_NAMES, INERTIAL_UNITS, self.parameters, self.covariance)

    @property
    def central(self) -> Estimates:
        """Mass, centre of mass, and moments of inertia about it, with their uncertainty."""
        p = jnp.asarray(self.parameters)
        J = np.asarray(jax.jacfwd(_central)(p))
        C = np.asarray(self.covariance)
        unknown = ~np.isfinite(np.diag(C))
        covariance = J @ np.where(np.isfinite(C), C, 0.0) @ J.T
        lost = np.any(J[:, unknown] != 0.0, axis=1)
        covariance[lost, lost] = np.inf
        return self._named(CENTRAL_NAMES, CENTRAL_UNITS, np.asarray(_central(p)), covariance)

    def _named(self, names, units, parameters, covariance) -> Estimates:
        return Estimates(
            label="payload",
            names=tuple(names),
            expressions=tuple(names),
            units=tuple(units),
            groups=("payload",) * TEN,
            parameters=parameters,
            covariance=covariance,
            freedom=np.full(TEN, float(np.min(self.freedom))),
        )


def identify_payload(
    unloaded: Fit,
    loaded: Fit,
    *,
    body: int | None = None,
    varying: Sequence[str] | None = None,
    bounds: BodyBounds | None = None,
) -> Payload:
    """Identifies a payload from a run without it and a run with it.

    Both runs are fitted together. What the payload adds to the base parameters depends on its ten
    parameters alone, and these are determined all ten although the last body's own are not: the
    robot without the payload is known from the other run. Uncertainties of both runs count.

    Args:
        unloaded: Without the payload.
        loaded: With it.
        body: Index of the body that carries it; that of the end-effector if None.
        varying: Names of base parameters that may differ between the runs beside the payload. If
            None, friction and offsets: they change with load and temperature.
        bounds: What is known of the payload: `BodyBounds(mass_max=..., radius=...)`. If None,
            wide ones from the robot's reach, which count only if the estimate could not exist.

    Raises:
        InputError: If the runs have different base parameters or have seen the same data, or the
            model does not have ten parameters for the body.
        RuntimeError: If no body within the bounds was proved to be the nearest.
    """
    runs = (unloaded, loaded)
    require_same_base(runs)
    runs = tuple(map(least_squares_of, runs))
    base = unloaded.base
    body = base.model.robot.tip_body if body is None else body
    own = own_parameters(base, varying, None)
    maps = [np.hstack([E, np.zeros((base.size, TEN))]) for E in state_maps(base.size, own, 2)]
    maps[1][:, -TEN:] = body_columns(base, body)
    found = tied(runs, maps)
    p, C = np.asarray(found.parameters)[-TEN:], np.asarray(found.covariance)[-TEN:, -TEN:]
    possible, distance = _possible(p, C, base.model.robot, bounds)
    return Payload(body, possible, p, C, np.asarray(found.freedom)[-TEN:], distance)


def _possible(
    estimate: Float[np.ndarray, "10"],
    covariance: Float[np.ndarray, "10 10"],
    robot: Robot,
    bounds: BodyBounds | None,
) -> tuple[Float[np.ndarray, "10"], float]:
    """The nearest parameters of a body that could exist, and how far they are."""
    if not np.isfinite(covariance).all():
        return estimate, np.nan
    if bounds is None:
        if consistency_margin(estimate) >= 0:
            return estimate, 0.0
        wide = BodyBounds.from_geometry(robot)
        bounds = BodyBounds(mass_max=np.max(wide.mass_max), radius=np.max(wide.radius))
    # Estimates that are known too well, as those of noiseless data, leave no digits for a proof.
    found, distance, error_bound = consistent_body(estimate, covariance, bounds, throw=False)
    if not error_bound <= LOOSE * (1.0 + distance**2):
        raise RuntimeError(
            "no body that could exist was proved to be the nearest to the payload's estimate, "
            f"whose mass is {estimate[0]:.4g} kg: are the runs those of the same robot?"
        )
    return found, distance


def body_columns(base: BaseParameters, body: int) -> Float[np.ndarray, "base 10"]:
    """Return the base parameters that unit parameters of a load on a body add.

    Args:
        base: The base parameters.
        body: Index of the body (0 is the first).

    Raises:
        InputError: If there is no such body, or the model lacks some of its ten parameters.
    """
    robot, names = base.model.robot, base.model.parameter_names
    if not 0 <= body < robot.joints:
        raise InputError(f"`body` must be from 0 to {robot.joints - 1}, but is {body}.")
    ten = [f"{name}{body + 1}" for name in INERTIAL_NAMES]
    missing = [name for name in ten if name not in names]
    if missing:
        raise InputError(
            f"a load on body {body} has ten parameters, but the model lacks `{missing[0]}`: use "
            "`RigidBodies()` with all ten."
        )
    unit = np.zeros((TEN, base.model.size))
    unit[range(TEN), [names.index(name) for name in ten]] = 1.0
    return np.asarray(base.from_standard(unit)).T


def _central(p: Float[Array, "10"]) -> Float[Array, "10"]:
    """Mass, centre of mass, and the six moments about it."""
    m, r = p[0], p[1:4] / p[0]
    x, y, z = r
    squares = jnp.stack([y * y + z * z, x * x + z * z, x * x + y * y, y * z, x * z, x * y])
    return jnp.concatenate([m[None], r, p[4:] - m * squares])
