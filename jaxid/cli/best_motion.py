"""The best motion of a search so far, written whenever a better one is found."""

from pathlib import Path

from jaxid.trajectory.trajectory import LinearTrajectory
from jaxid.workflow.motion_design import MotionTask, make_playable, write_motion

from .process import Farewell


class BestMotion(Farewell):
    """The best motion of a search so far, in its files.

    Within its context, a signal that ends the process says where the motion is.
    """

    def __init__(self, task: MotionTask, output: Path):
        self._task = task
        self._output = output
        self._is_writing = False

    def keep(self, motion: LinearTrajectory) -> None:
        """Write a better motion."""
        robot = self._task.setup.robot
        excitation = self._task.excitation
        playable = make_playable(robot, excitation, motion)
        # Ctrl-C may come between the last file and the next line.
        self._is_writing = True
        write_motion(robot, excitation, playable, self._output)

    def farewell(self) -> str:
        """Return the sentence with which Ctrl-C ends the search."""
        if not (self._is_writing and self._output.exists()):
            return "stopped before a motion kept all limits, and nothing was written"
        faults = self._task.faults
        note = f"; NOT CHECKED: {'; '.join(faults)}" if faults else ""
        return (
            f"stopped: `{self._output}` and the files beside it hold "
            "the best motion so far, which keeps all limits that "
            f"were checked{note}; `--resume` continues from it"
        )
