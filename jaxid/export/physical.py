"""What simulators can hold of a fit: bodies that could exist, and what stands at the joints."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float, double_precision
from jaxid.errors import InputError
from jaxid.export.feed_forward import bodies_of
from jaxid.identification.consistency import consistency_margin
from jaxid.identification.fit import Fit
from jaxid.robot.inertia import inertia_tensor
from jaxid.robot.robot import Robot

IMPOSSIBLE = -1e-9
"""Share of a body below which it could not exist, of 1: rounding reaches a little beyond zero."""


class Inertial(NamedTuple):
    """One body as files describe it.

    Attributes:
        mass: Mass [kg].
        centre: Centre of mass in the frame of the body [m].
        tensor: Inertia about the centre of mass, along the body's axes [kg m²].
    """

    mass: float
    centre: Float[np.ndarray, "3"]
    tensor: Float[np.ndarray, "3 3"]

    @classmethod
    def of(cls, p: Float[AnyArray, "10"]) -> "Inertial":
        """From ten parameters in the paper's order."""
        p = np.asarray(p, np.float64)
        m = float(p[0])
        c = p[1:4] / m if m else np.zeros(3)
        with double_precision():
            J = np.asarray(inertia_tensor(p[4:]))
        return cls(m, c, J - m * (c @ c * np.eye(3) - np.outer(c, c)))


class Joints(NamedTuple):
    """What stands at the joints of a fit, as far as simulators know it.

    Attributes:
        armature: Inertia of the rotors [kg m² or kg].
        damping: Viscous friction [N m s/rad or N s/m].
        friction: Dry friction [N m or N]; the mean of both directions.
        left: Names of the parameters that are not in these.
    """

    armature: Float[np.ndarray, " joints"]
    damping: Float[np.ndarray, " joints"]
    friction: Float[np.ndarray, " joints"]
    left: tuple[str, ...]

    @classmethod
    def of(cls, fit: Fit) -> "Joints":
        """Those of a fit."""
        model = fit.base.model
        values = dict(zip(model.parameter_names, fit.standard_parameters.tolist(), strict=True))
        of_bodies = sum(t.body_parameters for t in model.terms) * model.robot.joints
        used = set(model.parameter_names[:of_bodies])
        found = []
        for names in (("Ia",), ("fv", "fvp", "fvn"), ("fc", "fcp", "fcn")):
            each = []
            for j in range(1, model.robot.joints + 1):
                own = [f"{name}{j}" for name in names if f"{name}{j}" in values]
                each.append(float(np.mean([values[x] for x in own])) if own else 0.0)
                used |= set(own)
            found.append(np.array(each))
        left = tuple(x for x in values if x not in used)
        return cls(found[0], found[1], found[2], left)


def possible_bodies(fit: Fit, what: str) -> Float[np.ndarray, "joints 10"]:
    """The bodies of a fit, ten parameters each in the paper's order.

    Args:
        fit: The model.
        what: That is to be written, as it reads in a sentence.

    Raises:
        InputError: If the bodies could not exist.
    """
    way_out = (
        "identify with `jid.PhysicallyConsistent()` (in the experiment file: `[estimator]` "
        '`kind = "consistent"`)'
    )
    if fit.full_parameters is None:
        raise InputError(
            f"{what} needs bodies that could exist, but this fit knows only base parameters: "
            f"{way_out}."
        )
    bodies = bodies_of(fit.base.model, fit.standard_parameters)
    shares = np.asarray(consistency_margin(bodies))
    wrong = np.flatnonzero(~(shares >= IMPOSSIBLE) | ~(bodies[:, 0] > 0))
    if len(wrong):
        raise InputError(
            f"{what} needs bodies that could exist, but body {wrong[0] + 1} could not: {way_out}."
        )
    joints = Joints.of(fit)
    for name, values in (("Ia", joints.armature), ("fv", joints.damping), ("fc", joints.friction)):
        if (values < 0).any():
            j = int(np.flatnonzero(values < 0)[0]) + 1
            raise InputError(
                f"{what} needs friction that brakes and rotors that weigh something, but {name}{j} "
                f"is negative: {way_out}."
            )
    return bodies


def known_efforts(robot: Robot) -> Float[np.ndarray, " joints"]:
    """The largest forces of the joints [N m or N]; infinite where they are not known."""
    return np.asarray(robot.known_max_forces, np.float64)
