"""Fit of position-controlled joints: determined parameters, and errors of rollouts."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from jaxid.arrays import Matrix, Vector
from jaxid.measurement.recording import Recording
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    estimate_columns,
    significant,
)

from .body_loads import Bodies
from .determined_combinations import (
    MAX_RELATIVE_DEVIATION,
    Combination,
    determined_combinations,
)
from .errors import RolloutErrors
from .joint_fits import JointFit
from .motion import Contacts, FreeParameters, JointParameters, ServoMotion
from .servo import INDEX, LOWER, PARAMETERS, UPPER, State
from .simulation import ServoSimulator

LIMITED_PARAMETERS = [INDEX[x] for x in ("B", "d", "b", "um", "g", "ki")]
"""Parameters that are not at a limit of the search unless something is wrong."""
MIN_ROUNDING_RATIO = 1.5
"""Multiple of the encoder's rounding above which slow errors show a missing effect."""


@dataclasses.dataclass(frozen=True)
class ServoFit(Summarised):
    """Identified joints behind position servos.

    Attributes:
        joint_names: Names of the joints.
        parameters: Parameters of each joint, in the order of `jid.rollout.PARAMETERS`.
        free: Parameters that were estimated.
        covariance: Covariance of the estimated parameters, joint by joint.
        dof: Degrees of freedom of their deviations.
        combinations: Parameters and combinations that the logs determine.
        linear: Parameters of the linear baseline.
        hold: Whether commands are held until the next one, instead of interpolated.
        time_step: Longest step of the simulation [s].
        rms: Errors of the identification [motions, joints] [rad or m].
        motions: Names of the logs.
        bodies: Bodies whose weight loads the joints; None without.
        load: Mean absolute load of each joint in the logs [N m or N].
        notes: Doubts about the model, in sentences.
        hold_is_told: Whether the logs tell held commands from interpolated ones.
        gains: Gains of the servos that were given by name (`stiffness`, `damping`,
            `feed_forward`), NaN where unknown.
        compliances: What the logs tell of `1 / stiffness` where it was given.
        contacts: When something held the robot, as it was given [s].
        left_out: Number of samples within them, which the fit left out.
    """

    joint_names: tuple[str, ...]
    parameters: JointParameters
    free: FreeParameters
    covariance: Matrix
    dof: Vector
    combinations: tuple[Combination, ...]
    linear: JointParameters
    hold: bool
    time_step: float
    rms: Matrix
    motions: tuple[str, ...]
    bodies: Bodies | None
    load: Vector
    notes: tuple[str, ...] = ()
    hold_is_told: bool = True
    gains: Mapping[str, Vector] = dataclasses.field(default_factory=dict)
    compliances: tuple[Combination, ...] = ()
    contacts: Contacts = ()
    left_out: int = 0

    @classmethod
    def of(
        cls,
        fit: JointFit,
        joint_names: tuple[str, ...],
        groups: Sequence[Sequence[int]],
        undetermined: FreeParameters,
        **fields: Any,
    ) -> "ServoFit":
        """Return the fit of all joints, with its uncertainty, and further fields."""
        simulator = fit.simulator
        motion = simulator.motion
        determination = determined_combinations(fit, groups)
        notes = (
            *_notes_on_effects(undetermined, joint_names),
            *_notes_on_limits(fit, joint_names),
            *_notes_on_errors(fit, joint_names),
        )
        return cls(
            joint_names=joint_names,
            parameters=fit.parameters,
            free=fit.free,
            covariance=determination.covariance,
            dof=determination.dof,
            combinations=determination.combinations,
            hold=simulator.hold,
            time_step=simulator.time_step,
            rms=np.sqrt(fit.mean_squares),
            motions=motion.names,
            bodies=simulator.bodies,
            load=np.abs(simulator.loads[0]).mean(axis=(0, 2)),
            notes=notes,
            left_out=motion.left_out,
            **fields,
        )

    @cached_property
    def stiffness(self) -> Vector:
        """Stiffness of each servo [N m/rad or N/m]; NaN where it is unknown.

        It is given, or told by a known weight.
        """
        unknown = np.full(len(self.joint_names), np.nan)
        values = self.gains.get("stiffness", unknown).copy()
        for c in self.combinations:
            if c.name == "a" and c.deviation < MAX_RELATIVE_DEVIATION * abs(c.value):
                values[c.joint] = 1.0 / c.value
        return values

    @property
    def _commands(self) -> str:
        description = "held until the next one" if self.hold else "interpolated"
        if self.hold_is_told:
            return description
        rival = "interpolated, delays are half a sample time longer"
        if not self.hold:
            rival = "held until the next one, delays are half a sample time shorter"
        return f"{description}; the logs fit equally well if they are {rival}"

    @property
    def contact_words(self) -> str:
        """Effect of the contacts that were given on the fit, in words."""
        return f"{self.left_out} samples within them are left out of the fit"

    def _unit(self, c: Combination) -> str:
        """Return the unit of a parameter of a revolute or linear joint."""
        if self.bodies is None or self.bodies.model.robot.revolute[c.joint]:
            return c.unit.replace("u", "rad")
        return c.unit.replace("u", "m").replace("(N m)", "N")

    def simulate(self, log: Recording) -> list[np.ndarray]:
        """Simulate the segments of a log from their first positions, free-running.

        Args:
            log: Recording whose `forces` are the commands.

        Returns:
            Positions of each segment [samples, joints].
        """
        return [path.T for path in self.validate(log).simulated]

    def validate(self, logs: Sequence[Recording] | Recording) -> RolloutErrors:
        """Compare free-running simulations with logs, and with simple baselines.

        Every sample counts, but those within contacts that were given.

        Args:
            logs: Recordings whose `forces` are the commands.
        """
        simulator, states = self._simulation(logs)
        motion = simulator.motion
        baseline = ServoSimulator(motion, self.time_step)
        linear_positions = baseline.positions(self.linear, motion.start)
        samples = np.arange(motion.positions.shape[-1])
        times = motion.begin[:, None] + np.outer(motion.sample_time, samples)

        def cut(x: np.ndarray) -> tuple[np.ndarray, ...]:
            return tuple(y[..., :n] for y, n in zip(x, motion.lengths, strict=True))

        return RolloutErrors(
            self.joint_names,
            motion.names,
            cut(times),
            cut(motion.positions),
            cut(states.q),
            cut(motion.counted),
            {"linear": cut(linear_positions), "command": cut(motion.sent)},
        )

    def _simulation(
        self, logs: Sequence[Recording] | Recording
    ) -> tuple[ServoSimulator, State]:
        """Simulate logs; bodies load the joints at the simulated positions.

        Returns:
            The simulator, and the states at the samples [motions, joints, samples].
        """
        logs = [logs] if isinstance(logs, Recording) else logs
        motion = ServoMotion.of(logs, self.contacts)
        simulator = ServoSimulator(motion, self.time_step, self.hold, self.bodies)
        start = motion.start.copy()
        start[..., 2] = self._balanced_integrals(simulator)
        simulator = simulator.in_agreement(self.parameters, start)
        states = simulator.states(self.parameters, start)
        return simulator, State(*(x[..., :: simulator.steps] for x in states))

    def _balanced_integrals(self, simulator: ServoSimulator) -> np.ndarray:
        """Return initial integral actions, which balance the load at rest."""
        motion = simulator.motion
        ratios = {symbol: self.parameters[:, k] for symbol, k in INDEX.items()}
        error = ratios["g"] * motion.sent[..., 0] + ratios["b"] - motion.start[..., 0]
        load = ratios["a"] * simulator.loads[0][..., 0]
        return np.where(ratios["ki"] > 0.0, load - error, 0.0)

    def window_errors(
        self, logs: Sequence[Recording] | Recording, horizon: float = 1.0
    ) -> Vector:
        """Return RMS errors of windows that start from measured states [rad or m].

        The state at the start of a window is that of the free-running simulation, moved
        by its local error: errors change slowly, so that no fast motion is smoothed.

        Args:
            logs: Recordings whose `forces` are the commands.
            horizon: Length of the windows [s].
        """
        simulator, states = self._simulation(logs)
        motion = simulator.motion
        size = max(3, round(horizon / float(motion.sample_time.mean())))
        places = [
            (k, a, a + size)
            for k, n in enumerate(motion.lengths)
            for a in range(0, n - size + 1, size)
        ]
        motions, starts, _ = np.array(places).T
        simulated_states = np.stack(states, axis=-1)[motions, :, starts]
        errors = dataclasses.replace(motion, positions=motion.positions - states.q)
        start = simulated_states + errors.parts(places).start
        simulator = simulator.parts(places).in_agreement(self.parameters, start)
        paths = simulator.positions(self.parameters, start)
        windows = simulator.motion
        squares = ((paths - windows.positions) * windows.counted) ** 2
        return np.sqrt(squares.sum(axis=(0, 2)) / windows.counted.sum(axis=(0, 2)))

    def samples(self, count: int, seed: int = 0) -> np.ndarray:
        """Return parameters drawn from their t distributions, within their limits.

        Args:
            count: Number of draws.
            seed: Seed of the draws.
        """
        random = np.random.default_rng(seed)
        deviation = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance / deviation / deviation[:, None]
        zeros = np.zeros_like(deviation)
        normal_draws = random.multivariate_normal(
            zeros, correlation, count, check_valid="ignore", method="eigh"
        )
        probabilities = scipy.special.ndtr(np.clip(normal_draws, -7.0, 7.0))
        draws = np.tile(self.parameters, (count, 1, 1))
        draws[:, self.free] += deviation * scipy.special.stdtrit(
            self.dof, probabilities
        )
        return np.clip(draws, LOWER, UPPER)

    def summary(self) -> Table:
        """Return a table of what the logs determine, with 95 % intervals."""
        rows = self.combinations
        estimates = np.array([c.value for c in rows])
        deviations = np.array([c.deviation for c in rows])
        ends = np.array([c.interval() for c in rows]).reshape(-1, 2).T
        sizes = np.maximum(np.abs(estimates), 1e-12)
        is_clear = deviations < MAX_RELATIVE_DEVIATION * sizes
        is_clear &= np.array([c.agrees for c in rows], bool)
        joints = [c.joint for c in rows]
        joint_rows = (np.flatnonzero(np.diff(joints)) + 1).tolist()
        rms = np.sqrt((self.rms**2).mean(axis=0))
        error_texts = ", ".join(
            f"{name} {significant(1e3 * x)}"
            for name, x in zip(self.joint_names, rms, strict=True)
        )
        K = ", ".join(
            f"{name} {significant(k)}"
            for name, k in zip(self.joint_names, self.stiffness, strict=True)
            if np.isfinite(k)
        )
        facts = [
            ("logs", ", ".join(dict.fromkeys(self.motions))),
            ("errors of the fit", f"{error_texts} mrad or mm RMS"),
            ("commands", self._commands),
            ("stiffness", K or "not determined: all parameters are ratios to it"),
        ]
        if self.contacts:
            facts.append(("contacts given", self.contact_words))
        remarks: list[Remark | str] = [
            "positions determine inertias, friction, load and motor gain only in their "
            "ratios to the stiffness",
            *(Remark(note, Status.DOUBTFUL) for note in self.notes),
        ]
        return Table(
            "joints behind position servos",
            Column("joint", [self.joint_names[j] for j in joints]),
            Column("parameter", [c.name for c in rows]),
            Column("meaning", [c.meaning for c in rows]),
            *estimate_columns(estimates, deviations, ends, [*map(self._unit, rows)]),
            facts=facts,
            remarks=remarks,
            status=[Status.GOOD if x else Status.DOUBTFUL for x in is_clear],
            rules=joint_rows,
        )


def _notes_on_effects(
    undetermined: FreeParameters, joint_names: tuple[str, ...]
) -> list[str]:
    """Return a note for each effect that lowers errors and is not determined."""
    notes = []
    for k, parameter in enumerate(PARAMETERS):
        joints = [joint_names[j] for j in np.flatnonzero(undetermined[:, k])]
        # Stribeck friction and its speed are one effect.
        if joints and parameter.symbol != "vs":
            effect = parameter.meaning.capitalize()
            notes.append(
                f"{effect} is possible on {', '.join(joints)}, but the logs do not "
                "determine it: it is left out; record motions that show it"
            )
    return notes


def _notes_on_limits(fit: JointFit, joint_names: tuple[str, ...]) -> list[str]:
    """Return a note for each parameter that stands at a limit of the search."""
    notes = []
    for j, k in np.argwhere(fit.free):
        value = fit.parameters[j, k]
        is_limit = value in (UPPER[k], LOWER[k])
        # An integral gain or a delay of zero is none.
        if k in LIMITED_PARAMETERS and is_limit and value != 0.0:
            notes.append(
                f"{joint_names[j]}: {PARAMETERS[k].meaning} is at the limit of the "
                f"search, {value:.3g}: check signs, units and offsets of the commands"
            )
    return notes


def _notes_on_errors(fit: JointFit, joint_names: tuple[str, ...]) -> list[str]:
    """Return a note if errors show that an effect is missing."""
    motion = fit.simulator.motion
    path = fit.simulator.positions(fit.parameters, fit.start)
    rms = systematic_errors(path - motion.positions, motion)
    joint_errors = [
        f"{name} {1e3 * error:.2g}"
        for name, error in zip(joint_names, rms, strict=True)
        if error > 0.0
    ]
    if not joint_errors:
        return []
    return [
        "Errors are larger than an encoder's rounding and change slowly "
        f"({', '.join(joint_errors)} mrad or mm RMS): an effect is missing, such as "
        "other friction, play, elasticity or load, and the parameters "
        "compensate for it"
    ]


def systematic_errors(residuals: np.ndarray, motion: ServoMotion) -> Vector:
    """Return RMS errors [rad or m] of joints where an effect seems missing, else 0.

    Args:
        residuals: Errors of the positions [motions, joints, samples].
        motion: Measured positions.
    """
    places = (0, 2)
    counted = motion.counted
    r = residuals * counted
    sample_counts = counted.sum(axis=places)
    mean_squares = np.sum(r**2, axis=places) / sample_counts
    pairs = counted[..., 1:] * counted[..., :-1]
    products = np.sum(r[..., 1:] * r[..., :-1], axis=places)
    mean_products = products / pairs.sum(axis=places)
    steps = np.abs(np.diff(motion.positions))
    # Most steps of a slow joint are the smallest one; interpolated logs have smaller
    # ones, too.
    steps = np.where(steps > 1e-6, steps, np.nan)
    rounding = np.nanquantile(steps, 0.1, axis=places) / np.sqrt(12.0)
    is_slow = mean_products > 0.5 * mean_squares
    rms = np.sqrt(mean_squares)
    return np.where(is_slow & (rms > MIN_ROUNDING_RATIO * rounding), rms, 0.0)
