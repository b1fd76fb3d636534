"""Preview of a motion in MuJoCo's viewer: the shapes that were checked, not the robot's meshes."""

import time
import warnings

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.export.mujoco_model import mjcf_text, placement_attributes
from jaxid.io import import_extra
from jaxid.robot.collision import GROUND, Capsule, CollisionModel
from jaxid.robot.mjcf import exact_text, import_mujoco
from jaxid.robot.robot import Robot
from jaxid.robot.shapes import Box, HalfSpace
from jaxid.trajectory.trajectory import AbstractTrajectory

RATE = 60
"""Pictures per second."""
_BODY = (1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
"""Parameters of bodies that only move; their inertia does not matter."""


def preview_mjcf(robot: Robot, shapes: CollisionModel | None) -> str:
    """Return a robot as MJCF with its capsules and obstacles as shapes that touch nothing."""
    text = mjcf_text(robot, np.tile(_BODY, (robot.joints, 1)), {})
    root = etree.fromstring(text)
    etree.SubElement(
        etree.SubElement(root, "default"), "geom", contype="0", conaffinity="0"
    )
    world = root.find("worldbody")
    etree.SubElement(world, "light", pos="0 0 3")
    bodies = [root.find(f".//body[@name='{name}_body']") for name in robot.joint_names]
    for capsule in () if shapes is None else shapes.capsules:
        parent = world if capsule.body == GROUND else bodies[capsule.body]
        etree.SubElement(parent, "geom", rgba="0.3 0.6 0.9 1", **_capsule(capsule))
    for obstacle in () if shapes is None else shapes.obstacles:
        look = "0.9 0.6 0.3 0.5" if isinstance(obstacle, Box) else "0.8 0.8 0.8 1"
        etree.SubElement(world, "geom", rgba=look, **_obstacle(obstacle))
    return etree.tostring(root, encoding="unicode")


def _capsule(capsule: Capsule) -> dict[str, str]:
    ends = np.concatenate([capsule.start, capsule.end])
    if np.array_equal(capsule.start, capsule.end):
        shape = {"type": "sphere", "pos": exact_text(capsule.start)}
    else:
        shape = {"type": "capsule", "fromto": exact_text(ends)}
    return {"name": capsule.name, "size": exact_text(capsule.radius), **shape}


def _obstacle(obstacle: HalfSpace | Box) -> dict[str, str]:
    if isinstance(obstacle, Box):
        place = placement_attributes(obstacle.centre, obstacle.rotation)
        size = exact_text(obstacle.size / 2)
        return {"name": obstacle.name, "type": "box", "size": size, **place}
    normal = np.asarray(obstacle.normal)
    place = {"pos": exact_text(normal * obstacle.height), "zaxis": exact_text(normal)}
    return {"name": obstacle.name, "type": "plane", "size": "3 3 0.1", **place}


def positions(trajectory: AbstractTrajectory) -> Float[np.ndarray, "pictures joints"]:
    """Return the positions of all pictures [rad or m]."""
    return np.asarray(
        trajectory.motion(np.arange(0.0, float(trajectory.duration), 1 / RATE)).q
    )


def play(
    robot: Robot, shapes: CollisionModel | None, trajectory: AbstractTrajectory
) -> None:
    """Show a motion in MuJoCo's viewer, again and again, until its window is closed.

    Raises:
        InputError: If MuJoCo is not installed, or there is no display.
    """
    mujoco = import_mujoco()
    viewer, glfw = (
        import_extra(x, "mujoco", "a preview needs") for x in ("mujoco.viewer", "glfw")
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not glfw.init():
            raise InputError(
                "a preview needs a display, and none is there: see the page's figure."
            )
    model = mujoco.MjModel.from_xml_string(preview_mjcf(robot, shapes))
    data, rows = mujoco.MjData(model), positions(trajectory)
    at = [model.joint(name).qposadr[0] for name in robot.joint_names]
    with viewer.launch_passive(
        model, data, show_left_ui=False, show_right_ui=False
    ) as window:
        began = time.monotonic()
        while window.is_running():
            # It rests for a second before it begins again.
            now = (time.monotonic() - began) % (len(rows) / RATE + 1.0)
            data.qpos[at] = rows[min(int(now * RATE), len(rows) - 1)]
            mujoco.mj_kinematics(model, data)
            window.sync()
            time.sleep(1 / RATE)
