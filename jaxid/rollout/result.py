"""Fit of position-controlled joints: determined parameters, and errors of rollouts."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.identification.uncertainty.spectral import sandwich_of_columns
from jaxid.measurement.recording import Recording
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Table,
    significant,
    with_deviations,
)

from .bodies import Bodies
from .coupled import CoupledSimulator
from .errors import RolloutErrors
from .motion import ServoMotion
from .refine import Refinement, mean_squares, weights_of
from .servo import INDEX, LOWER, PARAMETERS, SCALE, UPPER, with_integral
from .uncoupled import ServoSimulator

MAX_RELATIVE_DEVIATION = 0.25
"""Relative standard deviation of a parameter above which it is not determined."""
LIMITED_PARAMETERS = [INDEX[x] for x in ("B", "d", "b", "um", "g", "ki")]
"""Parameters that are not at a limit of the search unless something is wrong."""
MIN_ROUNDING_RATIO = 1.5
"""Multiple of the encoder's rounding above which slow errors show a missing effect."""


class Combination(NamedTuple):
    """Parameter of a joint, or combination of some, that the logs determine.

    Attributes:
        joint: Index of the joint.
        name: Parameter, with those that are merged into it.
        meaning: Description in words.
        unit: Unit.
        coefficients: Factor of each parameter of all joints.
        value: Estimate.
        deviation: Standard deviation.
        dof: Degrees of freedom of the deviation.
    """

    joint: int
    name: str
    meaning: str
    unit: str
    coefficients: Float[np.ndarray, "joints parameters"]
    value: float
    deviation: float
    dof: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval."""
        half_width = self.deviation * float(
            special.stdtrit(max(self.dof, 1.0), 0.5 + 0.5 * level)
        )
        return self.value - half_width, self.value + half_width


@dataclasses.dataclass(frozen=True)
class ServoFit:
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
        given_stiffness: Stiffness of each servo as far as it was given, else NaN [N
            m/rad or N/m].
    """

    joint_names: tuple[str, ...]
    parameters: Float[np.ndarray, "joints parameters"]
    free: Bool[np.ndarray, "joints parameters"]
    covariance: Float[np.ndarray, "free free"]
    dof: Float[np.ndarray, " free"]
    combinations: tuple[Combination, ...]
    linear: Float[np.ndarray, "joints parameters"]
    hold: bool
    time_step: float
    rms: Float[np.ndarray, "motions joints"]
    motions: tuple[str, ...]
    bodies: Bodies | None
    load: Float[np.ndarray, " joints"]
    notes: tuple[str, ...] = ()
    hold_is_told: bool = True
    given_stiffness: Float[np.ndarray, " joints"] | None = None

    @classmethod
    def of(
        cls,
        refinement: Refinement,
        linear: Float[np.ndarray, "joints parameters"],
        joint_names: tuple[str, ...],
        hold_is_told: bool = True,
        given_stiffness: Float[np.ndarray, " joints"] | None = None,
    ) -> "ServoFit":
        """Return the fit of a refinement, with its uncertainty."""
        simulator = refinement.simulator
        r = refinement.residuals
        motion = simulator.motion
        combinations, covariance, dof = _determined_combinations(
            _Rows.of(refinement), refinement, joint_names
        )
        positions = np.asarray(motion.positions)
        joint_errors = []
        for j, name in enumerate(joint_names):
            counted_samples = np.asarray(motion.counted)[:, j] > 0
            if (rms := systematic_error(r[:, j], counted_samples, positions[:, j])) > 0:
                joint_errors.append(f"{name} {1e3 * rms:.2g}")
        notes = [
            f"{joint_names[j]}: {PARAMETERS[k].meaning} is at the limit of the search, "
            f"{refinement.parameters[j, k]:.3g}: check signs, units and offsets of the "
            "commands"
            for j, k in np.argwhere(refinement.free)
            # An integral gain of zero is none.
            if k in LIMITED_PARAMETERS
            and refinement.parameters[j, k] in (UPPER[k], LOWER[k])
            if refinement.parameters[j, k] != 0.0
        ]
        integral = "" if refinement.free[:, INDEX["ki"]].any() else ", integral action"
        effect_note = (
            "errors are larger than an encoder's rounding and change slowly "
            f"({', '.join(joint_errors)} mrad or mm RMS): an effect is missing, such "
            f"as other friction, play, elasticity{integral} or load, and the "
            "parameters are those that imitate it best"
        )
        load = np.zeros_like(motion.positions)
        if simulator.bodies is not None:
            load = simulator.bodies.loads(motion).load
        return cls(
            joint_names,
            refinement.parameters,
            refinement.free,
            covariance,
            dof,
            combinations,
            linear,
            simulator.hold,
            simulator.time_step,
            np.sqrt(mean_squares(motion, refinement.sums)),
            motion.names,
            simulator.bodies,
            np.abs(load).mean(axis=(0, 2)),
            (*notes, *([effect_note] if joint_errors else [])),
            hold_is_told,
            given_stiffness,
        )

    @cached_property
    def stiffness(self) -> Float[np.ndarray, " joints"]:
        """Stiffness of each servo [N m/rad or N/m]; NaN where it is unknown.

        It is given, or told by a known weight.
        """
        values = np.full(len(self.joint_names), np.nan)
        if self.given_stiffness is not None:
            values = self.given_stiffness.copy()
        for c in self.combinations:
            if c.name == "a" and c.deviation < MAX_RELATIVE_DEVIATION * abs(c.value):
                values[c.joint] = 1.0 / c.value
        return values

    @property
    def _commands(self) -> str:
        description = "held until the next one" if self.hold else "interpolated"
        if self.hold_is_told:
            return description
        return (
            f"{description}; if held, delays are half a sample time shorter: the "
            "logs do not tell"
        )

    def _unit(self, c: Combination) -> str:
        """Return the unit of a parameter of a revolute or linear joint."""
        if self.bodies is None or self.bodies.model.robot.revolute[c.joint]:
            return c.unit.replace("u", "rad")
        return c.unit.replace("u", "m").replace("(N m)", "N")

    def of_parameter(self, symbol: str) -> Float[np.ndarray, " joints"]:
        """Return a parameter of all joints by its symbol, like `"J"`."""
        return self.parameters[:, INDEX[symbol]]

    def simulate(self, log: Recording) -> list[np.ndarray]:
        """Simulate the segments of a log from their first positions, free-running.

        Args:
            log: Recording whose `forces` are the commands.

        Returns:
            Positions of each segment [samples, joints].
        """
        motion = ServoMotion.of([log])
        paths = self.paths(motion)
        return [path[:, :n].T for path, n in zip(paths, motion.lengths, strict=True)]

    def paths(self, motion: ServoMotion) -> Float[np.ndarray, "motions joints samples"]:
        """Return simulated positions [motions, joints, samples].

        The loads are those at the simulated positions.
        """
        x = self.parameters
        if x[:, INDEX["ki"]].any():
            loaded_motion = motion if self.bodies is None else self.bodies.loads(motion)
            motion = with_integral(loaded_motion, x, self.hold)
        simulator = CoupledSimulator(motion, self.time_step, self.hold, self.bodies)
        return simulator.positions(simulator.simulate(x))

    def validate(self, logs: Sequence[Recording] | Recording) -> RolloutErrors:
        """Compare free-running simulations with logs, and with simple baselines.

        Args:
            logs: Recordings whose `forces` are the commands.
        """
        motion = ServoMotion.of([logs] if isinstance(logs, Recording) else logs)
        simulated_positions = self.paths(motion)
        linear_positions = ServoSimulator(motion, self.time_step).paths(
            self.linear[None]
        )[:, 0]
        parts = range(motion.motions)
        lengths = motion.lengths
        times = motion.begin[:, None] + np.outer(
            motion.sample_time, np.arange(max(lengths))
        )

        def cut(x: AnyArray) -> tuple[np.ndarray, ...]:
            return tuple(np.asarray(x[k])[..., : lengths[k]] for k in parts)

        return RolloutErrors(
            self.joint_names,
            motion.names,
            cut(times),
            cut(motion.positions),
            cut(simulated_positions),
            cut(motion.sent),
            cut(linear_positions),
            cut(np.asarray(motion.counted) > 0),
        )

    def window_errors(
        self, logs: Sequence[Recording] | Recording, horizon: float = 1.0
    ) -> Float[np.ndarray, " joints"]:
        """Return RMS errors of windows that start from measured states [rad or m].

        Args:
            logs: Recordings whose `forces` are the commands.
            horizon: Length of the windows [s].
        """
        windows = ServoMotion.of(
            [logs] if isinstance(logs, Recording) else logs
        ).windows(horizon)
        errors = self.paths(windows) - np.asarray(windows.positions)
        return np.sqrt(np.mean(errors**2, axis=(0, 2)))

    def samples(
        self, count: int, seed: int = 0
    ) -> Float[np.ndarray, "count joints parameters"]:
        """Return parameters drawn from their t distributions, within their limits.

        Args:
            count: Number of draws.
            seed: Seed of the draws.
        """
        random = np.random.default_rng(seed)
        draws = np.tile(self.parameters, (count, 1, 1))
        deviation = np.sqrt(np.diag(self.covariance))
        size, vectors = np.linalg.eigh(self.covariance / deviation / deviation[:, None])
        root = vectors * np.sqrt(np.maximum(size, 0.0))
        normal_draws = np.clip(
            random.normal(size=(count, len(root))) @ root.T, -7.0, 7.0
        )
        draws[:, self.free] += deviation * special.stdtrit(
            self.dof, special.ndtr(normal_draws)
        )
        return np.clip(draws, LOWER, UPPER)

    def summary(self) -> Table:
        """Return a table of what the logs determine, with 95 % intervals."""
        rows = self.combinations
        values, deviations = with_deviations(
            [c.value for c in rows], [c.deviation for c in rows]
        )
        ends = np.array([c.interval() for c in rows]).reshape(-1, 2)
        lower_ends, upper_ends = (
            with_deviations(x, [c.deviation for c in rows])[0] for x in ends.T
        )
        size = np.array([abs(c.value) for c in rows])
        is_clear = np.array(
            [c.deviation for c in rows]
        ) < MAX_RELATIVE_DEVIATION * np.maximum(size, 1e-12)
        joint_rows = [
            k for k in range(1, len(rows)) if rows[k].joint != rows[k - 1].joint
        ]
        K = ", ".join(
            f"{name} {significant(k)}"
            for name, k in zip(self.joint_names, self.stiffness, strict=True)
            if np.isfinite(k)
        )
        facts = [
            ("logs", ", ".join(dict.fromkeys(self.motions))),
            (
                "errors",
                "  ".join(
                    significant(1e3 * x) for x in np.sqrt((self.rms**2).mean(axis=0))
                )
                + "  mrad or mm RMS",
            ),
            ("commands", self._commands),
            ("stiffness", K or "not determined: all parameters are ratios to it"),
        ]
        remarks: list[Remark | str] = [
            "positions determine inertias, friction, load and motor gain only in their "
            "ratios to the stiffness",
            *(Remark(note, Status.DOUBTFUL) for note in self.notes),
        ]
        return Table(
            "joints behind position servos",
            Column("joint", [self.joint_names[c.joint] for c in rows]),
            Column("parameter", [c.name for c in rows]),
            Column("meaning", [c.meaning for c in rows]),
            Column("estimate", values, kind="number"),
            Column("±", deviations, kind="number"),
            Column("unit", [self._unit(c) for c in rows]),
            Column("95 %\nfrom", lower_ends, kind="number"),
            Column("95 %\nto", upper_ends, kind="number"),
            facts=facts,
            remarks=remarks,
            status=[Status.GOOD if x else Status.DOUBTFUL for x in is_clear],
            rules=joint_rows,
        )

    def __str__(self) -> str:
        return self.summary().text()


class _Rows(NamedTuple):
    """Weighted sensitivities of a refinement, less what initial states can imitate.

    Attributes:
        refinement: Refinement.
        weights: Weight of each motion's squared errors [motions, joints].
        imitations: Initial states that imitate each parameter [motions, states,
            parameters].
        scores: Sensitivities times residuals [motions, parameters].
        information: Gauss-Newton matrix.
    """

    refinement: Refinement
    weights: np.ndarray
    imitations: np.ndarray
    scores: np.ndarray
    information: np.ndarray

    @classmethod
    def of(cls, refinement: Refinement) -> "_Rows":
        """Return the rows of a refinement."""
        weights = weights_of(refinement.simulator.motion, refinement.sums)
        size = refinement.simulator.motion.start[0].size
        scores = []
        imitations = []
        information = np.zeros((int(refinement.free.sum()),) * 2)
        certainties = refinement.simulator.motion.certainty
        for w, g, H, certainty in zip(
            weights, *refinement.products, certainties, strict=True
        ):
            motion_g = w @ g
            motion_H = np.tensordot(w, H, 1)
            state_information = motion_H[-size:, -size:] + np.diag(certainty.ravel())
            imitations.append(
                np.linalg.solve(state_information, motion_H[-size:, :-size])
            )
            scores.append(motion_g[:-size] - motion_g[-size:] @ imitations[-1])
            information += (
                motion_H[:-size, :-size] - motion_H[:-size, -size:] @ imitations[-1]
            )
        return cls(
            refinement, weights, np.stack(imitations), np.stack(scores), information
        )

    @property
    def columns(self) -> list[np.ndarray]:
        """Sensitivities of each motion and joint [parameters, samples]."""
        columns = []
        for S, start in zip(
            self.refinement.sensitivities, self.imitations, strict=True
        ):
            by_parameters = S[..., : -len(start)]
            by_start = S[..., -len(start) :]
            columns += list(np.swapaxes(by_parameters - by_start @ start, 1, 2))
        return columns

    def covariance(
        self, columns: list, indices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return covariance and degrees of freedom if only some parameters are unknown.

        The spectral sandwich, at least that of independent errors; where motions differ
        more than it explains, their scatter.
        """
        motion = self.refinement.simulator.motion
        motions, joints = self.weights.shape
        B = np.zeros_like(self.information)
        place = np.ix_(indices, indices)
        B[place] = _inverse(self.information[place])
        sandwich = sandwich_of_columns(
            np,
            [range(len(B))] * (motions * joints),
            np.sqrt(self.weights).ravel(),
            B,
            np.zeros((1, len(B))),
            columns,
            list(self.refinement.residuals.reshape(motions * joints, 1, -1)),
            np.asarray(motion.counted).mean(axis=-1).ravel(),
            float(motion.sample_time.mean()),
        )
        variance, dof = (x[0] for x in sandwich)
        # The sandwich is blind where no error can show: there the information alone
        # tells.
        samples = np.asarray(motion.counted).sum(axis=-1).max()
        variance = np.maximum(variance, np.diag(B) / max(float(samples), 1.0))
        size = np.sqrt(np.maximum(np.diag(B), 1e-300))
        changes = self.scores @ B
        scatter = motions / max(motions - 1, 1) * (changes**2).sum(axis=0)
        limit = stats.f.ppf(0.95, max(motions - 1, 1), dof)
        scatter_mask = (motions > 1) & (scatter > limit * variance)
        dof = np.where(scatter_mask, motions - 1.0, dof)
        deviation = np.sqrt(np.where(scatter_mask, scatter, variance))
        return B / np.outer(size, size) * np.outer(deviation, deviation), dof


def systematic_error(r: np.ndarray, kept: np.ndarray, q: np.ndarray) -> float:
    """Return a joint's RMS error [rad or m] if an effect seems missing; otherwise 0.

    Args:
        r: Residuals [motions, samples].
        kept: Whether a sample counts.
        q: Measured positions.
    """
    rms = float(np.sqrt(np.mean(r[kept] ** 2)))
    pair_mask = kept[:, 1:] & kept[:, :-1]
    neighbours = float(np.mean((r[:, 1:] * r[:, :-1])[pair_mask])) / rms**2
    steps = np.abs(np.diff(q, axis=-1)).ravel()
    steps = steps[steps > 1e-6]
    # Most steps of a slow joint are the smallest one; interpolated logs have smaller
    # ones, too.
    rounding = float(np.quantile(steps, 0.1)) / np.sqrt(12.0) if steps.size else 0.0
    return 0.0 if rms < MIN_ROUNDING_RATIO * rounding or neighbours < 0.5 else rms


def _inverse(H: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, finite where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-30))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    scaled_inverse = vectors / np.maximum(values, 1e-12) @ vectors.T
    return scaled_inverse / np.outer(size, size)


def _determined_combinations(
    rows: _Rows, refinement: Refinement, joint_names: tuple[str, ...]
) -> tuple[tuple[Combination, ...], np.ndarray, np.ndarray]:
    """Return the determined combinations, and covariance and dof of all parameters."""
    x = refinement.parameters[refinement.free]
    joints, symbols = np.nonzero(refinement.free)
    columns = rows.columns
    covariance, parameter_dof = rows.covariance(columns, np.arange(len(x)))
    size = np.maximum(np.abs(x), 0.1 * SCALE[symbols])
    interval_factors = (
        special.stdtrit(parameter_dof, 0.975) / special.ndtri(0.975) / size
    )
    indices, kappa = _merge(
        covariance * np.outer(interval_factors, interval_factors),
        np.maximum(np.abs(x), SCALE[symbols]) / size,
    )
    kappa = kappa * size[indices][:, None] / size[None, :]
    combination_covariance, dof = rows.covariance(columns, indices)
    combinations = []
    for k, i in enumerate(indices):
        coefficients = np.zeros(refinement.parameters.shape)
        coefficients[refinement.free] = kappa[k]
        name = PARAMETERS[symbols[i]].symbol
        meaning = PARAMETERS[symbols[i]].meaning
        merged_meanings = []
        for m in np.flatnonzero(kappa[k]):
            if m != i:
                is_elsewhere = joints[m] != joints[i]
                where = f" of {joint_names[joints[m]]}" if is_elsewhere else ""
                name += f" {kappa[k, m]:+.3g} {PARAMETERS[symbols[m]].symbol}{where}"
                merged_meanings.append(PARAMETERS[symbols[m]].meaning + where)
        if merged_meanings:
            meaning = f"{meaning} and {', '.join(merged_meanings)} only together"
        numbers = (
            float(kappa[k] @ x),
            float(np.sqrt(combination_covariance[i, i])),
            float(dof[i]),
        )
        unit = PARAMETERS[symbols[i]].unit
        place = int(joints[i]), name, meaning, unit, coefficients
        combinations.append(Combination(*place, *numbers))
    return tuple(combinations), covariance, parameter_dof


def _merge(covariance: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which relative parameters are determined, and how others merge into them.

    Args:
        covariance: Covariance of the relative parameters.
        reach: Usual size of each, to which it may change if it is not determined.

    A parameter is not determined if, with those before it known only by the logs, its
    deviation exceeds `MAX_RELATIVE_DEVIATION`: its column of the information's root
    adds almost nothing.
    """
    n = len(covariance)
    information = _inverse(covariance)
    values, vectors = np.linalg.eigh(information)
    W = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    indices: list[int] = []
    Q = np.zeros((n, 0))
    for k in range(n):
        remainder = W[:, k] - Q @ (Q.T @ W[:, k])
        if np.linalg.norm(remainder) > 1.0 / MAX_RELATIVE_DEVIATION:
            indices.append(k)
            Q = np.column_stack([Q, remainder / np.linalg.norm(remainder)])
    kappa = np.zeros((len(indices), n))
    if indices:
        kappa = np.linalg.lstsq(W[:, indices], W, rcond=None)[0]
        kappa[:, indices] = np.eye(len(indices))
        # What changes a combination by less than its deviation is left out.
        deviation = np.sqrt(np.diag(np.linalg.inv(W[:, indices].T @ W[:, indices])))
        kappa[np.abs(kappa) * reach < np.minimum(0.02, deviation)[:, None]] = 0.0
    return np.array(indices, int), kappa
