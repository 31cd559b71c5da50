"""What an online fleet gives: estimates of vehicles and targets, and smoothed poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.online.fleet_moments import PoseMoment
from ubl_graph.online.health import Status
from ubl_graph.pose_trajectory import mariners_angles, mariners_slopes


@dataclass(frozen=True, eq=False)
class FleetEstimate:
    """Where a vehicle is.

    Attributes
    ----------
    t : float
        s; increases from output to output of a vehicle.
    position : array, shape (3,), or None
        East, north, up, m. None while there is none.
    covariance : array, shape (3, 3), or None
        m^2; zero in the up of a vehicle that moves in a plane.
    heading, heading_sigma : float or None
        Clockwise from true north (0 to 2 pi), and its standard deviation, rad.
    velocity : array, shape (3,), or None
        East, north, up, m/s, as the odometry at `t` tells it.
    status : str
        initialising, ok, coasting, degraded, ambiguous, lost or rebuilt.
    reasons : tuple of str
        Why the status is not ok.
    rotation : array, shape (3, 3), or None
        `world_R_body`, body forward-left-up to east-north-up.
    pose_covariance : array, shape (6, 6), or None
        East, north, up (m), then the rotation about east, north and up (rad).
    """

    t: float
    position: FloatArray | None
    covariance: FloatArray | None
    heading: float | None
    heading_sigma: float | None
    velocity: FloatArray | None
    status: Status
    reasons: tuple[str, ...] = ()
    rotation: FloatArray | None = None
    pose_covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class SmoothedPose:
    """A vehicle's pose with all that came within the lag.

    Attributes
    ----------
    t : float
        s.
    position : array, shape (3,)
        East, north, up, m.
    covariance : array, shape (3, 3)
        m^2.
    heading, heading_sigma : float
        Clockwise from true north (0 to 2 pi), and its standard deviation, rad.
    """

    t: float
    position: FloatArray
    covariance: FloatArray
    heading: float
    heading_sigma: float

    @staticmethod
    def of(moment: PoseMoment) -> SmoothedPose:
        """What is said of a moment."""
        heading, sigma = heading_of(moment)
        return SmoothedPose(moment.t, moment.position, moment.covariance[:3, :3], heading, sigma)


@dataclass(frozen=True, eq=False)
class TargetFix:
    """Where a target is.

    Attributes
    ----------
    name : str
        The target's.
    t : float
        s.
    position : array, shape (3,), or None
        East, north, up, m. None while there is none; where it is ambiguous, the better place.
    covariance : array, shape (3, 3), or None
        m^2.
    velocity : array, shape (3,), or None
        m/s; zero for one at rest.
    velocity_covariance : array, shape (3, 3), or None
        m^2/s^2.
    status : str
        initialising, ok, ambiguous or lost.
    reason : str
        Why the status is not ok.
    rival : array, shape (3,), or None
        The other place, where it is ambiguous.
    """

    name: str
    t: float
    position: FloatArray | None
    covariance: FloatArray | None
    velocity: FloatArray | None
    velocity_covariance: FloatArray | None
    status: Status
    reason: str = ""
    rival: FloatArray | None = None


def heading_of(moment: PoseMoment) -> tuple[float, float]:
    """Heading and its standard deviation, rad."""
    rotation = moment.rotation[None]
    slope = mariners_slopes(rotation)[0, 0]
    variance = float(slope @ moment.covariance[3:, 3:] @ slope)
    return float(mariners_angles(rotation)[0, 0]), float(np.sqrt(max(variance, 0.0)))
