"""Robots of position-controlled joints in `../shared/data`: commands and encoders."""

import re
import tempfile
from importlib.metadata import distribution
from pathlib import Path

from arm import ServoArm
from timing import DATA

SEEN = ("multisine", "chirp_sweep", "friction_gravity", "step_response")
UNSEEN = (
    "actuator_bandwidth",
    "center_workspace",
    "circular_motion",
    "coupled_joints",
    "frequency_sweep",
    "backlash_detection",
)
URDF = "cmeel.prefix/share/example-robot-data/robots/so_arm_description/urdf/so101.urdf"


def recording(path):
    """Return a log whose commands take the place of forces."""
    import jaxid as jid

    columns = jid.Columns(time="time", angles="position{}", forces="command{}")
    return jid.read_recording(path, columns)


def bodies_of(robot, path, **options):
    """Return the rigid bodies of a robot with the parameters of its file."""
    import jaxid as jid

    model = jid.Model(robot, (jid.RigidBodies(),))
    return jid.rollout.Bodies(model, jid.robots.urdf_parameters(path, **options))


def so101():
    """SO-101, five servos of a hobby arm at 50 Hz, 12 bits; `sage`, Apache-2.0.

    Four motions of 94 to 170 s to identify from, six unseen. Its URDF file is that of
    `example-robot-data`. The jaw is not judged.
    """
    import jaxid as jid

    path = Path(str(distribution("example-robot-data").locate_file(URDF)))
    bodies = bodies_of(jid.load_urdf(path), path)
    logs = [[recording(DATA / "so101" / f"{x}.csv") for x in y] for y in (SEEN, UNSEEN)]
    return ServoArm("so101", *logs, bodies, tuple(range(5)))


def go2():
    """Unitree Go2, hung: twelve joints, 200 Hz; `sim2real-robot-identification`.

    BSD-3-Clause. A chirp of 23.5 s: first 70 %, then the rest. The authors set the
    servos' gain to 20 N m/rad.
    """
    import jaxid as jid

    text = (DATA / "go2" / "go2.xml").read_text(encoding="utf-8")
    # The meshes of the file are not here.
    text = re.sub(r'<mesh [^>]*/>|<geom [^>]*mesh="[^>]*/>', "", text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "go2.xml"
        path.write_text(text, encoding="utf-8")
        robot = jid.load_mjcf(path, base="base")
        bodies = bodies_of(robot, path, base="base")
    seen, unseen = recording(DATA / "go2" / "chirp.csv").split(0.7)
    return ServoArm("go2", [seen], [unseen], bodies, tuple(range(12)), 20.0)


KIND = "servos"
SETS = {"so101": so101, "go2": go2}
