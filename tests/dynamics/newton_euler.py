"""Newton's and Euler's laws in plain NumPy, in the ground's frame, about mass centres.

It shares neither code nor wording with the package: no body frames, no projection, no
moments about joint origins, no linearity in the parameters.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def body_properties(p):
    """Mass, centre and inertia about it, of parameters (m, m r_c, A, B, C, D, E, F)."""
    m, h, (A, B, C, D, E, F) = p[0], np.asarray(p[1:4]), p[4:]
    c = h / m
    about_origin = np.array([[A, -F, -E], [-F, B, -D], [-E, -D, C]])
    return m, c, about_origin - m * (c @ c * np.eye(3) - np.outer(c, c))


def inverse_dynamics(tree, parameters, q, qd, qdd):
    """Generalized forces of one sample; bodies without mass (None) are skipped."""
    n = len(tree.parent)
    R, o, w, wd, a, z = ([None] * n for _ in range(6))
    force, moment = (
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )  # of the subtree, about the world's origin
    for i, k in enumerate(tree.parent):
        Rp, op, wp, wdp, ap = (
            (np.eye(3), *np.zeros((4, 3))) if k < 0 else (R[k], o[k], w[k], wd[k], a[k])
        )
        turn = Rotation.from_rotvec(tree.axis[i] * q[i]).as_matrix()
        R[i] = Rp @ tree.rotation[i] @ (turn if tree.revolute[i] else np.eye(3))
        z[i] = R[i] @ tree.axis[i]
        arm = Rp @ tree.offset[i]
        w[i], wd[i] = wp.copy(), wdp.copy()
        if tree.revolute[i]:
            w[i] += z[i] * qd[i]
            wd[i] += z[i] * qdd[i] + np.cross(wp, z[i]) * qd[i]
        else:
            arm = arm + z[i] * q[i]
        o[i] = op + arm
        a[i] = ap + np.cross(wdp, arm) + np.cross(wp, np.cross(wp, arm))
        if not tree.revolute[i]:
            a[i] = a[i] + z[i] * qdd[i] + 2 * np.cross(wp, z[i]) * qd[i]
        if parameters[i] is None:
            continue
        m, c, Jc = body_properties(parameters[i])
        c, Jc = R[i] @ c, R[i] @ Jc @ R[i].T
        ac = a[i] + np.cross(wd[i], c) + np.cross(w[i], np.cross(w[i], c))
        force[i] = m * (ac - tree.gravity)
        moment[i] = (
            Jc @ wd[i] + np.cross(w[i], Jc @ w[i]) + np.cross(o[i] + c, force[i])
        )
    for i in reversed(range(n)):
        if tree.parent[i] >= 0:
            force[tree.parent[i]] += force[i]
            moment[tree.parent[i]] += moment[i]
    return np.array(
        [
            z[i] @ (moment[i] - np.cross(o[i], force[i]))
            if tree.revolute[i]
            else z[i] @ force[i]
            for i in range(n)
        ]
    )
