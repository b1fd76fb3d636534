"""Rollouts: identification from commands and encoders, so that a simulation moves like the robot."""

from .contact import Contact as Contact
from .identify import identify_rollout as identify_rollout
from .result import (
    Combination as Combination,
    RolloutErrors as RolloutErrors,
    ServoFit as ServoFit,
)
from .servo import PARAMETERS as PARAMETERS, Bodies as Bodies
