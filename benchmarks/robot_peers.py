"""Robots of URDF files in Pinocchio, and of MJCF files in MuJoCo: their forces."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lxml import etree

EFFECTS = {
    "jnt_stiffnesspoly": ("joint", "a stiffness that depends on the deflection"),
    "jnt_springyield": ("joint", "a spring that yields"),
    "dof_dampingpoly": ("joint", "a damping that depends on the speed"),
    "tendon_stiffness": ("tendon", "stiffness"),
    "tendon_stiffnesspoly": ("tendon", "a stiffness that depends on the deflection"),
    "tendon_damping": ("tendon", "damping"),
    "tendon_dampingpoly": ("tendon", "a damping that depends on the speed"),
    "tendon_frictionloss": ("tendon", "dry friction"),
    "tendon_armature": ("tendon", "inertia"),
    "actuator_armature": ("actuator", "inertia of several joints"),
    "actuator_damping": ("actuator", "damping of several joints"),
    "actuator_dampingpoly": ("actuator", "a damping that depends on the speed"),
    "body_gravcomp": ("body", "`gravcomp`"),
}
"""MuJoCo's arrays of effects that a note may name: kind of their elements, words."""


class Follower(NamedTuple):
    """Joint whose coordinate is a polynomial of that of another one.

    Attributes:
        joint: Name of the joint.
        master: Name of the joint that it follows; "" if it stands still.
        polynomial: Coefficients, the highest power first.
    """

    joint: str
    master: str
    polynomial: np.ndarray


def is_named(name: str, words: str, notes: Iterable[str]) -> bool:
    """Return whether a note names an element together with its effect."""
    return any(f"`{name}`" in note and words in note for note in notes)


def leaves_out_negative(notes: Iterable[str]) -> bool:
    """Return whether a note says that negative friction is not used."""
    return any("is negative and is not used" in note for note in notes)


class Peer:
    """Model of a file in another program.

    Attributes:
        followers: Joints that follow others.
    """

    followers: list[Follower]

    def links(self) -> list[str]:
        """Return the names of links, the end of the longest chain first."""
        raise NotImplementedError

    def leave_out(self, notes: Iterable[str]) -> None:
        """Switch off the effects that notes name."""
        raise NotImplementedError

    def keep_chain(self, base: str | None, tip: str | None) -> None:
        """Take away the mass of links that do not belong to a chain."""
        raise NotImplementedError

    def held_at(self, joint: str) -> float:
        """Return the coordinate of a joint nearest to zero."""
        raise NotImplementedError

    def sample_forces(self, motion: dict[str, np.ndarray]) -> dict[str, float]:
        """Return the force of every joint, whose q, qd, qdd stand by its name."""
        raise NotImplementedError

    def forces(self, names: Iterable[str], motion: Any, hold: bool) -> np.ndarray:
        """Return the forces of named joints; those of their followers count.

        Args:
            names: Names of the joints that move.
            motion: Motion of these joints.
            hold: Whether followers stand still, where their masters are held.
        """
        rows = []
        for q, qd, qdd in zip(motion.q, motion.qd, motion.qdd, strict=True):
            coordinates = dict(zip(names, np.stack([q, qd, qdd], axis=1), strict=True))
            slopes = {} if hold else self._move_followers(coordinates)
            for follower in self.followers:
                if follower.joint not in coordinates:
                    place = np.array([self._held_follower(follower), 0.0, 0.0])
                    coordinates[follower.joint] = place
            forces = self.sample_forces(coordinates)
            row = {name: forces[name] for name in names}
            for joint, (master, slope) in slopes.items():
                row[master] += slope * forces[joint]
            rows.append(list(row.values()))
        return np.array(rows)

    def _move_followers(self, coordinates: dict[str, np.ndarray]):
        """Enter followers of moving joints; return their masters, and their speeds."""
        slopes: dict[str, tuple[str, float]] = {}
        for _ in self.followers:
            for joint, master, polynomial in self.followers:
                if joint in coordinates or master not in coordinates:
                    continue
                q, qd, qdd = coordinates[master]
                slope = np.polyval(np.polyder(polynomial), q)
                curvature = np.polyval(np.polyder(polynomial, 2), q)
                acceleration = slope * qdd + curvature * qd**2
                value = np.polyval(polynomial, q)
                coordinates[joint] = np.array([value, slope * qd, acceleration])
                # A follower of a follower moves with the master of both.
                leader, leader_slope = slopes.get(master, (master, 1.0))
                slopes[joint] = leader, slope * leader_slope
        return slopes

    def _held_follower(self, follower: Follower) -> float:
        """Return the coordinate of a follower whose master is held."""
        masters = {x.joint: x for x in self.followers}
        if follower.master == follower.joint or not follower.master:
            return np.polyval(follower.polynomial, 0.0)
        master = masters.get(follower.master)
        place = (
            self.held_at(follower.master)
            if master is None
            else self._held_follower(master)
        )
        return np.polyval(follower.polynomial, place)


class Pinocchio(Peer):
    """URDF file in Pinocchio."""

    def __init__(self, path: Path):
        import pinocchio

        self.library = pinocchio
        self.model = pinocchio.buildModelFromUrdf(str(path))
        self.followers = []
        # As tolerant as the parsers of robots' programs.
        root = etree.fromstring(path.read_bytes(), etree.XMLParser(recover=True))
        for joint in root.iterfind("joint"):
            mimic = joint.find("mimic")
            if mimic is None or not self.model.existJointName(joint.get("name")):
                continue
            factor = float(mimic.get("multiplier", 1.0))
            offset = float(mimic.get("offset", 0.0))
            master = mimic.get("joint")
            if not self.model.existJointName(master):
                master = ""
            follower = Follower(joint.get("name"), master, np.array([factor, offset]))
            self.followers.append(follower)

    def links(self):
        """Return the names of links, the end of the longest chain first."""
        bodies = [
            frame
            for frame in self.model.frames
            if frame.type == self.library.FrameType.BODY
        ]
        bodies.sort(key=lambda frame: -len(self.model.supports[frame.parentJoint]))
        return [frame.name for frame in bodies]

    def leave_out(self, notes):
        """Take away links that float, and negative friction, if notes say so."""
        for index, joint in enumerate(self.model.joints):
            if joint.nv == 6 and "as objects that float freely" in " ".join(notes):
                self.model.inertias[index] = self.library.Inertia.Zero()
        for array in (self.model.damping, self.model.upperDryFrictionLimit):
            array[leaves_out_negative(notes) & (array < 0.0)] = 0.0

    def keep_chain(self, base, tip):
        """Take away the mass of links that do not belong to a chain."""
        if tip is None:
            return
        ends = []
        for link in (base, tip):
            if link is None:
                ends.append({0})
                continue
            frame = self.model.frames[self.model.getFrameId(link)]
            ends.append(set(self.model.supports[frame.parentJoint]))
        above, chain = ends
        for joint, supports in enumerate(self.model.supports):
            if not set(supports) - above <= chain:
                self.model.inertias[joint] = self.library.Inertia.Zero()

    def held_at(self, joint):
        """Return the coordinate of a joint nearest to zero."""
        place = self.model.idx_qs[self.model.getJointId(joint)]
        low = self.model.lowerPositionLimit[place]
        high = self.model.upperPositionLimit[place]
        if self.model.joints[self.model.getJointId(joint)].nq == 2 or low > high:
            return 0.0
        return float(np.clip(0.0, low, high))

    def sample_forces(self, motion):
        """Return the force of every joint, whose q, qd, qdd stand by its name."""
        model = self.model
        tangents = np.zeros((3, model.nv))
        place = {name: model.idx_vs[i] for i, name in enumerate(model.names) if i}
        for name, joint in zip(model.names[1:], model.joints[1:], strict=True):
            if name in motion:
                tangents[:, place[name]] = motion[name]
            elif joint.nv == 1:
                tangents[0, place[name]] = self.held_at(name)
        q, qd, qdd = tangents
        configuration = self.library.integrate(model, self.library.neutral(model), q)
        forces = self.library.rnea(model, model.createData(), configuration, qd, qdd)
        forces = forces + model.damping * qd
        forces = forces + model.upperDryFrictionLimit * np.sign(qd)
        return {name: forces[place[name]] for name in place}


class Mujoco(Peer):
    """MJCF file in MuJoCo."""

    def __init__(self, path: Path):
        import mujoco

        self.library = mujoco
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)
        flags = mujoco.mjtDisableBit
        disabled = self.model.opt.disableflags
        if disabled & (flags.mjDSBL_FRICTIONLOSS | flags.mjDSBL_CONSTRAINT):
            self.model.dof_frictionloss[:] = 0.0
        constraints = np.flatnonzero(self.model.eq_active0)
        if disabled & (flags.mjDSBL_EQUALITY | flags.mjDSBL_CONSTRAINT):
            constraints = []
        # Limits and contacts are no part of the robot; dry friction is added.
        self.model.opt.disableflags |= flags.mjDSBL_CONSTRAINT
        self.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
        kind = int(mujoco.mjtEq.mjEQ_JOINT)
        self.followers = [
            self._follower(int(constraint))
            for constraint in constraints
            if self.model.eq_type[constraint] == kind
        ]

    def _follower(self, constraint: int):
        """Return the joint that a constraint couples to another."""
        model = self.model
        joint = model.eq_obj1id[constraint]
        master = model.eq_obj2id[constraint]
        powers = np.poly1d(model.eq_data[constraint, 4::-1])
        refs = model.qpos0[model.jnt_qposadr]
        if master < 0:
            powers = np.poly1d([powers(0.0)])
        else:
            powers = powers(np.poly1d([1.0, -refs[master]]))
        polynomial = np.atleast_1d((powers + refs[joint]).coefficients)
        master_name = "" if master < 0 else self._name("joint", master)
        return Follower(self._name("joint", joint), master_name, polynomial)

    def _name(self, kind: str, index: int):
        """Return the name of an element, or its number if it has none."""
        return getattr(self.model, kind)(index).name or f"{kind}{index}"

    def links(self):
        """Return the names of links, the end of the longest chain first."""
        bodies = range(1, self.model.nbody)
        return [self._name("body", body) for body in sorted(bodies, key=self._depth)]

    def _path(self, body: int):
        """Return the joints that move a body."""
        joints = set()
        while body > 0:
            first = self.model.body_jntadr[body]
            joints |= set(range(first, first + self.model.body_jntnum[body]))
            body = self.model.body_parentid[body]
        return joints

    def _depth(self, body: int):
        """Return the number of joints that move a body, with a minus."""
        return -len(self._path(body))

    def leave_out(self, notes):
        """Switch off the effects that notes name."""
        model = self.model
        for array, (kind, words) in EFFECTS.items():
            values = np.asarray(getattr(model, array, []))
            for row in np.unique(np.argwhere(values)[:, 0]):
                element = model.dof_jntid[row] if array.startswith("dof") else row
                names = [self._name(kind, element)]
                if kind == "actuator":
                    names.append(self._name("joint", model.actuator_trnid[row, 0]))
                if any(is_named(name, words, notes) for name in names):
                    values[row] = 0.0
        if is_named("density", "the resistance of a medium", notes):
            model.opt.density = 0.0
            model.opt.viscosity = 0.0
        for array in (model.dof_damping, model.dof_frictionloss):
            array[leaves_out_negative(notes) & (array < 0.0)] = 0.0

    def keep_chain(self, base, tip):
        """Take away the mass of links that do not belong to a chain."""
        if tip is None:
            return
        model = self.model
        names = [self._name("body", body) for body in range(model.nbody)]
        sites = [model.site(i).name for i in range(model.nsite)]
        above = set() if base is None else self._path(names.index(base))
        end = names.index(tip) if tip in names else model.site_bodyid[sites.index(tip)]
        chain = self._path(int(end))
        for body in range(model.nbody):
            if not self._path(body) - above <= chain:
                model.body_mass[body] = 0.0
                model.body_inertia[body] = 0.0

    def held_at(self, joint):
        """Return the coordinate of a joint nearest to zero."""
        names = [self._name("joint", i) for i in range(self.model.njnt)]
        index = names.index(joint)
        if not self.model.jnt_limited[index]:
            return 0.0
        return float(np.clip(0.0, *self.model.jnt_range[index]))

    def sample_forces(self, motion):
        """Return the force of every joint, whose q, qd, qdd stand by its name."""
        model = self.model
        data = self.data
        self.library.mj_resetData(model, data)
        places = {}
        for joint in range(model.njnt):
            name = self._name("joint", joint)
            if model.jnt_type[joint] < int(self.library.mjtJoint.mjJNT_SLIDE):
                continue  # it floats, where the file puts it
            dof = model.jnt_dofadr[joint]
            places[name] = dof
            held = np.array([self.held_at(name), 0.0, 0.0])
            q, qd, qdd = motion.get(name, held)
            data.qpos[model.jnt_qposadr[joint]] = q
            data.qvel[dof] = qd
            data.qacc[dof] = qdd
        self.library.mj_inverse(model, data)
        friction = model.dof_frictionloss * np.sign(data.qvel)
        forces = data.qfrc_inverse + friction
        return {name: forces[dof] for name, dof in places.items()}


def open_peer(path: Path) -> Peer:
    """Return the model of a file in Pinocchio or MuJoCo."""
    return Pinocchio(path) if path.suffix == ".urdf" else Mujoco(path)
