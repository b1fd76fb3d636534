"""Figures of one method on one robot of servo joints: errors of its simulations."""

import numpy as np

HORIZONS = (0.1, 0.5)
"""Durations of simulations that start at recorded positions [s]."""
STARTS = 40
"""Number of these simulations in each part of a log."""
LENGTH = 1.1
"""Length of these simulations [s]."""


def parts_of(logs):
    """Return parts of logs without gaps, as recordings of their own."""
    import jaxid as jid

    parts = []
    for log in logs:
        for start, stop in log.segments:
            parts.append(
                jid.Recording.of(
                    np.asarray(log.angles)[start:stop],
                    np.asarray(log.forces)[start:stop],
                    sample_time=log.sample_time,
                    name=f"part {len(parts)}",
                )
            )
    return parts


def free_errors(result, logs, joints):
    """Return the RMS error of each joint over whole logs, free-running [rad]."""
    parts = parts_of(logs)
    errors = [
        simulated - np.asarray(part.angles)
        for simulated, part in zip(result.positions(parts), parts, strict=True)
    ]
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))[list(joints)]


def window_errors(result, logs, joints):
    """Return the RMS error after each horizon [rad], all joints together."""
    import jaxid as jid

    windows = []
    for part in parts_of(logs):
        size = round(LENGTH / part.sample_time) + 1
        last = len(part.angles) - size
        for start in np.linspace(0, last, STARTS).astype(int):
            windows.append(
                jid.Recording.of(
                    np.asarray(part.angles)[start : start + size],
                    np.asarray(part.forces)[start : start + size],
                    sample_time=part.sample_time,
                    name=f"window {len(windows)}",
                )
            )
    paths = np.stack(result.positions(windows))
    measured = np.stack([np.asarray(x.angles) for x in windows])
    errors = (paths - measured)[..., list(joints)]
    rows = [round(x / windows[0].sample_time) for x in HORIZONS]
    return [float(np.sqrt(np.mean(errors[:, row] ** 2))) for row in rows]


def figures(arm, method):
    """Return all figures by name."""
    result = method(arm)
    errors = free_errors(result, arm.unseen_logs, arm.joints)
    return {
        "error": float(np.sqrt(np.mean(errors**2))),
        "worst": float(errors.max()),
        "joints": errors.tolist(),
        "simulations": window_errors(result, arm.unseen_logs, arm.joints),
    }
