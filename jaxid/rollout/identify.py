"""Identification of joints behind position servos, from commands and positions alone.

Each choice of effects (gravity, friction by load, Stribeck friction, saturation,
inertial torques) is made by motions that the fit has not seen: leave one out among
those given. Whether commands are held or interpolated is decided by the errors of two
fits of all joints together.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from jaxid.arrays import Bool, Float, Numbers
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

from .bodies import Bodies
from .contact import contact_rows
from .coupled import CoupledSimulator
from .least_squares import Solution, bounded_step, minimise
from .motion import ServoMotion
from .refine import RESOLUTION, prepare, refine, weights_of
from .result import ServoFit
from .servo import INDEX, LOWER, SCALE, START, UPPER, with_integral
from .uncoupled import ServoSimulator

BASIC = ("J", "B", "d", "F", "b")
"""Parameters of every joint, before the choice."""
LINEAR = ("J", "B", "d", "b", "g")
"""Parameters of the baseline: a linear joint of second order with delay."""
EFFECTS = (
    ((), ("a",), ("b",), ("a", "b")),
    ((), ("mu",), ("Fs", "vs"), ("mu", "Fs", "vs")),
    ((), ("um",)),
)
"""Groups of effects to choose one each from: bias or load; friction; saturation."""
GAIN = 0.04
"""Fall of the held-out mean square's logarithm that justifies a larger model."""
DAMPED = 0.5
"""Damping ratio below which a joint oscillates."""
FOLDS = 4
"""Smallest number of parts for the choice: fewer logs are divided."""
LARGEST = 1e6
"""Mean square error of a simulation that left all bounds [rad² or m²]."""
SHORTEST = 5.0
"""Shortest part into which a log is divided [s]."""
LIGHT = 0.02
"""Load, relative to the most loaded joint's, below which a joint counts as unloaded."""
_STARTS = [
    (J, B, d)
    for J in (2e-4, 2e-3, 1e-2)
    for B in (0.01, 0.04, 0.15)
    for d in (0.0, 0.02)
]
"""Inertia, damping and delay from which searches may start."""


def identify_rollout(
    logs: Sequence[Recording] | Recording,
    bodies: Bodies | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    time_step: float = 0.01,
    saturation: bool = True,
    friction: bool = True,
    integral: bool = False,
    stiffness: Numbers | None = None,
) -> ServoFit:
    """Identify position-controlled joints so that a simulation moves like the robot.

    No torque is needed. The logs are recordings whose `forces` are the commanded
    positions: `jid.Recording.of(positions, commands, sample_time=…)`, or
    `jid.Columns(angles="position{}", forces="command{}")`.

    Positions tell torques in units of the servo's stiffness: the parameters are ratios
    to it. With bodies of known weight the stiffness itself follows where gravity acts
    on the joint, unless it is given.

    Args:
        logs: One or several recordings of the same robot and controller.
        bodies: Model and parameters of the robot's bodies, often from its URDF file:
            their weight loads the joints, and their inertial torques if that lowers the
            held-out errors (or `coupled` says so). Without them a joint has a constant
            bias.
        joint_names: Names of the joints; those of the model, or numbers, if None.
        time_step: Longest step of the simulation [s].
        saturation: Whether a largest torque of the servo is tried.
        friction: Whether friction that grows with load or falls with speed is tried.
        integral: Whether integral action of the servos (PID instead of PD controllers)
            is tried.
        stiffness: Known proportional gains of the servos, one for all or one for each
            joint, NaN where unknown [N m/rad or N/m].

    Raises:
        InputError: If logs differ in their joints, are too short, or do not move, or if
            the stiffness does not fit the joints.
    """
    logs = [logs] if isinstance(logs, Recording) else list(logs)
    motion = ServoMotion.of(_divided(logs)).known()
    _require_motion(motion)
    names = _joint_names(motion, bodies, joint_names)
    # Choices show in long steps, too.
    coarse = max(time_step, float(motion.sample_time.max()))
    motion = motion if bodies is None else bodies.loads(motion)
    given = _known_stiffness(stiffness, len(names))
    known = None if given is None or bodies is None else given
    search = _Search(ServoSimulator(motion, coarse), integral, known)
    motion = search.simulator.motion
    whole = None if bodies is None else bodies.together
    coupled = CoupledSimulator(motion, time_step, False, whole)
    with ThreadPoolExecutor(1) as pool:
        # What the refinement needs is compiled while the search runs.
        pool.submit(prepare, coupled, search.x, search.free)
        search.run(bodies is not None, friction, saturation, integral)
    if bodies is not None and whole is not None:
        together = bodies.coupled or search.choose_coupling(whole)
        bodies = whole if together else bodies
        # Inertial torques act on all joints, however badly a log tells them from `J`.
        search.free[:, INDEX["a"]] |= together & ~search.known
    motion = search.simulator.motion
    if integral:
        motion = with_integral(motion, search.x, False)
    coupled = dataclasses.replace(coupled, motion=motion, bodies=bodies)
    held = search.x.copy()
    held[:, INDEX["d"]] -= 0.5 * float(motion.sample_time.mean())
    other = dataclasses.replace(coupled, hold=True)
    found, told = refine((coupled, search.x), (other, held), search.free)
    return ServoFit.of(found, search.linear, names, told, given)


def _divided(logs: Sequence[Recording]) -> list[Recording]:
    """Return logs, the long ones divided.

    There are enough parts for the choice, and none is much longer than the others, to
    whose length all are padded.
    """
    usual, found = (
        max(float(np.median([x.duration for x in logs])), FOLDS * SHORTEST),
        [],
    )
    for log in logs:
        wanted = max(-(-FOLDS // len(logs)), round(log.duration / usual))
        parts = max(1, min(wanted, int(log.duration // SHORTEST)))
        ends = np.linspace(
            float(log.time[0]), float(log.time[-1]) + log.sample_time, parts + 1
        )
        found += [log.crop(float(a), float(b)) for a, b in itertools.pairwise(ends)]
    return found


def _require_motion(motion: ServoMotion) -> None:
    for channel in ("positions", "commands"):
        still = np.ptp(getattr(motion, channel), axis=-1).max(axis=0) < 10 * RESOLUTION
        if still.any():
            joint = int(np.argmax(still)) + 1
            raise InputError(
                f"`logs`: the {channel} of joint {joint} change by less than 1 mrad or "
                "1 mm. Leave the joint out, or give logs in which it moves."
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
            f"`logs` have {count} joints, but the robot has {len(names)}: choose the "
            "columns of its joints, or the `tip` of the robot."
        )
    return names


def _known_stiffness(
    stiffness: Numbers | None, joints: int
) -> Float[np.ndarray, " joints"] | None:
    if stiffness is None:
        return None
    given = np.asarray(stiffness, np.float64)
    if (
        given.shape not in ((), (joints,))
        or (given <= 0.0).any()
        or np.isinf(given).any()
    ):
        raise InputError(
            f"`stiffness` must be a positive number [N m/rad or N/m], or {joints} of "
            "them, one for each joint."
        )
    return np.broadcast_to(given, (joints,)).copy()


def mask(symbols: Sequence[str]) -> Bool[np.ndarray, " parameters"]:
    """Return which parameters are among these."""
    return np.isin(list(INDEX), list(symbols))


def _lower(scores: np.ndarray, others: np.ndarray) -> Bool[np.ndarray, " joints"]:
    """Return whether scores are lower than others by more than their scatter.

    Scores are arrays [motions, joints].
    """
    change = scores - others
    count = np.isfinite(change).sum(axis=0)
    mean = np.nansum(change, axis=0) / np.maximum(count, 1)
    squares = np.nansum((change - mean) ** 2, axis=0)
    scatter = np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1))
    return mean < -np.maximum(GAIN, scatter)


class _Search:
    """Fits of all joints, candidate models and folds, in batches.

    Attributes:
        simulator: Motions and steps.
        weights: Weight of each motion's squared errors [motions, joints].
        x: Parameters so far [joints, parameters].
        free: Parameters that are estimated.
        known: Joints whose stiffness is known.
        linear: Parameters of the linear baseline.
    """

    def __init__(
        self, simulator: ServoSimulator, integral: bool, stiffness: np.ndarray | None
    ):
        counted = np.asarray(simulator.motion.counted).sum(axis=-1)
        self.weights = 1.0 / np.maximum(counted, 1.0)
        joints = counted.shape[1]
        self.x = np.tile(START, (joints, 1))
        self.free = np.tile(mask(BASIC), (joints, 1))
        self.linear = self.x.copy()
        self.known = (
            np.zeros(joints, bool) if stiffness is None else np.isfinite(stiffness)
        )
        if stiffness is not None:
            self.x[self.known, INDEX["a"]] = 1.0 / stiffness[self.known]
        motion = simulator.motion
        if integral:
            motion = with_integral(motion, self.x, False)
        self.simulator = dataclasses.replace(simulator, motion=motion)

    def run(
        self, loaded: bool, friction: bool, saturation: bool, integral: bool
    ) -> None:
        """Choose the effects of all joints.

        Args:
            loaded: Whether bodies load the joints.
            friction: Whether friction by load and Stribeck friction are tried.
            saturation: Whether a largest torque is tried.
            integral: Whether integral action is tried.
        """
        self.start()
        if integral:
            # A servo that saturates often hides its integral action.
            alone = ((), ("ki",))
            self.choose((*alone, ("um",), ("ki", "um")) if saturation else alone)
        groups: list[Sequence[tuple[str, ...]]] = list(EFFECTS)
        if not loaded:
            groups[0] = (("b",),)
        if not friction:
            groups[1] = ((),)
        if not saturation:
            groups[2] = ((),)
        for k, group in enumerate(groups):
            self.choose(group)
            if k == 0:
                self.remove_contact()

    def solve(
        self,
        x: np.ndarray,
        free: np.ndarray,
        iterations: int = 12,
        damping: float = 1e-2,
    ) -> Solution:
        """Fit candidates [candidates, joints, parameters] to all motions."""
        w = self.weights[:, None, :]

        def moments(x, k):
            parts = zip((0, 1, 2), self.simulator.moments(x), strict=True)
            return tuple((w[(...,) + (None,) * n] * y).sum(axis=0) for n, y in parts)

        def costs(x, k):
            return (w * self.simulator.costs(x)).sum(axis=0)

        return minimise(
            moments, costs, x, free, (LOWER, UPPER), iterations, damping=damping
        )

    def held_out(self, found: Solution, free: np.ndarray) -> np.ndarray:
        """Return logarithms of the mean square errors of motions left out in turn.

        Without a motion the fit moves by a Gauss-Newton step; its error is simulated.

        Returns:
            Scores [motions, candidates, joints]; NaN where nothing counts.
        """
        w = self.weights[:, None, :]
        _, g, H = self.simulator.moments(found.x)
        left = (
            found.gradient - w[..., None] * g,
            found.information - w[..., None, None] * H,
        )
        x = np.broadcast_to(found.x, g.shape)
        step = bounded_step(
            *left, x, np.broadcast_to(free, x.shape), (LOWER, UPPER), 1e-3
        )
        errors = self.simulator.costs(np.clip(x + step, LOWER, UPPER), each=True)
        return self._scores(errors)

    def _scores(self, squares: np.ndarray) -> np.ndarray:
        """Return logarithms of mean squares of sums [motions, candidates, joints]."""
        counted = np.asarray(self.simulator.motion.counted).sum(axis=-1)
        mean = squares / np.maximum(counted, 1.0)[:, None]
        scores = np.log(
            np.minimum(np.nan_to_num(mean, nan=LARGEST), LARGEST) + RESOLUTION**2
        )
        return np.where((counted > 0)[:, None], scores, np.nan)

    def start(self) -> None:
        """Fit the basic model from the best of many starts, and the linear baseline."""
        grid = np.tile(self.x, (len(_STARTS), 1, 1))
        grid[..., [INDEX[k] for k in ("J", "B", "d")]] = np.array(_STARTS)[:, None]
        costs = (self.weights[:, None] * self.simulator.costs(grid)).sum(axis=0)
        best = np.argsort(costs, axis=0)[:3]
        x = np.concatenate(
            [np.take_along_axis(grid, best[..., None], axis=0), self.linear[None]]
        )
        x[3] = x[0]
        x[3][:, mask(("F", "a", "ki"))] = 0.0
        free = np.stack([self.free] * 3 + [np.tile(mask(LINEAR), (len(self.x), 1))])
        found = self.solve(x, free, iterations=8)
        self.linear = found.x[3]
        self._take(found.x[:3], self._best(found.x[:3], found.cost[:3]))
        self._weigh(self.x)

    def _best(self, x: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """Return the candidate of least cost, or one nearly as good with more damping.

        Damping counts up to the ratio `DAMPED`.

        An oscillation that an initial state excites may imitate the rounding of an
        encoder.
        """
        best, scores = np.argmin(cost, axis=0), self._scores(self.simulator.costs(x))
        ratio = 0.5 * x[..., INDEX["B"]] / np.sqrt(x[..., INDEX["J"]])
        calm = np.lexsort((cost, -np.minimum(ratio, DAMPED)), axis=0)[0]
        one, other = (
            np.take_along_axis(scores, k[None, None], axis=1)[:, 0]
            for k in (best, calm)
        )
        return np.where(_lower(one, other), best, calm)

    def _take(self, x: np.ndarray, chosen: np.ndarray) -> None:
        self.x = np.take_along_axis(x, chosen[None, :, None], axis=0)[0]

    def _weigh(self, x: np.ndarray) -> None:
        """Weigh motions by their own errors."""
        self.weights = weights_of(
            self.simulator.motion, self.simulator.costs(x[None])[:, 0]
        )

    def remove_contact(self) -> None:
        """Leave out samples in which something outside the model holds a joint."""
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
        """Take the effects of a group that lower held-out errors, joint by joint."""
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
        free[..., INDEX["a"]] &= self._loaded & ~self.known
        x[..., INDEX["a"]] *= self._loaded
        x[:, self.known, INDEX["a"]] = self.x[self.known, INDEX["a"]]
        # Friction per load needs a load.
        free[..., INDEX["mu"]] &= self._loaded & (x[..., INDEX["a"]] > 0.0)
        found = self.solve(x, free)
        scores = self.held_out(found, free)
        chosen = np.zeros(len(self.x), int)
        for k in range(1, len(group)):
            current = np.take_along_axis(scores, chosen[None, None], axis=1)[:, 0]
            # Effects that have been found stay: a known weight is not replaced by a
            # bias.
            larger = np.array([set(group[c]) <= set(group[k]) for c in chosen])
            chosen = np.where(larger & _lower(scores[:, k], current), k, chosen)
        self._take(found.x, chosen)
        self.free = np.take_along_axis(free, chosen[None, :, None], axis=0)[0]
        self._weigh(self.x)

    @property
    def _loaded(self) -> Bool[np.ndarray, " joints"]:
        """Joints on which the bodies have a weight worth mentioning."""
        load = np.abs(self.simulator.motion.load).max(axis=(0, 2))
        return load > LIGHT * load.max(initial=0.0)

    def _first_value(self, symbol: str) -> float | np.ndarray:
        """Return a start at which an effect is active: otherwise it has no gradient."""
        motion = self.simulator.motion
        lag = np.abs(motion.sent - motion.positions).max(axis=(0, 2))
        load = np.abs(motion.load).max(axis=(0, 2))
        own = self.x[:, INDEX["F"]]
        values = {
            "a": 0.02 / np.maximum(load, 1e-6),
            "b": self.x[:, INDEX["b"]],
            "mu": 0.2,
            "Fs": 0.3 * own + 1e-3,
            "vs": START[INDEX["vs"]],
            "um": 0.6 * lag,
            "ki": SCALE[INDEX["ki"]],
        }
        return values[symbol]

    def choose_coupling(self, bodies: Bodies) -> bool:
        """Decide whether inertial torques of bodies act, beside those of gravity."""
        motion = bodies.loads(self.simulator.motion)
        x = self.x.copy()
        own = x[:, INDEX["a"]] * np.asarray(motion.inertia).mean(axis=(0, 2))
        x[:, INDEX["J"]] = np.maximum(x[:, INDEX["J"]] - own, 1e-5)
        scores, results = [], []
        other = dataclasses.replace(self.simulator, motion=motion)
        for simulator, start, more in ((self.simulator, self.x, 0), (other, x, 3)):
            self.simulator = simulator
            found = self.solve(start[None], self.free[None], iterations=more)
            scores.append(np.nanmean(self.held_out(found, self.free[None])))
            results.append((simulator, found.x[0]))
        better = bool(scores[1] < scores[0])
        self.simulator, self.x = results[int(better)]
        self._weigh(self.x)
        return better
