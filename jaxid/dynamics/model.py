"""Model: a robot and the terms of its equations of motion, linear in the parameters."""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Hashable,
    JointMatrix,
    Joints,
    ManyJoints,
    Texts,
    as_array,
    namespace,
)
from jaxid.errors import InputError
from jaxid.program import Program, Shape
from jaxid.program.sample_methods import on_samples, program_of, spatial_form
from jaxid.robot.contacts import legs_of
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.joint_coordinates import at_sample
from jaxid.robot.robot import Robot

from . import projection_equation
from .articulated_bodies import rigid_body_accelerations
from .motion import Motion, as_motion, as_state
from .packed_regressor import PackedRegressor, gram
from .terms import (
    AbstractTerm,
    CoulombFriction,
    Presliding,
    RigidBodies,
    RotorInertia,
    ViscousFriction,
)
from .terms.dry_friction_transitions import is_open
from .terms.term import NamesAndUnits, TermParameters

Coordinates = ManyJoints | Sequence[Any]
Parameters = Float[AnyArray, " standard"] | Sequence[float | int]

DEFAULT_TERMS = (RigidBodies(), ViscousFriction(), CoulombFriction(), RotorInertia())


MAX_JOINTS_OF_MATRIX = 12
"""Joints up to which forward dynamics takes the mass matrix: its program is shorter."""


def _has_memory(part: Any):
    """Return whether a part of a term is the law of friction with memory."""
    return isinstance(part, Presliding)


class Model(Hashable):
    r"""The equations of motion $\Theta(q, \dot q, \ddot q)\, p = Q_m$ (Eqs. 16, 18).

    The columns stand in the order of the terms, the paper's order by default: bodies,
    viscous, Coulomb, rotors. Every method takes any leading batch axes, which
    broadcast, and works under `jit`, `vmap`, `grad`, `jvp` and `scan`, also with
    respect to the robot's geometry. NumPy arrays give NumPy arrays; arrays of JAX stay
    on their device. For few samples a method runs in NumPy at once; for many it is
    compiled for the robot, whose numbers are then constants: write
    `jax.jit(model.regressor)` rather than pass the model to what is compiled. Inverse
    and forward dynamics take a `Motion` or its arrays, one after the other.

    Attributes:
        robot: Known geometry, limits and drives.
        terms: Effects that are linear in unknown parameters.
    """

    robot: Robot
    terms: tuple[AbstractTerm, ...] = DEFAULT_TERMS

    def __check_init__(self):
        names = self.parameter_names
        if not self.terms:
            raise InputError("`terms` must hold at least one term, but is empty.")
        if len(set(names)) != len(names):
            name = next(name for name in names if names.count(name) > 1)
            raise InputError(
                "`terms` must not contribute the same "
                f"parameter twice, but `{name}` comes twice."
            )

    @property
    def parameters(self) -> NamesAndUnits:
        """Names and units of all standard parameters."""
        return tuple(p for term in self.terms for p in term.parameters(self.robot))

    @property
    def parameter_names(self) -> Texts:
        """Names of the standard parameters, in the order of the columns."""
        return tuple(name for name, _ in self.parameters)

    @property
    def parameter_units(self) -> Texts:
        """Units of the standard parameters."""
        return tuple(unit for _, unit in self.parameters)

    @property
    def size(self) -> int:
        """Number of standard parameters."""
        return len(self.parameters)

    def split(self, p: AnyArray) -> list[tuple[AbstractTerm, TermParameters]]:
        """Return each term with its parameters.

        Raises:
            InputError: If there is not one number for each standard parameter.
        """
        sizes = [len(term.parameters(self.robot)) for term in self.terms]
        if p.shape != (sum(sizes),):
            raise InputError(
                f"`p` must hold {sum(sizes)} standard "
                f"parameters, but has shape {p.shape}."
            )
        parts = []
        start = 0
        for term, size in zip(self.terms, sizes, strict=True):
            parts.append((term, p[start : start + size]))
            start += size
        return parts

    @property
    def memory(self) -> Presliding | None:
        """Law of the friction with memory; None without such friction.

        Raises:
            InputError: If terms have different lengths.
        """
        parts = jax.tree.leaves(self.terms, is_leaf=_has_memory)
        laws = {part for part in parts if _has_memory(part)}
        if len(laws) > 1:
            raise InputError("all terms with `Presliding` must share one `Presliding`.")
        return next(iter(laws), None)

    @property
    def input_shapes(self) -> list[Shape]:
        """Shapes of the arguments of `columns`."""
        robot = self.robot
        standstill = np.zeros(robot.joints)
        law = self.memory
        size = 0 if law is None else law.settled(standstill).shape[0]
        size += legs_of(robot).entries if robot.contacts else 0
        coordinates = robot.bodies if robot.loops else robot.joints
        states = [(size,)] if size else []
        return [(coordinates,), standstill.shape, standstill.shape, *states]

    def with_memory(self, **changes: Any) -> "Model":
        """Return the model with other fields of `memory`, such as `length`."""

        def change(part):
            return dataclasses.replace(part, **changes) if _has_memory(part) else part

        terms = jax.tree.map(change, self.terms, is_leaf=_has_memory)
        return dataclasses.replace(self, terms=terms)

    def with_transition_speeds(self, speeds: Joints | float) -> "Model":
        """Return the model with speeds of the transitions for which none are given."""

        def change(part):
            return dataclasses.replace(part, epsilon=speeds) if is_open(part) else part

        terms = jax.tree.map(change, self.terms, is_leaf=is_open)
        return dataclasses.replace(self, terms=terms)

    def arguments(self, motion: Motion) -> tuple[AnyArray, ...]:
        """Return the arguments of `columns`: with the state if forces depend on one.

        Where a motion does not have the state of friction with memory, its samples are
        a path in the order of time; without that of contacts, no foot stands.
        """
        # A look-up of a method takes longer than checking a few numbers.
        check = self.closed if self.robot.loops else self.check
        q = check(motion.q)
        law = self.memory
        state = motion.state
        if law is not None and state is None:
            if motion.qd.ndim == 1:
                state = law.settled(motion.qd)
            else:
                start = law.settled(motion.qd[..., 0, :])
                state = law.states(motion.q, start)
        contacts = motion.contacts
        if self.robot.contacts and contacts is None:
            entries = legs_of(self.robot).entries
            contacts = np.zeros((*motion.q.shape[:-1], entries))
        states = [x for x in (state, contacts) if x is not None]
        if len(states) == 2:
            states = [namespace(*states).concatenate(states, axis=-1)]
        return (q, motion.qd, motion.qdd, *states)

    def columns(self, q, qd, qdd, s=None) -> AnyArray:
        r"""Return the regressor $\Theta$ of one sample by definition (Eqs. 16, 18)."""
        robot, q = at_sample(self.robot, q)
        terms = self._in_state(s).terms
        theta = jnp.concatenate([t.columns(robot, q, qd, qdd) for t in terms], axis=1)
        return self._without_contacts(theta, s)

    def forces(self, p, q, qd, qdd, s=None) -> Joints:
        """Return the generalised forces of one sample by definition (Eqs. 11, 15)."""
        robot, q = at_sample(self.robot, q)
        parts = self._in_state(s).split(p)
        forces = reduce(add, (t.forces(robot, x, q, qd, qdd) for t, x in parts))
        return self._without_contacts(forces, s)

    def _in_state(self, s: AnyArray | None) -> "Model":
        """Return the model with the state of friction with memory, if it has some."""
        has_state = s is not None and self.memory is not None
        return self.with_memory(state=s) if has_state else self

    def _without_contacts(self, rows: Any, s: AnyArray | None) -> AnyArray:
        """Return rows without the forces of feet that stand (see `contacts`)."""
        if s is None or not self.robot.contacts:
            return rows
        legs = legs_of(self.robot)
        shape = (len(legs.rows), len(legs.joints))
        X = s[s.shape[0] - legs.entries :].reshape(shape)
        base_rows = np.array(legs.rows)
        return rows.at[base_rows].add(-X @ rows[np.array(legs.joints)])

    def inertia(self, p, q) -> JointMatrix:
        """Return the mass matrix of one sample by definition (Eq. 38)."""
        robot, q = at_sample(self.robot, q)
        return reduce(add, (t.mass_matrix(robot, x, q) for t, x in self.split(p)))

    def bias(self, p, q, qd, s=None) -> Joints:
        """Return the bias forces of one sample by definition (Eq. 38)."""
        return self.forces(p, q, qd, jnp.zeros_like(qd), s)

    def acceleration(self, p, q, qd, forces) -> Joints:
        """Return the accelerations of one sample that forces cause (Eq. 38)."""
        return projection_equation.solve_symmetric(
            self.inertia(p, q), forces - self.bias(p, q, qd)
        )

    def drive_inertia(self, p, q) -> JointMatrix:
        """Return the part of the mass matrix that is not that of the bodies."""
        matrices = [
            term.mass_matrix(self.robot, x, q)
            for term, x in self.split(p)
            if term.inertial_parameters(self.robot, x) is None
        ]
        n = self.robot.joints
        return reduce(add, matrices, jnp.zeros((n, n), q.dtype))

    def derived_program(self, name: str, *shapes: Shape) -> Program | None:
        """Return the program of the method `acceleration` of many joints, else None."""
        if name != "acceleration" or self.robot.joints <= MAX_JOINTS_OF_MATRIX:
            return None
        if self.robot.followers:
            return None
        p, q, *_ = shapes
        nonzeros = np.asarray(program_of(self, self.drive_inertia, p, q).nonzeros)
        if (nonzeros & ~np.eye(len(nonzeros), dtype=bool)).any():
            return None
        model = ArticulatedModel(self.robot, self.terms)
        return program_of(model, model.acceleration, *shapes)

    def potential(self, p, q) -> AnyArray:
        """Return the potential energy of one sample by definition."""
        robot, q = at_sample(self.robot, q)
        parts = self.split(p)
        return reduce(add, (t.potential_columns(robot, q) @ x for t, x in parts))

    @property
    def spatial_form(self) -> "SpatialModel":
        """The same model by spatial vectors."""
        return SpatialModel(self.robot, spatial_form(self.terms))

    def known_forces(self, q, qd, qdd, s=None) -> Joints:
        """Return the generalised forces of the known tool at one sample [N m or N]."""
        tool = self.robot.tool
        if tool is None:
            return jnp.zeros_like(qd)
        bodies: list[AnyArray] = [np.zeros(10)] * self.robot.bodies
        bodies[tool.body] = tool.parameters
        p = namespace(tool.parameters).stack(bodies)
        forces = projection_equation.rigid_body_forces(self.robot, p, q, qd, qdd)
        return self._without_contacts(forces, s)

    def regressor(self, motion: Motion) -> AnyArray:
        r"""Return the regressor $\Theta(q, \dot q, \ddot q)$ (Eqs. 16, 18).

        Its shape is [*batch, joints, standard].

        Args:
            motion: Joint motion at any number of instants.
        """
        return on_samples(self, self.columns, *self.arguments(motion))

    def packed_regressor(self, motion: Motion) -> PackedRegressor:
        r"""Return the stacked regressor $\bar\Theta$ without its zeros (Eq. 26).

        Several times as fast as `regressor`, whose dense matrix costs more than its
        entries.

        Args:
            motion: Joint motion [samples, joints].

        Raises:
            InputError: If the motion does not have one axis of samples, or JAX is
                tracing the robot's geometry.
        """
        return PackedRegressor(self, self.columns, *self.arguments(motion))

    def gram(self, motion: Motion, weights: Joints | None = None) -> AnyArray:
        r"""Return the information $\sum_k \Theta_k^T W^2 \Theta_k$ (Eq. 29).

        Takes a small part of the time of the regressor, which is never held in memory.

        Args:
            motion: Joint motion [samples, joints].
            weights: Weight of each joint's rows [1/(N m) or 1/N]; 1 if None.
        """
        return gram(self, self.columns, weights, *self.arguments(motion))

    def inverse_dynamics(
        self, p: Parameters, *motion: Motion | Coordinates
    ) -> ManyJoints:
        r"""Return the forces $\Theta p$ [N m or N], without forming $\Theta$ (Eq. 16).

        Args:
            p: Standard parameters.
            motion: A motion at any number of instants, or joint coordinates, velocities
                and accelerations.
        """
        arguments = self.arguments(as_motion(*motion))
        return on_samples(self, self.forces, *arguments, shared=(p,))

    def mass_matrix(self, p: Parameters, q: Coordinates) -> AnyArray:
        r"""Return the mass matrix $M(q)$, rotors included (Eq. 38).

        Args:
            p: Standard parameters.
            q: Joint coordinates [rad or m].
        """
        return on_samples(self, self.inertia, self.closed(q), shared=(p,))

    def bias_forces(self, p: Parameters, *state: Motion | Coordinates) -> ManyJoints:
        r"""Return the forces $h(q, \dot q)$ at zero acceleration [N m or N] (Eq. 38).

        Args:
            p: Standard parameters.
            state: A motion, whose accelerations do not matter, or joint coordinates and
                velocities.
        """
        q, qd = as_state(*state)
        return on_samples(self, self.bias, self.closed(q), self.check(qd), shared=(p,))

    def forward_dynamics(self, p: Parameters, *state_and_forces: Any) -> ManyJoints:
        r"""Return the accelerations $M^{-1} (Q_m - h)$ that forces cause (Eq. 38).

        Args:
            p: Standard parameters of bodies that can exist.
            state_and_forces: A motion, whose accelerations do not matter, or joint
                coordinates and velocities; then the generalised forces of the drives
                [N m or N].
        """
        *state, forces = state_and_forces
        q, qd = as_state(*state)
        samples = (self.closed(q), self.check(qd), self.check(forces))
        return on_samples(self, self.acceleration, *samples, shared=(p,))

    def kinetic_energy(self, p: Parameters, *state: Motion | Coordinates) -> AnyArray:
        r"""Return the kinetic energy $\frac12 \dot q^T M \dot q$ [J].

        Args:
            p: Standard parameters.
            state: A motion, whose accelerations do not matter, or joint coordinates and
                velocities.
        """
        q, qd = as_state(*state)
        M = self.mass_matrix(p, q)
        qd = self.check(qd)
        return 0.5 * jnp.einsum("...i,...ij,...j->...", qd, M, qd)

    def potential_energy(self, p: Parameters, q: Coordinates) -> AnyArray:
        """Return the potential energy [J], zero at the ground's origin."""
        return on_samples(self, self.potential, self.closed(q), shared=(p,))

    def tool_forces(self, motion: Motion) -> ManyJoints:
        """Return the forces of the known tool [N m or N]; zero without a tool."""
        return on_samples(self, self.known_forces, *self.arguments(motion))

    def closed(self, q: Coordinates) -> AnyArray:
        """Return coordinates as `check`, but those of all joints where loops move some.

        Where they are given already (`Robot.close`), they are taken as they are.

        Raises:
            InputError: If the last axis has another length, or loops do not close.
        """
        robot = self.robot
        if robot.loops and np.shape(q)[-1:] == (robot.bodies,):
            return as_array("q", q)
        q = self.check(q)
        return robot.close(q) if robot.loops else q

    def check(self, q: Coordinates) -> ManyJoints:
        """Return coordinates as an array with one number for each joint.

        Raises:
            InputError: If the last axis has another length.
        """
        q = as_array("q", q)
        if q.shape[-1:] != (self.robot.joints,):
            raise InputError(
                f"`motion` must have {self.robot.joints} joints "
                f"along its last axis, but has shape {q.shape}."
            )
        return q


class ArticulatedModel(Model):
    """A model by articulated bodies: the shortest program of many joints."""

    def derived_program(self, name: str, *shapes: Shape) -> Program | None:
        """Return None: its programs follow from no others."""
        return None

    def acceleration(self, p, q, qd, forces):
        """Return the accelerations of one sample that forces cause (Eq. 38)."""
        robot = self.robot
        standstill = jnp.zeros_like(q)
        bodies = jnp.zeros((robot.bodies, len(INERTIAL_NAMES)), q.dtype)
        for term, x in self.split(p):
            term_bodies = term.inertial_parameters(robot, x)
            if term_bodies is None:
                forces = forces - term.forces(robot, x, q, qd, standstill)
            else:
                bodies = bodies + term_bodies
        diagonal = np.arange(robot.joints)
        rotors = self.drive_inertia(p, q)[diagonal, diagonal]
        return rigid_body_accelerations(robot, bodies, rotors, q, qd, forces)


class SpatialModel(Model):
    """A model by spatial vectors, for derivatives and traced geometry."""

    def acceleration(self, p, q, qd, forces):
        """Return the accelerations of one sample that forces cause (Eq. 38)."""
        factor = jax.scipy.linalg.cho_factor(self.inertia(p, q))
        return jax.scipy.linalg.cho_solve(factor, forces - self.bias(p, q, qd))
