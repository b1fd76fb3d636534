"""Figures of one method on one robot: errors of poses that were held out."""

import numpy as np
from scipy.spatial.transform import Rotation


def pose_errors(result, session):
    """Return the error of each pose of a session: lengths [m] and angles [rad].

    A ball stays in its socket, whose place is the mean of the positions.
    """
    lengths = []
    angles = []
    for place, q in session.poses.items():
        rotations, positions = result.tips(q)
        if session.measured:
            measured_rotations, places = session.measured[place]
            turns = np.swapaxes(measured_rotations, 1, 2) @ rotations
            angles += Rotation.from_matrix(turns).magnitude().tolist()
        else:
            places = positions.mean(axis=0)
        lengths += np.linalg.norm(positions - places, axis=1).tolist()
    return lengths, angles


def figures(arm, method):
    """Return all figures by name: each session is held out in turn."""
    means = []
    all_angles = []
    for session in arm.sessions:
        others = [x for x in arm.sessions if x is not session]
        lengths, angles = pose_errors(method(arm._replace(sessions=others)), session)
        means.append(float(np.mean(lengths)))
        all_angles += angles
    return {
        "error": float(np.mean(means)),
        "worst": max(means),
        "angle": float(np.mean(all_angles)) if all_angles else None,
    }
