"""Waiting for other processes, on machines that may be slow and busy."""

import subprocess
from collections.abc import Sequence

SECONDS = 1800
"""Time after which a process counts as hung: no test is about speed."""


def outputs(processes: Sequence[subprocess.Popen]) -> list[str]:
    """Wait for processes and return what each has written; none is left behind."""
    try:
        return [process.communicate(timeout=SECONDS)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
            # Closes the pipes, whose rest would be a warning in a later test.
            process.communicate()
