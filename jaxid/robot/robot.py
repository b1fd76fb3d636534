"""Robot: kinematic tree, limits, drives and known load; never an unknown parameter."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Hashable,
    Indices,
    Joints,
    ManyJoints,
    Matrix3,
    Numbers,
    Texts,
    Vector3,
    as_finite_array,
    given,
    namespace,
)
from jaxid.errors import InputError
from jaxid.result_table import Column, Remark, Status, Summarised, Table

from .contacts import Contact, Imu
from .follower_joints import Followers, Loop, order_from_ground
from .inertia import IMPOSSIBLE, Tool
from .limits_and_drives import MAX_LENGTH, Drives, Limits, length_notes, limit_notes
from .loop_closing import close_loops
from .rotations import (
    SNAP_TOLERANCE,
    as_rotations,
    snapped,
    snapped_rotations,
    unit_axes,
)
from .virtual_joints import GROUP, numbers_of_bodies, solid_bodies, with_sensor

GRAVITY = (0.0, 0.0, -9.81)


class Robot(Summarised, Hashable):
    r"""An open kinematic chain or tree: joint $i$ moves body $i$ against its parent.

    Bodies of joints that follow others come last, after those of all joints that move
    alone and have coordinates, limits and drives.

    The frame of a body has its origin on the joint's axis. At $q_i = 0$ it is placed in
    its parent at `offset` with the attitude `rotation`; a revolute joint turns it about
    `axis`, a prismatic joint moves it along `axis`. Geometry may consist of NumPy
    arrays (constants of compiled code), which are checked, or of JAX arrays (inputs:
    batches of geometries, derivatives by lengths), which are taken as they are.

    Args:
        name: Name of the robot.
        revolute: For each joint whether it turns; a prismatic joint slides.
        axis: Axes of all joints, in the frames of their bodies; of any length.
        rotation: Attitudes of the bodies in their parents at $q = 0$: columns are the
            body's axes.
        offset: Origins of the bodies in their parents at $q = 0$ [m].
        parent: Indices of the parent bodies, -1 for the ground; a serial chain if None.
        followers: Joints that follow others, or that loops move; these come last.
        loops: Pairs of points that coincide; `with_loops` gives them to a robot.
        loop_rows: Entries of the distances between these points that close the loops.
        loop_pose: Coordinates of all joints at which the description closes the loops.
        coordinates: Those at the sample for which it is evaluated (`at_sample`).
        joint_names: Names of the joints; `joint1`, `joint2`, … if None.
        gravity: Acceleration of gravity in the frame of the ground [m/s²].
        limits: Joint limits; infinite if None.
        drives: Motors and gears; direct drives if None.
        tool: Known load, or None.
        tip_body: Index of the body that carries the end-effector; the last if None.
        tip_rotation: Attitude of the end-effector in that body; the body's own if None.
        tip_offset: Origin of the end-effector in that body [m].
        source: Origin of the numbers.
        source_tip: Link of the end-effector that was asked for in that file, or None.
        source_base: Link on the ground that was asked for in that file, or None.
        source_arguments: Names and texts of the arguments of that file, if it is xacro.
        notes: Changes and assumptions that were made, one sentence each.
        virtual: Indices of joints that nothing drives, in groups of six for the forces
            between two bodies; coordinates are zero (`virtual_joints`).
        floating: Whether the first group carries a base that moves.
        imu: Place of the IMU on that base.
        contacts: Points and soles at which it may touch the ground.

    Raises:
        InputError: If shapes do not fit, a parent comes after its child, an axis is
            zero, or an attitude is no rotation.
    """

    name: str = eqx.field(static=True)
    _: dataclasses.KW_ONLY
    joint_names: Texts = eqx.field(static=True, converter=given, default=None)
    parent: Indices = eqx.field(static=True, converter=given, default=None)
    followers: Followers = ()
    loops: tuple[Loop, ...] = ()
    loop_rows: Indices = eqx.field(static=True, default=())
    loop_pose: Float[AnyArray, " bodies"] | None = None
    coordinates: Float[AnyArray, " bodies"] | None = None
    revolute: tuple[bool, ...] = eqx.field(static=True)
    axis: Float[AnyArray, "*geometry bodies 3"] = eqx.field(converter=given)
    rotation: Float[AnyArray, "*geometry bodies 3 3"] = eqx.field(converter=given)
    offset: Float[AnyArray, "*geometry bodies 3"] = eqx.field(converter=given)
    gravity: Float[AnyArray, "*geometry 3"] = eqx.field(
        converter=given, default=GRAVITY
    )
    limits: Limits = eqx.field(converter=given, default=None)
    drives: Drives = eqx.field(converter=given, default=None)
    tool: Tool | None = None
    tip_body: int = eqx.field(static=True, converter=given, default=None)
    tip_rotation: Matrix3 = eqx.field(converter=given, default=None)
    tip_offset: Vector3 = eqx.field(converter=given, default=(0.0, 0.0, 0.0))
    source: str = eqx.field(static=True, default="")
    source_tip: str | None = eqx.field(static=True, default=None)
    source_base: str | None = eqx.field(static=True, default=None)
    source_arguments: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    notes: Texts = eqx.field(static=True, default=())
    virtual: Indices = eqx.field(static=True, default=())
    floating: bool = eqx.field(static=True, default=False)
    imu: Imu = eqx.field(static=True, default=Imu())
    contacts: tuple[Contact, ...] = eqx.field(static=True, default=())

    def __post_init__(self):
        if not self.revolute:
            raise InputError(
                "`revolute` must have one entry for each joint, but is empty."
            )
        n = self.bodies
        self._set_defaults()
        self.joint_names = tuple(self.joint_names)
        self.parent = tuple(int(body) for body in self.parent)
        self.revolute = tuple(bool(turns) for turns in self.revolute)
        # Arrays of JAX may have leading axes, for batches of geometries.
        self.axis = unit_axes(as_finite_array("`axis`", self.axis, (n, 3)))
        self.rotation = as_rotations("`rotation`", self.rotation, (n, 3, 3))
        self.offset = as_finite_array("`offset`", self.offset, (n, 3))
        self.gravity = as_finite_array("`gravity`", self.gravity, (3,))
        self.tip_rotation = as_rotations("`tip_rotation`", self.tip_rotation, (3, 3))
        self.tip_offset = as_finite_array("`tip_offset`", self.tip_offset, (3,))
        self._check_joints()
        self._check_bodies()

        doubts = limit_notes(self.joint_names, self.revolute, self.limits)
        notes = (*self.notes, *self._length_notes(), *doubts)
        # A copy finds the notes of its original again.
        self.notes = tuple(dict.fromkeys(notes))

    def _set_defaults(self):
        """Fill in what follows from the number of joints where it is not given."""
        joints = self.joints
        if not self.joint_names:
            self.joint_names = tuple(f"joint{i + 1}" for i in range(joints))
        if self.parent is None:
            self.parent = tuple(range(-1, self.bodies - 1))
        if self.limits is None:
            self.limits = Limits(joints)
        if self.drives is None:
            self.drives = Drives(joints)
        if self.tip_body is None:
            self.tip_body = self.bodies - 1
        if self.tip_rotation is None:
            self.tip_rotation = np.eye(3)

    def _check_joints(self):
        """Reject names, leaders and numbers that do not fit the number of joints."""
        n = self.joints
        if len(self.joint_names) != n or len(set(self.body_names)) != self.bodies:
            raise InputError(
                f"`joint_names` must be {n} different names, but is {self.joint_names}."
            )
        # Names are written to files and terminals.
        for name in (self.name, *self.body_names):
            if not name.isprintable():
                raise InputError(
                    f"the name {name!r} must be printable: remove all other characters."
                )
        for follower in self.followers:
            if follower.leader is not None and not 0 <= follower.leader < n:
                raise InputError(
                    f"`leader` of `{follower.name}` must be a joint that moves alone, "
                    f"from 0 to {n - 1}, but is {follower.leader}."
                )
        numbers = {"limits": self.limits.force, "drives": self.drives.zero}
        for field, entries in numbers.items():
            if entries.shape[-1:] != (n,):
                raise InputError(
                    f"`{field}` must describe {n} joints, as the robot has, but "
                    f"describe {entries.shape[-1]}."
                )

    def _check_bodies(self):
        """Reject parents and bodies that do not exist, or that form no tree."""
        n = self.bodies
        # Only bodies of followers, which come last, may carry earlier ones.
        first_follower = self.joints if self.followers else n
        are_earlier = all(
            -1 <= parent < body or first_follower <= parent < n
            for body, parent in enumerate(self.parent)
        )
        # A circle of parents is left out of the order.
        if len(self.parent) != n or not are_earlier or len(self.order) != n:
            raise InputError(
                f"`parent` must hold an earlier body, or -1, for each of {n} bodies, "
                f"but is {self.parent}."
            )
        bodies = {"tip_body": self.tip_body}
        if self.tool is not None:
            bodies["tool.body"] = self.tool.body
        for field, body in bodies.items():
            if not 0 <= body < n:
                raise InputError(
                    f"`{field}` must be a body from 0 to {n - 1}, but is {body}."
                )

    def _length_notes(self):
        """Reject offsets that no robot has; return notes on some that may be in mm."""
        lengths = {"`tip_offset`": self.tip_offset}
        if self.offset.ndim == 2:
            for name, offset in zip(self.body_names, self.offset, strict=True):
                lengths[f"`offset` of joint `{name}`"] = offset
        notes = []
        for owner, offset in lengths.items():
            # Arrays of JAX may be traced: their numbers are then unknown.
            if not isinstance(offset, np.ndarray):
                continue
            if (length := np.abs(offset).max()) > MAX_LENGTH:
                raise InputError(f"{owner} is {length:g} m long: give it in metres.")
            notes += length_notes(owner, offset)
        return notes

    @property
    def joints(self) -> int:
        """Number of joints that move alone, which is that of coordinates."""
        return len(self.revolute)

    @property
    def bodies(self) -> int:
        """Number of bodies, those of followers included."""
        return len(self.revolute) + len(self.followers)

    @property
    def driven(self) -> Indices:
        """Indices of the joints that are not virtual."""
        return tuple(i for i in range(self.joints) if i not in self.virtual)

    @property
    def rigid(self) -> Indices:
        """Indices of the virtual joints without velocity and acceleration."""
        return self.virtual[GROUP:] if self.floating else self.virtual

    @property
    def sensor_bodies(self) -> Indices:
        """Indices of the bodies behind force sensors."""
        return self.rigid[GROUP - 1 :: GROUP]

    @property
    def has_base_sensor(self) -> bool:
        """Whether a force sensor is under the base."""
        return self.virtual[:1] == (0,) and not self.floating

    @property
    def solid_bodies(self) -> Indices:
        """Indices of the bodies that have a mass."""
        return solid_bodies(self)

    @property
    def numbers(self) -> Indices:
        """For each body the number in names of parameters."""
        return numbers_of_bodies(self.bodies, self.virtual)

    @property
    def turns(self) -> tuple[bool, ...]:
        """For each body whether its joint turns."""
        return (*self.revolute, *(f.revolute for f in self.followers))

    @property
    def body_names(self) -> Texts:
        """Names of the joints that move the bodies, or of these bodies."""
        names = [*self.joint_names, *(f.name for f in self.followers)]
        for last in self.virtual[GROUP - 1 :: GROUP]:
            names[last] = names[last].rpartition(" ")[0]
        return tuple(names)

    @property
    def order(self) -> Indices:
        """Bodies in an order in which each comes after the one that carries it."""
        return order_from_ground(self.parent, len(self.followers))

    @property
    def ancestors(self) -> tuple[Indices, ...]:
        """For every body those from the ground to itself, whose joints move it."""
        chains: list[Indices] = [()] * self.bodies
        for body in self.order:
            parent = self.parent[body]
            parent_chain = chains[parent] if parent >= 0 else ()
            chains[body] = (*parent_chain, body)
        return tuple(chains)

    def close(self, q: Numbers) -> ManyJoints:
        """Return the coordinates of all joints; those of loops are on one branch.

        It is the branch of `loop_pose`. Where JAX traces, coordinates at which the
        loops do not close become NaN.

        Args:
            q: Coordinates of the joints that move alone [rad or m].

        Raises:
            InputError: If the loops do not close at some sample.
        """
        return close_loops(self, q)

    @property
    def known_max_forces(self) -> Joints:
        """Largest force of every joint, infinite where it is not known [N m or N]."""
        forces = np.asarray(self.limits.force)
        return np.where(np.isfinite(forces), forces, self.drives.max_forces)

    @property
    def max_forces(self) -> Joints:
        """Largest force of every joint: its limit, or that of its motors (Eq. 30).

        Raises:
            InputError: If neither is known for some joint.
        """
        forces = self.known_max_forces
        if not np.isfinite(forces).all():
            joint = int(np.argmin(np.isfinite(forces)))
            name = self.joint_names[joint]
            raise InputError(
                f"the largest force of joint `{name}` of `{self.name}` "
                "is not known: give `limits.force` (joint side) or "
                "`drives.max_torques` (motor side)."
            )
        return forces

    def replace(self, **fields: Any) -> "Robot":
        """Return a copy with some fields replaced and checked."""
        return dataclasses.replace(self, **fields)

    def snapped(self, tolerance: float = SNAP_TOLERANCE) -> "Robot":
        """Return the robot with rounded quarter turns made exact, like 1.5708 for pi/2.

        Args:
            tolerance: Entries of axes, attitudes and the direction of gravity this
                close to zero become zero [rad].

        Raises:
            InputError: If the tolerance is no small angle.
        """
        gravity = np.asarray(self.gravity)
        if gravity.any():
            length = np.linalg.norm(gravity, axis=-1, keepdims=True)
            gravity = length * snapped(gravity / length, tolerance)
        return self.replace(
            gravity=gravity,
            axis=snapped(self.axis, tolerance),
            rotation=snapped_rotations(self.rotation, tolerance),
        )

    def mounted(
        self, rotation: Numbers | None = None, position: Numbers = (0.0, 0.0, 0.0)
    ) -> "Robot":
        """Return the robot on a base that is tilted and shifted in the same gravity.

        Args:
            rotation: Attitude of the former ground frame on the new ground; upright if
                None.
            position: Origin of the former ground frame on the new ground [m].

        Raises:
            InputError: If the attitude is no rotation, or the position no point.
        """
        attitude = np.eye(3) if rotation is None else rotation
        R = as_rotations("`rotation`", attitude, (3, 3))
        r = as_finite_array("`position`", position, (3,))
        xp = namespace(R, r, self.rotation, self.offset)
        rotations = R @ self.rotation
        turned_offsets = self.offset @ R.T
        offsets = xp.broadcast_to(r, turned_offsets.shape) + turned_offsets

        # Only bodies on the ground move: the others are placed in their parents.
        is_on_ground = np.array(self.parent)[:, None] < 0
        return self.replace(
            rotation=xp.where(is_on_ground[..., None], rotations, self.rotation),
            offset=xp.where(is_on_ground, offsets, self.offset),
        )

    def with_tool(
        self,
        *,
        mass: AnyArray | float | int,
        centre_of_mass: Numbers,
        inertia: Numbers | None = None,
    ) -> "Robot":
        """Return the robot with another known load, at its end-effector.

        For a load elsewhere: `robot.replace(tool=Tool(body, ...))`.

        Args:
            mass: Mass [kg].
            centre_of_mass: Centre of mass in the end-effector's frame [m].
            inertia: Inertia tensor about the centre of mass, along the end-effector's
                axes [kg m²]; a point mass if None.

        Raises:
            InputError: If the mass is not positive, or no body has such an inertia.
        """
        placed_tool = Tool(
            self.tip_body, mass=mass, centre_of_mass=centre_of_mass, inertia=inertia
        )
        load = placed_tool.body_inertia.moved(self.tip_rotation, self.tip_offset)
        tool = dataclasses.replace(
            placed_tool, centre_of_mass=load.centre, inertia=load.tensor
        )
        return self.replace(tool=tool)

    def with_sensor(
        self,
        rotation: Numbers | None = None,
        position: Numbers = (0.0, 0.0, 0.0),
        *,
        under_base: bool = False,
    ) -> "Robot":
        """Return the robot with a six-axis force sensor, whose wrench it measures.

        A body called `sensor` is then behind the end-effector's frame, and carries the
        end-effector; or one called `base` is between the ground and the arm. The wrench
        is that which the sensor exerts on this body, along the axes of the sensor's
        frame and about its origin: at rest its force points up.

        Args:
            rotation: Attitude of the sensor's frame in that of the end-effector or of
                the ground; the same if None.
            position: Origin of the sensor's frame there [m].
            under_base: Whether the sensor is under the base.

        Raises:
            InputError: If there is a sensor already, or its place is none.
        """
        attitude = np.eye(3) if rotation is None else rotation
        R = as_rotations("`rotation` of the sensor", attitude, (3, 3))
        r = as_finite_array("`position` of the sensor", position, (3,))
        return with_sensor(self, R, r, under_base=under_base)

    def joint_unit(self, joint: int) -> str:
        """Return the unit of a joint's coordinate: rad or m."""
        return "rad" if self.revolute[joint] else "m"

    def force_unit(self, joint: int) -> str:
        """Return the unit of a joint's generalised force: N m or N."""
        return "N m" if self.revolute[joint] else "N"

    def unit_columns(self) -> tuple[str, str, list[Column]]:
        """Return the units of coordinates and forces; if they differ, as columns."""
        units = [self.joint_unit(j) for j in self.driven]
        force_units = [self.force_unit(j) for j in self.driven]
        if len(set(units)) == 1:
            return units[0], force_units[0], []
        columns = [Column("unit", units), Column("force unit", force_units)]
        return "unit", "force unit", columns

    @property
    def remarks(self) -> list[Remark]:
        """Notes, of which those on bodies that nobody can have built are doubts."""
        remarks = []
        for note in self.notes:
            status = Status.DOUBTFUL if IMPOSSIBLE in note else Status.NEUTRAL
            remarks.append(Remark(note, status))
        return remarks

    def summary(self) -> Table:
        """Return a table of the driven joints: parents, ranges, speeds and forces."""
        names = ("ground", *self.body_names)
        unit, force_unit, units = self.unit_columns()
        joints = list(self.driven)
        facts = [("end-effector", f"on the body of `{names[self.tip_body + 1]}`")]
        if self.floating:
            facts = [("feet", ", ".join(contact.name for contact in self.contacts))]
        if self.tool is not None:
            carrier = names[self.tool.body + 1]
            text = f"{float(self.tool.mass):.3g} kg on the body of `{carrier}`"
            facts.append(("tool", text))
        if self.source:
            facts.append(("source", self.source))
        return Table(
            f"{self.name}: {len(self.driven)} joints",
            Column("joint", [self.joint_names[j] for j in joints]),
            Column("parent", [names[self.parent[j] + 1] for j in joints]),
            *units,
            Column("from", self.limits.position_min[joints], unit),
            Column("to", self.limits.position_max[joints], unit),
            Column("speed", self.limits.velocity[joints], f"{unit}/s"),
            Column("acceleration", self.limits.acceleration[joints], f"{unit}/s²"),
            Column("force", self.known_max_forces[joints], force_unit),
            facts=facts,
            remarks=self.remarks,
        )
