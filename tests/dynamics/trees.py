"""Random kinematic trees and bodies, and the same trees in Pinocchio."""

from dataclasses import dataclass

import jax
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from jaxid.robot.robot import Robot

# Column of Pinocchio's regressor (m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) for each
# of (m, mx, my, mz, A, B, C, D, E, F). D, E, F are integrals, Pinocchio has the
# tensor's entries.
FROM_PINOCCHIO = [0, 1, 2, 3, 4, 6, 9, 8, 7, 5]
SIGNS = np.array([1, 1, 1, 1, 1, 1, 1, -1, -1, -1.0])


@dataclass(frozen=True)
class Tree:
    """Plain arrays: what a robot is, before any package has seen it."""

    parent: tuple[int, ...]
    revolute: tuple[bool, ...]
    axis: np.ndarray
    rotation: np.ndarray
    offset: np.ndarray
    gravity: np.ndarray

    @property
    def joints(self) -> int:
        return len(self.parent)

    def robot(self, **fields) -> Robot:
        return Robot(
            "tree",
            parent=self.parent,
            revolute=self.revolute,
            axis=self.axis,
            rotation=self.rotation,
            offset=self.offset,
            gravity=self.gravity,
            **fields,
        )

    def pinocchio(self, bodies: "list[Cloud] | None" = None) -> pin.Model:
        model = pin.Model()
        model.gravity.linear = self.gravity
        ids = []
        for i in range(self.joints):
            joint = pin.JointModelRevoluteUnaligned if self.revolute[i] else None
            joint = joint or pin.JointModelPrismaticUnaligned
            placement = pin.SE3(self.rotation[i], self.offset[i])
            parent = 0 if self.parent[i] < 0 else ids[self.parent[i]]
            ids.append(model.addJoint(parent, joint(self.axis[i]), placement, f"j{i}"))
            if bodies is not None:
                model.appendBodyToJoint(
                    ids[-1], bodies[i].pinocchio(), pin.SE3.Identity()
                )
        return model


def structure(
    rng: np.random.Generator, joints: int
) -> tuple[tuple[int, ...], tuple[bool, ...]]:
    """Parents and kinds of joints: two of three new bodies hang on the last one."""
    parent = [-1]
    for i in range(1, joints):
        parent.append(i - 1 if rng.random() < 0.65 else int(rng.integers(-1, i)))
    return tuple(parent), tuple(bool(x) for x in rng.random(joints) < 0.65)


def geometry(
    rng: np.random.Generator, joints: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arbitrary axes, attitudes and offsets."""
    axis = rng.normal(size=(joints, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    rotation = Rotation.from_rotvec(rng.normal(size=(joints, 3)) * 2.0).as_matrix()
    return axis, rotation, rng.normal(size=(joints, 3)) * 0.4


def random_tree(seed: int, joints: int) -> Tree:
    rng = np.random.default_rng(seed)
    return Tree(
        *structure(rng, joints), *geometry(rng, joints), rng.normal(size=3) * 9.81
    )


def bushy_tree(seed: int) -> Tree:
    """Three branches, two roots, depth first, which Pinocchio's mass matrix needs."""
    rng = np.random.default_rng(seed)
    parent, revolute = (
        (-1, 0, 1, 1, 0, 4, -1),
        (True, True, False, True, True, True, False),
    )
    return Tree(parent, revolute, *geometry(rng, 7), rng.normal(size=3) * 9.81)


def mixed_tree(seed: int = 0) -> Tree:
    """Two branches, a rail at the root, a slide in the middle: all recursive cases."""
    rng = np.random.default_rng(seed)
    parent, revolute = (-1, 0, 1, 1, 3), (False, True, True, False, True)
    return Tree(parent, revolute, *geometry(rng, 5), rng.normal(size=3) * 9.81)


@dataclass(frozen=True)
class Cloud:
    """A body of point masses, which is what the parameters are defined by."""

    masses: np.ndarray
    points: np.ndarray

    @property
    def mass(self) -> float:
        return float(self.masses.sum())

    @property
    def centre(self) -> np.ndarray:
        return self.masses @ self.points / self.mass

    @property
    def inertia(self) -> np.ndarray:
        """About the centre of mass."""
        r = self.points - self.centre
        return sum(
            m * (x @ x * np.eye(3) - np.outer(x, x))
            for m, x in zip(self.masses, r, strict=True)
        )

    @property
    def parameters(self) -> np.ndarray:
        """The integrals that define (m, m r_c, A, B, C, D, E, F)."""
        m, (x, y, z) = self.masses, self.points.T
        moments = [y * y + z * z, x * x + z * z, x * x + y * y, y * z, x * z, x * y]
        return np.array([self.mass, m @ x, m @ y, m @ z, *(m @ k for k in moments)])

    def pinocchio(self) -> pin.Inertia:
        return pin.Inertia(self.mass, self.centre, self.inertia)


def random_bodies(
    rng: np.random.Generator, joints: int, points: int = 6
) -> list[Cloud]:
    return [
        Cloud(rng.uniform(0.2, 2.0, points), rng.normal(size=(points, 3)) * 0.3 + 0.1)
        for _ in range(joints)
    ]


def standard_parameters(bodies: list[Cloud]) -> np.ndarray:
    """One row of ten for each body."""
    return np.array([b.parameters for b in bodies])


def random_motion(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Coordinates, velocities and accelerations, stacked."""
    return rng.uniform(-2.0, 2.0, (3, *shape)) * np.array([1.5, 1.0, 3.0]).reshape(
        3, *(1,) * len(shape)
    )


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference, relative to the largest entry."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def compiled(function):
    """Compiled without much optimisation, which takes longer than a few samples do.

    The lambda is there for bound methods: those of an immutable module are not
    hashable.
    """
    options = {
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
    }
    return jax.jit(lambda *args: function(*args), compiler_options=options)
