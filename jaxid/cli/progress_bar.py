"""Progress bar of a command in a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress, TimeElapsedColumn


@contextmanager
def progress_bar(console: Console) -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar in a terminal, and nothing elsewhere.

    Yields:
        Function that shows the completed fraction (0 to 1) of a stage.
    """
    columns = (*Progress.get_default_columns(), TimeElapsedColumn())
    is_quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=is_quiet) as bar:
        task = bar.add_task("starting", total=1.0)

        def show(stage: str, fraction: float) -> None:
            if fraction == 0.0:
                bar.reset(task)  # the clock starts again
            bar.update(task, description=stage, completed=fraction)

        yield show
