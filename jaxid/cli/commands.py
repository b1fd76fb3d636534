"""The commands `jaxid init`, `example`, `inspect`, `identify`; what all run through."""

import functools
import importlib.metadata
import io
import sys
from pathlib import Path
from typing import Annotated

import jax
import typer
from rich.text import Text

from jaxid.cli import runs
from jaxid.cli.demo import demo
from jaxid.cli.excite import excite
from jaxid.cli.export import export
from jaxid.cli.options import (
    ExperimentFile,
    Force,
    command_line,
    describe_error,
    open_console,
    open_stages,
    require_one_log_per_option,
)
from jaxid.diagnose.diagnosis import mistakes_in_logs
from jaxid.diagnose.mislabelled import BAD
from jaxid.errors import InputError
from jaxid.experiment.experiment import Experiment, load_experiment
from jaxid.experiment.folder import (
    output_folder,
    refuse_foreign_folder,
)
from jaxid.experiment.loading import Loaded, choose, doubts_of, load_log, load_logs
from jaxid.experiment.progress import Stages
from jaxid.experiment.runs import earlier_run, is_report
from jaxid.experiment.template import write_template
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.identify import identify as estimate
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.runs.twice import share_data
from jaxid.identification.runs.update import update
from jaxid.program.cache import keep_compiled
from jaxid.report.result_files import write_report
from jaxid.report.result_json import Alternative
from jaxid.report.tables import (
    alternative_table,
    base_table,
    body_table,
    log_table,
    motor_tables,
    residual_table,
    solution_name,
)
from jaxid.report.terminal import show, show_files, show_remarks
from jaxid.table import Remark, Status, Table
from jaxid.validation import torque_errors, validate

DISTRIBUTION = "jaxid-robotics"

DELAYS = (
    "whether the forces stand later in the logs than the angles takes longer to tell: `jaxid "
    "inspect` says so for each log."
)

app = typer.Typer(
    name="jaxid",
    help="Identifies the dynamic parameters of robots: from a log to a model.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run a command; an error of a user is one sentence on stderr, with exit code 2."""
    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    if isinstance(sys.stdout, io.TextIOWrapper):  # some terminals know few characters
        sys.stdout.reconfigure(errors="replace")
    try:
        require_one_log_per_option()
        app()
    except (InputError, OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and type(error) is not RuntimeError:
            raise  # of JAX, not a failed search
        open_console(stderr=True).print(Text(f"jaxid: {describe_error(error)}"), soft_wrap=True)
        raise SystemExit(2) from None


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        try:
            shown = importlib.metadata.version(DISTRIBUTION)
        except importlib.metadata.PackageNotFoundError:
            shown = "(not installed)"
        open_console().print(Text(f"jaxid {shown}"))
        raise typer.Exit


@app.command()
def init(
    urdf: Annotated[Path, typer.Argument(help="The robot's URDF file.", metavar="ARM.URDF")],
    tip: Annotated[
        str | None,
        typer.Option(
            metavar="LINK", help="The end-effector: take only the chain that leads to it."
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="What stands on the ground; the root if left."),
    ] = None,
) -> None:
    """Print a commented experiment file for a robot.

    Like this: jaxid init arm.urdf > experiment.toml
    """
    text = write_template(urdf, tip=tip, base=base, folder=output_folder())
    typer.echo(text.encode(), nl=False)  # TOML is UTF-8, whatever the terminal is


@app.command()
def example(
    folder: Annotated[Path, typer.Argument(help="Where the files shall lie.", metavar="DIR")],
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Of parameters, motion and noise.")
    ] = 0,
) -> None:
    """Write an experiment to try things on.

    An experiment file and two logs of a virtual robot whose parameters are known.
    """
    from jaxid.simulation.example import write_example

    console = open_console()
    with open_stages(1) as stage:
        stage("simulating")
        files = write_example(folder, seed=seed)
    for file in files:
        console.print(Text(f"wrote {file}"), soft_wrap=True)
    console.print(
        Text(
            f"now: jaxid identify {folder}/experiment.toml {folder}/identification.csv "
            f"--verify {folder}/verification.csv -o {folder}/report"
        ),
        soft_wrap=True,
    )


@app.command()
def inspect(
    experiment: ExperimentFile,
    logs: Annotated[
        list[Path] | None, typer.Argument(help="Logs to look at.", metavar="LOG")
    ] = None,
) -> None:
    """Show what can be identified, and if logs are sane.

    Joints, motors and limits; base parameters and what becomes of each standard parameter; ranges,
    speeds and forces of each log beside the limits, and what the log does not determine.
    """
    console = open_console()
    loaded = load_experiment(experiment)
    paths = logs or []
    choices = len(paths) + 1 if loaded.candidates else 0
    with open_stages(1 + choices + 4 * len(paths)) as stage:
        stage("finding base parameters")
        _ = loaded.base.expressions
        loaded, _ = choose(loaded, paths, stage)
        seen = [_look(loaded, path, stage) for path in paths]
    show(console, loaded.robot.summary(), *motor_tables(loaded.robot), base_table(loaded.base))
    show_remarks(console, loaded.notes)
    for log, fit, doubts in seen:
        show(console, log_table(log.recording, log.diagnosis, doubts))
        show(console, Table("", facts=fit.facts, remarks=fit.determination))


def _look(experiment: Experiment, path: Path, stage: Stages) -> tuple[Loaded, Fit, tuple[str, ...]]:
    log = load_log(experiment, path, stage)
    stage(f"factorising {path.name}")
    progress = stage.through(log.recording.samples)
    fit = estimate(experiment.base, log.observations, experiment.estimation.plain, progress)
    stage(f"looking for mistakes in {path.name}")
    return log, fit, log.diagnosis.fit_findings(fit)


app.command()(excite)


@app.command()
def identify(
    experiment: ExperimentFile,
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs to identify with, fitted together; the folder of an earlier report stands "
            "for the logs it was made of.",
            metavar="LOG",
        ),
    ],
    verify: Annotated[
        list[Path] | None,
        typer.Option(
            "--verify",
            metavar="LOG",
            help="A log to verify with, which the fit does not see; may be repeated.",
        ),
    ] = None,
    split: Annotated[
        float | None,
        typer.Option(
            "--split",
            metavar="F",
            help="Use the first fraction F (0-1) of each log for identification, the rest for "
            "validation.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the report.")
    ] = Path("report"),
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write the figures as PDF too, for papers.")
    ] = False,
    force: Force = False,
) -> None:
    """Estimate the parameters and write a report.

    A page for the browser, with figures and a verdict; the same numbers for programs.
    """
    console = open_console()
    if split is not None and not 0 < split < 1:
        raise InputError(f"`--split` must lie between 0 and 1, like 0.6, but is {split:g}.")
    places = [p.resolve() for p in logs]
    repeated = next((p for k, p in enumerate(logs) if places[k] in places[:k]), None)
    if repeated is not None:
        raise InputError(f"`{repeated}` is given twice: what it tells would count double.")
    twice = set(places) & {p.resolve() for p in verify or []}
    if twice:
        raise InputError(
            f"`{sorted(twice)[0].name}` is given both to identify and to verify with: a model that "
            "has seen a log is not verified by it; use `--split` to divide one log."
        )
    refuse_foreign_folder(output, force)
    loaded = load_experiment(experiment)
    others = verify or []
    given, logs = logs, [p for p in logs if not is_report(p)]
    reports = [p for p in given if is_report(p)]
    if not logs:
        raise InputError(
            "folders of earlier reports stand for their logs, but at least one log must be given "
            "as a file, for torque errors and figures."
        )
    choices = len(logs) + 1 if loaded.candidates else 0
    with open_stages(4 + choices + 2 * (len(logs) + len(others))) as stage:
        loaded, choice = choose(loaded, logs, stage, split)
        read = load_logs(loaded, [*logs, *others], stage)
        said, doubts = [note for log in read for note in log.notes], doubts_of(read)
        observed = [log.observations for log in read]
        fitted, checked = observed[: len(logs)], observed[len(logs) :]
        if split is not None:
            parts = [o.split(split) for o in fitted]
            percent = f"{100 * split:g}"
            fitted = [a.replace(name=f"{a.name}, first {percent} %") for a, _ in parts]
            checked = [*(b.replace(name=f"{b.name}, rest") for _, b in parts), *checked]
        stage("finding base parameters")
        base = loaded.base
        stage("factorising the rows")
        rows = RegressionProblem(base, fitted, stage.through(sum(o.samples for o in fitted)))
        fit = loaded.fit(rows, stage.through(sum(o.samples for o in fitted)))
        if reports:
            fit = _together(loaded, reports, fit)
            for o in checked:
                if share_data(fit.blocks, RegressionProblem(base, [o]).blocks):
                    raise InputError(
                        f"a report that was given has seen the data of `{o.name}`: a model that "
                        "has seen a log is not verified by it; verify with another."
                    )
        stage("predicting torques")
        through = stage.through(max(o.samples for o in [*fitted, *checked]))
        found = validate(fit, [*fitted, *checked], progress=through)
        alternative = None
        if (loaded.estimation.regularised or fit.undetermined) and not reports:
            same = rows if fit.base is base else RegressionProblem(fit.base, fitted)
            other = fit_problem(same, loaded.other_estimator)
            names = (solution_name(fit.solution), solution_name(other.solution))
            errors = [torque_errors(other, o) for o in (*fitted, *checked)]
            alternative = Alternative(other, errors, names)
        suspected = mistakes_in_logs([log.diagnosis for log in read[: len(logs)]], fit)
        if fit.residual > BAD and not suspected:
            said.append(DELAYS)
        stage("writing the report")
        logs_said = [*(n for o in (*fitted, *checked) for n in o.notes), *said]
        files = write_report(
            output,
            fit,
            found.errors[: len(fitted)],
            found.errors[len(fitted) :],
            found.definiteness,
            {
                "experiment": str(experiment),
                "experiment_text": loaded.text,
                "command": command_line(experiment, given, others, split, output, pdf),
                "identification": [str(p) for p in given],
                "verification": [str(p) for p in others],
                "split": split,
                "filter": str(loaded.filter),
                "decimation": str(loaded.decimation),
                "slow": loaded.min_speed,
            },
            (*loaded.notes, *dict.fromkeys(logs_said), *doubts),
            alternative,
            choice,
            (*doubts, *suspected),
            pdf,
        )
    tabulated = () if fit.consistency is None else fit.consistency.findings
    noted = [*loaded.notes, *logs_said, *(note for note in fit.notes if note not in tabulated)]
    show(console, loaded.robot.summary(), *motor_tables(loaded.robot))
    show_remarks(console, [*noted, *(Remark(text, Status.DOUBTFUL) for text in doubts)])
    show(console, fit.summary())
    if fit.residual_spectra is not None:
        show(console, residual_table(fit.residual_spectra, loaded.robot))
    show_remarks(console, [Remark(text, Status.DOUBTFUL) for text in suspected])
    if fit.consistency is not None:
        show(console, body_table(fit.consistency, loaded.robot.joint_names))
    show(console, found.summary())
    if alternative is not None:
        show(console, alternative_table(found.errors, alternative.errors, alternative.names))
    show_files(console, output, [p.name for p in files])


def _together(experiment: Experiment, reports: list[Path], fit: Fit) -> Fit:
    """A run with what earlier reports know, as if all logs had been fitted at once."""
    if fit.base.names != experiment.base.names or not fit.is_least_squares:
        essential = experiment.estimation.essential is not None
        kind = "for essential parameters" if essential else fit.estimator
        raise InputError(
            f"{experiment.path.name}: earlier reports can be added to plain least squares only, "
            f"but the estimator is {kind}: leave `[estimator]` out, or give the logs "
            "themselves."
        )
    return functools.reduce(update, [*(earlier_run(experiment, p) for p in reports), fit])


app.command()(demo)
app.command()(runs.compare)
app.command()(runs.payload)
app.command()(runs.gains)
app.command()(runs.states)
app.command()(export)
