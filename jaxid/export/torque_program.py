r"""The feed-forward of a controller as a scalar program with few operations (Eq. 39).

The same robot can be described in many ways, with the same forces. Before the program
is traced, a description is chosen that leaves few operations:

* matter on a joint's axis moves alike with the bodies on both sides of it, so that it
  is carried inward until nothing is left of it: what remains are the base parameters;
* the origin of a frame may lie anywhere on its joint's axis (where axes meet, forces
  vanish);
* the frame of the last body may be turned about its joint so that a first moment
  vanishes;
* in a suitable unit of length, some lengths are one.
"""

import dataclasses
import functools
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from scipy.spatial.transform import Rotation

from jaxid.arrays import AnyArray, Float, Joints, double_precision
from jaxid.dynamics import projection_equation
from jaxid.dynamics.model import Model
from jaxid.identification.consistency.pseudo_inertia import (
    inertial_parameters,
    pseudo_inertia,
)
from jaxid.identification.fit_result import Fit
from jaxid.io import write_bytes
from jaxid.program import Lowered, Program, on_any_platform, trace
from jaxid.robot.robot import Robot


@dataclasses.dataclass(frozen=True)
class Description:
    """One of many descriptions of the same robot, with the same forces."""

    robot: Robot  # joints and frames, in the unit of length
    bodies: Float[np.ndarray, "joints 4 4"]  # pseudo-inertias
    turned: Float[
        np.ndarray, " joints"
    ]  # angles that are added to those of the joints [rad]
    unit: float = 1.0  # unit of length [m]

    @property
    def cost(self) -> int:
        """Estimate of the operations: numbers that are not zero, weighted by experience."""
        robot, turning = self.robot, np.zeros(self.robot.joints, bool)
        for i, parent in enumerate(robot.parent):
            turning[i] = parent >= 0 and (robot.revolute[parent] or turning[parent])
        # A length counts only in a frame that turns.
        lengths = np.abs(np.asarray(robot.offset))[turning]
        present = lengths > 1e-12
        ones = np.abs(lengths - 1.0) < 1e-12
        frames = 4 * present.any(axis=1).sum() + 6 * present.sum() - 3 * ones.sum()
        return int(frames + np.count_nonzero(self.bodies))

    def forces(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> Joints:
        """Return the generalised forces of the bodies at one sample [N m or N] (Eq. 11)."""
        scale = np.where(self.robot.revolute, 1.0, 1.0 / self.unit)
        p = inertial_parameters(_with_44_bits(self.bodies))
        motion = (scale * q + self.turned, scale * qd, scale * qdd)
        return scale * projection_equation.rigid_body_forces(self.robot, p, *motion)

    def carry_inward(self) -> "Description":
        """Move what moves alike with the parent to the parent: the base parameters (Eq. 22).

        For a revolute joint that is matter on the axis (mass, first and second moment
        along it), for a prismatic one the second moments.
        """
        bodies, robot = self.bodies.copy(), self.robot
        for i in reversed(range(robot.joints)):
            axis, P, L = np.asarray(robot.axis[i]), bodies[i], np.zeros((4, 4))
            if robot.revolute[i]:
                L[3, 3] = P[3, 3]
                L[:3, 3] = L[3, :3] = (axis @ P[:3, 3]) * axis
                L[:3, :3] = (axis @ P[:3, :3] @ axis) * axis[:, None] * axis
            else:
                L[:3, :3] = P[:3, :3]
            bodies[i] = _without_rounding(P - L, P)
            if robot.parent[i] >= 0:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = robot.rotation[i], robot.offset[i]
                bodies[robot.parent[i]] += T @ L @ T.T
        return dataclasses.replace(self, bodies=bodies)

    def slide(self, body: int, distance: float) -> "Description":
        """Move the origin of a frame along its joint's axis."""
        robot = self.robot
        axis, R = np.asarray(robot.axis[body]), np.asarray(robot.rotation[body])
        offset = np.array(robot.offset)
        offset[body] += R @ axis * distance
        for child, parent in enumerate(robot.parent):
            if parent == body:
                offset[child] -= axis * distance
        bodies, T = self.bodies.copy(), np.eye(4)
        T[:3, 3] = -axis * distance
        bodies[body] = T @ bodies[body] @ T.T
        moved = robot.replace(offset=_without_rounding(offset, offset))
        return dataclasses.replace(self, robot=moved, bodies=bodies)

    def turn_last(self, body: int) -> "Description":
        """Turn the frame of a last body about its joint until a first moment is zero."""
        axis, P = np.asarray(self.robot.axis[body]), self.bodies[body]
        h = P[:3, 3] - (axis @ P[:3, 3]) * axis
        if np.linalg.norm(h) == 0.0:
            return self
        k = int(np.argmin(np.abs(axis)))
        wanted = np.eye(3)[k] - axis[k] * axis
        wanted /= np.linalg.norm(wanted)
        angle = float(np.arctan2(axis @ np.cross(wanted, h), wanted @ h))
        bodies, turned, T = self.bodies.copy(), self.turned.copy(), np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(-angle * axis).as_matrix()
        bodies[body] = _without_rounding(T @ P @ T.T, P)
        turned[body] += angle
        return dataclasses.replace(self, bodies=bodies, turned=turned)

    def in_unit(self, unit: float) -> "Description":
        """Use another unit of length [m]; moments keep theirs."""
        robot, D = self.robot, np.diag([1.0, 1.0, 1.0, unit])
        offset, gravity = (
            np.asarray(robot.offset) / unit,
            np.asarray(robot.gravity) / unit,
        )
        return dataclasses.replace(
            self,
            robot=robot.replace(offset=offset, gravity=gravity),
            bodies=D @ self.bodies @ D,
            unit=self.unit * unit,
        )


def simplest_description(
    robot: Robot, parameters: Float[np.ndarray, "joints 10"]
) -> Description:
    """Return a description of a robot, with ten parameters of each body, of few operations."""
    given = Description(
        robot, np.asarray(pseudo_inertia(parameters)), np.zeros(robot.joints)
    )
    best = given.carry_inward()
    for body in range(robot.joints):
        for distance in _distances(given.robot, body):
            slid = given.slide(body, distance)
            if slid.carry_inward().cost < best.cost:
                given, best = slid, slid.carry_inward()
    for body in set(range(robot.joints)) - set(robot.parent):
        if robot.revolute[body]:
            best = min(best, best.turn_last(body), key=lambda x: x.cost)
    lengths = [
        round(float(abs(x)), 12) for x in np.ravel(best.robot.offset) if abs(x) > 1e-9
    ]
    units = sorted(set(lengths), key=lambda x: -lengths.count(x))
    return min([best, *map(best.in_unit, units[:3])], key=lambda x: x.cost)


def _distances(robot: Robot, body: int) -> Iterator[float]:
    """Return where the origin comes nearest to that of the parent, or of a child."""
    if not robot.revolute[body]:
        return
    axis, R = np.asarray(robot.axis[body]), np.asarray(robot.rotation[body])
    nearest = [-float((R @ axis) @ robot.offset[body])]
    nearest += [
        float(axis @ robot.offset[c]) for c, p in enumerate(robot.parent) if p == body
    ]
    yield from (x for x in dict.fromkeys(nearest) if abs(x) > 1e-9)


def _without_rounding(x: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Set to zero what cancels up to rounding, compared with the largest entry before."""
    return np.where(np.abs(x) < 1e-13 * np.abs(before).max(), 0.0, x)


def _with_44_bits(x: np.ndarray) -> np.ndarray:
    """Round numbers so that their sums are exact, and equal ones are found equal."""
    mantissa, exponent = np.frexp(x)
    return np.ldexp(np.round(mantissa * 2.0**44), exponent - 44)


def body_parameters(
    model: Model, p: Float[AnyArray, " standard"]
) -> Float[np.ndarray, "joints 10"]:
    """Return ten parameters of each body, with zeros for those that the model leaves out."""
    n = model.robot.joints
    bodies = np.zeros((n, 10))
    for term, own in model.split(np.asarray(p, np.float64)):
        if term.body_parameters:
            bodies[:, : term.body_parameters] += np.asarray(own).reshape(n, -1)
    return bodies


def other_forces(fit: Fit) -> Callable[..., Any]:
    """Return the function of one sample that gives the forces of all terms but the bodies."""
    model = fit.base.model

    def forces(q, qd, qdd, s=None):
        total, given = (
            jnp.zeros_like(q),
            model if s is None else model.with_memory(state=s),
        )
        for term, own in given.split(fit.standard_parameters):
            if not term.body_parameters:
                total = total + term.forces(model.robot, own, q, qd, qdd)
        return total

    return forces


def torques(fit: Fit) -> Callable[..., Any]:
    """Return the function of one sample that gives the forces of a fit in few operations."""
    model = fit.base.model
    bodies = body_parameters(model, fit.standard_parameters)
    description, others = simplest_description(model.robot, bodies), other_forces(fit)
    return lambda q, qd, qdd, s=None: (
        description.forces(q, qd, qdd) + others(q, qd, qdd, s)
    )


def torque_program(fit: Fit) -> Program:
    """Return the program of the feed-forward on base parameters (Eq. 39)."""
    return trace(torques(fit), *fit.base.model.input_shapes)


def exported_function(fit: Fit) -> export.Exported:
    """Return the forces of any number of samples as an exported function of JAX (Eq. 39).

    `exported.call(q, qd, qdd)` takes arrays [samples, joints] of float64 and returns
    forces of the same shape (with friction that has memory also its states, as
    `Presliding.states` gives them); `exported.serialize()` gives bytes that
    `jax.export.deserialize` reads elsewhere.

    Args:
        fit: Identified model.
    """
    program = torque_program(fit)

    # One sample at a time, since the number of samples is not known here.
    one = functools.partial(on_any_platform, program, Lowered.dense)
    on_samples = jax.jit(jax.vmap(one))
    with double_precision():
        (samples,) = export.symbolic_shape("samples")
        sizes = [(samples, *own) for own in program.input_shapes]
        shapes = [jax.ShapeDtypeStruct(size, np.float64) for size in sizes]
        return export.export(on_samples, platforms=("cpu", "cuda"))(*shapes)


def export_jax(fit: Fit, path: str | Path) -> Path:
    """Write the feed-forward as a function of JAX that runs without jaxid (Eq. 39).

    Read it with `jax.export.deserialize(bytearray(Path(path).read_bytes()))` in 64-bit
    mode.

    Args:
        fit: Identified model.
        path: Path of the file; an existing file is replaced.

    Raises:
        RuntimeError: If the package `flatbuffers` is not installed.
    """
    if importlib.util.find_spec("flatbuffers") is None:
        raise RuntimeError(
            "JAX needs `flatbuffers` to export: `pip install flatbuffers`."
        )
    write_bytes(path, bytes(exported_function(fit).serialize()))
    return Path(path)
