"""The command `jaxid excite`: design of a motion to record, also when it is stopped."""

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from jaxid.cli.options import ExperimentFile, open_console, refuse_foreign_table
from jaxid.errors import InputError
from jaxid.excitation.criteria import CRITERIA
from jaxid.experiment.excitation import compare_criteria, design_motion, write_design
from jaxid.experiment.experiment import load_experiment
from jaxid.experiment.progress import designing
from jaxid.report.excitation import ordered, plan_remarks, side_by_side_table
from jaxid.report.page import show, show_files, show_remarks
from jaxid.table import Remark, Status

STOPPED = 130
"""Exit code of a command that Ctrl-C has ended, as shells expect it."""


def excite(
    experiment: ExperimentFile,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE.CSV", help="Table of the motion.")
    ] = Path("trajectory.csv"),
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where a design was stopped.")
    ] = False,
    all_criteria: Annotated[
        bool, typer.Option("--all-criteria", help="Show what each of the criteria buys.")
    ] = False,
) -> None:
    """Design the motion to record, within the limits of the joints.

    Beside the table lie the trajectory itself (.json), the same for ROS (.ros.yaml), pictures of
    joints and end-effector in a folder, and the state of the design until it is done. Ctrl-C keeps
    the best motion so far.
    """
    console = open_console()
    refuse_foreign_table(output)
    state = output.with_suffix(".state.npz")
    if state.exists() and not resume:
        raise InputError(
            f"`{state}` is there: a design was stopped before its end. `--resume` goes on with it; "
            "to begin anew, remove the file, or choose another -o."
        )
    loaded = load_experiment(experiment)
    if resume and not state.exists():
        text = f"`{state}` is not there to go on with: the design begins anew"
        show_remarks(console, [Remark(text, Status.DOUBTFUL)])
    try:
        with designing(console) as tell:
            excited = design_motion(loaded, tell, state, resume)
    except KeyboardInterrupt:
        open_console(stderr=True).print(Text(f"jaxid: {_nothing(state)}"), soft_wrap=True)
        raise typer.Exit(STOPPED) from None
    written = write_design(excited, output, _command_line(experiment, output, all_criteria))
    if not excited.plan.interrupted:
        state.unlink(missing_ok=True)
    show(console, *excited.plan.tables())
    show_remarks(console, ordered((*plan_remarks(excited.plan), *excited.aside.remarks)))
    names = [str(path.relative_to(output.parent)) for path in written]
    show_files(console, output.parent, names)
    if not all_criteria:
        return
    if excited.plan.interrupted:
        stopped = "the design was stopped, and no other criterion was tried"
        show_remarks(console, [Remark(stopped, Status.DOUBTFUL)])
        return
    with designing(console) as tell:
        plans = compare_criteria(loaded, tell)
    if plans:
        show(console, side_by_side_table(plans))
    if len(plans) < len(CRITERIA) or plans[-1].interrupted:
        done = sum(not plan.interrupted for plan in plans)
        text = f"stopped after {done} of {len(CRITERIA)} criteria"
        show_remarks(console, [Remark(text, Status.DOUBTFUL)])


def _nothing(state: Path) -> str:
    said = "the design was stopped before a motion kept all limits, and nothing was written"
    if state.is_file():
        return f"{said}: `--resume` goes on with `{state}`, where it was."
    return f"{said}: start again, and give it more time."


def _command_line(experiment: Path, output: Path, all_criteria: bool) -> str:
    """Return the command line that makes a motion again; the result is the same with `--resume`."""
    words = ["jaxid", "excite", str(experiment), "-o", str(output)]
    return shlex.join([*words, *(["--all-criteria"] if all_criteria else [])])
