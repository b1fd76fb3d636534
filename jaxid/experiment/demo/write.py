"""Writes what the demo has found into a folder."""

from pathlib import Path

from jaxid.experiment.demo.page import page
from jaxid.experiment.demo.record import record
from jaxid.experiment.demo.study import Study
from jaxid.io import atomic_folder
from jaxid.report.page import write_page
from jaxid.report.write import write_json

FILES = ("report.html", "demo.json")


def write_study(folder: Path, study: Study) -> list[Path]:
    """Writes all files, or none of them; returns them.

    Args:
        folder: Of the files.
        study: What was found.
    """
    with atomic_folder(folder) as staging:
        write_page(staging / FILES[0], page(study))
        write_json(staging / FILES[1], record(study))
    return [folder / name for name in FILES]
