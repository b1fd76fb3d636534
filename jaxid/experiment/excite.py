"""From the table `[excitation]` to a design."""

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from jaxid.excitation.criteria import (
    AbstractCriterion,
    AOptimal,
    ConditionNumber,
    DOptimal,
    EOptimal,
    ScaledConditionNumber,
    WeightedConditionNumber,
)
from jaxid.excitation.design import DesignProgress, design_excitation
from jaxid.excitation.plan import ExcitationPlan
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.robot_tables import within
from jaxid.trajectory.basis import FourierBasis
from jaxid.trajectory.rest import RestToRestBasis

CRITERIA: dict[str, Callable[[], AbstractCriterion]] = {
    "d_optimal": DOptimal,
    "a_optimal": AOptimal,
    "e_optimal": EOptimal,
    "condition_number": ConditionNumber,
    "weighted_condition_number": WeightedConditionNumber,
    "scaled_condition_number": ScaledConditionNumber,
}
"""What `excitation.criterion` may be."""


def design(
    experiment: Experiment,
    progress: Callable[[DesignProgress], None],
    state: Path,
    resume: bool,
) -> ExcitationPlan:
    """Designs the motion that the experiment file asks for.

    Args:
        experiment: With its table `[excitation]`, or the defaults.
        progress: Is told how far the design is.
        state: File that keeps the state of the design.
        resume: Goes on from that file if it is there.

    Raises:
        ValueError: If the table does not fit the robot, or no motion keeps all limits.
    """
    table = experiment.excitation
    with within(experiment.path.name, "excitation"):
        kind = RestToRestBasis if table.rest else FourierBasis
        return design_excitation(
            experiment.base,
            basis=kind(table.harmonics, table.omega),
            criterion=CRITERIA[table.criterion](),
            starts=table.starts,
            polish=min(table.polish, table.starts),
            key=jax.random.key(table.seed),
            noise=None if table.noise is None else np.array(table.noise),
            samples=table.samples,
            progress=progress,
            state=state,
            resume=resume,
        )
