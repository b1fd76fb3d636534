"""Identification of joints behind position servos, from commands and positions alone.

Each choice of effects (gravity, friction by load, Stribeck friction, saturation, inertial torques)
is made by motions that the fit has not seen: leave one out among those given. Held and interpolated
commands have the same parameters: their errors decide.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from jaxid.arrays import Bool, Float
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

from .contact import contact_rows
from .least_squares import Solution, bounded_step, minimise
from .motion import Bodies, ServoMotion, settling
from .result import ServoFit
from .servo import INDEX, LOWER, START, UPPER, ServoSimulator, coupled_states

BASIC = ("J", "B", "d", "F", "b")
"""Parameters of every joint, before the choice."""
LINEAR = ("J", "B", "d", "b", "g")
"""Parameters of the baseline: a linear joint of second order with delay."""
EFFECTS = (
    ((), ("a",), ("b",), ("a", "b")),
    ((), ("mu",), ("Fs", "vs"), ("mu", "Fs", "vs")),
    ((), ("um",)),
)
"""Groups of effects, from which one each is chosen: bias or load; friction; saturation."""
GAIN = 0.04
"""Fall of the logarithm of the held-out mean square for which a larger model is chosen."""
FOLDS = 4
"""Smallest number of parts for the choice: fewer logs are divided."""
RESOLUTION = 1e-4
"""Errors below which no motion counts more [rad or m]."""
SHORTEST = 5.0
"""Shortest part into which a log is divided [s]."""
LIGHT = 0.02
"""Load, relative to the most loaded joint's, below which a joint counts as unloaded."""
FALL = 0.002
"""Fall of the logarithm of the mean square error for which the refinement goes on."""
NEARLY_NONE = 1e-6
"""Damping of the refinement: more would keep badly known combinations near the search's values."""
ROUNDS = 12
"""Largest number of refinements under loads of the simulated motion."""
_STARTS = [(J, B, d) for J in (2e-4, 2e-3, 1e-2) for B in (0.01, 0.04, 0.15) for d in (0.0, 0.02)]
"""Inertia, damping and delay from which searches may start."""


def identify_rollout(
    logs: Sequence[Recording] | Recording,
    bodies: Bodies | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    time_step: float = 0.01,
    saturation: bool = True,
    friction: bool = True,
) -> ServoFit:
    """Identify position-controlled joints so that a simulation moves like the robot.

    No torque is needed. The logs are recordings whose `forces` are the commanded positions:
    `jid.Recording.of(positions, commands, sample_time=…)`, or
    `jid.Columns(angles="position{}", forces="command{}")`.

    Positions tell torques in units of the servo's stiffness: the parameters are ratios to it. With
    bodies of known weight the stiffness itself follows where gravity acts on the joint.

    Args:
        logs: One or several recordings of the same robot and controller.
        bodies: Model and parameters of the robot's bodies, often from its URDF file: their weight
            loads the joints, and their inertial torques if that lowers the held-out errors (or
            `coupled` says so). Without them a joint has a constant bias.
        joint_names: Names of the joints; those of the model, or numbers, if None.
        time_step: Longest step of the simulation [s].
        saturation: Whether a largest torque of the servo is tried.
        friction: Whether friction that grows with load or falls with speed is tried.

    Raises:
        InputError: If logs differ in their joints, are too short, or do not move.
    """
    logs = [logs] if isinstance(logs, Recording) else list(logs)
    motion = ServoMotion.of(_divided(logs))
    _require_motion(motion)
    names = _joint_names(motion, bodies, joint_names)
    simulator = ServoSimulator(motion if bodies is None else bodies.loads(motion), time_step)
    # Commands held or interpolated differ within a sample time only; the rest shows in long steps.
    coarse = max(time_step, float(motion.sample_time.max()))
    search = _Search(dataclasses.replace(simulator, time_step=coarse))
    search.start()
    groups: list[Sequence[tuple[str, ...]]] = list(EFFECTS)
    if bodies is None:
        groups[0] = (("b",),)
    if not friction:
        groups[1] = ((),)
    if not saturation:
        groups[2] = ((),)
    for k, group in enumerate(groups):
        search.choose(group)
        if k == 0:
            search.remove_contact()
    search.simulator = dataclasses.replace(search.simulator, time_step=time_step)
    if bodies is not None and not bodies.coupled:
        bodies = search.choose_coupling(bodies)
    solution = search.refine(bodies)
    found = search.simulator, search.weights, solution, search.free, search.linear
    return ServoFit.of(*found, names, bodies)


def _divided(logs: Sequence[Recording]) -> list[Recording]:
    """Return logs, the long ones divided so that there are enough parts for the choice."""
    found = []
    for log in logs:
        parts = max(1, min(-(-FOLDS // len(logs)), int(log.duration // SHORTEST)))
        ends = np.linspace(float(log.time[0]), float(log.time[-1]) + log.sample_time, parts + 1)
        found += [log.crop(float(a), float(b)) for a, b in itertools.pairwise(ends)]
    return found


def _require_motion(motion: ServoMotion) -> None:
    for channel in ("positions", "commands"):
        still = np.ptp(getattr(motion, channel), axis=-1).max(axis=0) < 10 * RESOLUTION
        if still.any():
            joint = int(np.argmax(still)) + 1
            raise InputError(
                f"`logs`: the {channel} of joint {joint} never change: nothing can be identified. "
                "Leave the joint out, or give logs in which it moves."
            )


def _joint_names(
    motion: ServoMotion, bodies: Bodies | None, names: Sequence[str] | None
) -> tuple[str, ...]:
    count = motion.positions.shape[1]
    if bodies is not None:
        names = names or bodies.model.robot.joint_names
    names = tuple(names or (f"joint {k + 1}" for k in range(count)))
    if len(names) != count:
        raise InputError(
            f"`logs` have {count} joints, but the robot has {len(names)}: choose the columns of "
            "its joints, or the `tip` of the robot."
        )
    return names


def mask(symbols: Sequence[str]) -> Bool[np.ndarray, " parameters"]:
    """Return which parameters are among these."""
    return np.isin(list(INDEX), list(symbols))


class _Search:
    """Fits of all joints, candidate models and folds, in batches.

    Attributes:
        simulator: Motions and steps.
        weights: Weight of each motion's squared errors [motions, joints].
        x: Parameters so far [joints, parameters].
        free: Parameters that are estimated.
        linear: Parameters of the linear baseline.
    """

    def __init__(self, simulator: ServoSimulator):
        self.simulator = simulator
        counted = np.asarray(simulator.motion.counted).sum(axis=-1)
        self.weights = 1.0 / np.maximum(counted, 1.0)
        joints = counted.shape[1]
        self.x = np.tile(START, (joints, 1))
        self.free = np.tile(mask(BASIC), (joints, 1))
        self.linear = self.x.copy()

    def solve(
        self, x: np.ndarray, free: np.ndarray, iterations: int = 10, damping: float = 1e-2
    ) -> Solution:
        """Fit candidates [candidates, joints, parameters] to all motions."""
        w = self.weights[:, None, :]

        def moments(x, k):
            parts = zip((0, 1, 2), self.simulator.moments(x), strict=True)
            return tuple((w[(...,) + (None,) * n] * y).sum(axis=0) for n, y in parts)

        def costs(x, k):
            return (w * self.simulator.costs(x)).sum(axis=0)

        return minimise(moments, costs, x, free, (LOWER, UPPER), iterations, damping=damping)

    def held_out(self, found: Solution, free: np.ndarray) -> Float[np.ndarray, "candidates joints"]:
        """Return mean logarithms of the mean square errors of motions left out, one at a time.

        Without a motion the fit moves by a Gauss-Newton step; its error is simulated.
        """
        w = self.weights[:, None, :]
        _, g, H = self.simulator.moments(found.x)
        left = found.gradient - w[..., None] * g, found.information - w[..., None, None] * H
        x = np.broadcast_to(found.x, g.shape)
        step = bounded_step(*left, x, np.broadcast_to(free, x.shape), (LOWER, UPPER), 1e-3)
        errors = self.simulator.costs(np.clip(x + step, LOWER, UPPER), each=True)
        counted = np.asarray(self.simulator.motion.counted).sum(axis=-1)
        mean = errors / np.maximum(counted, 1.0)[:, None]
        share = (counted > 0)[:, None] + 0.0
        scores = (share * np.log(mean + RESOLUTION**2)).sum(axis=0) / share.sum(axis=0)
        return np.where(np.isfinite(scores), scores, np.inf)

    def start(self) -> None:
        """Fit the basic model from the best of many starts, and the linear baseline."""
        grid = np.tile(self.x, (len(_STARTS), 1, 1))
        grid[..., [INDEX[k] for k in ("J", "B", "d")]] = np.array(_STARTS)[:, None]
        costs = (self.weights[:, None] * self.simulator.costs(grid)).sum(axis=0)
        best = np.argsort(costs, axis=0)[:3]
        x = np.concatenate([np.take_along_axis(grid, best[..., None], axis=0), self.linear[None]])
        x[3] = x[0]
        x[3, :, INDEX["F"]] = 0.0
        free = np.stack([self.free] * 3 + [np.tile(mask(LINEAR), (len(self.x), 1))])
        found = self.solve(x, free, iterations=8)
        self.linear = found.x[3]
        self._take(found.x[:3], np.argmin(found.cost[:3], axis=0))
        self._weigh(self.x)

    def _take(self, x: np.ndarray, chosen: np.ndarray) -> None:
        self.x = np.take_along_axis(x, chosen[None, :, None], axis=0)[0]

    def _weigh(self, x: np.ndarray) -> None:
        """Weigh motions by their own errors, so that the worst one does not decide alone."""
        counted = np.asarray(self.simulator.motion.counted).sum(axis=-1)
        mean = self.simulator.costs(x[None])[:, 0] / np.maximum(counted, 1.0)
        self.weights = np.where(counted > 0, 1.0 / (mean + RESOLUTION**2), 0.0) / np.maximum(
            counted, 1
        )

    def remove_contact(self) -> None:
        """Leave out the samples in which a joint is held by something that is not in the model."""
        motion = self.simulator.motion
        errors = self.simulator.paths(self.x[None])[:, 0] - np.asarray(motion.positions)
        touched = contact_rows(motion, errors)
        if touched.any():
            counted = np.asarray(motion.counted) * ~touched
            self.simulator = dataclasses.replace(
                self.simulator, motion=motion.replace(counted=counted)
            )
            self._weigh(self.x)

    def choose(self, group: Sequence[tuple[str, ...]]) -> None:
        """Take the effects of a group that lower the held-out errors, joint by joint."""
        if len(group) == 1:
            return
        every = {symbol for effects in group for symbol in effects}
        x, free = (np.stack([y] * len(group)) for y in (self.x, self.free))
        for k, effects in enumerate(group):
            free[k, :, mask(tuple(every))] = False
            free[k, :, mask(effects)] = True
            for symbol in every - set(effects):
                x[k, :, INDEX[symbol]] = START[INDEX[symbol]]
            for symbol in effects:
                x[k, :, INDEX[symbol]] = self._first_value(symbol)
        # Friction per load needs a load.
        free[..., INDEX["a"]] &= self._loaded
        free[..., INDEX["mu"]] &= free[..., INDEX["a"]]
        x[..., INDEX["a"]] *= self._loaded
        found = self.solve(x, free)
        scores = self.held_out(found, free)
        chosen = np.zeros(len(self.x), int)
        for k in range(1, len(group)):
            current = np.take_along_axis(scores, chosen[None], axis=0)[0]
            # Effects that have been found stay: a known weight is not replaced by a bias.
            larger = np.array([set(group[c]) <= set(group[k]) for c in chosen])
            chosen = np.where(larger & (scores[k] < current - GAIN), k, chosen)
        self._take(found.x, chosen)
        self.free = np.take_along_axis(free, chosen[None, :, None], axis=0)[0]
        self._weigh(self.x)

    @property
    def _loaded(self) -> Bool[np.ndarray, " joints"]:
        """Joints on which the bodies have a weight worth mentioning."""
        load = np.abs(self.simulator.motion.load).max(axis=(0, 2))
        return load > LIGHT * load.max(initial=0.0)

    def _first_value(self, symbol: str) -> float | np.ndarray:
        """Return a start at which an effect is active: otherwise it would have no gradient."""
        motion = self.simulator.motion
        lag = np.abs(np.asarray(motion.commands) - motion.positions).max(axis=(0, 2))
        load = np.abs(motion.load).max(axis=(0, 2))
        own = self.x[:, INDEX["F"]]
        values = {
            "a": 0.02 / np.maximum(load, 1e-6),
            "b": self.x[:, INDEX["b"]],
            "mu": 0.2,
            "Fs": 0.3 * own + 1e-3,
            "vs": START[INDEX["vs"]],
            "um": 0.6 * lag,
        }
        return values[symbol]

    def choose_coupling(self, bodies: Bodies) -> Bodies:
        """Decide whether inertial torques of the bodies act, beside those of gravity."""
        coupled = dataclasses.replace(bodies, coupled=True)
        motion = coupled.loads(self.simulator.motion)
        x, a = self.x.copy(), self.x[:, INDEX["a"]] * self.free[:, INDEX["a"]]
        own = a * np.asarray(motion.inertia).mean(axis=(0, 2))
        x[:, INDEX["J"]] = np.maximum(x[:, INDEX["J"]] - own, 1e-5)
        scores, results = [], []
        other = dataclasses.replace(self.simulator, motion=motion)
        for simulator, start in ((self.simulator, self.x), (other, x)):
            self.simulator = simulator
            found = self.solve(start[None], self.free[None], iterations=5)
            scores.append(self.held_out(found, self.free[None]).mean())
            results.append((simulator, found.x[0]))
        better = bool(scores[1] < scores[0])
        self.simulator, self.x = results[int(better)]
        self._weigh(self.x)
        return coupled if better else bodies

    def refine(self, bodies: Bodies | None) -> Solution:
        """Return the fit under the loads of the simulated motion, commands held or interpolated."""
        if bodies is not None and bodies.coupled:
            # Inertial torques act on all joints, however badly a log tells them from `J`.
            self.free[:, INDEX["a"]] = True
        first = self._refined(bodies, self.simulator, self.x)
        _, simulator, x = first
        held = x.copy()
        held[:, INDEX["d"]] -= 0.5 * float(simulator.motion.sample_time.mean())
        second = self._refined(bodies, dataclasses.replace(simulator, hold=True), held)
        _, self.simulator, self.x = min(first, second, key=lambda found: found[0])
        self._weigh(self.x)
        return self.solve(self.x[None], self.free[None], 1, NEARLY_NONE)

    def _refined(
        self, bodies: Bodies | None, simulator: ServoSimulator, x: np.ndarray
    ) -> tuple[float, ServoSimulator, np.ndarray]:
        """Return the mean logarithm of errors, the simulator and the parameters of a refinement.

        Measured positions tell inertial torques roughly. Here the loads follow the simulation, and
        all samples count, with initial velocities estimated.
        """
        motion = simulator.motion
        early = np.arange(motion.positions.shape[-1]) < settling(motion)[:, None, None]
        counted = np.where(early, 1.0, motion.counted)
        simulator = dataclasses.replace(simulator, motion=motion.replace(counted=counted))
        states, best, waited = simulator.states_of(x), (np.inf, simulator, x), 0
        for _ in range(ROUNDS):
            if bodies is not None:
                states = coupled_states(simulator, bodies, x, states, 5)
                loaded = bodies.loads(simulator.motion, *states)
                simulator = dataclasses.replace(simulator, motion=loaded)
            simulator = simulator.with_better_rates(x)
            mean = simulator.costs(x[None])[:, 0] / np.maximum(counted.sum(axis=-1), 1.0)
            score = float(np.log(mean + RESOLUTION**2).mean())
            waited = 0 if score < best[0] - FALL else waited + 1
            best = (score, simulator, x) if score < best[0] else best
            if waited == 2:
                break
            self.simulator = simulator
            self._weigh(x)
            x = self.solve(x[None], self.free[None], 1, NEARLY_NONE).x[0]
        return best
