"""Likely mistakes in the description of a log or a robot, found by the model itself.

Every possible mistake is corrected in turn, and the model is fitted anew to some
instants of all logs, with any friction that takes energy from the robot, as all
friction does. Without that condition a wrong sign would only change signs of parameters
where joints are hardly coupled; with less friction, a mistake might be named where the
model lacks some. What counts is also missed in stretches of time that were left out of
the fit.
"""

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize
from scipy.interpolate import CubicSpline

from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.identification.fit_result import Fit
from jaxid.measurement.observations import Observations
from jaxid.result_table import significant
from jaxid.robot.robot import Robot

BAD = 0.005
"""Fraction (0 to 1) of the forces left unexplained from which mistakes are sought."""
INSTANTS = 300
"""Number of instants of all logs that tell enough."""
FOLDS = 5
"""Parts of the time that are left out in turn."""
LATEST, FARTHEST, GAIN = 0.05, 0.8, 3.0
"""Largest delay [s], error of a zero [rad or m] and gain that are looked for."""
MOVED, SCALED = 0.2, 1.2
"""Error of a zero [rad or m] and gain of a force that logs may not reveal."""
MATERIAL = 0.02
"""Fraction (0 to 1) of the forces by which a delay must change them to be a mistake."""
FAR = 0.15
"""Fraction (0 to 1) of the forces that no model misses whose description is right."""
MOST = 0.5
"""Fraction (0 to 1) of what a model misses that a mistake's correction may leave."""
MANY = 12
"""Number of joints above which no pairs of joints and no axes are examined."""


class Correction(NamedTuple):
    """Correction of a possible mistake."""

    text: str  # the mistake, as a clause
    robot: Robot  # robot without the mistake
    motion: Motion  # motion of the log without it
    forces: np.ndarray  # forces of the log without it [N m or N]


class _Amount(NamedTuple):
    """Mistake of any amount in a joint (all, if it has no name), and two amounts."""

    joint: str
    what: str
    correction: Callable[[float, slice], Correction]
    largest: float
    small: float


def likely_mistakes(
    fit: Fit,
    logs: Sequence[Observations],
    motor_sides: tuple[bool, bool],
    events: tuple[str, ...] = (),
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return a sentence about the mistake that explains most of the misfit, and notes.

    A mistake is looked for in all logs alike, then in the columns of each. The notes
    say which mistakes would not show; `events`, sentences about moments, are returned
    if no mistake explains them. Whether angles and forces are taken for the motors' is
    in `motor_sides`.
    """
    samples = _Samples(fit.base.model, logs)
    robot = fit.base.model.robot
    left, left_unseen = samples.given, samples.missed(samples.as_given, folds=FOLDS)
    notes = samples.hidden(max(left / MOST, BAD))
    if left < BAD:
        return events, notes
    parts = [slice(0, len(samples.forces)), *(samples.parts if len(logs) > 1 else [])]
    for name, part in zip(
        ("", *(f"{log.name}: " for log in logs)), parts, strict=False
    ):
        motion, forces = samples.motion[part], samples.forces[part]
        candidates = [*_of_columns(robot, motion, forces, motor_sides)]
        amounts = [samples.best(x, part) for x in samples.amounts()]
        if left**2 - samples.missed(amounts[0], part) ** 2 < MATERIAL**2:
            del amounts[0]
        candidates += amounts
        if not name:
            candidates += _of_robot(robot, motion, forces)
            candidates += _of_kinds(robot, motion, forces) if left > FAR else ()
        tried = sorted(((samples.missed(c, part), k) for k, c in enumerate(candidates)))
        best = tried[0][0]
        likely = [candidates[k] for value, k in tried if value < 1.5 * best]
        unseen = samples.missed(likely[0], part, FOLDS)
        # With more than three candidates nothing is known.
        known = len(likely) <= 3 and best <= min(MOST * left, FAR)
        if known and unseen <= MOST * left_unseen:
            text = (
                f"{name}{', or '.join(c.text for c in likely)}: the model then misses "
                f"{100 * best:.2g} % of the forces instead of {100 * left:.2g} %."
            )
            return (text,), ()
    return events or _misfit(fit, samples.motion, samples.forces, left), notes


class _Samples:
    """Some instants of all logs, and what a model misses of their forces.

    The model may have any friction.
    """

    def __init__(self, model: Model, logs: Sequence[Observations]):
        step = -(-sum(log.rows for log in logs) // INSTANTS)
        instants = [log.instants[::step] for log in logs]
        motions = [log.motion[at] for log, at in zip(logs, instants, strict=True)]
        self.motion = jax.tree.map(lambda *x: np.concatenate(x), *motions)
        self.forces = np.concatenate(
            [np.asarray(log.reduced_forces)[::step] for log in logs]
        )
        ends = np.cumsum([0, *map(len, instants)]).tolist()
        self.parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self._logs, self._instants, self._model = logs, instants, model
        self._fastest = np.abs(self.motion.qd).max(axis=0)
        self._geometries: dict[tuple[bool, ...], _AnyGeometry] = {}
        self.as_given = Correction("", model.robot, self.motion, self.forces)
        self._rows = self._rows_of(self.as_given)
        braking = [
            re.fullmatch(r"f[vc]\d+", name) is not None
            for name in model.parameter_names
        ]
        self._braking = np.ones(self._rows.shape[2] - 1, bool)
        self._braking[: len(braking)] = braking
        self.given = _missed(self._rows, self._braking)

    def missed(self, c: Correction, part: slice = slice(None), folds: int = 1) -> float:
        """Return what is missed (0 to 1) if a part of the instants is corrected."""
        rows = self._rows.copy()
        rows[part] = self._rows_of(c)
        return _missed(rows, self._braking, folds)

    def best(self, mistake: _Amount, part: slice) -> Correction:
        """Return the correction of a mistake by the amount that leaves least.

        Where a parabola through small amounts promises too little, the search is left
        out.
        """

        def left(amount: float) -> float:
            return self.missed(mistake.correction(amount, part), part)

        step, now = 0.1 * mistake.small, self.given**2
        below, above = left(-step) ** 2, left(step) ** 2
        bend, slope = below + above - 2 * now, above - below
        if bend > 0 and slope**2 < 8 * bend * now * (1 - 0.9**2):
            return mistake.correction(-np.sign(slope) * step, part)
        bounds, options = (-mistake.largest, mistake.largest), {"maxiter": 10}
        found = optimize.minimize_scalar(left, bounds=bounds, options=options).x
        return mistake.correction(found, part)

    def hidden(self, shown: float) -> tuple[str, ...]:
        """Return a note on mistakes with which the model would miss less than shown."""
        unseen: dict[str, list[str]] = {}
        for mistake in self.amounts():
            change = mistake.correction(mistake.small, slice(None))
            if mistake.joint and self.missed(change) < shown:
                unseen.setdefault(mistake.what, []).append(f"`{mistake.joint}`")
        for j, name in enumerate(self._model.robot.joint_names):
            if self.missed(_reversed(self.as_given, j)) < shown:
                unseen.setdefault("a reversed axis", []).append(f"`{name}`")
        texts = []
        for what, names in unseen.items():
            every = len(names) == self.motion.joints > 1
            texts.append(f"{what} ({'any joint' if every else ', '.join(names)})")
        return (
            (f"mistakes that these logs cannot reveal: {', '.join(texts)}",)
            if texts
            else ()
        )

    def amounts(self) -> Iterator[_Amount]:
        """Yield mistakes of any amount: a delay, zeros of angles, gains of forces."""
        robot, q, forces = self._model.robot, self.motion.q, self.forces
        text = (
            "the forces of the log seem to be late (`recording.force_delay = {:.3g}`)"
        )

        def correction(text: str, part: slice, q=q, forces=forces) -> Correction:
            moved = Motion(q[part], self.motion.qd[part], self.motion.qdd[part])
            return Correction(text, robot, moved, forces[part])

        def late(x: float, part: slice) -> Correction:
            return correction(text.format(x), part, forces=self._later(x))

        yield _Amount("", "", late, LATEST, LATEST)
        for j, name in enumerate(robot.joint_names[:MANY]):
            own = np.eye(robot.joints)[j]
            unit, per = ("degrees", np.pi / 180) if robot.revolute[j] else ("m", 1.0)

            def moved(
                x: float, part: slice, own=own, name=name, unit=unit, per=per
            ) -> Correction:
                said = f"the angle of joint `{name}` seems to lack {x / per:.2g} {unit}"
                return correction(
                    f"{said} (`recording.angle_offsets`)", part, q + x * own
                )

            def scaled(x: float, part: slice, own=own, name=name) -> Correction:
                said = (
                    f"the gain of the force of joint `{name}` seems to be "
                    f"{np.exp(x):.2g}"
                )
                return correction(said, part, forces=forces * np.exp(-x * own))

            what = f"a zero that is off by {MOVED / per:.2g} {unit}"
            yield _Amount(name, what, moved, FARTHEST, MOVED)
            what = f"forces that are {SCALED:g} times too large"
            yield _Amount(
                name, what, scaled, float(np.log(GAIN)), -float(np.log(SCALED))
            )

    def _later(self, seconds: float) -> np.ndarray:
        """Return the forces that stand later in the logs."""
        shifted = []
        for log, at in zip(self._logs, self._instants, strict=True):
            time = log.reduced_time
            curve = CubicSpline(time, np.asarray(log.reduced_forces))
            shifted.append(curve(np.clip(log.time[at] + seconds, time[0], time[-1])))
        return np.concatenate(shifted)

    def _rows_of(self, c: Correction) -> np.ndarray:
        """Return the regressor, with any friction, and the forces as last column."""
        kinds = c.robot.revolute
        if kinds not in self._geometries:
            self._geometries[kinds] = _AnyGeometry(Model(c.robot, self._model.terms))
        columns, known = self._geometries[kinds](c.robot, c.motion)
        friction = _any_friction(np.asarray(c.motion.qd), self._fastest)
        return np.concatenate(
            [columns, friction, (c.forces - known)[..., None]], axis=2
        )


def _any_friction(speeds: np.ndarray, fastest: np.ndarray) -> np.ndarray:
    """Return friction columns of each braking joint: dry, with peaks, and quadratic."""
    v = speeds / np.where(fastest > 0, fastest, 1.0)
    shapes = [np.tanh(v / width) for width in (0.01, 0.1)]
    shapes += [np.tanh(v / 0.01) * np.exp(-((v / width) ** 2)) for width in (0.05, 0.2)]
    return np.concatenate(
        [x[..., None] * np.eye(v.shape[1]) for x in (*shapes, v * abs(v))], 2
    )


def _reversed(c: Correction, joint: int) -> Correction:
    """Return a correction that also reverses the angle and the force of a joint."""
    m, signs = c.motion, np.ones(c.motion.joints)
    signs[joint] = -1.0
    motion = Motion(m.q * signs, m.qd * signs, m.qdd * signs)
    return c._replace(motion=motion, forces=c.forces * signs)


def _misfit(
    fit: Fit, motion: Motion, forces: np.ndarray, left: float
) -> tuple[str, ...]:
    """Return a sentence about where a model does not fit, or nothing if it does."""
    if left < FAR:
        return ()
    errors = forces - fit.predict(motion) - fit.base.tool_forces(motion)
    size = np.sqrt(np.mean(forces**2, axis=0))
    missed = np.sqrt(np.mean(errors**2, axis=0)) / np.where(size > 0, size, np.inf)
    worst = int(np.argmax(missed))
    return (
        f"the model does not fit: it misses {significant(100 * left, 2)} % of the "
        "forces, most of all those of joint "
        f"`{fit.base.model.robot.joint_names[worst]}`, and no single mistake in signs, "
        "order, units, offsets, axes or gravity explains that.",
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
        columns = [
            drives.motor_angles(motion.q),
            *map(drives.motor_velocities, columns[1:]),
        ]
    if sides[1]:
        torques = drives.motor_torques(forces)

    def without(
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
        yield without(f"the sign of the force {key}force_signs`)", forces=change)
        yield without(f"the sign of the angle {key}angle_signs`)", change)
    # The number of pairs grows with the square.
    for i, j in itertools.combinations(range(n), 2) if n <= MANY else ():
        change = np.eye(n)
        change[[i, j]] = change[[j, i]]
        key = (
            f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        )
        yield without(f"the forces {key}forces`)", forces=change)
        yield without(f"the angles {key}angles`)", change)
        yield without(f"angles and forces {key}angles`, `forces`)", change, change)
    for unit, factor in (("deg", np.pi / 180), ("rev", 2 * np.pi)):
        for said, by in ((unit, factor), (f"rad, not in {unit}", 1 / factor)):
            text = (
                f"the angles of the log seem to be in {said} (`recording.angle_unit`)"
            )
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
        text = (
            f"the {what} of the log seem to be the {owner}s' "
            f"(`recording.{key.format(owner)}"
        )
        yield without(text, sides=other)


def _of_robot(robot: Robot, motion: Motion, forces: np.ndarray) -> Iterator[Correction]:
    """Yield corrections of the robot: zeros of angles, gravity, and axes of joints."""
    names, n, size = robot.joint_names, robot.joints, np.linalg.norm(robot.gravity)
    for j, turns in ((j, k) for j in range(n) if robot.revolute[j] for k in (-1, 1, 2)):
        q = motion.q + 0.5 * np.pi * turns * np.eye(n)[j]
        text = (
            f"the angle of joint `{names[j]}` seems to lack {90 * turns} degrees "
            "(`recording."
        )
        moved = Motion(q, motion.qd, motion.qdd)
        yield Correction(f"{text}angle_offsets`)", robot, moved, forces)
    for g in (*np.eye(3), *-np.eye(3)):
        if size > 0 and robot.gravity @ g < 0.9 * size:
            shown = ", ".join(f"{x:.4g}" for x in size * g + 0.0)
            text = f"gravity seems to be [{shown}] (`robot.gravity`)"
            yield Correction(text, robot.replace(gravity=size * g), motion, forces)
    if size > 0:
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
        yield _reversed(
            Correction(f"{text}its angle and its force", robot, motion, forces), j
        )
    for j, shift in itertools.product(range(n) if n <= MANY else (), (1, 2)):
        axis = np.array(robot.axis)
        axis[j] = np.roll(axis[j], shift)
        turned = Correction("", robot.replace(axis=axis), motion, forces)
        text = (
            f"the axis of joint `{names[j]}` seems to be ({{}}) in the frame of "
            "its body"
        )
        shown, other = (" ".join(f"{x:g}" for x in s * axis[j] + 0.0) for s in (1, -1))
        yield turned._replace(text=text.format(shown))
        yield _reversed(turned, j)._replace(text=text.format(other))


def _of_kinds(robot: Robot, motion: Motion, forces: np.ndarray) -> Iterator[Correction]:
    """Yield corrections of the kinds of joints."""
    for j, name in enumerate(robot.joint_names[:MANY]):
        kinds = tuple(turns != (i == j) for i, turns in enumerate(robot.revolute))
        text = f"joint `{name}` seems to {'turn' if kinds[j] else 'slide'}"
        yield Correction(text, robot.replace(revolute=kinds), motion, forces)


class _AnyGeometry(eqx.Module):
    """Regressor of a model with axes and gravity as arguments: it is traced once."""

    model: Model

    def columns(self, axis, gravity, q, qd, qdd, s=None):
        """Return a sample's regressor, followed by the forces of the known tool."""
        model = Model(
            self.model.robot.replace(axis=axis, gravity=gravity), self.model.terms
        )
        known = model.known_forces(q, qd, qdd)[:, None]
        return jnp.concatenate([model.columns(q, qd, qdd, s), known], axis=1)

    def __call__(self, robot: Robot, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Return the regressor of each sample, and the forces of the tool."""
        shared = np.asarray(robot.axis), np.asarray(robot.gravity)
        samples = self.model.arguments(motion)
        columns = in_numpy(self, self.columns, *samples, shared=shared)
        return columns[..., :-1], columns[..., -1]


def _missed(rows: np.ndarray, braking: np.ndarray, folds: int = 1) -> float:
    """Return the fraction (0 to 1) of the forces that least squares miss.

    The rows are a regressor with the forces as last column [instants, joints, columns].
    All joints count equally. Friction, the `braking` columns, is left out where it
    would come out negative. Each of several `folds`, of several stretches each, is left
    out of the fit for it.
    """
    size = np.sqrt(np.mean(rows[..., -1] ** 2, axis=0))
    theta = rows / np.where(size > 0, size, np.inf)[:, None]
    length = np.sqrt(np.sum(theta**2, axis=(0, 1)))
    if not np.isfinite(length).all():
        return np.inf
    theta[..., :-1] /= np.where(length[:-1] > 0, length[:-1], 1.0)
    stretches = np.array_split(theta, 4 * folds)
    parts = [
        np.concatenate(stretches[k::folds]).reshape(-1, theta.shape[2])
        for k in range(folds)
    ]
    products, squares = np.array([x.T @ x for x in parts]), 0.0
    for unseen in products:
        seen = products.sum(axis=0) - unseen if folds > 1 else unseen
        found = np.append(_with_braking(seen, braking), -1.0)
        squares += max(float(found @ unseen @ found), 0.0)
    return np.sqrt(squares) / max(length[-1], 1e-300)


def _with_braking(products: np.ndarray, braking: np.ndarray) -> np.ndarray:
    """Return the least-squares parameters, without friction that would not brake.

    Products of columns of length one suffice, with a little on their diagonal for those
    that depend on others: what both lose, 1e-6 of the forces, is far below `BAD`.
    """
    used = np.ones(len(braking), bool)
    regular = products[:-1, :-1] + 1e-12 * np.eye(len(braking))
    while True:
        found = np.zeros(len(braking))
        found[used] = np.linalg.solve(regular[used][:, used], products[:-1, -1][used])
        pushing = braking & (found < 0)
        if not pushing.any():
            return found
        used &= ~pushing
