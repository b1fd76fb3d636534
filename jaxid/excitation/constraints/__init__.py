"""Constraints of a motion: forces, end-effector, collisions."""

from .clearance import Clearance as Clearance
from .constraint import AbstractConstraint as AbstractConstraint, Finding as Finding
from .force_limits import ForceLimits as ForceLimits
from .loop_limits import LoopLimits as LoopLimits
from .tip_limits import TipLimits as TipLimits, tip_motion as tip_motion
