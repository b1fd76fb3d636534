"""Robots of `../shared/data` whose geometry is calibrated from poses."""

import numpy as np
from arm import GeometryArm, Session
from timing import DATA

PANDA = (4.97, 0.647, 3.229, 3.588, 1.226, 1.667, 0.735)
IIWA = (6.4, 8.9, 4.3, 4.4, 2.6, 2.8, 0.6)
HOLES = ("hole_0", "hole_1")
FOLDS = 10
"""Number of parts of the FR3's poses, divided at random."""


def ball(name, folder, file, masses):
    """Return an arm whose ball was placed into two sockets, 50 mm apart."""
    import jaxid as jid

    robot = jid.load_urdf(DATA / "mukca" / file)
    sessions = []
    for path in sorted((DATA / "mukca" / folder).iterdir()):
        poses = {x: np.loadtxt(path / f"{x}.csv", delimiter=",") for x in HOLES}
        sessions.append(Session(path.name, poses, {}))
    return GeometryArm(name, robot, masses, sessions, 0.05)


def panda_1():
    """First Panda: a ball in two sockets, three sessions; MUKCa, MIT.

    Starts from the manufacturer's table. Each session is held out in turn; what is
    known is the distance of the sockets. The ball's place on the flange is unknown.
    """
    return ball("panda_1", "panda_1", "panda_nominal.urdf", PANDA)


def panda_2():
    """Second Panda, eight sessions; MUKCa, MIT."""
    return ball("panda_2", "panda_2_clean", "panda_nominal.urdf", PANDA)


def iiwa14():
    """KUKA iiwa 14, three sessions; MUKCa, MIT."""
    return ball("iiwa14", "kuka_14", "iiwa14.urdf", IIWA)


def fr3():
    """Franka FR3: 114 poses of a camera; `robot-arm-kinematic-calibration`, MIT.

    Ten parts of the poses, divided at random, are held out in turn. Where the camera
    sits on the flange and where the board stands is unknown.
    """
    from scipy.spatial.transform import Rotation

    import jaxid as jid

    table = np.loadtxt(DATA / "fr3" / "camera_poses.csv", delimiter=",", skiprows=1)
    rotations = Rotation.from_rotvec(table[:, 10:]).as_matrix()
    order = np.random.default_rng(0).permutation(len(table))
    sessions = []
    for number, rows in enumerate(np.array_split(order, FOLDS)):
        poses = {"board": table[rows, :7]}
        measured = {"board": (rotations[rows], table[rows, 7:10])}
        sessions.append(Session(f"part {number}", poses, measured))
    robot = jid.load_urdf(DATA / "mukca" / "panda_nominal.urdf")
    return GeometryArm("fr3", robot, PANDA, sessions, None)


KIND = "geometry"
SETS = {"panda_1": panda_1, "panda_2": panda_2, "iiwa14": iiwa14, "fr3": fr3}
