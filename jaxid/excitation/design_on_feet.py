"""Design of the motion of a robot on its feet (Eq. 36).

Phases are independent of each other, and their information adds up. So one phase after
another is replaced: by a random motion at first, then by changes of the best one. A
candidate is made smaller until it keeps all limits, and taken if the criterion falls.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import PRNGKeyArray
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.contact_elimination import contact_mask, elimination
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits, complete_limits
from jaxid.robot.virtual_joints import GROUP, driven_robot
from jaxid.trajectory.motion_on_feet import MotionOnFeet

from .checks_on_feet import CheckedMotion, ChecksOnFeet
from .coefficient_limits import unknown_limits
from .constraints import AbstractConstraint
from .criteria import AbstractCriterion, DOptimal, Information
from .criteria.information_matrix import BaseMatrix, JointVector
from .design_result import DesignProgress, DesignStatus, ExcitationPlan, progress_status
from .ground_forces import measured_motion
from .motions_on_feet import MotionsOnFeet, Phase, Standing
from .problem import CHECKED_INSTANTS, assumed_noise

NOISE_SHARE = 0.01
"""Noise of the force on the base, relative to the weight."""
GUARD = 0.5
"""Time around a change of contact whose samples are not counted on [s]."""
SHRINKAGE = 0.5
"""Factor by which coordinates are made smaller until all limits are kept."""
ACCOMPANYING_SHARE = 0.2
"""Share of these coordinates where joints of no leg exceed limits and shrink, too."""
MAX_SHRINKAGES = 24
"""Times that they are; then the motion becomes one without waves."""
MAX_NAMED = 3
"""Limits that are named if a robot cannot keep them."""
CHANGED_SHARE = 0.3
"""Share of the coordinates that a change of a motion replaces."""
MIN_DURATION = 1e-3
"""Duration of a search whose time was over before it began [s]."""
CHANGES = 4
"""Changes of each phase in a generation."""


class Candidate(NamedTuple):
    """A phase that keeps all limits, and what it tells."""

    phase: Phase
    information: Information


class DesignOnFeet:
    """Search for a motion on feet.

    Args:
        base: Base parameters to be determined.
        standing: How the robot stands.
        harmonics: Number of harmonics of each phase.
        omega: Ground frequency [rad/s].
        limits: Limits of the driven joints; the robot's if None.
        criterion: Criterion to be minimised.
        constraints: Constraints beside these limits.
        noise: Standard deviation of the forces' noise of each driven joint.
        prior: Information of earlier experiments.
        samples: Number of measured samples of one run.
    """

    def __init__(
        self,
        base: BaseParameters,
        standing: Standing,
        harmonics: int,
        omega: float,
        limits: Limits | None,
        criterion: AbstractCriterion | None,
        constraints: tuple[AbstractConstraint, ...],
        noise: JointVector | None,
        prior: BaseMatrix | None,
        samples: int,
    ):
        self.base = base
        self.motions = MotionsOnFeet(base, standing, harmonics, omega)
        joints = driven_robot(base.model.robot)
        known_limits = joints.limits if limits is None else limits
        complete = complete_limits(joints.replace(limits=known_limits))
        # Accelerations that nobody has given are limited by the torques alone.
        acceleration = known_limits.acceleration
        self.limits = dataclasses.replace(complete, acceleration=acceleration)
        self.assumed_limits = tuple(
            x for x in unknown_limits(known_limits) if x[0] != "acceleration"
        )
        self.checks = ChecksOnFeet(self.motions, self.limits, constraints)
        self.criterion = DOptimal() if criterion is None else criterion
        joint_noise = assumed_noise(joints) if noise is None else np.asarray(noise)
        if joint_noise.shape != (joints.joints,):
            raise InputError(
                "`noise` must hold one number for each of the "
                f"{joints.joints} driven joints, but is {joint_noise}."
            )
        # Also 1 % of the weight, and of its moment about the ground.
        pose = self.motions.pose[None]
        rest = Motion(pose, 0.0 * pose, 0.0 * pose)
        trunk = measured_motion(base.model.robot, rest)
        weight = base.forces_in_numpy(standing.parameters, trunk.motion)[0, 2]
        force_noise = np.full(3, NOISE_SHARE * weight)
        moment_noise = force_noise * self.motions.pose[2]
        self.noise = np.concatenate([force_noise, moment_noise, joint_noise])
        self.samples = samples
        self.prior = 0.0 if prior is None else np.asarray(prior)
        self.sizes = np.ones(base.size)
        self._value = jax.jit(self.criterion)

    def information(self, phase: Phase) -> Information:
        """Return what the samples of a phase tell."""
        motions = self.motions
        times = motions.times
        stands = motions.loads(phase.number, times) > 0.0
        trunk = measured_motion(motions.robot, phase.motion(times))
        X = elimination(motions.robot, trunk.motion.q, trunk.up, stands)
        motion = dataclasses.replace(trunk.motion, contacts=X)
        mask = contact_mask(motions.robot, motion)
        changes = np.flatnonzero(np.diff(stands.all(axis=1)))
        distances = np.abs(times[:, None] - times[changes])
        mask[(distances <= GUARD).any(axis=1)] = False
        rows = np.asarray(self.base.regressor(motion))
        # The samples of one run are shared by all phases.
        share = self.samples / motions.phases / len(times)
        plain_rows = rows[mask]
        weighted_rows = (rows / self.noise[:, None])[mask]
        return Information(
            share * plain_rows.T @ plain_rows,
            share * weighted_rows.T @ weighted_rows,
            self.sizes,
        )

    def total(self, candidates: Sequence[Candidate]) -> Information:
        """Return the information of all phases and of earlier experiments."""
        plain = np.sum([x.information.plain for x in candidates], axis=0)
        weighted = np.sum([x.information.weighted for x in candidates], axis=0)
        return Information(plain, weighted + self.prior, self.sizes)

    def value(self, candidates: Sequence[Candidate]) -> float:
        """Return the criterion of all phases."""
        return float(np.exp(self._value(self.total(candidates))))

    @property
    def instants(self) -> np.ndarray:
        """Times of a phase at which the result is checked, from its start [s]."""
        count = CHECKED_INSTANTS // self.motions.phases
        return np.linspace(0.0, self.motions.duration, count)

    def candidate(
        self,
        number: int,
        coefficients: np.ndarray,
        times: np.ndarray,
        random: np.random.Generator,
    ) -> Candidate:
        """Return a phase that is made smaller until it keeps all limits at some times.

        Raises:
            InputError: If not even the lean and the lift alone keep them.
        """
        checked = None
        shrinkages = MAX_SHRINKAGES if coefficients.any() else 0
        for attempt in range(shrinkages + 1):
            if attempt == shrinkages:
                coefficients = np.zeros_like(coefficients)
            phase = self.motions.phase(number, coefficients)
            if phase.spline is not None:
                checked = self.checks(phase, times)
                if checked.violation <= 0.0:
                    return Candidate(phase, self.information(phase))
            is_smaller = self._smaller_coordinates(checked, random)
            coefficients = np.where(is_smaller, SHRINKAGE, 1.0) * coefficients
        raise InputError(
            f"`{self.motions.robot.name}` cannot move in phase {number + 1} of "
            f"{self.motions.phases} (all feet stand, then each is lifted in its turn), "
            f"however little it sways: {self._reason(checked)}."
        )

    def _smaller_coordinates(
        self, checked: CheckedMotion | None, random: np.random.Generator
    ) -> np.ndarray:
        """Return which coordinates are to become smaller.

        Which ones exceed a limit is not known but for joints of no leg: random ones.
        """
        is_smaller = random.uniform(size=(self.motions.shape[0], 1)) < 0.5
        if checked is None or not self.motions.other_joints:
            return is_smaller
        other_joints = np.array(self.motions.other_joints) - GROUP
        exceeds = checked.joint_use[other_joints] > 1.0
        if exceeds.any():
            is_smaller &= random.uniform(size=is_smaller.shape) < ACCOMPANYING_SHARE
            is_smaller[GROUP:-GROUP, 0] |= exceeds
        return is_smaller

    def _reason(self, checked: CheckedMotion | None) -> str:
        """Return which limits a motion exceeds."""
        if checked is None:
            return "a leg cannot reach its place; give a `pose` with knees bent more"
        findings = [x for x in checked.findings if x.value > 0]
        findings.sort(key=lambda finding: -finding.value)
        sentences = [str(x) for x in findings[:MAX_NAMED]]
        if len(findings) > MAX_NAMED:
            sentences.append(f"{len(findings) - MAX_NAMED} more")
        largest_use = checked.use.max(axis=0)
        joint = int(largest_use.argmax())
        if largest_use[joint] > 1.0:
            name = self.motions.robot.joint_names[GROUP + joint]
            sentences.append(f"joint `{name}` exceeds its range, speed or acceleration")
        return f"{'; '.join(sentences)}; give another `pose`"

    def fine_candidate(
        self, number: int, coefficients: np.ndarray, random: np.random.Generator
    ) -> Candidate:
        """Return a phase that is made smaller until it keeps all limits everywhere."""
        # On the coarse grid each trial takes a tenth of the time.
        coarse = self.candidate(number, coefficients, self.motions.times, random)
        return self.candidate(number, coarse.phase.coefficients, self.instants, random)

    def keeps_limits(self, phase: Phase) -> bool:
        """Return whether a phase keeps its limits on a fine grid."""
        return self.checks(phase, self.instants).violation <= 0.0

    def change(
        self, waves: np.ndarray, new_waves: np.ndarray, random: np.random.Generator
    ) -> np.ndarray:
        """Return waves of which some coordinates are replaced, the others scaled."""
        is_new = random.uniform(size=(len(waves), 1)) < CHANGED_SHARE
        scaled_waves = random.uniform(0.8, 1.3) * waves
        return self.motions.bounded(np.where(is_new, new_waves, scaled_waves))

    def plan(
        self,
        candidates: Sequence[Candidate],
        reference: Information,
        status: DesignStatus,
        history: list[float],
    ) -> ExcitationPlan:
        """Return the result of the search."""
        motions = self.motions
        checks = [self.checks(x.phase, self.instants) for x in candidates]
        findings = [
            max(entries, key=lambda finding: finding.value)
            for entries in zip(*(x.findings for x in checks), strict=True)
        ]
        return ExcitationPlan(
            base=self.base,
            trajectory=motions.trajectory([x.phase for x in candidates]),
            criterion=self.criterion,
            limits=self.limits,
            assumed=self.assumed_limits,
            use=np.max([x.use for x in checks], axis=0),
            information=self.total(candidates),
            reference=reference,
            noise=self.noise,
            samples=self.samples,
            findings=tuple(findings),
            status=status,
            history=np.asarray(history),
            parameters=motions.standing.parameters,
        )


def design_on_feet(
    design: DesignOnFeet,
    *,
    starts: int = 32,
    generations: int = 12,
    key: PRNGKeyArray | None = None,
    progress: Callable[[DesignProgress], None] | None = None,
    begin: MotionOnFeet | None = None,
    seconds: float | None = None,
) -> ExcitationPlan:
    """Search for a motion on feet; arguments are those of `minimise`.

    Raises:
        InputError: If no motion keeps all limits.
        KeyboardInterrupt: If Ctrl-C came before a motion kept all limits.
    """
    start_time = time.monotonic()
    duration = math.inf if seconds is None else max(seconds, MIN_DURATION)
    key = jax.random.key(0) if key is None else key
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    motions = design.motions
    numbers = range(motions.phases)
    shape = (motions.phases, *motions.shape)
    if begin is not None and begin.coefficients.shape != shape:
        raise InputError("`begin` must be a motion of the same robot and settings.")
    # A robot that cannot even lean and lift its feet is refused at once.
    still_waves = np.zeros(motions.shape)
    candidates = [
        design.candidate(number, still_waves, motions.times, random)
        for number in numbers
    ]
    trajectory = motions.trajectory([x.phase for x in candidates])
    for number in numbers:
        if progress is not None:
            share = number / motions.phases
            task = "finding a first motion"
            progress(DesignProgress(share, task, math.inf, False, trajectory))
        waves = motions.random(random)
        candidates[number] = design.fine_candidate(number, waves, random)
    design.sizes = typical_sizes(design.total(candidates))
    reference = design.total(candidates)
    if begin is not None:
        first_waves = np.asarray(begin.coefficients)
        candidates = [
            design.fine_candidate(number, first_waves[number], random)
            for number in numbers
        ]
    trajectory = motions.trajectory([x.phase for x in candidates])
    history = [design.value(candidates)]
    steps = starts + CHANGES * motions.phases * generations
    try:
        for step in range(steps):
            number = step % motions.phases
            new_waves = motions.random(random)
            if step >= starts:
                waves = candidates[number].phase.coefficients
                new_waves = design.change(waves, new_waves, random)
            others = candidates.copy()
            others[number] = design.candidate(number, new_waves, motions.times, random)
            value = design.value(others)
            if value < history[-1] and design.keeps_limits(others[number].phase):
                candidates = others
                trajectory = motions.trajectory([x.phase for x in candidates])
            history.append(design.value(candidates))
            elapsed_time = time.monotonic() - start_time
            share = min(max((step + 1) / steps, elapsed_time / duration), 1.0)
            if progress is not None:
                task = "improving the phases"
                progress(DesignProgress(share, task, history[-1], True, trajectory))
            if elapsed_time > duration:
                break
    except KeyboardInterrupt:
        return design.plan(candidates, reference, DesignStatus.STOPPED, history)
    return design.plan(candidates, reference, progress_status(history), history)


def typical_sizes(information: Information) -> np.ndarray:
    """Return each parameter's deviation if it were the only one."""
    squares = np.diag(information.weighted)
    return 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))
