"""Virtual robots: experiments whose truth is known, on our own physics or on MuJoCo."""

from jaxid.simulation.example import virtual_panda as virtual_panda
from jaxid.simulation.example import write_example as write_example
from jaxid.simulation.friction import AbstractDisturbance as AbstractDisturbance
from jaxid.simulation.friction import AbstractGearFriction as AbstractGearFriction
from jaxid.simulation.friction import CableForce as CableForce
from jaxid.simulation.friction import FrictionTemperature as FrictionTemperature
from jaxid.simulation.friction import LuGreFriction as LuGreFriction
from jaxid.simulation.friction import SmoothFriction as SmoothFriction
from jaxid.simulation.friction import TorqueRipple as TorqueRipple
from jaxid.simulation.mechanics import FlexibleGear as FlexibleGear
from jaxid.simulation.mechanics import RigidGear as RigidGear
from jaxid.simulation.mechanics import Servo as Servo
from jaxid.simulation.mujoco import MujocoRobot as MujocoRobot
from jaxid.simulation.tx90l import cad_tx90l_on_rail as cad_tx90l_on_rail
from jaxid.simulation.tx90l import virtual_tx90l_on_rail as virtual_tx90l_on_rail
from jaxid.simulation.virtual import Sensors as Sensors
from jaxid.simulation.virtual import Tracking as Tracking
from jaxid.simulation.virtual import VirtualRobot as VirtualRobot
from jaxid.simulation.virtual import random_bodies as random_bodies
