"""What is known of a robot: its kinematic tree, its limits and its drives. Never a parameter."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from jaxid.robot.drives import Drives
from jaxid.robot.limits import Limits
from jaxid.types import AnyArray, Float

GRAVITY = (0.0, 0.0, -9.81)
AXES = "xyz"


class Tool(eqx.Module):
    """A load of known mass that is mounted on a body: it is subtracted, not identified.

    Attributes:
        body: Index of the body that carries it (0 is the first).
        mass: Mass [kg].
        centre_of_mass: In the frame of the body [m].
        inertia: Inertia tensor about its centre of mass, along the axes of the body's frame [kg m²].
    """

    body: int = eqx.field(static=True)
    mass: Float[AnyArray, ""]
    centre_of_mass: Float[AnyArray, "3"]
    inertia: Float[AnyArray, "3 3"]

    @property
    def parameters(self) -> Float[AnyArray, "10"]:
        """The ten parameters $(m, m r_c, A, B, C, D, E, F)$ about the body's origin (Eqs. 8, 9)."""
        m, r = self.mass, np.asarray(self.centre_of_mass)
        J = self.inertia + m * (r @ r * np.eye(3) - np.outer(r, r))
        return np.array(
            [m, *(m * r), J[0, 0], J[1, 1], J[2, 2], -J[1, 2], -J[0, 2], -J[0, 1]], np.float64
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

    @classmethod
    def of(
        cls,
        name: str,
        *,
        parent: tuple[int, ...] | None = None,
        revolute: tuple[bool, ...],
        axis: ArrayLike,
        rotation: ArrayLike,
        offset: ArrayLike,
        joint_names: tuple[str, ...] | None = None,
        gravity: ArrayLike = GRAVITY,
        limits: Limits | None = None,
        drives: Drives | None = None,
        tool: Tool | None = None,
        tip_body: int | None = None,
        tip_rotation: ArrayLike | None = None,
        tip_offset: ArrayLike = (0.0, 0.0, 0.0),
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
            ValueError: If shapes do not fit, a parent comes after its child, an axis is zero, or
                an attitude is no rotation.
        """
        n = len(revolute)
        if n == 0:
            raise ValueError("a robot must have at least one joint, but has none.")
        parent = tuple(range(-1, n - 1)) if parent is None else tuple(int(i) for i in parent)
        if len(parent) != n or any(not -1 <= p < i for i, p in enumerate(parent)):
            raise ValueError(
                f"`parent` must name for each of the {n} bodies an earlier one (or -1 for the "
                f"ground), but is {parent}."
            )
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
                raise ValueError(
                    f"`{key}` must hold finite numbers of shape {shape}, "
                    f"but has shape {arrays[key].shape}."
                )
        length = np.linalg.norm(arrays["axis"], axis=1)
        if (length < 1e-9).any():
            j = int(np.flatnonzero(length < 1e-9)[0]) + 1
            raise ValueError(f"`axis` of joint {j} is the zero vector: give it a direction.")
        arrays["axis"] = np.where(
            np.abs(length - 1.0)[:, None] > 1e-15, arrays["axis"] / length[:, None], arrays["axis"]
        )
        for j, R in enumerate(arrays["rotation"]):
            if np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
                raise ValueError(f"`rotation` of joint {j + 1} is no rotation matrix.")
        names = tuple(f"joint{i + 1}" for i in range(n)) if joint_names is None else joint_names
        if len(names) != n or len(set(names)) != n:
            raise ValueError(f"`joint_names` must be {n} different names, but is {names}.")
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
            notes=tuple(notes),
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
    def max_forces(self) -> Float[AnyArray, " joints"]:
        """Largest generalized force of every joint [N m or N]: of the joint, else of its motors (Eq. 30).

        Raises:
            ValueError: If neither is known for some joint.
        """
        forces = np.where(np.isfinite(self.limits.force), self.limits.force, self.drives.max_forces)
        if not np.isfinite(forces).all():
            j = int(np.flatnonzero(~np.isfinite(forces))[0])
            raise ValueError(
                f"the largest force of joint `{self.joint_names[j]}` of `{self.name}` is not known: "
                "give `limits.force` (joint side) or `drives.max_torques` (motor side)."
            )
        return forces

    def replace(self, **fields: Any) -> "Robot":
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **fields)

    def joint_unit(self, joint: int) -> str:
        """Unit of a joint's coordinate: rad or m."""
        return "rad" if self.revolute[joint] else "m"

    def force_unit(self, joint: int) -> str:
        """Unit of a joint's generalized force: N m or N."""
        return "N m" if self.revolute[joint] else "N"
