"""Methods for geometry: this package, and least squares of scipy as users write it."""

import numpy as np
from arm import GeometryResult
from scipy.spatial.transform import Rotation

NOISE = 1e-3
"""Error of a position [m] that counts as much as one of `ANGLE`."""
ANGLE = 1e-3
"""Error of an attitude [rad]."""
DISTANCE_NOISE = 1e-4
"""Error of the known distance [m]."""


def flange(robot, q, shifts=None, turns=None):
    """Return rotations and positions of the flange, joint origins being corrected."""
    R = np.broadcast_to(np.eye(3), (len(q), 3, 3))
    r = np.zeros((len(q), 3))
    for j in range(robot.joints):
        shift = robot.offset[j] + (0.0 if shifts is None else shifts[j])
        r = r + R @ shift
        R = R @ robot.rotation[j]
        if turns is not None:
            R = R @ Rotation.from_rotvec(turns[j]).as_matrix()
        R = R @ Rotation.from_rotvec(q[:, [j]] * robot.axis[j]).as_matrix()
    return R @ robot.tip_rotation, r + R @ robot.tip_offset


def least_squares(arm, with_origins):
    """Return the best tool, board and, if wanted, joint origins, by differences."""
    import scipy.optimize

    robot = arm.robot
    count = robot.joints

    def unknowns(x):
        tool = (Rotation.from_rotvec(x[3:6]).as_matrix(), x[:3])
        board = (Rotation.from_rotvec(x[9:12]).as_matrix(), x[6:9])
        origins = x[12:].reshape(2, count, 3) if with_origins else (None, None)
        return tool, board, origins

    def tips(x, q):
        (tool_rotation, tool), (board_rotation, board), origins = unknowns(x)
        R, r = flange(robot, q, *origins)
        points = (r + R @ tool - board) @ board_rotation
        return board_rotation.T @ R @ tool_rotation, points

    def residuals(x):
        parts = [1e-3 * x]
        for session in arm.sessions:
            centres = []
            for place, q in session.poses.items():
                R, r = tips(x, q)
                if session.measured:
                    rotations, positions = session.measured[place]
                    error = Rotation.from_matrix(np.swapaxes(rotations, 1, 2) @ R)
                    parts.append(error.as_rotvec().ravel() / ANGLE)
                else:
                    positions = r.mean(axis=0)
                    centres.append(positions)
                parts.append((r - positions).ravel() / NOISE)
            if centres:
                length = np.linalg.norm(centres[0] - centres[1])
                parts.append([(length - arm.distance) / DISTANCE_NOISE])
        return np.concatenate(parts)

    start = np.zeros(12 + 6 * count * with_origins)
    if arm.sessions[0].measured:
        start[:12] = hand_eye(arm)
    x = scipy.optimize.least_squares(residuals, start).x
    return GeometryResult(lambda q: tips(x, q))


def hand_eye(arm):
    """Return tool and board for the nominal geometry, as a start."""
    rotations = []
    positions = []
    measured_rotations = []
    measured_positions = []
    for session in arm.sessions:
        for place, q in session.poses.items():
            R, r = flange(arm.robot, q)
            rotations.append(R)
            positions.append(r)
            measured_rotations.append(session.measured[place][0])
            measured_positions.append(session.measured[place][1])
    R = np.concatenate(rotations)
    r = np.concatenate(positions)
    S = np.concatenate(measured_rotations)
    s = np.concatenate(measured_positions)
    # R T = B S for tool T and board B: linear, both as vectors of nine numbers.
    unit = np.eye(3)
    rows = [
        np.hstack([np.kron(a, unit), -np.kron(unit, b.T)])
        for a, b in zip(R, S, strict=True)
    ]
    solution = np.linalg.svd(np.concatenate(rows))[2][-1]
    tool_rotation = nearest_rotation(solution[:9])
    board_rotation = nearest_rotation(solution[9:])
    # r + R tool = board + B s.
    rows = np.concatenate([np.concatenate([a, -unit], axis=1) for a in R])
    offsets = np.linalg.lstsq(rows, (s @ board_rotation.T - r).ravel(), rcond=None)[0]
    angles = [
        Rotation.from_matrix(x).as_rotvec() for x in (tool_rotation, board_rotation)
    ]
    return np.concatenate([offsets[:3], angles[0], offsets[3:], angles[1]])


def nearest_rotation(vector):
    """Return the rotation that is nearest to a matrix of any size and sign."""
    matrix = vector.reshape(3, 3)
    U, _, V = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return U @ V


def scipy_script(arm):
    """Six corrections of each joint's origin, tool and board by `least_squares`."""
    return least_squares(arm, with_origins=True)


def nominal(arm):
    """The manufacturer's geometry; only tool and board are found."""
    return least_squares(arm, with_origins=False)


def jaxid(arm):
    """`jid.calibrate` with rough masses."""
    import jaxid as jid

    observations = []
    for session in arm.sessions:
        for place, q in session.poses.items():
            if session.measured:
                rotations, positions = session.measured[place]
                observations.append(
                    jid.calibration.MeasuredPose(
                        session.name,
                        q,
                        positions=positions,
                        rotations=rotations,
                        place_stays=True,
                    )
                )
            else:
                observations.append(
                    jid.calibration.PointContact(session.name, q, place=place)
                )
        if arm.distance:
            first, second = session.poses
            observations.append(
                jid.calibration.SocketDistance(
                    session.name,
                    place=first,
                    other_place=second,
                    distance=arm.distance,
                )
            )
    bodies = jid.calibration.rough_bodies(arm.robot, arm.masses)
    fit = jid.calibrate(arm.robot, observations, bodies=bodies)
    tool = fit.frames["", "tool"]
    boards = [x for key, x in fit.frames.items() if key != ("", "tool")]

    def tips(q):
        R, r = flange(fit.robot, q + fit.deflections(q))
        points = r + R @ tool.position
        if not arm.sessions[0].measured:
            return R @ tool.rotation, points
        board = boards[0]
        return (
            board.rotation.T @ R @ tool.rotation,
            (points - board.position) @ board.rotation,
        )

    return GeometryResult(tips)


KIND = "geometry"
METHODS = {"nominal": nominal, "scipy": scipy_script, "jaxid": jaxid}
