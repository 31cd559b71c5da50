"""Frozen measurement records, one class per kind, columnar inside.

A record class holds M measurements of one kind as arrays of length M; single numbers are taken
as M = 1 and broadcast against arrays. All quantities are SI and radians, times are float64
seconds since the mission's epoch. Whatever enters is checked here, at the door: a value that is
not finite, negative where it must not be, or absurd raises a `DataError` that names the
record, or the file, row and field it came from.
"""

from __future__ import annotations

from ubl_graph.measurements.acoustic import (
    MAX_RANGE,
    MAX_TRAVEL_TIME,
    SLANT_RANGE_SIGMA,
    STAMP_TOLERANCE,
    TRAVEL_TIME_SIGMA,
    OneWayRange,
    SlantRange,
    TwoWayRange,
)
from ubl_graph.measurements.motion import (
    ANGULAR_RATE_SIGMA,
    ATTITUDE_SIGMA,
    HEADING_SIGMA,
    VELOCITY_SIGMA,
    AngularRate,
    Attitude,
    Heading,
    Odometry,
    Velocity,
    odometry_covariance,
)
from ubl_graph.measurements.places import (
    DEPTH_SIGMA,
    MAX_DISTANCE,
    POSITION_SIGMA,
    Depth,
    PositionFix,
)

__all__ = [
    "ANGULAR_RATE_SIGMA",
    "ATTITUDE_SIGMA",
    "DEPTH_SIGMA",
    "HEADING_SIGMA",
    "MAX_DISTANCE",
    "MAX_RANGE",
    "MAX_TRAVEL_TIME",
    "POSITION_SIGMA",
    "SLANT_RANGE_SIGMA",
    "STAMP_TOLERANCE",
    "TRAVEL_TIME_SIGMA",
    "VELOCITY_SIGMA",
    "AngularRate",
    "Attitude",
    "Depth",
    "Heading",
    "Odometry",
    "OneWayRange",
    "PositionFix",
    "SlantRange",
    "TwoWayRange",
    "Velocity",
    "odometry_covariance",
]
