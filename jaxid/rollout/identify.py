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

from jaxid.arrays import Numbers, Vector
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

from .body_loads import Bodies
from .coupled import CoupledSimulator
from .coupled_refinement import RESOLUTION, prepare, refine, weights_of
from .least_squares import Solution, bounded_step, minimise
from .motion import ServoMotion
from .result import ServoFit
from .servo import INDEX, LOWER, SCALE, START, UPPER, with_integral
from .uncoupled import ServoSimulator

BASIC_PARAMETERS = ("J", "B", "d", "F", "b")
"""Parameters of every joint, before the choice."""
LINEAR_PARAMETERS = ("J", "B", "d", "b", "g")
"""Parameters of the baseline: a linear joint of second order with delay."""
EFFECTS = (
    ((), ("a",), ("b",), ("a", "b")),
    ((), ("mu",), ("Fs", "vs"), ("mu", "Fs", "vs")),
    ((), ("um",)),
)
"""Groups of effects to choose one each from: bias or load; friction; saturation."""
MIN_SCORE_GAIN = 0.04
"""Fall of the held-out mean square's logarithm that justifies a larger model."""
OSCILLATION_DAMPING = 0.5
"""Damping ratio below which a joint oscillates."""
MIN_PARTS = 4
"""Smallest number of parts for the choice: fewer logs are divided."""
MAX_MEAN_SQUARE = 1e6
"""Mean square error of a simulation that left all bounds [rad² or m²]."""
MIN_PART_DURATION = 5.0
"""Shortest part into which a log is divided [s]."""
MIN_LOAD_SHARE = 0.02
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
    motion = ServoMotion.of(_split_logs(logs)).known()
    _require_motion(motion)
    names = _joint_names(motion, bodies, joint_names)
    # Choices show in long steps, too.
    search_step = max(time_step, float(motion.sample_time.max()))
    motion = motion if bodies is None else bodies.loads(motion)
    known_stiffness = _checked_stiffness(stiffness, len(names))
    search_stiffness = (
        None if known_stiffness is None or bodies is None else known_stiffness
    )
    search = _Search(ServoSimulator(motion, search_step), integral, search_stiffness)
    motion = search.simulator.motion
    coupled_bodies = None if bodies is None else bodies.together
    simulator = CoupledSimulator(motion, time_step, False, coupled_bodies)
    with ThreadPoolExecutor(1) as pool:
        # What the refinement needs is compiled while the search runs.
        pool.submit(prepare, simulator, search.x, search.free_mask)
        search.run(bodies is not None, friction, saturation, integral)
    if bodies is not None and coupled_bodies is not None:
        has_coupling = bodies.coupled or search.choose_coupling(coupled_bodies)
        bodies = coupled_bodies if has_coupling else bodies
        # Inertial torques act on all joints, however badly a log tells them from `J`.
        search.free_mask[:, INDEX["a"]] |= has_coupling & ~search.has_stiffness
    motion = search.simulator.motion
    if integral:
        motion = with_integral(motion, search.x, False)
    simulator = dataclasses.replace(simulator, motion=motion, bodies=bodies)
    held_parameters = search.x.copy()
    held_parameters[:, INDEX["d"]] -= 0.5 * float(motion.sample_time.mean())
    held_simulator = dataclasses.replace(simulator, hold=True)
    refinement, hold_is_told = refine(
        (simulator, search.x), (held_simulator, held_parameters), search.free_mask
    )
    return ServoFit.of(
        refinement, search.baseline, names, hold_is_told, known_stiffness
    )


def _split_logs(logs: Sequence[Recording]) -> list[Recording]:
    """Return logs, with long ones divided into parts of similar durations.

    The choice needs several parts. All are padded to the longest one, so that none
    should be much longer than the others.
    """
    durations = [log.duration for log in logs]
    part_duration = max(float(np.median(durations)), MIN_PARTS * MIN_PART_DURATION)
    min_count = -(-MIN_PARTS // len(logs))
    part_logs = []
    for log in logs:
        desired_count = max(min_count, round(log.duration / part_duration))
        max_count = int(log.duration // MIN_PART_DURATION)
        part_count = max(1, min(desired_count, max_count))
        end_time = log.time[-1] + log.sample_time
        part_ends = np.linspace(log.time[0], end_time, part_count + 1).tolist()
        part_logs += [log.crop(a, b) for a, b in itertools.pairwise(part_ends)]
    return part_logs


def _require_motion(motion: ServoMotion) -> None:
    for channel in ("positions", "commands"):
        rest_mask = (
            np.ptp(getattr(motion, channel), axis=-1).max(axis=0) < 10 * RESOLUTION
        )
        if rest_mask.any():
            joint = int(np.argmax(rest_mask)) + 1
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


def _checked_stiffness(stiffness: Numbers | None, joints: int) -> Vector | None:
    if stiffness is None:
        return None
    values = np.asarray(stiffness, np.float64)
    if (
        values.shape not in ((), (joints,))
        or (values <= 0.0).any()
        or np.isinf(values).any()
    ):
        raise InputError(
            f"`stiffness` must be a positive number [N m/rad or N/m], or {joints} of "
            "them, one for each joint."
        )
    return np.broadcast_to(values, (joints,)).copy()


def mask(symbols: Sequence[str]) -> np.ndarray:
    """Return which parameters are among these."""
    return np.isin(list(INDEX), list(symbols))


def _is_lower(scores: np.ndarray, rivals: np.ndarray) -> np.ndarray:
    """Return whether scores are lower than those of rivals by more than their scatter.

    Scores are arrays [motions, joints].
    """
    change = scores - rivals
    count = np.isfinite(change).sum(axis=0)
    mean = np.nansum(change, axis=0) / np.maximum(count, 1)
    squares = np.nansum((change - mean) ** 2, axis=0)
    scatter = np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1))
    return mean < -np.maximum(MIN_SCORE_GAIN, scatter)


def _of_candidates(scores: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the scores of one candidate for each joint [motions, joints]."""
    return np.take_along_axis(scores, indices[None, None], axis=1)[:, 0]


class _Search:
    """Fits of all joints, candidate models and folds, in batches.

    Attributes:
        simulator: Motions and steps.
        weights: Weight of each motion's squared errors [motions, joints].
        x: Parameters so far [joints, parameters].
        free_mask: Whether each parameter is estimated.
        has_stiffness: Whether the stiffness of each joint is known.
        baseline: Parameters of the linear baseline.
    """

    def __init__(
        self, simulator: ServoSimulator, integral: bool, stiffness: np.ndarray | None
    ):
        sample_counts = np.asarray(simulator.motion.counted).sum(axis=-1)
        self.weights = 1.0 / np.maximum(sample_counts, 1.0)
        joints = sample_counts.shape[1]
        self.x = np.tile(START, (joints, 1))
        self.free_mask = np.tile(mask(BASIC_PARAMETERS), (joints, 1))
        self.baseline = self.x.copy()
        self.has_stiffness = (
            np.zeros(joints, bool) if stiffness is None else np.isfinite(stiffness)
        )
        if stiffness is not None:
            self.x[self.has_stiffness, INDEX["a"]] = 1.0 / stiffness[self.has_stiffness]
        motion = simulator.motion
        if integral:
            motion = with_integral(motion, self.x, False)
        self.simulator = dataclasses.replace(simulator, motion=motion)

    def run(
        self, has_bodies: bool, friction: bool, saturation: bool, integral: bool
    ) -> None:
        """Choose the effects of all joints.

        Args:
            has_bodies: Whether bodies load the joints.
            friction: Whether friction by load and Stribeck friction are tried.
            saturation: Whether a largest torque is tried.
            integral: Whether integral action is tried.
        """
        self.start()
        if integral:
            # A servo that saturates often hides its integral action.
            effects = ((), ("ki",))
            self.choose((*effects, ("um",), ("ki", "um")) if saturation else effects)
        groups: list[Sequence[tuple[str, ...]]] = list(EFFECTS)
        if not has_bodies:
            groups[0] = (("b",),)
        if not friction:
            groups[1] = ((),)
        if not saturation:
            groups[2] = ((),)
        for group in groups:
            self.choose(group)

    def solve(
        self,
        x: np.ndarray,
        free_mask: np.ndarray,
        iterations: int = 12,
    ) -> Solution:
        """Fit candidates [candidates, joints, parameters] to all motions."""
        w = self.weights[:, None, :]

        def moments(x):
            parts = zip((0, 1, 2), self.simulator.moments(x), strict=True)
            return tuple((w[(...,) + (None,) * n] * y).sum(axis=0) for n, y in parts)

        def costs(x):
            return (w * self.simulator.costs(x)).sum(axis=0)

        return minimise(
            moments,
            costs,
            x,
            free_mask,
            (LOWER, UPPER),
            iterations,
        )

    def held_out_scores(self, solution: Solution, free_mask: np.ndarray) -> np.ndarray:
        """Return logarithms of the mean square errors of motions left out in turn.

        Without a motion the fit moves by a Gauss-Newton step; its error is simulated.

        Returns:
            Scores [motions, candidates, joints]; NaN where nothing counts.
        """
        w = self.weights[:, None, :]
        _, g, H = self.simulator.moments(solution.x)
        remaining_moments = (
            solution.gradient - w[..., None] * g,
            solution.information - w[..., None, None] * H,
        )
        x = np.broadcast_to(solution.x, g.shape)
        step = bounded_step(
            *remaining_moments,
            x,
            np.broadcast_to(free_mask, x.shape),
            (LOWER, UPPER),
            1e-3,
        )
        errors = self.simulator.costs(np.clip(x + step, LOWER, UPPER), each=True)
        return self._scores(errors)

    def _scores(self, squares: np.ndarray) -> np.ndarray:
        """Return logarithms of mean squares of sums [motions, candidates, joints]."""
        sample_counts = np.asarray(self.simulator.motion.counted).sum(axis=-1)
        mean = squares / np.maximum(sample_counts, 1.0)[:, None]
        scores = np.log(
            np.minimum(np.nan_to_num(mean, nan=MAX_MEAN_SQUARE), MAX_MEAN_SQUARE)
            + RESOLUTION**2
        )
        return np.where((sample_counts > 0)[:, None], scores, np.nan)

    def start(self) -> None:
        """Fit the basic model from the best of many starts, and the linear baseline."""
        grid = np.tile(self.x, (len(_STARTS), 1, 1))
        grid[..., [INDEX[k] for k in ("J", "B", "d")]] = np.array(_STARTS)[:, None]
        costs = (self.weights[:, None] * self.simulator.costs(grid)).sum(axis=0)
        best_indices = np.argsort(costs, axis=0)[:3]
        x = np.concatenate(
            [
                np.take_along_axis(grid, best_indices[..., None], axis=0),
                self.baseline[None],
            ]
        )
        x[3] = x[0]
        x[3][:, mask(("F", "a", "ki"))] = 0.0
        free_mask = np.stack(
            [self.free_mask] * 3 + [np.tile(mask(LINEAR_PARAMETERS), (len(self.x), 1))]
        )
        solution = self.solve(x, free_mask, iterations=8)
        self.baseline = solution.x[3]
        self._take_candidates(
            solution.x[:3], self._best_candidates(solution.x[:3], solution.cost[:3])
        )
        self._weigh_motions(self.x)

    def _best_candidates(self, x: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """Return the candidate of least cost, or one nearly as good with more damping.

        Damping counts up to the ratio `OSCILLATION_DAMPING`.

        An oscillation that an initial state excites may imitate the rounding of an
        encoder.
        """
        inertia = x[..., INDEX["J"]]
        damping = x[..., INDEX["B"]]
        damping_ratio = 0.5 * damping / np.sqrt(inertia)
        counted_ratio = np.minimum(damping_ratio, OSCILLATION_DAMPING)
        best_indices = np.argmin(cost, axis=0)
        calm_indices = np.lexsort((cost, -counted_ratio), axis=0)[0]
        scores = self._scores(self.simulator.costs(x))
        best_scores = _of_candidates(scores, best_indices)
        calm_scores = _of_candidates(scores, calm_indices)
        is_better = _is_lower(best_scores, calm_scores)
        return np.where(is_better, best_indices, calm_indices)

    def _take_candidates(self, x: np.ndarray, choices: np.ndarray) -> None:
        self.x = np.take_along_axis(x, choices[None, :, None], axis=0)[0]

    def _weigh_motions(self, x: np.ndarray) -> None:
        """Weigh motions by their own errors."""
        self.weights = weights_of(
            self.simulator.motion, self.simulator.costs(x[None])[:, 0]
        )

    def choose(self, group: Sequence[tuple[str, ...]]) -> None:
        """Take the effects of a group that lower held-out errors, joint by joint."""
        if len(group) == 1:
            return
        x, free_mask = self._candidates(group)
        solution = self.solve(x, free_mask)
        scores = self.held_out_scores(solution, free_mask)
        choices = np.zeros(len(self.x), int)
        for k in range(1, len(group)):
            current_scores = _of_candidates(scores, choices)
            # Effects that have been found stay: a known weight is not replaced by a
            # bias.
            is_extension = np.array([set(group[c]) <= set(group[k]) for c in choices])
            is_better = _is_lower(scores[:, k], current_scores)
            choices = np.where(is_extension & is_better, k, choices)
        self._take_candidates(solution.x, choices)
        places = choices[None, :, None]
        self.free_mask = np.take_along_axis(free_mask, places, axis=0)[0]
        self._weigh_motions(self.x)

    def _candidates(
        self, group: Sequence[tuple[str, ...]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return starts with the effects of a group, and which parameters are free."""
        symbols = set(itertools.chain(*group))
        x = np.stack([self.x] * len(group))
        free_mask = np.stack([self.free_mask] * len(group))
        for k, effects in enumerate(group):
            free_mask[k, :, mask(tuple(symbols))] = False
            free_mask[k, :, mask(effects)] = True
            for symbol in symbols - set(effects):
                x[k, :, INDEX[symbol]] = START[INDEX[symbol]]
            for symbol in effects:
                x[k, :, INDEX[symbol]] = self._start_value(symbol)
        compliance = INDEX["a"]
        is_loaded = self._loaded_joints
        has_stiffness = self.has_stiffness
        free_mask[..., compliance] &= is_loaded & ~has_stiffness
        x[..., compliance] *= is_loaded
        x[:, has_stiffness, compliance] = self.x[has_stiffness, compliance]
        # Friction per load needs a load.
        free_mask[..., INDEX["mu"]] &= is_loaded & (x[..., compliance] > 0.0)
        return x, free_mask

    @property
    def _loaded_joints(self) -> np.ndarray:
        """Joints on which the bodies have a weight worth mentioning."""
        load = np.abs(self.simulator.motion.load).max(axis=(0, 2))
        return load > MIN_LOAD_SHARE * load.max(initial=0.0)

    def _start_value(self, symbol: str) -> float | np.ndarray:
        """Return a start at which an effect is active: otherwise it has no gradient."""
        motion = self.simulator.motion
        lag = np.abs(motion.sent - motion.positions).max(axis=(0, 2))
        load = np.abs(motion.load).max(axis=(0, 2))
        dry_friction = self.x[:, INDEX["F"]]
        values = {
            "a": 0.02 / np.maximum(load, 1e-6),
            "b": self.x[:, INDEX["b"]],
            "mu": 0.2,
            "Fs": 0.3 * dry_friction + 1e-3,
            "vs": START[INDEX["vs"]],
            "um": 0.6 * lag,
            "ki": SCALE[INDEX["ki"]],
        }
        return values[symbol]

    def choose_coupling(self, bodies: Bodies) -> bool:
        """Decide whether inertial torques of bodies act, beside those of gravity."""
        motion = bodies.loads(self.simulator.motion)
        x = self.x.copy()
        body_inertia = x[:, INDEX["a"]] * np.asarray(motion.inertia).mean(axis=(0, 2))
        x[:, INDEX["J"]] = np.maximum(x[:, INDEX["J"]] - body_inertia, 1e-5)
        scores = []
        results = []
        coupled_simulator = dataclasses.replace(self.simulator, motion=motion)
        for simulator, start, iterations in (
            (self.simulator, self.x, 0),
            (coupled_simulator, x, 3),
        ):
            self.simulator = simulator
            solution = self.solve(
                start[None], self.free_mask[None], iterations=iterations
            )
            scores.append(
                np.nanmean(self.held_out_scores(solution, self.free_mask[None]))
            )
            results.append((simulator, solution.x[0]))
        is_better = bool(scores[1] < scores[0])
        self.simulator, self.x = results[int(is_better)]
        self._weigh_motions(self.x)
        return is_better
