"""Measured robots of `../shared/data`, and where each of their logs is divided."""

from arm import Arm
from timing import DATA, EXPERIMENTS, PENDULUM, PENDULUM_LOGS

SPLIT = 0.6
"""Share of a single log that is identified from; the rest is unseen."""


def one_log(name, band, log):
    """Return a robot with one log, which is divided in time."""
    import jaxid as jid

    path = EXPERIMENTS / f"{name}.toml"
    # The default estimator, as a new experiment file has it.
    text = path.read_text(encoding="utf-8").split("[estimator]")[0]
    content = jid.experiment.parse_experiment(text, path)
    recording = jid.workflow.read_log(content.setup, DATA / log, content.columns)
    first_part, _ = recording.split(SPLIT)
    end = first_part.duration
    first_text = text.replace("[recording]", f"[recording]\nstop = {end}")
    rest_text = text.replace("[recording]", f"[recording]\nstart = {end}")
    logs = [DATA / log]
    return Arm(name, band, first_text, logs, rest_text, logs, EXPERIMENTS)


def tx40():
    """Stäubli TX40, six axes, coupled wrist; `figaroh-examples`, Apache-2.0.

    One log of 9 s at 5 kHz, motor side; first 60 %, then the rest. Not known: the true
    parameters. Its robot file's inertial values are not used.
    """
    return one_log("tx40", 20.0, "tx40/motor_position.csv")


def ur10():
    """Universal Robots UR10, six axes; `inverse-dynamics-solver`, BSD-3-Clause.

    One log of 27.5 s at 125 Hz, torques from motor currents; first 60 %, then the rest.
    """
    return one_log("ur10", 4.0, "ur10/exciting_measured.csv")


def kr300():
    """KUKA KR300 R2500 ultra, six axes; `Robot_Identification`, MIT.

    Log A to identify from, B and C unseen. Slow motion, and a counterbalance on joint 2
    that no method here knows.
    """
    path = EXPERIMENTS / "kr300.toml"
    text = path.read_text(encoding="utf-8").split("[estimator]")[0]
    logs = [DATA / "kr300" / f"traj_{x}.csv" for x in "ABC"]
    return Arm("kr300", 5.0, text, logs[:1], text, logs[1:], EXPERIMENTS)


def pendulum():
    """Double pendulum of DFKI, design C.1, two axes; `double_pendulum`, BSD-3-Clause.

    Four logs of 10 s at 500 Hz to identify from, two unseen. Encoders of 14 bits:
    between 6 and 20 Hz, the torques that their accelerations give are eight to fifty
    times those that were measured. Hence a band of 5 Hz.
    """
    folder = DATA / "double_pendulum"
    text = PENDULUM.format(folder=folder)
    logs = [folder / f"{x}.csv" for x in PENDULUM_LOGS]
    return Arm("pendulum", 5.0, text, logs[:4], text, logs[4:], folder)


KIND = "torques"
SETS = {"tx40": tx40, "ur10": ur10, "kr300": kr300, "pendulum": pendulum}
