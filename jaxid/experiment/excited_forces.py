"""Forces of a designed motion: what limits them, and what is said of those that nothing limits."""

import re
from collections.abc import Iterator

import numpy as np

from jaxid.arrays import double_precision
from jaxid.excitation.constraints.constraint import Finding
from jaxid.excitation.constraints.forces import (
    AbstractForceLimits,
    JointForces,
    MotorTorques,
    NominalForces,
)
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.nominal import Nominal
from jaxid.identification.runs.estimates import groups
from jaxid.report.blocks import Remark, Tone
from jaxid.report.excitation_words import named
from jaxid.trajectory.trajectory import AbstractTrajectory

LOOKED_AT = 4000
"""Instants at which the forces of a motion are looked at that was designed without them."""


def force_limits(
    experiment: Experiment, nominal: Nominal, margin: float
) -> tuple[AbstractForceLimits, ...]:
    """Limits of joints' forces and motors' torques, as far as the robot has them.

    Args:
        experiment: Whose robot it is.
        nominal: What the forces are computed with; what is unknown of it counts as zero.
        margin: Share of the limits that stays unused.
    """
    robot = experiment.robot
    forces = NominalForces.of(
        experiment.base, np.nan_to_num(nominal.parameters), nominal.covariance
    )
    found: list[AbstractForceLimits] = []
    if np.isfinite(robot.limits.force).any():
        found.append(JointForces(forces, margin))
    if np.isfinite(robot.drives.max_torques).any():
        found.append(MotorTorques(forces, margin))
    return tuple(found)


def force_remarks(
    experiment: Experiment, nominal: Nominal | None, played: AbstractTrajectory
) -> Iterator[Remark]:
    """What is to be said of the forces of a motion, where any are limited.

    Args:
        experiment: With its table `[excitation]`.
        nominal: What is known of the parameters.
        played: The motion with its leads.
    """
    robot, margin = experiment.robot, experiment.excitation.force_margin
    if not np.isfinite(robot.known_max_forces).any():
        return
    if nominal is None:
        yield Remark(
            Tone.DOUBTFUL,
            "forces were not looked at, although they have limits, for no parameters are known: "
            "say in `excitation.nominal` where an earlier result is, and give `force_margin` to "
            "keep the limits",
        )
        return
    if margin is None:
        yield _looked_at(experiment, nominal, played)
    unknown = unknown_words(experiment, nominal)
    if unknown:
        text = f"not known, and counted as zero in the forces: {unknown}"
        yield Remark(Tone.DOUBTFUL, text)
    if nominal.open:
        yield Remark(
            Tone.DOUBTFUL,
            f"`{experiment.excitation.nominal}` does not determine {', '.join(nominal.open)}: the "
            "forces are computed with its estimates of them, whose uncertainty counts as zero",
        )


def _looked_at(experiment: Experiment, nominal: Nominal, played: AbstractTrajectory) -> Remark:
    robot, found = experiment.robot, []
    with double_precision():
        motion = played.motion(np.linspace(0.0, float(played.duration), LOOKED_AT))
        for limit in force_limits(experiment, nominal, 0.0):
            found += limit.describe(robot, np.asarray(limit(robot, motion)))
    beyond = [_share(one) for one in found if one.value > 0]
    if beyond:
        return Remark(
            Tone.BAD,
            "by the nominal parameters this motion needs more than robot and motors can give: "
            f"{'; '.join(beyond)}; give `force_margin`, and the design keeps these limits",
        )
    nearest = max(found, key=lambda one: one.value)
    return Remark(
        Tone.PLAIN,
        f"forces were not part of the design; by the nominal parameters they stay within their "
        f"limits, the nearest being {_share(nearest)} (`force_margin` keeps them with room)",
    )


def _share(one: Finding) -> str:
    return f"{one.name} with {100 * one.used:.1f} % of {one.limit:.4g} {one.unit}"


def unknown_words(experiment: Experiment, nominal: Nominal) -> str:
    """The unknown parameters by effect and joint; empty if all are known.

    Args:
        experiment: With its base parameters.
        nominal: What is known of them.
    """
    base, robot = experiment.base, experiment.robot
    joints: dict[str, list[int]] = {}
    for k in np.flatnonzero(np.isnan(nominal.parameters)):
        number = re.search(r"\d+$", base.model.parameter_names[base.indices[k]])
        if number is not None:
            joints.setdefault(groups(base)[k], []).append(int(number[0]) - 1)
    effects: dict[str, list[str]] = {}
    for effect, of in joints.items():
        effects.setdefault(named(robot, sorted(set(of))), []).append(effect)
    return "; ".join(f"{', '.join(words)} of {where}" for where, words in effects.items())
