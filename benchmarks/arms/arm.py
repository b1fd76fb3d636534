"""What a set of the benchmark gives to a method, and what a method gives back."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]


class Signals(NamedTuple):
    """Joint motion and torques of one log, filtered alike below the set's band."""

    q: np.ndarray  # [samples, joints]
    qd: np.ndarray
    qdd: np.ndarray
    forces: np.ndarray
    sample_time: float  # [s]


class Arm(NamedTuple):
    """One robot: its description, logs to identify from, and logs that are unseen.

    `text` and `unseen_text` are experiment files of this package, since a set is read
    once; other methods take `signals` and `robot`, or their own reading of the files.
    """

    name: str
    band: float  # cut-off frequency at which all methods are judged [Hz]
    text: str  # experiment file for the logs to identify from
    logs: Sequence[Path]
    unseen_text: str  # experiment file for the unseen logs
    unseen_logs: Sequence[Path]
    folder: Path  # folder to which paths in the experiment files are relative
    machine: Any = None  # the simulated machine, if its parameters are the truth

    def experiment(self, unseen: bool = False) -> Any:
        """Return the experiment of the logs, or of the unseen ones."""
        import jaxid as jid

        text = self.unseen_text if unseen else self.text
        return jid.experiment.parse_experiment(text, self.folder / "experiment.toml")

    @property
    def robot(self) -> Any:
        """Known geometry, limits and drives: a `jaxid.Robot`."""
        return self.experiment().setup.robot

    def signals(self, unseen: bool = False) -> list[Signals]:
        """Return the filtered signals of each log."""
        import jaxid as jid

        content = self.experiment(unseen)
        low_pass = jid.ZeroPhaseButterworth(self.band)
        parts = []
        for log in self.unseen_logs if unseen else self.logs:
            recording = jid.workflow.read_log(content.setup, log, content.columns)
            seen = jid.observe(recording, content.setup.robot, low_pass)
            motion = seen.reduced_motion
            arrays = (motion.q, motion.qd, motion.qdd, seen.reduced_forces)
            # Parts of a log that has gaps are not one motion.
            for start, stop in seen.row_segments:
                part = [np.asarray(x)[start:stop] for x in arrays]
                parts.append(Signals(*part, seen.sample_time))
        return parts


class Result(NamedTuple):
    """What a method returns: a function, and what else it knows."""

    # Forces [samples, joints] of a motion (q, qd, qdd), each [samples, joints].
    forces: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    # Ten parameters of each body (m, m c, A, B, C, D, E, F), if there are any.
    bodies: np.ndarray | None = None


class ServoArm(NamedTuple):
    """Robot of position-controlled joints: commands and positions, no torques."""

    name: str
    logs: list[Any]  # recordings to identify from; their `forces` are the commands
    unseen_logs: list[Any]
    bodies: Any  # `jaxid.rollout.Bodies` of the robot's file
    joints: tuple[int, ...]  # joints that are judged
    stiffness: float | None = None  # known gain of the servos [N m/rad]


class ServoResult(NamedTuple):
    """What a method for servo joints returns."""

    # Positions [samples, joints] of some recordings, each simulated from its first
    # position under its commands.
    positions: Callable[[list[Any]], list[np.ndarray]]


class Session(NamedTuple):
    """Poses of one session of a calibration; a place is one socket, or one board."""

    name: str
    poses: dict[str, np.ndarray]  # joint coordinates [poses, joints] of each place
    # Measured rotations and positions of each place; none if a ball stays in a socket.
    measured: dict[str, tuple[np.ndarray, np.ndarray]]


class GeometryArm(NamedTuple):
    """Robot whose nominal geometry is known, and sessions of poses to calibrate it."""

    name: str
    robot: Any  # `jaxid.Robot` of nominal geometry
    masses: tuple[float, ...]  # rough masses of the bodies [kg]
    sessions: list[Session]
    distance: float | None  # known distance of the two sockets [m]


class GeometryResult(NamedTuple):
    """What a method for geometry returns."""

    # Rotation [poses, 3, 3] and position [poses, 3] of the tool, in the robot's base;
    # of measured poses in the frame in which they are measured.
    tips: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
