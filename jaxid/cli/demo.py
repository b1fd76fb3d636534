"""The command `jaxid demo`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from jaxid.cli.options import Force, open_console, open_stages
from jaxid.experiment.folder import refuse_foreign_folder


def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the report.")
    ] = Path("demo"),
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Of motions and noise.")
    ] = 0,
    force: Force = False,
) -> None:
    """Do the whole paper on a virtual TX90L on its rail.

    Base parameters, optimal excitation, measurement cold and warm, identification, verification on
    the path of ISO 9283, and how well the path is followed with and without the model.
    """
    from jaxid.demo.page import write_study
    from jaxid.demo.study import run_study
    from jaxid.demo.tables import remarks, tables
    from jaxid.report.terminal import show, show_remarks

    console = open_console()
    refuse_foreign_folder(output, force)
    with open_stages(15) as stage:
        part = stage.part()

        def progress(name: str, fraction: float) -> None:
            nonlocal part
            if fraction == 0.0:
                stage(name)
                part = stage.part()
            else:
                part(fraction)

        study = run_study(seed, progress)
        stage("writing the report")
        files = write_study(output, study)
    show(console, *tables(study))
    show_remarks(console, remarks(study))
    console.print()
    console.print(Text(f"the report: {files[0]}"), soft_wrap=True)
