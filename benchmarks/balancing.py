"""A humanoid that balances in MuJoCo: it shifts its weight and steps in place.

The drives follow whole-body inverse dynamics: the accelerations of all joints and the
forces under the feet that come closest to what is wanted of the centre of mass, the
trunk, the lifted foot and the other joints, while the feet on the ground rest. They use
the mass matrix of MuJoCo and the true state, as a good state estimator would tell it.
"""

from typing import Any

import mujoco
import numpy as np

CONTROL_STEPS = 2  # steps of the simulation for each torque
LANDED = 2e-3  # height of a foot that stands, above its first one [m]
CYCLE = 20.0  # both feet are lifted once [s]


def rise(t: float, start: float, stop: float) -> float:
    """Return 0 before a time, 1 after another, and a smooth path between them."""
    x = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return float(x**3 * (10 - 15 * x + 6 * x**2))


class Waves:
    """Sums of three sines for each of some channels, and their derivatives."""

    def __init__(self, rng: Any, channels: int, low: float, high: float):
        self.rate = 2 * np.pi * rng.uniform(low, high, (3, channels))
        self.phase = rng.uniform(0, 6.3, (3, channels))

    def __call__(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return values about one, rates and accelerations."""
        angle = self.rate * t + self.phase
        return (
            np.sin(angle).sum(0) / 1.7,
            (self.rate * np.cos(angle)).sum(0) / 1.7,
            (-(self.rate**2) * np.sin(angle)).sum(0) / 1.7,
        )


class Balance:
    """Controller of a humanoid on two flat feet."""

    def __init__(self, m: Any, d: Any, feet: list[int], seed: int):
        rng = np.random.default_rng(seed)
        self.m, self.d, self.feet = m, d, feet
        self.stand = d.qpos[7:].copy()
        self.legs = [self._leg(geom) for geom in feet]
        self.start_feet = [d.geom_xpos[geom].copy() for geom in feet]
        self.start_attitudes = [d.geom_xmat[g].reshape(3, 3).copy() for g in feet]
        self.rest = [d.geom_xpos[geom, 2] for geom in feet]
        self.height = d.subtree_com[1, 2]
        self.sway = Waves(rng, 3, 0.2, 0.9)
        self.turn = Waves(rng, 3, 0.2, 1.0)
        self.swing = Waves(rng, m.nv - 6, 0.3, 0.9)
        self.kick = Waves(rng, 6, 0.4, 1.0)
        self.turn_size = np.array([0.05, 0.06, 0.08])
        self.sway_size = np.array([0.012, 0.02, 0.012])

    def _leg(self, geom: int) -> set[int]:
        """Return the coordinates that carry a foot."""
        body, coordinates = self.m.geom_bodyid[geom], set()
        while body > 1:
            coordinates.add(int(self.m.body_dofadr[body]))
            body = self.m.body_parentid[body]
        return coordinates

    def phase(self, t: float) -> tuple[int | None, float, float]:
        """Return the lifted foot, how far weight is shifted, how far it is lifted."""
        half, now = divmod(t % CYCLE, CYCLE / 2)
        shift = rise(now, 1.5, 3.5) - rise(now, 7.8, 9.6)
        lift = rise(now, 3.8, 4.8) - rise(now, 6.6, 7.6)
        lifted = int(half) if 3.8 < now < 7.6 else None
        return lifted, shift * (-1.0 if half else 1.0), lift

    def _centre(self, t: float, shift: float, calm: float):
        """Return where the centre of mass should be, and its acceleration."""
        left, right = (self.d.geom_xpos[g] for g in self.feet)
        middle = 0.5 * (left + right)
        # The first foot is lifted where the weight is on the second one.
        place = middle + 0.5 * abs(shift) * np.sign(shift) * (right - left)
        place[2] = self.height
        value, rate, acceleration = self.sway(t)
        size = calm * self.sway_size
        return place + size * value, size * rate, size * acceleration

    def torques(self, d: Any, t: float) -> np.ndarray:
        """Return the torques of all drives."""
        m = self.m
        mujoco.mj_forward(m, d)
        nv = m.nv
        lifted, shift, lift = self.phase(t)
        calm = min(1.0, t / 2) * (1.0 - 0.75 * abs(shift))
        # A foot that has not landed yet, or that tips, is moved back to its place.
        heights = [
            d.geom_xpos[g, 2] - z for g, z in zip(self.feet, self.rest, strict=True)
        ]
        down = [k for k in range(2) if k != lifted and heights[k] < LANDED]
        on = down or [k for k in range(2) if k != lifted]
        M = np.zeros((nv, nv))
        mujoco.mj_fullM(m, d, M)
        v = d.qvel
        J, Jd = zip(*(self._foot(g) for g in self.feet), strict=True)
        size = nv + 6 * len(on)
        H, g = np.zeros((size, size)), np.zeros(size)

        def task(matrix, wanted, weight):
            """Add one to the squares that are minimised."""
            rows = np.zeros((len(matrix), size))
            rows[:, : matrix.shape[1]] = matrix
            H[:] += weight**2 * rows.T @ rows
            g[:] += weight**2 * rows.T @ wanted

        place, rate, acceleration = self._centre(t, shift, calm)
        Jc = np.zeros((3, nv))
        mujoco.mj_jacSubtreeCom(m, d, Jc, 1)
        error = place - d.subtree_com[1]
        task(Jc, acceleration + 60 * error + 14 * (rate - Jc @ v), 10.0)

        value, rate, acceleration = self.turn(t)
        R = d.xmat[1].reshape(3, 3)
        wanted = np.zeros(4)
        mujoco.mju_euler2Quat(wanted, calm * self.turn_size * value, "xyz")
        error = np.zeros(3)
        now = np.zeros(4)
        mujoco.mju_mat2Quat(now, R.ravel())
        mujoco.mju_subQuat(error, wanted, now)
        rate = calm * self.turn_size * rate
        Jr = np.zeros((3, nv))
        Jr[:, 3:6] = np.eye(3)
        task(
            Jr,
            calm * self.turn_size * acceleration + 60 * error + 14 * (rate - v[3:6]),
            5.0,
        )
        value, rate, acceleration = self.swing(t)
        size_of_swing = 0.2 * min(1.0, t / 2) * (1.0 - 0.6 * abs(shift))
        rows = np.eye(nv)[6:]
        wanted = size_of_swing * acceleration
        wanted = wanted + 40 * (self.stand + size_of_swing * value - d.qpos[7:])
        wanted = wanted + 12 * (size_of_swing * rate - v[6:])
        in_leg = np.array([k in self.legs[0] | self.legs[1] for k in range(6, nv)])
        task(rows[~in_leg], wanted[~in_leg], 1.0)
        calm_posture = 40 * (self.stand - d.qpos[7:]) - 12 * v[6:]
        task(rows[in_leg], calm_posture[in_leg], 0.05)
        for k in {0, 1} - {*on}:
            height = lift if k == lifted else 0.0
            task(J[k], self._kicked(t, k, height, J[k] @ v), 10.0)

        # Forces under the feet: small moments keep them within the soles.
        loads = 0.5 + 0.5 * shift * np.array([-1.0, 1.0])
        costs = np.array([1e-3, 1e-3, 3e-4, 0.05, 0.02, 0.03])
        small = np.concatenate([costs / max(loads[k], 0.02) for k in on])
        H[nv:, nv:] += np.diag(small**2)
        H[:nv, :nv] += 1e-6 * np.eye(nv)
        J_on = np.concatenate([J[k] for k in on])
        bias = d.qfrc_bias - d.qfrc_passive
        E = np.zeros((6 + len(J_on), size))
        E[:6, :nv], E[:6, nv:] = M[:6], -J_on[:, :6].T
        E[6:, :nv] = J_on
        rest = -np.concatenate([Jd[k] @ v for k in on]) - 20 * J_on @ v
        e = np.concatenate([-bias[:6], rest])
        saddle = np.block([[H, E.T], [E, -1e-9 * np.eye(len(E))]])
        x = np.linalg.solve(saddle, np.concatenate([g, e]))
        forces = M @ x[:nv] + bias - J_on.T @ x[nv:size]
        return forces[6:]

    def _foot(self, geom: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the Jacobian of a foot, and its derivative with time."""
        m, d = self.m, self.d
        J, Jd = np.zeros((6, m.nv)), np.zeros((6, m.nv))
        place, body = d.geom_xpos[geom], m.geom_bodyid[geom]
        mujoco.mj_jac(m, d, J[:3], J[3:], place, body)
        mujoco.mj_jacDot(m, d, Jd[:3], Jd[3:], place, body)
        return J, Jd

    def _kicked(self, t: float, foot: int, lift: float, now: np.ndarray) -> np.ndarray:
        """Return the acceleration that is wanted of a lifted foot."""
        d, geom = self.d, self.feet[foot]
        value, rate, acceleration = self.kick(t)
        size = lift * np.array([0.04, 0.02, 0.03, 0.1, 0.25, 0.25])
        place = self.start_feet[foot] + [0, 0, 0.1 * lift] + size[:3] * value[:3]
        R = d.geom_xmat[geom].reshape(3, 3)
        turned = np.zeros(4)
        mujoco.mju_euler2Quat(turned, size[3:] * value[3:], "xyz")
        wanted = np.zeros(9)
        mujoco.mju_quat2Mat(wanted, turned)
        wanted = wanted.reshape(3, 3) @ self.start_attitudes[foot]
        error = np.zeros(3)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (wanted @ R.T).ravel())
        mujoco.mju_quat2Vel(error, quaternion, 1.0)
        both = np.concatenate([place - d.geom_xpos[geom], error])
        return size * acceleration + 400 * both + 40 * (size * rate - now)
