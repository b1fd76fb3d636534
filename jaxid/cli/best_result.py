"""The best result of a search so far, written whenever a better one is found."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from .process import farewells


class BestResult:
    """The best result of a search so far, in its files.

    Within its context, a signal that ends the process says where they are.

    Args:
        output: File that shows that a result was written.
        write: Function that writes a result.
        sentence: What a signal says where there is a result.
        excuse: What it says where there is none.
    """

    def __init__(
        self, output: Path, write: Callable[[Any], Any], sentence: str, excuse: str
    ):
        self._output = output
        self._write = write
        self._sentence = sentence
        self._excuse = excuse
        self._is_writing = False

    def __enter__(self) -> Self:
        farewells.append(self.farewell)
        return self

    def __exit__(self, *_: object) -> None:
        farewells.pop()

    def keep(self, result: Any) -> None:
        """Write a better result."""
        # Ctrl-C may come between the last file and the next line.
        self._is_writing = True
        self._write(result)

    def farewell(self) -> str:
        """Return the sentence with which Ctrl-C ends the search."""
        has_result = self._is_writing and self._output.exists()
        return self._sentence if has_result else self._excuse
