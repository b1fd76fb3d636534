"""FIGAROH: regressor, elimination of columns, QR and least squares of its tools."""

from types import SimpleNamespace

import numpy as np
from arm import Result

CONFIGURATION = {
    "has_friction": True,
    "has_actuator_inertia": True,
    "has_joint_offset": True,
}


def figaroh(arm):
    """The default identification of FIGAROH's documentation."""
    from figaroh.tools.qrdecomposition import QRDecomposer
    from figaroh.tools.regressor import build_regressor_basic
    from pinocchio_loop import Bodies, pinocchio_model

    joints = arm.robot.joints
    model = pinocchio_model(arm.robot, Bodies(joints))
    model.gravity.linear = np.asarray(arm.robot.gravity)
    robot = SimpleNamespace(model=model, data=model.createData())
    configuration = {**CONFIGURATION, "act_idxv": list(range(joints))}

    def columns(q, qd, qdd):
        W = build_regressor_basic(robot, q, qd, qdd, configuration)
        return np.swapaxes(W.reshape(joints, len(q), -1), 0, 1)

    logs = arm.signals()
    rows = np.concatenate([columns(*(x[::5] for x in log[:3])) for log in logs])
    forces = np.concatenate([log.forces[::5] for log in logs])
    W = np.swapaxes(rows, 0, 1).reshape(-1, rows.shape[2])
    visible = np.flatnonzero((W**2).sum(axis=0) >= 1e-6)
    decomposer = QRDecomposer(tolerance=1e-8)
    names = [f"p{k}" for k in visible]
    *_, estimates = decomposer.double_decomposition(
        forces.T.ravel(), W[:, visible], names
    )
    chosen = visible[decomposer.base_indices]
    return Result(lambda *motion: columns(*motion)[..., chosen] @ estimates)


KIND = "torques"
METHODS = {"FIGAROH": figaroh}
