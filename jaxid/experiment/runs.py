"""Runs as a command needs them: from logs, or from what reports keep of theirs."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from jaxid.diagnose.diagnosis import mistakes_in_logs
from jaxid.errors import InputError
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.loading import doubts_of, load_log
from jaxid.experiment.progress import Stages
from jaxid.identification.fit import Fit, load
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.runs.least_squares import require_same_base
from jaxid.identification.runs.update import update
from jaxid.report.result_files import MODEL


def is_report(path: Path) -> bool:
    """Whether a path stands for the logs that a report was made of."""
    return path.is_dir()


def earlier_run(experiment: Experiment, folder: Path) -> Fit:
    """What a report keeps of the logs that it was made of.

    Args:
        experiment: Whose robot and model they must be of.
        folder: That `jaxid identify` has written.

    Raises:
        InputError: If it keeps nothing, or of another robot or model.
    """
    path = folder / MODEL
    if not path.is_file():
        raise InputError(
            f"`{folder}` is a folder, but holds no `{MODEL}`: name a log, or the folder of a "
            "report that `jaxid identify` has written."
        )
    fit = load(path)
    try:
        require_same_base((fit, dataclasses.replace(fit, base=experiment.base, name="these logs")))
    except InputError as error:
        raise InputError(f"`{path}` does not fit `{experiment.path.name}`: {error}") from error
    return fit


def require_plain(experiment: Experiment) -> tuple[str, ...]:
    """Refuses estimators whose search two runs cannot share, and says what counts for others.

    Args:
        experiment: Whose runs are looked at together.

    Raises:
        InputError: If friction's shapes are to be found.
    """
    if experiment.linear is not None:
        raise InputError(
            f"{experiment.path.name}: `estimator.nonlinear_friction` would find other shapes of "
            "friction in each run: leave it out, and give both runs the shapes that `jaxid "
            "identify` finds, as `epsilon` and `stribeck` of `model.coulomb`."
        )
    chosen = experiment.estimation
    plain = chosen.estimator is chosen.plain and not chosen.regularised
    if plain and chosen.essential is None:
        return ()
    return ("all runs are weighted least squares here: the rest of `[estimator]` does not count",)


def read_run(
    experiment: Experiment, paths: Sequence[Path], stage: Stages, name: str
) -> tuple[Fit, list[str]]:
    """Logs, and reports that stand for theirs, as one run; and doubts about the logs.

    Args:
        experiment: Whose logs they are.
        paths: Of logs, and of folders of reports.
        stage: Is told what is done.
        name: Of the run.

    Raises:
        InputError: If a log is not as the experiment's file says, or a folder holds no report.
    """
    earlier = [earlier_run(experiment, path) for path in paths if is_report(path)]
    logs = [load_log(experiment, path, stage) for path in paths if not is_report(path)]
    doubts = doubts_of(logs)
    if logs:
        observed = [log.observations for log in logs]
        stage(f"factorising the rows, {name}")
        through = stage.through(sum(o.samples for o in observed))
        rows = RegressionProblem(experiment.base, observed, through)
        fit = fit_problem(rows, experiment.estimation.plain)
        doubts += mistakes_in_logs([log.diagnosis for log in logs], fit)
        earlier.append(fit)
    return functools.reduce(update, earlier), doubts
