"""Capsules on a robot's bodies, obstacles of its world, and their clearances."""

from .capsule_fit import fit_capsules as fit_capsules
from .collision_model import CollisionModel as CollisionModel
from .shapes import (
    GROUND as GROUND,
    Box as Box,
    Capsule as Capsule,
    HalfSpace as HalfSpace,
)
