"""The Projection Equation as Sec. 2 of the paper words it, for one sample.

Positions are written down; velocities are their derivatives by time, Jacobians are
derivatives of velocities by joint velocities, momenta are differentiated by time.
Nothing is derived by hand, and only the centre-of-mass form is used for the forces; the
print's Jacobian by q (Eqs. 5, 7) is by qd.
"""

import jax
import jax.numpy as jnp
import numpy as np


def cross(a):
    """The matrix of Eq. 3."""
    return jnp.cross(np.eye(3), jnp.broadcast_to(a, (3, 3)))


def frames(tree, q):
    """Attitude and origin of every body on the ground."""
    out = []
    for i, k in enumerate(tree.parent):
        K = np.cross(np.eye(3), tree.axis[i])
        turned = (
            np.eye(3) + jnp.sin(q[i]) * K + 2.0 * jnp.sin(0.5 * q[i]) ** 2 * (K @ K)
        )
        R = tree.rotation[i] @ (turned if tree.revolute[i] else np.eye(3))
        r = (
            tree.offset[i]
            + (0.0 if tree.revolute[i] else 1.0) * (R @ tree.axis[i]) * q[i]
        )
        if k >= 0:
            R, r = out[k][0] @ R, out[k][1] + out[k][0] @ r
        out.append((R, r))
    return out


def origin_velocities(tree, q, qd):
    """v_o and w_o of every body, in its own frame: one row of six for each."""
    now, rate = jax.jvp(lambda x: frames(tree, x), (q,), (qd,))
    rows = []
    for (R, _), (Rd, rd) in zip(now, rate, strict=True):
        S = R.T @ Rd
        rows.append(jnp.concatenate([R.T @ rd, jnp.stack([S[2, 1], S[0, 2], S[1, 0]])]))
    return jnp.stack(rows)


def shift(c):
    """The matrix of Eqs. 6 and 7 that goes from the origin to the centre of mass."""
    return jnp.block([[np.eye(3), cross(c).T], [np.zeros((3, 3)), np.eye(3)]])


def centre_velocities(tree, centres, q, qd):
    """v_c and w_c of every body (Eq. 6)."""
    rows = origin_velocities(tree, q, qd)
    return jnp.stack([shift(c) @ x for c, x in zip(centres, rows, strict=True)])


def along(function, q, qd, qdd):
    """A function of (q, qd) and its derivative by time along the motion."""
    return jax.jvp(function, (q, qd), (qd, qdd))


def momentum_form(tree, masses, centres, inertias, q, qd, qdd):
    """Q of Eq. 1, with the momenta of Eq. 2 differentiated by time."""

    def momenta(x, xd):
        rows = centre_velocities(tree, centres, x, xd)
        p = jnp.stack([m * row[:3] for m, row in zip(masses, rows, strict=True)])
        L = jnp.stack([J @ row[3:] for J, row in zip(inertias, rows, strict=True)])
        return p, L

    (p, L), (pd, Ld) = along(momenta, q, qd, qdd)
    F = jax.jacfwd(lambda xd: centre_velocities(tree, centres, q, xd))(qd)
    w = centre_velocities(tree, centres, q, qd)[:, 3:]
    total = jnp.zeros(tree.joints)
    for i, (R, _) in enumerate(frames(tree, q)):
        weight = R.T @ (masses[i] * tree.gravity)
        force = pd[i] + cross(w[i]) @ p[i] - weight
        total = total + F[i].T @ jnp.concatenate([force, Ld[i] + cross(w[i]) @ L[i]])
    return total


def matrix_form(tree, masses, centres, inertias, q, qd, qdd):
    """Q of Eq. 4, with F_c from F_o by Eq. 7."""
    rows, rates = along(
        lambda x, xd: centre_velocities(tree, centres, x, xd), q, qd, qdd
    )
    F_o = jax.jacfwd(lambda xd: origin_velocities(tree, q, xd))(qd)
    zero = np.zeros((3, 3))
    total = jnp.zeros(tree.joints)
    for i, (R, _) in enumerate(frames(tree, q)):
        m, J, W = masses[i], inertias[i], cross(rows[i, 3:])
        inertia = jnp.block([[m * np.eye(3), zero], [zero, J]])
        gyration = jnp.block([[W * m, zero], [zero, W @ J]])
        impressed = jnp.concatenate([R.T @ (m * tree.gravity), np.zeros(3)])
        wrench = inertia @ rates[i] + gyration @ rows[i] - impressed
        total = total + (shift(centres[i]) @ F_o[i]).T @ wrench
    return total


def _inertia_columns(w):
    """[Omega | -hat Omega] of Eq. 9, by the tensor's definition, unit by unit."""
    tensors = np.zeros((6, 3, 3))
    for k in range(3):
        tensors[k, k, k] = 1.0
    for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1))):
        tensors[3 + k, i, j] = tensors[3 + k, j, i] = -1.0
    return jnp.stack([J @ w for J in tensors], axis=1)


def regressor(tree, q, qd, qdd):
    """[Theta_1 ... Theta_n] of Eqs. 10 and 11, by the three matrices of Eq. 10."""
    rows, rates = along(lambda x, xd: origin_velocities(tree, x, xd), q, qd, qdd)
    F_o = jax.jacfwd(lambda xd: origin_velocities(tree, q, xd))(qd)
    o1, o3, o6 = np.zeros((3, 1)), np.zeros((3, 3)), np.zeros((3, 6))
    columns = []
    for i, (R, _) in enumerate(frames(tree, q)):
        v, w, vd, wd, g = (
            rows[i, :3],
            rows[i, 3:],
            rates[i, :3],
            rates[i, 3:],
            R.T @ tree.gravity,
        )
        W = cross(w)
        inertial = jnp.block(
            [[vd[:, None], cross(wd), o6], [o1, -cross(vd), _inertia_columns(wd)]]
        )
        gyroscopic = jnp.block(
            [
                [(W @ v)[:, None], W @ W, o6],
                [o1, -cross(W @ v), W @ _inertia_columns(w)],
            ]
        )
        weight = jnp.block([[g[:, None], o3, o6], [o1, -cross(g), o6]])
        columns.append(F_o[i].T @ (inertial + gyroscopic - weight))
    return jnp.concatenate(columns, axis=1)
