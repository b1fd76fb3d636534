"""Xacro files, which the program `xacro` expands with their arguments to URDF."""

import re
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

from jaxid.errors import InputError

from .limits_and_drives import listed

MAX_SECONDS = 60.0
"""Time after which the program is stopped [s]."""
ARGUMENT = re.compile(rb"<[\w.-]+:arg\s[^>]*?\bname\s*=\s*[\"']([^\"']*)[\"']")
"""Element of a xacro file that declares an argument, with its name."""


def expand_xacro(path: Path, arguments: Mapping[str, str]) -> bytes:
    """Return a xacro file as the program `xacro` expands it.

    Args:
        path: Path of the file.
        arguments: Texts of its arguments, by name.

    Raises:
        InputError: If the program is missing, fails or does not end, or the file has no
            argument of a name.
    """
    assignments = [f"{name}:={text}" for name, text in arguments.items()]
    words = [str(path), *assignments]
    command = f"`xacro {' '.join(words)} -o {path.name.split('.')[0]}.urdf`"
    program = shutil.which("xacro")
    if program is None:
        raise InputError(
            f"`{path}` is a xacro file: expand it by {command} (`pip install xacro`)."
        )
    process = _run([program, *words], path, command)
    if process.returncode:
        message = process.stderr.decode(errors="replace").strip()
        reason, *_ = message.splitlines() or ["no reason given"]
        raise InputError(
            f"`{path}`: {command} fails: {reason}: give the expanded file, or the "
            "arguments that it needs (`xacro_arguments` in `[robot]`, `jaxid init "
            "--xacro NAME:=VALUE`)."
        )
    if arguments:
        listing = _run([program, *words, "--deps"], path, command).stdout
        _refuse_unknown(path, arguments, listing.decode(errors="replace").split())
    return process.stdout


def _run(words: list[str], path: Path, command: str):
    """Run the program, for a limited time."""
    try:
        return subprocess.run(
            words, capture_output=True, stdin=subprocess.DEVNULL, timeout=MAX_SECONDS
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"`{path}`: {command} has not ended after {MAX_SECONDS:g} s: give the "
            "expanded file."
        ) from error


def _refuse_unknown(
    path: Path, arguments: Mapping[str, str], included_files: list[str]
):
    """Reject an argument that no file declares, which the program would ignore."""
    names = []
    for file in (path, *map(Path, included_files)):
        if file.is_file():
            names += [name.decode() for name in ARGUMENT.findall(file.read_bytes())]
    for name in arguments.keys() - names:
        raise InputError(
            f"`{path}` has no xacro argument `{name}`; it has "
            f"{listed(names) or 'none'}."
        )
