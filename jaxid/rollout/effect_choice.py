"""Choice of the effects of joints by motions that a fit has not seen."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from jaxid.arrays import Indices, Matrix, Texts, Vector

from .joint_fits import JointFit
from .motion import FreeParameters, JointParameters
from .servo import INDEX, LOWER, START, UPPER
from .simulation import ServoSimulator

BASIC_PARAMETERS = ("J", "B", "d", "F", "b")
"""Parameters of every joint before the choice; `a` instead of `b` under a weight."""
LINEAR_PARAMETERS = ("J", "B", "d", "b", "g")
"""Parameters of the baseline: a linear joint of second order with delay."""
MIN_SCORE_GAIN = 0.1
"""Fall of the held-out mean square's logarithm that justifies a larger model.

A tenth of the mean square is a twentieth of the error; set on a quadruped's chirp.
"""
MAX_EFFECT_DEVIATION = 0.25
"""Relative deviation of an effect's parameter above which it is not determined."""
MIN_EFFECT_COST = 1e-2
"""Relative change of the mean square by an effect below which it does not act."""
OSCILLATION_DAMPING = 0.5
"""Damping ratio below which a joint oscillates."""
MIN_LOAD_SHARE = 0.02
"""Load, relative to the most loaded joint's, below which a joint counts as unloaded."""
STARTS = [
    (J, B, d)
    for J in (2e-4, 2e-3, 1e-2)
    for B in (0.01, 0.04, 0.15)
    for d in (0.0, 0.02)
]
"""Inertia, damping and delay from which searches may start."""

IMITATING_EFFECTS = ("f", "ki", "um")
"""Effects that may have imitated later choices: a fit without each is tried."""

SATURATION_SHARES = (0.2, 0.5, 1.0)
"""Starts of the largest torque, over the usual start."""

Groups = tuple[Indices, ...]
"""Indices of the joints of each kind, which are equal as far as the logs tell."""


def parameter_mask(symbols: Sequence[str]) -> np.ndarray:
    """Return which parameters are among these."""
    return np.isin(list(INDEX), list(symbols))


def is_lower(
    scores: Matrix,
    rivals: Matrix,
    groups: Groups,
    scatter_share: float = 1.0,
) -> np.ndarray:
    """Return for which joints scores are clearly lower than those of rivals.

    Joints of a kind decide together.

    Args:
        scores: Held-out scores [motions, joints].
        rivals: Scores of the smaller model.
        groups: Joints of each kind.
        scatter_share: Share of the scatter between motions that a gain must exceed.
    """
    decisions = np.zeros(scores.shape[1], bool)
    for group in groups:
        change = (scores - rivals)[:, list(group)].mean(axis=1)
        scatter = (
            np.std(change, ddof=1) / np.sqrt(len(change)) if len(change) > 1 else 0
        )
        limit = max(MIN_SCORE_GAIN, scatter_share * scatter)
        decisions[list(group)] = change.mean() < -limit
    return decisions


@dataclasses.dataclass
class EffectChoice:
    """Fits of all joints, of which each choice takes the best.

    Attributes:
        fit: Fit with the effects so far.
        groups: Joints of each kind.
        known_compliance: Inverse of the stiffness where it is known, else NaN.
        advance: Called before each fit, for the progress.
    """

    fit: JointFit
    groups: Groups
    known_compliance: Vector
    advance: Callable[[], None]

    @classmethod
    def start(
        cls,
        simulator: ServoSimulator,
        groups: Groups,
        known_compliance: Vector,
        advance: Callable[[], None],
    ) -> "EffectChoice":
        """Fit joints with basic parameters, from the best of many starts."""
        joints = len(known_compliance)
        start_parameters = np.tile(START, (joints, 1))
        is_known = np.isfinite(known_compliance)
        start_parameters[is_known, INDEX["a"]] = known_compliance[is_known]
        free_mask = np.tile(parameter_mask(BASIC_PARAMETERS), (joints, 1))
        # Where bodies load a joint, their weight is preferred to a bias.
        load = _largest_loads(simulator)
        is_loaded = load > MIN_LOAD_SHARE * load.max(initial=0.0)
        free_mask[is_loaded, INDEX["b"]] = False
        free_mask[is_loaded & ~is_known, INDEX["a"]] = True
        has_new_compliance = is_loaded & ~is_known
        start_parameters[has_new_compliance, INDEX["a"]] = (
            0.02 / load[has_new_compliance]
        )
        grid = [(start_parameters, values) for values in STARTS]
        starts = _best_starts(simulator, grid, count=2)
        fits = []
        for parameters in starts:
            advance()
            start_fit = JointFit.of(simulator, parameters, free_mask)
            fits.append(start_fit.improved(6).weighed_by_errors())
        first_fit, second_fit = fits
        fit = _calm_choice(first_fit, second_fit, groups)
        return cls(fit, groups, known_compliance, advance)

    @property
    def loaded_joints(self) -> np.ndarray:
        """Joints on which the bodies have a weight worth mentioning."""
        load = _largest_loads(self.fit.simulator)
        return load > MIN_LOAD_SHARE * load.max(initial=0.0)

    def choose_all(self) -> None:
        """Choose all effects."""
        self.choose_saturation()
        self.choose(("f",), ("ki",))
        self.choose(("b",))
        self.choose(("mu",), ("Fs", "vs"), ("mu", "Fs", "vs"))
        self.choose(("um",))

    def choose(self, *candidates: Texts) -> None:
        """Add effects that lower held-out errors, each to the best of those before.

        Args:
            candidates: Symbols of the parameters that each candidate adds.
        """
        best_fit = self.fit
        for effects in candidates:
            self.advance()
            trial = self.with_effects(effects)
            groups = self.groups
            if effects == ("b",):
                # Biases are of the assembly: equal joints have different ones.
                groups = tuple((j,) for j in range(len(self.known_compliance)))
            # Two effects compete with each one of them, and with none.
            choice = is_lower(trial.held_out_scores, best_fit.held_out_scores, groups)
            best_fit = best_fit.mixed_with(trial, choice)
        self.fit = best_fit.weighed_by_errors()

    def choose_saturation(self) -> None:
        """Add a largest torque that lowers held-out errors, from many starts.

        A servo that often saturates has no good fit without it to begin with.
        """
        self.advance()
        fit = self.fit
        k = INDEX["um"]
        start_parameters = fit.parameters.copy()
        lag = self._start_values("um")
        grid = []
        for share in SATURATION_SHARES:
            parameters = start_parameters.copy()
            parameters[:, k] = share * lag
            grid += [(parameters, values) for values in STARTS]
        (best_start,) = _best_starts(fit.simulator, grid, count=1)
        free_mask = fit.free.copy()
        free_mask[:, k] = True
        trial = JointFit.of(
            fit.simulator, best_start, free_mask, start=fit.start, weights=fit.weights
        ).improved(8)
        # One motion alone may show it: then its gain is as large as the scatter.
        choice = is_lower(
            trial.held_out_scores,
            fit.held_out_scores,
            self.groups,
            scatter_share=0.5,
        )
        self.fit = fit.mixed_with(trial, choice).weighed_by_errors()

    def with_effects(self, effects: Texts) -> JointFit:
        """Return the fit with further effects."""
        parameters = self.fit.parameters.copy()
        free_mask = self.fit.free.copy()
        for symbol in effects:
            k = INDEX[symbol]
            has_effect = self._can_have(symbol)
            values = self._start_values(symbol)
            is_new = has_effect & ~free_mask[:, k]
            parameters[is_new, k] = values[is_new]
            free_mask[:, k] |= has_effect
        fit = JointFit.of(
            self.fit.simulator,
            parameters,
            free_mask,
            start=self.fit.start,
            weights=self.fit.weights,
        )
        return fit.improved(4)

    def _can_have(self, symbol: str) -> np.ndarray:
        """Return which joints an effect may act on."""
        if symbol == "a":
            return self.loaded_joints & ~np.isfinite(self.known_compliance)
        if symbol == "mu":
            return self.loaded_joints & (self.fit.parameters[:, INDEX["a"]] > 0.0)
        return np.ones(len(self.known_compliance), bool)

    def _start_values(self, symbol: str) -> Vector:
        """Return values at which an effect is active: otherwise it has no gradient."""
        simulator = self.fit.simulator
        motion = simulator.motion
        lag = np.abs(motion.sent - motion.positions).max(axis=(0, 2))
        load = _largest_loads(simulator)
        parameters = self.fit.parameters
        dry_friction = parameters[:, INDEX["F"]]
        values = {
            "a": 0.02 / np.maximum(load, 1e-6),
            "b": parameters[:, INDEX["b"]],
            "mu": 0.2 + 0.0 * load,
            "Fs": 0.3 * dry_friction + 1e-3,
            "vs": START[INDEX["vs"]] + 0.0 * load,
            "um": 0.6 * lag,
            "ki": 1.0 + 0.0 * load,
            "f": 0.3 * parameters[:, INDEX["B"]],
        }
        return values[symbol]


def _largest_loads(simulator: ServoSimulator) -> Vector:
    """Return the largest torque of the bodies on each joint [N m or N]."""
    torques, _ = simulator.loads
    return np.abs(torques).max(axis=(0, 2))


def undetermined_effects(fit: JointFit) -> FreeParameters:
    """Return the effects whose parameters the motions do not determine.

    They are at a limit of the search, never act, or differ between motions.
    """
    values = np.abs(fit.parameters)
    information = fit.equations.information.sum(axis=0)
    own_information = np.diagonal(information, axis1=1, axis2=2)
    is_uncertain = fit.motion_deviations > MAX_EFFECT_DEVIATION * values
    # An effect that never acts has no information, and no scatter either.
    is_idle = own_information * values**2 < MIN_EFFECT_COST
    is_limit = (values >= UPPER) | (values <= LOWER)
    undetermined = is_uncertain | is_idle | is_limit
    effects = parameter_mask(("mu", "Fs", "vs", "um", "ki", "f"))
    undetermined &= effects
    # Stribeck friction is one effect of two parameters.
    pair = [INDEX["Fs"], INDEX["vs"]]
    undetermined[:, pair] |= undetermined[:, pair].any(axis=1, keepdims=True)
    return undetermined & fit.free


def without_imitations(fit: JointFit, groups: Groups) -> JointFit:
    """Return the fit without control effects that do not lower held-out errors.

    They may have imitated held commands, or friction that was chosen later.
    """
    for symbol in IMITATING_EFFECTS:
        mask = fit.free & parameter_mask((symbol,))
        if mask.any():
            trial = without_effects(fit, mask).improved(2)
            needs_effect = is_lower(fit.held_out_scores, trial.held_out_scores, groups)
            fit = fit.mixed_with(trial, ~needs_effect & mask.any(axis=1))
    return fit


def without_effects(fit: JointFit, effects: FreeParameters) -> JointFit:
    """Return the fit whose effects have their neutral values."""
    return JointFit.of(
        fit.simulator,
        np.where(effects, START, fit.parameters),
        fit.free & ~effects,
        start=fit.start,
        weights=fit.weights,
        pull=fit.pull,
    )


def _best_starts(
    simulator: ServoSimulator,
    grid: Sequence[tuple[JointParameters, tuple[float, float, float]]],
    count: int,
) -> list[JointParameters]:
    """Return the parameters of least error for each joint.

    Args:
        simulator: Motions.
        grid: Parameters, and inertia, damping and delay in their place.
        count: Number of starts.
    """
    columns = [INDEX[symbol] for symbol in ("J", "B", "d")]
    motion = simulator.motion
    starts = []
    costs = []
    for start_parameters, values in grid:
        parameters = start_parameters.copy()
        parameters[:, columns] = values
        path = simulator.positions(parameters, motion.start)
        errors = (path - motion.positions) * motion.counted
        squares = np.sum(errors**2, axis=-1) / motion.sample_counts
        starts.append(parameters)
        costs.append(np.nan_to_num(squares.sum(axis=0), nan=np.inf))
    order = np.argsort(np.array(costs), axis=0)
    joints = np.arange(len(starts[0]))
    return [np.array(starts)[order[k], joints] for k in range(count)]


def _calm_choice(first: JointFit, second: JointFit, groups: Groups) -> JointFit:
    """Return the better fit of each joint, or one nearly as good with more damping.

    Damping counts up to the ratio `OSCILLATION_DAMPING`: an oscillation that an initial
    state excites may imitate the rounding of an encoder.
    """

    def damping_ratios(fit: JointFit) -> Vector:
        inertia = fit.parameters[:, INDEX["J"]]
        damping = fit.parameters[:, INDEX["B"]]
        return np.minimum(0.5 * damping / np.sqrt(inertia), OSCILLATION_DAMPING)

    second_is_better = is_lower(second.held_out_scores, first.held_out_scores, groups)
    first_is_better = is_lower(first.held_out_scores, second.held_out_scores, groups)
    is_calmer = damping_ratios(second) > damping_ratios(first)
    return first.mixed_with(second, second_is_better | (is_calmer & ~first_is_better))
