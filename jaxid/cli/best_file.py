"""The best file of a search so far, written whenever a better one is found."""

from pathlib import Path

from jaxid.io import write_text

from .process import Farewell


class BestFile(Farewell):
    """The best experiment file of a search so far.

    Within its context, a signal that ends the process says where the file is.
    """

    def __init__(self, output: Path):
        self._output = output
        self._is_writing = False

    def keep(self, text: str) -> None:
        """Write a better file."""
        # Ctrl-C may come between the file and the next line.
        self._is_writing = True
        write_text(self._output, text)

    def farewell(self) -> str:
        """Return the sentence with which Ctrl-C ends the search."""
        if not (self._is_writing and self._output.exists()):
            return "stopped before a change lowered the errors: nothing was written"
        return f"stopped: `{self._output}` holds the best model so far"
