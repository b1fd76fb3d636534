"""The regressors of real robots, from their URDF files, against Pinocchio's."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trees

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import RigidBodies
from jaxid.robot.urdf import load_urdf, urdf_parameters

cmeel = pytest.importorskip("cmeel", reason="example-robot-data is not installed")
ROBOTS = (
    Path(next(iter(cmeel.__path__))).parent
    / "cmeel.prefix/share/example-robot-data/robots"
)
SAMPLES = 3

ARMS = [
    ("ur_description/urdf/ur5_robot.urdf", None, 6),
    ("ur_description/urdf/ur10_robot.urdf", None, 6),
    ("xarm_description/urdf/xarm7.urdf", None, 7),
    ("panda_description/urdf/panda.urdf", "panda_link8", 7),
    ("kinova_description/robots/kinova.urdf", None, 6),  # continuous joints
    ("z1_description/urdf/z1.urdf", None, 7),
    ("so_arm_description/urdf/so101.urdf", None, 6),
    ("talos_data/robots/talos_left_arm.urdf", None, 7),
    ("double_pendulum_description/urdf/double_pendulum_continuous.urdf", None, 2),
    ("finger_edu_description/robots/finger_edu.urdf", None, 3),
]
TREES = [
    (
        "tiago_description/robots/tiago_no_hand.urdf",
        None,
        12,
    ),  # wheels, prismatic torso
    ("solo_description/robots/solo.urdf", None, 8),  # four legs
    ("simple_humanoid_description/urdf/simple_humanoid.urdf", None, 29),
]


def _pinocchio(path: Path, names: tuple[str, ...]) -> tuple[pin.Model, list[int]]:
    """The same joints in Pinocchio (others locked), and where each of ours stands."""
    model = pin.buildModelFromUrdf(str(path))
    others = [j for j in range(1, model.njoints) if model.names[j] not in names]
    if others:
        model = pin.buildReducedModel(model, others, pin.neutral(model))
    return model, [model.idx_vs[model.getJointId(name)] for name in names]


def _configuration(model: pin.Model, q: np.ndarray) -> np.ndarray:
    """Joint angles as Pinocchio wants them: cosine and sine of a continuous joint."""
    out = np.zeros(model.nq)
    for j in range(1, model.njoints):
        x = q[model.idx_vs[j]]
        turns = model.nqs[j] == 2
        out[model.idx_qs[j] : model.idx_qs[j] + model.nqs[j]] = (
            [np.cos(x), np.sin(x)] if turns else x
        )
    return out


@pytest.mark.parametrize(("file", "tip", "joints"), ARMS + TREES)
def test_regressor_of_a_real_robot(file, tip, joints):
    path = ROBOTS / file
    robot = load_urdf(path, tip=tip)
    assert robot.joints == joints
    model, order = _pinocchio(path, robot.joint_names)
    q, qd, qdd = trees.random_motion(np.random.default_rng(joints), SAMPLES, joints)
    p = urdf_parameters(path, tip=tip)
    bodies = Model(robot, (RigidBodies(),))
    found = np.asarray(bodies.regressor(Motion(q, qd, qdd)))
    data = model.createData()
    regressors, forces = [], []
    for x, xd, xdd in zip(q, qd, qdd, strict=True):
        theirs = np.zeros((3, joints))
        theirs[:, order] = x, xd, xdd
        state = (_configuration(model, theirs[0]), theirs[1], theirs[2])
        columns = pin.computeJointTorqueRegressor(model, data, *state)
        columns = columns.reshape(joints, joints, 10)[order][:, order]
        columns = columns[:, :, trees.FROM_PINOCCHIO] * trees.SIGNS
        regressors.append(columns.reshape(joints, -1))
        forces.append(pin.rnea(model, data, *state)[order])
    assert trees.relative(found, np.array(regressors)) < 1e-12
    if tip is None:
        assert trees.relative(found @ p, np.array(forces)) < 1e-12
