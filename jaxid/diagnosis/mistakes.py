"""Likely mistakes in the description of a log or a robot, found by the model itself.

Every possible mistake is corrected in turn, and the model is fitted anew to some instants of the
log, with friction that takes energy from the robot, as all friction does. Without that condition a
wrong sign would only change signs of parameters where joints are hardly coupled.
"""

import itertools
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.identification.fit_result import Fit
from jaxid.result_table import significant
from jaxid.robot.robot import Robot

BAD = 0.03
"""Fraction (0 to 1) of the forces left unexplained from which mistakes are looked for."""
FAR = 0.15
"""Fraction (0 to 1) of the forces that no model misses whose description is right."""
MOST = 0.5
"""Fraction (0 to 1) of what a model misses that may be left by the correction of a mistake."""
MANY = 12
"""Number of joints above which no two joints, and no axes, are examined: they would be too many."""
ALIKE, CLEAR = 1.05, 1.5
"""Ratios of what two corrections leave up to which they are the same, and from which one is not."""


class Correction(NamedTuple):
    """Correction of a possible mistake.

    Attributes:
        text: The mistake, as a clause.
        robot: The robot without the mistake.
        motion: Motion of the log without it.
        forces: Forces of the log without it [N m or N].
    """

    text: str
    robot: Robot
    motion: Motion
    forces: np.ndarray


def likely_mistakes(
    fit: Fit, motion: Motion, forces: np.ndarray, motor_sides: tuple[bool, bool]
) -> tuple[str, ...]:
    """Return a sentence about the mistake that explains most of what a model misses, or nothing.

    Args:
        fit: Fit of the robot's model.
        motion: Joint motion at some instants of a log.
        forces: Forces at these instants [N m or N].
        motor_sides: Whether angles and forces of the log are taken for the motors'.
    """
    model = fit.base.model
    robot = model.robot
    geometries: dict[tuple[bool, ...], _AnyGeometry] = {}

    def rest(c: Correction) -> float:
        kinds = c.robot.revolute
        if kinds not in geometries:
            geometries[kinds] = _AnyGeometry(Model(c.robot, model.terms))
        columns = geometries[kinds](c.robot, c.motion)
        return _unexplained(*columns, c.forces, model.parameter_names)

    left = rest(Correction("", robot, motion, forces))
    if left < BAD:
        return ()
    candidates = [
        *_of_columns(robot, motion, forces, motor_sides),
        *_of_robot(robot, motion, forces),
        *(_of_kinds(robot, motion, forces) if left > FAR else ()),
    ]
    tried = sorted(((rest(c), c.text) for c in candidates), key=lambda pair: pair[0])
    best = tried[0][0]
    likely = [text for value, text in tried if value <= ALIKE * best]
    others = [value for value, _ in tried[len(likely) :]]
    # With more than three candidates nothing is known.
    clear = len(likely) <= 3 and min(others, default=np.inf) >= CLEAR * best
    if clear and best <= min(MOST * left, FAR):
        return (
            f"{', or '.join(likely)}: the model then misses {100 * best:.2g} % of the forces "
            f"instead of {100 * left:.2g} %.",
        )
    return _misfit(fit, motion, forces, left)


def _misfit(fit: Fit, motion: Motion, forces: np.ndarray, left: float) -> tuple[str, ...]:
    """Return a sentence about where a model does not fit, or nothing if it misses little."""
    if left < FAR:
        return ()
    errors = forces - fit.predict(motion) - fit.base.tool_forces(motion)
    size = np.sqrt(np.mean(forces**2, axis=0))
    missed = np.sqrt(np.mean(errors**2, axis=0)) / np.where(size > 0, size, np.inf)
    worst = int(np.argmax(missed))
    return (
        f"the model does not fit: it misses {significant(100 * left, 2)} % of the forces, most of "
        f"all those of joint `{fit.base.model.robot.joint_names[worst]}`, and no single mistake in "
        "signs, order, units, offsets, axes or gravity explains that.",
    )


def _of_columns(
    robot: Robot, motion: Motion, forces: np.ndarray, sides: tuple[bool, bool]
) -> Iterator[Correction]:
    """Yield corrections of the columns of a log."""
    drives = robot.drives
    names = robot.joint_names
    n = robot.joints
    eye = np.eye(n)
    columns = [motion.q, motion.qd, motion.qdd]
    torques = forces
    if sides[0]:
        columns = [drives.motor_angles(motion.q), *map(drives.motor_velocities, columns[1:])]
    if sides[1]:
        torques = drives.motor_torques(forces)

    def without(text: str, angles: np.ndarray = eye, forces: np.ndarray = eye, sides=sides):
        """Return a correction with other combinations of the log's columns."""
        q, qd, qdd = (x @ angles for x in columns)
        f = torques @ forces
        if sides[0]:
            q, qd, qdd = drives.joint_angles(q), *map(drives.joint_velocities, (qd, qdd))
        f = drives.joint_forces(f) if sides[1] else f
        return Correction(text, robot, Motion(q, qd, qdd), np.asarray(f))

    for j, name in enumerate(names):
        change = np.diag(np.where(np.arange(n) == j, -1.0, 1.0))
        key = f"of joint `{name}` seems to be wrong (`recording."
        yield without(f"the sign of the force {key}force_signs`)", forces=change)
        yield without(f"the sign of the angle {key}angle_signs`)", change)
    # The number of pairs grows with the square.
    for i, j in itertools.combinations(range(n), 2) if n <= MANY else ():
        change = np.eye(n)
        change[[i, j]] = change[[j, i]]
        key = f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        yield without(f"the forces {key}forces`)", forces=change)
        yield without(f"the angles {key}angles`)", change)
        yield without(f"angles and forces {key}angles`, `forces`)", change, change)
    for unit, factor in (("deg", np.pi / 180), ("rev", 2 * np.pi)):
        for said, by in ((unit, factor), (f"rad, not in {unit}", 1 / factor)):
            text = f"the angles of the log seem to be in {said} (`recording.angle_unit`)"
            yield without(text, np.diag(np.where(robot.revolute, by, 1.0)))
    if drives.is_direct:
        return
    angles, forces_too = (not side for side in sides)
    cases = (
        ("angles and forces", angles, 'side = "{}"`)', (angles, angles)),
        ("angles", angles, "side`, with `forces_side` as it is)", (angles, sides[1])),
        ("forces", forces_too, 'forces_side = "{}"`)', (sides[0], forces_too)),
    )
    for what, motors, key, other in cases[sides[0] != sides[1] :]:
        owner = "motor" if motors else "joint"
        text = f"the {what} of the log seem to be the {owner}s' (`recording.{key.format(owner)}"
        yield without(text, sides=other)


def _of_robot(robot: Robot, motion: Motion, forces: np.ndarray) -> Iterator[Correction]:
    """Yield corrections of the robot: zeros of its angles, gravity, and axes of joints."""
    names, n, size = robot.joint_names, robot.joints, np.linalg.norm(robot.gravity)
    own, every = np.arange(n) == np.arange(n)[:, None], (motion.q, motion.qd, motion.qdd)

    def reversed_axis(text: str, j: int, changed: Robot) -> Correction:
        signs = np.where(own[j], -1.0, 1.0)
        return Correction(text, changed, Motion(*(x * signs for x in every)), forces * signs)

    for j, turns in ((j, k) for j in range(n) if robot.revolute[j] for k in (-1, 1, 2)):
        q = motion.q + 0.5 * np.pi * turns * own[j]
        text = f"the angle of joint `{names[j]}` seems to lack {90 * turns} degrees (`recording."
        moved = Motion(q, motion.qd, motion.qdd)
        yield Correction(f"{text}angle_offsets`)", robot, moved, forces)
    for g in (*np.eye(3), *-np.eye(3)):
        if size > 0 and robot.gravity @ g < 0.9 * size:
            shown = ", ".join(f"{x:.4g}" for x in size * g + 0.0)
            text = f"gravity seems to be [{shown}] (`robot.gravity`)"
            yield Correction(text, robot.replace(gravity=size * g), motion, forces)
    if size > 0:
        text = "the forces seem not to contain gravity: the log, or the drive, has subtracted it"
        yield Correction(text, robot.replace(gravity=np.zeros(3)), motion, forces)
    for j, name in enumerate(names):
        text = f"the axis of joint `{name}` seems to be reversed in the robot, or in the log both "
        yield reversed_axis(f"{text}its angle and its force", j, robot)
    for j, shift in itertools.product(range(n) if n <= MANY else (), (1, 2)):
        axis = np.array(robot.axis)
        axis[j] = np.roll(axis[j], shift)
        turned, text = (
            robot.replace(axis=axis),
            f"the axis of joint `{names[j]}` seems to be ({{}})",
        )
        shown, other = (" ".join(f"{x:g}" for x in s * axis[j] + 0.0) for s in (1, -1))
        text += " in the frame of its body"
        yield Correction(text.format(shown), turned, motion, forces)
        yield reversed_axis(text.format(other), j, turned)


def _of_kinds(robot: Robot, motion: Motion, forces: np.ndarray) -> Iterator[Correction]:
    """Yield corrections of the kinds of joints."""
    for j, name in enumerate(robot.joint_names[:MANY]):
        kinds = tuple(turns != (i == j) for i, turns in enumerate(robot.revolute))
        text = f"joint `{name}` seems to {'turn' if kinds[j] else 'slide'}"
        yield Correction(text, robot.replace(revolute=kinds), motion, forces)


class _AnyGeometry(eqx.Module):
    """Regressor of a model whose axes and gravity are arguments: it is traced only once."""

    model: Model

    def columns(self, axis, gravity, q, qd, qdd, s=None):
        """Return the regressor of one sample, and the forces of the known tool behind it."""
        model = Model(self.model.robot.replace(axis=axis, gravity=gravity), self.model.terms)
        known = model.known_forces(q, qd, qdd)[:, None]
        return jnp.concatenate([model.columns(q, qd, qdd, s), known], axis=1)

    def __call__(self, robot: Robot, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Return the regressor of each sample, and the forces of the tool."""
        shared = np.asarray(robot.axis), np.asarray(robot.gravity)
        samples = self.model.arguments(motion)
        columns = in_numpy(self, self.columns, *samples, shared=shared)
        return columns[..., :-1], columns[..., -1]


def _unexplained(
    regressor: np.ndarray, tool_forces: np.ndarray, forces: np.ndarray, names: Sequence[str]
) -> float:
    """Return the fraction (0 to 1) of the forces that least squares leave unexplained.

    All joints count equally. Friction terms that would come out negative are left out.
    """
    wanted = forces - tool_forces
    size = np.sqrt(np.mean(wanted**2, axis=0))
    scale = 1.0 / np.where(size > 0, size, np.inf)
    theta = np.concatenate([regressor, wanted[..., None]], axis=2) * scale[:, None]
    theta = theta.reshape(-1, theta.shape[2])
    if not np.isfinite(theta).all():
        return np.inf
    R = np.asarray(np.linalg.qr(theta, mode="r"))
    length = np.linalg.norm(R, axis=0)
    R, target = R[:, :-1] / np.where(length[:-1] > 0, length[:-1], 1.0), R[:, -1]
    braking = np.array([re.fullmatch(r"f[vc]\d+", name) is not None for name in names])
    used = np.ones(len(names), bool)
    while True:
        found = np.zeros(len(names))
        found[used] = np.linalg.lstsq(R[:, used], target, rcond=1e-9)[0]
        pushing = braking & (found < 0)
        if not pushing.any():
            break
        used &= ~pushing
    return float(np.linalg.norm(R @ found - target) / max(length[-1], 1e-300))
