"""The table `[excitation]` becomes constraints, what earlier motions told, and trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.excitation.constraints.clearance import Clearance
from jaxid.excitation.constraints.constraint import AbstractConstraint
from jaxid.excitation.constraints.tip import TipAcceleration, TipSpeed, Workspace
from jaxid.excitation.criteria import (
    AbstractCriterion,
    AOptimal,
    ConditionNumber,
    DOptimal,
    EOptimal,
    ScaledConditionNumber,
    WeightedConditionNumber,
)
from jaxid.excitation.information import information
from jaxid.experiment.excited_forces import force_limits
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.nominal import Nominal
from jaxid.experiment.tables import ExcitationTable
from jaxid.trajectory.basis import AbstractBasis
from jaxid.trajectory.files import load_trajectory
from jaxid.trajectory.fourier import FourierBasis, RestToRestBasis
from jaxid.trajectory.leads import LeadsBasis
from jaxid.trajectory.spline import RestToRestSplineBasis
from jaxid.trajectory.trajectory import count_cycles

CRITERIA: dict[str, Callable[[], AbstractCriterion]] = {
    "d_optimal": DOptimal,
    "a_optimal": AOptimal,
    "e_optimal": EOptimal,
    "condition_number": ConditionNumber,
    "weighted_condition_number": WeightedConditionNumber,
    "scaled_condition_number": ScaledConditionNumber,
}
"""What `excitation.criterion` may be."""
LEAD = 0.5
"""Time of leads that are designed together with the motion where the file does not say [s]."""


def build_basis(table: ExcitationTable, constrained: bool) -> AbstractBasis:
    """The trajectories to choose from.

    Args:
        table: Of the experiment file.
        constrained: Whether there is more to keep than limits of joints: then leads are designed
            together with the motion, so that they keep it too.

    Raises:
        InputError: If two kinds are asked for, or one whose end no sample would meet.
    """
    if table.spline is not None:
        if table.rest:
            raise InputError(
                "`rest` is for Fourier series, and a `spline` rests at its ends: leave one out."
            )
        return RestToRestSplineBasis(table.spline.points, table.spline.duration)
    if table.rest:
        return RestToRestBasis(*table.series)
    series = FourierBasis(*table.series)
    if table.led is None:
        _require_division(table.sample_time, float(series.duration))
        return series
    if not constrained and table.led.time is None:
        return series
    lead = LEAD if table.led.time is None else table.led.time
    return LeadsBasis(*table.series, lead=lead, periods=table.led.periods)


def _require_division(sample_time: float | None, period: float) -> None:
    """Refuses samples of a motion at full speed that would end before it or go on after it."""
    if sample_time is None:
        return
    count = count_cycles(period, sample_time)
    if abs(count * sample_time - period) > 1e-6 * sample_time:
        raise InputError(
            f"`sample_time` must divide the period of {period:.9g} s where there are no `leads`, "
            f"for the motion repeats at full speed, but is {sample_time:g} s: choose `omega` = "
            f"{2 * np.pi / (count * sample_time):.9g}, or leave `leads` as they are."
        )


def build_constraints(
    experiment: Experiment, nominal: Nominal | None
) -> tuple[AbstractConstraint, ...]:
    """What the motion must keep beside the limits of the joints.

    Args:
        experiment: With its tables `[collision]` and `[excitation]`.
        nominal: What is known of the parameters.

    Raises:
        InputError: If forces are limited, but no parameters or no largest forces are known.
    """
    table = experiment.excitation
    found: list[AbstractConstraint] = []
    if experiment.collision is not None:
        found.append(Clearance(experiment.collision, experiment.clearance))
    if table.tip_speed is not None:
        found.append(TipSpeed(table.tip_speed))
    if table.tip_acceleration is not None:
        found.append(TipAcceleration(table.tip_acceleration))
    if table.workspace is not None:
        found.append(Workspace.of(*table.workspace))
    if table.force_margin is None:
        return tuple(found)
    if nominal is None:
        raise InputError(
            "`force_margin` needs parameters to compute forces with: say in `nominal` where an "
            "earlier result of `jaxid identify` is."
        )
    forces = force_limits(experiment, nominal, table.force_margin)
    if not forces:
        raise InputError(
            "`force_margin` needs largest forces: give `limits.force` or `drives.max_torques`."
        )
    return (*found, *forces)


def build_prior(
    experiment: Experiment, noise: Float[np.ndarray, " joints"]
) -> Float[np.ndarray, "base base"] | None:
    """What earlier motions will have told; None if there are none.

    Args:
        experiment: With its table `[excitation]`.
        noise: Standard deviations of the forces' noise.

    Raises:
        InputError: If the criterion knows no noise, or a file holds no motion of this robot.
    """
    table, folder = experiment.excitation, experiment.path.parent
    if not table.earlier:
        return None
    if not CRITERIA[table.criterion]().weighted:
        raise InputError(
            f'`earlier` and `criterion = "{table.criterion}"` do not go together: what motions '
            "tell adds up in units of the noise, which this criterion does not know; leave out "
            '`earlier`, or choose a criterion like "d_optimal".'
        )
    return np.sum([_told(experiment, folder / p, noise) for p in table.earlier], axis=0)


def _told(
    experiment: Experiment, path: Path, noise: Float[np.ndarray, " joints"]
) -> Float[np.ndarray, "base base"]:
    trajectory, samples = load_trajectory(path), experiment.excitation.samples
    if trajectory.joints != experiment.robot.joints:
        raise InputError(
            f"`earlier`: the motion of `{path}` moves {_joints(trajectory.joints)}, but the robot "
            f"`{experiment.robot.name}` has {experiment.robot.joints}: name motions of this robot."
        )
    times = np.arange(samples) * (float(trajectory.duration) / samples)
    motion = trajectory.motion(times)
    return np.asarray(information(experiment.base, motion, 1.0 / noise).weighted)


def _joints(count: int) -> str:
    return f"{count} joint{'' if count == 1 else 's'}"
