"""Fit of position-controlled joints: parameters, what they determine, and errors of rollouts."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from jaxid.arrays import AnyArray, Bool, Float, double_precision
from jaxid.identification.uncertainty.spectral import sandwich_of_columns
from jaxid.measurement.recording import Recording
from jaxid.result_table import Column, Remark, Status, Table, significant, with_deviations

from .contact import Contact, contact_rows, contacts, sustained_errors, typical_errors
from .errors import RolloutErrors
from .least_squares import Solution
from .motion import Bodies, ServoMotion
from .servo import INDEX, LOWER, PARAMETERS, SCALE, UPPER, ServoSimulator, coupled_states

UNDETERMINED = 0.5
"""Standard deviation, relative to a parameter's size, above which it is not determined."""
SYSTEMATIC = 1.5
"""Multiple of the encoder's rounding above which slow errors show a missing effect."""


class Combination(NamedTuple):
    """Parameter of a joint, or combination of some, that the logs determine.

    Attributes:
        joint: Index of the joint.
        name: Parameter, with those that are merged into it.
        meaning: Description in words.
        unit: Unit.
        coefficients: Factor of each parameter.
        value: Estimate.
        deviation: Standard deviation.
        dof: Degrees of freedom of the deviation.
    """

    joint: int
    name: str
    meaning: str
    unit: str
    coefficients: Float[np.ndarray, " parameters"]
    value: float
    deviation: float
    dof: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval."""
        half = self.deviation * float(special.stdtrit(max(self.dof, 1.0), 0.5 + 0.5 * level))
        return self.value - half, self.value + half


@dataclasses.dataclass(frozen=True)
class ServoFit:
    """Identified joints behind position servos.

    Attributes:
        joint_names: Names of the joints.
        parameters: Parameters of each joint, in the order of `jid.rollout.PARAMETERS`.
        free: Parameters that were estimated.
        covariance: Covariance of the parameters of each joint; zero where they are fixed.
        combinations: Parameters and combinations that the logs determine.
        linear: Parameters of the linear baseline.
        hold: Whether commands are held until the next one, instead of interpolated.
        time_step: Longest step of the simulation [s].
        rms: Errors of the identification [motions, joints] [rad or m].
        motions: Names of the logs.
        typical: Typical sustained error of each joint [rad or m].
        contacts: Stretches that were left out, because something held the robot.
        bodies: Bodies whose weight loads the joints; None without.
        load: Mean absolute load of each joint in the logs [N m or N].
        notes: Doubts about the model, in sentences.
    """

    joint_names: tuple[str, ...]
    parameters: Float[np.ndarray, "joints parameters"]
    free: Bool[np.ndarray, "joints parameters"]
    covariance: Float[np.ndarray, "joints parameters parameters"]
    combinations: tuple[Combination, ...]
    linear: Float[np.ndarray, "joints parameters"]
    hold: bool
    time_step: float
    rms: Float[np.ndarray, "motions joints"]
    motions: tuple[str, ...]
    typical: Float[np.ndarray, " joints"]
    contacts: tuple[Contact, ...]
    bodies: Bodies | None
    load: Float[np.ndarray, " joints"]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        simulator: ServoSimulator,
        weights: Float[np.ndarray, "motions joints"],
        solution: Solution,
        free: Bool[np.ndarray, "joints parameters"],
        linear: Float[np.ndarray, "joints parameters"],
        joint_names: tuple[str, ...],
        bodies: Bodies | None,
    ) -> "ServoFit":
        """Return the fit of a solution, with its uncertainty."""
        x, motion = solution.x, simulator.motion
        y, S = (y[:, 0] for y in simulator.sensitivities(x))
        r, S = (y - motion.positions) * motion.counted, S * np.asarray(motion.counted)[..., None]
        S = without_rates(S, np.maximum(np.mean(r**2, axis=-1), 1e-12))
        covariance, combinations, lacking = np.zeros((*x[0].shape, len(PARAMETERS))), [], []
        for j in range(len(x[0])):
            root, counted = np.sqrt(weights[:, j])[:, None], np.asarray(motion.counted)[:, j]
            scaled = root * r[:, j], root[..., None] * S[:, j]
            rows = _Rows(*scaled, counted.mean(axis=1), float(motion.sample_time.mean()))
            own, covariance[j] = _determined(rows, x[0, j], free[j], j)
            combinations += own
            if (
                rms := systematic_error(r[:, j], counted > 0, np.asarray(motion.positions)[:, j])
            ) > 0:
                lacking.append(f"{joint_names[j]} {1e3 * rms:.2g}")
        notes = (
            f"errors are larger than an encoder's rounding and change slowly "
            f"({', '.join(lacking)} mrad or mm RMS): an effect is missing, such as other friction, "
            "play, elasticity or load, and the parameters are those that imitate it best",
        )
        errors = np.where(np.asarray(motion.counted) > 0, r, 0.0)
        count = np.maximum(np.asarray(motion.counted).sum(axis=-1), 1.0)
        everything = y - np.asarray(motion.positions)
        typical = typical_errors(motion, sustained_errors(motion, everything))
        return cls(
            joint_names,
            x[0],
            free,
            covariance,
            tuple(combinations),
            linear,
            simulator.hold,
            simulator.time_step,
            np.sqrt((errors**2).sum(axis=-1) / count),
            motion.names,
            typical,
            contacts(motion, everything, typical),
            bodies,
            np.abs(motion.load).mean(axis=(0, 2)),
            notes if lacking else (),
        )

    @cached_property
    def stiffness(self) -> Float[np.ndarray, " joints"]:
        """Stiffness of each servo [N m/rad or N/m], where a known weight tells it; else NaN."""
        a = self.parameters[:, INDEX["a"]]
        found = np.full(len(a), np.nan)
        for c in self.combinations:
            if c.name == "a" and c.deviation < UNDETERMINED * abs(c.value):
                found[c.joint] = 1.0 / c.value
        return found

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

    def paths(self, motion: ServoMotion, parameters: AnyArray | None = None) -> np.ndarray:
        """Return simulated positions [motions, joints, samples], with loads at these positions."""
        x = np.asarray(self.parameters if parameters is None else parameters)
        simulator = ServoSimulator(motion, self.time_step, self.hold)
        if self.bodies is None:
            return simulator.paths(x[None])[:, 0]
        loaded = self.bodies.loads(motion, np.asarray(motion.commands))
        states = dataclasses.replace(simulator, motion=loaded).states_of(x)
        return coupled_states(simulator, self.bodies, x, states)[0][..., :: simulator.steps]

    def validate(self, logs: Sequence[Recording] | Recording) -> RolloutErrors:
        """Compare free-running simulations with logs, and with simple baselines.

        Args:
            logs: Recordings whose `forces` are the commands.
        """
        motion = ServoMotion.of([logs] if isinstance(logs, Recording) else logs)
        simulated = self.paths(motion)
        linear = ServoSimulator(motion, self.time_step).paths(self.linear[None])[:, 0]
        errors = simulated - np.asarray(motion.positions)
        touched = contact_rows(motion, errors, self.typical)
        parts = range(motion.motions)
        lengths, times = motion.lengths, motion.sample_time

        def cut(x: AnyArray) -> tuple[np.ndarray, ...]:
            return tuple(np.asarray(x[k])[..., : lengths[k]] for k in parts)

        return RolloutErrors(
            self.joint_names,
            motion.names,
            tuple(float(times[k]) * np.arange(lengths[k]) for k in parts),
            cut(motion.positions),
            cut(simulated),
            cut(motion.commands),
            cut(linear),
            cut((np.asarray(motion.counted) > 0) & ~touched),
            contacts(motion, errors, self.typical),
        )

    def window_errors(
        self, logs: Sequence[Recording] | Recording, horizon: float = 1.0
    ) -> Float[np.ndarray, " joints"]:
        """Return root mean square errors of windows that start from measured states [rad or m].

        Args:
            logs: Recordings whose `forces` are the commands.
            horizon: Length of the windows [s].
        """
        windows = ServoMotion.of([logs] if isinstance(logs, Recording) else logs).windows(horizon)
        errors = self.paths(windows) - np.asarray(windows.positions)
        return np.sqrt(np.mean(errors**2, axis=(0, 2)))

    def samples(self, count: int, seed: int = 0) -> Float[np.ndarray, "count joints parameters"]:
        """Return parameters drawn from their distribution, within their limits.

        Args:
            count: Number of draws.
            seed: Seed of the draws.
        """
        random = np.random.default_rng(seed)
        draws = np.tile(self.parameters, (count, 1, 1))
        for j, C in enumerate(self.covariance):
            size, vectors = np.linalg.eigh(C / SCALE / SCALE[:, None])
            root = SCALE[:, None] * vectors * np.sqrt(np.maximum(size, 0.0))
            draws[:, j] += random.normal(size=(count, len(C))) @ root.T
        return np.clip(draws, LOWER, UPPER)

    def summary(self) -> Table:
        """Return a table of what the logs determine, with 95 % intervals."""
        rows = self.combinations
        values, deviations = with_deviations([c.value for c in rows], [c.deviation for c in rows])
        ends = np.array([c.interval() for c in rows]).reshape(-1, 2)
        low, high = (with_deviations(x, [c.deviation for c in rows])[0] for x in ends.T)
        size = np.array([abs(c.value) for c in rows])
        clear = np.array([c.deviation for c in rows]) < 0.25 * np.maximum(size, 1e-12)
        first = [k for k in range(1, len(rows)) if rows[k].joint != rows[k - 1].joint]
        K = ", ".join(
            f"{name} {significant(k)}"
            for name, k in zip(self.joint_names, self.stiffness, strict=True)
            if np.isfinite(k)
        )
        facts = [
            ("logs", ", ".join(dict.fromkeys(self.motions))),
            (
                "errors",
                "  ".join(significant(1e3 * x) for x in np.sqrt((self.rms**2).mean(axis=0)))
                + "  mrad or mm RMS",
            ),
            ("commands", "held until the next one" if self.hold else "interpolated"),
            ("stiffness", K or "not determined: all parameters are ratios to it"),
        ]
        remarks: list[Remark | str] = [
            "positions determine inertias, friction, load and motor gain only in their ratios to "
            "the stiffness",
            *(Remark(note, Status.DOUBTFUL) for note in self.notes),
            *(
                Remark(
                    f"{c.name}: from {c.start:.1f} s to {c.stop:.1f} s something held "
                    f"{self.joint_names[c.joint]} (contact?): left out",
                    Status.DOUBTFUL,
                )
                for c in self.contacts
            ),
        ]
        return Table(
            "joints behind position servos",
            Column("joint", [self.joint_names[c.joint] for c in rows]),
            Column("parameter", [c.name for c in rows]),
            Column("meaning", [c.meaning for c in rows]),
            Column("estimate", values, kind="number"),
            Column("±", deviations, kind="number"),
            Column("unit", [c.unit.replace("u", "rad") for c in rows]),
            Column("95 %\nfrom", low, kind="number"),
            Column("95 %\nto", high, kind="number"),
            facts=facts,
            remarks=remarks,
            status=[Status.GOOD if x else Status.DOUBTFUL for x in clear],
            rules=first,
        )

    def __str__(self) -> str:
        return self.summary().text()


def without_rates(S: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return sensitivities to the parameters less what initial velocities can imitate."""
    start, own = S[..., -1:], S[..., :-1]
    known = np.sum(start**2, axis=-2, keepdims=True) + variance[..., None, None]
    return own - start * np.sum(start * own, axis=-2, keepdims=True) / known


class _Rows(NamedTuple):
    """Weighted residuals and sensitivities of one joint, in all motions.

    Attributes:
        residuals: Residuals [motions, samples].
        sensitivities: Sensitivities [motions, samples, parameters].
        exposure: Fraction of the samples of each motion that count.
        sample_time: Mean sample time [s].
    """

    residuals: np.ndarray
    sensitivities: np.ndarray
    exposure: np.ndarray
    sample_time: float

    def covariance(self, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return covariance and degrees of freedom of some parameters.

        The spectral sandwich; where motions differ more than it explains, their scatter.
        """
        S, count = self.sensitivities[..., own], len(self.residuals)
        A = S.reshape(-1, S.shape[-1])
        B = _inverse(A.T @ A)
        with double_precision():
            found = sandwich_of_columns(
                [range(len(B))] * count,
                np.ones(count),
                B,
                np.zeros((1, len(B))),
                list(np.moveaxis(S, 1, 2)),
                list(self.residuals[:, None]),
                self.exposure,
                self.sample_time,
            )
        variance, dof = (np.asarray(x)[0] for x in found)
        correlation = B / np.sqrt(np.outer(np.diag(B), np.diag(B)))
        scores = np.einsum("mtp,mt->mp", S, self.residuals) @ B
        scatter = count / max(count - 1, 1) * (scores**2).sum(axis=0)
        limit = stats.f.ppf(0.95, count - 1, dof) if count > 1 else np.inf
        differ = scatter > limit * variance
        dof = np.where(differ, count - 1.0, dof)
        deviation = np.sqrt(np.where(differ, scatter, variance))
        return correlation * np.outer(deviation, deviation), dof


def systematic_error(r: np.ndarray, kept: np.ndarray, q: np.ndarray) -> float:
    """Return a joint's RMS error [rad or m] if it looks like a missing effect; otherwise 0.

    Args:
        r: Residuals [motions, samples].
        kept: Whether a sample counts.
        q: Measured positions.
    """
    rms = float(np.sqrt(np.mean(r[kept] ** 2)))
    both = kept[:, 1:] & kept[:, :-1]
    neighbours = float(np.mean((r[:, 1:] * r[:, :-1])[both])) / rms**2
    steps = np.abs(np.diff(q, axis=-1)).ravel()
    steps = steps[steps > 1e-6]
    # Most steps of a slow joint are the smallest one; interpolated logs have smaller ones, too.
    rounding = float(np.quantile(steps, 0.1)) / np.sqrt(12.0) if steps.size else 0.0
    return 0.0 if rms < SYSTEMATIC * rounding or neighbours < 0.5 else rms


def _inverse(H: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, large but finite where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-30))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    scaled = vectors / np.maximum(values, 1e-12) @ vectors.T
    return scaled / np.outer(size, size)


def _determined(
    rows: _Rows, x: np.ndarray, moving: np.ndarray, joint: int
) -> tuple[list[Combination], np.ndarray]:
    """Return the combinations that a joint's rows determine, and the covariance of all."""
    covariance, _ = rows.covariance(moving)
    index = np.flatnonzero(moving)
    size = np.maximum(np.abs(x[index]), 0.1 * SCALE[index])
    own, kappa = _merge(covariance / np.outer(size, size))
    kappa = kappa * size[own][:, None] / size[None, :]
    chosen = np.zeros(len(x), bool)
    chosen[index[own]] = True
    reduced, dof = rows.covariance(chosen)
    full = np.zeros((len(x), len(x)))
    full[np.ix_(index, index)] = covariance
    found = []
    for k, i in enumerate(index[own]):
        coefficients = np.zeros(len(x))
        coefficients[index] = kappa[k]
        merged = [m for m in np.flatnonzero(coefficients) if m != i]
        parts = [f"{coefficients[m]:+.3g} {PARAMETERS[m].symbol}" for m in merged]
        name = " ".join([PARAMETERS[i].symbol, *parts])
        meaning = PARAMETERS[i].meaning
        if merged:
            others = ", ".join(PARAMETERS[m].meaning for m in merged)
            meaning = f"{meaning} and {others} only together"
        numbers = float(coefficients @ x), float(np.sqrt(reduced[k, k])), float(dof[k])
        unit = PARAMETERS[i].unit
        found.append(Combination(joint, name, meaning, unit, coefficients, *numbers))
    return found, full


def _merge(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which relative parameters are determined, and how the others merge into them.

    A parameter is not determined if, with those before it known only by the logs, its deviation
    exceeds `UNDETERMINED`: its column of the information's root adds almost nothing.
    """
    n = len(covariance)
    information = _inverse(covariance)
    values, vectors = np.linalg.eigh(information)
    W = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    own: list[int] = []
    Q = np.zeros((n, 0))
    for k in range(n):
        new = W[:, k] - Q @ (Q.T @ W[:, k])
        if np.linalg.norm(new) > 1.0 / UNDETERMINED:
            own.append(k)
            Q = np.column_stack([Q, new / np.linalg.norm(new)])
    kappa = np.zeros((len(own), n))
    if own:
        kappa = np.linalg.lstsq(W[:, own], W, rcond=None)[0]
        kappa[:, own] = np.eye(len(own))
        kappa[np.abs(kappa) < 0.02] = 0.0
    return np.array(own, int), kappa
