"""Likely mistakes in the description of a log or a robot, found by the model itself.

Every possible mistake is corrected in turn, and the model is fitted anew to some
instants of all logs, with any friction that takes energy from the robot, as all
friction does. Without that condition a wrong sign would only change signs of parameters
where joints are hardly coupled; with less friction, a mistake might be named where the
model lacks some. What counts is also missed in stretches of time that were left out of
the fit.
"""

import functools
import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy import optimize
from scipy.interpolate import CubicSpline

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.identification.fit_result import Fit
from jaxid.measurement.observations import Observations
from jaxid.result_table import significant
from jaxid.robot.robot import Robot

from .braking_fit import AnyGeometry, braking_misfit, friction_columns

MIN_MISFIT = 0.005
"""Fraction (0 to 1) of the forces left unexplained from which mistakes are sought."""
INSTANTS = 300
"""Number of instants of all logs that tell enough."""
FOLDS = 5
"""Parts of the time that are left out in turn."""
MAX_DELAY = 0.05
"""Largest delay that is looked for [s]."""
MAX_ZERO_ERROR = 0.8
"""Largest error of a zero that is looked for [rad or m]."""
ZERO_STEP = 0.02
"""Step of the search for the error of a zero [rad or m]."""
MAX_LOG_GAIN = math.log(3.0)
"""Logarithm of the largest gain of a force that is looked for."""
LOG_GAIN_STEP = -0.1 * math.log(1.2)
"""Step of the search for the logarithm of a gain."""
MIN_DELAY_EFFECT = 0.02
"""Fraction (0 to 1) of the forces by which a delay must change them to be a mistake."""
MAX_MISFIT = 0.15
"""Fraction (0 to 1) of the forces that no model misses whose description is right."""
MAX_RATIO = 0.5
"""Fraction (0 to 1) of what a model misses that a mistake's correction may leave."""
MAX_JOINTS = 12
"""Number of joints above which no pairs of joints and no axes are examined."""


UNIT_FACTORS = {
    "rad": {"deg": np.pi / 180, "rev": 2 * np.pi},
    "deg": {"rad, not in deg": 180 / np.pi},
    "rev": {"rad, not in rev": 0.5 / np.pi},
}
"""Units that angles may have instead of that of their file, and factors to them."""
NO_UNIT = (
    "the angles of the log seem to be in no unit with a name, roughly {} (`recording."
    "angle_unit` takes numbers, beside `angle_offsets`; or `drives.gear_ratios`)"
)
UNIT_TEXTS = {
    1.0: "the angles of the log seem to be in {} (`recording.angle_unit`)",
    0.95: NO_UNIT,
    1.05: NO_UNIT,
}
"""Mistakes, by the multiple of a unit's factor that leaves least of the forces."""


class Correction(NamedTuple):
    """Correction of a possible mistake."""

    text: str  # the mistake, as a clause
    robot: Robot  # robot without the mistake
    motion: Motion  # motion of the log without it
    forces: np.ndarray  # forces of the log without it [N m or N]
    # corrections by other factors, which leave more where the factor is exact
    neighbours: tuple["Correction", ...] = ()


class _Amount(NamedTuple):
    """Mistake of any amount: its correction, its limit, and a step of the search."""

    correction: Callable[[float, slice], Correction]
    max_amount: float
    step: float


def likely_mistakes(
    fit: Fit,
    logs: Sequence[Observations],
    motor_sides: tuple[bool, bool],
    events: tuple[str, ...] = (),
    angle_unit: str = "rad",
) -> tuple[str, ...]:
    """Return a sentence about the mistake that explains most of the misfit.

    A mistake is looked for in all logs alike, then in the columns of each. If none
    explains it, `events`, sentences about moments, are returned, or else where the
    model does not fit. Whether angles and forces are taken for the motors' is in
    `motor_sides`, and the unit of the angles in the file in `angle_unit`.
    """
    samples = _Samples(fit.base.model, logs)
    robot = fit.base.model.robot
    misfit = samples.initial_misfit
    if misfit < MIN_MISFIT:
        return events
    initial_unseen_misfit = samples.misfit(samples.no_correction, folds=FOLDS)
    parts = [("", slice(0, len(samples.forces)))]
    if len(logs) > 1:
        names = [f"{log.name}: " for log in logs]
        parts += zip(names, samples.parts, strict=True)
    for name, part in parts:
        motion = samples.motion[part]
        forces = samples.forces[part]
        columns = (robot, motion, forces, motor_sides, angle_unit)
        candidates = [*_column_corrections(*columns)]
        amounts = [samples.best_correction(x, part) for x in samples.amounts()]
        if misfit**2 - samples.misfit(amounts[0], part) ** 2 < MIN_DELAY_EFFECT**2:
            del amounts[0]
        candidates += amounts
        if not name:
            candidates += _robot_corrections(robot, motion, forces)
        misfits = np.array([samples.misfit(c, part) for c in candidates])
        order = np.argsort(misfits, kind="stable")
        min_misfit = misfits[order[0]]
        suspects = [candidates[k] for k in order if misfits[k] < 1.5 * min_misfit]
        unseen_misfit = samples.misfit(suspects[0], part, FOLDS)
        max_misfit = min(MAX_RATIO * misfit, MAX_MISFIT)
        # With more than three candidates nothing is known.
        is_sure = len(suspects) <= 3 and min_misfit <= max_misfit
        if is_sure and unseen_misfit <= MAX_RATIO * initial_unseen_misfit:
            words = ", or ".join(samples.clause(c, part) for c in suspects)
            text = (
                f"{name}{words}: the model then misses {100 * min_misfit:.2g} % of the "
                f"forces instead of {100 * misfit:.2g} %."
            )
            return (text,)
    return events or _misfit_text(fit, samples.motion, samples.forces, misfit)


class _Samples:
    """Some instants of all logs, and what a model misses of their forces.

    The model may have any friction.
    """

    def __init__(self, model: Model, logs: Sequence[Observations]):
        rows = sum(log.rows for log in logs)
        step = -(-rows // INSTANTS)
        instants = [log.instants[::step] for log in logs]
        motions = [log.motion[k] for log, k in zip(logs, instants, strict=True)]
        self.motion = jax.tree.map(lambda *x: np.concatenate(x), *motions)
        self.forces = np.concatenate(
            [np.asarray(log.reduced_forces)[::step] for log in logs]
        )
        ends = np.cumsum([0, *map(len, instants)]).tolist()
        self.parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self._logs = logs
        self._instants = instants
        self._model = model
        self._max_speeds = np.abs(self.motion.qd).max(axis=0)
        self._geometry = AnyGeometry(model)
        self.no_correction = Correction("", model.robot, self.motion, self.forces)
        self._rows = self._corrected_rows(self.no_correction)
        is_model_friction = [
            re.fullmatch(r"f[vc]\d+", name) is not None
            for name in model.parameter_names
        ]
        column_count = self._rows.shape[2] - 1
        self._is_friction = np.ones(column_count, bool)
        self._is_friction[: len(is_model_friction)] = is_model_friction
        self.initial_misfit = braking_misfit(self._rows, self._is_friction)

    def misfit(self, c: Correction, part: slice = slice(None), folds: int = 1) -> float:
        """Return what is missed (0 to 1) if a part of the instants is corrected."""
        rows = self._rows.copy()
        rows[part] = self._corrected_rows(c)
        return braking_misfit(rows, self._is_friction, folds)

    def clause(self, c: Correction, part: slice) -> str:
        """Return the clause of a correction, or of a neighbour that leaves less."""
        return min((c, *c.neighbours), key=lambda x: self.misfit(x, part)).text

    def best_correction(self, mistake: _Amount, part: slice) -> Correction:
        """Return the correction of a mistake by the amount that leaves least.

        Where a parabola through small amounts promises too little, the search is left
        out.
        """

        def misfit(amount: float) -> float:
            return self.misfit(mistake.correction(amount, part), part)

        step = mistake.step
        initial_square = self.initial_misfit**2
        lower_square = misfit(-step) ** 2
        upper_square = misfit(step) ** 2
        curvature = lower_square + upper_square - 2 * initial_square
        slope = upper_square - lower_square
        min_fall = (1 - 0.9**2) * initial_square
        if curvature > 0 and slope**2 < 8 * curvature * min_fall:
            return mistake.correction(-np.sign(slope) * step, part)
        bounds = (-mistake.max_amount, mistake.max_amount)
        options = {"maxiter": 10}
        best_amount = optimize.minimize_scalar(misfit, bounds=bounds, options=options).x
        return mistake.correction(best_amount, part)

    def amounts(self) -> Iterator[_Amount]:
        """Yield mistakes of any amount: a delay, zeros of angles, gains of forces."""
        yield _Amount(self._later, MAX_DELAY, 0.1 * MAX_DELAY)
        for j in range(min(self.motion.joints, MAX_JOINTS)):
            shift = functools.partial(self._shifted, j)
            scale = functools.partial(self._scaled, j)
            yield _Amount(shift, MAX_ZERO_ERROR, ZERO_STEP)
            yield _Amount(scale, MAX_LOG_GAIN, LOG_GAIN_STEP)

    def _later(self, seconds: float, part: slice) -> Correction:
        """Return the correction of late forces."""
        text = (
            "the forces of the log seem to be late (`recording.force_delay = "
            f"{seconds:.3g}`)"
        )
        forces = self._delayed_forces(seconds)[part]
        return Correction(text, self._model.robot, self.motion[part], forces)

    def _shifted(self, j: int, change: float, part: slice) -> Correction:
        """Return the correction of the zero of a joint's angle."""
        robot = self._model.robot
        text = f"{np.rad2deg(change):.2g} degrees"
        if not robot.revolute[j]:
            text = f"{change:.2g} m"
        text = (
            f"the angle of joint `{robot.joint_names[j]}` seems to lack {text} "
            "(`recording.angle_offsets`)"
        )
        motion = self.motion[part]
        q = motion.q + change * np.eye(motion.joints)[j]
        motion = Motion(q, motion.qd, motion.qdd)
        return Correction(text, robot, motion, self.forces[part])

    def _scaled(self, j: int, log_gain: float, part: slice) -> Correction:
        """Return the correction of the gain of a joint's force."""
        robot = self._model.robot
        text = (
            f"the gain of the force of joint `{robot.joint_names[j]}` seems to be "
            f"{np.exp(log_gain):.2g}"
        )
        gains = np.exp(log_gain * np.eye(robot.joints)[j])
        forces = self.forces[part] / gains
        return Correction(text, robot, self.motion[part], forces)

    def _delayed_forces(self, seconds: float) -> np.ndarray:
        """Return the forces that stand later in the logs."""
        forces = []
        for log, rows in zip(self._logs, self._instants, strict=True):
            time = log.reduced_time
            curve = CubicSpline(time, np.asarray(log.reduced_forces))
            instants = np.clip(log.time[rows] + seconds, time[0], time[-1])
            forces.append(curve(instants))
        return np.concatenate(forces)

    def _corrected_rows(self, c: Correction) -> np.ndarray:
        """Return the regressor, with any friction, and the forces as last column."""
        columns, tool = self._geometry(c.robot, c.motion)
        friction = friction_columns(np.asarray(c.motion.qd), self._max_speeds)
        return np.concatenate([columns, friction, (c.forces - tool)[..., None]], axis=2)


def _reversal(c: Correction, joint: int) -> Correction:
    """Return a correction that also reverses the angle and the force of a joint."""
    m = c.motion
    signs = np.where(np.arange(m.joints) == joint, -1.0, 1.0)
    motion = Motion(m.q * signs, m.qd * signs, m.qdd * signs)
    return c._replace(motion=motion, forces=c.forces * signs)


def _misfit_text(
    fit: Fit, motion: Motion, forces: np.ndarray, misfit: float
) -> tuple[str, ...]:
    """Return a sentence about where a model does not fit, or nothing if it does."""
    if misfit < MAX_MISFIT:
        return ()
    errors = forces - fit.predict(motion) - fit.base.tool_forces(motion)
    force_sizes = np.sqrt(np.mean(forces**2, axis=0))
    error_sizes = np.sqrt(np.mean(errors**2, axis=0))
    misfits = error_sizes / np.where(force_sizes > 0, force_sizes, np.inf)
    joint = int(np.argmax(misfits))
    return (
        f"the model does not fit: it misses {significant(100 * misfit, 2)} % of the "
        "forces, most of all those of joint "
        f"`{fit.base.model.robot.joint_names[joint]}`, and no single mistake in signs, "
        "order, units, offsets, axes or gravity explains that.",
    )


def _column_corrections(
    robot: Robot,
    motion: Motion,
    forces: np.ndarray,
    sides: tuple[bool, bool],
    angle_unit: str,
) -> Iterator[Correction]:
    """Yield corrections of the columns of a log."""
    drives = robot.drives
    names = robot.joint_names
    n = robot.joints
    eye = np.eye(n)
    columns = [motion.q, motion.qd, motion.qdd]
    torques = forces
    if sides[0]:
        columns = [
            drives.motor_angles(motion.q),
            *map(drives.motor_velocities, columns[1:]),
        ]
    if sides[1]:
        torques = drives.motor_torques(forces)

    def variant(
        text: str, angles: np.ndarray = eye, forces: np.ndarray = eye, sides=sides
    ):
        """Return a correction with other combinations of the log's columns."""
        q, qd, qdd = (x @ angles for x in columns)
        f = torques @ forces
        if sides[0]:
            q, qd, qdd = (
                drives.joint_angles(q),
                *map(drives.joint_velocities, (qd, qdd)),
            )
        f = drives.joint_forces(f) if sides[1] else f
        return Correction(text, robot, Motion(q, qd, qdd), np.asarray(f))

    for j, name in enumerate(names):
        change = np.diag(np.where(np.arange(n) == j, -1.0, 1.0))
        key = f"of joint `{name}` seems to be wrong (`recording."
        yield variant(f"the sign of the force {key}force_signs`)", forces=change)
        yield variant(f"the sign of the angle {key}angle_signs`)", change)
    # The number of pairs grows with the square.
    for i, j in itertools.combinations(range(n), 2) if n <= MAX_JOINTS else ():
        change = np.eye(n)
        change[[i, j]] = change[[j, i]]
        key = (
            f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        )
        yield variant(f"the forces {key}forces`)", forces=change)
        yield variant(f"the angles {key}angles`)", change)
        yield variant(f"angles and forces {key}angles`, `forces`)", change, change)
    for unit, factor in UNIT_FACTORS.get(angle_unit, {}).items():
        exact, *neighbours = (
            variant(
                text.format(unit), np.diag(np.where(robot.revolute, x * factor, 1.0))
            )
            for x, text in UNIT_TEXTS.items()
        )
        yield exact._replace(neighbours=tuple(neighbours))
    if drives.is_direct:
        return
    angles = not sides[0]
    forces_side = not sides[1]
    cases = (
        ("angles and forces", angles, 'side = "{}"`)', (angles, angles)),
        ("angles", angles, "side`, with `forces_side` as it is)", (angles, sides[1])),
        ("forces", forces_side, 'forces_side = "{}"`)', (sides[0], forces_side)),
    )
    for data, is_motor, key, other_sides in cases[sides[0] != sides[1] :]:
        owner = "motor" if is_motor else "joint"
        text = (
            f"the {data} of the log seem to be the {owner}s' "
            f"(`recording.{key.format(owner)}"
        )
        yield variant(text, sides=other_sides)


def _robot_corrections(
    robot: Robot, motion: Motion, forces: np.ndarray
) -> Iterator[Correction]:
    """Yield corrections of the robot: zeros of angles, gravity, and axes of joints."""
    names = robot.joint_names
    n = robot.joints
    norm = np.linalg.norm(robot.gravity)
    for j, turns in itertools.product(np.flatnonzero(robot.revolute), (-1, 1, 2)):
        q = motion.q + 0.5 * np.pi * turns * np.eye(n)[j]
        text = (
            f"the angle of joint `{names[j]}` seems to lack {90 * turns} degrees "
            "(`recording."
        )
        turned_motion = Motion(q, motion.qd, motion.qdd)
        yield Correction(f"{text}angle_offsets`)", robot, turned_motion, forces)
    for g in (*np.eye(3), *-np.eye(3)):
        if norm > 0 and robot.gravity @ g < 0.9 * norm:
            vector = ", ".join(f"{x:.4g}" for x in norm * g + 0.0)
            text = f"gravity seems to be [{vector}] (`robot.gravity`)"
            yield Correction(text, robot.replace(gravity=norm * g), motion, forces)
    if norm > 0:
        text = (
            "the forces seem not to contain gravity: the log, or the drive, has "
            "subtracted it"
        )
        yield Correction(text, robot.replace(gravity=np.zeros(3)), motion, forces)
    for j, name in enumerate(names):
        text = (
            f"the axis of joint `{name}` seems to be reversed in the robot, or in "
            "the log both "
        )
        yield _reversal(
            Correction(f"{text}its angle and its force", robot, motion, forces), j
        )
    for j, shift in itertools.product(range(n) if n <= MAX_JOINTS else (), (1, 2)):
        axis = np.array(robot.axis)
        axis[j] = np.roll(axis[j], shift)
        variant = Correction("", robot.replace(axis=axis), motion, forces)
        text = (
            f"the axis of joint `{names[j]}` seems to be ({{}}) in the frame of "
            "its body"
        )
        vector, mirror = (
            " ".join(f"{x:g}" for x in s * axis[j] + 0.0) for s in (1, -1)
        )
        yield variant._replace(text=text.format(vector))
        yield _reversal(variant, j)._replace(text=text.format(mirror))
