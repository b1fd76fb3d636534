"""First estimates of where something stands, in closed form, for nominal geometry."""

import numpy as np

from jaxid.arrays import Matrix3, Vector, Vector3
from jaxid.robot.rotations import Vectors

from .frames import Frame


def centre_of_distances(points: Vectors, distances: Vector) -> Vector3:
    """Return the point that has these distances from points, as nearly as possible."""
    middle = points.mean(axis=0)
    rays = points - middle
    squares = np.sum(rays**2, axis=1) - distances**2
    matrix = np.column_stack([2.0 * rays, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(matrix, squares, rcond=1e-6)
    return middle + solution[:3]


def nearest_plane(points: Vectors) -> Frame:
    """Return a frame in the plane that points lie near; its z axis is the normal."""
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    handedness = np.linalg.det(axes)
    rotation = axes.T * np.array([1.0, 1.0, handedness])
    return Frame(rotation, middle)


def nearest_frame(points: Vectors, measured: Vectors) -> Frame:
    """Return the frame of an instrument whose measured points lie near the points."""
    middle = points.mean(axis=0)
    measured_middle = measured.mean(axis=0)
    rotation = nearest_rotation((points - middle).T @ (measured - measured_middle))
    return Frame(rotation, middle - rotation @ measured_middle)


def nearest_rotation(matrix: Matrix3) -> Matrix3:
    """Return the rotation that is nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    handedness = np.linalg.det(left @ right)
    return left * np.array([1.0, 1.0, handedness]) @ right


def tool_and_place(tips: Frame, measured: Frame) -> tuple[Frame, Frame]:
    """Return frames with `place @ measured = tip @ tool` as nearly as possible.

    First the attitudes, which are linear in the entries of both rotations, then the
    positions.
    """
    # By columns, the entries of A X B are those of X times kron(B', A).
    identity = np.eye(3)
    place_parts = [np.kron(R.T, identity) for R in measured.rotation]
    tool_parts = [np.kron(identity, R) for R in tips.rotation]
    matrix = np.concatenate(
        [np.block([place_parts[i], -tool_parts[i]]) for i in range(len(tool_parts))]
    )
    _, _, axes = np.linalg.svd(matrix, full_matrices=False)
    entries = axes[-1].reshape(2, 3, 3).swapaxes(1, 2)
    sign = np.sign(np.linalg.det(entries[0]))
    place_rotation, tool_rotation = (nearest_rotation(sign * x) for x in entries)

    turned_positions = measured.position @ place_rotation.T
    distances = (tips.position - turned_positions).ravel()
    columns = np.concatenate(
        [np.tile(identity, (len(tips.rotation), 1)), -tips.rotation.reshape(-1, 3)],
        axis=1,
    )
    solution, *_ = np.linalg.lstsq(columns, distances, rcond=1e-6)
    place_position, tool_position = np.split(solution, 2)
    return Frame(tool_rotation, tool_position), Frame(place_rotation, place_position)
