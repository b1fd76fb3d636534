"""Instrumental variables, as A. Janot identifies industrial robots."""

import numpy as np
from arm import Result

from methods.pinocchio_script import Columns, stacked


def instruments(arm):
    """Instruments from the motion that a strong low-pass filter leaves.

    Columns and instruments differ by noise alone, so that noise in the columns does not
    bias the estimate; base columns by QR.
    """
    import scipy.linalg
    from scipy.signal import butter, sosfiltfilt

    columns = Columns(arm.robot)
    rows, forces = stacked(arm, columns)
    smooth_parts = []
    for log in arm.signals():
        low_pass = butter(2, 0.5 * arm.band, fs=1 / log.sample_time, output="sos")
        motion = [sosfiltfilt(low_pass, x, axis=0)[::5] for x in log[:3]]
        smooth_parts.append(columns(*motion))
    size = rows.shape[2]
    weights = 1.0 / forces.std(axis=0)
    W = (rows * weights[:, None]).reshape(-1, size)
    Z = (np.concatenate(smooth_parts) * weights[:, None]).reshape(-1, size)
    scale = np.linalg.norm(W, axis=0)
    scale[scale == 0] = 1.0
    _, R, order = scipy.linalg.qr(W / scale, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    chosen = order[: int(np.sum(diagonal > 1e-5 * diagonal[0]))]
    products = Z[:, chosen].T @ W[:, chosen]
    right_side = Z[:, chosen].T @ (forces * weights).ravel()
    estimates = np.linalg.lstsq(products, right_side, rcond=1e-12)[0]
    return Result(lambda *motion: columns(*motion)[..., chosen] @ estimates)


KIND = "torques"
METHODS = {"instrumental variables": instruments}
