"""Check of a designed motion against floor and self-collision, where its design had no part."""

from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import Float, double_precision
from jaxid.errors import InputError
from jaxid.result_table import Remark, Status
from jaxid.robot.collision import CollisionModel, fit_capsules
from jaxid.robot.forward_and_inverse_kinematics import placements
from jaxid.robot.robot import Robot
from jaxid.robot.shapes import HalfSpace
from jaxid.trajectory.trajectory import AbstractTrajectory

from .experiment import Experiment

INSTANTS = 2000
"""Instants of a motion that are checked."""
FLOOR = "the floor"


class Nearest(NamedTuple):
    """The smallest distance of two shapes along a motion [m], and its time [s]."""

    names: str
    distance: float
    time: float

    def __str__(self) -> str:
        size = 100 * abs(self.distance)
        how = f"overlap by {size:.1f} cm" if self.distance < 0 else f"keep {size:.1f} cm"
        return f"{self.names} {how} at {self.time:.2f} s"


def collision_remarks(experiment: Experiment, played: AbstractTrajectory) -> list[Remark]:
    """Return what a motion does to floor and robot, or what could not be checked.

    Without a table `[collision]`, capsules around the collision geometry of the URDF file are
    checked against each other and against a floor at the origin of the ground. Shapes that overlap
    with all joints at zero, or as near to it as their ranges allow, are left out.
    """
    if experiment.clearance is not None:
        if experiment.clearance.model.obstacles:
            return []
        text = "no floor and no obstacle was checked: give `ground` in `[collision]`"
        return [Remark(text, Status.DOUBTFUL)]
    robot, time = experiment.robot, np.linspace(0.0, float(played.duration), INSTANTS)
    low, high = (np.asarray(getattr(robot.limits, f"position_{x}")) for x in ("min", "max"))
    cure, remarks, by = "`fit = true` and `ground = 0.0`", [], "capsules around its geometry"
    with double_precision():
        poses = np.vstack([np.clip(np.zeros(robot.joints), low, high), played.motion(time).q])
        try:
            shapes = _fitted(experiment)
            names, gaps = shapes.pair_names, np.asarray(shapes.clearance(robot, poses))
        except (ImportError, OSError, InputError) as error:
            cure, by = "`capsules` and `ground = 0.0`", "its joints alone"
            names, gaps = (f"the lowest joint and {FLOOR}",), _lowest(robot, poses)
            why = str(error).rstrip(".")
            text = f"self-collision was not checked ({why}): give {cure} in a table `[collision]`"
            remarks.append(Remark(text, Status.BAD))
    gravity, floors = np.asarray(robot.gravity), [name.endswith(FLOOR) for name in names]
    watched = gaps[0] >= 0
    if gravity[2] > -0.9 * np.linalg.norm(gravity) or not np.any(watched & floors):
        watched = watched & ~np.array(floors)
        text = "no floor was checked: the robot does not stand upright on the origin of the ground"
        remarks.append(Remark(f"{text}; give {cure} in `[collision]`", Status.DOUBTFUL))
    at = gaps[1:].argmin(axis=0)
    least = [
        Nearest(name, float(gaps[1 + k, i]), float(time[k]))
        for i, (name, k) in enumerate(zip(names, at, strict=True))
    ]
    found = sorted(
        (x for x, kept in zip(least, watched, strict=True) if kept), key=lambda x: x.distance
    )
    if hits := [str(x) for x in found if x.distance < 0]:
        more = f"; and {len(hits) - 3} more pairs" if len(hits) > 3 else ""
        text = f"this motion collides: {'; '.join(hits[:3])}{more}; {cure} in a table `[collision]`"
        remarks.append(Remark(f"{text} keep them apart", Status.BAD))
    elif found:
        text = (
            f"floor and self-collision were no part of the design; by {by}, {found[0]}, the least"
        )
        remarks.append(Remark(text, Status.NEUTRAL))
    return remarks


def _fitted(experiment: Experiment) -> CollisionModel:
    """Return the capsules of the robot's URDF file, with a floor."""
    source, robot = experiment.source, experiment.robot
    if source.urdf is None:
        raise InputError("only a URDF file has geometry")
    place = {**source.chain, **source.placement}
    capsules = fit_capsules(experiment.path.parent / source.urdf, **place)
    return CollisionModel(robot, capsules, [HalfSpace(FLOOR, height=0.0)])


def _lowest(robot: Robot, poses: np.ndarray) -> Float[np.ndarray, "poses 1"]:
    """Return the height of the lowest moving frame [m]; those that never move do not count."""

    def heights(q: jax.Array) -> jax.Array:
        rotations, origins = placements(robot, q)
        tip = origins[robot.tip_body] + rotations[robot.tip_body] @ robot.tip_offset
        return jax.numpy.append(origins[:, 2], tip[2])

    z = np.asarray(jax.vmap(heights)(jax.numpy.asarray(poses)))
    moving = np.ptp(z, axis=0) > 1e-9
    return z[:, moving].min(axis=1, initial=np.inf, keepdims=True)
