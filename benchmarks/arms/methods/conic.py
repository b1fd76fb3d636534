"""Physically consistent least squares by CVXPY and CLARABEL, as recent papers do it."""

import numpy as np
from arm import Result

from methods.pinocchio_script import Columns, stacked


def conic(arm):
    """Least squares under positive pseudo-inertias, friction and rotors, then CLARABEL.

    Rows are reduced to a triangle first; a small ridge keeps open directions small.
    """
    import cvxpy as cp

    columns = Columns(arm.robot)
    rows, forces = stacked(arm, columns)
    weights = 1.0 / forces.std(axis=0)
    W = (rows * weights[:, None]).reshape(-1, rows.shape[2])
    R = np.linalg.qr(np.column_stack([W, (forces * weights).ravel()]), mode="r")
    joints = arm.robot.joints
    p = cp.Variable(rows.shape[2])
    constraints = [p[10 * joints : 13 * joints] >= 0]
    for k in range(joints):
        m, x, y, z, xx, xy, yy, xz, yz, zz = (p[10 * k + j] for j in range(10))
        half = 0.5 * (xx + yy + zz)
        pseudo_inertia = cp.bmat(
            [
                [half - xx, -xy, -xz, x],
                [-xy, half - yy, -yz, y],
                [-xz, -yz, half - zz, z],
                [x, y, z, m],
            ]
        )
        constraints.append(pseudo_inertia >> 0)
    error = cp.sum_squares(R[:, :-1] @ p - R[:, -1]) + 1e-4 * cp.sum_squares(p)
    cp.Problem(cp.Minimize(error), constraints).solve(solver="CLARABEL")
    estimates = np.asarray(p.value)
    order = [0, 1, 2, 3, 4, 6, 9, 8, 7, 5]
    signs = np.array([1, 1, 1, 1, 1, 1, 1, -1, -1, -1.0])
    bodies = estimates[: 10 * joints].reshape(-1, 10)[:, order] * signs
    return Result(lambda *motion: columns(*motion) @ estimates, bodies)


KIND = "torques"
METHODS = {"CVXPY and CLARABEL": conic}
