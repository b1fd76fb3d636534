"""Virtual robots: experiments whose truth is known."""

from .example import virtual_panda as virtual_panda, write_example as write_example
from .friction_and_ripple import (
    AbstractGearFriction as AbstractGearFriction,
    FrictionTemperature as FrictionTemperature,
    LuGreFriction as LuGreFriction,
    SmoothFriction as SmoothFriction,
    TorqueRipple as TorqueRipple,
)
from .mechanics import Servo as Servo
from .tx90l import virtual_tx90l_on_rail as virtual_tx90l_on_rail
from .virtual import (
    Sensors as Sensors,
    Tracking as Tracking,
    VirtualRobot as VirtualRobot,
    random_bodies as random_bodies,
)
