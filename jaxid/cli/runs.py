"""Commands for several runs of one robot: `jaxid compare`, `payload`, `gains` and `states`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from jaxid.cli.options import (
    ExperimentFile,
    Force,
    open_console,
    open_stages,
    refuse_foreign_folder,
)
from jaxid.errors import InputError
from jaxid.experiment.experiment import Experiment, load_experiment
from jaxid.experiment.session import is_report, read_run, require_plain, select_filter
from jaxid.identification.comparison import compare as compare_fits
from jaxid.identification.drive_gains import identify_drive_gains
from jaxid.identification.fit import Fit
from jaxid.identification.payload import (
    CENTRAL_NAMES,
    CENTRAL_UNITS,
    Payload,
    identify_payload,
)
from jaxid.identification.states import identify_states
from jaxid.report.page import show, show_files, show_remarks
from jaxid.report.result_files import (
    estimate_rows,
    read_fit,
    write_comparison,
    write_estimates,
)
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.table import Remark, Status, significant

Unloaded = Annotated[
    list[Path],
    typer.Argument(
        help="Logs without the load, or folders of reports on such logs.", metavar="LOG"
    ),
]
Loaded = Annotated[
    list[Path],
    typer.Option(
        "--loaded",
        metavar="LOG",
        help="A log with the load, or the folder of a report; may be repeated.",
    ),
]
UNLIKELY = 0.01
"""Probability that the states agree on shared parameters, below which a remark is made."""


def compare(
    first: Annotated[
        Path, typer.Argument(help="Report of one run, like that of the cold robot.", metavar="COLD")
    ],
    second: Annotated[
        Path, typer.Argument(help="Report of another run of the same robot.", metavar="WARM")
    ],
    level: Annotated[
        float, typer.Option("--level", metavar="L", help="Confidence of the decisions (0-1).")
    ] = 0.95,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of table and figure.")
    ] = Path("comparison"),
    force: Force = False,
) -> None:
    """Decide which parameters have changed between two runs.

    Each argument is a folder that `jaxid identify` has written.
    """
    console = open_console()
    if first.resolve() == second.resolve():
        raise InputError(f"`{first}` is given twice: compare two different runs.")
    refuse_foreign_folder(output, force)
    twins = first.resolve().name == second.resolve().name
    cold, warm = (read_fit(path, str(path) if twins else None) for path in (first, second))
    found = compare_fits(cold, warm, level)
    with open_stages(1) as stage:
        stage("drawing")
        files = write_comparison(output, found, (first, second))
    show(console, found.summary(), found.group_summary())
    show_files(console, output, [p.name for p in files])


def payload(
    experiment: ExperimentFile,
    logs: Unloaded,
    loaded: Loaded,
    body: Annotated[
        str | None,
        typer.Option(
            "--body", metavar="JOINT", help="The joint that moves the body with the payload."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the result.")
    ] = Path("payload"),
    force: Force = False,
) -> None:
    """Find a payload's mass, centre of mass and moments of inertia.

    From logs without it and logs with it. Friction may differ between them.
    """
    refuse_foreign_folder(output, force)
    described = load_experiment(experiment)
    carrier = _body(described, body)
    pair, doubts = _pair(described, logs, loaded)
    found = identify_payload(*pair, body=carrier)
    name = described.robot.joint_names[found.body]
    content = {
        "body": name,
        "mass": found.mass,
        "centre_of_mass": found.centre_of_mass,
        "inertia": found.inertia,
        "estimate": found.estimate,
        "distance": found.distance,
    }
    sources = {"unloaded": logs, "loaded": loaded}
    rows = [
        *estimate_rows(INERTIAL_NAMES, INERTIAL_UNITS, found.parameters, found.uncertainty),
        *estimate_rows(CENTRAL_NAMES, CENTRAL_UNITS, *found.central),
    ]
    covariance = found.uncertainty.covariance
    files = write_estimates(output, "payload", rows, covariance, content, sources)
    console = open_console()
    show(console, found.summary())
    show_remarks(console, [Remark(text, Status.DOUBTFUL) for text in doubts])
    _show_lines(
        console, "to subtract it from other logs, in the experiment file:", _tool(found, name)
    )
    show_files(console, output, [p.name for p in files])


def gains(
    experiment: ExperimentFile,
    logs: Unloaded,
    loaded: Loaded,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the result.")
    ] = Path("gains"),
    force: Force = False,
) -> None:
    """Find the drives' true forces, like torque constants, with a load that is known.

    From logs without it and logs with it; the table `[load]` of the experiment file describes it.
    """
    refuse_foreign_folder(output, force)
    described = load_experiment(experiment)
    if described.load is None:
        raise InputError(
            f"{described.path.name}: the table `[load]` is missing: `mass`, `centre_of_mass` and "
            "`inertia` of what is on the robot in the logs behind `--loaded`."
        )
    pair, doubts = _pair(described, logs, loaded)
    found = identify_drive_gains(*pair, described.load)
    key, values = _corrected(described, np.asarray(found.gains))
    sources = {"unloaded": logs, "loaded": loaded}
    names = found.joint_names
    rows = estimate_rows(names, ("1",) * len(names), found.gains, found.uncertainty)
    covariance = found.uncertainty.covariance
    files = write_estimates(output, "gains", rows, covariance, {key: values}, sources)
    console = open_console()
    show(console, found.summary())
    show_remarks(console, [Remark(text, Status.DOUBTFUL) for text in doubts])
    shown = ", ".join(significant(v, 5) for v in values)
    lines = ["[recording]", f"{key} = [{shown}]"]
    _show_lines(console, "to use them, in the experiment file:", lines)
    show_files(console, output, [p.name for p in files])


def states(
    experiment: ExperimentFile,
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Logs, or folders of reports: one for each state, like cold and warm.",
            metavar="LOG",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the result.")
    ] = Path("states"),
    force: Force = False,
) -> None:
    """Fit several states of a robot at once: one inertia, friction for each.

    Like cold and warm. Friction and offsets are each state's own, all else is shared.
    """
    refuse_foreign_folder(output, force)
    described = load_experiment(experiment)
    names = [path.resolve().stem for path in logs]
    if len(set(names)) < max(len(names), 2):
        raise InputError(
            f"give one log or report for each of two or more states, with different names: they "
            f"name the states, but are {', '.join(names)}."
        )
    runs, doubts = _runs(described, [[path] for path in logs], names)
    found = identify_states(runs)
    chance = found.sharing[1]
    content = {
        "states": found.states,
        "shared": [found.base.names[k] for k in found.shared],
        "varying": [found.base.names[k] for k in found.varying],
        "sharing_chance": chance,
    }
    rows = estimate_rows(found.names, found.units, found.parameters, found.uncertainty)
    covariance = found.uncertainty.covariance
    files = write_estimates(output, "states", rows, covariance, content, {"states": logs})
    console = open_console()
    if chance < UNLIKELY:
        doubts.append(
            "the states do not agree on what they share (chance "
            f"{100 * chance:.2g} %): something else than friction and offsets differs"
        )
    show(console, found.summary())
    show_remarks(console, [Remark(text, Status.DOUBTFUL) for text in doubts])
    for other in names[1:]:
        comparison = found.compare(names[0], other)
        show(console, comparison.summary(), comparison.group_summary())
    show_files(console, output, [p.name for p in files])


def _pair(
    experiment: Experiment, logs: list[Path], loaded: list[Path]
) -> tuple[tuple[Fit, Fit], list[str]]:
    twice = {p.resolve() for p in logs} & {p.resolve() for p in loaded}
    if twice:
        raise InputError(
            f"`{sorted(twice)[0].name}` is given both without and with the load: name it once."
        )
    runs, doubts = _runs(experiment, [logs, loaded], ["unloaded", "loaded"])
    return (runs[0], runs[1]), doubts


def _runs(
    experiment: Experiment, each: list[list[Path]], names: list[str]
) -> tuple[list[Fit], list[str]]:
    """Return a run of the logs and reports of each state, and findings on the logs."""
    doubts = [*require_plain(experiment)]
    files = [p for paths in each for p in paths if not is_report(p)]
    choices = len(files) + 1 if experiment.candidates else 0
    runs = []
    with open_stages(1 + len(each) + choices + 2 * len(files)) as stage:
        stage("finding base parameters")
        _ = experiment.base
        experiment, _ = select_filter(experiment, files, stage)
        for paths, name in zip(each, names, strict=True):
            run, said = read_run(experiment, paths, stage, name)
            runs.append(dataclasses.replace(run, name=name))
            doubts += said
    return runs, doubts


def _body(experiment: Experiment, joint: str | None) -> int | None:
    names = experiment.robot.joint_names
    if joint is None:
        return None
    if joint not in names:
        raise InputError(f"`--body` must be one of {', '.join(names)}, but is `{joint}`.")
    return names.index(joint)


def _tool(found: Payload, joint: str) -> list[str]:
    def listed(values: np.ndarray) -> str:
        return ", ".join(f"{v:.6g}" for v in values)

    J = found.inertia
    keys = ("xx", "yy", "zz", "xy", "xz", "yz")
    entries = (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
    inertia = ", ".join(f"{k} = {v:.6g}" for k, v in zip(keys, entries, strict=True))
    return [
        "[robot.tool]",
        f'body = "{joint}"',
        f"mass = {found.mass:.6g}",
        f"centre_of_mass = [{listed(found.centre_of_mass)}]",
        f"inertia = {{ {inertia} }}",
    ]


def _corrected(experiment: Experiment, gains: np.ndarray) -> tuple[str, list[float]]:
    """Return the key of the file that corrects forces, and its values."""
    columns = experiment.columns
    if columns is not None and columns.torque_constants is not None:
        return "torque_constants", (np.array(columns.torque_constants) * gains).tolist()
    known = 1.0 if columns is None or columns.force_gains is None else columns.force_gains
    return "force_gains", (np.array(known) * gains).tolist()


def _show_lines(console: Console, text: str, lines: list[str]) -> None:
    console.print()
    console.print(Text(text, style="dim"))
    for line in lines:
        console.print(Text(line), soft_wrap=True)
