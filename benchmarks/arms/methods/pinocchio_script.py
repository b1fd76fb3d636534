"""Regressor of Pinocchio and NumPy, as in the scripts that papers publish."""

import numpy as np
from arm import Result

SPEED = 0.01
"""Speed of the transition of dry friction [rad/s]."""


class Columns:
    """Regressor of bodies, viscous and dry friction, rotors and offsets."""

    def __init__(self, robot):
        import pinocchio
        from pinocchio_loop import Bodies, pinocchio_model

        self.pinocchio = pinocchio
        self.model = pinocchio_model(robot, Bodies(robot.joints))
        self.model.gravity.linear = np.asarray(robot.gravity)
        self.data = self.model.createData()

    def __call__(self, q, qd, qdd):
        """Return the columns [samples, joints, parameters]."""
        rows = []
        for sample in zip(q, qd, qdd, strict=True):
            rows.append(
                self.pinocchio.computeJointTorqueRegressor(
                    self.model, self.data, *sample
                ).copy()
            )
        unit = np.eye(q.shape[1])
        friction = [x[:, :, None] * unit for x in (qd, np.tanh(qd / SPEED), qdd)]
        offsets = np.broadcast_to(unit, (len(q), *unit.shape))
        return np.concatenate([np.array(rows), *friction, offsets], axis=2)


def stacked(arm, columns, every=5):
    """Return the rows and forces of all logs, every fifth sample."""
    logs = arm.signals()
    parts = [columns(*(x[::every] for x in log[:3])) for log in logs]
    forces = [log.forces[::every] for log in logs]
    return np.concatenate(parts), np.concatenate(forces)


def script(arm):
    """QR for the base parameters, then least squares weighted joint by joint."""
    import scipy.linalg

    columns = Columns(arm.robot)
    rows, forces = stacked(arm, columns)
    size = rows.shape[2]
    W = rows.reshape(-1, size)
    scale = np.linalg.norm(W, axis=0)
    scale[scale == 0] = 1.0
    _, R, order = scipy.linalg.qr(W / scale, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    chosen = order[: int(np.sum(diagonal > 1e-7 * diagonal[0]))]
    estimates = np.linalg.lstsq(W[:, chosen], forces.ravel(), rcond=None)[0]
    residuals = forces - rows[..., chosen] @ estimates
    weights = 1.0 / residuals.std(axis=0)
    weighted_rows = rows[..., chosen] * weights[:, None]
    estimates = np.linalg.lstsq(
        weighted_rows.reshape(-1, len(chosen)), (forces * weights).ravel(), rcond=None
    )[0]
    return Result(lambda *motion: columns(*motion)[..., chosen] @ estimates)


KIND = "torques"
METHODS = {"NumPy and Pinocchio": script}
