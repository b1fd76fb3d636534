"""Identification of joints behind position servos, from commands and positions alone.

Each choice of effects is made by motions that the fit has not seen: leave one out among
those given. Whether commands are held or interpolated is decided by the errors of two
fits.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from jaxid.arrays import Numbers, Texts, Vector
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording

from .body_loads import Bodies
from .determined_combinations import Combination, determined_combinations
from .effect_choice import (
    LINEAR_PARAMETERS,
    EffectChoice,
    parameter_mask,
    undetermined_effects,
    without_effects,
    without_imitations,
)
from .equal_joints import joint_groups, pull_equal_joints
from .joint_fits import RESOLUTION, JointFit
from .motion import Contacts, JointParameters, ServoMotion
from .result import ServoFit
from .servo import INDEX, LOWER, MAX_DELAY
from .simulation import ServoSimulator

MIN_FALL = 1e-3
"""Fall of the errors' mean logarithm that continues the refinement."""
MAX_ROUNDS = 8
"""Largest number of rounds of the refinement."""
CHOICE_ROUNDS = 2
"""Rounds after which held and interpolated commands are compared."""
MAX_STEP_ERROR = 0.05
"""Median change of estimates, in their deviations, above which steps are halved."""
MAX_HALVINGS = 3
"""Largest number of times that steps are halved."""
FIT_COUNT = 15
"""Number of fits, for the progress."""

Progress = Callable[[str, float], None]
"""Callback with a stage and its completed fraction."""


def identify_rollout(
    logs: Sequence[Recording] | Recording,
    bodies: Bodies | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    stiffness: Numbers | None = None,
    damping: Numbers | None = None,
    feed_forward: Numbers | None = None,
    alike: Sequence[Sequence[str]] | None = None,
    contacts: Contacts = (),
    progress: Progress | None = None,
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
        stiffness: Known proportional gains of the servos, one for all or one for each
            joint, NaN where unknown [N m/rad or N/m].
        damping: Known derivative gains, which are compared with the estimates only [N m
            s/rad or N s/m].
        feed_forward: Known gains of the command's velocity; likewise.
        alike: Words in the names of joints of one kind, like `[["hip"], ["knee"]]`:
            they get similar parameters unless the logs contradict. If None, joints
            whose names differ only in a side are of one kind, like `left_hip` and
            `right_hip`.
        contacts: Starts and ends of the times in which something holds the robot, like
            `[(6.5, 64.7)]`, by the clock of the logs; of all logs, or by the name of
            the log. These samples do not count [s].
        progress: Callback, called with a stage and its completed fraction (0 to 1).

    Raises:
        InputError: If logs differ in their joints, are too short, or do not move, or if
            stiffness or kinds do not fit the joints.
    """
    logs = [logs] if isinstance(logs, Recording) else list(logs)
    motion = ServoMotion.of(logs, contacts).split()
    _require_motion(motion)
    names = _joint_names(motion, bodies, joint_names)
    groups = joint_groups(names, alike)
    all_gains = {
        "stiffness": stiffness,
        "damping": damping,
        "feed_forward": feed_forward,
    }
    gains = {
        name: _checked_gains(name, values, len(names))
        for name, values in all_gains.items()
        if values is not None
    }
    known_compliance = np.full(len(names), np.nan)
    if bodies is not None and "stiffness" in gains:
        known_compliance = 1.0 / gains["stiffness"]

    count = 0

    def advance() -> None:
        nonlocal count
        if progress is not None:
            progress("choosing effects", min(count / FIT_COUNT, 1.0))
        count += 1

    # Choices show in long steps, too.
    simulator = ServoSimulator(motion, float(motion.sample_time.max()), bodies=bodies)
    choice = EffectChoice.start(simulator, groups, known_compliance, advance)
    linear_parameters = _linear_baseline(choice.fit)
    # Held commands that count as interpolated ones would imitate a feed-forward.
    fine_fit, _ = _with_better_commands(choice.with_effects(("f",)))
    if fine_fit.simulator.hold:
        held_simulator = dataclasses.replace(simulator, hold=True)
        held_fit = _with_simulator(choice.fit, held_simulator, choice.fit.parameters)
        choice.fit = held_fit.improved(6).weighed_by_errors()
    choice.choose_all()
    fit = choice.fit
    if bodies is not None and not bodies.coupled:
        fit = _with_better_bodies(fit, bodies)
    fit = pull_equal_joints(fit, groups)

    if progress is not None:
        progress("refining", 0.0)
    fit, hold_is_told = _with_better_commands(fit)
    fit = without_imitations(fit, groups)
    undetermined = undetermined_effects(fit)
    # An effect that is zero is none.
    possible_effects = undetermined & (fit.parameters > LOWER)
    fit = _descend(without_effects(fit, undetermined))
    fine_fit = _in_short_enough_steps(fit)
    if fine_fit is not fit:
        fit, hold_is_told = _with_better_commands(fine_fit)
        # Errors of short steps are noise: estimates are worth the last rounds.
        fit = _descend(fit, min_fall=MIN_FALL / 100)
    heavy_joints = choice.loaded_joints & (known_compliance > 0.0)
    return ServoFit.of(
        fit,
        names,
        groups,
        possible_effects,
        linear=linear_parameters,
        hold_is_told=hold_is_told,
        gains=gains,
        compliances=_told_compliances(fit, groups, heavy_joints),
        contacts=contacts,
    )


def _told_compliances(
    fit: JointFit, groups: Sequence[Sequence[int]], joints: np.ndarray
) -> tuple[Combination, ...]:
    """Return what the logs tell of the given stiffness of joints under a weight."""
    if not joints.any():
        return ()
    free_mask = fit.free.copy()
    free_mask[joints, INDEX["a"]] = True
    trial = JointFit.of(
        fit.simulator, fit.parameters, free_mask, start=fit.start, weights=fit.weights
    ).improved(4)
    combinations = determined_combinations(trial, groups).combinations
    return tuple(c for c in combinations if c.name == "a" and joints[c.joint])


def _linear_baseline(fit: JointFit) -> JointParameters:
    """Return the parameters of linear joints of second order with delay."""
    parameters = fit.parameters.copy()
    parameters[:, parameter_mask(("F", "a"))] = 0.0
    free_mask = np.tile(parameter_mask(LINEAR_PARAMETERS), (len(parameters), 1))
    simulator = dataclasses.replace(fit.simulator, bodies=None)
    baseline = JointFit.of(
        simulator, parameters, free_mask, start=fit.start, weights=fit.weights
    )
    return baseline.improved(4).parameters


def _with_better_bodies(fit: JointFit, bodies: Bodies) -> JointFit:
    """Return the fit with inertial torques, if they lower held-out errors."""
    simulator = dataclasses.replace(
        fit.simulator, bodies=dataclasses.replace(bodies, coupled=True)
    )
    parameters = fit.parameters.copy()
    inertia = parameters[:, INDEX["a"]] * simulator.loads[1].mean(axis=(0, 2))
    rotor_inertia = parameters[:, INDEX["J"]] - inertia
    parameters[:, INDEX["J"]] = np.maximum(rotor_inertia, 1e-5)
    trial = JointFit.of(
        simulator, parameters, fit.free, start=fit.start, weights=fit.weights
    ).improved(4)
    is_better = trial.held_out_scores.mean() < fit.held_out_scores.mean()
    return trial.weighed_by_errors() if is_better else fit


def _with_simulator(
    fit: JointFit, simulator: ServoSimulator, parameters: JointParameters
) -> JointFit:
    """Return the fit in another simulator, with other parameters."""
    return JointFit.of(
        simulator,
        parameters,
        fit.free,
        start=fit.start,
        weights=fit.weights,
        pull=fit.pull,
    )


def _with_better_commands(fit: JointFit) -> tuple[JointFit, bool]:
    """Return the fit with held or interpolated commands.

    Returns:
        The better fit, and whether the logs tell it.
    """
    simulator = fit.simulator
    half_sample = 0.5 * float(simulator.motion.sample_time.mean())
    # Held commands are half a sample late.
    change = half_sample if simulator.hold else -half_sample
    parameters = fit.parameters.copy()
    delays = parameters[:, INDEX["d"]] + change
    parameters[:, INDEX["d"]] = np.clip(delays, 0.0, MAX_DELAY)
    rival_simulator = dataclasses.replace(simulator, hold=not simulator.hold)
    rival = _with_simulator(fit, rival_simulator, parameters)
    rivals = [rival]
    feed_forward = rival.free & parameter_mask(("f",))
    if feed_forward.any():
        # A feed-forward may imitate the commands that are not tried.
        rivals.append(without_effects(rival, feed_forward))
    fit = _descend(fit, CHOICE_ROUNDS)
    rival = min((_descend(x, CHOICE_ROUNDS) for x in rivals), key=_score)
    gain = _score(fit) - _score(rival)
    return rival if gain > 0.0 else fit, abs(gain) > MIN_FALL


def _descend(
    fit: JointFit, rounds: int = MAX_ROUNDS, min_fall: float = MIN_FALL
) -> JointFit:
    """Return the minimum, with loads and weights that follow the simulation."""
    for _ in range(rounds):
        previous_score = _score(fit)
        fit = fit.along_simulation().weighed_by_errors().improved(2)
        if abs(previous_score - _score(fit)) < min_fall:
            break
    return fit


def _in_short_enough_steps(fit: JointFit) -> JointFit:
    """Return the fit in steps so short that halving them hardly moves estimates.

    The errors of long steps hide in those of real robots, not in those of exact models.
    """
    for _ in range(MAX_HALVINGS):
        simulator = fit.simulator
        half_step = 0.5 * float(simulator.motion.sample_time.max()) / simulator.steps
        fine_simulator = dataclasses.replace(
            simulator, time_step=half_step, path=None
        ).with_loads_of(fit.parameters, fit.start)
        trial = _with_simulator(fit, fine_simulator, fit.parameters)
        # Less the step that long steps would take: no search ends exactly.
        damping = np.full(len(fit.parameters), 1e-3)
        changes = np.abs(trial.step(damping)[0] - fit.step(damping)[0])
        ratios = changes / np.maximum(fit.motion_deviations, 1e-300)
        # By chance some of many deviations are small: the median is not.
        if np.median(ratios[fit.free]) < MAX_STEP_ERROR:
            break
        fit = _descend(trial, 1)
    return fit


def _score(fit: JointFit) -> float:
    """Return the mean logarithm of the mean square errors."""
    return float(np.log(fit.mean_squares + RESOLUTION**2).mean())


def _require_motion(motion: ServoMotion) -> None:
    """Check that positions and commands of all joints change."""
    for channel in ("positions", "commands"):
        ranges = np.ptp(getattr(motion, channel), axis=-1).max(axis=0)
        if (ranges < 10 * RESOLUTION).any():
            joint = int(np.argmin(ranges)) + 1
            raise InputError(
                f"`logs`: the {channel} of joint {joint} change by less than 1 mrad or "
                "1 mm. Leave the joint out, or give logs in which it moves."
            )


def _joint_names(
    motion: ServoMotion, bodies: Bodies | None, names: Sequence[str] | None
) -> Texts:
    """Return the names of the joints: those given, of the bodies, or numbers."""
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


def _checked_gains(name: str, gains: Numbers, joints: int) -> Vector:
    """Return a gain of each joint, NaN where it is unknown."""
    values = np.asarray(gains, np.float64)
    has_shape = values.shape in ((), (joints,))
    if not has_shape or (values <= 0.0).any() or np.isinf(values).any():
        unit = "N m/rad or N/m" if name == "stiffness" else "N m s/rad or N s/m"
        raise InputError(
            f"`{name}` must be a positive number [{unit}], or {joints} of them, one "
            "for each joint."
        )
    return np.broadcast_to(values, (joints,)).copy()
