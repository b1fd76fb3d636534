"""The library of robots, followers, and parameters that files of robots claim."""

from .follower_joints import Follower as Follower
from .library import (
    iiwa14 as iiwa14,
    kr300 as kr300,
    panda as panda,
    planar_arm as planar_arm,
    tx40 as tx40,
    tx90l_on_rail as tx90l_on_rail,
    tx90l_on_rail_collision as tx90l_on_rail_collision,
    ur10 as ur10,
    ur10e as ur10e,
)
from .urdf import urdf_parameters as urdf_parameters
