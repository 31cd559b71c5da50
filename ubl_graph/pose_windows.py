"""A dead-reckoned track and its ranges, and windows within which its shape holds.

What the search of start poses is given: plain arrays, whatever they were made from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray

#: A window ends where the odometry's own error has grown to so many range sigmas,
WINDOW_DRIFT = 3.0
#: or where it holds so many ranges; more windows than this are made fewer and longer.
WINDOW_RANGES, MOST_WINDOWS = 200, 64


@dataclass(frozen=True, eq=False)
class ReckonedTrack:
    """Composed odometry of a segment, in a frame of its own.

    Attributes
    ----------
    t : array, shape (N,)
        s, strictly increasing; N >= 2.
    position : array, shape (N, 3)
        m; the horizontal frame is turned and shifted arbitrarily, the third component is up.
    yaw : array, shape (N,)
        Counter-clockwise from the frame's first axis, rad.
    position_variance, heading_variance : array, shape (N,)
        What odometry has added by then to the variance of each horizontal component (m^2) and of
        the heading (rad^2); never falling.
    """

    t: FloatArray
    position: FloatArray
    yaw: FloatArray
    position_variance: FloatArray
    heading_variance: FloatArray


@dataclass(frozen=True, eq=False)
class TrackRanges:
    """Ranges, M rows.

    Attributes
    ----------
    t : array, shape (M,)
        s, within the track.
    antenna, beacon : array, shape (M, 3)
        Antenna in the track's frame and beacon in the world (east, north, up), m.
    distance, sigma : array, shape (M,)
        As measured, m.
    """

    t: FloatArray
    antenna: FloatArray
    beacon: FloatArray
    distance: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class Anchors:
    """What is known of the vehicle's pose at A times; an infinite sigma says "not known".

    Attributes
    ----------
    t : array, shape (A,)
        s, within the track.
    position, sigma : array, shape (A, 3)
        Of the vehicle's reference point: east, north, up, m.
    yaw, yaw_sigma : array, shape (A,)
        Counter-clockwise from east, rad.
    """

    t: FloatArray
    position: FloatArray
    sigma: FloatArray
    yaw: FloatArray
    yaw_sigma: FloatArray

    @classmethod
    def none(cls) -> Anchors:
        """No anchor at all."""
        rows, vectors = np.empty(0), np.empty((0, 3))
        return cls(rows, vectors, vectors, rows, rows)


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Standard deviations of what a track may have beside place and heading; 0 leaves it out.

    Attributes
    ----------
    turn_bias : float
        rad/s.
    scale : float
        Of the odometry, 1.
    range_scale : float
        Log of the factor on ranges, 1.
    up : float
        Of the track's ups, m; 0 where they are right (depth known, planar vehicle).
    """

    turn_bias: float = 0.0
    scale: float = 0.0
    range_scale: float = 0.0
    up: float = 0.0


def select(arrays: Any, rows: Any) -> Any:
    """Pick rows of every array of a dataclass."""
    return replace(arrays, **{n: getattr(arrays, n)[rows] for n in arrays.__dataclass_fields__})


def drift_between(
    track: ReckonedTrack, begin: IntArray, end: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Standard deviation of place (m) and heading (rad) that odometry gains between nodes."""
    steps = np.linalg.norm(np.diff(track.position, axis=0), axis=1)
    total = np.concatenate([[0.0], np.cumsum(steps)])
    way, place, heading = (
        a[end] - a[begin] for a in (total, track.position_variance, track.heading_variance)
    )
    # A heading that walks as the way goes on leaves sigma * way / sqrt(3) aside of it.
    return np.sqrt(place + heading * way**2 / 3.0), np.sqrt(heading)


def cut(track: ReckonedTrack, ranges: TrackRanges) -> IntArray:
    """Nodes at which windows begin and end: the first, the last, and as many between as needed."""
    sigma = float(np.median(ranges.sigma)) if len(ranges.t) else 1.0
    last = len(track.t) - 1
    seen = np.searchsorted(ranges.t, track.t)
    factor = 1
    while True:
        joints = [0]
        while joints[-1] < last and len(joints) <= MOST_WINDOWS + 1:
            ahead = np.arange(joints[-1] + 1, last + 1)
            drift, _ = drift_between(track, np.full(len(ahead), joints[-1]), ahead)
            good = drift <= factor * WINDOW_DRIFT * sigma
            good &= seen[ahead] - seen[joints[-1]] <= factor * WINDOW_RANGES
            joints.append(joints[-1] + max(1, int(np.count_nonzero(good))))
        if joints[-1] == last and len(joints) <= MOST_WINDOWS + 1:
            return np.array(joints, dtype=np.int64)
        factor *= 2
