"""Progress bars of commands: stages, and samples of a long log with their speed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from jaxid.excitation.design import DesignProgress
from jaxid.measurement.observations import Progress as Callback


class _Speed(ProgressColumn):
    """Column with the speed and the remaining time."""

    def render(self, task):
        """Return the text of the column; empty before the speed is known."""
        if not task.fields.get("samples") or not task.speed:
            return Text("")
        done = 100 * task.completed / (task.total or 1.0)
        left = "" if task.time_remaining is None else f", {_clock(float(task.time_remaining))} left"
        speed = f", {_large(float(task.speed))} rows/s" if task.fields.get("rows") else ""
        return Text(f"{done:3.0f} %{speed}{left}")


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def _large(count: float) -> str:
    return f"{count / 1e6:.1f} million" if count >= 1e6 else f"{count:,.0f}".replace(",", " ")


class Stages:
    """Progress bar of a command, called with the name of each stage as it begins."""

    def __init__(self, bar: Progress, total: int):
        self._bar = bar
        self._task = bar.add_task("starting", total=total + 1)
        self._samples = bar.add_task("", total=1, samples=True, visible=False)

    def __call__(self, name: str) -> None:
        """Begin a stage.

        Args:
            name: Name of the stage.
        """
        self._bar.update(self._task, description=name, advance=1)
        self._bar.update(self._samples, visible=False)

    def through(self, samples: int) -> Callback:
        """Return a callback for the completed fraction of so many samples (a second bar).

        Args:
            samples: Number of samples.
        """
        return self._counting(samples, rows=True)

    def part(self) -> Callback:
        """Return a callback for the completed fraction of a stage (a second bar)."""
        return self._counting(1, rows=False)

    def _counting(self, total: int, rows: bool) -> Callback:
        self._bar.reset(self._samples, total=total, visible=False, samples=True, rows=rows)

        def progress(fraction: float) -> None:
            self._bar.update(self._samples, completed=fraction * total, visible=True)

        return progress


@contextmanager
def stages(console: Console, total: int) -> Iterator[Stages]:
    """Show a progress bar in a terminal, and nothing elsewhere.

    Args:
        console: Terminal.
        total: Number of stages.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), _Speed())
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as progress:
        yield Stages(progress, total)


@contextmanager
def designing(console: Console) -> Iterator[Callable[[DesignProgress], None]]:
    """Show a progress bar of a design with the best value so far, in a terminal only.

    Args:
        console: Terminal.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as progress:
        task = progress.add_task("preparing", total=1.0)

        def tell(now: DesignProgress) -> None:
            kept = "" if now.feasible else ", limits not yet kept"
            text = f"{now.task}, best so far {now.best:.5g}{kept}"
            progress.update(task, description=text, completed=now.fraction)

        yield tell
