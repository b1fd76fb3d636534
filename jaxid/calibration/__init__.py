"""Kinematic calibration: the geometry of a robot from poses in several sessions."""

from .adjustment import Weights as Weights, adjust as adjust
from .calibrate import rough_bodies as rough_bodies
from .error_derivatives import corrected_robot as corrected_robot
from .geometry_fit import GeometryChange as GeometryChange, GeometryFit as GeometryFit
from .observations import (
    OBSERVATIONS as OBSERVATIONS,
    AbstractObservation as AbstractObservation,
    KnownDistance as KnownDistance,
    MeasuredPose as MeasuredPose,
    MeasuredPosition as MeasuredPosition,
    PlaneContact as PlaneContact,
    PointContact as PointContact,
    SocketDistance as SocketDistance,
)
from .pose_proposals import propose_sessions as propose_sessions
