"""What is known of the parameters before the experiment: an earlier result, or the URDF file."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.experiment.experiment import Experiment
from jaxid.report.compared_files import read_estimates
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.plausibility import SNAP_TOLERANCE
from jaxid.robot.urdf import urdf_parameters


class Nominal(NamedTuple):
    """Base parameters as far as they are known before the experiment.

    Attributes:
        names: Of the base parameters.
        parameters: NaN where nothing is known.
        covariance: Of an earlier fit; None if the parameters are only claimed. Zero for what the
            fit leaves open: its estimates predict the forces of its logs, and no number says how
            well they predict others.
        open: Names of those parameters.
    """

    names: tuple[str, ...]
    parameters: Float[np.ndarray, " base"]
    covariance: Float[np.ndarray, "base base"] | None
    open: tuple[str, ...] = ()

    @property
    def sizes(self) -> Float[np.ndarray, " base"]:
        """The parameters; NaN for what is open as well, for its estimate means nothing alone."""
        return np.where(np.isin(self.names, self.open), np.nan, self.parameters)


def build_nominal(experiment: Experiment) -> Nominal | None:
    """What is known of the parameters: from an earlier result, or what the URDF file claims.

    Args:
        experiment: With its table `[excitation]`.

    Raises:
        InputError: If the earlier result is of other parameters.
    """
    base, report, robot = experiment.base, experiment.excitation.nominal, experiment.source
    if report is not None:
        found = read_estimates(experiment.path.parent / report)
        if found.names != base.names:
            raise InputError(
                f"`nominal`: the {len(found.names)} base parameters of `{report}` are not the "
                f"{base.size} of this experiment: identify with the same robot and model."
            )
        covariance = np.array(found.covariance)
        undecided = ~np.isfinite(np.diag(covariance))
        names = tuple(n for n, u in zip(found.names, undecided, strict=True) if u)
        covariance[undecided | undecided[:, None]] = 0.0
        return Nominal(base.names, np.asarray(found.parameters), covariance, names)
    if robot.urdf is None:
        return None
    try:
        claimed = urdf_parameters(
            experiment.path.parent / robot.urdf,
            tip=robot.tip,
            base=robot.base,
            snap_tolerance=SNAP_TOLERANCE if robot.snap_tolerance is None else robot.snap_tolerance,
        )
    except ValueError:
        if experiment.excitation.force_margin is not None:
            raise
        return None  # nothing is kept by it, and the robot's notes name the body that cannot be
    if not np.any(claimed):
        return None
    names = [f"{n}{i + 1}" for i in range(experiment.robot.joints) for n in INERTIAL_NAMES]
    known = dict(zip(names, np.asarray(claimed).tolist(), strict=True))
    standard = experiment.model.parameter_names
    values = np.asarray(base.from_standard([known.get(name, 0.0) for name in standard]))
    leads = [standard[k] in known for k in base.indices]
    return Nominal(base.names, np.where(leads, values, np.nan), None)
