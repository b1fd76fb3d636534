"""An arm that is not nominal, by Pinocchio, which shares no code with the package."""

import numpy as np
import pinocchio
import scipy

import jaxid as jid

MASSES = np.array([5.0, 0.6, 3.2, 3.6, 1.2, 1.7, 0.7])


def turned(vector):
    """Return the rotation by a small turn, as the package defines it."""
    quaternion = np.append(0.5 * np.asarray(vector), 1.0)
    return scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix()


class TrueArm:
    """A robot with other joint origins, whose joints deflect under gravity."""

    def __init__(self, robot, origins=None, compliances=None, masses=MASSES):
        origins = np.zeros((robot.bodies, 6)) if origins is None else origins
        joints = robot.joints
        self.compliances = np.zeros(joints) if compliances is None else compliances
        self.model = pinocchio.Model()
        self.model.gravity.linear = np.array(robot.gravity)
        for j in range(joints):
            R = robot.rotation[j] @ turned(origins[j, 3:])
            r = robot.offset[j] + robot.rotation[j] @ origins[j, :3]
            axis = robot.axis[j]
            kind = pinocchio.JointModelRevoluteUnaligned(axis)
            if not robot.revolute[j]:
                kind = pinocchio.JointModelPrismaticUnaligned(axis)
            parent = robot.parent[j] + 1
            placement = pinocchio.SE3(R, r)
            number = self.model.addJoint(parent, kind, placement, f"j{j}")
            end = robot.tip_offset if j + 1 == joints else robot.offset[j + 1]
            inertia = pinocchio.Inertia(masses[j], 0.5 * end, np.zeros((3, 3)))
            self.model.appendBodyToJoint(number, inertia, pinocchio.SE3.Identity())
        self.data = self.model.createData()
        self.tip = pinocchio.SE3(
            np.array(robot.tip_rotation), np.array(robot.tip_offset)
        )

    def deflection(self, q):
        """Return the deflection of the joints under gravity."""
        holding = pinocchio.computeGeneralizedGravity(self.model, self.data, q)
        return -self.compliances * holding

    def placement(self, q, tool=(0.0, 0.0, 0.0)):
        """Return attitude and position of a tool in one pose."""
        angles = np.asarray(q) + self.deflection(np.asarray(q))
        pinocchio.forwardKinematics(self.model, self.data, angles)
        tip = self.data.oMi[self.model.njoints - 1] * self.tip
        return tip.rotation, tip.translation + tip.rotation @ np.asarray(tool)

    def placements(self, q, tool=(0.0, 0.0, 0.0)):
        """Return attitudes and positions of a tool in many poses."""
        pairs = [self.placement(x, tool) for x in q]
        return tuple(np.stack(x) for x in zip(*pairs, strict=True))

    def touching(self, q, tool, points):
        """Return coordinates near `q` with which the tool is at some points."""
        solutions = []
        for x, point in zip(q, points, strict=True):
            for _ in range(30):
                error = self.placement(x, tool)[1] - point
                steps = 1e-6 * np.eye(len(x))
                moved = [self.placement(x + step, tool)[1] for step in steps]
                slopes = (np.transpose(moved) - error[:, None] - point[:, None]) / 1e-6
                change = np.linalg.pinv(slopes) @ error
                x = x - change * min(1.0, 0.3 / max(np.abs(change).max(), 1e-12))
                if np.abs(change).max() < 1e-9:
                    break
            solutions.append(x)
        return np.stack(solutions)


def true_origins(robot, seed=0, shift=1e-3, turn=3e-3):
    """Return random errors of the joints' origins."""
    scales = np.repeat([shift, turn], 3)
    return scales * np.random.default_rng(seed).normal(size=(robot.bodies, 6))


def random_poses(robot, count, seed=0):
    """Return coordinates in the middle of the joints' ranges."""
    low = np.maximum(robot.limits.position_min, -2.8)
    high = np.minimum(robot.limits.position_max, 2.8)
    share = np.random.default_rng(seed).uniform(0.15, 0.85, (count, robot.joints))
    return low + share * (high - low)


def ball_sessions(robot, arm, sessions=4, poses=24, noise=1e-4, seed=0):
    """Return observations of a ball that is put into two sockets 50 mm apart."""
    rng = np.random.default_rng(seed)
    tool = np.array([0.01, 0.02, 0.15])
    centre = np.array([0.0, -0.2, 0.0, -2.0, 0.0, 1.9, 0.6])
    observations = []
    for number in range(sessions):
        name = f"session {number}"
        middle = centre + rng.uniform(-0.5, 0.5, 7)
        first = arm.placement(middle, tool)[1]
        direction = rng.normal(size=3)
        second = first + 0.05 * direction / np.linalg.norm(direction)
        for place, socket in (("a", first), ("b", second)):
            q = middle + rng.uniform(-0.6, 0.6, (poses, 7))
            points = socket + noise * rng.normal(size=(poses, 3))
            touching = arm.touching(q, tool, points)
            observations.append(
                jid.calibration.PointContact(name, touching, place=place)
            )
        observations.append(
            jid.calibration.SocketDistance(
                name, place="a", other_place="b", distance=0.05
            )
        )
    return observations
