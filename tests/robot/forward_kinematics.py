"""Forward kinematics in plain NumPy and SciPy: an oracle that shares no code."""

import numpy as np
from scipy.spatial.transform import Rotation


def transform(rotation, offset):
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = offset
    return T


def about(axis, angle):
    return transform(
        Rotation.from_rotvec(np.asarray(axis) * angle).as_matrix(), np.zeros(3)
    )


def along(axis, length):
    return transform(np.eye(3), np.asarray(axis) * length)


def from_rpy(rpy, xyz):
    return transform(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def body_transforms(robot, q):
    """4 x 4 placements of all bodies on the ground."""
    placed = []
    for i, parent in enumerate(robot.parent):
        T = transform(robot.rotation[i], robot.offset[i])
        move = about if robot.revolute[i] else along
        T = T @ move(robot.axis[i], q[i])
        placed.append(T if parent < 0 else placed[parent] @ T)
    return np.array(placed)


def tip_transform(robot, q):
    tip = transform(robot.tip_rotation, robot.tip_offset)
    return body_transforms(robot, q)[robot.tip_body] @ tip


def dh_frames(rows, q, convention, revolute=None):
    """4 x 4 placements of a table's frames 0, 1, …, n, one product after the other."""
    x, z = np.eye(3)[[0, 2]]
    frames = [np.eye(4)]
    for i, (alpha, a, d, *rest) in enumerate(rows):
        theta = rest[0] if rest else 0.0
        if revolute is None or revolute[i]:
            theta = theta + q[i]
        else:
            d = d + q[i]
        twist = [about(x, alpha), along(x, a)]
        turn = [about(z, theta), along(z, d)]
        T = frames[-1]
        for factor in twist + turn if convention == "modified" else turn + twist:
            T = T @ factor
        frames.append(T)
    return np.array(frames)


def urdf_chain(rows, q):
    """4 x 4 placements of a chain of (type, xyz, axis), all rpy zero."""
    T, placed = np.eye(4), []
    for (kind, xyz, axis), angle in zip(rows, q, strict=True):
        move = along if kind == "prismatic" else about
        T = T @ transform(np.eye(3), xyz) @ move(axis, angle)
        placed.append(T)
    return np.array(placed)


def random_configuration(robot, seed):
    """Angles all around, strokes of half a metre."""
    rng = np.random.default_rng(seed)
    reach = np.where(robot.revolute, np.pi, 0.5)
    return rng.uniform(-reach, reach)
