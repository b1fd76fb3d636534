"""Identification from rollouts: a simulation that moves like the robot."""

from .body_loads import Bodies as Bodies
from .determined_combinations import Combination as Combination
from .errors import RolloutErrors as RolloutErrors
from .identify import identify_rollout as identify_rollout
from .motion import ServoMotion as ServoMotion
from .result import ServoFit as ServoFit
from .servo import PARAMETERS as PARAMETERS
from .simulation import ServoSimulator as ServoSimulator
from .torque import (
    TorqueRolloutFit as TorqueRolloutFit,
    identify_torque_rollout as identify_torque_rollout,
)
