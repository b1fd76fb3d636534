"""The library of robots, followers, loops, and parameters that files claim."""

from .follower_joints import Follower as Follower, Loop as Loop
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
from .loop_assembly import with_loops as with_loops
from .urdf import urdf_parameters as urdf_parameters
