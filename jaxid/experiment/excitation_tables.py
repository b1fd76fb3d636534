"""The table `[excitation]` becomes constraints, what is known before, and trajectories."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.dynamics.terms import INERTIAL_NAMES
from jaxid.excitation.constraints.clearance import Clearance
from jaxid.excitation.constraints.constraint import AbstractConstraint
from jaxid.excitation.constraints.forces import JointForces, MotorTorques, NominalForces
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
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.tables import ExcitationTable
from jaxid.report.compared_files import read_estimates
from jaxid.robot.snap import SNAP_TOLERANCE
from jaxid.robot.urdf import urdf_parameters
from jaxid.trajectory.basis import AbstractBasis, FourierBasis
from jaxid.trajectory.files import load_trajectory
from jaxid.trajectory.leads_basis import LeadsBasis
from jaxid.trajectory.rest import RestToRestBasis
from jaxid.trajectory.spline import RestToRestSplineBasis
from jaxid.types import Float

CRITERIA: dict[str, Callable[[], AbstractCriterion]] = {
    "d_optimal": DOptimal,
    "a_optimal": AOptimal,
    "e_optimal": EOptimal,
    "condition_number": ConditionNumber,
    "weighted_condition_number": WeightedConditionNumber,
    "scaled_condition_number": ScaledConditionNumber,
}
"""What `excitation.criterion` may be."""


class Nominal(NamedTuple):
    """Base parameters as far as they are known before the experiment.

    Attributes:
        parameters: NaN where nothing is known.
        covariance: Of an earlier fit; None if the parameters are only claimed.
    """

    parameters: Float[np.ndarray, " base"]
    covariance: Float[np.ndarray, "base base"] | None


def build_basis(table: ExcitationTable, constrained: bool) -> AbstractBasis:
    """The trajectories to choose from.

    Args:
        table: Of the experiment file.
        constrained: Whether there is more to keep than limits of joints: then leads are designed
            together with the motion, so that they keep it too.

    Raises:
        ValueError: If two kinds are asked for.
    """
    if table.spline is not None:
        if table.rest:
            raise ValueError(
                "`rest` is for Fourier series, and a `spline` rests at its ends: leave one out."
            )
        return RestToRestSplineBasis(table.spline.points, table.spline.duration)
    if table.rest:
        return RestToRestBasis(table.harmonics, table.omega)
    kind = LeadsBasis if constrained and table.leads else FourierBasis
    return kind(table.harmonics, table.omega)


def build_nominal(experiment: Experiment) -> Nominal | None:
    """What is known of the parameters: from an earlier result, or what the URDF file claims.

    Args:
        experiment: With its table `[excitation]`.

    Raises:
        ValueError: If the earlier result is of other parameters.
    """
    base, report, robot = experiment.base, experiment.excitation.nominal, experiment.source
    if report is not None:
        found = read_estimates(experiment.path.parent / report)
        if found.names != base.names:
            raise ValueError(
                f"`nominal`: the {len(found.names)} base parameters of `{report}` are not the "
                f"{base.size} of this experiment: identify with the same robot and model."
            )
        return Nominal(np.asarray(found.parameters), np.asarray(found.covariance))
    if robot.urdf is None:
        return None
    claimed = urdf_parameters(
        experiment.path.parent / robot.urdf,
        tip=robot.tip,
        base=robot.base,
        snap_tolerance=SNAP_TOLERANCE if robot.snap_tolerance is None else robot.snap_tolerance,
    )
    if not np.any(claimed):
        return None
    names = [f"{n}{i + 1}" for i in range(experiment.robot.joints) for n in INERTIAL_NAMES]
    known = dict(zip(names, np.asarray(claimed).tolist(), strict=True))
    standard = experiment.model.parameter_names
    values = np.asarray(base.from_standard([known.get(name, 0.0) for name in standard]))
    leads = [standard[k] in known for k in base.indices]
    return Nominal(np.where(leads, values, np.nan), None)


def build_constraints(
    experiment: Experiment, nominal: Nominal | None
) -> tuple[AbstractConstraint, ...]:
    """What the motion must keep beside the limits of the joints.

    Args:
        experiment: With its tables `[collision]` and `[excitation]`.
        nominal: What is known of the parameters.

    Raises:
        ValueError: If forces are limited, but no parameters or no largest forces are known.
    """
    table, found = experiment.excitation, []
    if experiment.collision is not None:
        found.append(Clearance(experiment.collision, experiment.clearance))
    if table.tip_speed is not None:
        found.append(TipSpeed(table.tip_speed))
    if table.tip_acceleration is not None:
        found.append(TipAcceleration(table.tip_acceleration))
    if table.workspace is not None:
        found.append(Workspace.of(*table.workspace))
    if table.force_margin is not None:
        found += _forces(experiment, nominal, table.force_margin)
    return tuple(found)


def _forces(
    experiment: Experiment, nominal: Nominal | None, margin: float
) -> list[AbstractConstraint]:
    if nominal is None:
        raise ValueError(
            "`force_margin` needs parameters to compute forces with: say in `nominal` where an "
            "earlier result of `jaxid identify` is."
        )
    robot = experiment.robot
    forces = NominalForces.of(
        experiment.base, np.nan_to_num(nominal.parameters), nominal.covariance
    )
    found: list[AbstractConstraint] = []
    if np.isfinite(robot.limits.force).any():
        found.append(JointForces(forces, margin))
    if np.isfinite(robot.drives.max_torques).any():
        found.append(MotorTorques(forces, margin))
    if not found:
        raise ValueError("`force_margin` needs largest forces: give `limits.force`.")
    return found


def build_prior(
    experiment: Experiment, noise: Float[np.ndarray, " joints"]
) -> Float[np.ndarray, "base base"] | None:
    """What earlier motions will have told; None if there are none.

    Args:
        experiment: With its table `[excitation]`.
        noise: Standard deviations of the forces' noise.

    Raises:
        ValueError: If the criterion knows no noise, or a file holds no motion of this robot.
    """
    table, folder = experiment.excitation, experiment.path.parent
    if not table.earlier:
        return None
    if not CRITERIA[table.criterion]().weighted:
        raise ValueError(
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
        raise ValueError(
            f"`earlier`: the motion of `{path}` moves {_joints(trajectory.joints)}, but the robot "
            f"`{experiment.robot.name}` has {experiment.robot.joints}: name motions of this robot."
        )
    times = np.arange(samples) * (float(trajectory.duration) / samples)
    motion = trajectory.motion(times)
    return np.asarray(information(experiment.base, motion, 1.0 / noise).weighted)


def _joints(count: int) -> str:
    return f"{count} joint{'' if count == 1 else 's'}"
