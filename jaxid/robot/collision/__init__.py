"""Collision models: capsules on a robot's bodies, obstacles of its world, and their clearances."""

from jaxid.robot.collision.fitting import fit_capsules as fit_capsules
from jaxid.robot.collision.model import CollisionModel as CollisionModel
from jaxid.robot.collision.shapes import GROUND as GROUND
from jaxid.robot.collision.shapes import AbstractObstacle as AbstractObstacle
from jaxid.robot.collision.shapes import Box as Box
from jaxid.robot.collision.shapes import Capsule as Capsule
from jaxid.robot.collision.shapes import HalfSpace as HalfSpace
