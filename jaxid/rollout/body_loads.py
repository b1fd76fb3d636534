"""Bodies that load a robot's joints: loads of a known motion, and scalar programs."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array
from jaxid.dynamics.model import Model
from jaxid.dynamics.projection_equation import solve_symmetric
from jaxid.dynamics.sample_methods import in_numpy
from jaxid.program import Program, trace
from jaxid.program.trace import FREE

from .dry_friction import Slip
from .motion import ServoMotion, smooth_rates


class Programs(NamedTuple):
    """Scalar programs of bodies that are simulated.

    Attributes:
        bodies: Mass matrix and bias forces from positions and velocities.
        derivatives: Both with their derivatives: of matrix and forces by positions, of
            the forces by velocities.
        solve: Velocities in a stage, as in `stage_velocities`; None without coupling.
    """

    bodies: Program
    derivatives: Program
    solve: Program | None


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Bodies that load the joints: a model with its parameters, often from a URDF file.

    Attributes:
        model: Model of the robot.
        parameters: Standard parameters.
        coupled: Whether inertial torques count, beside those of gravity.
    """

    model: Model
    parameters: AnyArray
    coupled: bool = False

    def matrix_and_bias(self, q: Array, v: Array) -> tuple[AnyArray, AnyArray]:
        """Return mass matrix and bias forces; without coupling, gravity alone."""
        model = self.model
        p = np.asarray(self.parameters)
        zero_velocity = jnp.zeros_like(q)
        if self.coupled:
            return model.inertia(p, q), model.bias(p, q, v)
        return jnp.zeros((len(q), len(q))), model.forces(
            p, q, zero_velocity, zero_velocity
        )

    @functools.cached_property
    def together(self) -> "Bodies":
        """The same bodies with their inertial torques."""
        return self if self.coupled else dataclasses.replace(self, coupled=True)

    @functools.cached_property
    def programs(self) -> Programs:
        """Programs of a simulation of these bodies."""
        n = self.model.robot.joints

        def terms_with_derivatives(q, v):
            by_q = jax.jacfwd(self.matrix_and_bias)(q, v)
            return *by_q, jax.jacfwd(lambda v: self.matrix_and_bias(q, v)[1])(v)

        bodies, derivatives = (
            trace(f, (n,), (n,)) for f in (self.matrix_and_bias, terms_with_derivatives)
        )
        solve = None
        if self.coupled:
            matrix = np.full(bodies.nonzeros[0].shape, FREE)
            matrix[~bodies.nonzeros[0]] = 0.0
            solve = trace(stage_velocities, matrix, *[(n,)] * 6, (), *[(n,)] * 2)
        return Programs(bodies, derivatives, solve)

    def loads(self, motion: ServoMotion) -> ServoMotion:
        """Return motions with the loads between two samples of measured positions."""
        q = np.asarray(motion.positions)
        load = np.zeros_like(q)
        inertia = np.zeros_like(q)
        model = self.model
        p = np.asarray(self.parameters)
        for k, dt in enumerate(map(float, motion.sample_time)):
            path, qd, qdd = (0.5 * (x[1:] + x[:-1]) for x in smooth_rates(q[k].T, dt))
            if self.coupled:
                M = in_numpy(model, model.inertia, path, shared=(p,))
                diagonals = np.diagonal(M, axis1=1, axis2=2)
                forces = (
                    in_numpy(model, model.forces, path, qd, qdd, shared=(p,))
                    - diagonals * qdd
                )
                inertia[k, :, :-1] = diagonals.T
            else:
                forces = in_numpy(
                    model, model.forces, path, 0 * qd, 0 * qd, shared=(p,)
                )
            load[k, :, :-1] = forces.T
        return motion.replace(load=load, inertia=inertia)


def stage_velocities(
    M, force, inertia, friction, resistance, scale, w, ahead, free, direction
) -> tuple[Array, Array, Array]:
    """Return velocities in a stage, and how the joints slip at these velocities.

    Args:
        M: Mass matrix over the time of the stage, rows and columns times `scale`.
        force: Forces on the joints over the stiffness.
        inertia: Inertia of each joint without the bodies.
        friction: Dry friction.
        resistance: Resistance of each joint without the bodies.
        scale: Root of the inverse stiffness.
        w: Velocities before the stage.
        ahead: Change of the velocity behind the stage over that in it.
        free: 1 for joints that move, 0 for those that friction holds.
        direction: Mean direction of the joints that move.
    """
    momentum = M @ (w / scale)
    A = M * jnp.outer(free, free) + jnp.diag(resistance * free + 1.0 - free)
    balance = (force + inertia * w - friction * direction) / scale + momentum
    u = scale * solve_symmetric(A, free * balance)
    diagonal = jnp.stack([M[j, j] for j in range(len(force))])
    coupling_force = scale * (momentum - M @ (u / scale)) - diagonal * (w - u)
    slip = Slip.of(
        force + coupling_force,
        inertia + diagonal,
        friction,
        resistance + diagonal,
        w,
        ahead,
    )
    return u, slip.free, slip.direction
