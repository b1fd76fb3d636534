"""Folders: whether one may take a report or a comparison, and where the output ends up."""

import os
import stat
import sys
from pathlib import Path

from jaxid.errors import InputError
from jaxid.io import read_json, require_writable
from jaxid.report.result_json import SCHEMAS
from jaxid.trajectory.files import load_trajectory


def refuse_foreign_folder(target: Path, force: bool) -> None:
    """Refuses to put a report into a folder that holds other things; an earlier report may go.

    Args:
        target: Folder of the report.
        force: Whether the report may stand beside other files.

    Raises:
        OSError: If nothing can be written there.
        InputError: If there is something else in its place.
    """
    if target.exists() and not target.is_dir():
        raise InputError(f"`{target}` is a file, but a report needs a folder: choose another -o.")
    if force or not target.is_dir() or not any(target.iterdir()) or _is_report(target):
        require_writable(target)
        return
    raise InputError(
        f"`{target}` holds files but no report: choose another folder with -o, or add --force to "
        "put the report beside them."
    )


def refuse_foreign_table(target: Path) -> None:
    """Refuses to write a motion over other files; an earlier motion may go.

    Args:
        target: The table, beside which the trajectory lies with the suffix `.json`, the message for
            ROS, and a folder of pictures.

    Raises:
        OSError: If nothing can be written there.
        InputError: If the name is not that of a table, or something else is in its place.
    """
    if target.suffix.lower() != ".csv":
        raise InputError(f"`{target}` must end in .csv: choose another -o.")
    beside, pictures = target.with_suffix(".json"), target.with_suffix("")
    if _is_trajectory(beside):
        return
    ros = (target.with_suffix(f".ros.{kind}") for kind in ("yaml", "json"))
    drawn = sorted(pictures.iterdir()) if pictures.is_dir() else []
    found = next((path for path in (target, beside, *ros, *drawn) if path.exists()), None)
    if found is not None:
        raise InputError(
            f"`{found}` is there already, and no motion of `jaxid excite`: choose another -o."
        )
    require_writable(target.parent)


def _is_trajectory(path: Path) -> bool:
    try:
        load_trajectory(path)
    except (OSError, ValueError):
        return False
    return True


def _is_report(folder: Path) -> bool:
    return any(_has(folder / file, schema) for file, schema in SCHEMAS.items())


def _has(path: Path, schema: str) -> bool:
    try:
        held = read_json(path)
        return str(held["schema"]).startswith(schema.split("/")[0])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def output_folder() -> Path | None:
    """This folder, or None if the output is redirected into a file of another one."""
    try:
        status = os.fstat(sys.stdout.fileno())
    except (OSError, ValueError):
        return Path()
    if not stat.S_ISREG(status.st_mode):
        return Path()
    here = (entry.stat(follow_symlinks=False) for entry in os.scandir())
    return Path() if any(os.path.samestat(status, one) for one in here) else None
