r"""Contacts of a floating base with the ground, and how their forces are eliminated.

A contact that stands exerts an unknown force $f$ on its leg:
$\Theta_l p = Q_l + J_l^T f$ in the rows of the leg's own joints, and
$\Theta_b p = J_b^T f$ in those of the base. The joints of the leg tell $f$, so that
$(\Theta_b - X \Theta_l)\, p = -X Q_l$ with $X = J_b^T (J_l^T)^+$. Unlike a null
space, $X$ is smooth in time, so that these rows may be filtered. The rows of the leg
itself are used up.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.errors import InputError

from .rotations import rpy_angles
from .virtual_joints import GROUP


class Imu(eqx.Module):
    """Place of an inertial measurement unit on a floating base.

    Attributes:
        position: Place of the accelerometer in the frame of the base [m].
        rpy: Roll, pitch and yaw of the sensor in that frame, as in a URDF [rad].
    """

    position: tuple[float, ...] = eqx.field(static=True, default=(0.0, 0.0, 0.0))
    rpy: tuple[float, ...] = eqx.field(static=True, default=(0.0, 0.0, 0.0))


class AbstractContactShape(eqx.Module):
    """Shape of a foot: which forces its contact with the ground transmits."""

    @abstractmethod
    def jacobian(self, velocity: AnyArray, turn: AnyArray, up: AnyArray) -> AnyArray:
        """Return motions on which the contact's forces do work [samples joints forces].

        Args:
            velocity: Velocity of the foot's origin by the joints [samples joints 3].
            turn: Its angular velocity likewise.
            up: Unit vector against gravity [samples 3].
        """


class Sphere(AbstractContactShape):
    """Ball foot: a force at its lowest point.

    Attributes:
        radius: Radius of the ball [m]; 0 for a point.
    """

    radius: float = eqx.field(static=True, converter=float, default=0.0)

    def jacobian(self, velocity, turn, up):
        """Return the velocity of the lowest point."""
        arm = -self.radius * up[:, None]
        return velocity + np.cross(turn, arm)


class Sole(AbstractContactShape):
    """Flat foot: a force and a moment."""

    def jacobian(self, velocity, turn, up):
        """Return velocity and angular velocity of the foot."""
        return np.concatenate([velocity, turn], axis=2)


class Contact(eqx.Module):
    """Foot that may touch the ground.

    Attributes:
        name: Name of the foot.
        body: Index of the body that it is part of.
        position: Centre of the ball, or a point of the sole, in the body's frame [m].
        shape: Shape of the foot.
    """

    name: str = eqx.field(static=True)
    body: int = eqx.field(static=True)
    position: tuple[float, ...] = eqx.field(static=True, default=(0.0, 0.0, 0.0))
    shape: AbstractContactShape = Sphere()


class Legs(NamedTuple):
    """Rows of the equations of motion that contacts change.

    Attributes:
        rows: Rows of the base, and of joints that carry several feet.
        own_joints: For each contact the joints that carry it alone.
    """

    rows: tuple[int, ...]
    own_joints: tuple[tuple[int, ...], ...]

    @property
    def joints(self) -> tuple[int, ...]:
        """Joints of all legs, leg by leg."""
        return sum(self.own_joints, ())

    @property
    def entries(self) -> int:
        """Number of entries of $X$ of all legs side by side."""
        return len(self.rows) * len(self.joints)


def legs_of(robot: Any) -> Legs:
    """Return the rows that the contacts of a robot change.

    Raises:
        InputError: If no joint carries a foot alone.
    """
    chains = [
        [i for i in robot.ancestors[contact.body] if i in robot.driven]
        for contact in robot.contacts
    ]
    carried_feet = [joint for chain in chains for joint in chain]
    shared_joints = sorted({i for i in carried_feet if carried_feet.count(i) > 1})
    own_joints = []
    for contact, chain in zip(robot.contacts, chains, strict=True):
        leg_joints = tuple(i for i in chain if i not in shared_joints)
        if not leg_joints:
            raise InputError(
                f"contact `{contact.name}` must be on a leg of its own: give the feet "
                "of one leg as one `Sole()`."
            )
        own_joints.append(leg_joints)
    rows = (*robot.virtual[:GROUP], *shared_joints)
    return Legs(rows, tuple(own_joints))


def contact_at(tree: Any, link: str, shape: AbstractContactShape) -> Contact:
    """Return the contact of a link of a `UrdfTree` with the ground."""
    tree.require_link("contacts", link)
    body, rotation, position = tree.carriers[link]
    if isinstance(shape, Sphere):
        position = position + rotation @ _ball_centre(tree, link)
    return Contact(link, body, tuple(position.tolist()), shape)


def _ball_centre(tree: Any, link: str) -> np.ndarray:
    """Return the centre of the link's only collision sphere, or its origin [m]."""
    parts = tree.links[link].findall("collision")
    balls = [part for part in parts if part.find("geometry/sphere") is not None]
    origin = balls[0].find("origin") if len(balls) == 1 else None
    return tree.numbers(origin, "xyz", (0.0, 0.0, 0.0))


def imu_at(tree: Any, link: str | Imu | None) -> Imu:
    """Return the place of an IMU, or of its link; that of the base's frame if None."""
    if not isinstance(link, str):
        return link or Imu()
    tree.require_link("imu", link)
    body, rotation, position = tree.carriers[link]
    if body != GROUP - 1:
        raise InputError(f"`imu` must be a link of the base, but is `{link}`.")
    return Imu(tuple(position.tolist()), tuple(rpy_angles(rotation).tolist()))
