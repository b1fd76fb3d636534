"""Figures of one method on one set: errors of torques and of simulations, bodies."""

import numpy as np

HORIZONS = (0.1, 0.5)
"""Durations of simulations under measured torques [s]."""
STARTS = 40
"""Number of states from which simulations start."""
POSES = 200
"""Number of recorded poses in which the mass matrix is looked at."""
MAX_SAMPLES = 20_000
"""Samples of a log that are judged; longer logs are thinned out."""


def torque_errors(result, logs):
    """Return the RMS error over the RMS torque: of all joints, and of each."""
    errors = []
    forces = []
    for log in logs:
        step = max(1, len(log.q) // MAX_SAMPLES)
        part = [x[::step] for x in log[:4]]
        errors.append(part[3] - result.forces(*part[:3]))
        forces.append(part[3])
    squares = np.sum(np.concatenate(errors) ** 2, axis=0)
    force_squares = np.sum(np.concatenate(forces) ** 2, axis=0)
    total = float(np.sqrt(squares.sum() / force_squares.sum()))
    return total, np.sqrt(squares / force_squares)


def mass_matrices(result, q):
    """Return the mass matrix at some poses, from differences of forces at rest."""
    zeros = np.zeros_like(q)
    rest = result.forces(q, zeros, zeros)
    columns = []
    for joint in range(q.shape[1]):
        unit = zeros.copy()
        unit[:, joint] = 1.0
        columns.append(result.forces(q, zeros, unit) - rest)
    return np.stack(columns, axis=-1)


def definite_share(result, logs):
    """Return the share of recorded poses with a positive definite mass matrix."""
    q = np.concatenate([log.q for log in logs])
    q = q[:: max(1, len(q) // POSES)]
    matrices = mass_matrices(result, q)
    symmetric = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return float(np.mean(np.linalg.eigvalsh(symmetric)[:, 0] > 0))


def accelerations(result, q, qd, forces):
    """Return the accelerations under some forces."""
    bias = result.forces(q, qd, np.zeros_like(q))
    return np.linalg.solve(mass_matrices(result, q), (forces - bias)[..., None])[..., 0]


def simulation_errors(result, logs, horizon):
    """Return the RMS error of positions at the end of simulations [rad or m].

    Each begins at a recorded state and follows the recorded torques (midpoint rule).
    """
    log = max(logs, key=lambda x: len(x.q))
    step = log.sample_time
    stride = max(1, round(0.002 / step))
    count = int(horizon / (stride * step))
    last = len(log.q) - count * stride - 1
    starts = np.linspace(0, last, STARTS).astype(int)
    q = log.q[starts].copy()
    qd = log.qd[starts].copy()
    duration = stride * step
    for k in range(count):
        now = starts + k * stride
        forces = 0.5 * (log.forces[now] + log.forces[now + stride])
        start_acceleration = accelerations(result, q, qd, log.forces[now])
        middle_q = q + 0.5 * duration * qd
        middle_qd = qd + 0.5 * duration * start_acceleration
        acceleration = accelerations(result, middle_q, middle_qd, forces)
        q = q + duration * middle_qd
        qd = qd + duration * acceleration
    errors = q - log.q[starts + count * stride]
    rms = float(np.sqrt(np.mean(errors**2)))
    return rms if np.isfinite(rms) else np.inf


def plausible_share(bodies):
    """Return the share of bodies that can exist; None if the method gives none."""
    if bodies is None:
        return None
    shares = []
    for m, x, y, z, A, B, C, D, E, F in np.asarray(bodies):
        inertia = np.array([[A, -F, -E], [-F, B, -D], [-E, -D, C]])
        moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        pseudo_inertia = np.block(
            [[moments, np.array([[x], [y], [z]])], [np.array([[x, y, z, m]])]]
        )
        size = np.abs(np.diag(pseudo_inertia)).max()
        shares.append(np.linalg.eigvalsh(pseudo_inertia)[0] >= -1e-9 * size)
    return float(np.mean(shares))
