"""Fit of position-controlled joints: determined parameters, and errors of rollouts."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.identification.run_to_run import Run
from jaxid.identification.uncertainty import Uncertainty
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
from .determined_combinations import Combination, determined_combinations
from .errors import RolloutErrors
from .joint_fits import JointFit
from .motion import Contacts, FreeParameters, JointParameters, ServoMotion
from .servo import INDEX, LOWER, PARAMETERS, UPPER, State
from .simulation import ServoSimulator

LIMITED_PARAMETERS = [INDEX[x] for x in ("B", "d", "b", "um", "g", "ki")]
"""Parameters that are not at a limit of the search unless something is wrong."""


@dataclasses.dataclass(frozen=True)
class ServoFit(Summarised):
    """Identified joints behind position servos.

    Attributes:
        joint_names: Names of the joints.
        parameters: Parameters of each joint, in the order of `jid.rollout.PARAMETERS`.
        free: Parameters that were estimated.
        uncertainty: Uncertainty of the estimated parameters, joint by joint.
        combinations: Parameters and combinations that the logs determine.
        linear: Parameters of the linear baseline.
        hold: Whether commands are held until the next one, instead of interpolated.
        time_step: Longest step of the simulation [s].
        rms: Errors of the identification of each joint [rad or m].
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

    joint_names: Texts
    parameters: JointParameters
    free: FreeParameters
    uncertainty: Uncertainty
    combinations: tuple[Combination, ...]
    linear: JointParameters
    hold: bool
    time_step: float
    rms: Vector
    motions: Texts
    bodies: Bodies | None
    load: Vector
    notes: Texts = ()
    hold_is_told: bool = True
    gains: Mapping[str, Vector] = dataclasses.field(default_factory=dict)
    compliances: tuple[Combination, ...] = ()
    contacts: Contacts = ()
    left_out: int = 0

    @classmethod
    def of(
        cls,
        fit: JointFit,
        joint_names: Texts,
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
        )
        return cls(
            joint_names=joint_names,
            parameters=fit.parameters,
            free=fit.free,
            uncertainty=determination.uncertainty,
            combinations=determination.combinations,
            hold=simulator.hold,
            time_step=simulator.time_step,
            rms=np.sqrt(fit.mean_squares.mean(axis=0)),
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
            if c.name == "a" and c.is_determined:
                values[c.joint] = 1.0 / c.value
        return values

    @property
    def run(self) -> Run:
        """Estimates under the names of the logs, as `jid.agreement` takes them."""
        rows = self.combinations
        deviations = np.array([c.deviation for c in rows])
        return Run(
            name=", ".join(dict.fromkeys(self.motions)),
            names=tuple(f"{c.name} ({self.joint_names[c.joint]})" for c in rows),
            units=tuple(c.unit for c in rows),
            kinds=tuple(c.meaning for c in rows),
            parameters=np.array([c.value for c in rows]),
            covariance=np.diag(deviations**2),
            dof=float(np.median([c.dof for c in rows])),
        )

    @property
    def has_stiffness(self) -> bool:
        """Whether simulators can be given absolute numbers."""
        return bool(np.isfinite(self.stiffness).any())

    @property
    def _commands(self) -> str:
        description = "held until the next one" if self.hold else "interpolated"
        if self.hold_is_told:
            return description
        return (
            f"{description}; the logs fit equally well if they are not, with delays "
            f"half a sample time {'shorter' if self.hold else 'longer'}"
        )

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

    def _balanced_integrals(self, simulator: ServoSimulator) -> Matrix:
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
        draws = np.tile(self.parameters, (count, 1, 1))
        draws[:, self.free] += self.uncertainty.random_errors(count, seed)
        return np.clip(draws, LOWER, UPPER)

    def summary(self) -> Table:
        """Return a table of what the logs determine, with 95 % intervals."""
        rows = self.combinations
        ends = np.array([c.interval() for c in rows]).reshape(-1, 2).T
        joints = [c.joint for c in rows]
        K = self._by_joint(self.stiffness)
        facts = [
            ("logs", ", ".join(dict.fromkeys(self.motions))),
            ("errors of the fit", f"{self._by_joint(1e3 * self.rms)} mrad or mm RMS"),
            ("commands", self._commands),
            ("stiffness", K or "not determined: all parameters are ratios to it"),
        ]
        if self.contacts:
            text = f"{self.left_out} samples within them are left out of the fit"
            facts.append(("contacts given", text))
        remarks: list[Remark | str] = [
            "Positions determine inertias, friction, load and motor gain only in their "
            "ratios to the stiffness."
        ]
        status = [_status(c) for c in rows]
        if Status.NEUTRAL in status:
            remarks.append(
                "1 / stiffness is as good as the masses of the given bodies: logs "
                "determine only the product of both, and intervals do not contain "
                "errors of the masses."
            )
        remarks += [Remark(note, Status.DOUBTFUL) for note in self.notes]
        return Table(
            "joints behind position servos",
            Column("joint", [self.joint_names[j] for j in joints]),
            Column("parameter", [c.name for c in rows]),
            Column("meaning", [c.meaning for c in rows]),
            *estimate_columns(
                [c.value for c in rows],
                [c.deviation for c in rows],
                ends,
                [c.unit for c in rows],
            ),
            facts=facts,
            remarks=remarks,
            status=status,
            rules=(np.flatnonzero(np.diff(joints)) + 1).tolist(),
        )

    def _by_joint(self, values: Vector) -> str:
        """Return the values that are known, each behind the name of its joint."""
        pairs = zip(self.joint_names, values, strict=True)
        return ", ".join(
            f"{name} {significant(x)}" for name, x in pairs if np.isfinite(x)
        )


def _status(combination: Combination) -> Status:
    """Return the judgement of an estimate; none if it depends on given masses."""
    if not (combination.is_determined and combination.agrees):
        return Status.DOUBTFUL
    depends_on_masses = combination.coefficients[INDEX["a"]] != 0.0
    return Status.NEUTRAL if depends_on_masses else Status.GOOD


def _notes_on_effects(undetermined: FreeParameters, joint_names: Texts) -> list[str]:
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


def _notes_on_limits(fit: JointFit, joint_names: Texts) -> list[str]:
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
