"""URDF or MJCF file of a robot, and its claims on bodies, rotors and friction."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxid.arrays import Float, Matrix, Numbers, Vector
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.consistency import consistency_margin
from jaxid.io import FilePath
from jaxid.robot.capsule_fit import placed_shapes
from jaxid.robot.collision_geometry import BodyShape
from jaxid.robot.contacts import AbstractContactShape
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import joint_parameters, load_urdf
from jaxid.robot.urdf_tree import UrdfTree


@dataclasses.dataclass(frozen=True)
class RobotFile:
    """URDF or MJCF file of a robot.

    Attributes:
        path: Path of the file.
        tip: Link (body or site) of the end-effector; only the chain to it is used.
        base: Link (body) that stands on the ground; the root by default.
        base_rotation: Orientation of the base in the frame of the ground; None for
            parallel frames.
        base_position: Position of the base in the frame of the ground [m].
        xacro_arguments: Texts of the arguments of a xacro file, by name.
        floating: Whether the base moves freely.
        imu: Link of the IMU on a floating base.
        contacts: Links of the feet of a floating base, and their shapes.
    """

    path: FilePath
    tip: str | None = None
    base: str | None = None
    base_rotation: Float[np.ndarray, "3 3"] | None = None
    base_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    xacro_arguments: Mapping[str, str] = dataclasses.field(default_factory=dict)
    floating: bool = False
    imu: str | None = None
    contacts: Mapping[str, AbstractContactShape] | None = None

    @property
    def chain(self) -> dict[str, Any]:
        """Ends of the chain and arguments, for functions that read the file."""
        return {
            "tip": self.tip,
            "base": self.base,
            "xacro_arguments": self.xacro_arguments,
            "floating": self.floating,
        }

    @property
    def placement(self) -> dict[str, Any]:
        """Orientation and position of the base, for functions that make robots."""
        return {
            "base_rotation": self.base_rotation,
            "base_position": self.base_position,
        }

    def load(self, gravity: Numbers | None = None) -> Robot:
        """Load the robot; gravity in the frame of the ground is the file's if None."""
        return load_urdf(
            self.path,
            gravity=gravity,
            imu=self.imu,
            contacts=self.contacts,
            **self.chain,
            **self.placement,
        )

    def shapes(self) -> list[BodyShape]:
        """Return the shapes that can be read, each with its body, in the body's frame.

        Without capsules around them: this is how the robot looks.
        """
        tree = UrdfTree(self.path, **self.chain)
        mount = np.eye(3) if self.base_rotation is None else self.base_rotation
        place = np.asarray(self.base_position)
        shapes = []
        for link in placed_shapes(tree, mount, place, faults={}):
            for shape in link.shapes:
                shapes.append((link.body, shape.placed(link.rotation, link.position)))
        return shapes

    def bodies(self) -> Float[np.ndarray, "bodies 10"]:
        """Return the inertial parameters of the bodies.

        Moments of inertia that cannot exist are replaced by the nearest that can.

        Raises:
            InputError: If a body cannot exist for another reason.
        """
        tree = UrdfTree(self.path, **self.chain)
        return np.asarray(tree.bodies(check=True, nearest=True))

    def possible_bodies(self) -> Float[np.ndarray, "bodies 10"] | None:
        """Return the inertial parameters if all bodies can exist, otherwise None."""
        try:
            bodies = self.bodies()
        except InputError:
            return None
        return bodies if (consistency_margin(bodies) > 0.0).all() else None

    def claims(self) -> dict[str, float]:
        """Return all parameters that the file claims, by their names in a model.

        Nothing if it describes no masses, or a body that cannot exist: notes of the
        robot name that body.
        """
        try:
            bodies = self.bodies()
        except InputError:
            return {}
        if not np.any(bodies):
            return {}
        # A floating base has the number 0.
        first_number = 0 if self.floating else 1
        return _named_bodies(bodies, first_number) | self._joint_claims()

    def _joint_claims(self) -> dict[str, float]:
        """Return claimed rotors, friction and springs, by their names in a model."""
        parameters = joint_parameters(self.path, **self.chain)
        # A spring that rests elsewhere than at zero adds a constant force.
        offsets = -parameters["stiffness"] * parameters.pop("springref")
        rows = (*parameters.values(), offsets)
        claims = {}
        for symbol, row in zip(("Ia", "fv", "fc", "ks", "fo"), rows, strict=True):
            for joint, value in enumerate(row, 1):
                if value > 0.0 or (symbol == "fo" and value):
                    claims[f"{symbol}{joint}"] = float(value)
        return claims


def base_parameters_of(claims: Mapping[str, float], base: BaseParameters) -> Vector:
    """Return base parameters of standard ones, which are 0 unless they are named."""
    standard_parameters = [claims.get(x, 0.0) for x in base.model.parameter_names]
    return np.asarray(base.from_standard(standard_parameters))


def claimed_parameters(claims: Mapping[str, float], base: BaseParameters) -> Vector:
    """Return base parameters of standard ones; NaN unless they are named."""
    names = base.model.parameter_names
    is_claimed = [names[k] in claims for k in base.indices]
    return np.where(is_claimed, base_parameters_of(claims, base), np.nan)


def _named_bodies(bodies: Matrix, first_number: int) -> dict[str, float]:
    """Return the parameters of bodies by their names in a model."""
    return {
        f"{symbol}{number}": float(value)
        for number, body in enumerate(bodies, first_number)
        for symbol, value in zip(INERTIAL_NAMES, body, strict=True)
    }


def joint_number(robot: Robot, name: str, key: str = "body") -> int:
    """Return the index of the body whose joint a key or an option names."""
    if name not in robot.body_names:
        raise InputError(
            f"`{key}` must be the name of the joint that moves it "
            f'({", ".join(robot.body_names)}), but is "{name}".'
        )
    return robot.body_names.index(name)
