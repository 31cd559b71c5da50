"""How far a fix, or a position that was set, is from a pose that was estimated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Setup, Start
from ubl_graph.online.buffer import Entry
from ubl_graph.online.gate import TURN_RATE
from ubl_graph.online.state import Moment
from ubl_graph.pose_trajectory import mariners_angles, mariners_slopes

#: A heading known worse than this is not known, rad.
KNOWN_HEADING = 0.5


def place_of(start: Start) -> tuple[FloatArray, FloatArray]:
    """A position that was set, (2,) or (3,), m, and its covariance."""
    known = [start.east, start.north] + ([] if start.up is None else [start.up])
    return np.array(known), start.sigma**2 * np.eye(len(known))


def pose_gap(entry: Entry, moment: Moment, setup: Setup) -> tuple[FloatArray, FloatArray]:
    """From an estimated pose to a fix or a position that was set.

    Parameters
    ----------
    entry : Entry
        The fix.
    moment : Moment
        Of a vehicle whose nodes are poses, at the fix' time.
    setup : Setup
        For the antenna's lever arm, and whether the vehicle moves in a plane.

    Returns
    -------
    array, shape (d,)
        East, north and perhaps up, m; last the heading, rad, where one was set.
    array, shape (d, d)
        Its covariance.
    """
    rotation, pose = moment.rotation, moment.pose_covariance
    assert rotation is not None
    assert pose is not None
    start = entry.record if isinstance(entry.record, Start) else None
    arm = np.zeros(3)
    if start is not None:
        place, covariance = place_of(start)
    else:
        place, covariance = entry.values[1][0], entry.values[2][0]
        arm = rotation @ setup.vehicle.antenna.body
    d = 2 if setup.options.node == "pose2" else len(place)
    # A turn t about the world's axes moves the antenna by t x arm.
    swing = np.cross(np.eye(3), arm).T
    slopes = [np.concatenate([np.eye(3), swing], axis=1)[:d]]
    gap, noise = place[:d] - (moment.mean[:3] + arm)[:d], np.diag(np.zeros(d + 1))
    noise[:d, :d] = covariance[:d, :d]
    if start is None or start.heading is None:
        slope = slopes[0]
        return gap, noise[:d, :d] + slope @ pose @ slope.T
    heading = float(mariners_angles(rotation[None])[0, 0])
    slopes.append(np.concatenate([np.zeros(3), mariners_slopes(rotation[None])[0, 0]])[None])
    noise[d, d] = start.heading_sigma**2
    slope = np.concatenate(slopes)
    off = math.remainder(start.heading - heading, 2.0 * math.pi)
    return np.append(gap, off), noise + slope @ pose @ slope.T


def with_heading(start: Start, moment: Moment, dt: float) -> Start:
    """A position with the heading that goes with it, a time dt (s) after a moment.

    It is left out where it says nothing any more.
    """
    rotation, pose = moment.rotation, moment.pose_covariance
    assert rotation is not None
    assert pose is not None
    slope = mariners_slopes(rotation[None])[0, 0]
    sigma = math.hypot(math.sqrt(float(slope @ pose[3:, 3:] @ slope)), TURN_RATE * abs(dt))
    if not 0.0 < sigma < KNOWN_HEADING:
        return start
    heading = float(mariners_angles(rotation[None])[0, 0])
    return replace(start, heading=heading, heading_sigma=sigma)
