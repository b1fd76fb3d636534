"""Figures of one method on logs with torques: errors of torques and simulations."""

import numpy as np

HORIZONS = (0.1, 0.5)
"""Durations of simulations under measured torques [s]."""
STARTS = 40
"""Number of states from which simulations start."""
STEP = 0.002
"""Step of simulations [s]."""
MAX_SPEED = 1e3
"""Speed from which a simulation diverges [rad/s or m/s]."""
SPEED_STEP = 1e-3
"""Step of speeds for the change of friction with the speed [rad/s or m/s]."""
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


def slopes(function, x, step):
    """Return the derivatives of forces by each element of motion, by differences."""
    start = function(x)
    columns = []
    for joint in range(x.shape[1]):
        moved = x.copy()
        moved[:, joint] += step
        columns.append((function(moved) - start) / step)
    return np.stack(columns, axis=-1)


def mass_matrices(result, q, qd):
    """Return the mass matrix at some states."""
    return slopes(lambda qdd: result.forces(q, qd, qdd), np.zeros_like(q), 1.0)


def definite_share(result, logs):
    """Return the share of recorded poses with a positive definite mass matrix."""
    q = np.concatenate([log.q for log in logs])
    q = q[:: max(1, len(q) // POSES)]
    matrices = mass_matrices(result, q, np.zeros_like(q))
    symmetric = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return float(np.mean(np.linalg.eigvalsh(symmetric)[:, 0] > 0))


def next_speeds(result, q, qd, forces, duration):
    """Return the speeds after a short step under some forces.

    Dry friction is stiff, so that its change with the speed counts at the end of the
    step (linearly implicit Euler).
    """
    still = np.zeros_like(q)
    bias = result.forces(q, qd, still)
    damping = slopes(lambda x: result.forces(q, x, still), qd, SPEED_STEP)
    matrix = mass_matrices(result, q, qd) + duration * damping
    acceleration = np.linalg.solve(matrix, (forces - bias)[..., None])[..., 0]
    return qd + duration * acceleration


def simulation_errors(result, logs):
    """Return the RMS error of positions after each horizon of simulations [rad or m].

    Each begins at a recorded state and follows the recorded torques.
    """
    log = max(logs, key=lambda x: len(x.q))
    time = log.sample_time * np.arange(len(log.q))
    last = len(log.q) - int(HORIZONS[-1] / log.sample_time) - 2
    starts = np.linspace(0, last, STARTS).astype(int)
    q = log.q[starts].copy()
    qd = log.qd[starts].copy()
    ends = [round(x / STEP) for x in HORIZONS]
    errors = []
    for k in range(1, ends[-1] + 1):
        forces = at_times(time[starts] + (k - 0.5) * STEP, time, log.forces)
        # Forces that depend on the position count in the middle of the step.
        end_speeds = next_speeds(result, q + 0.5 * STEP * qd, qd, forces, STEP)
        q = q + 0.5 * STEP * (qd + end_speeds)
        qd = end_speeds
        if not np.all(np.abs(qd) < MAX_SPEED):
            break
        if k in ends:
            distances = q - at_times(time[starts] + k * STEP, time, log.q)
            errors.append(float(np.sqrt(np.mean(distances**2))))
    return errors + [np.inf] * (len(ends) - len(errors))


def at_times(times, samples, values):
    """Return recorded values [times, joints], interpolated between samples."""
    return np.stack([np.interp(times, samples, x) for x in values.T], axis=-1)


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


def figures(arm, method):
    """Return all figures by name."""
    result = method(arm)
    unseen = arm.signals(unseen=True)
    total, joints = torque_errors(result, unseen)
    return {
        "error": total,
        "worst": float(joints.max()),
        "joints": joints.tolist(),
        "simulations": simulation_errors(result, unseen),
        "definite": definite_share(result, unseen),
        "plausible": plausible_share(result.bodies),
    }
