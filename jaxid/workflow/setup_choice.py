"""Choice between setups of a robot by errors on parts of logs unseen by the fits."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import equinox as eqx

from jaxid.errors import InputError
from jaxid.identification.friction_laws import (
    identify_presliding,
    identify_transition_speeds,
)
from jaxid.identification.model_selection import (
    ModelCandidate,
    ModelChoice,
    choose_model,
)
from jaxid.measurement.columns import Columns
from jaxid.measurement.observations import Observations

from .log_identification import require_separate_logs
from .log_loading import load_logs, select_filter
from .setup import Paths, Progress, Setup, ignore_progress


def choose_setup(
    setups: Mapping[str, Setup],
    logs: Paths,
    columns: Columns,
    progress: Progress = ignore_progress,
) -> ModelChoice:
    """Choose between models and estimators by the errors of unseen parts of logs.

    Args:
        setups: Setups of one robot by their names. Their logs are read and filtered as
            the first one says.
        logs: Paths of logs.
        columns: Meaning of their columns.
        progress: Callback, called with a stage and its completed fraction (0 to 1).

    Returns:
        The choice; `chosen.name` is the name of the setup that is chosen.
    """
    paths = [Path(log) for log in logs]
    require_separate_logs(paths)
    setup, *_ = setups.values()
    if setup.nonlinear_friction:
        raise InputError(
            "leave `estimator.nonlinear_friction` out: the choice is between models "
            "that are linear in their parameters."
        )
    setup = select_filter(setup, paths, columns, progress)
    observations = [
        log.observations for log in load_logs(setup, paths, columns, progress)
    ]
    return choose_setup_by_rows(setups, observations, progress)


def choose_setup_by_rows(
    setups: Mapping[str, Setup],
    observations: Sequence[Observations],
    progress: Progress = ignore_progress,
) -> ModelChoice:
    """Choose between models and estimators by errors on unseen parts of the logs."""
    progress("choosing the model", 0.0)
    candidates = []
    for name, setup in setups.items():
        base = identify_transition_speeds(setup.base, observations)
        candidates.append(ModelCandidate(name, base, setup.estimator))
    candidates = with_common_length(candidates, observations)
    choice_progress = partial(progress, "choosing the model")
    return choose_model(candidates, observations, progress=choice_progress)


def with_common_length(
    candidates: Sequence[ModelCandidate], observations: Sequence[Observations]
) -> list[ModelCandidate]:
    """Return candidates with the presliding lengths of that with most parameters."""
    bases = [x.base for x in candidates if x.base.model.memory is not None]
    if not bases:
        return list(candidates)
    largest_base = max(bases, key=lambda base: base.size)
    memory = identify_presliding(largest_base, observations).model.memory
    length = getattr(memory, "length", None)
    changed_candidates = []
    for candidate in candidates:
        model = candidate.base.model
        if model.memory is not None:
            model = model.with_memory(length=length)
        base = eqx.tree_at(lambda x: x.model, candidate.base, model)
        changed_candidates.append(candidate._replace(base=base))
    return changed_candidates
