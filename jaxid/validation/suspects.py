"""Mistakes in the description of a log or robot that a search tries, one at a time."""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Indices
from jaxid.measurement.recording import Recording
from jaxid.result_table import significant
from jaxid.robot.rotations import axis_rotation

from .descriptions import DescribedLog
from .filtered_log import Motion
from .row_fits import Rows

LOW_PASSES = (1.5, 3.0, 6.0)
"""Cut-offs of a filter of the forces that are tried [Hz]."""
MAX_JOINTS = 12
"""Number of joints above which no pairs of joints are tried."""
MIN_SPAN = 0.02
"""Smallest range of a joint that is a motion [rad or m]."""
GEAR_RATIOS = (10.0, 20.0, 30.0, 50.0, 80.0, 100.0, 120.0, 160.0, 200.0)
"""Common ratios of gears that are tried where none is stated."""
UNIT_FACTORS = {
    "rad": {"deg": math.pi / 180, "rev": 2 * math.pi},
    "deg": {"rad, not in deg": 180 / math.pi},
    "rev": {"rad, not in rev": 0.5 / math.pi},
}
"""Units that angles may have instead of that of their file, and factors to them."""
UNIT_START = "the angles of the log seem to be in "
"""Begin of all sentences about units of angles."""
NO_UNIT_TEXT = (
    UNIT_START + "an unnamed unit, roughly {} (give a number as "
    "`recording.angle_unit`, with `angle_offsets`, or correct `drives.gear_ratios`)"
)
UNIT_TEXTS = {
    1.0: UNIT_START + "{} (`recording.angle_unit`)",
    0.95: NO_UNIT_TEXT,
    1.05: NO_UNIT_TEXT,
}
"""Mistakes, by the multiple of a unit's factor that leaves least of the forces."""


class Suspect(NamedTuple):
    """A mistake that is made or not.

    Attributes:
        sentence: What seems to be wrong, with the key that mends it.
        rows: Rows of the log if it is so.
        is_gain: Whether it is the gain of a joint's force.
    """

    sentence: str
    rows: Callable[[], Rows]
    is_gain: bool = False


class Quantity(NamedTuple):
    """A mistake of any amount.

    Attributes:
        sentence: What seems to be wrong, for an amount.
        rows: Rows of the log for an amount.
        step: Amount that changes the forces a little.
        bounds: Smallest and largest amount that somebody can have missed.
        min_amount: Amount below which it does not matter.
        is_gain: Whether it is the gain of a joint's force.
    """

    sentence: Callable[[float], str]
    rows: Callable[[float], Rows]
    step: float
    bounds: tuple[float, float]
    min_amount: float
    is_gain: bool = False


class SuspectedMistakes:
    """Mistakes that a described log may hide."""

    def __init__(
        self,
        described_log: DescribedLog,
        recording: Recording,
        bodies: np.ndarray | None = None,
    ):
        """Prepare the mistakes of a log.

        Args:
            described_log: Log, and the rows that it has under other descriptions.
            recording: What its columns are taken for.
            bodies: Inertial parameters of the robot's file [bodies, 10]; or None.
        """
        self._log = described_log
        self._recording = recording
        self._bodies = bodies
        robot = described_log.robot
        self._names = [f"`{name}`" for name in robot.joint_names]
        self._joints = range(robot.joints)
        self._revolute = np.array(robot.revolute)
        self._identity = np.eye(robot.joints)
        # Columns of motors act on the joints through the gears, which may couple them.
        self._angle_gears = self._identity
        self._force_gears = self._identity
        self._zeros = np.zeros(robot.joints)
        if recording.angles_on_motor_side:
            gears = robot.drives.joint_velocities(self._identity)
            self._angle_gears = np.asarray(gears).T
            self._zeros = np.asarray(robot.drives.joint_angles(self._zeros))
        if recording.forces_on_motor_side:
            gears = robot.drives.joint_forces(self._identity)
            self._force_gears = np.asarray(gears).T

    def of_columns(self) -> Iterator[Suspect]:
        """Yield the mistakes in the columns of a log that are made or not."""
        yield from self._signs()
        yield from self._exchanges()
        yield from self._units()
        yield from self._sides()
        yield from self._right_angles()
        yield from self._filters()

    def of_robot(self) -> Iterator[Suspect]:
        """Yield the mistakes in the robot that are made or not."""
        yield from self._reversals()
        yield from self._axes()
        yield from self._gravity()

    def _combined_motion(self, matrix: np.ndarray) -> Motion:
        """Return the motion with other combinations of the log's columns."""
        gears = self._angle_gears
        joint_matrix = gears @ matrix @ np.linalg.inv(gears)
        motion = self._log.log.motion.shifted(-self._zeros)
        return motion.combined(joint_matrix).shifted(self._zeros)

    def _combined_forces(self, matrix: np.ndarray) -> np.ndarray:
        """Return the forces with other combinations of the log's columns."""
        gears = self._force_gears
        joint_matrix = gears @ matrix @ np.linalg.inv(gears)
        return self._log.log.forces @ joint_matrix.T

    def _angles(self, sentence: str, matrix: np.ndarray) -> Suspect:
        """Return the suspicion that angles are other combinations of the columns."""

        def rows() -> Rows:
            return self._log.with_motion(self._combined_motion(matrix))

        return Suspect(sentence, rows)

    def _forces(self, sentence: str, matrix: np.ndarray) -> Suspect:
        """Return the suspicion that forces are other combinations of the columns."""

        def rows() -> Rows:
            return self._log.with_forces(self._combined_forces(matrix))

        return Suspect(sentence, rows)

    def _both(self, sentence: str, matrix: np.ndarray) -> Suspect:
        """Return the suspicion that both are other combinations of the columns."""

        def rows() -> Rows:
            motion = self._combined_motion(matrix)
            forces = self._combined_forces(matrix)
            return self._log.with_motion_and_forces(motion, forces)

        return Suspect(sentence, rows)

    def rows_of_signs(self, angle_signs: np.ndarray, force_signs: np.ndarray) -> Rows:
        """Return the rows with other signs of the columns [joints], +1 or -1."""
        motion = self._combined_motion(np.diag(angle_signs))
        forces = self._combined_forces(np.diag(force_signs))
        return self._log.with_motion_and_forces(motion, forces)

    def _signs(self) -> Iterator[Suspect]:
        for j in self._joints:
            signs = np.diag(1 - 2 * self._identity[j])
            of_joint = f"of joint {self._names[j]} seems to be wrong"
            key = "recording.force_signs"
            yield self._forces(f"the sign of the force {of_joint} (`{key}`)", signs)
            key = "recording.angle_signs"
            yield self._angles(f"the sign of the angle {of_joint} (`{key}`)", signs)

    def _reversals(self) -> Iterator[Suspect]:
        log = self._log.log
        for j in self._joints:
            signs = 1 - 2 * self._identity[j]
            motion = log.motion.combined(np.diag(signs))
            forces = log.forces * signs
            sentence = (
                f"the axis of joint {self._names[j]} seems to be reversed in the "
                "robot, or in the log both its angle and its force"
            )

            def rows(motion=motion, forces=forces) -> Rows:
                return self._log.with_motion_and_forces(motion, forces)

            yield Suspect(sentence, rows)

    def _exchanges(self) -> Iterator[Suspect]:
        pairs = itertools.combinations(self._joints, 2)
        # The number of pairs grows with the square.
        for i, j in pairs if len(self._joints) <= MAX_JOINTS else ():
            exchange = self._identity.copy()
            exchange[[i, j]] = exchange[[j, i]]
            pair = f"of joints {self._names[i]} and {self._names[j]}"
            seems = f"{pair} seem to be exchanged"
            yield self._forces(f"the forces {seems} (`recording.forces`)", exchange)
            yield self._angles(f"the angles {seems} (`recording.angles`)", exchange)
            yield self._both(
                f"angles and forces {seems} (`recording.angles`, `forces`)", exchange
            )

    def _right_angles(self) -> Iterator[Suspect]:
        motion = self._log.log.motion
        for j in np.flatnonzero(self._revolute):
            for degrees in (-90, 90, 180):
                offsets = math.radians(degrees) * self._identity[j]
                sentence = (
                    f"the angle of joint {self._names[j]} seems to lack {degrees} "
                    "degrees (`recording.angle_offsets`)"
                )

                def rows(offsets=offsets) -> Rows:
                    return self._log.with_motion(motion.shifted(offsets))

                yield Suspect(sentence, rows)

    def _axes(self) -> Iterator[Suspect]:
        geometry = self._log.geometry
        for j, turn in itertools.product(self._joints, (1, 2)):
            axis = geometry.axis.copy()
            axis[j] = np.roll(axis[j], turn)
            words = " ".join(f"{x:g}" for x in axis[j] + 0.0)
            sentence = (
                f"the axis of joint {self._names[j]} seems to be ({words}) in the "
                "frame of its body, or the opposite"
            )
            other = geometry._replace(axis=axis)
            yield Suspect(sentence, lambda other=other: self._log.with_geometry(other))

    def _units(self) -> Iterator[Suspect]:
        for sentence, scales in self._scales():
            matrix = np.diag(scales)
            spans = np.ptp(self._combined_motion(matrix).q, axis=0)
            # A unit that leaves no motion is none.
            if spans[scales != 1.0].max() > MIN_SPAN:
                yield self._angles(sentence, matrix)

    def _scales(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield units and common ratios of gears, and the scales that undo them."""
        turning = self._revolute
        if turning.any():
            factors = UNIT_FACTORS.get(self._recording.angle_unit, {})
            for unit, factor in factors.items():
                for multiple, text in UNIT_TEXTS.items():
                    scales = np.where(turning, multiple * factor, 1.0)
                    yield text.format(unit), scales
            yield from self._joints_in_degrees()
        if not turning.all():
            sentence = "the coordinates of sliding joints seem to be in mm"
            yield sentence, np.where(turning, 1.0, 1e-3)
        if self._log.robot.drives.is_direct:
            # The ratios are coarse: that of the robot may lie between two of them.
            sentence = (
                f"the angles of the log seem to be {GEAR_RATIOS[0]:g} to "
                f"{GEAR_RATIOS[-1]:g} times too large: state the gears "
                "(`drives.gear_ratios`, `recording.side`), or the unit (`recording."
                "angle_unit` takes numbers, beside `angle_offsets`)"
            )
            for ratio in GEAR_RATIOS:
                yield sentence, np.full(len(turning), 1 / ratio)

    def _joints_in_degrees(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield that one joint of several is in degrees, if it moves so far."""
        if self._recording.angle_unit != "rad" or len(self._joints) == 1:
            return
        spans = np.ptp(self._log.log.motion.q, axis=0)
        for j in np.flatnonzero(self._revolute & (spans > 2 * math.pi)):
            sentence = (
                f"the angle of joint {self._names[j]}, and not of all, seems to be in "
                "deg (`recording.angle_unit` takes a list with a unit for each joint)"
            )
            yield sentence, np.where(self._identity[j] > 0, math.pi / 180, 1.0)

    def _sides(self) -> Iterator[Suspect]:
        """Yield that angles or forces are on the other side of the gears."""
        drives = self._log.robot.drives
        if drives.is_direct:
            return
        q, qd, qdd = self._log.log.motion
        if self._recording.angles_on_motor_side:
            owner = "joint"
            rates = map(drives.motor_velocities, (qd, qdd))
            coordinates = drives.motor_angles(q)
        else:
            owner = "motor"
            rates = map(drives.joint_velocities, (qd, qdd))
            coordinates = drives.joint_angles(q)
        motion = Motion(*map(np.asarray, (coordinates, *rates)))
        convert = drives.joint_forces
        force_owner = "motor"
        if self._recording.forces_on_motor_side:
            convert = drives.motor_torques
            force_owner = "joint"
        forces = np.asarray(convert(self._log.log.forces))

        yield Suspect(
            f"the angles of the log seem to be the {owner}s' (`recording.side`, with "
            "`forces_side` as it is)",
            lambda: self._log.with_motion(motion),
        )
        yield Suspect(
            f"the forces of the log seem to be the {force_owner}s' "
            f'(`recording.forces_side = "{force_owner}"`)',
            lambda: self._log.with_forces(forces),
        )
        if owner == force_owner:
            yield Suspect(
                f"the angles and forces of the log seem to be the {owner}s' "
                f'(`recording.side = "{owner}"`)',
                lambda: self._log.with_motion_and_forces(motion, forces),
            )

    def _gravity(self) -> Iterator[Suspect]:
        described_log = self._log
        geometry = described_log.geometry
        norm = np.linalg.norm(geometry.gravity)
        if norm == 0:
            return
        for direction in (*np.eye(3), *-np.eye(3)):
            if geometry.gravity @ direction < 0.9 * norm:
                words = ", ".join(f"{x:.4g}" for x in norm * direction + 0.0)
                sentence = f"gravity seems to be [{words}] (`robot.gravity`)"
                other = geometry._replace(gravity=norm * direction)
                yield Suspect(
                    sentence, lambda other=other: described_log.with_geometry(other)
                )
        weightless = geometry._replace(gravity=np.zeros(3))
        absent = "the forces seem not to contain"
        cure = "the log, or the drive, has subtracted it"
        yield Suspect(
            f"{absent} gravity: {cure}",
            lambda: described_log.with_geometry(weightless),
        )
        yield Suspect(
            f"{absent} gravity and Coriolis forces: {cure}",
            described_log.without_gravity_and_coriolis,
        )
        if self._bodies is not None:
            yield from self._subtracted_predictions(self._bodies)

    def _subtracted_predictions(self, bodies: np.ndarray) -> Iterator[Suspect]:
        """Yield what a controller that knows the file's bodies may have subtracted."""
        described_log = self._log
        q, qd, _ = described_log.log.motion
        rest = np.zeros_like(qd)
        parts = {"gravity": rest, "gravity and Coriolis forces": qd}
        for part, speeds in parts.items():
            samples = described_log.samples_of_bodies(Motion(q, speeds, rest))
            added_rows = described_log.log.rows_of(samples @ bodies.ravel())
            sentence = (
                f"the log or the drive seems to have subtracted {part} of the file's "
                "bodies from the forces"
            )
            yield Suspect(
                sentence,
                lambda added_rows=added_rows: described_log.with_added_forces(
                    added_rows
                ),
            )

    def _filters(self) -> Iterator[Suspect]:
        every_joint = tuple(self._joints)
        for cutoff in (*LOW_PASSES, 15.0):
            yield self._low_pass(every_joint, cutoff, "all forces")
        for j, cutoff in itertools.product(self._joints, LOW_PASSES):
            yield self._low_pass((j,), cutoff, f"the force of joint {self._names[j]}")

    def _low_pass(self, joints: Indices, cutoff: float, forces: str) -> Suspect:
        sentence = f"a low-pass of about {cutoff:g} Hz seems to delay {forces}"
        return Suspect(sentence, lambda: self._log.with_low_pass(joints, cutoff))

    def quantities(self) -> Iterator[Quantity]:
        """Yield the mistakes of any amount."""
        yield self._delay(tuple(self._joints))
        for j in self._joints:
            yield self._delay((j,))
            yield self.gain(j)
            yield self._ratio(j)
            yield self._offset(j)
            for direction in range(3):
                yield self._twist(j, direction)
                yield self._length(j, direction)

    def _delay(self, joints: Indices) -> Quantity:
        def sentence(seconds: float) -> str:
            if joints == tuple(self._joints):
                return (
                    f"the forces of the log seem to be {1e3 * seconds:.2g} ms late "
                    f"(`recording.force_delay = {seconds:.3g}`)"
                )
            return (
                f"the force of joint {self._names[joints[0]]} seems to be "
                f"{1e3 * seconds:.2g} ms later in the log than the angles"
            )

        def rows(seconds: float) -> Rows:
            return self._log.with_earlier_forces(joints, seconds)

        return Quantity(sentence, rows, 2e-3, (-0.011, 0.1), 1e-3)

    def gain(self, joint: int, center: float = 0.0) -> Quantity:
        """Return the gain of a joint's force, about a logarithm."""

        def sentence(logarithm: float) -> str:
            gain = significant(math.exp(logarithm), 2)
            cure = significant(math.exp(-logarithm), 2)
            return (
                f"the force of joint {self._names[joint]} in the log seems to be "
                f"{gain} times the true one (`recording.force_gains` of {cure})"
            )

        def rows(logarithm: float) -> Rows:
            columns = self._log.rows.columns.copy()
            columns[:, joint] *= math.exp(logarithm)
            return self._log.rows._replace(columns=columns)

        bounds = (center - 0.8, center + 0.8)
        return Quantity(sentence, rows, 0.02, bounds, 0.02, is_gain=True)

    def _ratio(self, joint: int) -> Quantity:
        motion = self._log.log.motion

        def sentence(logarithm: float) -> str:
            return (
                f"the gear ratio of joint {self._names[joint]} seems to be wrong: its "
                f"angle is {math.exp(logarithm):.3g} times the logged one"
            )

        def rows(logarithm: float) -> Rows:
            scales = np.exp(logarithm * self._identity[joint])
            return self._log.with_motion(motion.combined(np.diag(scales)))

        return Quantity(sentence, rows, 0.02, (-0.8, 0.8), 0.02)

    def _offset(self, joint: int) -> Quantity:
        motion = self._log.log.motion
        step = 0.02 if self._revolute[joint] else 0.02 * self._typical_length

        def sentence(amount: float) -> str:
            text = f"{amount:.2g} m"
            if self._revolute[joint]:
                text = f"{math.degrees(amount):.2g} degrees"
            return (
                f"the angle of joint {self._names[joint]} seems to lack {text} "
                "(`recording.angle_offsets`)"
            )

        def rows(amount: float) -> Rows:
            shifted = motion.shifted(amount * self._identity[joint])
            return self._log.with_motion(shifted)

        return Quantity(sentence, rows, step, (-35 * step, 35 * step), 0.5 * step)

    def _twist(self, joint: int, direction: int) -> Quantity:
        def sentence(amount: float) -> str:
            return (
                f"the frame of joint {self._names[joint]} seems to be turned by "
                f"{math.degrees(amount):.2g} degrees about its {'xyz'[direction]} axis"
            )

        def rows(amount: float) -> Rows:
            rotation = axis_rotation(np.eye(3)[direction], amount)
            return self._log.with_geometry(self._log.geometry.turned(joint, rotation))

        return Quantity(sentence, rows, 0.02, (-0.7, 0.7), 0.01)

    def _length(self, joint: int, direction: int) -> Quantity:
        step = 0.02 * self._typical_length

        def sentence(amount: float) -> str:
            return (
                f"the place of joint {self._names[joint]} seems to be wrong by "
                f"{amount:.2g} m along its {'xyz'[direction]} axis"
            )

        def rows(amount: float) -> Rows:
            shift = amount * np.eye(3)[direction]
            return self._log.with_geometry(self._log.geometry.moved(joint, shift))

        return Quantity(sentence, rows, step, (-35 * step, 35 * step), 0.5 * step)

    @property
    def _typical_length(self) -> float:
        """Mean distance of joints from the joints that carry them [m]."""
        distances = np.linalg.norm(self._log.geometry.offset, axis=1)
        return 0.05 + float(distances.mean())
