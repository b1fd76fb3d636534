"""What is known of a robot: its kinematic tree, its limits and its drives. Never a parameter."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Numbers, as_array, is_traced, namespace
from jaxid.errors import InputError
from jaxid.robot.drives import Drives
from jaxid.robot.limits import Limits
from jaxid.robot.names import cleaned, control_characters
from jaxid.robot.plausible import FAR, FARTHEST, HEAVIEST, far_notes

GRAVITY = (0.0, 0.0, -9.81)
AXES = "xyz"


class Tool(eqx.Module):
    """A load of known mass that is mounted on a body: it is subtracted, not identified.

    Attributes:
        body: Index of the body that carries it (0 is the first).
        mass: Mass [kg].
        centre_of_mass: In the frame of the body [m].
        inertia: Inertia tensor about its centre of mass, along the body's axes [kg m²].
    """

    body: int = eqx.field(static=True)
    mass: Float[AnyArray, ""]
    centre_of_mass: Float[AnyArray, "3"]
    inertia: Float[AnyArray, "3 3"]

    @classmethod
    def of(
        cls,
        body: int,
        *,
        mass: Float[AnyArray, ""] | float | int,
        centre_of_mass: Numbers,
        inertia: Numbers | None = None,
    ) -> "Tool":
        """Builds a tool and checks it; a point mass if no inertia is given.

        Raises:
            InputError: If the mass is not positive, or the inertia belongs to no body.
        """
        m, r = as_array("mass", mass), as_array("centre_of_mass", centre_of_mass)
        J = np.zeros((3, 3)) if inertia is None else as_array("inertia", inertia)
        if m.shape != () or not (is_traced(m) or 0.0 < m <= HEAVIEST):
            raise InputError(
                f"`mass` of the tool must be a positive number of {HEAVIEST:g} kg at most, but is "
                f"{mass}."
            )
        if r.shape != (3,) or not (is_traced(r) or np.isfinite(r).all()):
            raise InputError("`centre_of_mass` of the tool must hold three finite numbers [m].")
        if not is_traced(r) and np.abs(r).max() > FARTHEST:
            raise InputError(
                f"`centre_of_mass` of the tool lies {np.abs(r).max():g} m away: give it in metres."
            )
        if J.shape != (3, 3) or not (is_traced(J) or _is_symmetric(np.asarray(J))):
            raise InputError("`inertia` of the tool must be a symmetric 3 x 3 matrix [kg m²].")
        if not is_traced(J) and np.abs(J).max() > FAR**2 * HEAVIEST:
            raise InputError(f"`inertia` of the tool holds {np.abs(J).max():g}: give it in kg m².")
        if not is_traced(J):
            cls._refuse_impossible(np.linalg.eigvalsh(J))
        return cls(body, m, r, J)

    @staticmethod
    def _refuse_impossible(principal: np.ndarray) -> None:
        slack = 1e-9 * np.abs(principal).max()
        if principal[0] < -slack or principal[2] > principal[0] + principal[1] + slack:
            raise InputError(
                "`inertia` of the tool belongs to no body: its principal moments are "
                f"{principal[0]:.3g}, {principal[1]:.3g}, {principal[2]:.3g} kg m², but none may "
                "be negative or larger than the sum of the others; is it about the centre of mass?"
            )

    @property
    def parameters(self) -> Float[AnyArray, "10"]:
        """The ten parameters $(m, m r_c, A, B, C, D, E, F)$ about the body's origin (Eqs. 8, 9)."""
        m, r = self.mass, self.centre_of_mass
        J = self.inertia + m * (r @ r * np.eye(3) - r[:, None] * r[None, :])
        return namespace(m, r, J).stack(
            [m, *(m * r), J[0, 0], J[1, 1], J[2, 2], -J[1, 2], -J[0, 2], -J[0, 1]]
        )


class Robot(eqx.Module):
    r"""An open kinematic chain or tree: joint $i$ moves body $i$ against its parent.

    The frame of a body has its origin on the joint's axis. At $q_i = 0$ it stands at `offset` with
    the attitude `rotation` in its parent; a revolute joint turns it about `axis`, a prismatic joint
    moves it along `axis`. Geometry may carry NumPy arrays (constants of what is compiled) or JAX
    arrays (inputs: batches of geometries, derivatives with respect to lengths).

    Attributes:
        name: Of the robot.
        joint_names: One for each joint.
        parent: Index of the parent body; -1 is the ground.
        revolute: Whether the joint turns; a prismatic joint slides.
        axis: Unit vectors of the joints' axes, in the frame of their body.
        rotation: Attitude of the body in its parent at $q = 0$: columns are the body's axes.
        offset: Origin of the body in its parent at $q = 0$ [m].
        gravity: In the frame of the ground [m/s²].
        limits: What the joints can do.
        drives: Motors and gears.
        tool: A known load, or None.
        tip_body: Index of the body that carries the end-effector.
        tip_rotation: Attitude of the end-effector in that body.
        tip_offset: Origin of the end-effector in that body [m].
        source: Where the numbers come from.
        notes: What was changed or assumed on the way, in sentences.
    """

    name: str = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    parent: tuple[int, ...] = eqx.field(static=True)
    revolute: tuple[bool, ...] = eqx.field(static=True)
    axis: Float[AnyArray, "*geometry joints 3"]
    rotation: Float[AnyArray, "*geometry joints 3 3"]
    offset: Float[AnyArray, "*geometry joints 3"]
    gravity: Float[AnyArray, "*geometry 3"]
    limits: Limits
    drives: Drives
    tool: Tool | None
    tip_body: int = eqx.field(static=True)
    tip_rotation: Float[AnyArray, "3 3"]
    tip_offset: Float[AnyArray, "3"]
    source: str = eqx.field(static=True, default="")
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        n = self.joints
        if len(self.revolute) != n or any(not -1 <= p < i for i, p in enumerate(self.parent)):
            raise InputError(
                f"`parent` must name for each of the {len(self.revolute)} bodies an earlier one "
                f"(or -1 for the ground), but is {self.parent}."
            )
        if len(self.joint_names) != n or len(set(self.joint_names)) != n:
            raise InputError(
                f"`joint_names` must be {n} different names, but is {self.joint_names}."
            )
        for name in (self.name, *self.joint_names):
            if sign := control_characters(name):
                raise InputError(
                    f"the name `{cleaned(name)}` holds the control character {sign}: remove it."
                )
        carrier = self.tip_body if self.tool is None else self.tool.body
        for what, body in (("tip_body", self.tip_body), ("tool.body", carrier)):
            if not 0 <= body < n:
                raise InputError(f"`{what}` must be a body from 0 to {n - 1}, but is {body}.")
        for what, one in (("limits", self.limits.force), ("drives", self.drives.zero)):
            if one.shape[-1:] != (n,):
                raise InputError(
                    f"`{what}` must be of {n} joints, like the robot, but are of {one.shape[-1]}."
                )

    @classmethod
    def of(
        cls,
        name: str,
        *,
        parent: tuple[int, ...] | None = None,
        revolute: tuple[bool, ...],
        axis: Numbers,
        rotation: Numbers,
        offset: Numbers,
        joint_names: tuple[str, ...] | None = None,
        gravity: Numbers = GRAVITY,
        limits: Limits | None = None,
        drives: Drives | None = None,
        tool: Tool | None = None,
        tip_body: int | None = None,
        tip_rotation: Numbers | None = None,
        tip_offset: Numbers = (0.0, 0.0, 0.0),
        source: str = "",
        notes: tuple[str, ...] = (),
    ) -> "Robot":
        """Builds a robot and checks it; axes are normalised, unknown limits are infinite.

        Args:
            name: Of the robot.
            parent: Index of each body's parent, -1 for the ground; a serial chain if None.
            revolute: Whether each joint turns (otherwise it slides).
            axis: Axes of the joints, in their body's frame.
            rotation: Attitudes of the bodies in their parents at q = 0.
            offset: Origins of the bodies in their parents at q = 0 [m].
            joint_names: `joint1`, `joint2`, … if None.
            gravity: In the frame of the ground [m/s²].
            limits: Infinite if None.
            drives: Direct drives if None.
            tool: A known load.
            tip_body: Body of the end-effector; the last if None.
            tip_rotation: Attitude of the end-effector in that body; the same if None.
            tip_offset: Origin of the end-effector in that body [m].
            source: Where the numbers come from.
            notes: What was changed or assumed on the way.

        Raises:
            InputError: If shapes do not fit, a parent comes after its child, an axis is zero, or
                an attitude is no rotation.
        """
        n = len(revolute)
        if n == 0:
            raise InputError("a robot must have at least one joint, but has none.")
        parent = tuple(range(-1, n - 1)) if parent is None else tuple(int(i) for i in parent)
        arrays = {}
        for key, value, shape in (
            ("axis", axis, (n, 3)),
            ("rotation", rotation, (n, 3, 3)),
            ("offset", offset, (n, 3)),
            ("gravity", gravity, (3,)),
            ("tip_rotation", np.eye(3) if tip_rotation is None else tip_rotation, (3, 3)),
            ("tip_offset", tip_offset, (3,)),
        ):
            arrays[key] = np.array(value, dtype=np.float64)
            if arrays[key].shape != shape or not np.isfinite(arrays[key]).all():
                raise InputError(
                    f"`{key}` must hold finite numbers of shape {shape}, "
                    f"but has shape {arrays[key].shape}."
                )
        length = np.linalg.norm(arrays["axis"], axis=1)
        if (length < 1e-9).any():
            j = int(np.flatnonzero(length < 1e-9)[0]) + 1
            raise InputError(f"`axis` of joint {j} is the zero vector: give it a direction.")
        arrays["axis"] = np.where(
            np.abs(length - 1.0)[:, None] > 1e-15, arrays["axis"] / length[:, None], arrays["axis"]
        )
        for j, R in enumerate(arrays["rotation"]):
            _require_rotation(f"`rotation` of joint {j + 1}", R)
        _require_rotation("`tip_rotation`", arrays["tip_rotation"])
        names = tuple(f"joint{i + 1}" for i in range(n)) if joint_names is None else joint_names
        places = [f"`offset` of joint `{one}`" for one in names]
        places = dict(zip(places, arrays["offset"], strict=False))
        places["`tip_offset`"] = arrays["tip_offset"]
        for what, r in places.items():
            if np.abs(r).max() > FARTHEST:
                raise InputError(f"{what} is {np.abs(r).max():g} m long: give it in metres.")
        return cls(
            name=name,
            joint_names=tuple(names),
            parent=parent,
            revolute=tuple(bool(r) for r in revolute),
            limits=Limits.of(n) if limits is None else limits,
            drives=Drives.of(n) if drives is None else drives,
            tool=tool,
            tip_body=n - 1 if tip_body is None else tip_body,
            source=source,
            notes=(*notes, *(said for what, r in places.items() for said in far_notes(what, r))),
            **arrays,
        )

    @property
    def joints(self) -> int:
        """Number of joints, which is the number of bodies."""
        return len(self.parent)

    @property
    def ancestors(self) -> tuple[tuple[int, ...], ...]:
        """For every body, the joints that move it: itself and those between it and the ground."""
        chains: list[tuple[int, ...]] = []
        for i, p in enumerate(self.parent):
            chains.append((i,) if p < 0 else (*chains[p], i))
        return tuple(chains)

    @property
    def known_max_forces(self) -> Float[AnyArray, " joints"]:
        """Largest force of every joint as far as it is known; else infinite [N m or N]."""
        own = np.asarray(self.limits.force)
        return np.where(np.isfinite(own), own, self.drives.max_forces)

    @property
    def max_forces(self) -> Float[AnyArray, " joints"]:
        """Largest force of every joint [N m or N]: its own, else that of its motors (Eq. 30).

        Raises:
            InputError: If neither is known for some joint.
        """
        forces = self.known_max_forces
        if not np.isfinite(forces).all():
            j = int(np.flatnonzero(~np.isfinite(forces))[0])
            raise InputError(
                f"the largest force of joint `{self.joint_names[j]}` of `{self.name}` is not known:"
                " give `limits.force` (joint side) or `drives.max_torques` (motor side)."
            )
        return forces

    def replace(self, **fields: Any) -> "Robot":
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **fields)

    def mounted(
        self, rotation: Numbers | None = None, position: Numbers = (0.0, 0.0, 0.0)
    ) -> "Robot":
        """The same robot on a base that is tilted and shifted; gravity stays as it is.

        Args:
            rotation: Attitude of the former ground frame on the new ground; upright if None.
            position: Origin of the former ground frame on the new ground [m].

        Raises:
            InputError: If the attitude is no rotation, or the position no point.
        """
        R = np.eye(3) if rotation is None else as_array("rotation", rotation)
        r = as_array("position", position)
        if R.shape != (3, 3):
            raise InputError(f"the base's rotation must be a 3 x 3 matrix, not of shape {R.shape}.")
        if not is_traced(R):
            _require_rotation("the base's rotation", np.asarray(R))
        if r.shape != (3,) or not (is_traced(r) or np.isfinite(r).all()):
            raise InputError("the base's position must hold three finite numbers [m].")
        on_ground = np.array(self.parent) < 0
        moves = np.broadcast_to(on_ground[:, None], self.offset.shape)
        turns = np.broadcast_to(on_ground[:, None, None], self.rotation.shape)
        xp = namespace(R, r, self.rotation, self.offset)
        r = xp.broadcast_to(r, self.offset.shape)
        return self.replace(
            rotation=xp.where(turns, R @ self.rotation, self.rotation),
            offset=xp.where(moves, r + self.offset @ R.T, self.offset),
        )

    def with_tool(
        self,
        *,
        mass: Float[AnyArray, ""] | float | int,
        centre_of_mass: Numbers,
        inertia: Numbers | None = None,
    ) -> "Robot":
        """The robot with a known load at its end-effector, in place of the load it had.

        For a load elsewhere: `robot.replace(tool=Tool.of(body, ...))`.

        Args:
            mass: Mass [kg].
            centre_of_mass: In the end-effector's frame [m].
            inertia: About the centre of mass, along the end-effector's axes [kg m²]; a point mass
                if None.

        Raises:
            InputError: If the mass is not positive, or the inertia belongs to no body.
        """
        R = self.tip_rotation
        tool = Tool.of(self.tip_body, mass=mass, centre_of_mass=centre_of_mass, inertia=inertia)
        return self.replace(
            tool=Tool(
                tool.body,
                tool.mass,
                self.tip_offset + R @ tool.centre_of_mass,
                R @ tool.inertia @ R.T,
            )
        )

    def joint_unit(self, joint: int) -> str:
        """Unit of a joint's coordinate: rad or m."""
        return "rad" if self.revolute[joint] else "m"

    def force_unit(self, joint: int) -> str:
        """Unit of a joint's generalized force: N m or N."""
        return "N m" if self.revolute[joint] else "N"


def _is_symmetric(J: np.ndarray) -> bool:
    return bool(np.abs(J - J.T).max() <= 1e-9 * np.abs(J).max() < np.inf)


def _require_rotation(what: str, R: np.ndarray) -> None:
    if not np.abs(R.T @ R - np.eye(3)).max() < 1e-6 or np.linalg.det(R) < 0:
        raise InputError(f"{what} is no rotation matrix.")
